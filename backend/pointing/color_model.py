"""How often colors occur among the splats of each object."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

CELL, SPREAD = 4.0, 4.0
"""Edge length in CIELAB units of the cells in which colors are counted, and standard deviation of the Gaussian by which
the counts are smoothed."""

RARE = 1e-4
"""Part of an object's splats whose color falls into one cell; rarer colors hardly tell to which object they belong."""


class ColorModel:
    """Counts the colors of nodes with the same label.

    Args:
        lab: (n, 3) CIELAB colors of the nodes.
    """

    def __init__(self, lab: np.ndarray) -> None:
        cells, self._of_node = np.unique(np.floor(lab / CELL).astype(np.int64), axis=0, return_inverse=True)
        tree = cKDTree(CELL * cells)
        near = tree.sparse_distance_matrix(tree, 3 * SPREAD, output_type="coo_matrix").tocsr()
        near.data = np.exp(-0.5 * (near.data / SPREAD) ** 2)
        # The distance of a cell from itself, 0, is not stored.
        near = near + sparse.eye_array(len(cells))
        self._near = sparse.csr_array(near / (np.sqrt(2 * np.pi) * SPREAD / CELL) ** 3)

    def likeness(self, labels: np.ndarray, count: int) -> np.ndarray:
        """Return (n, count) how likely each node has each label by its color alone; rows sum up to 1 or less.

        Args:
            labels: (n,) labels below `count`, -1 for nodes that do not count.
            count: number of labels.
        """
        known = labels >= 0
        counts = np.zeros((self._near.shape[0], count))
        np.add.at(counts, (self._of_node[known], labels[known]), 1.0)
        density = (self._near @ (counts / np.maximum(counts.sum(0), 1.0)))[self._of_node]
        return density / (density.sum(1, keepdims=True) + RARE)
