"""How good a reconstruction is, on views it has not seen, and the report that says so."""

from .metrics import IdScores, ImageScores, psnr, ssim
from .pictures import comparison, contact_sheet, curve_picture, id_picture, save_picture, thumbnail
from .protocols import evaluate
from .report import write_report

__all__ = [
    "IdScores",
    "ImageScores",
    "comparison",
    "contact_sheet",
    "curve_picture",
    "evaluate",
    "id_picture",
    "psnr",
    "save_picture",
    "ssim",
    "thumbnail",
    "write_report",
]
