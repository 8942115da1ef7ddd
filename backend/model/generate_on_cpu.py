"""Generation of Gaussians from anchors and heads on the CPU, with a hand-written gradient.

Since most offsets generate no splat, the output of the shape and color heads and its gradient are computed splat by
splat: nothing is computed, stored or read for the other offsets, and the anchors' rows are not copied.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import prange
from torch.nn.functional import pad

from ..raster.kernel import kernel
from ..raster.simd import LANES, above, exp2, keep, load, splat, spread, store, total, where
from ..shared.splats.blending import ALPHA_MIN
from .anchors import LOG_EXTENT_MAX, Layout
from .heads import HIDDEN

RAW_OPACITY_MIN = np.float32(math.atanh(ALPHA_MIN))
"""Splats with an opacity below ALPHA_MIN, which are never drawn, are not generated."""

_CHUNK = 32
"""Number of anchors per chunk. Within a chunk, offsets are processed one by one, to keep their weights in the cache."""

_PARTIAL_SUMS = 32
"""Number of partial sums of the heads' gradients; fixed, so that results do not depend on the number of threads."""

_UNROLL = 4
"""Number of independent sums that are computed in parallel, to hide the latency of additions."""

_SHAPE, _COLOR = _UNROLL, _UNROLL + 8
"""First columns of the gradients of an offset's shape and color, after that of its opacity; multiples of _UNROLL."""

_LOG2_E = np.float32(math.log2(math.e))
_UNITS = 3 * HIDDEN
assert HIDDEN == 2 * LANES


@kernel()
def _exp(x):
    """Return e**x for x up to 80, lane by lane; propagates NaN."""
    return exp2(x * splat(_LOG2_E)) + (x - x)


@kernel()
def _add_hidden(values, at, count, weights, row, sums):
    """Add values[at : at + count] @ weights[row : row + count] to sums (_UNITS,); weights (inputs, _UNITS)."""
    h0, h1, h2 = load(sums, 0), load(sums, LANES), load(sums, 2 * LANES)
    h3, h4, h5 = load(sums, 3 * LANES), load(sums, 4 * LANES), load(sums, 5 * LANES)
    for i in range(count):
        x = spread(values, at + i)
        w = (row + i) * _UNITS
        h0 += x * load(weights, w)
        h1 += x * load(weights, w + LANES)
        h2 += x * load(weights, w + 2 * LANES)
        h3 += x * load(weights, w + 3 * LANES)
        h4 += x * load(weights, w + 4 * LANES)
        h5 += x * load(weights, w + 5 * LANES)
    store(sums, 0, h0)
    store(sums, LANES, h1)
    store(sums, 2 * LANES, h2)
    store(sums, 3 * LANES, h3)
    store(sums, 4 * LANES, h4)
    store(sums, 5 * LANES, h5)


@kernel()
def _head_output(hidden, at, layer, j, output):
    """Write a head's output for offset j, computed from its hidden units hidden[at : at + HIDDEN], to `output`.

    layer: from `_by_offset`.
    """
    for block in range(layer.shape[1]):
        start = (j * layer.shape[1] + block) * (HIDDEN + 1) * LANES
        one, two = load(layer, start + HIDDEN * LANES), splat(np.float32(0.0))
        three, four = two, two
        for i in range(0, HIDDEN, _UNROLL):
            row = start + i * LANES
            one += spread(hidden, at + i) * load(layer, row)
            two += spread(hidden, at + i + 1) * load(layer, row + LANES)
            three += spread(hidden, at + i + 2) * load(layer, row + 2 * LANES)
            four += spread(hidden, at + i + 3) * load(layer, row + 3 * LANES)
        store(output, block * LANES, (one + two) + (three + four))


