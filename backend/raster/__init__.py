"""Differentiable rasterization of 3D Gaussians and discs: a common interface to the CPU and GPU renderers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from ..gpu.emulator import emulated
from .camera import Camera
from .cpu import renderer as cpu

__all__ = ["Camera", "Rendered", "compile_kernels", "object_map", "object_ranks", "rasterize"]


class Rendered(NamedTuple):
    """A rendered image; planes that were not requested are None.

    Attributes:
        color: (3, H, W), premultiplied, without background.
        alpha: (H, W).
        label_probability: (H, W), probability of each pixel's label.
        depth: (H, W), expected depth times alpha.
        median: (H, W), the depth at which the transmittance falls below one half, 0 where it does not; no gradient.
        surface: (H, W), mean depth of the splats up to the median one, thus without what shines through the surface;
            0 where nothing is drawn; no gradient.
        normals: (3, H, W), mean normal in camera space, towards the camera, times alpha.
        distortion: (H, W), sum_{i<j} w_i w_j (1 / z_i - 1 / z_j)^2 over the blending weights w.
        frame: internal data of the renderer, for `object_map` and growth. Its `seen` (N,) marks the visible splats; its
            `screen_gradient` (N, 2), after the backward pass, is the gradient with respect to their centers in pixels.
    """

    color: torch.Tensor
    alpha: torch.Tensor
    label_probability: torch.Tensor | None
    depth: torch.Tensor | None
    median: torch.Tensor | None
    surface: torch.Tensor | None
    normals: torch.Tensor | None
    distortion: torch.Tensor | None
    frame: Any


def _renderer(device: torch.device) -> Any:
    """Return the renderer module for tensors on `device`; if a GPU is emulated, always the GPU renderer."""
    if device.type == "cuda" or emulated():
        from .gpu import renderer as gpu

        return gpu
    return cpu


def _array(renderer: Any, tensor: torch.Tensor, kind: torch.dtype = torch.float32) -> Any:
    """Convert a tensor to the renderer's input type: an array for the CPU renderer, otherwise a tensor."""
    tensor = tensor.detach().to(kind).contiguous()
    return tensor.numpy() if renderer is cpu else tensor


def _tensor(array: Any) -> torch.Tensor | None:
    """Return the renderer's array or tensor as a new tensor on the same memory.

    A frame that held the tensors that autograd returns would hold itself, through their gradient function.
    """
    if isinstance(array, np.ndarray):
        return torch.from_numpy(array)
    return None if array is None else array.detach()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        sh: torch.Tensor,
        ids: torch.Tensor,
        camera: Camera,
        labels: torch.Tensor | None,
        wanted: dict[str, bool],
        holder: list[Any],
    ) -> tuple[torch.Tensor | None, ...]:
        renderer = ctx.renderer = _renderer(means.device)
        ctx.means_type = means.dtype
        if means.dtype == torch.float64:
            # Far from the origin (georeferenced captures), float32 is too coarse: subtract the camera's position.
            means = means - torch.from_numpy(camera.center).to(means.device, non_blocking=True)
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
        depths = _tensor(frame.median), _tensor(frame.surface)
        ctx.mark_non_differentiable(*(plane for plane in depths if plane is not None))
        alpha = _tensor(1.0 - frame.transmittance)
        return (
            _tensor(frame.color), alpha, _tensor(frame.label_probability), _tensor(frame.depth),
            _tensor(frame.normals), _tensor(frame.moments), *depths,
        )  # fmt: skip

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        # The last planes, median and surface, have no gradient.
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
    want_surface: bool = False,
    want_normals: bool = False,
    want_distortion: bool = False,
    primitive: str = "3d",
) -> Rendered:
    """Render 3D Gaussians (Kerbl et al. 2023) or discs (Huang et al. 2024), differentiable in the first five arguments.

    Only the requested planes are computed. Tensors on a GPU are rendered by the GPU renderer, and all results
    are on that device, including the frame's `seen` and `screen_gradient`.

    Args:
        means: centers (N, 3), float32; or float64 for scenes far from the origin, in which case they are converted to
            camera-relative positions before rounding to float32.
        quats: rotations (N, 4) wxyz of any length, float32.
        scales: standard deviations (N, 3), linear, float32. A disc spans the first two axes of its rotation; its third
            scale has no effect.
        opacities: (N,) in (0, 1), float32.
        sh: spherical harmonics (N, K, 3) with K = 1, 4, 9 or 16, float32; color = 0.5 + SH, clamped at 0.
        ids: (N,) int32, the object of each splat.
        camera: the camera.
        labels: (H, W) int32; if given, the probability that each pixel shows its label is computed.
        want_depth: whether to compute the depth. The depth of a disc in a pixel is that of the ray's intersection with
            its plane; the depth of a 3D Gaussian is that of its center.
        want_median: whether to compute the median depth.
        want_surface: whether to compute the depth of the surface, without what shines through it.
        want_normals: whether to compute the normals, for discs only.
        want_distortion: whether to compute the distortion, for discs only.
        primitive: "3d" for 3D Gaussians, "2d" for discs.

    Returns:
        The image and the requested planes.

    Raises:
        ValueError: `primitive` is unknown, or normals or distortion are requested for 3D Gaussians.
    """
    if primitive not in ("2d", "3d"):
        raise ValueError(f"primitive is {primitive!r}, expected '2d' or '3d'")
    if primitive == "3d" and (want_normals or want_distortion):
        raise ValueError("3D Gaussians have no normals and no distortion")
    wanted = {
        "want_depth": want_depth, "want_median": want_median, "want_surface": want_surface,
        "want_normals": want_normals, "want_moments": want_distortion, "flat": primitive == "2d",
    }  # fmt: skip
    holder: list[Any] = []
    color, alpha, label_probability, depth, normals, moments, median, surface = _Rasterize.apply(
        means, quats, scales, opacities, sh, ids, camera, labels, wanted, holder
    )
    distortion = None if moments is None else alpha * moments[1] - moments[0] ** 2
    return Rendered(color, alpha, label_probability, depth, median, surface, normals, distortion, holder[0])


