"""Conversion of a training's state to and from the tensors and JSON of a checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..model.anchors import Anchors
from ..model.checkpoint import Stored, Take, load_checkpoint
from ..model.heads import Heads
from ..model.object_model import Normalization, ObjectModel
from ..model.splats import gathered_columns
from ..raster import devices
from ..raster.settings import EPS_2D, EPS_2D_DISC, USUAL_EPS_2D
from ..shared.class_table import ClassTable
from ..shared.errors import InputError
from ..shared.formats.typed import typed
from ..shared.reconstruction.objects import LARGEST_ID
from .budget import TrainingProgress
from .cells.region import Region
from .exposure.photo_colors import PhotoColors
from .growth_strategy import GrowthStrategy
from .optimizer.average import PREFIX, Average
from .optimizer.head_adam import MOMENTS, STEP, HeadAdam, checkpoint_name
from .optimizer.row_adam import RowAdam
from .settings import HEAD_RATES, MODES, Settings

Keep = Callable[[Anchors], np.ndarray]
"""Returns which of a block of anchors are kept, (n,) bool."""

_BLOCK = 65536
"""Number of anchors, or rows of a tensor, that are read at a time."""

Expected = dict[str, tuple[type, tuple[int, ...]]]
"""Type and shape of tensors by name."""

BLUR_KEY = "blur"
"""Name of the low-pass filter's variance in a checkpoint's state; former versions did not write it."""

_OTHER_BLUR = (
    "The discs in {folder} were trained by a version that blurred them more, so they appear too thin now; train them "
    "further, or again, to adapt them."
)

_FORMER_TENSORS = {"adam.first": "adam.exp_avg", "adam.second": "adam.exp_avg_sq"}
_FORMER_KEYS = {"teach_unlabelled": "supervise_background", "centre": "center", "settled_from": "converged_at"}
"""Names in checkpoints written by older versions, and their current names."""


def read_checkpoint(
    folder: Path, take: Take | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any], str | None] | None:
    """Read the latest complete checkpoint in `folder`; take: as in `load_checkpoint`.

    Returns:
        The tensors, the state, and a warning or None; None if there is no checkpoint.

    Raises:
        InputError: there are checkpoint files, but none can be read.
    """
    found = load_checkpoint(
        folder, lambda tensors, state: _check_training(tensors, _renamed(state)), _FORMER_TENSORS, take
    )
    if found is None:
        return None
    tensors, state, warning = found
    return tensors, _renamed(state), warning


def _renamed(state: dict[str, Any]) -> dict[str, Any]:
    """Replace names of older versions by the present ones."""
    state = {_FORMER_KEYS.get(key, key): value for key, value in state.items()}
    for part in ("normalization", "progress"):
        state[part] = {_FORMER_KEYS.get(key, key): value for key, value in state[part].items()}
    return state


def training_tensors(
    model: ObjectModel,
    row_optimizer: RowAdam,
    growth: GrowthStrategy,
    average: Average,
    head_optimizer: HeadAdam,
    colors: PhotoColors | None,
) -> dict[str, np.ndarray]:
    """Return all tensors that the next step depends on, by their names in a checkpoint."""
    anchors = model.anchors
    tensors: dict[str, torch.Tensor | np.ndarray] = {
        "anchors.positions": anchors.positions,
        "anchors.rows": anchors.rows,
        "anchors.ids": anchors.ids,
        **row_optimizer.tensors(),
        **growth.tensors(),
        "object_ids": model.classes.ids,
        "background": model.background,
        **average.tensors(),
        **head_optimizer.tensors(),
        **({} if colors is None else colors.tensors()),
        **{f"heads.{name}": value for name, value in model.heads.state_dict().items()},
    }
    return {name: devices.host(value) for name, value in tensors.items()}


def training_state(
    settings: Settings,
    model: ObjectModel,
    supervise_background: bool,
    rng: np.random.Generator,
    p: TrainingProgress,
    region: Region,
) -> dict[str, Any]:
    """Return what a checkpoint contains beside its tensors, as JSON."""
    return {
        "settings": settings.as_dict(),
        "voxel": model.anchors.voxel,
        "supervise_background": supervise_background,
        "normalization": {"center": model.normalization.center, "scale": model.normalization.scale},
        "rng": rng.bit_generator.state,
        BLUR_KEY: EPS_2D_DISC if model.primitive == "2d" else model.blur,
        "progress": {**p.__dict__},
        **({} if region.is_whole else {"region": region.as_dict()}),
    }


def require_settings(wanted: Settings, state: dict[str, Any], folder: Path) -> None:
    """Raise InputError if the training of a checkpoint in `folder` has other settings than `wanted`."""
    stored = Settings(**state["settings"])
    if wanted.in_effect() != stored.in_effect():
        changed = [k for k, v in wanted.as_dict().items() if stored.as_dict()[k] != v]
        raise InputError(
            f"The checkpoint in {folder} was trained with other settings ({', '.join(changed)}); use the same, "
            "another --out, or --restart to start over."
        )


def model_from_checkpoint(tensors: dict[str, np.ndarray], state: dict[str, Any]) -> ObjectModel:
    """Return the model stored in a checkpoint's tensors and state; its anchors share their memory with the tensors."""
    settings = Settings(**state["settings"])
    anchors = Anchors(
        settings.layout, float(state["voxel"]),
        *(torch.from_numpy(tensors[f"anchors.{n}"]) for n in ("positions", "rows", "ids")),
    )  # fmt: skip
    heads = Heads(settings.layout, settings.mode, settings.sh_degree, torch.Generator())
    heads.load_state_dict(
        {k.removeprefix("heads."): torch.from_numpy(v.copy()) for k, v in tensors.items() if k.startswith("heads.")}
    )
    center, scale = state["normalization"]["center"], state["normalization"]["scale"]
    normalization = Normalization((center[0], center[1], center[2]), scale)
    return ObjectModel(
        anchors, heads, torch.from_numpy(tensors["background"].copy()), ClassTable(tensors["object_ids"]),
        normalization, settings.primitive, EPS_2D if settings.primitive == "2d" else state.get(BLUR_KEY, USUAL_EPS_2D),
    )  # fmt: skip


