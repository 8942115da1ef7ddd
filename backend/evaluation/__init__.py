"""How good a reconstruction is, on views it has not seen, and the report that says so."""

from .metrics import IdScores, ImageScores, psnr, ssim
from .protocols import evaluate

__all__ = ["IdScores", "ImageScores", "evaluate", "psnr", "ssim"]
