"""Valid inputs that cases damage: a capture and a reconstruction of it with everything that commands write."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.shared.errors import EXIT_DONE
from backend.shared.reconstruction.shot import Frame, Sample, Shot, write_shot
from tests.backend.conftest import write_scene

from .running import Runner

SHORT_TRAINING = ("--steps", 3, "--offsets", 3, "--sh-degree", 1)


@dataclass(frozen=True)
class Templates:
    """Folders that cases copy; they are not changed.

    Attributes:
        captures: captures with a model in binary and in text, the latter with a distorting lens and no masks.
        trained: a reconstruction of the first capture, with meshes, edits, a fill, an evaluation, a report and renders.
        shot: a shot file for it.
        splats: splats for `import-splats`.
    """

    captures: tuple[Path, Path]
    trained: Path
    shot: Path
    splats: Path


def make_templates(folder: Path, runner: Runner) -> Templates:
    """Write the templates to `folder`."""
    captures = folder / "capture", folder / "distorted"
    scene = write_scene(captures[0], views=9, size=(48, 36), points=40)
    lens = [48, 48, 24, 18, 0.05, -0.02, 0.001, 0.001]
    write_scene(captures[1], views=5, size=(48, 36), points=30, suffix=".txt", model="OPENCV", params=lens, masks=False)
    trained, shot = folder / "trained", folder / "shot.json"
    for command in (
        ["train", captures[0], "--out", trained, "--steps", 12, "--offsets", 3, "--memory-mb", 100],
        ["mesh", trained, "--objects", 1, 2, "--faces", 200, "--texture-size", 256],
        ["edit", trained, "--remove", 5, "--fill", "--recolor", "1:hue=0.2", "--duplicate", "2:x=0.3"],
        ["evaluate", trained],
        ["report", trained],
        ["render", trained, "--ids"],
    ):
        outcome = runner.run(command, folder, 300)
        assert outcome.code == EXIT_DONE, f"{command}: {outcome.err}"
    K = np.array([[48.0, 0, 24], [0, 48, 18], [0, 0, 1]])
    samples = [Sample(float(i), scene.viewmats[i], K, (0.1, 100.0)) for i in (1, 2)]
    frames = [Frame(i + 1, (i + 0.5, i + 1.5), [sample]) for i, sample in enumerate(samples)]
    write_shot(shot, Shot(48, 36, frames))
    splats = folder / "splats.ply"
    shutil.copyfile(trained / "splats.ply", splats)
    return Templates(captures, trained, shot, splats)
