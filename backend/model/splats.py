"""Gaussians as plain arrays, for export, import and display."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..shared.splats.blending import EPS_2D

ROWS_AT_ONCE = 1 << 16
"""Number of splats that are converted or written at a time, since models may take half of the memory."""


@dataclass
class Splats:
    """N Gaussians in world coordinates.

    Attributes:
        means: (N, 3) in world units, float32 or float64.
        quats: (N, 4) unit quaternions w, x, y, z, local to world.
        scales: (N, 3) standard deviations > 0 in world units, not their logarithms.
        opacities: (N,) in (0, 1), not their logits.
        sh: (N, K, 3), K = (degree + 1)^2 coefficients of the real spherical harmonics for red, green, blue;
            color = max(0, basis(direction) . sh + 0.5).
        object_ids: (N,) int64 in 0 .. 2^32 - 1; 0 is "no object".
        unobserved: (N,) bool, generated to fill a hole and visible in no image; all False if not given.
        blur: variance in square pixels of the low-pass filter with which they are to be drawn.
    """

    means: NDArray
    quats: NDArray
    scales: NDArray
    opacities: NDArray
    sh: NDArray
    object_ids: NDArray
    unobserved: NDArray = field(default_factory=lambda: np.zeros(0, bool))
    blur: float = EPS_2D

    def __post_init__(self) -> None:
        n = len(self.means)
        if len(self.unobserved) == 0:
            self.unobserved = np.zeros(n, bool)
        shapes = {
            "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "object_ids": (n,),
            "unobserved": (n,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"splats: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            raise ValueError(f"splats: sh has shape {self.sh.shape}, expected ({n}, K, 3)")
        if self.sh.shape[1] < 1 or math.isqrt(self.sh.shape[1]) ** 2 != self.sh.shape[1]:
            raise ValueError(f"splats: sh has {self.sh.shape[1]} coefficients, expected 1, 4, 9 or 16")
        self.object_ids = self.object_ids.astype(np.int64, copy=False)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics; 0 if the color does not depend on the direction."""
        return math.isqrt(self.sh.shape[1]) - 1

    @classmethod
    def empty(cls, degree: int = 0) -> Splats:
        """Return an empty set of splats with spherical harmonics of `degree`."""
        return cls(
            means=np.zeros((0, 3), np.float32),
            quats=np.zeros((0, 4), np.float32),
            scales=np.zeros((0, 3), np.float32),
            opacities=np.zeros(0, np.float32),
            sh=np.zeros((0, (degree + 1) ** 2, 3), np.float32),
            object_ids=np.zeros(0, np.int64),
        )

    def select(self, rows: NDArray | slice) -> Splats:
        """Return the splats selected by a boolean mask (N,), by indices, in that order, or by a slice, not copied."""
        return Splats(
            self.means[rows],
            self.quats[rows],
            self.scales[rows],
            self.opacities[rows],
            self.sh[rows],
            self.object_ids[rows],
            self.unobserved[rows],
            self.blur,
        )

    def with_degree(self, degree: int) -> Splats:
        """Return the splats with higher bands of spherical harmonics removed, or filled with zeros."""
        k = (degree + 1) ** 2
        sh = np.zeros((len(self), k, 3), self.sh.dtype)
        keep = min(k, self.sh.shape[1])
        sh[:, :keep] = self.sh[:, :keep]
        return replace(self, sh=sh)


def concatenate(parts: Sequence[Splats]) -> Splats:
    """Concatenate splats of the same filter; spherical harmonics are padded with zeros to the highest degree."""
    if not parts:
        return Splats.empty()
    degree = max(part.degree for part in parts)
    parts = [part if part.degree == degree else part.with_degree(degree) for part in parts]
    return Splats(
        np.concatenate([part.means for part in parts]),
        np.concatenate([part.quats for part in parts]),
        np.concatenate([part.scales for part in parts]),
        np.concatenate([part.opacities for part in parts]),
        np.concatenate([part.sh for part in parts]),
        np.concatenate([part.object_ids for part in parts]),
        np.concatenate([part.unobserved for part in parts]),
        parts[0].blur,
    )


@dataclass(frozen=True)
class PlacedSplats:
    """Splats in a space of their own, as nodes of a scene have.

    Attributes:
        splats: in that space.
        matrix: (4, 4) affine map to world space.
        name: of the node, may be empty.
        object_id: of the object, 0 .. 2^32 - 1, or None if the file does not tell.
    """

    splats: Splats
    matrix: NDArray
    name: str = ""
    object_id: int | None = None


def objects_of(splats: Splats) -> list[tuple[int, Splats, NDArray[np.float64]]]:
    """Return the ID, the splats and the center (3,) of their means' bounds of each object that has splats, by ID."""
    ids, counts = np.unique(splats.object_ids, return_counts=True)
    rows = np.split(np.argsort(splats.object_ids, kind="stable"), np.cumsum(counts)[:-1])
    found = []
    for object_id, own in zip(ids.tolist(), rows, strict=True):
        part = splats.select(own)
        low, high = part.means.min(0).astype(np.float64), part.means.max(0).astype(np.float64)
        found.append((object_id, part, (low + high) / 2))
    return found


def gathered(parts: Iterable[Splats], most: int) -> Splats:
    """Concatenate splats while they are made, so that there is no second copy of them.

    Args:
        parts: splats of one degree and of the same types; one part or more.
        most: upper bound of the number of splats. Rows that are not filled take addresses, but no memory.
    """
    blur = EPS_2D

    def arrays() -> Iterator[dict[str, NDArray]]:
        nonlocal blur
        for part in parts:
            values = vars(part).copy()
            blur = values.pop("blur")
            yield values

    return Splats(**gathered_columns(arrays(), most), blur=blur)


def gathered_columns(parts: Iterable[Mapping[str, NDArray]], most: int) -> dict[str, NDArray]:
    """Concatenate arrays while they are made, as `gathered` does.

    Args:
        parts: one or more; all have the same names, and the arrays of a part the same number of rows.
        most: upper bound of the number of rows of the result.
    """
    whole: dict[str, NDArray] = {}
    count = 0
    for part in parts:
        length = len(next(iter(part.values())))
        for name, values in part.items():
            if name not in whole:
                whole[name] = np.empty((most, *values.shape[1:]), values.dtype)
            whole[name][count : count + length] = values
        count += length
    # On Windows, addresses count as memory, so that little of many is copied.
    return {name: values[:count].copy() if 2 * count < most else values[:count] for name, values in whole.items()}


def blocks(count: int, each: int = 1) -> Iterator[slice]:
    """Divide `count` rows, which have `each` splats, into blocks of at most ROWS_AT_ONCE splats."""
    size = max(ROWS_AT_ONCE // each, 1)
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def some_blocks(count: int, each: int = 1) -> list[slice]:
    """Return the `blocks`, or an empty one if there are no rows."""
    return list(blocks(count, each)) or [slice(0, 0)]


def converted(values: NDArray, convert: Callable[[NDArray], NDArray], kind: DTypeLike = np.float64) -> NDArray:
    """Return convert(values), of the same shape and of the type `kind`, computed in blocks of rows."""
    out = np.empty(values.shape, kind)
    for rows in blocks(len(values)):
        out[rows] = convert(values[rows])
    return out
