"""Splats of other programs as SPZ and .splat: what the writers write, what others write, and damaged files."""

from __future__ import annotations

import gzip
import os
import struct

import numpy as np
import pytest

from backend.export import read_foreign_splats, read_splats, write_splat, write_splats, write_spz
from backend.model.splats import Splats
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import read_objects, write_objects
from backend.shared.splats.blending import EPS_2D, USUAL_EPS_2D
from backend.shared.splats.spherical_harmonics import C0

from .command_result import assert_rejected
from .test_edit_export import assert_close, folder, read_spz, some_splats  # noqa: F401


def spz(version=3, count=1, degree=0, bits=8, body=b"", magic=0x5053474E, flags=0):
    """Return the bytes of an SPZ file."""
    return gzip.compress(struct.pack("<IIIBBBB", magic, version, count, degree, bits, flags, 0) + body)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_round_trip(tmp_path, degree):
    splats = some_splats(degree=degree)
    splats.quats[:4] = np.eye(4)
    write_spz(tmp_path / "a.spz", splats)
    found, warnings = read_foreign_splats(tmp_path / "a.spz")
    assert warnings == [] and found.degree == degree
    assert_close(found, splats, 0.02)
    np.testing.assert_allclose(found.sh[:, 1:], splats.sh[:, 1:], atol=0.004)
    mine = read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(found.means, mine.means, atol=1e-7)
    np.testing.assert_allclose(found.quats, mine.quats, atol=1e-6)
    np.testing.assert_allclose(found.sh, mine.sh, atol=1e-6)
    write_spz(tmp_path / "b.spz", found)
    assert gzip.decompress((tmp_path / "b.spz").read_bytes()) == gzip.decompress((tmp_path / "a.spz").read_bytes())


def test_spz_of_version_2(tmp_path):
    """Version 2 stores x, y and z of a quaternion in a byte each."""
    splats = some_splats(degree=1)
    splats.quats *= np.where(splats.quats[:, :1] < 0, -1, 1).astype(np.float32)
    write_spz(tmp_path / "a.spz", splats)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    start, count = 16 + 16 * len(splats), len(splats)
    xyz = np.rint((splats.quats[:, 1:] + 1) * 127.5).astype(np.uint8)
    data = struct.pack("<II", 0x5053474E, 2) + data[8:start] + xyz.tobytes() + data[start + 4 * count :]
    (tmp_path / "b.SPZ").write_bytes(gzip.compress(data))
    found, warnings = read_foreign_splats(tmp_path / "b.SPZ")
    assert warnings == []
    np.testing.assert_allclose(found.means, splats.means, atol=1e-5)
    np.testing.assert_allclose(found.quats[:, 1:], splats.quats[:, 1:], atol=0.02)
    np.testing.assert_allclose(found.sh[:, 1:], splats.sh[:, 1:], atol=0.004)
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, atol=1e-6)


def test_spz_of_degree_4_keeps_degree_3(tmp_path):
    rng = np.random.default_rng(0)
    sh = rng.integers(0, 256, (2, 24, 3), np.uint8)
    body = bytes(9 * 2) + bytes([200] * 2) + bytes([127] * 6) + bytes([100] * 6) + bytes(8) + sh.tobytes()
    (tmp_path / "a.spz").write_bytes(spz(count=2, degree=4, body=body))
    found, warnings = read_foreign_splats(tmp_path / "a.spz")
    assert found.degree == 3 and "degree 4" in warnings[0]
    np.testing.assert_allclose(found.sh[:, 1:], (sh[:, :15].astype(float) - 128) / 128)


def test_spz_positions_have_a_sign_and_fractional_bits(tmp_path):
    fixed = [-1, 1, -(2**23), 2**23 - 1, 0, 300]
    body = b"".join(value.to_bytes(3, "little", signed=True) for value in fixed) + bytes(2 + 6 + 6 + 8)
    (tmp_path / "a.spz").write_bytes(spz(count=2, bits=4, body=body))
    np.testing.assert_allclose(read_foreign_splats(tmp_path / "a.spz")[0].means.ravel(), np.array(fixed) / 16)


