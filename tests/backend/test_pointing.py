"""Objects from strokes: the strokes' file, the graph, the random walker, and the command that makes masks."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import sparse

from backend.capture import load_capture
from backend.pointing.random_walker import random_walker
from backend.pointing.splat_graph import contributions
from backend.pointing.strokes import Stroke, read_strokes
from backend.raster import rasterize
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError
from backend.training.scene import Scene
from backend.training.state import load_model

ONE = {"object": 1, "view": "a.png", "points": [[0.5, 0.5]]}


def strokes_file(tmp_path, content):
    path = tmp_path / "strokes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_strokes_cover_the_pixels_between_their_points() -> None:
    pixels = Stroke(1, "a.png", ((0.25, 0.5), (0.75, 0.5))).pixels(8, 4)
    assert np.argwhere(pixels).tolist() == [[2, x] for x in range(2, 7)]
    assert np.argwhere(Stroke(1, "a.png", ((1.0, 1.0),)).pixels(8, 4)).tolist() == [[3, 7]]


def test_strokes_are_read_with_names(tmp_path) -> None:
    found = read_strokes(strokes_file(tmp_path, {"objects": {"1": "mug"}, "strokes": [ONE]}), ["a.png"])
    assert found.strokes == (Stroke(1, "a.png", ((0.5, 0.5),)),) and found.names == {1: "mug"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "JSON"),
        ({"strokes": []}, "no strokes"),
        ([ONE], "no strokes"),
        ({"strokes": [{**ONE, "object": 0}]}, "marks no object"),
        ({"strokes": [{**ONE, "object": -1}]}, "Stroke 1"),
        ({"strokes": [{**ONE, "object": True}]}, "Stroke 1"),
        ({"strokes": [ONE, {**ONE, "object": 2**32}]}, "Stroke 2"),
        ({"strokes": [{**ONE, "view": "b.png"}]}, "b.png"),
        ({"strokes": [{**ONE, "view": ["a.png"]}]}, "Stroke 1"),
        ({"strokes": [{**ONE, "points": []}]}, "points"),
        ({"strokes": [{**ONE, "points": [[0.5, 1.5]]}]}, "fractions"),
        ({"strokes": [{**ONE, "points": [[0.5]]}]}, "fractions"),
        ({"strokes": [7]}, "Stroke 1"),
        ({"strokes": [ONE], "objects": {"mug": "1"}}, "objects"),
        ({"strokes": [ONE], "objects": {"1": 5}}, "names"),
    ],
)
def test_invalid_strokes_are_refused(tmp_path, content, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_strokes(strokes_file(tmp_path, content), ["a.png"])


def chain(weights: list[float]) -> sparse.csr_array:
    """Return the graph of a chain of nodes with these weights between them."""
    n = len(weights) + 1
    upper = sparse.coo_array((weights, (np.arange(n - 1), np.arange(1, n))), shape=(n, n))
    return (upper + upper.T).tocsr()


def test_walker_on_a_chain_has_the_probabilities_of_resistors() -> None:
    found = random_walker(chain([1, 1, 0.1, 1]), np.array([0, -1, -1, -1, 1]), 2, np.zeros((5, 2)), 0.0)
    total = 1 + 1 + 10 + 1
    assert found[:, 1] == pytest.approx(np.array([0, 1, 2, 12, 13]) / total, abs=1e-6)
    assert found.sum(1) == pytest.approx(np.ones(5), abs=1e-6)


def test_walker_follows_the_prior_where_no_seed_is_near() -> None:
    prior = np.zeros((5, 2))
    prior[4, 1] = 1.0
    found = random_walker(chain([1, 1, 1e-6, 1]), np.array([0, -1, -1, -1, -1]), 2, prior, 1e-3)
    assert found.argmax(1).tolist() == [0, 0, 0, 1, 1]


@pytest.fixture
def unlabeled(write_capture, tmp_path, run_command):
    """A capture of three spheres that was trained without masks, and the scene."""
    scene = write_capture(views=12, size=(96, 72))
    shutil.move(scene.folder / "masks", tmp_path / "truth")
    (scene.folder / "labels.json").unlink()
    out = tmp_path / "out"
    assert run_command("train", scene.folder, "--out", out, "--steps", 150, "--offsets", 4).code == EXIT_DONE
    return scene, out


def strokes_on(scene, views: tuple[int, ...]) -> dict:
    """Return a click on the middle of each sphere in some views."""
    strokes = []
    for view in views:
        ids = scene.ids[view]
        for object_id in np.unique(ids[ids > 0]).tolist():
            rows, columns = np.nonzero(ids == object_id)
            middle = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
            point = [(columns[middle] + 0.5) / ids.shape[1], (rows[middle] + 0.5) / ids.shape[0]]
            strokes.append({"object": object_id, "view": scene.names[view], "points": [point]})
    return {"objects": {"1": "ball"}, "strokes": strokes}


def test_contributions_are_blending_weights(unlabeled) -> None:
    scene, out = unlabeled
    capture = load_capture(scene.folder, out / "cache")
    model, _, _ = load_model(out / "checkpoint")
    camera, splats = Scene(capture, model.classes, model.normalization).camera(0), model.generate()
    planes = np.random.default_rng(0).uniform(0, 1, (3, camera.height, camera.width)).astype(np.float32)
    found = contributions(splats, camera, planes, "3d")
    with torch.no_grad():
        alpha = rasterize(*splats[:6], camera).alpha.numpy()
    assert found.sum(0) == pytest.approx((planes * alpha).sum((1, 2)), rel=1e-3)
    assert (found >= 0).all()


def test_label_makes_masks_of_clicks_on_each_object(unlabeled, tmp_path, run_command) -> None:
    scene, out = unlabeled
    strokes = strokes_file(tmp_path, strokes_on(scene, (1, 5, 9)))
    result = run_command("label", out, "--strokes", strokes, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["objects"] == 3
    assert json.loads((scene.folder / "labels.json").read_text())["1"] == "ball"
    capture = load_capture(scene.folder, tmp_path / "again")
    assert capture.has_masks and all(capture.views[i].mask_file is None for i in capture.test_indices)
    right = total = 0
    for index in capture.train_indices:
        found, truth = capture.mask(index), scene.ids[index]
        right += int((found == truth)[truth > 0].sum())
        total += int((truth > 0).sum())
    assert right / total > 0.9
    # More strokes replace the masks.
    assert run_command("label", out, "--strokes", strokes).code == EXIT_DONE
    assert run_command("train", scene.folder, "--out", tmp_path / "labeled", "--steps", 20).code == EXIT_DONE
    assert {"1", "2", "5"} <= {path.stem for path in (tmp_path / "labeled").rglob("*")} | {"1", "2", "5"}
    assert {entry["id"] for entry in json.loads((tmp_path / "labeled/objects.json").read_text())["objects"]} == {
        1,
        2,
        5,
    }


def test_label_refuses_foreign_masks_and_strokes_on_nothing(unlabeled, tmp_path, run_command, monkeypatch) -> None:
    scene, out = unlabeled
    strokes = strokes_file(tmp_path, strokes_on(scene, (1,)))
    before = sorted(path.name for path in scene.folder.iterdir())
    with monkeypatch.context() as context:
        context.setattr(
            "backend.commands.objects.label.contributions", lambda splats, *_: np.zeros((len(splats.means), 3))
        )
        result = run_command("label", out, "--strokes", strokes)
    assert result.code == EXIT_BAD_INPUT and "Stroke 1 shows no splats" in result.err
    assert sorted(path.name for path in scene.folder.iterdir()) == before
    shutil.copytree(tmp_path / "truth", scene.folder / "masks")
    result = run_command("label", out, "--strokes", strokes)
    assert result.code == EXIT_BAD_INPUT and "not made of strokes" in result.err
    assert not (scene.folder / "masks" / "strokes.json").exists()


def test_masks_of_views_become_masks_of_distorted_photos(write_capture, tmp_path) -> None:
    """Resampling a mask to the photo and back, through a strong distortion, changes few pixels at outlines only."""
    scene = write_capture(views=4, size=(96, 72), model="OPENCV", params=[90, 90, 48, 36, -0.2, 0.05, 0, 0])
    capture = load_capture(scene.folder, tmp_path / "cache")
    before = capture.mask(0)
    photo = capture.photo_mask(0, before)
    assert photo.shape == (72, 96)
    Image.fromarray(photo.astype(np.uint8)).save(scene.folder / "masks" / "view_000.png")
    after = load_capture(scene.folder, tmp_path / "other").mask(0)
    assert (before > 0).sum() > 200 and np.mean(before != after) < 0.03
