"""Training on a real GPU: quality as on the CPU, no synchronization, and checkpoints that resume on either device.

Requires only packages such as torch, numba, scipy, safetensors and Pillow, not those that read captures.
"""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import pytest
import torch

from backend.model.anchors import Layout
from backend.model.draw import draw
from backend.model.generate import generate
from backend.model.heads import Heads
from backend.raster import devices, rasterize
from backend.shared.events import Reporter
from backend.training import step
from backend.training.budget import Budget
from backend.training.losses.on_cpu import image_loss, normal_loss, volume_loss
from backend.training.settings import Settings
from backend.training.trainer import Trainer

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")

WIDTH, HEIGHT, VIEWS = 160, 120, 24
SPHERES = ((1, (-0.7, 0.0, 0.0), 0.5, (0.9, 0.3, 0.2)), (2, (0.7, 0.1, 0.0), 0.45, (0.2, 0.7, 0.3)),
           (5, (0.0, -0.2, 0.9), 0.35, (0.3, 0.4, 0.9)))  # fmt: skip
SETTINGS = Settings(offsets=5, sh_degree=1)
FLAT = dataclasses.replace(SETTINGS, primitive="2d", distortion_weight=0.1)


@dataclasses.dataclass(frozen=True)
class View:
    width: int
    height: int
    K: np.ndarray
    viewmat: np.ndarray
    camera_id: int = 1

    def to_camera(self, xyz: np.ndarray) -> np.ndarray:
        return xyz @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]

    def pixels_of(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        z = np.maximum(xyz[:, 2], 1e-9)
        x, y = (xyz[:, i] / z * self.K[i, i] + self.K[i, 2] for i in (0, 1))
        inside = np.flatnonzero((xyz[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height))
        return inside, x[inside].astype(np.int64), y[inside].astype(np.int64)


@dataclasses.dataclass(frozen=True)
class Points:
    xyz: np.ndarray
    rgb: np.ndarray


@dataclasses.dataclass(frozen=True)
class Keypoints:
    xy: np.ndarray
    point_index: np.ndarray


class Spheres:
    """A capture of three shaded spheres by a ring of cameras, in memory."""

    has_masks = True
    validation_indices = ()

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.views, self._images, self._masks = [], [], []
        for i in range(VIEWS):
            angle = 2 * math.pi * i / VIEWS
            camera_center = np.array([3 * math.cos(angle), -0.8 + 0.5 * (i % 2), 3 * math.sin(angle)])
            forward = -camera_center / np.linalg.norm(camera_center)
            right = np.cross(forward, [0.0, -1.0, 0.0])
            right /= np.linalg.norm(right)
            viewmat = np.eye(4)
            viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
            viewmat[:3, 3] = -viewmat[:3, :3] @ camera_center
            K = np.array([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1.0]])
            self.views.append(View(WIDTH, HEIGHT, K, viewmat))
            image, mask = self._shaded(viewmat, K)
            self._images.append(image)
            self._masks.append(mask)
        directions = rng.normal(size=(len(SPHERES), 200, 3))
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
        xyz = [np.array(c) + r * d for (_, c, r, _), d in zip(SPHERES, directions, strict=True)]
        rgb = [np.tile(255 * np.array(color), (200, 1)) for *_, color in SPHERES]
        self.points = Points(np.concatenate(xyz), np.concatenate(rgb).astype(np.uint8))
        self.ids = np.repeat([i for i, *_ in SPHERES], 200)
        self.test_indices = tuple(range(0, VIEWS, 8))
        self.train_indices = tuple(i for i in range(VIEWS) if i % 8)

    @staticmethod
    def _shaded(viewmat: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
        nearest, mask = np.full(x.shape, np.inf), np.zeros(x.shape, np.int64)
        image = np.full((*x.shape, 3), 0.5)
        for object_id, center, radius, color in SPHERES:
            c = viewmat[:3, :3] @ center + viewmat[:3, 3]
            a, b = (rays * rays).sum(-1), rays @ c
            root = b * b - a * (c @ c - radius * radius)
            t = (b - np.sqrt(np.maximum(root, 0))) / a
            here = (root > 0) & (t < nearest)
            normal = (rays * t[..., None] - c) / radius @ viewmat[:3, :3]
            light = 0.6 + 0.4 * normal @ np.array([0.3, -0.9, 0.3])
            image = np.where(here[..., None], np.array(color) * light[..., None], image)
            nearest, mask = np.where(here, t, nearest), np.where(here, object_id, mask)
        return np.clip(255 * image + 0.5, 0, 255).astype(np.uint8), mask

    def image(self, index: int, downscale: int = 1) -> np.ndarray:
        return self._images[index][::downscale, ::downscale]

    def mask(self, index: int, downscale: int = 1) -> np.ndarray:
        return self._masks[index][::downscale, ::downscale]

    def K(self, index: int, downscale: int = 1) -> np.ndarray:  # noqa: N802 - as of Capture
        K = self.views[index].K.copy()
        K[:2] /= downscale
        return K

    def keypoints(self, index: int) -> Keypoints:
        return Keypoints(np.zeros((0, 2)), np.zeros(0, np.int64))


@pytest.fixture(scope="module")
def spheres():
    return Spheres()


@pytest.fixture
def gpu():
    return devices.pick("cuda")


def started(spheres, settings, place):
    return Trainer.start(spheres, spheres.ids, settings, device=place)


def trained(spheres, settings, place, steps=300):
    trainer = started(spheres, settings, place)
    for i in range(steps):
        trainer.step(i / steps)
    return trainer


def quality(trainer):
    """Return PSNR in the held-out views in dB, and the fraction of object pixels with the right ID."""
    capture = trainer.scene.capture
    squares, right = [], []
    for index in capture.test_indices:
        rendered = draw(trainer.shown, trainer.scene.camera(index))
        truth = capture.mask(index)
        squares.append(((rendered.image - capture.image(index) / 255.0) ** 2).mean())
        right.append((rendered.ids[truth > 0] == truth[truth > 0]).mean())
    return -10 * math.log10(np.mean(squares)), float(np.mean(right))


def test_auto_selects_gpu(gpu):
    assert devices.why_not_cuda() is None
    assert gpu.type == "cuda" and devices.pick("auto") == gpu and devices.pick("cpu").type == "cpu"


def close(got, want, relative, absolute):
    np.testing.assert_allclose(
        got.detach().cpu(), want.detach().cpu(), rtol=relative, atol=absolute * float(want.detach().abs().max())
    )


def test_losses_and_gaussians_match_cpu(gpu):
    """On the GPU, tensor cores must not reduce the precision of SSIM's variances or of the heads."""
    rng = np.random.default_rng(0)
    h, w = 120, 200
    planes = [torch.tensor(rng.uniform(0.3, 1, s), dtype=torch.float32) for s in ((3, h, w), (h, w), (h, w), (3,))]
    target = (planes[0] + 0.02 * torch.tensor(rng.normal(size=(3, h, w)), dtype=torch.float32)).clamp(0, 1)
    labels = torch.tensor(rng.integers(-1, 3, (h, w)), dtype=torch.int32)
    depth = torch.tensor(3 + 0.03 * np.arange(w) + rng.normal(0, 0.01, (h, w)), dtype=torch.float32)
    layout = Layout(5, 32)
    rows = torch.tensor(rng.normal(0, 0.5, (500, layout.columns)), dtype=torch.float32)
    positions, ids = torch.tensor(rng.normal(size=(500, 3)), dtype=torch.float32), torch.zeros(500, dtype=torch.int32)

    def everything(place):
        leaves = [v.clone().to(place).requires_grad_() for v in (*planes, depth, rows)]
        color, alpha, weight, background, z, row = leaves
        heads = Heads(layout, "explicit", 1, torch.Generator().manual_seed(0)).to(place)
        g = generate(layout, positions.to(place), row, ids.to(place), heads).only_valid()
        values = [
            image_loss(color, alpha, weight, background, target.to(place), labels.to(place), 0.2, 0.1),
            normal_loss(color, z, alpha, np.array([150.0, 150, 100, 60])), volume_loss(g.scales),
            (g.means.sum() + g.quats.sum() + g.sh.sum() + g.opacities.sum()) / len(g.source),
        ]  # fmt: skip
        sum(values).backward()
        return torch.stack(values), [leaf.grad for leaf in leaves] + [p.grad for p in heads.parameters()]

    want, want_gradients = everything(devices.CPU)
    got, gradients = everything(gpu)
    close(got, want, 2e-4, 0)
    for a, b in zip(gradients, want_gradients, strict=True):
        assert a.is_cuda
        close(a, b, 2e-3, 2e-4)


@pytest.mark.parametrize("settings", [SETTINGS, FLAT], ids=["3d", "2d"])
def test_step_does_not_synchronize(spheres, gpu, settings):
    trainer = started(spheres, settings, gpu)
    for progress in (0.3, 0.8):
        for _ in spheres.train_indices:  # targets are uploaded and kernels compiled
            trainer.step(progress)
    trainer.progress.last_growth = trainer.progress.step
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for progress in (0.3, 0.3, 0.8, 0.8):
            loss = trainer.step(progress)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert loss.is_cuda and loss.isfinite() and trainer.model.anchors.rows.is_cuda


@pytest.mark.parametrize("settings", [SETTINGS, FLAT, dataclasses.replace(SETTINGS, mode="view")],
                         ids=["3d", "2d", "view"])  # fmt: skip
def test_training_quality_matches_cpu(spheres, gpu, settings):
    want, want_right = quality(trained(spheres, settings, devices.CPU))
    begun = time.monotonic()
    trainer = trained(spheres, settings, gpu)
    got, right = quality(trainer)
    print(f"{settings.primitive} {settings.mode}: {got:.2f} dB after {time.monotonic() - begun:.1f} s on the GPU, "
          f"{want:.2f} dB on the CPU")  # fmt: skip
    assert trainer.model.device.type == "cuda"
    assert got > 25 and got > want - 0.7
    assert right > 0.95 and right > want_right - 0.02


@pytest.mark.parametrize("first", ["cpu", "cuda"])
def test_checkpoint_resumes_on_other_device(spheres, gpu, tmp_path, first):
    places = [devices.CPU, gpu] if first == "cpu" else [gpu, devices.CPU]
    begun = started(spheres, SETTINGS, places[0])
    begun.run(Budget(steps=150), tmp_path, Reporter())
    resumed, warning = Trainer.resume(spheres, tmp_path, SETTINGS, device=places[1])
    assert warning is None and resumed.progress.step == 150
    assert resumed.model.device == places[1]
    close(resumed.model.anchors.rows, begun.model.anchors.rows, 0, 0)
    resumed.run(Budget(steps=300), tmp_path, Reporter())
    found, right = quality(resumed)
    assert found > 25 and right > 0.95


def test_training_in_parts_reaches_same_quality(spheres, gpu, monkeypatch):
    def full(*arguments, **options):
        if arguments[6].width > WIDTH // 2:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return rasterize(*arguments, **options)

    monkeypatch.setattr(step, "rasterize", full)
    trainer = trained(spheres, SETTINGS, gpu)
    monkeypatch.undo()
    found, right = quality(trainer)
    assert trainer.parts == 2 and found > 25 and right > 0.95
