"""The loss of splats that are hidden in photos and reach beyond the masks of their object."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from backend.model.draw import objects_alone
from backend.model.object_model import anchors_in_view
from backend.raster import Camera, rasterize
from backend.training.losses.on_cpu import PROBABILITY_FLOOR
from backend.training.losses.silhouettes import silhouette_loss
from backend.training.settings import Settings
from backend.training.step import frustum
from backend.training.trainer import Trainer


def sheet(x: float, depth: float, half: float) -> torch.Tensor:
    """Means of opaque splats on a square facing the camera, 0.05 apart."""
    columns, rows = np.meshgrid(*[np.arange(-half, half + 1e-6, 0.05)] * 2)
    return torch.tensor(np.stack([columns.ravel() + x, rows.ravel(), np.full(rows.size, depth)], 1)).float()


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


def test_loss_fades_splats_beyond_their_object_only() -> None:
    """Something else may hide them in a picture of the whole scene, in which they have no gradient then."""
    parts = sheet(0, 2, 0.5), sheet(2.2, 5, 0.3), sheet(0, 5, 0.3)
    means = torch.cat(parts)
    count = len(means)
    opacities = torch.full((count,), 0.95, requires_grad=True)
    camera = Camera(np.eye(4), np.array([[80.0, 0, 40], [0, 80, 40], [0, 0, 1]]), 80, 80)
    labels = torch.zeros((80, 80), dtype=torch.int32)
    labels[20:60, 20:60] = 1
    alone = rasterize(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 3), 0.04), opacities,
        torch.zeros(count, 1, 3), torch.ones(count, dtype=torch.int32), camera,
    )  # fmt: skip
    silhouette_loss(alone.alpha, labels).backward()
    gradient = opacities.grad
    assert gradient is not None
    front, beyond, behind = gradient.split([len(part) for part in parts])
    assert (beyond > 0).all() and not behind.any()
    inner = parts[0][:, :2].abs().amax(1) < 0.38
    assert front[inner].max() < 0.02 * beyond.median(), "only splats at the edge reach over the background"


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


def test_objects_in_view_are_rendered_alone(tiny) -> None:
    """Objects out of view are left out, so that a view of a large model does not render all of its objects."""
    capture, ids = tiny()
    trainer = Trainer.start(capture, ids, Settings(offsets=2))
    camera, model = trainer.scene.camera(capture.test_indices[0]), trainer.model
    away = int(model.classes.classes_of([2])[0])
    # Behind the camera.
    model.anchors.positions[model.anchors.ids == away] = torch.from_numpy(
        np.linalg.inv(camera.viewmat)[:3] @ [0, 0, -5, 1]
    ).float()
    with torch.no_grad():
        splats = model.generate(anchors_in_view(model.anchors, *frustum(camera)), camera.center)
        expected = {}
        for object_id in set(capture.object_ids.tolist()) - {2}:
            number = int(model.classes.classes_of([object_id])[0])
            expected[object_id] = rasterize(*splats.select(splats.ids == number)[:6], camera).alpha.numpy()
    found = dict(objects_alone(model, camera))
    assert list(found) == sorted(expected) and all(alpha.max() > 0 for alpha in found.values())
    assert all(np.array_equal(found[object_id], alpha) for object_id, alpha in expected.items())
