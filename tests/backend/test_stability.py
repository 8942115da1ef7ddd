"""Short trainings on difficult captures; benchmarks/stability.py runs longer ones."""

import numpy as np
import pytest
import torch

from backend.model.anchors import Anchors, Layout, seed_anchors
from backend.model.generate import generate
from backend.model.heads import Heads
from backend.raster import Camera, rasterize
from backend.shared.errors import InputError
from backend.training.settings import Settings
from benchmarks.stability import each_image, each_mask, elsewhere, train
from tests.backend.conftest import SPHERES

SHORT = {
    "settings": Settings(offsets=4), "steps": 40, "views": 9, "size": (64, 48), "points": 40, "scored": False,
}  # fmt: skip
FLAT = {**SHORT, "settings": Settings(offsets=4, primitive="2d")}


@pytest.fixture(scope="module")
def here():
    return train(**SHORT)


@pytest.mark.parametrize(("scale", "offset"), [(1e-4, 0.0), (1e4, 0.0), (1.0, 1e6)])
def test_training_is_independent_of_scale_and_offset(here, scale, offset):
    there = train(elsewhere(scale, offset), **SHORT)
    assert not there.lost and abs(there.psnr - here.psnr) < 0.1
    expected = scale * np.array(here.trainer.model.normalization.center) + offset
    np.testing.assert_allclose(there.trainer.model.normalization.center, expected, rtol=1e-6, atol=1e-6 * scale)


@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("options", [SHORT, FLAT], ids=["3d", "2d"])
def test_images_of_one_color_train_without_faults(options, value):
    found = train(each_image(lambda _, pixels: np.full_like(pixels, value)), **options)
    assert not found.lost and found.psnr > 10


@pytest.mark.parametrize("views", [1, 2])
def test_one_or_two_images_train_without_faults(views):
    found = train(**{**SHORT, "views": views})
    assert not found.lost and found.psnr > 15


@pytest.mark.parametrize("points", [1, 3])
def test_fewer_than_four_points_are_rejected(points):
    with pytest.raises(InputError, match=f"only {points} points, and at least 4"):
        train(**{**SHORT, "points": points, "spheres": SPHERES[:1]})


def test_coincident_points_give_one_anchor():
    found = train(**{**SHORT, "spheres": [(1, (0.0, 0.0, 0.0), 0.0)]})
    assert not found.lost and len(found.trainer.model.anchors) == 1


def test_wrong_masks_are_outvoted():
    rng = np.random.default_rng(0)

    def wrong(view, ids):
        out = ids.copy()
        for i in (1, 2, 5):
            if rng.random() < 0.3:
                out[ids == i] = rng.choice([j for j in (1, 2, 5) if j != i])
        return out

    # With only 9 views, a few that are wrong in the same way would win the vote.
    found = train(each_mask(wrong), **{**SHORT, "views": 18, "steps": 120, "scored": True})
    assert not found.lost and found.given_miou < 0.7 and found.miou > found.given_miou + 0.2


@pytest.mark.parametrize("primitive", ["3d", "2d"])
@pytest.mark.parametrize("mode", ["explicit", "view"])
def test_anchor_at_camera_center_stays_finite(mode, primitive):
    layout = Layout(4, 8)
    rng = np.random.default_rng(0)
    camera_center = np.array([0.3, -0.2, 1.0])
    xyz = np.concatenate([np.zeros((1, 3)), rng.normal(0, 0.3, (20, 3)) + np.array([0, 0, 2])]) + camera_center
    seeded = seed_anchors(xyz, np.full((21, 3), 0.5), np.zeros(21, np.int64), 1e-3, layout, rng)
    positions = seeded.positions.clone()
    positions[(positions - torch.tensor(camera_center).float()).norm(dim=1).argmin()] = torch.tensor(
        camera_center
    ).float()
    anchors = Anchors(layout, 1e-3, positions, seeded.rows.requires_grad_(), seeded.ids)
    heads = Heads(layout, mode, 1, torch.Generator().manual_seed(0))
    viewmat = np.eye(4)
    viewmat[:3, 3] = -camera_center
    camera = Camera(viewmat, np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), 32, 24)
    g = generate(layout, anchors.positions, anchors.rows, anchors.ids, heads, camera_center)
    drawn = rasterize(*g[:6], camera, want_depth=True, primitive=primitive)
    assert drawn.alpha.max() > 0.1
    (drawn.color.sum() + drawn.depth.sum()).backward()
    for tensor in (drawn.color, drawn.depth, anchors.rows.grad, *(p.grad for p in heads.parameters())):
        assert tensor.isfinite().all()
