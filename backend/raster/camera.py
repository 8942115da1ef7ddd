"""The pinhole camera of the renderers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .settings import EPS_2D, NEAR


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        viewmat: (4, 4) float64, world to camera, OpenCV axes (x right, y down, z forward).
        K: (3, 3) float64, intrinsics in pixels; the center of the first pixel is (0.5, 0.5).
        width, height: size of the image in pixels.
        near: depth of the near plane in scene units.
        blur: variance in square pixels of the low-pass filter with which 3D Gaussians are drawn, which is that of their
            training.
        gain: per-channel brightness of the camera's photo relative to the scene; rendered images are multiplied by it.
        whole: for a crop, the bounds (left, top, right, bottom) of the uncropped image, in pixels from the upper left
            corner of the crop; None: not a crop.
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    near: float = NEAR
    blur: float = EPS_2D
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    whole: tuple[float, float, float, float] | None = None

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the view matrix and the intrinsics as arrays.

        Returns:
            viewmat (4, 4) and (fx, fy, cx, cy), contiguous float64.
        """
        K = self.K
        return (
            np.ascontiguousarray(self.viewmat, np.float64),
            np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float64),
        )

    @property
    def center(self) -> np.ndarray:
        """Position of the camera in the world, (3,) float64."""
        return -np.asarray(self.viewmat[:3, :3].T @ self.viewmat[:3, 3], np.float64)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the uncropped image, in pixels from the upper left corner of this one."""
        return self.whole or (0.0, 0.0, float(self.width), float(self.height))

    def crop(self, x: int, y: int, width: int, height: int) -> Camera:
        """Return a camera that renders exactly a part of this camera's image.

        The projection is clamped at the bounds of the whole image instead of the part's (see `bounds`).

        Args:
            x, y: the part's upper left pixel.
            width, height: the part's size in pixels.

        Returns:
            The camera of the part.
        """
        K = np.array(self.K, np.float64)
        K[0, 2] -= x
        K[1, 2] -= y
        left, top, right, bottom = self.bounds
        whole = (left - x, top - y, right - x, bottom - y)
        return replace(self, K=K, width=width, height=height, whole=whole)

    def reduced(self, downscale: int) -> Camera:
        """Return a camera whose pixels are blocks of downscale x downscale of these; a remainder is left out."""
        K = np.array(self.K, np.float64)
        K[:2] /= downscale
        left, top, right, bottom = (bound / downscale for bound in self.bounds)
        whole = None if self.whole is None else (left, top, right, bottom)
        return replace(self, K=K, width=self.width // downscale, height=self.height // downscale, whole=whole)

    def at_origin(self) -> Camera:
        """Return a copy of the camera at the origin of the world."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] = 0.0
        return replace(self, viewmat=viewmat)
