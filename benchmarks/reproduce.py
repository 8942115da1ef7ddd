"""One scene of the paper's datasets: converted, trained, measured by its protocol, and compared with the paper.

    python benchmarks/reproduce.py DATASET SCENE --out DIR [--steps N | --minutes M] [--json]

SCENE is the folder of a scene; docs/reproduce.md says where it comes from and which files it has. The capture is
written to DIR/capture, the reconstruction to DIR/reconstruction, and the figures to DIR/figures.json. The same command
continues a run that was stopped.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

import numpy as np

from backend.model.checkpoint import load_checkpoint
from backend.shared.errors import EXIT_BAD_INPUT, InputError
from backend.shared.formats.anchors_ply import read_anchor_table
from backend.shared.formats.json_file import plain, read_json, write_json
from backend.shared.formats.splat_ply import ids_of, read_splat_table, unobserved_of
from backend.shared.reconstruction.folder import Reconstruction
from benchmarks import shared
from benchmarks.protocols import lerf_mask, replica, scannetpp, three_d_ovs
from benchmarks.protocols.captures import read_pixels
from benchmarks.protocols.metrics import Results

DATASETS = {"lerf-mask": lerf_mask, "3d-ovs": three_d_ovs, "replica": replica, "scannetpp": scannetpp}

PAPER_STEPS = 30_000


def converted(dataset: str, scene: Path, out: Path, every: int | None = None) -> Path:
    """Return the capture of a scene in OUT/capture, converted unless it is there.

    Raises:
        InputError: The scene cannot be used, or OUT has the capture of another scene.
    """
    capture, partial, record = out / "capture", out / "capture.partial", out / "scene.json"
    made_from = {"dataset": dataset, "scene": str(scene.resolve()), "every": every}
    if capture.exists():
        if not record.exists() or read_json(record) != made_from:
            raise InputError(f"{capture} is not the capture of {scene} with these options; choose another --out.")
        return capture
    if not scene.is_dir():
        raise InputError(f"{scene} is not a folder; expected that of a scene of {dataset}.")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    options = {} if every is None else {"every": every}
    DATASETS[dataset].convert(scene, partial, **options)
    write_json(record, made_from)
    partial.rename(capture)
    return capture


def run(*words: object) -> int:
    """Run a command of the program, with its messages on the error output; return its exit code."""
    command = [sys.executable, "-m", "backend", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, stdout=2, check=False).returncode


def read_results(folder: Path) -> Results:
    """Return what the commands left in a reconstruction folder; renders are read on demand."""
    reconstruction = Reconstruction(folder)
    anchors, splats = read_anchor_table(reconstruction.anchors), read_splat_table(reconstruction.splats)
    evaluation = folder / "evaluation.json"

    def ids(view: str) -> np.ndarray:
        path = (reconstruction.renders / view).with_suffix(".ids.png")
        array = path.with_suffix(".npy")
        return np.load(array) if array.exists() else read_pixels(path).astype(np.int64)

    return Results(
        ids,
        read_json(evaluation)["quality"] if evaluation.exists() else {},
        {"anchors": _by_object(anchors), "splats": _by_object(splats[~unobserved_of(splats)])},
    )


def _by_object(table: np.ndarray) -> dict[int, np.ndarray]:
    """Return object ID -> positions (n, 3) of a table of anchors or splats."""
    xyz, ids = np.stack([table[axis] for axis in "xyz"], 1).astype(np.float64), ids_of(table)
    return {int(i): xyz[ids == i] for i in np.unique(ids) if i > 0}


def text(dataset: str, scene: str, figures: Mapping[str, Any], training: Mapping[str, Any]) -> str:
    """Return the figures of a scene as tables, beside the paper's.

    Args:
        dataset: Key of `DATASETS`.
        scene: Name of the scene, as in the paper.
        figures: As from the dataset's `measure`.
        training: steps and seconds of the training.
    """
    module = DATASETS[dataset]
    theirs = module.paper(scene)

    def form(key: str, value: float | None) -> str:
        return "" if value is None else module.FIGURES[key][1].format(value)

    rows = [[label, form(key, theirs.get(key)), form(key, figures[key])] for key, (label, _) in module.FIGURES.items()]
    length = f"{training['steps']:,} steps in {training['seconds'] / 60:.1f} minutes; the paper trains {PAPER_STEPS:,}"
    lines = [f"{dataset}, {scene}: {length}.", "", *shared.table(["", "paper", "ours"], rows), ""]
    if prompts := figures.get("prompts"):
        found = [
            [
                row["prompt"], "none" if row["id"] is None else str(row["id"]), str(row["views"]),
                f"{100 * row['iou']:.1f}", f"{100 * row['biou']:.1f}",
            ]
            for row in prompts
        ]  # fmt: skip
        lines += [*shared.table(["prompt", "object ID", "views", "IoU (%)", "BIoU (%)"], found), ""]
    return "\n".join([*lines, *module.NOTES])


def reproduce(options: argparse.Namespace) -> int:
    """Convert, train, measure and print; return the exit code.

    Raises:
        InputError: The scene or the folder of --out cannot be used.
    """
    module = DATASETS[options.dataset]
    out = options.out.resolve()
    capture = converted(options.dataset, options.scene, out, options.every)
    folder = out / "reconstruction"
    length = ("--steps", options.steps) if options.minutes is None else ("--minutes", options.minutes)
    name, *arguments = module.AFTER_TRAINING
    for words in (("train", capture, "--out", folder, *length, *module.TRAINING), (name, folder, *arguments)):
        if code := run(*words):
            return code
    figures = module.measure(options.scene, capture, read_results(folder))
    progress = load_checkpoint(Reconstruction(folder).checkpoint)[1]["progress"]
    training = {"steps": progress["step"], "seconds": progress["seconds"]}
    scene = options.scene.resolve().name
    written = plain({
        "dataset": options.dataset, "scene": scene, "training": training, "figures": figures,
        "paper": module.paper(scene),
    })  # fmt: skip
    write_json(out / "figures.json", written)
    print(json.dumps(written) if options.json else text(options.dataset, scene, figures, training))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments, and reproduce a scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("dataset", choices=DATASETS)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--steps", type=int, default=PAPER_STEPS, help=f"training steps ({PAPER_STEPS:,}, as in the paper)"
    )
    length.add_argument("--minutes", type=float, help="training time instead of steps")
    parser.add_argument("--every", type=int, help=f"replica: one of this many frames is a view ({replica.EVERY})")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    options = parser.parse_args(arguments)
    if options.every is not None and (options.dataset != "replica" or options.every < 1):
        parser.error("--every is a number of frames, of replica alone")
    try:
        return reproduce(options)
    except InputError as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
