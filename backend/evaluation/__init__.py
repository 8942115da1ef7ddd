"""Evaluation of a reconstruction on held-out views, and its report."""

from .images import comparison, contact_sheet, curve_image, id_image, save_image, thumbnail
from .metrics import IdScores, ImageScores, color_corrected, psnr, ssim
from .protocols import evaluate
from .report import write_report

__all__ = [
    "IdScores",
    "ImageScores",
    "color_corrected",
    "comparison",
    "contact_sheet",
    "curve_image",
    "evaluate",
    "id_image",
    "psnr",
    "save_image",
    "ssim",
    "thumbnail",
    "write_report",
]
