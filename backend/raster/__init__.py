"""One interface to every renderer: Gaussians, a camera and what is wanted -> what was wanted, differentiable."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import config

from . import cpu
from .camera import Camera

__all__ = ["Camera", "Rendered", "compile_kernels", "object_map", "rasterize"]


class Rendered(NamedTuple):
    """color (3, H, W) premultiplied, without background; alpha (H, W); weight (H, W): probability of the pixel's label;
    depth (H, W): expected depth times alpha; median (H, W): the depth at which half of the light is taken, 0 where less
    is, without gradient; normals (3, H, W): mean normal in camera space, towards the camera, times alpha; distortion
    (H, W): sum_{i<j} w_i w_j (1 / z_i - 1 / z_j)^2 over the weights w; frame: the renderer's own record, for
    `object_map` and growth. What was not asked for is None."""

    color: torch.Tensor
    alpha: torch.Tensor
    weight: torch.Tensor | None
    depth: torch.Tensor | None
    median: torch.Tensor | None
    normals: torch.Tensor | None
    distortion: torch.Tensor | None
    frame: Any


def _renderer(device: torch.device) -> Any:
    """The module that draws what lies on `device`. In numba's simulator that is the CUDA renderer for everything."""
    if device.type == "cuda" or config.ENABLE_CUDASIM:
        from . import cuda

        return cuda
    return cpu


def _array(renderer: Any, tensor: torch.Tensor, kind: torch.dtype = torch.float32) -> Any:
    """A tensor as the renderer takes it."""
    tensor = tensor.detach().to(kind).contiguous()
    return tensor.numpy() if renderer is cpu else tensor


def _tensor(array: Any) -> torch.Tensor | None:
    """What the renderer made as a tensor."""
    return torch.from_numpy(array) if isinstance(array, np.ndarray) else array


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, sh, ids, camera, labels, wanted, holder):
        renderer = ctx.renderer = _renderer(means.device)
        ctx.means_type = means.dtype
        if means.dtype == torch.float64:
            # Far from the origin (georeferenced captures) float32 would round positions: count from the camera.
            means = means - torch.from_numpy(camera.centre).to(means.device, non_blocking=True)
            camera = camera.at_origin()
        gaussians = renderer.Gaussians(
            *(_array(renderer, tensor) for tensor in (means, quats, scales, opacities, sh)),
            _array(renderer, ids, torch.int32),
        )
        frame = renderer.forward(
            gaussians, camera, None if labels is None else _array(renderer, labels, torch.int32), **wanted
        )
        ctx.frame = frame
        holder.append(frame)
        median = _tensor(frame.median)
        if median is not None:
            ctx.mark_non_differentiable(median)
        alpha = _tensor(1.0 - frame.transmittance)
        return (
            _tensor(frame.color), alpha, _tensor(frame.weight), _tensor(frame.depth), _tensor(frame.normals),
            _tensor(frame.moments), median,
        )  # fmt: skip

    @staticmethod
    def backward(ctx: Any, *gradients):
        # The last plane is the median, which has none.
        renderer = ctx.renderer
        g_color, g_alpha, *others = (None if g is None else _array(renderer, g) for g in gradients[:6])
        assert g_color is not None and g_alpha is not None
        out = renderer.backward(ctx.frame, g_color, g_alpha, *others)
        arrays = (out.means, out.quats, out.scales, out.opacities, out.sh)
        g_means, *g_others = (_tensor(a) for a in arrays)
        assert g_means is not None
        return (g_means.to(ctx.means_type), *g_others, None, None, None, None, None)


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor,
    ids: torch.Tensor,
    camera: Camera,
    labels: torch.Tensor | None = None,
    want_depth: bool = False,
    want_median: bool = False,
    want_normals: bool = False,
    want_distortion: bool = False,
    primitive: str = "3d",
) -> Rendered:
    """Draw 3D Gaussians (Kerbl et al. 2023) or, with primitive "2d", discs (Huang et al. 2024), differentiable in the
    first five arguments.

    means (N, 3), quats (N, 4) wxyz of any length, scales (N, 3) linear, opacities (N,) in (0, 1), sh (N, K, 3) with
    K = 1, 4, 9 or 16 (colour = 0.5 + SH, clamped at 0): float32. Means in float64 are taken relative to the camera
    before they are rounded, for scenes far from the origin. ids (N,) int32. labels (H, W) int32: also return the
    probability that each pixel shows its label (the paper's P at the label); nothing is computed that is not asked for.

    A disc lies in the plane of the first two axes of its rotation; its third scale has no effect. Its depth in a pixel
    is that where the pixel's ray meets this plane, a 3D Gaussian's that of its centre. Normals and distortion are those
    of discs.

    Tensors on a CUDA device are drawn by the CUDA renderer, and everything returned lies there; the frame's `seen` (N,)
    and `screen_gradient` (N, 2) then are tensors too.
    """
    if primitive not in ("2d", "3d"):
        raise ValueError(f"primitive is {primitive!r}, expected '2d' or '3d'")
    if primitive == "3d" and (want_normals or want_distortion):
        raise ValueError("3D Gaussians have no normals and no distortion")
    wanted = {
        "want_depth": want_depth, "want_median": want_median, "want_normals": want_normals,
        "want_moments": want_distortion, "flat": primitive == "2d",
    }  # fmt: skip
    holder: list[Any] = []
    color, alpha, weight, depth, normals, moments, median = _Rasterize.apply(
        means, quats, scales, opacities, sh, ids, camera, labels, wanted, holder
    )
    distortion = None if moments is None else alpha * moments[1] - moments[0] ** 2
    return Rendered(color, alpha, weight, depth, median, normals, distortion, holder[0])


