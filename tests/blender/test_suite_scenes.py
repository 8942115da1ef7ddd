# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes of the benchmark suite: their truth, and photos as cameras develop them."""

import json

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.backend.shared.events import Reporter, StagedReporter
from objectgs.objectgs_addon.demo import capture

from benchmarks import suite_scenes
from benchmarks.suite import DEVELOP, SYNTHETIC


def written(folder, stage, count: int = 5):
    """Write a small capture of a stage's first views, and return the images and IDs by view."""
    reporter = StagedReporter(Reporter())
    capture.begin(reporter, count)
    settings = capture.Settings(width=48, height=36, samples=1)
    stage.built.view_layers[0].update()
    step = max(1, len(stage.views) // count)
    capture.write(
        folder, stage.built, stage.objects, stage.views[::step][:count], settings, reporter,
        develop=stage.develop, prepare=stage.prepare, target=stage.target,
    )  # fmt: skip
    return json.loads((folder / "labels.json").read_text())


def test_sky_has_no_object_and_no_points(tmp_path, fresh):
    """The light of the world is not taken for an ID."""
    labels = written(tmp_path, suite_scenes.yard(101))
    assert len(labels) == 8
    ids, depths = [], []
    for path in sorted((tmp_path / "truth" / "masks").iterdir()):
        image = bpy.data.images.load(str(path))
        image.colorspace_settings.name = "Non-Color"
        depths.append(np.load(tmp_path / "truth" / "depth" / f"{path.stem}.npy"))
        pixels = np.array(image.pixels[:]).reshape(image.size[1], image.size[0], image.channels)[::-1, :, 0]
        ids.append(np.round(pixels * 65535).astype(int))
    ids, depths = np.array(ids), np.array(depths)
    assert ((ids == 0) == (depths == 0)).all(), "exactly the sky has no depth"
    assert (ids[:, 0] == 0).mean() > 0.5 and (ids[:, -1] == 0).sum() == 0
    assert (np.load(tmp_path / "truth" / "points.npz")["object_id"] > 0).all()


@pytest.mark.long
def test_every_scene_is_built_and_described(fresh):
    assert list(suite_scenes.SCENES) == list(SYNTHETIC)
    assert {name for name in DEVELOP if name in SYNTHETIC} < set(SYNTHETIC)
    for number, (name, make) in enumerate(suite_scenes.SCENES.items()):
        if name == "many":
            continue  # Placing 60 objects takes long.
        stage = make(100 + number)
        assert [obj.id for obj in stage.objects] == list(range(1, len(stage.objects) + 1)), name
        assert len({view.name for view in stage.views}) == len(stage.views) >= 12, name
        for view in stage.views:
            assert np.allclose(view.rotation @ view.rotation.T, np.eye(3)) and np.linalg.det(view.rotation) > 0


def test_photos_are_developed_as_described(fresh):
    gray = np.full((24, 32, 3), 120, np.uint8)
    exposed = suite_scenes.exposure(107)
    means = np.array([exposed.develop(gray, i).mean((0, 1)) for i in range(len(exposed.views))])
    assert means.mean(1).std() > 10 and (means / means.mean(1, keepdims=True)).std(0).max() > 0.01
    assert [view.name for view in exposed.views] != sorted(view.name for view in exposed.views)
    edge = np.where(np.arange(32) < 16, 40, 200)[None, :, None].repeat(24, 0).repeat(3, 2).astype(np.uint8)
    shaken = suite_scenes.blur(108)
    steepest = [np.abs(np.diff(shaken.develop(edge, i).astype(int).mean((0, 2)))).max() for i in range(20)]
    assert min(steepest) < 80 < 120 < max(steepest), "some photos are sharp"


def test_finished_captures_are_kept(tmp_path, fresh):
    """A finished capture of this version is not made again."""
    folder = tmp_path / "few"
    (folder / "truth").mkdir(parents=True)
    record = {"suite": suite_scenes.VERSION, "scene": "few", "samples": 1}
    (folder / "truth" / "settings.json").write_text(json.dumps(record))
    assert suite_scenes.make("few", tmp_path, 1) == folder and not (folder / "images").exists()