@kernel(parallel=True)
def _count(rows, seen_from, weights, biases, opacity_layer, k, features, hidden, opacity, counts):
    """Compute the hidden units of each anchor, its offsets' opacities before tanh, and the number of its splats."""
    columns = rows.shape[1]
    n_opacity = 3 * k + 6 + features
    extra = seen_from.shape[1]
    zero = splat(np.float32(0.0))
    count = rows.shape[0]
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        sums = np.empty(_UNITS, np.float32)
        output = np.empty(opacity_layer.shape[1] * LANES, np.float32)
        for a in range(chunk * _CHUNK, min(chunk * _CHUNK + _CHUNK, count)):
            sums[:] = biases
            _add_hidden(rows, a * columns + 3 * k + 6, features, weights, 0, sums)
            _add_hidden(seen_from, a * extra, extra, weights, features, sums)
            for i in range(0, _UNITS, LANES):
                units = load(sums, i)
                # This form of ReLU propagates NaN.
                store(hidden, a * _UNITS + i, where(above(zero, units), zero, units))
            _head_output(hidden, a * _UNITS, opacity_layer, 0, output)
            kept = 0
            for j in range(k):
                opacity[a, j] = output[j] + rows[a, n_opacity + j]
                if opacity[a, j] > RAW_OPACITY_MIN:
                    kept += 1
            counts[a] = kept


@kernel(parallel=True)
def _forward(positions, rows, opacity, hidden, shape_layer, color_layer, k, features, coefficients, starts, out):
    means, quats, scales, opacities, sh, source, extents = out
    columns = rows.shape[1]
    n_shape = 3 * k + 6 + features + k
    n_color = n_shape + 7 * k
    count = positions.shape[0]
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        first, last = chunk * _CHUNK, min(chunk * _CHUNK + _CHUNK, count)
        places = starts[first:last].copy()
        shape = np.empty(shape_layer.shape[1] * LANES, np.float32)
        color = np.empty(color_layer.shape[1] * LANES, np.float32)
        powers = np.zeros(LANES, np.float32)
        most, large, one = splat(np.float32(LOG_EXTENT_MAX)), splat(np.float32(80.0)), np.float32(1.0)
        for a in range(first, last):
            x = load(rows, a * columns + 3 * k)
            store(powers, 0, _exp(where(above(x, most), most, x)))
            for i in range(6):
                extents[a, i] = powers[i]
        for j in range(k):
            for a in range(first, last):
                if not opacity[a, j] > RAW_OPACITY_MIN:
                    continue
                _head_output(hidden, a * _UNITS + HIDDEN, shape_layer, j, shape)
                _head_output(hidden, a * _UNITS + 2 * HIDDEN, color_layer, j, color)
                at = places[a - first]
                places[a - first] += 1
                source[at] = a * k + j
                for i in range(3):
                    powers[i] = -(shape[i] + rows[a, n_shape + 7 * j + i])
                powers[3] = -2 * opacity[a, j]
                x = load(powers, 0)
                store(powers, 0, _exp(where(above(x, large), large, x)))
                # tanh
                opacities[at] = (one - powers[3]) / (one + powers[3])
                for i in range(3):
                    means[at, i] = positions[a, i] + rows[a, 3 * j + i] * extents[a, i]
                    scales[at, i] = extents[a, 3 + i] / (one + powers[i])
                for i in range(4):
                    quats[at, i] = shape[3 + i] + rows[a, n_shape + 7 * j + 3 + i]
                for c in range(coefficients):
                    for i in range(3):
                        sh[at, c, i] = color[3 * c + i]
                for i in range(3):
                    sh[at, 0, i] += rows[a, n_color + 3 * j + i]


@kernel()
def _head_gradient(raw, column, hidden, at, weights, row, g_hidden, to, g_weights):
    """Add the contribution of a splat to the gradients of a head, for _UNROLL of the head's outputs.

    The outputs have the gradients raw[column:] and the rows of the weights from `row` on; the hidden units are
    hidden[at:], their gradients g_hidden[to:].
    """
    h0, h1 = load(hidden, at), load(hidden, at + LANES)
    g0, g1 = load(g_hidden, to), load(g_hidden, to + LANES)
    for c in range(_UNROLL):
        g = spread(raw, column + c)
        w = (row + c) * HIDDEN
        g0 += g * load(weights, w)
        g1 += g * load(weights, w + LANES)
        store(g_weights, w, load(g_weights, w) + g * h0)
        store(g_weights, w + LANES, load(g_weights, w + LANES) + g * h1)
    store(g_hidden, to, g0)
    store(g_hidden, to + LANES, g1)


