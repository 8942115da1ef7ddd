"""Every command and option of `python -m backend`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

from ..shared.defaults import DETAIL, OVERLAP
from ..shared.version import __version__
from . import options, texts, types


class UsageError(Exception):
    """The command line is not valid; the message is argparse's as a sentence."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message[:1].upper()}{message[1:]}; see `{self.prog} --help`.")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line.

    Returns:
        A parser whose result contains the command's name as `command` and its options. It raises `UsageError` instead
        of exiting.
    """
    parser = _Parser(
        prog="python -m backend",
        description=texts.INTRODUCTION,
        epilog=texts.ENDING,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = _Commands(parser)
    _add_capture_commands(commands)
    _add_training_commands(commands)
    _add_cells(commands)
    _add_label(commands)
    _add_render(commands)
    _add_mesh(commands)
    _add_film(commands)
    _add_edit(commands)
    _add_export(commands)
    _add_import_splats(commands)
    _add_measuring_commands(commands)
    return parser


class _Commands:
    """Adds commands to a parser, each with the options that all commands have."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", title="commands")

    def add(self, name: str, summary: str, description: str, example: str) -> argparse.ArgumentParser:
        command = self._commands.add_parser(
            name, help=summary, description=description, allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            epilog=f"example:\n  python -m backend {name} {example}".rstrip(),
        )  # fmt: skip
        command.add_argument("--json", action="store_true", help="print events as JSON lines, for other programs")
        command.add_argument("--threads", type=types.count, metavar="N", help="number of CPU threads (default: all)")
        return command

    def add_for_result(self, name: str, summary: str, description: str, example: str) -> argparse.ArgumentParser:
        """Add a command that opens a trained reconstruction and its capture."""
        command = self.add(name, summary, description, example)
        options.add_reconstruction(command)
        command.add_argument(
            "--capture", type=Path, metavar="CAPTURE", help="the capture's present folder, if it was moved"
        )
        options.add_memory(command)
        options.add_device(command)
        return command


def _add_capture_commands(commands: _Commands) -> None:
    poses = commands.add("sfm", "Make a capture of photos or a video", texts.SFM, "photos --out garden")
    poses.add_argument(
        "photos",
        type=Path,
        nargs="+",
        metavar="PHOTOS",
        help="folder with photos and videos, also in subfolders; or a video; or files",
    )
    poses.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="folder for the new capture")
    poses.add_argument(
        "--cameras", choices=("auto", "one", "each"), default="auto",
        help="which photos share a camera and its focal length: auto, by size and EXIF; one, all; each, none (auto)",
    )  # fmt: skip
    poses.add_argument(
        "--calibration", type=Path, metavar="FILE",
        help="COLMAP's cameras.bin or cameras.txt, or its folder, with a camera for each size of photos; lenses are "
        "kept as they are there",
    )  # fmt: skip
    poses.add_argument(
        "--features", choices=("auto", "objects"), default="auto",
        help="where features are: auto, everywhere, unless the background stands still while the objects turn; "
        "objects, on the objects of the masks (auto)",
    )  # fmt: skip
    poses.add_argument(
        "--matcher", type=Path, metavar="FOLDER",
        help="match by the networks of a checkpoint of LightGlue or EfficientLoFTR; see above (SIFT)",
    )  # fmt: skip
    poses.add_argument(
        "--frames", type=types.count, metavar="N", help="number of frames of each video (by how far the picture moves)"
    )
    poses.add_argument(
        "--leave-out",
        action="extend",
        nargs="+",
        default=[],
        metavar="NAME",
        help="photos to leave out, named as in images/",
    )
    poses.add_argument(
        "--list", type=Path, metavar="FILE",
        help='JSON file with more of both, if a command line is too short: {"photos": [...], "leave_out": [...]}',
    )  # fmt: skip
    poses.add_argument(
        "--set", type=types.count, default=1, metavar="N",
        help="which set of photos to use if nothing connects several: 1, the largest; 2, the next (1)",
    )  # fmt: skip
    masks = commands.add(
        "masks", "Make masks of those of another program, or of a model", texts.MASKS,
        "garden segmentation/annotations.json",
    )  # fmt: skip
    masks.add_argument("capture", type=Path, metavar="CAPTURE", help=options.CAPTURE)
    masks.add_argument("masks", type=Path, metavar="MASKS", help="file or folder of masks, or model; see above")
    masks.add_argument(
        "--objects", choices=("auto", "given", "find"), default="auto",
        help="which segments show the same object: given, as the masks say; find, by the points that they show; auto, "
        "find if the masks do not say, or contradict the points (auto)",
    )  # fmt: skip
    masks.add_argument(
        "--text", type=types.names, metavar="NAMES",
        help='names of the objects that a model is to find, such as "red cup; book"; see above (all segments)',
    )  # fmt: skip
    masks.add_argument(
        "--detector", type=Path, metavar="FOLDER",
        help="checkpoint of Grounding DINO, which finds what --text names, unless MASKS is SAM 3",
    )  # fmt: skip
    options.add_device(masks)
    check = commands.add("check", "Check a capture and list its contents", texts.CHECK, "garden")
    options.add_capture(check)
    prepare = commands.add(
        "import", "Prepare a capture's cameras and points for display", texts.IMPORT, "garden --out garden-splats"
    )
    options.add_preparation(prepare)
    vote = commands.add(
        "vote", "Assign each point the object that most masks show", texts.VOTE, "garden --out garden-splats"
    )
    options.add_vote(vote)


