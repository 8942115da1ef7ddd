# SPDX-License-Identifier: GPL-3.0-or-later
"""Command line of headless.py."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import NoReturn

_INTRODUCTION = """\
ObjectGS without a window: from captures to .blend files and images.

  blender -b -P headless.py -- run   garden --out garden-splats --minutes 10
  blender -b -P headless.py -- batch captures --out results --minutes 10

A Python that has the bpy wheel does the same: python headless.py run ...
"""

_ENDING = """\
`COMMAND --help` lists a command's options. Ctrl+C or SIGTERM stops at any time;
the same command continues from there. Exit codes: 0 done, 2 the input cannot be
used (one sentence says why), 130 cancelled, 1 anything else.
"""

_BATCH = """\
Run every capture in FOLDER (each subfolder with images/ or sparse/), each into
DIR/<name>, and write a summary to DIR/batch.md and DIR/batch.json. A failure does
not stop the other captures. The same command continues later; captures that were
finished with the same settings are skipped, and so are those that another batch
runs, so several computers can share the folders. Exit code 2 if any capture cannot
be used, also since another program uses it, 1 if any failed for another reason.
"""

_TRAIN_OPTIONS = """\
All other options after {} are those of the backend's train command:
--minutes M or --steps N, --max-size PIXELS, --only NAME ..., --keep KEY ... (train --help lists them).
"""


_MESH = """\
Make a textured mesh of each object of the reconstruction in DIR, in DIR/meshes.
OPTIONS are those of `python -m backend mesh`, whose --help explains them:
--objects NAME ..., --set NAME=ID,ID, --scene, --faces N, --open, --texture-size N.
"""


_PLAN = """\
Print what training would do with a capture, what it would leave out, and why, without
training. OPTIONS are those of `python -m backend plan`, whose --help explains them:
--keep KEY ..., --leave-out KEY ..., --only NAME ..., --no-meshes.
"""

_RESULT_COMMANDS = {
    "edit": (
        "remove, recolor, move or duplicate objects",
        """\
Edit the objects of the reconstruction in DIR, as build shows and export writes them. The
splats are unchanged, so that each edit can be undone. Without OPTIONS, print the
edits. OPTIONS are those of `python -m backend edit`, whose --help explains them:
--remove mug, --restore mug, --recolor can:hue=0.3, --move box:x=0.1, --duplicate ...,
--reset all.
""",
    ),
    "export": (
        "write the splats for other programs",
        """\
Write the splats of the reconstruction in DIR, with all edits, as PLY, SPZ, .splat, glTF or
USD; export-meshes writes the meshes.
OPTIONS are those of `python -m backend export`, whose --help explains them:
--format F, --objects NAME ..., --per-object, --coordinates blender, --sh-degree N.
""",
    ),
}

_EXPORT_MESHES = """\
Write the meshes of the reconstruction in DIR with their textures and all edits, as glTF,
USD or OBJ: without removed objects, recolored, moved, and with duplicates. Only the .blend
has its Set Ground and Set Distance, which are left out.
"""

_IMPORT_SPLATS = """\
Make a reconstruction of splats that were trained by another program: SPLATS is a PLY,
SPZ or .splat file. With --capture, the masks of the capture assign each splat to an object.
"""

_FILM = """\
Render the splats of a reconstruction through the camera of a .blend, frame by frame:
color, depth and object mattes in FOLDER/splats.0001.exr and so on, with the edits of
objects.json and the objects' transforms in the .blend. --composite also renders the
.blend with Blender and combines both by depth. Existing film frames and composites are
skipped, so that several machines can share FOLDER, each with its own --frames.
"""


class UsageError(Exception):
    """The command line is invalid; the message is one sentence."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message[:1].upper()}{message[1:]}; see headless.py --help.")


def parse(arguments: list[str]) -> argparse.Namespace:
    """Parse a command line.

    Returns:
        The options, with `command`; commands that pass options to the backend also have `source` and `rest`.

    Raises:
        UsageError: the command line is invalid.
        SystemExit: after --help.
    """
    options, rest = _parser().parse_known_args(arguments)
    if options.takes is None:
        if rest:
            raise UsageError(f"Unrecognized arguments: {' '.join(rest)}; see headless.py --help.")
        return options
    if not rest or rest[0].startswith("-"):
        out = "" if options.takes == "DIR" else " --out DIR"
        raise UsageError(f"{options.takes} must come first: headless.py {options.command} {options.takes}{out}.")
    options.source, *options.rest = rest
    return options


