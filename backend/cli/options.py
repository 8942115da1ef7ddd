"""Options that several commands share, and the option groups of `train`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..shared.defaults import MAX_SIZE
from ..shared.expectation import PRESET_STEPS
from ..shared.reconstruction.plan import EVERYTHING, KEYS
from . import types

CAPTURE = "folder with images/, cameras (sparse/0/ or another program's file) and masks/"
"""Help of an argument that is a capture."""


def add_memory(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--memory-mb", type=types.count, default=2000, metavar="MB",
        help="memory for decoded images; more memory makes training faster (2000)",
    )  # fmt: skip


def add_device(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto",
        help="cpu, or cuda for an NVIDIA GPU; auto uses cuda if it works, and `doctor` explains why it does not (auto)",
    )  # fmt: skip


def add_max_size(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--max-size", type=types.count, default=MAX_SIZE, metavar="PIXELS",
        help=f"reduce larger images to this length of the longer side ({MAX_SIZE})",
    )  # fmt: skip


def add_capture(command: argparse.ArgumentParser) -> None:
    command.add_argument("capture", type=Path, metavar="CAPTURE", help=CAPTURE)
    add_max_size(command)


def add_reconstruction(command: argparse.ArgumentParser) -> None:
    command.add_argument("folder", type=Path, metavar="DIR", help="reconstruction folder, as given to train --out")


def add_preparation(command: argparse.ArgumentParser, out_required: bool = True) -> None:
    add_capture(command)
    add_memory(command)
    add_output(command, out_required)


def add_output(command: argparse.ArgumentParser, required: bool = True) -> None:
    command.add_argument(
        "--out", type=Path, required=required, metavar="DIR",
        help="reconstruction folder; created if it does not exist",
    )  # fmt: skip
    command.add_argument(
        "--overwrite", action="store_true",
        help="use DIR even if it contains other files; files that have the names of a reconstruction's are replaced",
    )  # fmt: skip


def add_vote(command: argparse.ArgumentParser, out_required: bool = True) -> None:
    add_preparation(command, out_required)
    command.add_argument(
        "--strategy", choices=("majority", "probability", "correspondence"), default="majority",
        help="how a point gets its object: majority, the object that most masks show at the point; probability, drawn "
        "in proportion to the masks' votes; correspondence, the majority among images in which COLMAP observed the "
        "point (majority)",
    )  # fmt: skip
    command.add_argument(
        "--seed", type=types.index, default=0, metavar="N", help="random seed; the same seed gives the same result (0)"
    )
    command.add_argument(
        "--only", action="extend", nargs="+", metavar="OBJECT",
        help="reconstruct only these objects, by name or ID; all others count as unlabeled",
    )  # fmt: skip
    command.add_argument(
        "--groups", type=Path, metavar="FILE",
        help='merge IDs into one object: a labels file that gives them the same name, {"1": "chair", "2": "chair"}',
    )  # fmt: skip


def add_length(command: argparse.ArgumentParser) -> None:
    length = command.add_mutually_exclusive_group()
    length.add_argument(
        "--minutes", type=types.amount, metavar="M",
        help="total training time in minutes (5); with --preset final, the upper limit",
    )  # fmt: skip
    length.add_argument("--steps", type=types.count, metavar="N", help="total number of training steps")
    command.add_argument(
        "--preset", choices=("preview", "standard", "final"),
        help=f"length by name: preview, {PRESET_STEPS['preview']} steps, to check the scene; standard, "
        f"{PRESET_STEPS['standard']} steps; final, until it converges on validation views",
    )  # fmt: skip
    command.add_argument("--restart", action="store_true", help="discard an earlier training in DIR")
    add_checkpoint_seconds(command)


def add_checkpoint_seconds(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--checkpoint-seconds", type=types.amount, default=30.0, metavar="S",
        help="least time between checkpoints in seconds; more if they take long to write (30)",
    )  # fmt: skip


def add_splats(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("splats; the defaults suit most captures")
    group.add_argument(
        "--mode", choices=("explicit", "view", "paper"), default="explicit",
        help="explicit: splats.ply is exactly the model; view: splats depend on the camera, and splats.ply is an "
        "approximation; paper: as view, but heads alone determine the splats, as in the paper (explicit)",
    )  # fmt: skip
    group.add_argument(
        "--primitive", choices=("3d", "2d"), default="3d",
        help="2d: flat splats that lie on the surfaces; splats.ply stores them as thin Gaussians (3d)",
    )  # fmt: skip
    group.add_argument(
        "--sh-degree", type=int, choices=(0, 1, 2, 3), default=1,
        help="degree of the spherical harmonics for view-dependent color in explicit mode; 0: none (1)",
    )  # fmt: skip
    group.add_argument(
        "--background", choices=("learned", "black", "white"), default="learned",
        help="color behind all splats (learned)",
    )  # fmt: skip
    group.add_argument(
        "--voxel", type=types.amount, metavar="SIZE", help="size of the finest detail, in the capture's units (auto)"
    )
    group.add_argument("--offsets", type=types.count, metavar="N", help="number of splats of each anchor (10)")
    group.add_argument("--max-anchors", type=types.count, metavar="N", help="maximum number of anchors (200000)")
    group.add_argument(
        "--semantic-weight", type=types.weight, metavar="W", help="weight of the label loss; 0.01 for poor masks (0.1)"
    )
    group.add_argument(
        "--normal-weight", type=types.weight, metavar="W", help="weight of smooth surfaces, for flat splats (0.05)"
    )
    group.add_argument(
        "--distortion-weight", type=types.weight, metavar="W",
        help="weight of concentrating flat splats at one depth (10)",
    )  # fmt: skip
    group.add_argument("--unlabeled-is-object", action="store_true", help="treat ID 0 as an object, not as unlabeled")


def add_plan_overrides(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("overriding the plan; `plan` shows its decisions and their reasons")
    group.add_argument(
        "--keep", action="extend", nargs="+", default=[], choices=(*KEYS, EVERYTHING), metavar="KEY",
        help=f"do what the plan omits: {', '.join(KEYS)}, or {EVERYTHING}",
    )  # fmt: skip
    group.add_argument(
        "--leave-out",
        action="extend",
        nargs="+",
        default=[],
        choices=KEYS,
        metavar="KEY",
        help="omit what the plan does",
    )
    group.add_argument("--no-meshes", action="store_true", help="plan for splats without meshes")
