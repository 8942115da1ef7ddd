"""Test of a GPU: what it draws, differentiates and trains is compared with the CPU's results.

`python -m backend.commands.setup.self_test FOLDER GPU` tests the GPU with this number, with its files in a folder that
is empty or does not exist, and prints the difference as JSON, in the last line. It is a process of its own, since a
driver may end or block the one that calls it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

from ...raster import Camera, devices, object_map, rasterize
from .small_scene import SmallScene

PRIMITIVES = {"3d": "Gaussians", "2d": "discs"}

_SPLATS, _WIDTH, _HEIGHT, _FOCAL, _OBJECTS = 4_000, 320, 240, 250.0, 5
_FAINT = 700
_STEPS = 5
_CLOSE, _MOST_PIXELS = 1e-3, 1e-3
"""A value of an image is close within this fraction of the largest one; this fraction of the values may not be, since
rounding decides whether a splat still counts in a pixel."""
_RELATIVE, _MOST_SPLATS = 1e-2, 1e-2
"""Largest relative error of a loss and of a splat's gradient, beyond that of a median gradient; and the fraction of the
splats that may exceed it, since gradients of discs seen edge-on are sensitive to rounding."""
_OF_IMAGES = ("color", "alpha", "probability of the labels", "depth", "normals", "distortion", "objects")


def results(device: torch.device, scratch: Path) -> dict[str, np.ndarray]:
    """Draw, differentiate and train small scenes with each primitive.

    Args:
        device: The device to compute on.
        scratch: A folder for files, which is empty or does not exist.

    Returns:
        Images (_HEIGHT, _WIDTH) or (3, _HEIGHT, _WIDTH), gradients, and the losses (_STEPS,) of a training, by name.
    """
    scene = SmallScene(scratch, device)
    found: dict[str, np.ndarray] = {}
    for primitive, name in PRIMITIVES.items():
        values = _drawn(device, primitive)
        trainer = scene.start(primitive)
        values["losses"] = np.array([float(trainer.step(0.3)) for _ in range(_STEPS)])
        found |= {f"{what} of {name}": value for what, value in values.items()}
    return found


def _drawn(device: torch.device, primitive: str) -> dict[str, np.ndarray]:
    """Return the images of random splats, some of them behind the camera, long or large, and their gradients."""
    rng = np.random.default_rng(0)
    z = rng.uniform(-0.5, 4.0, _SPLATS)
    means = np.stack([rng.uniform(-0.8, 0.8, _SPLATS) * z, rng.uniform(-0.6, 0.6, _SPLATS) * z, z], 1)
    scales = np.exp(rng.normal(np.log(0.01), 0.8, (_SPLATS, 3))) * np.abs(z)[:, None]
    opacities = rng.uniform(0.05, 0.97, _SPLATS)
    # Faint ones in one tile, which takes several passes.
    means[:_FAINT, :2], opacities[:_FAINT] = 0.01 * means[:_FAINT, :2], 0.02
    values = {
        "positions": means, "rotations": rng.normal(size=(_SPLATS, 4)), "scales": scales,
        "opacities": opacities, "colors": rng.normal(0, 0.4, (_SPLATS, 4, 3)),
    }  # fmt: skip
    ids = torch.from_numpy(rng.integers(0, _OBJECTS, _SPLATS).astype(np.int32)).to(device)
    labels = torch.from_numpy(rng.integers(0, _OBJECTS, (_HEIGHT, _WIDTH)).astype(np.int32)).to(device)
    K = np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1]])
    leaves = {
        name: torch.from_numpy(value.astype(np.float32)).to(device).requires_grad_() for name, value in values.items()
    }
    flat = primitive == "2d"
    drawn = rasterize(
        leaves["positions"], leaves["rotations"], leaves["scales"], leaves["opacities"], leaves["colors"], ids,
        Camera(np.eye(4), K, _WIDTH, _HEIGHT), labels,
        want_depth=True, want_normals=flat, want_distortion=flat, primitive=primitive,
    )  # fmt: skip
    planes = (drawn.color, drawn.alpha, drawn.label_probability, drawn.depth, drawn.normals, drawn.distortion)
    images = {name: plane for name, plane in zip(_OF_IMAGES, planes, strict=False) if plane is not None}
    loss = torch.zeros((), device=device)
    for plane in images.values():
        weights = torch.from_numpy(rng.normal(size=tuple(plane.shape)).astype(np.float32))
        loss = loss + (plane * weights.to(device)).sum()
    loss.backward()
    images["objects"] = torch.as_tensor(object_map(drawn)[0])
    gradients = {f"gradients of the {name}": leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return {name: devices.host(value) for name, value in (images | gradients).items()}


def difference(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> str:
    """Return what differs by more than rounding, for a sentence; "" if nothing does.

    Args:
        found: The results of a GPU, as from `results`.
        expected: Those of the CPU.
    """
    for name, right in expected.items():
        value = found[name]
        if not np.isfinite(value).all():
            return f"the {name} are not finite"
        if name.startswith(_OF_IMAGES):
            apart = float((np.abs(value - right) > _CLOSE * max(float(np.abs(right).max()), 1e-12)).mean())
            if apart > _MOST_PIXELS:
                return f"the {name} differ in {apart:.1%} of the pixels"
            continue
        errors, sizes = (np.linalg.norm(each.reshape(len(each), -1), axis=1) for each in (value - right, right))
        apart = float((errors > _RELATIVE * np.maximum(sizes, np.median(sizes[sizes > 0]))).mean())
        if apart > (_MOST_SPLATS if name.startswith("gradients") else 0.0):
            return f"the {name} differ for {apart:.1%} of the {'splats' if name.startswith('gradients') else 'steps'}"
    return ""


def problem_of(device: torch.device, scratch: Path) -> str:
    """Return how the results of a device differ from those of the CPU, as `difference`."""
    return difference(results(device, scratch / "gpu"), results(devices.CPU, scratch / "cpu"))


if __name__ == "__main__":
    if torch.cuda.is_available():
        torch.cuda.set_device(int(sys.argv[2]))
    print(json.dumps({"problem": problem_of(devices.pick("cuda"), Path(sys.argv[1]))}))