def require_checkpoint(
    folder: Path, take: Take | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any], str | None]:
    """Return the result of `read_checkpoint`; raise InputError also if there is no checkpoint."""
    found = read_checkpoint(folder, take)
    if found is None:
        raise InputError(f"{folder} contains no checkpoint; train first.")
    return found


def read_result(
    folder: Path, keep: Keep | None = None, fixed: bool = True
) -> tuple[dict[str, np.ndarray], dict[str, Any], str | None]:
    """Read the result of a training from its checkpoint, without what only its continuation depends on.

    That takes a quarter of the memory of the whole checkpoint.

    Args:
        folder: The folder of the checkpoint.
        keep: Chooses among a block of the anchors those that are kept in memory; None: all.
        fixed: Whether anchors that the training did not change are read, too; without them, the state still tells
            how many there are.

    Returns:
        The tensors, as in a checkpoint, of the mean of the model over the latest steps, the state, and a warning or
        None.

    Raises:
        InputError: There is no checkpoint in `folder`, or none can be read.
    """
    return require_checkpoint(folder, lambda stored, state: _take_result(stored, state, keep, fixed))


def _take_result(stored: Stored, state: dict[str, Any], keep: Keep | None, with_fixed: bool) -> dict[str, np.ndarray]:
    """Return the tensors that `read_result` returns."""
    mean = {name.removeprefix(PREFIX) for name in stored if name.startswith(PREFIX)}
    others = [name for name in stored if not name.startswith(("adam.", "growth.", "anchors.", PREFIX))]
    layout, voxel = Settings(**state["settings"]).layout, float(state["voxel"])
    count = len(stored["anchors.ids"])
    fixed = Region.of(state).fixed
    # Fixed anchors, the first ones, have no mean.
    without_mean = fixed if "rows" in mean else count
    begin = 0 if with_fixed else fixed

    def block(first: int, last: int) -> dict[str, np.ndarray]:
        read = {name: stored.part(f"anchors.{name}", first, last) for name in ("positions", "ids")}
        middle = min(max(first, without_mean), last)
        rows = [stored.part("anchors.rows", first, middle)]
        if middle < last:
            rows.append(stored.part(PREFIX + "rows", middle - without_mean, last - without_mean))
        read["rows"] = np.concatenate(rows)
        if keep is not None:
            each = (torch.from_numpy(read[name]) for name in ("positions", "rows", "ids"))
            kept = keep(Anchors(layout, voxel, *each))
            read = {name: values[kept] for name, values in read.items()}
        return read

    starts = range(begin, max(count, begin + 1), _BLOCK)
    of_anchors = gathered_columns((block(first, min(first + _BLOCK, count)) for first in starts), count - begin)
    return {
        **{name: stored[PREFIX + name if name in mean else name] for name in others},
        **{f"anchors.{name}": values for name, values in of_anchors.items()},
    }