@kernel()
def _hidden_gradient(g_hidden, count, inputs, weights, g_inputs, g_weights):
    """Backpropagate through the hidden layer for `count` anchors.

    Adds to g_weights (_UNITS, width) and writes the gradients of the inputs (_CHUNK, width) to g_inputs. g_hidden
    (_CHUNK, _UNITS) are the gradients of the hidden units; width is a multiple of LANES.
    """
    width = inputs.shape[1]
    for block in range(0, width, LANES):
        for c in range(0, _UNITS, _UNROLL):
            row = c * width + block
            one, two = load(g_weights, row), load(g_weights, row + width)
            three, four = load(g_weights, row + 2 * width), load(g_weights, row + 3 * width)
            for a in range(count):
                x = load(inputs, a * width + block)
                at = a * _UNITS + c
                one += spread(g_hidden, at) * x
                two += spread(g_hidden, at + 1) * x
                three += spread(g_hidden, at + 2) * x
                four += spread(g_hidden, at + 3) * x
            store(g_weights, row, one)
            store(g_weights, row + width, two)
            store(g_weights, row + 2 * width, three)
            store(g_weights, row + 3 * width, four)
        for a in range(count):
            one = splat(np.float32(0.0))
            two, three, four = one, one, one
            for c in range(0, _UNITS, _UNROLL):
                at, row = a * _UNITS + c, c * width + block
                one += spread(g_hidden, at) * load(weights, row)
                two += spread(g_hidden, at + 1) * load(weights, row + width)
                three += spread(g_hidden, at + 2) * load(weights, row + 2 * width)
                four += spread(g_hidden, at + 3) * load(weights, row + 3 * width)
            store(g_inputs, a * width + block, (one + two) + (three + four))


