"""The panoptic scores of Replica and ScanNet++, which `evaluate` computes."""

from __future__ import annotations

from collections.abc import Mapping

from .metrics import percent

FIGURES = {
    "psnr": ("PSNR (dB)", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "miou": ("mIoU (%)", "{:.2f}"),
    "dice": ("Dice (%)", "{:.2f}"),
    "accuracy": ("Accuracy (%)", "{:.2f}"),
}

NOTES = (
    "The paper's figures are means over all its scenes.",
    "IoU and Dice of an object are taken over the pixels of all test views, and averaged over the objects; unlabeled "
    "pixels do not count.",
)


def panoptic(quality: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return the figures of a reconstruction from the means of `evaluate`, with IoU, Dice and accuracy in percent."""
    return {
        key: percent(quality.get(key)) if key in ("miou", "dice", "accuracy") else quality.get(key) for key in FIGURES
    }
