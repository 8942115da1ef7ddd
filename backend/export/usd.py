"""Export and import of splats as USD: each object is a ParticleField3DGaussianSplat of OpenUSD 26.03 and later."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model.splats import PlacedSplats, Splats, objects_of
from ..shared.errors import InputError
from ..shared.formats.atomic import atomic_path, replace_file
from ..shared.formats.file_names import distinct_stems
from .gltf import LOW_PASS, low_pass_of
from .ply import DEGREE_KEPT

ROOT = "/splats"
"""Path of the prim above those of the objects."""

_PRIM = "ParticleField3DGaussianSplat"
_OBJECT_ID = "userProperties:object_id"

_REACH = 3.0
"""Radius of a splat in standard deviations, within which almost all of its opacity lies."""


def write_usd(path: Path, splats: Splats, names: Mapping[int, str]) -> list[str]:
    """Write splats as binary USD, atomically.

    Each object is a prim that is moved to the center of its splats, with the ID in `userProperties:object_id`;
    positions are relative to it, so that float32 suffices far from the origin, too. Units are meters, and Z is up, as
    in the USD files of Blender's exporter.

    Args:
        path: The file to write.
        splats: The splats.
        names: object ID -> name, for all IDs of the splats; the display name of the prim.

    Returns:
        No warnings.

    Raises:
        InputError: The package usd-core is missing.
        OSError: The file cannot be written.
    """
    _require_usd(path)
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdVol, Vt

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    layer.customLayerData = {LOW_PASS: splats.blur}
    objects = objects_of(splats)
    prims = _prim_names({object_id: names[object_id] for object_id, _, _ in objects})
    for object_id, part, center in objects:
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{ROOT}/{prims[object_id]}")
        prim = field.GetPrim()
        prim.SetDisplayName(names[object_id])
        prim.CreateAttribute(_OBJECT_ID, Sdf.ValueTypeNames.Int64, custom=True).Set(object_id)
        UsdGeom.XformCommonAPI(prim).SetTranslate(Gf.Vec3d(*center.tolist()))
        means = (part.means - center).astype(np.float32)
        reach = _REACH * part.scales.max(1, keepdims=True)
        extent = np.stack([(means - reach).min(0), (means + reach).max(0)]).astype(np.float32)
        field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
        # Quaternions are stored with their real part last.
        field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(_float32(part.quats[:, [1, 2, 3, 0]])))
        field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(_float32(part.scales)))
        field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_float32(part.opacities)))
        field.CreateRadianceSphericalHarmonicsDegreeAttr(part.degree)
        coefficients = _float32(part.sh.reshape(-1, 3))
        field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(coefficients))
    with atomic_path(path) as part_path:
        # USD takes the format of a file from its suffix.
        written = part_path.with_name(f"{part_path.name}.usdc")
        try:
            if not layer.Export(str(written)):
                raise OSError(0, "USD cannot write it; is the disk full?")
            replace_file(written, part_path)
        except Tf.ErrorException as error:
            # Its message is of several lines and contains the path of the temporary file.
            raise OSError(0, "USD cannot write it; is the disk full?") from error
        finally:
            written.unlink(missing_ok=True)
    return []


def read_usd(path: Path) -> tuple[list[PlacedSplats], str]:
    """Read the splats of a USD file, written by this or another program, at its first time.

    Args:
        path: The file to read: .usd, .usda, .usdc or .usdz.

    Returns:
        The splats of each ParticleField3DGaussianSplat that is visible and not a guide, and the axis that is up, Y or
        Z.

    Raises:
        InputError: The file cannot be read, or has no splats; or the package usd-core is missing.
    """
    _require_usd(path)
    from pxr import Tf, Usd, UsdGeom, UsdVol

    if not path.is_file():
        raise InputError(f"{path} cannot be read (No such file); check it.")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise InputError(f"{path} is not a USD file, or damaged; export it again.") from error
    time = Usd.TimeCode.EarliestTime()
    places = UsdGeom.XformCache(time)
    blur = low_pass_of(stage.GetRootLayer().customLayerData.get(LOW_PASS))
    found = []
    for prim in stage.TraverseAll():
        image = UsdGeom.Imageable(prim)
        if prim.GetTypeName() != _PRIM or image.ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        field = UsdVol.ParticleField3DGaussianSplat(prim)
        matrix = np.array(places.GetLocalToWorldTransform(prim)).T
        object_id = prim.GetAttribute(_OBJECT_ID).Get() if prim.HasAttribute(_OBJECT_ID) else None
        try:
            if not np.isfinite(matrix).all():
                raise ValueError("matrix")
            splats = _splats_of(field, time, blur)
        except ValueError as error:
            raise InputError(f"{path}: attributes of {prim.GetPath()} do not fit together; export it again.") from error
        found.append(PlacedSplats(splats, matrix, prim.GetDisplayName() or prim.GetName(), object_id))
    if not found:
        raise InputError(f"{path} has no splats ({_PRIM}); import its meshes with Blender's own importer.")
    return found, str(UsdGeom.GetStageUpAxis(stage))


def _splats_of(field: Any, time: Any, blur: float) -> Splats:
    """Return the splats of a prim in its own space, with the schema's defaults; raises ValueError for wrong lengths."""

    def values(attribute: Any, half: Any, width: int) -> NDArray | None:
        array = attribute.Get(time) or half.Get(time)
        return np.array(array, np.float32).reshape(-1, width) if array else None

    means = values(field.GetPositionsAttr(), field.GetPositionshAttr(), 3)
    if means is None:
        means = np.zeros((0, 3), np.float32)
    count = len(means)
    turns = field.GetOrientationsAttr().Get(time) or field.GetOrientationshAttr().Get(time) or ()
    quats = np.array([(turn.GetReal(), *turn.GetImaginary()) for turn in turns], np.float32).reshape(-1, 4)
    if len(quats) < count:
        quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    scales = values(field.GetScalesAttr(), field.GetScaleshAttr(), 3)
    if scales is None or len(scales) < count:
        scales = np.ones((count, 3), np.float32)
    opacities = values(field.GetOpacitiesAttr(), field.GetOpacitieshAttr(), 1)
    if opacities is None or len(opacities) < count:
        opacities = np.ones((count, 1), np.float32)
    degree = int(field.GetRadianceSphericalHarmonicsDegreeAttr().Get())
    if degree < 0:
        raise ValueError("degree")
    coefficients = (degree + 1) ** 2
    sh = values(
        field.GetRadianceSphericalHarmonicsCoefficientsAttr(), field.GetRadianceSphericalHarmonicsCoefficientshAttr(), 3
    )
    if sh is None or len(sh) < count * coefficients:
        sh, coefficients = np.full((count, 3), 0.5, np.float32), 1
    sh = sh[: count * coefficients].reshape(count, coefficients, 3)[:, : (DEGREE_KEPT + 1) ** 2]
    ids = np.zeros(count, np.int64)
    return Splats(
        means.astype(np.float64), quats[:count], scales[:count].astype(np.float64),
        opacities[:count, 0].astype(np.float64), sh, ids, blur=blur,
    )  # fmt: skip


def _require_usd(path: Path) -> None:
    """Raise InputError if the package is missing; no other command needs it, and the user's own Python may lack it."""
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"{path} needs the package usd-core, which the backend's Python lacks; install it, or use another format."
        ) from error


def _prim_names(names: Mapping[int, str]) -> dict[int, str]:
    """Return distinct names of prims in ASCII, as older programs need them: letters, digits and underscores."""
    stems = distinct_stems({i: re.sub(r"[^A-Za-z0-9]+", "_", name) for i, name in names.items()})
    plain = {i: stem.replace("-", "_") for i, stem in stems.items()}
    return {i: f"_{name}" if name[0].isdigit() else name for i, name in plain.items()}


def _float32(values: NDArray) -> NDArray:
    return np.ascontiguousarray(values, np.float32)