@kernel(parallel=True)
def _backward(rows, seen_from, hidden, weights, by_offset, k, features, coefficients, starts, splats, grads, out):
    scales, opacities, source, extents = splats
    g_means, g_quats, g_scales, g_opacities, g_sh = grads
    g_rows, g_weights, g_biases, g_by_offset, g_head_biases = out
    n_features = 3 * k + 6
    n_opacity = n_features + features
    n_shape = n_opacity + k
    n_color = n_shape + 7 * k
    count, width, extra = rows.shape[0], weights.shape[1], seen_from.shape[1]
    outputs = by_offset.shape[1]
    zero = splat(np.float32(0.0))
    for part in prange(_PARTIAL_SUMS):
        raw = np.zeros((_CHUNK, k, outputs), np.float32)
        made = np.empty((_CHUNK, k), np.bool_)
        faulty = np.empty(_CHUNK, np.bool_)
        inputs, g_inputs = np.zeros((_CHUNK, width), np.float32), np.empty((_CHUNK, width), np.float32)
        g_hidden = np.empty((_CHUNK, _UNITS), np.float32)
        of_weights, of_biases, of_offset, of_head_biases = (
            g_weights[part],
            g_biases[part],
            g_by_offset[part],
            g_head_biases[part],
        )
        of_weights[:] = 0.0
        of_biases[:] = 0.0
        of_offset[:] = 0.0
        of_head_biases[:] = 0.0
        begin, end = part * count // _PARTIAL_SUMS, (part + 1) * count // _PARTIAL_SUMS
        for first in range(begin, end, _CHUNK):
            last = min(first + _CHUNK, end)
            made[:] = False
            g_hidden[:] = 0.0
            for a in range(first, last):
                for i in range(g_rows.shape[1]):
                    g_rows[a, i] = 0.0
                for i in range(features):
                    inputs[a - first, i] = rows[a, n_features + i]
                for i in range(extra):
                    inputs[a - first, features + i] = seen_from[a, i]
                sound = zero
                for n in range(starts[a], starts[a + 1]):
                    j = source[n] - a * k
                    at = a - first
                    made[a - first, j] = True
                    alpha = opacities[n]
                    raw[at, j, 0] = g_opacities[n] * (np.float32(1.0) - alpha * alpha)
                    g_rows[a, n_opacity + j] = raw[at, j, 0]
                    for i in range(3):
                        g_rows[a, 3 * j + i] = g_means[n, i] * extents[a, i]
                        g_rows[a, 3 * k + i] += g_means[n, i] * rows[a, 3 * j + i] * extents[a, i]
                        g_rows[a, 3 * k + 3 + i] += g_scales[n, i] * scales[n, i]
                        sigmoid = scales[n, i] / extents[a, 3 + i]
                        raw[at, j, _SHAPE + i] = g_scales[n, i] * scales[n, i] * (np.float32(1.0) - sigmoid)
                        g_rows[a, n_shape + 7 * j + i] = raw[at, j, _SHAPE + i]
                        g_rows[a, n_color + 3 * j + i] = g_sh[n, 0, i]
                    for i in range(4):
                        raw[at, j, _SHAPE + 3 + i] = g_quats[n, i]
                        g_rows[a, n_shape + 7 * j + 3 + i] = g_quats[n, i]
                    for c in range(coefficients):
                        for i in range(3):
                            raw[at, j, _COLOR + 3 * c + i] = g_sh[n, c, i]
                    for i in range(0, outputs, LANES):
                        x = load(raw, (at * k + j) * outputs + i)
                        sound += x - x
                # x - x is NaN for a non-finite x. Such an anchor adds nothing to the heads' gradients, and the gradient
                # of its row becomes NaN.
                faulty[a - first] = not total(sound) == 0.0  # noqa: SIM201 - true of NaN
                if faulty[a - first]:
                    made[a - first] = False
                if faulty[a - first] or starts[a] == starts[a + 1]:
                    inputs[a - first] = 0.0
            for j in range(k):
                for a in range(first, last):
                    if not made[a - first, j]:
                        continue
                    at, to, column = a * _UNITS, (a - first) * _UNITS, ((a - first) * k + j) * outputs
                    row = j * outputs
                    for c in range(0, outputs, LANES):
                        store(of_head_biases, row + c, load(of_head_biases, row + c) + load(raw, column + c))
                    for c in range(0, _COLOR + 3 * coefficients, _UNROLL):
                        head = 0 if c < _SHAPE else HIDDEN if c < _COLOR else 2 * HIDDEN
                        _head_gradient(
                            raw, column + c, hidden, at + head, by_offset, row + c, g_hidden, to + head, of_offset
                        )
            for a in range(first, last):
                for i in range(0, _UNITS, LANES):
                    to = (a - first) * _UNITS + i
                    g_units = keep(above(load(hidden, a * _UNITS + i), zero), load(g_hidden, to))
                    store(g_hidden, to, g_units)
                    store(of_biases, i, load(of_biases, i) + g_units)
            _hidden_gradient(g_hidden, last - first, inputs, weights, g_inputs, of_weights)
            for a in range(first, last):
                for i in range(features):
                    g_rows[a, n_features + i] = np.float32(np.nan) if faulty[a - first] else g_inputs[a - first, i]


