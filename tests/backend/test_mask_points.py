"""Points of objects on which the capture has none, placed where the masks agree."""

import json

import numpy as np
import pytest

from backend.capture import load_capture
from backend.labels.corrections import IGNORED
from backend.labels.mask_points import place_points
from backend.shared.errors import EXIT_DONE
from backend.shared.events import Reporter

from .conftest import SPHERES

MISSING = 5


@pytest.fixture
def capture_without_points(write_capture):
    """The three spheres, the third without points."""
    scene = write_capture(views=24, size=(96, 72))
    keep = scene.point_objects != MISSING
    kept = np.cumsum(keep) - 1
    scene.xyz, scene.rgb, scene.point_objects = scene.xyz[keep], scene.rgb[keep], scene.point_objects[keep]
    for i, seen in enumerate(scene.seen):
        mine = keep[seen]
        scene.seen[i], scene.pixels[i] = kept[seen[mine]], scene.pixels[i][mine]
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    return scene


def test_points_lie_on_the_object(capture_without_points, tmp_path):
    capture = load_capture(capture_without_points.folder, tmp_path / "cache")
    placed = place_points(capture, [MISSING])
    assert 100 < len(placed.ids) <= 400 and set(placed.ids.tolist()) == {MISSING}
    _, center, radius = next(sphere for sphere in SPHERES if sphere[0] == MISSING)
    distance = np.linalg.norm(placed.xyz - center, axis=1)
    # The visual hull of a few views is somewhat larger than the sphere.
    assert 0.7 * radius < np.median(distance) < 1.3 * radius and (distance < 2 * radius).mean() > 0.95
    again = place_points(capture, [MISSING])
    assert all(np.array_equal(one, other) for one, other in zip(placed, again, strict=True))


def test_pixels_of_no_known_object_do_not_disagree(capture_without_points, tmp_path):
    """The corrected masks of every third view ignore what shows the object, and all that surrounds it."""
    capture = load_capture(capture_without_points.folder, tmp_path / "cache")
    ignored = frozenset(capture.train_indices[::3])
    corrected = capture.with_corrected_masks(
        ignored, lambda _, mask: np.where(np.isin(mask, [0, MISSING]), IGNORED, mask)
    )
    placed = place_points(corrected, [MISSING])
    _, center, radius = next(sphere for sphere in SPHERES if sphere[0] == MISSING)
    assert len(placed.ids) > 100 and np.median(np.linalg.norm(placed.xyz - center, axis=1)) < 1.3 * radius


def test_points_are_placed_with_progress_and_each_mask_is_read_once(capture_without_points, tmp_path, monkeypatch):
    capture = load_capture(capture_without_points.folder, tmp_path / "cache")
    others = [int(each) for each in capture.object_ids if each != MISSING]
    alone = place_points(capture, [MISSING])
    read, told, mask = [], [], capture.mask
    monkeypatch.setattr(capture, "mask", lambda index: read.append(index) or mask(index))
    reporter = Reporter()
    monkeypatch.setattr(reporter, "progress", lambda done, total, **_: told.append((done, total)))
    placed = place_points(capture, [*others, MISSING], reporter=reporter)
    assert len(read) == len(set(read)) <= len(capture.train_indices)
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert np.array_equal(placed.xyz[placed.ids == MISSING], alone.xyz)


def test_object_without_agreement_gets_no_points(capture_without_points, tmp_path):
    capture = load_capture(capture_without_points.folder, tmp_path / "cache")
    assert len(place_points(capture, [77]).ids) == 0


def test_object_without_points_is_learned(capture_without_points, tmp_path, run_command):
    out = tmp_path / "out"
    result = run_command("train", capture_without_points.folder, "--out", out, "--steps", 200, "--json")
    assert result.code == EXIT_DONE
    assert any("points where its masks agree" in message for message in result.messages("status"))
    assert run_command("evaluate", out).code == EXIT_DONE
    scores = {row["id"]: row["iou"] for row in json.loads((out / "evaluation.json").read_text())["objects"]}
    # Without its points, the object has an IoU of 0.
    assert scores[MISSING] > 0.6 and min(scores.values()) > 0.6
