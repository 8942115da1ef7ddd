"""A pinhole camera as the renderers take it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .settings import NEAR


@dataclass(frozen=True)
class Camera:
    """viewmat (4, 4) float64 world to camera with OpenCV axes; K (3, 3) float64 in pixels, the first pixel's centre at
    (0.5, 0.5); width and height in pixels; near: nearest drawn depth in scene units; gain: how much brighter, channel
    by channel, the camera's photo is than the scene (a finished picture is multiplied by it); whole: where the picture
    that this is a part of begins and ends (left, top, right, bottom), in pixels from this one's corner."""

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    near: float = NEAR
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    whole: tuple[float, float, float, float] | None = None

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """viewmat (4, 4) and (fx, fy, cx, cy), contiguous float64."""
        K = self.K
        return (
            np.ascontiguousarray(self.viewmat, np.float64),
            np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float64),
        )

    @property
    def centre(self) -> np.ndarray:
        """(3,) float64: where the camera stands in the world."""
        return -np.asarray(self.viewmat[:3, :3].T @ self.viewmat[:3, 3], np.float64)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the whole picture."""
        return self.whole or (0.0, 0.0, float(self.width), float(self.height))

    def crop(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of a part of the picture, whose upper left is the pixel (x, y). What it draws is that part of what
        this one draws: how far beside the picture the perspective is followed goes by the whole."""
        K = np.array(self.K, np.float64)
        K[0, 2] -= x
        K[1, 2] -= y
        left, top, right, bottom = self.bounds
        whole = (left - x, top - y, right - x, bottom - y)
        return replace(self, K=K, width=width, height=height, whole=whole)

    def at_origin(self) -> Camera:
        """The same camera moved to the world's origin."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] = 0.0
        return replace(self, viewmat=viewmat)
