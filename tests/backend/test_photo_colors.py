"""Color corrections of photos: recovery of known ones, their mean, and their checkpoints."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from backend.raster import devices
from backend.training.exposure import photo_colors
from backend.training.exposure.photo_colors import PhotoColors, begin_colors, corrected, fit_correction


def test_correction_applies_to_render_and_background() -> None:
    generator = torch.Generator().manual_seed(0)
    color, alpha = torch.rand((3, 4, 5), generator=generator), torch.rand((4, 5), generator=generator)
    background, correction = torch.rand(3, generator=generator), torch.randn((2, 3), generator=generator)
    shown, behind = corrected(color, background, correction)
    found = shown + (1 - alpha) * behind[:, None, None]
    composed = color + (1 - alpha) * background[:, None, None]
    torch.testing.assert_close(found, correction[0].exp()[:, None, None] * composed + correction[1][:, None, None])


def test_known_corrections_are_recovered() -> None:
    generator = torch.Generator().manual_seed(1)
    render, nothing = torch.rand((3, 24, 24), generator=generator), torch.zeros(3)
    true = torch.randn((5, 2, 3), generator=generator) * torch.tensor([0.3, 0.05])[:, None]
    true[:4] -= true[:4].mean(0)
    photos = [corrected(render, nothing, correction)[0] for correction in true]
    colors = PhotoColors(5, range(4), devices.CPU)
    rng = np.random.default_rng(0)
    for step in range(2000):
        index = int(rng.integers(4))
        correction = colors.of(index)
        (corrected(render, nothing, correction)[0] - photos[index]).abs().mean().backward()
        assert correction.grad is not None
        colors.step(index, correction.grad, step / 2000)
    assert (colors.values[:4] - true[:4]).abs().max() < 0.02
    assert true[:4].abs().max() > 0.3
    assert not colors.values[4].any(), "a photo that is held out has no correction"
    assert colors.values[:4].mean(0).abs().max() < 1e-6


def test_correction_of_a_spared_photo_does_not_drift() -> None:
    colors = PhotoColors(3, range(3), devices.CPU)
    for _ in range(20):
        colors.step(0, torch.ones((2, 3)), 0.0)
        colors.step(1, -torch.ones((2, 3)) * 2, 0.0)
        assert not colors.values[2].any()
    assert colors.values[:2].any() and colors.values.mean(0).abs().max() < 1e-6
    colors.values[2] = 0.3
    colors.step(2, torch.ones((2, 3)), 0.0)
    assert colors.values.mean(0).abs().max() < 1e-6, "once it is trained on, it counts"


def test_unusable_gradient_changes_nothing() -> None:
    colors = PhotoColors(2, (0, 1), devices.CPU)
    colors.step(0, torch.ones((2, 3)), 0.0)
    before = {name: tensor.clone() for name, tensor in colors.tensors().items()}
    colors.step(1, torch.full((2, 3), torch.nan), 0.0)
    assert all(torch.equal(before[name], tensor) for name, tensor in colors.tensors().items())


@pytest.mark.parametrize("photos", [2, 3])
def test_corrections_are_restored_from_checkpoints_of_the_same_photos(photos: int) -> None:
    colors, other = PhotoColors(2, (0, 1), devices.CPU), PhotoColors(photos, (0, 1), devices.CPU)
    colors.step(0, torch.ones((2, 3)), 0.0)
    colors.step(1, -torch.ones((2, 3)), 0.0)
    other.restore({name: tensor.numpy() for name, tensor in colors.tensors().items()})
    assert other.values.any() == (photos == 2)
    other.restore({})


def test_correction_is_fitted_to_a_photo() -> None:
    rng = np.random.default_rng(0)
    render = rng.uniform(0.1, 0.9, (8, 9, 3))
    gain, offset = np.array([0.5, 1.0, 1.7]), np.array([0.1, 0.0, -0.05])
    found = fit_correction(render, gain * render + offset)
    np.testing.assert_allclose(found, [np.log(gain), offset], atol=1e-6)
    gray = fit_correction(np.full((8, 9, 3), 0.5), render)
    assert not gray[0].any(), "a render of one color says nothing about the gain"
    np.testing.assert_allclose(gray[1], render.mean((0, 1)) - 0.5, atol=1e-6)


def test_correction_begins_at_the_common_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in training, where the photo over its gain is compared with the render."""
    rng = np.random.default_rng(0)
    render, gain, true = rng.uniform(0.1, 0.6, (8, 9, 3)), np.array([0.5, 1.0, 1.2]), np.array([[0.1], [0.05]])
    photo = gain * (np.exp(true[0]) * render + true[1])
    scene = SimpleNamespace(
        camera=lambda index: None, gains=gain[None], capture=SimpleNamespace(image=lambda index: 255 * photo)
    )
    monkeypatch.setattr(photo_colors, "draw", lambda *_, **__: SimpleNamespace(image=gain * render))
    colors = PhotoColors(1, (0,), devices.CPU)
    begin_colors(colors, None, scene, [0])
    np.testing.assert_allclose(colors.values[0], np.repeat(true, 3, 1), atol=1e-6)