def load_model(
    folder: Path, device: torch.device = devices.CPU, keep: Keep | None = None
) -> tuple[ObjectModel, dict[str, Any], str | None]:
    """Load the result of a training, the mean of the model over the latest steps.

    Args:
        folder: The folder of the checkpoint.
        device: Where the model is to be.
        keep: As in `read_result`.

    Returns:
        The model on `device`, the checkpoint's state, and a warning or None.

    Raises:
        InputError: There is no checkpoint in `folder`, or none can be read.
    """
    tensors, state, warning = read_result(folder, keep)
    return model_from_checkpoint(tensors, state).to(device), state, warning


def blur_warning(state: dict[str, Any], folder: Path) -> str | None:
    """Return the warning about a checkpoint with discs of a version that filtered them otherwise, or None."""
    if Settings(**state["settings"]).primitive != "2d" or state.get(BLUR_KEY) == EPS_2D_DISC:
        return None
    return _OTHER_BLUR.format(folder=folder)


def progress_of(state: dict[str, Any]) -> TrainingProgress:
    """Return the training's progress stored in a checkpoint's state."""
    return TrainingProgress(**json.loads(json.dumps(state["progress"])))


def _check_training(tensors: Mapping[str, np.ndarray], state: dict[str, Any]) -> None:
    """Check that tensors and state are those that `training_tensors` and `Trainer.save` write.

    Types, shapes, values that are not finite, and indices are checked, so that nothing fails later.

    Raises:
        ValueError, KeyError, TypeError: They are not.
    """
    settings = Settings(**typed(Settings, state["settings"]))
    TrainingProgress(**typed(TrainingProgress, state["progress"]))
    _check_state(settings, state)
    columns, k = settings.layout.columns, settings.offsets
    count, classes = len(tensors["anchors.positions"]), len(tensors["object_ids"])
    trained = count - Region.of(state).fixed
    f4, i4 = np.float32, np.int32
    expected: Expected = {
        "anchors.positions": (f4, (count, 3)),
        "anchors.rows": (f4, (count, columns)),
        "anchors.ids": (i4, (count,)),
        "adam.exp_avg": (f4, (trained, columns)),
        "adam.exp_avg_sq": (f4, (trained, columns)),
        "growth.gradient": (f4, (count * k,)),
        "growth.visits": (i4, (count * k,)),
        "growth.opacity": (f4, (count,)),
        "growth.views": (i4, (count,)),
        "object_ids": (np.int64, (classes,)),
        "background": (f4, (3,)),
    }
    _check_tensors(tensors, expected)
    # The heads are created only now, since their size depends on settings that the tensors have confirmed.
    heads = Heads(settings.layout, settings.mode, settings.sh_degree, torch.Generator())
    shapes: Expected = {f"heads.{name}": (f4, tuple(value.shape)) for name, value in heads.state_dict().items()}
    if any(name.startswith("mean.") for name in tensors):
        shapes |= {f"mean.{name}": shape for name, shape in shapes.items()}
        shapes |= {"mean.rows": (f4, (trained, columns)), "mean.background": (f4, (3,))}
    if "colors.steps" in tensors:
        photos = len(tensors["colors.steps"])
        shapes |= {name: (f4, (photos, 2, 3)) for name in ("colors.values", "colors.exp_avg", "colors.exp_avg_sq")}
        shapes |= {"colors.steps": (f4, (photos,))}
    _check_tensors(tensors, shapes)
    ordered = [value for name in HEAD_RATES if name != "background" for value in getattr(heads, name).parameters()]
    _check_head_moments(tensors, [*(tuple(value.shape) for value in ordered), (3,)])
    ids = tensors["object_ids"]
    if not (np.diff(ids) > 0).all() or not (len(ids) and ids[0] == 0 and ids[-1] <= LARGEST_ID):
        raise ValueError("object_ids are not ascending from 0")
    if count and not 0 <= tensors["anchors.ids"].min() <= tensors["anchors.ids"].max() < classes:
        raise ValueError("anchors have classes that do not exist")


