"""The command line: what can be asked, and exit codes. What is done lives in `backend.commands`."""

from __future__ import annotations

import argparse
import errno
import math
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from . import __version__, lacking
from .expectation import PRESET_STEPS
from .planning.plan import EVERYTHING, KEYS
from .protocol import (
    EXIT_BAD_INPUT,
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_FAILED,
    Cancelled,
    InputError,
    JsonReporter,
    Reporter,
)
from .recolour import Recolour
from .stopping import StoppingReporter, StopRequest

_INTRODUCTION = """\
From photos to labelled splats and meshes. A capture is a folder with images/, the COLMAP
model of their cameras in sparse/0, and, for objects, one picture of object IDs
for each image in masks/. What is made of it goes into a reconstruction folder.

  python -m backend check    garden                      what is in the capture?
  python -m backend plan     garden                      what does it need?
  python -m backend train    garden --out garden-splats  make the splats (5 minutes)
  python -m backend mesh     garden-splats               make each object's mesh
  python -m backend evaluate garden-splats               how good are they?
  python -m backend report   garden-splats               read garden-splats/report.md
  python -m backend edit     garden-splats --remove mug  change objects
  python -m backend export   garden-splats --out all.ply for other programs
"""

_ENDING = """\
`python -m backend COMMAND --help` lists a command's options. Ctrl+C stops at any
time; the same command goes on from there. Exit codes: 0 done, 2 the input cannot
be used (one sentence says why), 130 stopped, 1 anything else.
"""

_CHECK = """\
Look through a capture and say what it holds and what is wrong with it: cameras,
images without a pose, masks, objects. Nothing is written.
"""

_IMPORT = """\
Get a capture ready to be shown: undistort its images once, and leave its cameras in
cameras.json and its points in points.ply. `vote` and `train` do this by themselves.
"""

_PLAN = """\
Say what training would do with a capture and what it would leave out, and why: nothing
is trained and no image is changed. Takes the options of `train`, whose --keep and
--leave-out change the plan. With --out, what DIR knows already counts (votes, objects
that are left out), and the plan is left in DIR/plan.json.
"""

_VOTE = """\
Give each 3D point of the capture the object that most masks show there. Leaves
points.ply, with an object_id for each point, and objects.json in the
reconstruction folder. `train` does this by itself where it is not done yet.
"""

_TRAIN = """\
Make the splats. Leaves splats.ply, which splat viewers and Blender read, a
checkpoint to go on from, and previews/, which show how it looks now.
Stopped, it leaves what it has come to, the mean over its latest steps.
Run again with more --minutes or --steps, it goes on where it stopped.
"""

_RENDER = """\
Draw the splats from the capture's cameras into DIR/renders, named as the images.
"""

_EVALUATE = """\
Compare renders with the photos that training has not seen (every 8th). PSNR and
SSIM say how close the pictures are; mIoU, mBIoU, Dice and accuracy how well the
objects agree with the masks. Meshes are measured too: whether they are closed, how
their texture looks in those photos, and, where CAPTURE/truth has the true surfaces,
how close they come. `report` shows the figures.
"""

_MESH = """\
Make a textured mesh of each object: closed, in the capture's own place and scale,
in DIR/meshes as PLY with a PNG. Stopped, the same command goes on with what is
missing. `evaluate` afterwards measures the meshes too.
"""

_FILM = """\
Draw film frames of the splats, with the edits of DIR/objects.json, as a shot file
says: multilayer EXR with colour (linear, premultiplied), depth, object IDs and
Cryptomatte. Blender's panel Film writes shot files; backend/film/shot.py says what
they hold. Frames that are there already are skipped, so several machines can share
a folder, each with its own --frames.
"""

_REPORT = """\
Write report.md, with pictures, plots and what was left out, and report.json, the
same for programs. Run `evaluate` before, so that the report says how good it is.
"""

