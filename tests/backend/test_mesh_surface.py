"""From splats to surfaces: what views see of an object, signed distance, and the closed mesh around it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from backend.mesh.views import Views
from backend.model.generate import Generated
from backend.raster import Camera, rasterize


def camera_at(eye, width=64, height=48, focal=60.0):
    """A camera at `eye` that looks at the origin, z up."""
    eye = np.asarray(eye, float)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, width, height)


def sheet(x, class_index, half=0.5, step=0.05, colour=0.5):
    """Opaque splats on the plane at `x`, facing along x."""
    grid = np.arange(-half, half + 1e-6, step)
    y, z = (a.ravel() for a in np.meshgrid(grid, grid))
    n = len(y)
    return Generated(
        torch.tensor(np.stack([np.full(n, x), y, z], 1), dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.tensor([[0.002, step / 2, step / 2]]).repeat(n, 1),
        torch.full((n,), 0.97),
        torch.full((n, 1, 3), colour),
        torch.full((n,), class_index, dtype=torch.int32),
        torch.arange(n),
    )


def views_of(splats, cameras, explicit=True, **options):
    """`Views` of plain splats."""
    ids = splats.ids.numpy()

    def generate(seen=None, eye=None):
        assert explicit or eye is not None
        return splats if seen is None else Generated(*(part[torch.from_numpy(seen)] for part in splats))

    model = SimpleNamespace(generate=generate, explicit=explicit, anchors=SimpleNamespace(ids=ids))
    scene = SimpleNamespace(camera=lambda index, downscale: cameras[index])
    return Views(model, scene, range(len(cameras)), **options)


@pytest.mark.parametrize("explicit", [True, False])
def test_an_object_is_drawn_unhidden_and_knows_how_much_of_it_is_hidden(explicit):
    near, far = sheet(1.0, 1, half=0.3), sheet(0.0, 2)
    splats = Generated(*(torch.cat(parts) for parts in zip(near, far)))
    cameras = [camera_at((4, 0, 0)), camera_at((-4, 0, 0)), camera_at((4, 0.5, 0.3))]
    views = views_of(splats, cameras, explicit)

    hidden = views.object_view(0, [2])
    y, x = 24 - hidden.y, 32 - hidden.x
    assert hidden.depth[y, x] == pytest.approx(4.0, abs=0.01)
    assert hidden.alpha[y, x] > 0.95
    assert hidden.visible[y, x] < 0.05
    assert hidden.visible[24 + 6 - hidden.y, 32 - hidden.x] < 0.05
    assert hidden.visible[24 + 7 - hidden.y, 32 + 7 - hidden.x] > 0.9
    assert hidden.color[y, x] == pytest.approx(0.5 + 0.282 * 0.5, abs=0.01)
    assert views.object_view(1, [2]).visible[y, x] > 0.99
    both = views.object_view(0, [2, 1])
    y, x = 24 - both.y, 32 - both.x
    assert both.visible[both.alpha > 0.9].min() > 0.99
    assert both.depth[y, x] == pytest.approx(3.0, abs=0.01)

    seen = views.scene_map(0)
    assert seen.ids[24, 32] == 1 and seen.ids[31, 39] == 2 and seen.ids[0, 0] == -1
    assert seen.depth[24, 32] == pytest.approx(3.0, abs=0.01)
    assert seen.depth[31, 39] == pytest.approx(4.0, abs=0.03)
    assert seen.depth[0, 0] == 0


def test_a_view_through_the_crop_is_the_view_itself():
    splats = sheet(0.0, 2)
    camera = camera_at((4, 1.5, 0.3))
    view = views_of(splats, [camera]).object_view(0, [2])
    whole = rasterize(*splats[:6], camera, want_depth=True)
    h, w = view.alpha.shape
    assert h * w < camera.width * camera.height
    assert np.abs(view.alpha - whole.alpha.numpy()[view.y : view.y + h, view.x : view.x + w]).max() < 1e-4
    outside = whole.alpha.numpy().copy()
    outside[view.y : view.y + h, view.x : view.x + w] = 0
    assert outside.max() == 0


def test_out_of_view_and_absent_objects_have_no_view():
    views = views_of(sheet(0.0, 2), [camera_at((4, 0, 0)), camera_at((4, 0, 0))])
    assert views.object_view(0, [1]) is None
    behind = camera_at((4, 0, 0))
    behind.viewmat[2] *= -1
    behind.viewmat[0] *= -1
    assert views_of(sheet(0.0, 2), [behind]).object_view(0, [2]) is None


def test_views_stay_within_their_memory():
    cameras = [camera_at((4, 0.1 * i, 0)) for i in range(6)]
    views = views_of(sheet(0.0, 2), cameras, memory_mb=0.12)
    for _ in range(2):
        for i in range(6):
            assert views.object_view(i, [2]).depth.max() > 0
    held = [*views._maps.values(), *views._views.values()]
    size = sum(p.nbytes for v in held for p in vars(v).values() if isinstance(p, np.ndarray))
    assert 0 < size <= 0.12e6