def _check_state(settings: Settings, state: dict[str, Any]) -> None:
    if not isinstance(state["supervise_background"], bool):
        raise TypeError("supervise_background is not a boolean")
    center, scale = state["normalization"]["center"], state["normalization"]["scale"]
    if len(center) != 3 or not all(map(math.isfinite, center)) or not (math.isfinite(scale) and scale > 0):
        raise ValueError("the normalization is invalid")
    if not (math.isfinite(state["voxel"]) and state["voxel"] > 0):
        raise ValueError("the voxel size is invalid")
    blur = state.get(BLUR_KEY, USUAL_EPS_2D)
    if isinstance(blur, bool) or not 0 < blur <= USUAL_EPS_2D:
        raise ValueError("the low-pass filter is invalid")
    choices = {"mode": MODES, "primitive": ("3d", "2d"), "background": ("learned", "black", "white")}
    if any(getattr(settings, name) not in values for name, values in choices.items()):
        raise ValueError("a setting is unknown")
    if not (0 <= settings.sh_degree <= 3 and 1 <= settings.offsets <= 1000 and settings.max_anchors >= 1):
        raise ValueError("a setting is out of range")
    np.random.default_rng().bit_generator.state = state["rng"]


def _check_tensors(tensors: Mapping[str, np.ndarray], expected: Expected) -> None:
    for name, (dtype, shape) in expected.items():
        kind = tensors.kind(name) if isinstance(tensors, Stored) else (tensors[name].dtype, tensors[name].shape)
        if kind != (dtype, shape):
            raise ValueError(f"{name} is {kind[0]} {kind[1]}, expected {np.dtype(dtype)} {shape}")
        if np.dtype(dtype).kind == "f" and not _is_finite(tensors, name, shape[0]):
            raise ValueError(f"{name} is not finite")


def _is_finite(tensors: Mapping[str, np.ndarray], name: str, length: int) -> bool:
    """Return whether all values of a tensor with this number of rows are finite; of a file, blocks are read."""
    if not isinstance(tensors, Stored):
        return bool(np.isfinite(tensors[name]).all())
    blocks = (tensors.part(name, first, first + _BLOCK) for first in range(0, length, _BLOCK))
    return all(np.isfinite(block).all() for block in blocks)


def _check_head_moments(tensors: Mapping[str, np.ndarray], shapes: Sequence[tuple[int, ...]]) -> None:
    """Check the state of the heads' optimizer; shapes: those of its parameters, in order."""
    for i, shape in enumerate(shapes):
        if checkpoint_name(i, STEP) in tensors:
            # A scalar is stored with one dimension.
            kinds: Expected = {checkpoint_name(i, name): (np.float32, shape) for name in MOMENTS}
            _check_tensors(tensors, {**kinds, checkpoint_name(i, STEP): (np.float32, (1,))})