_EDIT = """\
Remove, recolour, move or copy objects: what `export`, `film` and Blender show. Edits
are kept in objects.json, and what was trained stays as it is, so that each can be
taken back; without options, say what is edited. OBJECT is a name, a part of one, or an
ID; several KEY=VALUE are parted by commas. Lengths are in the capture's units; x, y and
z are Blender's axes, z up; turns (rx, ry, rz) are in degrees and, as the scale, about
the object's middle. A new colour or place takes the place of the one before it.
"""

_EXPORT = """\
Write the splats, with all edits, for other programs: as PLY (exact, with object_id),
SPZ (a fifth of the size) or .splat (one colour each).
"""

_IMPORT_SPLATS = """\
Make a reconstruction of splats that were trained elsewhere. Their objects are those of
object_id in the file; or, with --capture, of a vote by that capture's masks, where the
splats are in its coordinates.
"""

_DOCTOR = """\
Say which versions and devices are there, and try everything on a tiny scene. The
first run compiles the kernels, about a minute, so that later commands start at once.
"""


class _UsageError(Exception):
    """The command line makes no sense; the message is argparse's, made a sentence."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise _UsageError(f"{message[:1].upper()}{message[1:]}; see `{self.prog} --help`.")


def parser() -> argparse.ArgumentParser:
    """Every command and option."""
    how = argparse.RawDescriptionHelpFormatter
    top = _Parser(
        prog="python -m backend", description=_INTRODUCTION, epilog=_ENDING, formatter_class=how, allow_abbrev=False
    )
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND", title="commands")

    def command(name: str, summary: str, description: str, example: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=summary, description=description, formatter_class=how, allow_abbrev=False,
            epilog=f"example:\n  python -m backend {name} {example}".rstrip(),
        )  # fmt: skip
        sub.add_argument("--json", action="store_true", help="print events as JSON lines, for other programs")
        sub.add_argument("--threads", type=_count, metavar="N", help="processor cores to use (default: all)")
        return sub

    def memory_option(sub: argparse.ArgumentParser) -> None:
        sub.add_argument(
            "--memory-mb", type=_count, default=2000, metavar="MB", help="memory for images; more is faster (2000)"
        )

    def device_option(sub: argparse.ArgumentParser) -> None:
        sub.add_argument(
            "--device", choices=("auto", "cpu", "cuda"), default="auto",
            help="cpu, or cuda: an NVIDIA GPU; `doctor` says why one is not used (auto: cuda where it works)",
        )  # fmt: skip

    def size_option(sub: argparse.ArgumentParser) -> None:
        sub.add_argument(
            "--max-size", type=_count, default=1600, metavar="PIXELS",
            help="larger images are reduced to this longest side (1600)",
        )  # fmt: skip

    def capture_options(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with images/, sparse/0/ and masks/")
        size_option(sub)

    def making_options(sub: argparse.ArgumentParser, out_required: bool = True) -> None:
        capture_options(sub)
        memory_option(sub)
        sub.add_argument(
            "--out", type=Path, required=out_required, metavar="DIR",
            help="reconstruction folder, made where it is not there",
        )  # fmt: skip

    def vote_options(sub: argparse.ArgumentParser, out_required: bool = True) -> None:
        making_options(sub, out_required)
        sub.add_argument(
            "--strategy", choices=("majority", "probability", "correspondence"), default="majority",
            help="a point's object: the one most masks show there (majority), one drawn as often as masks show it, "
            "or only by masks of images in which COLMAP found the point",
        )  # fmt: skip
        sub.add_argument("--seed", type=_seed, default=0, metavar="N", help="same seed, same result (0)")
        sub.add_argument(
            "--only", nargs="+", metavar="OBJECT",
            help="make these objects, by names or IDs; the others stay part of the unlabelled rest",
        )  # fmt: skip
        sub.add_argument(
            "--groups", type=Path, metavar="FILE",
            help='IDs that are one object: a labels file that gives them one name, {"1": "chair", "2": "chair"}',
        )  # fmt: skip

    def plan_options(sub: argparse.ArgumentParser) -> None:
        group = sub.add_argument_group("what is left out; `plan` says what and why")
        group.add_argument(
            "--keep", nargs="+", default=[], choices=(*KEYS, EVERYTHING), metavar="KEY",
            help=f"do what the plan leaves out: {', '.join(KEYS)}, or {EVERYTHING} of them",
        )  # fmt: skip
        group.add_argument(
            "--leave-out", nargs="+", default=[], choices=KEYS, metavar="KEY", help="leave out what the plan does"
        )
        group.add_argument("--no-meshes", action="store_true", help="no meshes will be made of these splats")

    check = command("check", "say what a capture holds and what is wrong with it", _CHECK, "garden")
    capture_options(check)

    making = command("import", "get cameras and points ready to be shown", _IMPORT, "garden --out garden-splats")
    making_options(making)

    vote = command("vote", "give each point its object, from the masks", _VOTE, "garden --out garden-splats")
    vote_options(vote)

    for name, summary, description, example in (
        ("plan", "say what a capture needs and what it can do without", _PLAN, "garden"),
        ("train", "make the splats", _TRAIN, "garden --out garden-splats --minutes 10"),
    ):
        train = command(name, summary, description, example)
        vote_options(train, out_required=name == "train")
        device_option(train)
        length = train.add_mutually_exclusive_group()
        length.add_argument(
            "--minutes", type=_amount, metavar="M",
            help="train this long in all (5); with --preset final at most this long",
        )  # fmt: skip
        length.add_argument(
            "--steps", type=_count, metavar="N", help="train this many steps in all, however long it takes"
        )
        train.add_argument(
            "--preset", choices=("preview", "standard", "final"),
            help=f"instead: preview, {PRESET_STEPS['preview']} steps, shows whether all is well; standard, "
            f"{PRESET_STEPS['standard']} steps; final goes on until the error on held-out views has flattened",
        )  # fmt: skip
        train.add_argument("--restart", action="store_true", help="forget an earlier training in DIR")
        train.add_argument(
            "--checkpoint-seconds", type=_amount, default=30.0, metavar="S",
            help="the most work that a crash can cost (30)",
        )  # fmt: skip
        finer = train.add_argument_group("how the splats are made; the defaults suit most captures")
        finer.add_argument(
            "--mode", choices=("explicit", "view"), default="explicit",
            help="explicit: splats.ply is exactly the model; view: as in the paper, splats change with the camera and "
            "splats.ply is a fit (explicit)",
        )  # fmt: skip
        finer.add_argument(
            "--primitive", choices=("3d", "2d"), default="3d",
            help="2d: flat splats, which lie on the surfaces; splats.ply holds them as thin Gaussians (3d)",
        )  # fmt: skip
        finer.add_argument(
            "--sh-degree", type=int, choices=(0, 1, 2, 3), default=1,
            help="how much colour may change with direction, in explicit mode; 0: not at all (1)",
        )  # fmt: skip
        finer.add_argument(
            "--background", choices=("learned", "black", "white"), default="learned", help="behind all splats (learned)"
        )
        finer.add_argument(
            "--voxel", type=_amount, metavar="SIZE", help="finest detail, in the capture's units (automatic)"
        )
        finer.add_argument("--offsets", type=_count, metavar="N", help="splats around each anchor (10)")
        finer.add_argument("--max-anchors", type=_count, metavar="N", help="growth stops there (200000)")
        finer.add_argument(
            "--semantic-weight", type=_weight, metavar="W", help="how much masks count; 0.01 for poor ones (0.1)"
        )
        finer.add_argument(
            "--normal-weight", type=_weight, metavar="W", help="how smooth a surface flat splats make (0.05)"
        )
        finer.add_argument(
            "--distortion-weight", type=_weight, metavar="W", help="how much flat splats are drawn to one depth (10)"
        )
        finer.add_argument(
            "--unlabelled-is-object", action="store_true", help="ID 0 is an object too, not just unlabelled"
        )
        plan_options(train)

    def result(name: str, summary: str, description: str, example: str) -> argparse.ArgumentParser:
        sub = command(name, summary, description, example)
        sub.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder, as given to train --out")
        sub.add_argument("--capture", type=Path, metavar="CAPTURE", help="where the capture is now, if it was moved")
        memory_option(sub)
        device_option(sub)
        return sub

    render = result("render", "draw the splats as pictures", _RENDER, "garden-splats --views all --ids")
    render.add_argument(
        "--views", choices=("held-out", "all"), default="held-out", help="those not trained on, or all (held-out)"
    )
    render.add_argument("--ids", action="store_true", help="also the object IDs, as NAME.ids.png of 16 bits")
    render.add_argument("--depth", action="store_true", help="also the depth in the capture's units, as NAME.depth.npy")
    mesh = result("mesh", "make a textured mesh of each object", _MESH, "garden-splats --objects mug can")
    mesh.add_argument(
        "--objects", nargs="+", metavar="OBJECT", help="names or IDs; without: every object that is not left out"
    )
    mesh.add_argument(
        "--set", action="append", type=_named_set, metavar="NAME=ID,ID",
        help="one mesh of several objects, by names or IDs; may be given again",
    )  # fmt: skip
    mesh.add_argument("--scene", action="store_true", help="one mesh of everything")
    mesh.add_argument(
        "--faces", type=_faces, default=20_000, metavar="N",
        help="most triangles of an object; the whole scene may have five times as many (20000)",
    )  # fmt: skip
    mesh.add_argument("--open", action="store_true", help="leave open what no camera saw, such as undersides")
    mesh.add_argument(
        "--texture-size", type=int, choices=(256, 512, 1024, 2048, 4096), metavar="PIXELS",
        help="side of the texture: 256 to 4096 (from the photos' resolution)",
    )  # fmt: skip
    mesh.add_argument("--restart", action="store_true", help="make meshes anew that are there already")
    film = command(
        "film", "draw film frames through an animated camera", _FILM, "garden-splats --shot shot.json --out f"
    )
    film.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder, as given to train --out")
    film.add_argument("--shot", type=Path, required=True, metavar="FILE", help="camera and objects, moment by moment")
    film.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="where splats.0001.exr ... go")
    film.add_argument("--frames", metavar="LIST", help="only these of the shot's frames, as 1-24 or 1,5,9-12")
    film.add_argument("--png", action="store_true", help="each frame also as PNG: encoded as a photo, straight alpha")
    device_option(film)
    edit = command(
        "edit", "remove, recolour, move or copy objects", _EDIT,
        "garden-splats --remove mug --recolor can:hue=0.3 --move box:x=0.1",
    )  # fmt: skip
    edit.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder")
    edit.add_argument("--remove", nargs="+", default=[], metavar="OBJECT", help="make objects invisible")
    edit.add_argument("--floaters", action="store_true", help="with --remove: what floats unlabelled inside them, too")
    edit.add_argument(
        "--fill", action="store_true",
        help="with --remove: close the flat ground or wall that they hid, with what is around (marked as invented)",
    )  # fmt: skip
    edit.add_argument("--restore", nargs="+", default=[], metavar="OBJECT", help="make removed objects visible again")
    edit.add_argument(
        "--recolor", nargs="+", default=[], type=_recolour, metavar="OBJECT:KEY=VALUE",
        help="hue (-0.5 to 0.5: turns of the colour wheel), saturation (0: grey, 1: as it is), value and contrast (1: "
        "as it is), tint=#RRGGBB, replace=#RRGGBB and amount (0 to 1: how much of replace)",
    )  # fmt: skip
    edit.add_argument(
        "--move", nargs="+", default=[], type=_placement, metavar="OBJECT:KEY=VALUE",
        help="from where it was captured: x, y, z, rx, ry, rz, scale",
    )  # fmt: skip
    edit.add_argument(
        "--duplicate", nargs="+", default=[], type=_placement, metavar="OBJECT:KEY=VALUE",
        help="one more, placed like that",
    )  # fmt: skip
    edit.add_argument(
        "--reset", nargs="+", default=[], metavar="OBJECT", help="take all of these edits of objects back, or of `all`"
    )

    export = command(
        "export", "write the splats for other programs", _EXPORT, "garden-splats --out mug.spz --objects mug"
    )
    export.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder")
    export.add_argument("--out", type=Path, required=True, metavar="PATH", help="file, or a folder with --per-object")
    export.add_argument("--format", choices=("ply", "spz", "splat"), help="(by the file's suffix, else ply)")
    export.add_argument("--objects", nargs="+", metavar="OBJECT", help="names or IDs; without: everything")
    export.add_argument("--per-object", action="store_true", help="a file for each object")
    export.add_argument(
        "--coordinates", choices=("capture", "blender"), default="capture",
        help="COLMAP's, as photos and cameras have them, or Blender's, z up (capture)",
    )  # fmt: skip
    export.add_argument(
        "--sh-degree", type=int, choices=(0, 1, 2, 3), help="spherical harmonics up to this degree (as trained)"
    )
    export.add_argument(
        "--no-ids", action="store_true", help="PLY without object_id, for programs that stumble over it"
    )

    imported = command(
        "import-splats", "make a reconstruction of splats from elsewhere", _IMPORT_SPLATS,
        "point_cloud.ply --out garden-splats --capture garden",
    )  # fmt: skip
    imported.add_argument("ply", type=Path, metavar="PLY", help="splats as 3D Gaussian splatting programs write them")
    imported.add_argument("--out", type=Path, required=True, metavar="DIR", help="reconstruction folder to make")
    imported.add_argument("--capture", type=Path, metavar="CAPTURE", help="folder with images/, sparse/0/ and masks/")
    size_option(imported)
    memory_option(imported)

    result("evaluate", "measure how good the splats are", _EVALUATE, "garden-splats")
    result("report", "write a report with pictures", _REPORT, "garden-splats")
    device_option(command("doctor", "say whether everything works on this computer", _DOCTOR, ""))
    return top


def _whole(text: str, least: int, wanted: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value < 2**63:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number {wanted}")
    return value


def _count(text: str) -> int:
    return _whole(text, 1, "above 0")


def _faces(text: str) -> int:
    return _whole(text, 100, "from 100 on")


def _named_set(text: str) -> tuple[str, list[str]]:
    name, _, words = text.partition("=")
    found = [word.strip() for word in words.split(",") if word.strip()]
    if not name.strip() or not found:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=ID,ID")
    return name.strip(), found


def _keys(text: str, known: Sequence[str]) -> tuple[str, dict[str, str]]:
    """OBJECT:KEY=VALUE,KEY=VALUE taken apart."""
    word, _, rest = text.rpartition(":")
    values = {}
    for part in rest.split(","):
        key, _, value = part.partition("=")
        values[key.strip()] = value.strip()
    if not word.strip() or not all(values.values()):
        raise argparse.ArgumentTypeError(f"{text!r} is not OBJECT:KEY=VALUE,KEY=VALUE")
    if unknown := [key for key in values if key not in known]:
        raise argparse.ArgumentTypeError(f"{text!r} has an unknown {unknown[0]!r}; there are {', '.join(known)}")
    return word.strip(), values


def _number(key: str, text: str, least: float = -math.inf, most: float = math.inf) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and least <= value <= most):
        between = f" between {least:g} and {most:g}" if math.isfinite(most) else f" from {least:g} on"
        wanted = between if math.isfinite(least) else ""
        raise argparse.ArgumentTypeError(f"{key}={text} is not a number{wanted}")
    return value


def _recolour(text: str) -> tuple[str, Recolour]:
    ranges = {"hue": (-0.5, 0.5), "amount": (0.0, 1.0)}
    word, given = _keys(text, ("hue", "saturation", "value", "contrast", "tint", "replace", "amount"))
    values: dict[str, Any] = {}
    for key, value in given.items():
        if key not in ("tint", "replace"):
            values[key] = _number(key, value, *ranges.get(key, (0.0,)))
        elif re.fullmatch("#[0-9a-fA-F]{6}", value):
            values[key] = tuple(channel / 255 for channel in bytes.fromhex(value[1:]))
        else:
            raise argparse.ArgumentTypeError(f"{key}={value} is not a colour such as #ff8800")
    if "replace" in values:
        values.setdefault("amount", 1.0)
    return word, Recolour(**values)


def _placement(text: str) -> tuple[str, dict[str, float]]:
    word, given = _keys(text, ("x", "y", "z", "rx", "ry", "rz", "scale"))
    values = {key: _number(key, value) for key, value in given.items()}
    if values.get("scale", 1.0) <= 0:
        raise argparse.ArgumentTypeError(f"scale={given['scale']} is not a number above 0")
    return word, values


def _seed(text: str) -> int:
    return _whole(text, 0, "from 0 on")


def _weight(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 on")
    return value


def _amount(text: str) -> float:
    value = _weight(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    reporter = _reporter(as_json="--json" in arguments)
    try:
        return _run(arguments, reporter)
    except BrokenPipeError:
        # Nobody reads any more. Python would complain once again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_CANCELLED
    finally:
        reporter.close()


def _run(arguments: list[str], reporter: Reporter) -> int:
    stop = StopRequest(announce=reporter.status)
    try:
        options = parser().parse_args(arguments)
        # Before the signals are taken over, since pycolmap takes SIGTERM for itself when it is imported.
        from .commands import COMMANDS
        from .commands.machine import set_threads

        with stop.listening(read_stdin=options.json):
            set_threads(options.threads)
            COMMANDS[options.command](options, StoppingReporter(reporter, stop))
        return EXIT_DONE
    except (InputError, _UsageError) as error:
        reporter.error(str(error))
        return EXIT_BAD_INPUT
    except (Cancelled, KeyboardInterrupt) as error:
        reporter.stopped(str(error) or "Stopped at once.")
        return EXIT_CANCELLED
    except BrokenPipeError:
        raise
    except Exception as error:
        sentence = _refusal(error)
        if sentence:
            reporter.error(sentence)
            return EXIT_BAD_INPUT
        import traceback

        traceback.print_exc(file=sys.stderr)
        reporter.error(f"An unexpected failure: {type(error).__name__}: {' '.join(str(error).split())}")
        return EXIT_FAILED


def _reporter(as_json: bool) -> Reporter:
    if as_json:
        return JsonReporter()
    from .console import ConsoleReporter

    return ConsoleReporter()


def _refusal(error: Exception) -> str | None:
    """What the machine lacks for what was asked, as a sentence; None for every other failure."""
    from .device import is_out_of_memory

    if is_out_of_memory(error):
        return (
            "The GPU's memory is full; close programs that use it, or try a smaller --max-size or --max-anchors, or "
            "--device cpu. The same command goes on from the last checkpoint."
        )
    # torch says that memory ran out with a RuntimeError.
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate memory" in str(error)):
        return "There is not enough memory; try a smaller --max-size, --memory-mb or --max-anchors."
    if isinstance(error, ModuleNotFoundError):
        return lacking(error)
    if isinstance(error, OSError) and error.filename:
        full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
        what = "could not be written" if full else "cannot be used"
        advice = "free some space and run the same command again" if full else "check it and its permissions"
        return f"{error.filename} {what} ({error.strerror}); {advice}."
    return None