class Generate(torch.autograd.Function):
    """Heads and generation of the Gaussians as one autograd function.

    Inputs: positions (n, 3), rows (n, columns), seen_from (n, 4 or 0), layout, and the weights and biases of the four
    layers. Outputs: means, quats, scales, opacities, sh and source, as in `Generated`.
    """

    @staticmethod
    def forward(ctx: Any, positions, rows, seen_from, layout: Layout, *parameters):
        w_hidden, b_hidden, w_opacity, b_opacity, w_shape, b_shape, w_color, b_color = parameters
        k, features = layout.offsets, layout.features
        n, coefficients = len(rows), len(b_color) // (3 * k)
        hidden, opacity = torch.empty(n, _UNITS), np.empty((n, k), np.float32)
        starts = np.zeros(n + 1, np.int64)
        values = rows.detach().numpy()
        _count(
            values, seen_from.numpy(), w_hidden.T.contiguous().numpy(), b_hidden.numpy(),
            _by_offset(w_opacity, b_opacity, 1), k, features, hidden.numpy(), opacity, starts[1:],
        )  # fmt: skip
        np.cumsum(starts, out=starts)
        made = int(starts[-1])
        out = tuple(np.empty((made, *s), np.float32) for s in ((3,), (4,), (3,), (), (coefficients, 3)))
        source, extents = np.empty(made, np.int64), np.empty((n, 6), np.float32)
        _forward(
            positions.numpy(), values, opacity, hidden.numpy(), _by_offset(w_shape, b_shape, k),
            _by_offset(w_color, b_color, k), k, features, coefficients, starts, (*out, source, extents),
        )  # fmt: skip
        ctx.arrays = (k, features, coefficients, starts, (out[2], out[3], source, extents))
        ctx.save_for_backward(rows, seen_from, hidden, w_hidden, w_opacity, w_shape, w_color)
        source_tensor = torch.from_numpy(source)
        ctx.mark_non_differentiable(source_tensor)
        return (*(torch.from_numpy(a) for a in out), source_tensor)

    @staticmethod
    def backward(ctx: Any, *gradients):
        rows, seen_from, hidden, w_hidden, *of_heads = ctx.saved_tensors
        k, _, coefficients, *_ = ctx.arrays
        sizes = (1, 7, 3 * coefficients)
        of_offsets = [weights.view(k, m, HIDDEN) for m, weights in zip(sizes, of_heads, strict=True)]
        by_offset = torch.cat([pad(w, (0, 0, 0, -w.shape[1] % _UNROLL)) for w in of_offsets], 1)
        by_offset = pad(by_offset, (0, 0, 0, -by_offset.shape[1] % LANES))
        weights = pad(w_hidden, (0, -w_hidden.shape[1] % LANES))
        g_rows = torch.empty_like(rows)
        sums = [
            torch.empty(_PARTIAL_SUMS, *shape)
            for shape in (weights.shape, (_UNITS,), by_offset.shape, by_offset.shape[:2])
        ]
        _backward(
            rows.detach().numpy(), seen_from.numpy(), hidden.numpy(), weights.numpy(), by_offset.numpy(), *ctx.arrays,
            tuple(np.ascontiguousarray(g.numpy()) for g in gradients[:5]),
            tuple(t.numpy() for t in (g_rows, *sums)),
        )  # fmt: skip
        of_hidden, of_biases, of_weights, of_head_biases = (parts.sum(0) for parts in sums)
        of_parameters = [of_hidden[:, : w_hidden.shape[1]], of_biases]
        for start, m in zip((0, _SHAPE, _COLOR), sizes, strict=True):
            part = slice(start, start + m)
            of_parameters += [of_weights[:, part].reshape(-1, HIDDEN), of_head_biases[:, part].reshape(-1)]
        return (None, g_rows, None, None, *of_parameters)


def _by_offset(weights: torch.Tensor, biases: torch.Tensor, k: int) -> np.ndarray:
    """Rearrange a layer (k * m, HIDDEN) and its biases (k * m,) to (k, blocks, HIDDEN + 1, LANES).

    The weights of LANES outputs of an offset become adjacent, followed by the biases.
    """
    m = len(biases) // k
    layer = torch.cat([weights, biases[:, None]], 1).view(k, m, HIDDEN + 1)
    layer = pad(layer, (0, 0, 0, -m % LANES)).view(k, -1, LANES, HIDDEN + 1)
    return layer.transpose(2, 3).contiguous().numpy()
