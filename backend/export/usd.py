"""Export of splats as USD, each object a prim of the type ParticleField3DGaussianSplat of OpenUSD 26.03 and later."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..model.splats import Splats, objects_of
from ..shared.errors import InputError
from ..shared.formats.atomic import atomic_path, replace_file
from ..shared.formats.file_names import distinct_stems

ROOT = "/splats"
"""Path of the prim above those of the objects."""

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
    # No other command needs the package, and an environment of the user's may lack it.
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdVol, Vt
    except ImportError as error:
        raise InputError(
            f"{path} cannot be written, since the backend's Python lacks the package usd-core; install it, or export "
            "as glTF."
        ) from error

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
    objects = objects_of(splats)
    prims = _prim_names({object_id: names[object_id] for object_id, _, _ in objects})
    for object_id, part, center in objects:
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{ROOT}/{prims[object_id]}")
        prim = field.GetPrim()
        prim.SetDisplayName(names[object_id])
        prim.CreateAttribute("userProperties:object_id", Sdf.ValueTypeNames.Int64, custom=True).Set(object_id)
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


def _prim_names(names: Mapping[int, str]) -> dict[int, str]:
    """Return distinct names of prims in ASCII, as older programs need them: letters, digits and underscores."""
    stems = distinct_stems({i: re.sub(r"[^A-Za-z0-9]+", "_", name) for i, name in names.items()})
    plain = {i: stem.replace("-", "_") for i, stem in stems.items()}
    return {i: f"_{name}" if name[0].isdigit() else name for i, name in plain.items()}


def _float32(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
