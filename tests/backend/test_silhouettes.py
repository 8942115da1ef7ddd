"""Splats that are hidden in photos and reach beyond the masks of their object: in training, and afterwards."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from backend.commands import exported
from backend.export import read_splats
from backend.model.generate import Generated
from backend.model.object_model import anchors_in_view
from backend.pointing.silhouettes import outside_silhouettes
from backend.raster import Camera, rasterize
from backend.shared.errors import EXIT_DONE
from backend.training.losses.on_cpu import PROBABILITY_FLOOR
from backend.training.losses.silhouettes import silhouette_loss
from backend.training.settings import Settings
from backend.training.step import frustum
from backend.training.trainer import Trainer

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


def test_loss_is_that_of_labels_where_masks_show_the_background() -> None:
    alpha = torch.tensor([[0.5, 1.0, 0.75, 0.0], [1.0, 1.0, 0.25, 0.5]], requires_grad=True)
    labels = torch.tensor([[0, 0, 1, 0], [2, -1, -1, 1]], dtype=torch.int32)
    loss = silhouette_loss(alpha, labels)
    f = PROBABILITY_FLOOR
    expected = -(np.log((0.5 + f) / (1 + f)) + np.log(f / (1 + f))) / 6
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert alpha.grad is not None
    assert torch.equal(alpha.grad != 0, labels == 0) and (alpha.grad >= 0).all()
    assert silhouette_loss(alpha, torch.full_like(labels, -1)).item() == 0.0


def test_loss_fades_hidden_splats_beyond_their_object_alone() -> None:
    """In a picture of all splats, the wall hides them, so nothing else has a gradient there."""
    front, hidden, behind = sheet((0, 0, 2), 0.5, 1), sheet((2.2, 0, 5), 0.3, 1), sheet((0, 0, 5), 0.3, 1)
    splats, _ = generated([front, hidden, behind])
    splats.opacities.requires_grad_()
    labels = torch.from_numpy(square(-0.26, 0.26)).int()
    silhouette_loss(rasterize(*splats[:6], camera()).alpha, labels).backward()
    gradient = splats.opacities.grad
    assert gradient is not None
    within, of_hidden, _ = gradient.split([len(front[0]), len(hidden[0]), len(behind[0])])
    assert (of_hidden > 0).all()
    # Splats at the edge of the object reach over the background.
    inner = np.abs(front[0][:, :2]).max(1) < 0.38
    assert within[inner].max() < 0.02 * of_hidden.median()


def of_step(trainer: Trainer, index: int, alone: bool) -> float:
    gradients = trainer.view_step.compute(index, 0.0, alone=alone)
    assert gradients is not None
    return gradients.loss.item()


def test_a_step_adds_the_loss_of_objects_alone(tiny) -> None:
    capture, ids = tiny()
    settings = Settings(offsets=2)
    trainer = Trainer.start(capture, np.where(ids == 2, 0, ids), settings, supervise_background=True)
    index = capture.train_indices[0]
    camera, model = trainer.scene.camera(index), trainer.model
    with torch.no_grad():
        splats = model.generate(anchors_in_view(model.anchors, *frustum(camera)), camera.center)
        alpha = rasterize(*splats.select(splats.ids > 0)[:6], camera).alpha
        _, labels = trainer.scene.target(index)
        assert labels is not None and (labels == 0).any() and (splats.ids == 0).any()
        expected = 0.1 * settings.semantic_weight * silhouette_loss(alpha, labels).item()
    assert expected > 1e-5
    assert of_step(trainer, index, True) - of_step(trainer, index, False) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "settings",
    [
        {"semantic_weight": 0.0}, {"mode": "paper"}, {"zero_is_object": True}, {"supervise_background": False},
    ],
)  # fmt: skip
def test_a_step_has_no_such_loss_where_nothing_is_known_of_the_background(tiny, settings) -> None:
    capture, ids = tiny()
    supervised = settings.pop("supervise_background", True)
    given = dataclasses.replace(Settings(offsets=2), **settings)
    trainer = Trainer.start(capture, ids, given, supervise_background=supervised)
    index = capture.train_indices[0]
    assert of_step(trainer, index, True) == of_step(trainer, index, False)
