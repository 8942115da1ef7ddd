"""Splats that are hidden in photos and reach beyond the masks of their object."""

from __future__ import annotations

import numpy as np
import torch

from backend.commands import exported
from backend.export import read_splats
from backend.model.generate import Generated
from backend.pointing.silhouettes import outside_silhouettes
from backend.raster import Camera
from backend.shared.errors import EXIT_DONE

SIZE = 80


def sheet(center: tuple[float, float, float], half: float, object_id: int) -> tuple[np.ndarray, np.ndarray]:
    """Means of opaque splats on a square facing the camera, 0.05 apart, and their object."""
    x, y = np.meshgrid(*[np.arange(-half, half + 1e-6, 0.05)] * 2)
    means = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1) + center
    return means, np.full(len(means), object_id)


def generated(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Generated, np.ndarray]:
    means, ids = (np.concatenate(each) for each in zip(*parts, strict=True))
    n = len(means)
    splats = Generated(
        torch.tensor(means, dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 0.04), torch.full((n,), 0.95), torch.zeros(n, 1, 3),
        torch.tensor(ids, dtype=torch.int32), torch.arange(n),
    )  # fmt: skip
    return splats, ids


def camera(x: float = 0.0) -> Camera:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, np.array([[80.0, 0, 40], [0, 80, 40], [0, 0, 1]]), SIZE, SIZE)


def square(left: float, right: float) -> np.ndarray:
    """Mask of object 1 over a range of x and the whole height from -0.25 to 0.25, both as fractions of the depth."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5 - 40) / 80
    return ((x >= left) & (x <= right) & (np.abs(y) <= 0.26)).astype(np.int64)


def test_splats_hidden_beyond_their_object_are_found() -> None:
    """Some lie behind the wall beside the object, some behind the object, and one object has no mask beside it."""
    front, hidden, behind = sheet((0, 0, 2), 0.5, 1), sheet((2.2, 0, 5), 0.3, 1), sheet((0, 0, 5), 0.3, 1)
    splats, ids = generated([front, sheet((0, 0, 4), 2.5, 0), hidden, behind])
    calls: list[int] = []
    views = [(camera(x), square(-0.26 - x / 2, 0.26 - x / 2)) for x in (0.0, 0.05, -0.05)]
    outside = outside_silhouettes(splats, ids, "3d", views, calls.append)
    expected = np.zeros(len(ids), bool)
    expected[len(ids) - len(behind[0]) - len(hidden[0]) : len(ids) - len(behind[0])] = True
    assert calls == [1, 2, 3]
    # Splats at the edge of the object lie half on the background.
    edge = np.abs(splats.means[:, :2].numpy()).max(1) > 0.42
    assert (outside == expected)[~edge | (ids == 0) | expected].all()


def test_parts_behind_unlabeled_things_stay_with_their_object() -> None:
    """The right half of an object is seen in two of five photos; in the others, something without ID is before it."""
    front = sheet((0, 0, 2), 0.5, 1)
    splats, ids = generated([front])
    whole, left = square(-0.26, 0.26), square(-0.26, 0.0)
    covered, covered_ids = generated([front, sheet((0.3, 0, 1), 0.28, 0)])
    views = [(camera(), whole)] * 2 + [(camera(), left)] * 3
    inner = np.abs(front[0][:, :2]).max(1) < 0.42
    assert not outside_silhouettes(splats, ids, "3d", views, lambda _: None)[inner].any()
    # Without a photo that shows it, nothing tells that the half behind the thing exists.
    hidden = outside_silhouettes(covered, covered_ids, "3d", [(camera(), left)], lambda _: None)[: len(front[0])]
    assert hidden[inner & (front[0][:, 0] > 0.1)].all() and not hidden[inner & (front[0][:, 0] < -0.1)].any()


def test_a_training_releases_them_from_their_object(write_capture, tmp_path, run_command, monkeypatch) -> None:
    """They keep their place and color in splats.ply, and get no object; a later export finds them anew."""
    scene, out = write_capture(views=8), tmp_path / "out"
    given: list[np.ndarray] = []

    def first_five(_splats: Generated, ids: np.ndarray, *_: object) -> np.ndarray:
        given.append(ids)
        return (ids > 0) & (np.cumsum(ids > 0) <= 5) & (len(given) > 1)

    monkeypatch.setattr(exported, "outside_silhouettes", first_five)
    command = ("train", scene.folder, "--out", out, "--steps", 12, "--keep", "rest", "--json")
    results = [run_command(*command)]
    before = read_splats(out / "splats.ply")[0]
    results.append(run_command(*command))
    after = read_splats(out / "splats.ply")[0]
    assert [result.code for result in results] == [EXIT_DONE] * 2 and len(given) == 2
    assert any("5 splats" in message for message in results[1].messages("status"))
    changed = before.object_ids != after.object_ids
    assert changed.sum() == 5 and (after.object_ids[changed] == 0).all()
    assert np.array_equal(before.means, after.means) and np.array_equal(before.sh, after.sh)