def object_map(rendered: Rendered) -> tuple[Any, Any]:
    """Find the most probable object of each pixel.

    Args:
        rendered: result of `rasterize`.

    Returns:
        The ID (H, W) int32, -1 where nothing is drawn, and its probability (H, W) float32: the sum of the blending
        weights of its splats. NumPy arrays from the CPU renderer, tensors on the device from the GPU renderer.
    """
    ids, probabilities = object_ranks(rendered, 1)
    return ids[0], probabilities[0]


def object_ranks(rendered: Rendered, ranks: int) -> tuple[Any, Any]:
    """Rank the most probable objects of each pixel.

    Args:
        rendered: result of `rasterize`.
        ranks: number of objects per pixel.

    Returns:
        The IDs (ranks, H, W) int32 in descending order of probability, -1 where there are no more, and their
        probabilities (ranks, H, W) float32; arrays or tensors, as in `object_map`.
    """
    if isinstance(rendered.frame, cpu.Frame):
        return cpu.object_ranks(rendered.frame, ranks)
    from .gpu import renderer as gpu

    return gpu.object_ranks(rendered.frame, ranks)


_SURFACE = {"want_depth": True, "want_normals": True, "want_distortion": True}
_KINDS: tuple[tuple[str, bool, dict[str, bool]], ...] = (
    ("3d", True, {}), ("3d", False, {}), ("2d", True, {}), ("2d", False, {}), ("2d", True, _SURFACE),
)  # fmt: skip
"""The variants rendered in training and previews: primitive, whether with labels and gradients, and additional planes.
On the CPU, all variants of a primitive use the same kernel."""


def compile_kernels(
    device: torch.device | None = None,
    progress: Callable[[int, int], object] | None = None,
    primitives: Sequence[str] = ("3d", "2d"),
) -> float:
    """Compile all rendering kernels that are used in training, or load them from numba's cache on disk.

    Afterwards, this process compiles no rendering kernels in training, and on the CPU for any request. Later processes
    read the cache, which is in NUMBA_CACHE_DIR, as the command line sets it, else in `__pycache__` beside the kernels
    or, if that is not writable, in the user's cache folder.

    Args:
        device: the device to compile for; None: the CPU.
        progress: called as progress(done, total) before the first and after each kernel.
        primitives: what is rendered.

    Returns:
        The elapsed seconds.
    """
    started = time.perf_counter()
    ones = torch.ones((1, 4), device=device)
    ids = torch.zeros(1, dtype=torch.int32, device=device)
    labels = torch.zeros((2, 2), dtype=torch.int32, device=device)
    camera = Camera(np.eye(4), np.eye(3), 2, 2)
    kinds = [kind for kind in _KINDS if kind[0] in primitives]

    def report(done: int) -> None:
        if progress:
            progress(done, 2 * len(kinds))

    report(0)
    for index, (primitive, labeled, wanted) in enumerate(kinds):
        means = ones[:, :3].clone().requires_grad_(labeled)
        drawn = rasterize(
            means, ones, ones[:, :3], 0.5 * ones[:, 0], 0 * ones[:, None, :3], ids, camera,
            labels=labels if labeled else None, primitive=primitive, **wanted,
        )  # fmt: skip
        report(2 * index + 1)
        if labeled:
            planes = (drawn.color, drawn.alpha, drawn.label_probability, drawn.depth, drawn.normals, drawn.distortion)
            torch.stack([plane.sum() for plane in planes if plane is not None]).sum().backward()
        else:
            object_map(drawn)
        report(2 * index + 2)
    if ones.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - started