def _parser() -> argparse.ArgumentParser:
    how = argparse.RawDescriptionHelpFormatter
    top = _Parser(
        prog="headless.py", description=_INTRODUCTION, epilog=_ENDING, formatter_class=how, allow_abbrev=False
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND", title="commands")

    def command(
        name: str,
        summary: str,
        description: str,
        usage: str | None = None,
        takes: str | None = None,
        epilog: str | None = None,
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=summary,
            description=description,
            usage=usage,
            epilog=epilog,
            formatter_class=how,
            allow_abbrev=False,
        )
        sub.set_defaults(takes=takes)
        return sub

    _demo(
        command(
            "demo",
            "render the demo capture",
            "Render the built-in demo capture: objects on a table, with masks, a sparse model and the ground truth.",
        )
    )
    for name, summary in (
        ("import", "open a capture"),
        ("vote", "assign an object to each point by a vote of the masks"),
        ("train", "train the splats"),
    ):
        sub = command(
            name,
            summary,
            f"The backend's {name} command: {summary}.",
            takes="CAPTURE",
            usage=f"headless.py {name} CAPTURE --out DIR [OPTIONS]",
            epilog=f"OPTIONS are those of `python -m backend {name}`, whose --help explains them.",
        )
        _backend(sub)
        if name != "import":
            _groups(sub)
    planned = command(
        "plan",
        "analyze which parts of training a capture needs",
        _PLAN,
        takes="CAPTURE",
        usage="headless.py plan CAPTURE [--out DIR] [OPTIONS]",
    )
    _backend(planned, out_required=False)
    _groups(planned)
    mesh = command(
        "mesh", "make a textured mesh of each object", _MESH, takes="DIR", usage="headless.py mesh DIR [OPTIONS]"
    )
    mesh.add_argument("--capture", type=Path, metavar="CAPTURE", help="the capture's present folder, if it was moved")
    _backend_python(mesh)
    for name, (summary, description) in _RESULT_COMMANDS.items():
        out = " --out PATH" if name == "export" else ""
        sub = command(name, summary, description, takes="DIR", usage=f"headless.py {name} DIR{out} [OPTIONS]")
        if out:
            sub.add_argument(
                "--out", type=Path, required=True, metavar="PATH", help="file, or a folder with --per-object"
            )
        _backend_python(sub)
    _export_meshes(command("export-meshes", "write the meshes for other programs", _EXPORT_MESHES))
    imported = command(
        "import-splats",
        "make a reconstruction of splats of another program",
        _IMPORT_SPLATS,
        takes="SPLATS",
        usage="headless.py import-splats SPLATS --out DIR [--capture CAPTURE]",
    )
    imported.add_argument("--capture", type=Path, metavar="CAPTURE", help="folder with images/, cameras and masks/")
    _backend(imported)
    build = command(
        "build",
        "make a .blend of a reconstruction",
        "Put a reconstruction's cameras, points, splats and meshes into a new .blend file.",
    )
    build.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder")
    build.add_argument(
        "--blend",
        type=Path,
        metavar="FILE",
        help="file to write (DIR/objectgs.blend, or objectgs-2.blend if that was saved since)",
    )
    render = command("render", "render an image of a .blend", "Render an image of a .blend file made by build.")
    render.add_argument(
        "source",
        type=Path,
        metavar="DIR_OR_BLEND",
        help="reconstruction folder, whose .blend that was built last is rendered, or any .blend file",
    )
    render.add_argument("--out", type=Path, required=True, metavar="IMAGE", help="file.png, .jpg or .exr")
    render.add_argument("--camera", metavar="NAME", help="a camera of the file (the scene's own)")
    render.add_argument("--show", choices=("splats", "meshes", "both"), help="parts of the objects (as in the file)")
    render.add_argument(
        "--apart",
        action="store_true",
        help=("pull the objects' meshes apart, with a light, a ground and a camera; the file is unchanged"),
    )
    _picture(render)
    _film(command("film", "render film frames through the camera of a .blend", _FILM))
    run = command(
        "run",
        "all steps from a capture to a .blend and images",
        (
            "Train, make meshes, evaluate, make DIR/objectgs.blend and render it: DIR/render.png shows the splats,\n"
            "DIR/pulled-apart.png the objects' meshes, if there are any."
        ),
        takes="CAPTURE",
        usage="headless.py run CAPTURE --out DIR [OPTIONS]",
        epilog=_TRAIN_OPTIONS.format("CAPTURE"),
    )
    _backend(run)
    _compute(run)
    _groups(run)
    _meshes(run)
    _picture(run)
    batch = command(
        "batch",
        "run every capture of a folder",
        _BATCH,
        takes="FOLDER",
        usage="headless.py batch FOLDER --out DIR [OPTIONS]",
        epilog=_TRAIN_OPTIONS.format("FOLDER"),
    )
    _backend(batch, out="folder of all reconstructions and of the summary")
    _compute(batch)
    _groups(batch)
    _meshes(batch)
    _picture(batch)
    return top


def _export_meshes(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder")
    sub.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="file.glb, .usdc or .obj; with --per-object, a folder of that name without the suffix",
    )
    sub.add_argument(
        "--objects", action="extend", nargs="+", metavar="OBJECT", help="names or IDs (all that are not removed)"
    )
    sub.add_argument("--per-object", action="store_true", help="write one file per object")
    sub.add_argument(
        "--coordinates",
        choices=("blender", "capture"),
        default="blender",
        help="blender: as in Blender, in the axes of the format; capture: those of the cameras (blender)",
    )


def _film(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("blend", type=Path, metavar="BLEND", help="file with the reconstruction and a camera")
    sub.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder of the frames")
    sub.add_argument("--frames", metavar="LIST", help="as 1-24 or 1,5,9-12 (the file's own range)")
    sub.add_argument(
        "--subframes",
        type=_count,
        metavar="N",
        help="subframes while the shutter is open (9 if the file has motion blur, else 1)",
    )
    sub.add_argument("--png", action="store_true", help="also write each frame as PNG with alpha")
    sub.add_argument(
        "--composite",
        choices=("png", "exr"),
        help=(
            "also render the file with Blender, combined with the splats by depth: FOLDER/composite.0001.png or .exr"
        ),
    )
    sub.add_argument("--save", type=Path, metavar="FILE", help="save the .blend, with its compositor set up, as FILE")
    sub.add_argument(
        "--dir", type=Path, metavar="DIR", help="the reconstruction folder, if it was moved or is on another computer"
    )
    sub.add_argument("--camera", metavar="NAME", help="a camera of the file (the scene's own)")
    sub.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="device that renders the splats (auto)"
    )
    _backend_python(sub)
    _picture(sub)


def _demo(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("out", type=Path, metavar="OUT", help="folder to make")
    sub.add_argument("--objects", type=int, default=8, help="objects on the table, 1 to 60 (default 8)")
    sub.add_argument("--views", type=int, default=48, help="images on two rings (default 48)")
    sub.add_argument("--width", type=int, default=320, help="pixels (default 320)")
    sub.add_argument("--height", type=int, default=240, help="pixels (default 240)")
    sub.add_argument("--seed", type=int, default=0, help="random seed (default 0)")
    sub.add_argument(
        "--mask-noise",
        type=float,
        default=0.0,
        metavar="X",
        help=(
            "noise of masks/, 0 (none, default) to 1 (poor): borders move by up to 4X pixels; an object of a view is "
            "1-3 pixels too large or small with probability X, has a wrong ID with 0.15 X, is missing with 0.10 X"
        ),
    )
    sub.add_argument("--samples", type=int, default=20, help="maximum samples per pixel, denoised (default 20)")
    sub.add_argument("--json", action="store_true", help="print events as JSON lines, for other programs")
    sub.add_argument("--overwrite", action="store_true", help="replace a demo capture with other settings in OUT")


def _backend(sub: argparse.ArgumentParser, out_required: bool = True, out: str = "reconstruction folder") -> None:
    sub.add_argument("--out", type=Path, required=out_required, metavar="DIR", help=out)
    _backend_python(sub)


def _compute(sub: argparse.ArgumentParser) -> None:
    """Add the options that each of several commands of the backend takes."""
    sub.add_argument("--device", choices=("auto", "cpu", "cuda"), help="device of all steps (auto)")
    sub.add_argument("--threads", type=_count, metavar="N", help="number of CPU threads of each step (all)")
    sub.add_argument("--memory-mb", type=_count, metavar="MB", help="memory of each step for decoded images (2000)")


def _groups(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--groups",
        type=Path,
        metavar="FILE",
        help=('labels file; IDs with the same name are one object: {"1": "chair", "2": "chair"}'),
    )


def _meshes(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--no-meshes", action="store_true", help="make splats only")


def _backend_python(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--backend-python",
        metavar="PATH",
        help=("Python of the compute backend (the variable OBJECTGS_PYTHON, or that of the preferences)"),
    )


def _picture(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--engine", choices=("CYCLES", "EEVEE"), help="render engine (the file's own)")
    sub.add_argument("--samples", type=_count, metavar="N", help="samples per pixel (the file's own)")
    sub.add_argument("--size", type=_size, metavar="WxH", help="pixels (the file's own)")


def _count(text: str) -> int:
    if not re.fullmatch("[1-9][0-9]{0,5}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch("([0-9]{1,5})x([0-9]{1,5})", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    if not (4 <= width <= 65536 and 4 <= height <= 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 640x480")
    return width, height