def object_map(rendered: Rendered) -> tuple[Any, Any]:
    """The most probable ID (H, W) int32 (-1 where nothing is drawn) and its probability (H, W) float32: NumPy arrays
    from the CPU renderer, tensors on the device from the CUDA renderer."""
    if isinstance(rendered.frame, cpu.Frame):
        return cpu.object_map(rendered.frame)
    from . import cuda

    return cuda.object_map(rendered.frame)


_SURFACE = {"want_depth": True, "want_normals": True, "want_distortion": True}
_KINDS: tuple[tuple[str, bool, dict[str, bool]], ...] = (
    ("3d", True, {}), ("3d", False, {}), ("2d", True, {}), ("2d", False, {}), ("2d", True, _SURFACE),
)  # fmt: skip
"""What training draws, and what shows how far it is: primitive, with labels and a gradient, and which more planes.
On the CPU a kernel serves all of a primitive."""


def compile_kernels(place: torch.device | None = None, progress: Callable[[int, int], object] | None = None) -> float:
    """Make every kernel that training draws with on a device (None: the CPU) ready, compiled or read from numba's cache
    on disk; returns the seconds it took.

    progress(done, total) is called before the first and after every kernel. What follows in this process compiles
    nothing more, on the CPU whatever is asked for; a later process reads the cache (NUMBA_CACHE_DIR, or `__pycache__`
    beside the kernels, or the user's own cache folder where that is not writable).
    """
    started = time.perf_counter()
    report = progress or (lambda done, total: None)
    ones = torch.ones((1, 4), device=place)
    ids = torch.zeros(1, dtype=torch.int32, device=place)
    labels = torch.zeros((2, 2), dtype=torch.int32, device=place)
    camera = Camera(np.eye(4), np.eye(3), 2, 2)
    done, total = 0, 2 * len(_KINDS)
    report(done, total)
    for primitive, labelled, wanted in _KINDS:
        means = ones[:, :3].clone().requires_grad_(labelled)
        drawn = rasterize(
            means, ones, ones[:, :3], 0.5 * ones[:, 0], 0 * ones[:, None, :3], ids, camera,
            labels=labels if labelled else None, primitive=primitive, **wanted,
        )  # fmt: skip
        report(done := done + 1, total)
        if labelled:
            planes = (drawn.color, drawn.alpha, drawn.weight, drawn.depth, drawn.normals, drawn.distortion)
            torch.stack([plane.sum() for plane in planes if plane is not None]).sum().backward()
        else:
            object_map(drawn)
        report(done := done + 1, total)
    if ones.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - started