def _add_training_commands(commands: _Commands) -> None:
    """Add `plan` and `train`, which take the same options."""
    for name, summary, description, example in (
        ("plan", "Show what training would do and omit, and why", texts.PLAN, "garden"),
        ("train", "Train the splats", texts.TRAIN, "garden --out garden-splats --minutes 10"),
    ):
        command = commands.add(name, summary, description, example)
        options.add_vote(command, out_required=name == "train")
        options.add_device(command)
        options.add_length(command)
        options.add_splats(command)
        options.add_plan_overrides(command)


def _add_cells(commands: _Commands) -> None:
    """Add `split`, `train-cell` and `merge`."""
    split = commands.add_for_result(
        "split", "Divide a large model into cells to train one by one", texts.SPLIT, "town-splats --cells 4"
    )
    split.add_argument("--cells", type=types.several, required=True, metavar="N", help="number of cells, at least 2")
    split.add_argument(
        "--overlap", type=types.fraction, default=OVERLAP, metavar="NUMBER",
        help=f"how far neighboring cells reach into each other, relative to their size ({OVERLAP:g})",
    )  # fmt: skip
    split.add_argument("--restart", action="store_true", help="discard cells of an earlier division")
    cell = commands.add_for_result(
        "train-cell", "Train one cell", texts.TRAIN_CELL, "town-splats --cell 0 --minutes 20"
    )
    cell.add_argument("--cell", type=types.index, required=True, metavar="N", help="number of the cell, from 0 on")
    length = cell.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=types.amount, metavar="M", help="total training time of the cell in minutes")
    length.add_argument(
        "--steps", type=types.count, metavar="N",
        help="total number of training steps of the cell (default: as many as the divided model has)",
    )  # fmt: skip
    cell.add_argument(
        "--max-anchors", type=types.count, metavar="N",
        help="maximum number of anchors of the cell (default: as for the whole of the divided model)",
    )  # fmt: skip
    cell.add_argument("--restart", action="store_true", help="discard an earlier training of the cell")
    options.add_checkpoint_seconds(cell)
    merge = commands.add_for_result("merge", "Join the trained cells", texts.MERGE, "town-splats")
    merge.add_argument(
        "--steps", type=types.count, metavar="N",
        help="number of training steps where cells meet (default: a twentieth of those of all cells, at most 2000)",
    )  # fmt: skip


def _add_label(commands: _Commands) -> None:
    """Add `propose`, `label`, `clean-labels` and `point`."""
    propose = commands.add_for_result(
        "propose", "Find objects without strokes or masks", texts.PROPOSE, "garden-splats"
    )
    propose.add_argument(
        "--strokes", type=Path, metavar="FILE", help="file of strokes to write (default: strokes.json in the folder)"
    )
    propose.add_argument(
        "--detail", type=types.fraction, default=DETAIL, metavar="NUMBER",
        help=f"from 0 to 1; more divides the scene into more objects ({DETAIL:g})",
    )  # fmt: skip
    label = commands.add_for_result(
        "label", "Separate objects by strokes on them in a few photos", texts.LABEL,
        "garden-splats --strokes strokes.json",
    )  # fmt: skip
    label.add_argument(
        "--strokes", type=Path, required=True, metavar="FILE", help="strokes on the objects, as JSON; see above"
    )
    commands.add_for_result(
        "clean-labels", "Correct masks and splats by the masks of all photos", texts.CLEAN_LABELS, "garden-splats"
    )
    point = commands.add_for_result(
        "point", "Answer the strokes of another program", texts.POINT, "garden-splats --json"
    )
    for command in (label, point):
        command.add_argument(
            "--segmenter", type=Path, metavar="FOLDER",
            help="take what a model segments by each stroke for the stroke: a checkpoint of SAM, SAM 2.1 or EdgeTAM",
        )  # fmt: skip


