"""A surface without looks: what fusion makes and texturing dresses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class Surface:
    """vertices (V, 3) float64 in scene units; faces (F, 3) int32, counter-clockwise from outside; invented (F,) bool:
    faces that close what no camera saw."""

    vertices: np.ndarray
    faces: np.ndarray
    invented: np.ndarray
