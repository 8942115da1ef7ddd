"""Scenes of the paper's datasets: converted, trained, measured by their protocol, and compared with the paper.

    python benchmarks/reproduce.py DATASET SCENE [SCENE ...] --out DIR [--steps N | --minutes M] [--json]

SCENE is the folder of a scene; docs/reproduce.md says where it comes from and which files it has. In DIR, each scene
has a folder of its name with its capture, its reconstruction, and its figures in figures.json. The same command
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
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError
from backend.shared.formats.anchors_ply import read_anchor_table
from backend.shared.formats.json_file import plain, read_json, write_json
from backend.shared.formats.splat_ply import ids_of, read_splat_table, unobserved_of
from backend.shared.reconstruction.folder import Reconstruction
from benchmarks import shared
from benchmarks.protocols import lerf_mask, replica, scannetpp, three_d_ovs
from benchmarks.protocols.captures import read_pixels
from benchmarks.protocols.metrics import Results, mean

DATASETS = {"lerf-mask": lerf_mask, "3d-ovs": three_d_ovs, "replica": replica, "scannetpp": scannetpp}

PAPER_STEPS = 30_000


def converted(dataset: str, scene: Path, out: Path, every: int | None = None) -> Path:
    """Return the capture of a scene in OUT/capture; it is converted unless it is there.

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


class CommandFailed(Exception):
    """A command of the program failed, and has said why; code is its exit code."""

    def __init__(self, code: int) -> None:
        self.code = code


def run(*words: object) -> None:
    """Run a command of the program, with its messages on the error output; raise CommandFailed if it fails."""
    command = [sys.executable, "-m", "backend", *map(str, words)]
    code = subprocess.run(command, cwd=ROOT, stdout=2, check=False).returncode
    if code:
        raise CommandFailed(code)


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


def table(dataset: str, theirs: Mapping[str, float], figures: Mapping[str, Any]) -> list[str]:
    """Return the lines of a table of figures beside the paper's.

    Args:
        dataset: Key of `DATASETS`.
        theirs: The paper's figures.
        figures: As from the dataset's `measure`.
    """
    labels = DATASETS[dataset].FIGURES

    def form(key: str, value: float | None) -> str:
        return "" if value is None else labels[key][1].format(value)

    rows = [[label, form(key, theirs.get(key)), form(key, figures[key])] for key, (label, _) in labels.items()]
    return shared.table(["", "paper", "ours"], rows)


def text(found: Mapping[str, Any]) -> str:
    """Return the result of a scene, as from `reproduce`, with the figures beside the paper's."""
    training, figures = found["training"], found["figures"]
    length = f"{training['steps']:,} steps in {training['seconds'] / 60:.1f} minutes; the paper trains {PAPER_STEPS:,}"
    lines = [
        f"{found['dataset']}, {found['scene']}: {length}.", "",
        *table(found["dataset"], found["paper"], figures), "",
    ]  # fmt: skip
    if prompts := figures.get("prompts"):
        rows = [
            [
                row["prompt"], "none" if row["id"] is None else str(row["id"]), str(row["views"]),
                f"{100 * row['iou']:.1f}", f"{100 * row['biou']:.1f}",
            ]
            for row in prompts
        ]  # fmt: skip
        lines += [*shared.table(["prompt", "object ID", "views", "IoU (%)", "BIoU (%)"], rows), ""]
    return "\n".join(lines)


def means(dataset: str, found: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Return the mean of each figure over the scenes that have it."""
    return {
        key: mean(result["figures"][key] for result in found if result["figures"][key] is not None)
        for key in DATASETS[dataset].FIGURES
    }


def reproduce(dataset: str, scene: Path, out: Path, length: Sequence[object], every: int | None) -> dict[str, Any]:
    """Convert, train and measure a scene.

    Args:
        dataset: Key of `DATASETS`.
        scene: Folder of the scene.
        out: Folder for its capture, reconstruction and figures.
        length: Options of `train` for the length of the training.
        every: For Replica, one of this many frames is a view.

    Returns:
        dataset, scene (its name), training (steps and seconds), figures, as from `measure`, and the paper's figures.

    Raises:
        InputError: The scene or the output folder cannot be used.
        CommandFailed: A command of the program failed.
    """
    module = DATASETS[dataset]
    capture = converted(dataset, scene, out, every)
    folder = out / "reconstruction"
    run("train", capture, "--out", folder, *length, *module.TRAINING)
    name, *arguments = module.AFTER_TRAINING
    run(name, folder, *arguments)
    figures = module.measure(scene, capture, read_results(folder))
    progress = load_checkpoint(Reconstruction(folder).checkpoint)[1]["progress"]
    found = plain({
        "dataset": dataset, "scene": scene.name,
        "training": {"steps": progress["step"], "seconds": progress["seconds"]},
        "figures": figures, "paper": module.paper(scene.name),
    })  # fmt: skip
    write_json(out / "figures.json", found)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the arguments, reproduce the scenes and print their figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("dataset", choices=DATASETS)
    parser.add_argument("scene", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--steps", type=int, default=PAPER_STEPS, help=f"training steps ({PAPER_STEPS:,}, as in the paper)"
    )
    length.add_argument("--minutes", type=float, help="training time of a scene instead of steps")
    parser.add_argument("--every", type=int, help=f"replica: one of this many frames is a view ({replica.EVERY})")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    options = parser.parse_args(arguments)
    if options.every is not None and (options.dataset != "replica" or options.every < 1):
        parser.error("--every is a number of frames, of replica alone")
    words = ("--steps", options.steps) if options.minutes is None else ("--minutes", options.minutes)
    found = []
    try:
        for scene in (path.resolve() for path in options.scene):
            out = options.out.resolve() / scene.name
            found.append(reproduce(options.dataset, scene, out, words, options.every))
            if not options.json:
                print(text(found[-1]), flush=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
    except CommandFailed as error:
        return error.code
    module, mean_of_all = DATASETS[options.dataset], means(options.dataset, found)
    if options.json:
        print(json.dumps({"scenes": found, "mean": mean_of_all}))
        return EXIT_DONE
    if len(found) > 1:
        rows = table(options.dataset, module.paper("mean"), mean_of_all)
        print("\n".join([f"Mean of {len(found)} scenes:", "", *rows, ""]))
    print("\n".join(module.NOTES))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