def _add_render(commands: _Commands) -> None:
    render = commands.add_for_result(
        "render", "Render the splats from the capture's cameras", texts.RENDER, "garden-splats --views all --ids"
    )
    render.add_argument(
        "--views", choices=("held-out", "all"), default="held-out",
        help="the views held out of training, or all views (held-out)",
    )  # fmt: skip
    render.add_argument("--ids", action="store_true", help="also write the object IDs, as 16-bit NAME.ids.png")
    render.add_argument(
        "--depth", action="store_true", help="also write the depth in the capture's units, as NAME.depth.npy"
    )


def _add_mesh(commands: _Commands) -> None:
    mesh = commands.add_for_result(
        "mesh", "Extract a textured mesh of each object", texts.MESH, "garden-splats --objects mug can"
    )
    mesh.add_argument(
        "--objects",
        action="extend",
        nargs="+",
        metavar="OBJECT",
        help="names or IDs (default: every object that is not left out)",
    )
    mesh.add_argument(
        "--set", action="append", type=types.named_set, metavar="NAME=ID,ID",
        help="extract one mesh of several objects, by names or IDs; may be repeated",
    )  # fmt: skip
    mesh.add_argument("--scene", action="store_true", help="extract one mesh of the whole scene")
    mesh.add_argument(
        "--faces", type=types.faces, default=20_000, metavar="N",
        help="maximum number of triangles of an object; the whole scene may have five times as many (20000)",
    )  # fmt: skip
    mesh.add_argument(
        "--open", action="store_true", help="leave unobserved parts open, such as undersides, instead of closing them"
    )
    mesh.add_argument(
        "--texture-size", type=int, choices=(256, 512, 1024, 2048, 4096), metavar="PIXELS",
        help="side of the texture, 256 to 4096 (default: by the photos' resolution)",
    )  # fmt: skip
    mesh.add_argument("--restart", action="store_true", help="replace existing meshes")


def _add_film(commands: _Commands) -> None:
    film = commands.add(
        "film", "Render film frames through an animated camera", texts.FILM, "garden-splats --shot shot.json --out f"
    )
    options.add_reconstruction(film)
    film.add_argument("--shot", type=Path, required=True, metavar="FILE", help="camera and objects for each frame")
    film.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder for splats.0001.exr ...")
    film.add_argument("--frames", metavar="LIST", help="only these frames of the shot, such as 1-24 or 1,5,9-12")
    film.add_argument("--png", action="store_true", help="also write each frame as PNG, in sRGB with straight alpha")
    options.add_device(film)


def _add_edit(commands: _Commands) -> None:
    edit = commands.add(
        "edit", "Remove, recolor, move or duplicate objects", texts.EDIT,
        "garden-splats --remove mug --recolor can:hue=0.3 --move box:x=0.1",
    )  # fmt: skip
    options.add_reconstruction(edit)
    edit.add_argument("--remove", action="extend", nargs="+", default=[], metavar="OBJECT", help="remove objects")
    edit.add_argument(
        "--floaters", action="store_true", help="with --remove: also remove unlabeled floaters inside the objects"
    )
    edit.add_argument(
        "--fill", action="store_true",
        help="with --remove or --move: fill the holes that the objects leave in flat ground or walls from their "
        "surroundings; the fill is marked as unobserved",
    )  # fmt: skip
    edit.add_argument(
        "--restore", action="extend", nargs="+", default=[], metavar="OBJECT", help="restore removed objects"
    )
    edit.add_argument(
        "--clean-floaters", action="extend", nargs="+", default=[], metavar="OBJECT",
        help="hide the floaters of objects, or of `all`: splats far from the rest, and small groups apart from it",
    )  # fmt: skip
    edit.add_argument(
        "--restore-floaters",
        action="extend",
        nargs="+",
        default=[],
        metavar="OBJECT",
        help="show the floaters of objects, or of `all`",
    )
    edit.add_argument(
        "--recolor", action="extend", nargs="+", default=[], type=types.recolor, metavar="OBJECT:KEY=VALUE",
        help="hue (-0.5 to 0.5, in turns of the color wheel), saturation, value and contrast (factors; 1: unchanged), "
        "tint=#RRGGBB, replace=#RRGGBB and amount (0 to 1, how much of replace)",
    )  # fmt: skip
    edit.add_argument(
        "--move", action="extend", nargs="+", default=[], type=types.placement, metavar="OBJECT:KEY=VALUE",
        help="move relative to the captured position: x, y, z, rx, ry, rz, scale",
    )  # fmt: skip
    edit.add_argument(
        "--duplicate", action="extend", nargs="+", default=[], type=types.placement, metavar="OBJECT:KEY=VALUE",
        help="add a duplicate with this transform, as for --move",
    )  # fmt: skip
    edit.add_argument(
        "--reset",
        action="extend",
        nargs="+",
        default=[],
        metavar="OBJECT",
        help="undo all of these edits of objects, or of `all`",
    )