@pytest.mark.parametrize(("flags", "blur"), [(0, USUAL_EPS_2D), (1, EPS_2D), (2, USUAL_EPS_2D), (3, EPS_2D)])
def test_antialiased_spz_is_not_blurred_more(tmp_path, flags, blur):
    (tmp_path / "a.spz").write_bytes(spz(body=bytes(20), flags=flags))
    assert read_foreign_splats(tmp_path / "a.spz")[0].blur == blur


def test_splat_round_trip(tmp_path):
    splats = some_splats(degree=0)
    splats.sh = np.clip(splats.sh, -1.5, 1.5)
    write_splat(tmp_path / "a.splat", splats)
    found, warnings = read_foreign_splats(tmp_path / "a.splat")
    assert warnings == [] and found.degree == 0 and len(found) == len(splats)
    order = np.argsort(-splats.opacities * splats.scales.prod(1) ** (1 / 3), kind="stable")
    wanted = splats.select(order)
    np.testing.assert_array_equal(found.means, wanted.means)
    np.testing.assert_allclose(found.scales, wanted.scales, rtol=1e-6)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.002)
    np.testing.assert_allclose(found.sh, wanted.sh, atol=0.51 / 255 / C0)
    # 128 of 128 does not fit into a byte.
    np.testing.assert_allclose(found.quats, wanted.quats, atol=0.012)
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, atol=1e-6)


