"""Recoloring as one affine map of colors, and the effect of each control."""

from __future__ import annotations

import numpy as np
import pytest

from backend.shared.color.recolor import LUMA, Recolor

COLORS = np.random.default_rng(0).uniform(0.1, 0.9, (50, 3))


def apply(recolor, colors=COLORS):
    matrix, offset = recolor.affine()
    return colors @ matrix.T + offset


def test_defaults_change_nothing():
    np.testing.assert_allclose(apply(Recolor()), COLORS, atol=1e-15)
    assert not Recolor(middle=0.2, replace=(1, 0, 0)).changes and Recolor(middle=0.2).stored() is None


def test_hue_rotates_colors_and_keeps_luma():
    turned = apply(Recolor(hue=1 / 3))
    np.testing.assert_allclose(turned @ LUMA, COLORS @ LUMA, atol=1e-12)
    red = apply(Recolor(hue=1 / 3), np.array([[0.8, 0.2, 0.2]]))[0]
    assert red.argmax() == 1
    np.testing.assert_allclose(apply(Recolor(hue=-0.3), apply(Recolor(hue=0.3))), COLORS, atol=1e-12)
    np.testing.assert_allclose(apply(Recolor(hue=1.0)), COLORS, atol=1e-12)


def test_zero_saturation_gives_gray_of_same_luma():
    gray = apply(Recolor(saturation=0))
    np.testing.assert_allclose(gray, np.repeat((COLORS @ LUMA)[:, None], 3, 1), atol=1e-12)


def test_replace_keeps_shading():
    replaced = apply(Recolor(replace=(0.2, 0.4, 0.1), amount=1, middle=0.6))
    brightness = (COLORS @ LUMA / 0.6)[:, None]
    np.testing.assert_allclose(replaced, brightness * (0.2, 0.4, 0.1), atol=1e-12)
    half = apply(Recolor(replace=(0.2, 0.4, 0.1), amount=0.5, middle=0.6))
    np.testing.assert_allclose(half, (COLORS + replaced) / 2, atol=1e-12)


def test_contrast_value_and_tint():
    np.testing.assert_allclose(apply(Recolor(contrast=2, middle=0.4)), 2 * COLORS - 0.4, atol=1e-12)
    both = apply(Recolor(contrast=2, middle=0.4, value=0.5, tint=(1, 0.5, 0)))
    np.testing.assert_allclose(both, (2 * COLORS - 0.4) * (0.5, 0.25, 0), atol=1e-12)


@pytest.mark.parametrize("recolor", [
    Recolor(hue=0.2, tint=(1, 0.5, 0.25)), Recolor(replace=(0, 1, 0), amount=0.7, middle=0.3), Recolor(value=2),
])  # fmt: skip
def test_stored_recolor_round_trip(recolor):
    assert Recolor.of(recolor.stored()) == recolor
    assert Recolor.of({**recolor.stored(), "later": 1}) == recolor


@pytest.mark.parametrize("values", [{"hue": "red"}, {"tint": [1, 2]}, {"value": float("nan")}, {"replace": 3}, None])
def test_invalid_values_are_rejected(values):
    with pytest.raises((ValueError, TypeError)):
        Recolor.of(values)