def _add_export(commands: _Commands) -> None:
    export = commands.add(
        "export", "Export the splats for other programs", texts.EXPORT, "garden-splats --out mug.spz --objects mug"
    )
    options.add_reconstruction(export)
    export.add_argument("--out", type=Path, required=True, metavar="PATH", help="file, or folder with --per-object")
    export.add_argument(
        "--format", choices=("ply", "spz", "splat", "glb", "usdc"),
        help="file format (default: by the file's suffix, else ply)",
    )  # fmt: skip
    export.add_argument(
        "--objects", action="extend", nargs="+", metavar="OBJECT", help="names or IDs (default: everything)"
    )
    export.add_argument("--per-object", action="store_true", help="write one file per object")
    export.add_argument(
        "--coordinates", choices=("capture", "blender"), default="capture",
        help="capture: COLMAP's coordinates, as the photos' cameras have them; blender: Z up (capture)",
    )  # fmt: skip
    export.add_argument(
        "--to-world", type=types.matrix, metavar="MATRIX",
        help="for --coordinates blender, the 16 numbers of the world matrix of the reconstruction's empty in Blender, "
        "if it was moved there: 1,0,0,0,0,1, and so on",
    )  # fmt: skip
    export.add_argument(
        "--sh-degree",
        type=int,
        choices=(0, 1, 2, 3),
        help="highest degree of spherical harmonics (default: as trained)",
    )
    export.add_argument(
        "--levels", type=int, choices=(1, 2, 3, 4), default=0,
        help="also write so many coarser versions, each with about a fourth of the splats of the one before: beside "
        "all.ply, all-1.ply has a fourth, all-2.ply a sixteenth, and so on",
    )  # fmt: skip
    export.add_argument(
        "--no-ids", action="store_true",
        help="omit object_id from PLY, for programs that cannot read it, and do not split glTF and USD into objects",
    )  # fmt: skip
    export.add_argument(
        "--bake-background", action="store_true",
        help="add a sphere of splats in the color behind the scene, for programs that draw splats on black",
    )  # fmt: skip


def _add_import_splats(commands: _Commands) -> None:
    import_splats = commands.add(
        "import-splats", "Make a reconstruction from splats of another program", texts.IMPORT_SPLATS,
        "point_cloud.ply --out garden-splats --capture garden",
    )  # fmt: skip
    import_splats.add_argument(
        "splats", type=Path, metavar="SPLATS",
        help="file in the format of 3D Gaussian splatting (.ply), or .spz, .splat, .glb or .usd",
    )  # fmt: skip
    options.add_output(import_splats)
    import_splats.add_argument("--capture", type=Path, metavar="CAPTURE", help=options.CAPTURE)
    options.add_max_size(import_splats)
    options.add_memory(import_splats)


def _add_measuring_commands(commands: _Commands) -> None:
    commands.add_for_result(
        "evaluate", "Measure the splats and meshes on held-out views", texts.EVALUATE, "garden-splats"
    )
    commands.add_for_result("report", "Write a report with images and plots", texts.REPORT, "garden-splats")
    doctor = commands.add("doctor", "Check that everything works on this computer", texts.DOCTOR, "")
    options.add_device(doctor)