def test_splat_rows_that_cannot_be_used_are_dropped(tmp_path):
    rows = np.zeros(5, [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    rows["scale"], rows["rgba"], rows["quat"] = 0.1, 255, (255, 128, 128, 128)
    rows["mean"][0] = np.nan
    rows["scale"][1] = np.inf
    rows["quat"][2] = 128
    rows["scale"][3], rows["rgba"][3] = -1, 0
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    found, warnings = read_foreign_splats(tmp_path / "a.splat")
    assert len(found) == 2 and "3 of 5 splats in a.splat were dropped" in warnings[0]
    assert (found.scales > 0).all() and ((found.opacities > 0) & (found.opacities < 1)).all()


@pytest.mark.parametrize("kind", ["spz", "splat"])
def test_import_restores_what_export_wrote(run_command, folder, tmp_path, kind):  # noqa: F811
    """In the capture's coordinates, whatever the axes of the format."""
    write_splats(folder.splats, some_splats(degree=0))
    assert run_command("export", folder.folder, "--out", tmp_path / f"all.{kind}").code == EXIT_DONE
    made = Reconstruction(tmp_path / "imported")
    result = run_command("import-splats", tmp_path / f"all.{kind}", "--out", made.folder, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["splats"] == 60 and result.events[-1]["objects"] == 0
    found, wanted = read_splats(made.splats)[0], read_splats(folder.splats)[0]
    assert found.blur == USUAL_EPS_2D and wanted.blur == EPS_2D
    order, others = np.lexsort(np.round(found.means, 3).T), np.lexsort(np.round(wanted.means, 3).T)
    found, wanted = found.select(order), wanted.select(others)
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-4)
    np.testing.assert_allclose(found.scales, wanted.scales, rtol=0.04)
    assert (np.abs((found.quats * wanted.quats).sum(1)) > 0.999).all()


def test_import_of_spz_assigns_ids_from_masks(run_command, write_capture, tmp_path):
    scene = write_capture(views=9, points=200)
    splats = some_splats(n=len(scene.xyz), degree=0)
    splats.means, splats.object_ids = scene.xyz.astype(np.float32), np.zeros(len(scene.xyz), np.int64)
    made, out = Reconstruction(tmp_path / "made").create(), tmp_path / "imported"
    write_splats(made.splats, splats)
    write_objects(made.objects, [])
    assert run_command("export", made.folder, "--out", tmp_path / "all.spz").code == EXIT_DONE
    assert run_command("import-splats", tmp_path / "all.spz", "--out", out, "--capture", scene.folder).code == EXIT_DONE
    assert (read_splats(out / "splats.ply")[0].object_ids == scene.point_objects).mean() > 0.95
    assert [entry.name for entry in read_objects(out / "objects.json")] == ["sphere 1", "sphere 2", "sphere 5"]


def test_refused_import_leaves_the_cameras_of_another_one(run_command, write_capture, tmp_path):
    scene, other = write_capture(views=6, points=60), write_capture("other", views=4, points=60)
    splats, out = some_splats(n=len(scene.xyz), degree=0), tmp_path / "imported"
    for name, place in (("a.ply", 0), ("b.ply", 1000)):
        splats.means = (scene.xyz + place).astype(np.float32)
        write_splats(tmp_path / name, splats)
    assert run_command("import-splats", tmp_path / "a.ply", "--out", out, "--capture", scene.folder).code == EXIT_DONE
    before = (out / "cameras.json").read_bytes()
    result = run_command("import-splats", tmp_path / "b.ply", "--out", out, "--capture", other.folder)
    assert_rejected(result, "Only 0% of the splats lie in the views of")
    assert (out / "cameras.json").read_bytes() == before


BOMB = struct.pack("<IIIBBBB", 0x5053474E, 3, 2**32 - 1, 3, 8, 0, 0) + bytes(1 << 20)
BAD = {
    "a.spz: empty": (b"", ("not an SPZ",)),
    "a.spz: not gzip": (b"ply\n" * 9, ("damaged or not an SPZ",)),
    "a.spz: magic": (spz(magic=1), ("not an SPZ",)),
    "a.spz: short header": (gzip.compress(b"NGSP"), ("not an SPZ",)),
    "a.spz: version 1": (spz(version=1), ("version 1", "2 and 3")),
    "a.spz: version 4": (spz(version=4), ("version 4", "as PLY", "splat-transform a.spz a.ply")),
    "a.spz: plain version 4": (struct.pack("<II", 0x5053474E, 4) + bytes(50), ("version 4", "PLY")),
    "a.spz: degree": (spz(degree=5), ("damaged SPZ header",)),
    "a.spz: bits": (spz(bits=200), ("damaged SPZ header",)),
    "a.spz: truncated": (spz(count=3, body=bytes(59)), ("is truncated", "3 splats")),
    "a.spz: cut": (spz(count=3000, body=os.urandom(60_000))[:30_000], ("is truncated",)),
    "a.spz: bomb": (gzip.compress(BOMB), ("4,294,967,295 splats",)),
    "a.spz: none": (spz(count=0), ("contains no splats",)),
    "a.splat: truncated": (bytes(33), ("33 bytes", "32")),
    "a.splat: empty": (b"", ("contains no splats",)),
    "a.splat: all zero": (bytes(64), ()),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused(run_command, tmp_path, what):
    data, words = BAD[what]
    path = tmp_path / what.split(":")[0]
    path.write_bytes(data)
    if what.endswith("all zero"):
        assert run_command("import-splats", path, "--out", tmp_path / "out").code == EXIT_DONE
        return
    assert_rejected(run_command("import-splats", path, "--out", tmp_path / "new" / "out"), str(path), *words)
    assert not (tmp_path / "new").exists()


def test_refused_splats_are_explained(run_command, tmp_path):
    splats = some_splats(n=1)
    write_splats(tmp_path / "a.ply", splats)
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(splats.means.tobytes()[:4], np.float32(np.nan).tobytes()))
    result = run_command("import-splats", tmp_path / "a.ply", "--out", tmp_path / "out")
    assert_rejected(result, "contains no splats", "1 of 1 splats in a.ply were dropped")


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such files")
@pytest.mark.parametrize("name", ["a.spz", "a.splat"])
def test_special_files_are_refused(run_command, tmp_path, name):
    assert_rejected(run_command("import-splats", tmp_path / name, "--out", tmp_path / "out"), name, "cannot be read")
    os.mkfifo(tmp_path / name)
    assert_rejected(run_command("import-splats", tmp_path / name, "--out", tmp_path / "out"), name, "pipe")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a.spz", "a.splat"])
def test_damaged_files_raise_only_input_errors(tmp_path, name):
    path, rng = tmp_path / name, np.random.default_rng(0)
    (write_spz if name == "a.spz" else write_splat)(path, some_splats(degree=0))
    whole = path.read_bytes()
    plain = gzip.decompress(whole) if name == "a.spz" else whole
    for trial in range(100):
        data = bytearray(plain)
        data = data[: rng.integers(len(data))] if trial % 2 else data
        for _ in range(trial % 5):
            if len(data):
                data[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(gzip.compress(bytes(data)) if name == "a.spz" else data)
        try:
            found = read_foreign_splats(path)[0]
        except InputError:
            continue
        assert isinstance(found, Splats) and np.isfinite(found.means).all() and np.isfinite(found.scales).all()
