"""Import of splats as glTF and USD, of this and of other programs, and damaged files."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdVol
from scipy.spatial.transform import Rotation

from backend.editing import transformed
from backend.export import read_foreign_scene, read_splats
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import read_objects
from backend.shared.splats.blending import EPS_2D, USUAL_EPS_2D

from .command_result import assert_rejected
from .test_edit_export import folder, some_splats  # noqa: F401

IDS = (0, 1, 2, 3, 7)


@pytest.mark.parametrize("kind", ["glb", "usdc"])
def test_exported_scenes_are_imported_with_their_objects(run_command, folder, tmp_path, kind):  # noqa: F811
    run_command("export", folder.folder, "--out", tmp_path / f"a.{kind}", "--coordinates", "blender")
    run_command("export", folder.folder, "--out", tmp_path / "a.ply", "--coordinates", "blender")
    assert run_command("import-splats", tmp_path / f"a.{kind}", "--out", tmp_path / "again").code == EXIT_DONE
    again = Reconstruction(tmp_path / "again")
    found, wanted = read_splats(again.splats)[0], read_splats(tmp_path / "a.ply")[0]
    if kind == "glb":
        wanted = transformed(wanted, np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))
    order = np.argsort(wanted.object_ids, kind="stable")
    np.testing.assert_array_equal(found.object_ids, wanted.object_ids[order])
    np.testing.assert_allclose(found.means, wanted.means[order], atol=1e-6)
    np.testing.assert_allclose(found.scales, wanted.scales[order], rtol=1e-5)
    np.testing.assert_allclose(found.opacities, wanted.opacities[order], atol=1e-6)
    np.testing.assert_allclose(found.sh, wanted.sh[order], atol=1e-5)
    assert found.blur == wanted.blur == EPS_2D
    assert {entry.id: entry.name for entry in read_objects(again.objects) if entry.id} == {
        entry.id: entry.name for entry in read_objects(folder.objects)
    }
    up = np.array(json.loads(again.cameras.read_text())["upright"]["rotation"])[2]
    np.testing.assert_allclose(up, [0, 1, 0] if kind == "glb" else [0, 0, 1], atol=1e-6)


def glb(content, binary):
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(binary), 0x004E4942) + binary


def foreign_gltf():
    """Return the content of a file as of another program: interleaved, of integers, nodes in each other."""
    rows = np.zeros(4, [("p", "<f4", 3), ("r", "i1", 4), ("s", "<f4", 3), ("o", "u1", 4), ("c", "<f4", 3)])
    rows["p"] = np.arange(12).reshape(4, 3)
    rows["r"] = [0, 0, 127, 0]
    rows["s"], rows["o"][:, 0], rows["c"] = 0.5, 51, 0.25
    offsets = [rows.dtype.fields[name][1] for name in rows.dtype.names]
    kinds = [(5126, "VEC3"), (5120, "VEC4"), (5126, "VEC3"), (5121, "SCALAR"), (5126, "VEC3")]
    accessors = [
        {
            "bufferView": 0,
            "byteOffset": at,
            "componentType": kind,
            "type": of,
            "count": 4,
            "normalized": kind != 5126,
        }
        for at, (kind, of) in zip(offsets, kinds)
    ]
    names = [
        "POSITION",
        *(f"KHR_gaussian_splatting:{n}" for n in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")),
    ]
    extension = {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    primitive = {"mode": 0, "attributes": dict(zip(names, range(5))), "extensions": extension}
    turn = Rotation.from_euler("z", 90, degrees=True).as_quat().tolist()
    nodes = [
        {"name": "left", "mesh": 0, "translation": [0, 0, 5]},
        {"children": [0, 2], "rotation": turn, "scale": [2, 2, 2]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 100, 0, 0, 1]},
    ]
    content = {
        "nodes": nodes, "meshes": [{"name": "bush", "primitives": [primitive, {"attributes": {"POSITION": 0}}]}],
        "accessors": accessors, "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize}],
        "buffers": [{"byteLength": rows.nbytes}],
    }  # fmt: skip
    return content, rows.tobytes()


def test_gltf_of_other_programs_keeps_places_and_names(run_command, tmp_path):
    (tmp_path / "a.glb").write_bytes(glb(*foreign_gltf()))
    nodes, warnings, description = read_foreign_scene(tmp_path / "a.glb")
    assert warnings == [] and description.names == {1: "left", 2: "bush"} and description.up == [0, 1, 0]
    first, second = (transformed(node.splats, node.matrix) for node in nodes)
    np.testing.assert_allclose(first.means[1], [-8, 6, 20], atol=1e-6)
    np.testing.assert_allclose(second.means[0], [-2, 200, 4], atol=1e-6)
    np.testing.assert_allclose(first.scales, 1.0)
    np.testing.assert_allclose(first.opacities, 0.2)
    turned = Rotation.from_quat(first.quats, scalar_first=True).apply([1, 0, 0])
    np.testing.assert_allclose(turned, np.tile([0, -1, 0], (4, 1)), atol=1e-6)
    assert run_command("import-splats", tmp_path / "a.glb", "--out", tmp_path / "out").code == EXIT_DONE


def test_damaged_gltf_is_refused(run_command, tmp_path):
    content, binary = foreign_gltf()
    whole, path, rng = glb(content, binary), tmp_path / "a.glb", np.random.default_rng(0)

    def refused(data, words):
        path.write_bytes(data)
        assert_rejected(run_command("import-splats", path, "--out", tmp_path / "out"), "a.glb", words)
        assert not (tmp_path / "out").exists()

    refused(b"", "not a binary glTF")
    refused(whole[:100], "truncated")
    refused(whole[:-20], "truncated")
    refused(glb({**content, "nodes": []}, binary), "has no splats")
    refused(glb({**content, "meshes": []}, binary), "damaged")
    refused(glb({**content, "nodes": [{"mesh": 0, "children": [1]}, {"children": [1]}]}, binary), "below several")
    packed = json.loads(json.dumps(content))
    packed["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["extensions"] = {"SPZ": {}}
    refused(glb(packed, binary), "uncompressed")
    messages = []
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            read_foreign_scene(path)
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > 50 and all(text.endswith(".") and "\n" not in text for text in messages)


def test_usd_of_other_programs_has_the_defaults_of_the_schema(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.Xform.Define(stage, "/w").AddScaleOp().Set(Gf.Vec3f(2))
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/w/tree")
    field.CreatePositionshAttr([Gf.Vec3h(1, 2, 3), Gf.Vec3h(4, 5, 6)])
    UsdVol.ParticleField3DGaussianSplat.Define(stage, "/w/hidden").CreateVisibilityAttr("invisible")
    stage.Save()
    (node,), _, description = read_foreign_scene(tmp_path / "a.usda")
    assert description.up == [0, 1, 0] and node.splats.degree == 0 and node.splats.object_ids.tolist() == [0, 0]
    np.testing.assert_allclose(transformed(node.splats, node.matrix).means, [[2, 4, 6], [8, 10, 12]])
    np.testing.assert_allclose(node.splats.sh, 0.5)
    np.testing.assert_allclose(node.splats.scales, 1)
    assert node.splats.blur == USUAL_EPS_2D


def test_damaged_usd_is_refused(run_command, tmp_path):
    for data, words in ((b"#usda 1.0\n", "has no splats"), (b"garbage", "not a USD file")):
        (tmp_path / "a.usd").write_bytes(data)
        assert_rejected(run_command("import-splats", tmp_path / "a.usd", "--out", tmp_path / "out"), "a.usd", words)
    assert_rejected(
        run_command("import-splats", tmp_path / "b.usdc", "--out", tmp_path / "out"), "b.usdc", "cannot be read"
    )
    assert not (tmp_path / "out").exists()
