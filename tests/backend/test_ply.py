"""Splat PLY files: exact bytes, an independent reader, and files of other programs."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from backend.export import read_splats, write_splat_parts, write_splats
from backend.model.splats import Splats, concatenate
from backend.shared.errors import InputError
from backend.shared.formats.ply import read_vertices, write_vertices
from backend.shared.formats.splat_ply import Description, read_description, read_splat_table
from backend.shared.splats.blending import EPS_2D, USUAL_EPS_2D


def some_splats(n=5, degree=1, seed=0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Splats(
        means=rng.normal(size=(n, 3)).astype(dtype),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.normal(-3, 1, (n, 3))),
        opacities=rng.uniform(0.01, 0.99, n),
        sh=rng.normal(size=(n, (degree + 1) ** 2, 3)).astype(np.float32),
        object_ids=rng.integers(0, 2**32, n),
    )


def parse(data):
    """Parse PLY bytes with struct alone; return (property names, rows of values)."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    row = struct.Struct(
        "<" + "".join({"float": "f", "double": "d", "uint": "I", "uchar": "B"}[p[0]] for p in properties)
    )
    assert len(body) == row.size * count
    return [name for _, name in properties], [row.unpack_from(body, i * row.size) for i in range(count)]


def foreign(path, names, rows, kinds=None, order="<"):
    """Write a PLY with any property names in any order, as another program might."""
    kinds = kinds or {}
    word = {"f": "float", "d": "double", "I": "uint", "B": "uchar"}
    row = struct.Struct(order + "".join(kinds.get(name, "f") for name in names))
    head = ["ply", f"format binary_{'little' if order == '<' else 'big'}_endian 1.0", "comment made elsewhere"]
    head += [f"element vertex {len(rows)}", *(f"property {word[kinds.get(name, 'f')]} {name}" for name in names)]
    data = "\n".join([*head, "end_header", ""]).encode() + b"".join(row.pack(*values) for values in rows)
    path.write_bytes(data)
    return path


MINIMAL = ["opacity", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2"]
MINIMAL += ["f_dc_2", "f_dc_1", "f_dc_0", "z", "y", "x"]
ROW = dict(
    x=1, y=2, z=3, f_dc_0=0.1, f_dc_1=0.2, f_dc_2=0.3, opacity=0, scale_0=0, scale_1=-1, scale_2=-2,
    rot_0=2, rot_1=0, rot_2=0, rot_3=0,
)  # fmt: skip


def minimal(path, *changes, names=MINIMAL, **options):
    return foreign(path, names, [[{**ROW, **change}[name] for name in names] for change in changes], **options)


def test_single_splat_has_expected_bytes(tmp_path):
    splats = Splats(
        means=np.array([[1, 2, 3]], np.float32),
        quats=np.array([[0.5, -0.5, 0.5, 0.5]], np.float32),
        scales=np.array([[1.0, np.e, np.e**2]]),
        opacities=np.array([0.5]),
        sh=np.arange(12, dtype=np.float32).reshape(1, 4, 3),
        object_ids=np.array([2**32 - 1]),
    )
    assert write_splats(tmp_path / "splats.ply", splats) == []
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat binary_little_endian 1.0\ncomment low_pass 0.05\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in names) + "property uint object_id\nend_header\n"
    rest = [3, 6, 9, 4, 7, 10, 5, 8, 11]
    values = [1, 2, 3, 0, 0, 0, 0, 1, 2, *rest, 0, 0, 1, 2, 0.5, -0.5, 0.5, 0.5]
    assert (tmp_path / "splats.ply").read_bytes() == header.encode() + struct.pack("<26fI", *values, 2**32 - 1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_independent_reader_gets_written_values(tmp_path, degree):
    splats = some_splats(degree=degree)
    write_splats(tmp_path / "a.ply", splats)
    names, rows = parse((tmp_path / "a.ply").read_bytes())
    assert len(names) == 18 + 3 * ((degree + 1) ** 2 - 1)
    for i, row in enumerate(rows):
        value = dict(zip(names, row))
        assert [value[c] for c in "xyz"] == splats.means[i].tolist()
        assert [value[f"rot_{j}"] for j in range(4)] == splats.quats[i].tolist()
        assert np.exp([value[f"scale_{j}"] for j in range(3)]) == pytest.approx(splats.scales[i], rel=1e-6)
        assert 1 / (1 + np.exp(-value["opacity"])) == pytest.approx(splats.opacities[i], rel=1e-6)
        assert [value[f"f_dc_{c}"] for c in range(3)] == splats.sh[i, 0].tolist()
        rest = [value[f"f_rest_{j}"] for j in range(splats.sh[i, 1:].size)]
        assert rest == splats.sh[i, 1:].T.reshape(-1).tolist()
        assert value["object_id"] == splats.object_ids[i]


@pytest.mark.parametrize("degree", [0, 3])
def test_splats_round_trip(tmp_path, degree):
    splats = some_splats(n=70_000, degree=degree)
    write_splats(tmp_path / "a.ply", splats)
    again, warnings = read_splats(tmp_path / "a.ply")
    assert warnings == []
    for name in ("means", "quats", "sh", "object_ids"):
        assert np.array_equal(getattr(again, name), getattr(splats, name)), name
        assert getattr(again, name).dtype == getattr(splats, name).dtype, name
    np.testing.assert_allclose(again.scales, splats.scales, rtol=1e-6)
    np.testing.assert_allclose(again.opacities, splats.opacities, rtol=1e-6)
    write_splats(tmp_path / "b.ply", again)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_unobserved_splats_are_marked(tmp_path):
    splats = some_splats(n=5)
    splats.unobserved = np.array([0, 1, 0, 0, 1], bool)
    write_splats(tmp_path / "a.ply", splats)
    table = read_vertices(tmp_path / "a.ply")
    assert table.dtype.names[-2:] == ("object_id", "unobserved") and table["unobserved"].tolist() == [0, 1, 0, 0, 1]
    splats.sh[0, 0, 0] = np.nan
    write_splats(tmp_path / "a.ply", splats)
    assert read_splats(tmp_path / "a.ply")[0].unobserved.tolist() == [True, False, False, True]
    write_splats(tmp_path / "b.ply", splats, with_ids=False)
    assert read_vertices(tmp_path / "b.ply").dtype.names[-1] == "rot_3"
    both = concatenate([splats, some_splats(n=2, degree=2)])
    assert both.unobserved.tolist() == [*splats.unobserved.tolist(), False, False]


def test_empty_splats_round_trip(tmp_path):
    write_splats(tmp_path / "a.ply", Splats.empty(2))
    again, warnings = read_splats(tmp_path / "a.ply")
    assert len(again) == 0 and again.degree == 2 and warnings == []


def test_distant_positions_use_double(tmp_path):
    splats = some_splats(n=50, dtype=np.float64)
    splats.means += 1e6
    write_splats(tmp_path / "far.ply", splats)
    assert (
        b"property double x\nproperty double y\nproperty double z\nproperty float nx"
        in (tmp_path / "far.ply").read_bytes()
    )
    assert np.array_equal(read_splats(tmp_path / "far.ply")[0].means, splats.means)
    splats.means -= 1e6
    write_splats(tmp_path / "near.ply", splats)
    assert b"double" not in (tmp_path / "near.ply").read_bytes()


def test_extreme_opacities_and_scales_stay_finite(tmp_path):
    splats = some_splats(n=3)
    splats.opacities = np.array([0.0, 1.0, 0.5])
    splats.scales[0, 0] = 0.0
    write_splats(tmp_path / "a.ply", splats)
    _, rows = parse((tmp_path / "a.ply").read_bytes())
    assert np.isfinite(rows).all()
    again, warnings = read_splats(tmp_path / "a.ply")
    assert warnings == [] and len(again) == 3
    assert again.opacities == pytest.approx(splats.opacities, abs=2e-7)
    assert (again.opacities > 0).all() and (again.opacities < 1).all() and (again.scales > 0).all()


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nonfinite_splats_are_not_written(tmp_path, name, value):
    splats = some_splats(n=4)
    getattr(splats, name)[2] = value
    warnings = write_splats(tmp_path / "a.ply", splats)
    assert len(warnings) == 1 and "1 of 4" in warnings[0]
    assert np.array_equal(read_splats(tmp_path / "a.ply")[0].object_ids, splats.object_ids[[0, 1, 3]])


def test_parts_are_written_as_the_whole(tmp_path):
    splats = some_splats(n=9, dtype=np.float64)
    splats.means += 1e6
    splats.unobserved[8] = True
    splats.quats[3:5] = 0
    expected = write_splats(tmp_path / "whole.ply", splats)
    parts = [splats.select(slice(*ends)) for ends in ((0, 3), (3, 3), (3, 5), (5, 9))]
    count, warnings = write_splat_parts(tmp_path / "whole-in-parts.ply", lambda: parts)
    assert count == 7 and warnings == [sentence.replace("whole.ply", "whole-in-parts.ply") for sentence in expected]
    assert (tmp_path / "whole-in-parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    passes = iter([parts, parts[:3]])
    before = (tmp_path / "whole.ply").read_bytes()
    with pytest.raises(ValueError, match="7 vertices, not 3"):
        write_splat_parts(tmp_path / "whole.ply", lambda: next(passes))
    assert (tmp_path / "whole.ply").read_bytes() == before


def test_ids_beyond_32_bits_are_rejected(tmp_path):
    splats = some_splats(n=2)
    splats.object_ids[0] = 2**32
    with pytest.raises(ValueError, match="2\\^32"):
        write_splats(tmp_path / "a.ply", splats)
    assert list(tmp_path.iterdir()) == []


def test_failed_write_keeps_old_file(tmp_path, monkeypatch):
    write_splats(tmp_path / "a.ply", some_splats(n=2))
    before = (tmp_path / "a.ply").read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_splats(tmp_path / "a.ply", some_splats(n=3))
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert (tmp_path / "a.ply").read_bytes() == before


@pytest.mark.parametrize("order", ["<", ">"])
def test_foreign_property_order_and_endianness_are_read(tmp_path, order):
    splats, warnings = read_splats(minimal(tmp_path / "a.ply", {}, {"x": 9}, order=order))
    assert warnings == []
    assert splats.means.tolist() == [[1, 2, 3], [9, 2, 3]]
    assert splats.quats.tolist() == [[1, 0, 0, 0]] * 2
    assert splats.scales[0] == pytest.approx([1, np.exp(-1), np.exp(-2)])
    assert splats.opacities[0] == 0.5
    assert splats.sh[0, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert splats.object_ids.tolist() == [0, 0]
    assert splats.blur == USUAL_EPS_2D


@pytest.mark.parametrize(("comment", "blur"), [("0.1", 0.1), ("wide", 0.3), ("-1", 0.3), ("nan", 0.3), ("", 0.3)])
def test_filter_is_that_of_the_file(tmp_path, comment, blur):
    path = tmp_path / "a.ply"
    write_splats(path, replace(some_splats(n=3), blur=0.05))
    path.write_bytes(path.read_bytes().replace(b"low_pass 0.05", f"low_pass {comment}".encode()))
    assert read_splats(path)[0].select([0, 2]).with_degree(0).blur == blur


@pytest.mark.parametrize(
    ("comment", "blur"),
    [
        ("antialiased 1", EPS_2D),
        (" SplatRenderMode:  MIP ", EPS_2D),
        ("antialiased 0", USUAL_EPS_2D),
        ("SplatRenderMode: default", USUAL_EPS_2D),
        ("SplatRenderMode: mip\ncomment low_pass 0.1", 0.1),
    ],
)
def test_antialiased_splats_are_not_blurred_more(tmp_path, comment, blur):
    path = minimal(tmp_path / "a.ply", {})
    path.write_bytes(path.read_bytes().replace(b"made elsewhere", comment.encode()))
    assert read_splats(path)[0].blur == blur


def test_description_is_that_of_the_comments(tmp_path):
    told = Description([0.0, -0.6, 0.8], [0.0, 0.5, 1.0], {0: "", 7: 'Käse "7"\n\u2028', 2**32 - 1: "x"})
    write_splats(tmp_path / "a.ply", some_splats(), description=told)
    assert read_description(tmp_path / "a.ply") == told
    write_splats(tmp_path / "a.ply", some_splats(), description=Description(names={i: "x" * 99 for i in range(9999)}))
    assert read_description(tmp_path / "a.ply") == Description()
    odd = [
        "up 0 0 0",
        "up 1 2",
        "up 1 2 x",
        "up 9e299 0 0",
        "background 1 nan 1",
        "object",
        "object x y",
        "object 1 y",
        'object 1 "y',
    ]
    path = minimal(tmp_path / "b.ply", {})
    path.write_bytes(path.read_bytes().replace(b"made elsewhere", "\ncomment ".join(odd).encode()))
    assert read_description(path) == Description() and len(read_splats(path)[0]) == 1
    path = minimal(tmp_path / "c.ply", {})
    path.write_bytes(path.read_bytes().replace(b"made elsewhere", b'object 1 "a\\ud83d"'))
    assert read_description(path).names == {1: "a?"}, "half a surrogate pair cannot be written again"


def test_unknown_properties_are_ignored_and_doubles_kept(tmp_path):
    names = [*MINIMAL, "red", "object_id"]
    kinds = {"x": "d", "y": "d", "z": "d", "red": "B", "object_id": "I"}
    change = {"x": 1e9 + 0.125, "red": 3, "object_id": 70_000}
    splats, _ = read_splats(minimal(tmp_path / "a.ply", change, names=names, kinds=kinds))
    assert splats.means[0, 0] == 1e9 + 0.125
    assert splats.object_ids.tolist() == [70_000]


def test_degree_4_is_read_as_degree_3(tmp_path):
    names = [*MINIMAL, *(f"f_rest_{i}" for i in range(72))]
    path = minimal(tmp_path / "a.ply", {f"f_rest_{i}": i for i in range(72)}, names=names)
    splats, warnings = read_splats(path)
    assert splats.degree == 3 and warnings == ["a.ply has spherical harmonics of degree 4, of which 3 are kept."]
    assert splats.sh[0, 1:].T.tolist() == [[start + i for i in range(15)] for start in (0, 24, 48)]
    with pytest.raises(InputError, match="72 properties"):
        read_splat_table(path)


def test_discs_without_a_third_scale_are_read(tmp_path):
    names = [name for name in MINIMAL if name != "scale_2"]
    splats, warnings = read_splats(minimal(tmp_path / "a.ply", {}, {"scale_0": -3}, names=names))
    assert warnings == []
    np.testing.assert_allclose(splats.scales, np.exp([[0, -1, -1], [-3, -1, -3]]) * [1, 1, 0.001])
    with pytest.raises(InputError, match="no property scale_2"):
        read_splat_table(tmp_path / "a.ply")
    with pytest.raises(InputError, match="no property scale_0, scale_2"):
        read_splats(minimal(tmp_path / "a.ply", {}, names=[name for name in names if name != "scale_0"]))


def test_float_ids_are_read_and_invalid_ones_become_0(tmp_path):
    names = [*MINIMAL, "object_id"]
    rows = [{"object_id": 7.0}, {"object_id": -1.0}, {"object_id": np.nan}]
    splats, warnings = read_splats(minimal(tmp_path / "a.ply", *rows, names=names))
    assert splats.object_ids.tolist() == [7, 0, 0]
    assert len(warnings) == 1 and warnings[0].startswith("2 splats")


@pytest.mark.parametrize(
    "bad",
    [
        {"x": np.nan},
        {"z": np.inf},
        {"f_dc_1": -np.inf},
        {"opacity": np.nan},
        {"scale_1": np.inf},
        {"scale_2": 1e4},
        {"rot_3": np.nan},
        {"rot_0": 0},
    ],
)
def test_nonfinite_rows_are_dropped_with_warning(tmp_path, bad):
    splats, warnings = read_splats(minimal(tmp_path / "a.ply", {"x": 10}, bad, {"x": 30}))
    assert splats.means[:, 0].tolist() == [10, 30]
    assert len(warnings) == 1 and "1 of 3" in warnings[0] and "a.ply" in warnings[0]
    assert all(np.isfinite(getattr(splats, name)).all() for name in ("means", "quats", "scales", "opacities", "sh"))


def test_infinite_logits_and_flat_axes_are_kept(tmp_path):
    rows = [{"opacity": np.inf}, {"opacity": -np.inf}, {"scale_2": -np.inf}]
    splats, warnings = read_splats(minimal(tmp_path / "a.ply", *rows))
    assert warnings == [] and splats.opacities == pytest.approx([1, 0, 0.5], abs=2e-7)
    assert splats.scales[2] == pytest.approx([1, np.exp(-1), 0]) and splats.scales[2, 2] > 0


def test_truncated_file_is_reported(tmp_path):
    write_splats(tmp_path / "a.ply", some_splats(n=10))
    data = (tmp_path / "a.ply").read_bytes()
    for keep in (len(data) - 1, len(data) // 2, 200, 3, 0):
        (tmp_path / "cut.ply").write_bytes(data[:keep])
        with pytest.raises(InputError, match=r"cut\.ply"):
            read_splats(tmp_path / "cut.ply")
    (tmp_path / "cut.ply").write_bytes(data[:-1])
    with pytest.raises(InputError, match="specifies 10 vertices, but only 9"):
        read_splats(tmp_path / "cut.ply")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "ASCII"),
        ("solid cube\n", "not a PLY"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no property y"),
        ("ply\nformat binary_little_endian 1.0\nend_header\n", "no vertices"),
        (
            "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
            "plain number",
        ),
        (
            "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
            "property uint packed_position\nend_header\n",
            "compressed PLY of PlayCanvas or SuperSplat",
        ),
        ("ply\nformat binary_little_endian 1.0\nelement face 1\nproperty float x\nelement vertex 1\n", "PLY header"),
    ],
)
def test_non_splat_files_are_rejected(tmp_path, text, why):
    path = tmp_path / "odd.ply"
    path.write_text(text)
    with pytest.raises(InputError, match=why) as caught:
        read_splats(path)
    assert "odd.ply" in str(caught.value) and "\n" not in str(caught.value)


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(InputError, match=r"none\.ply"):
        read_splats(tmp_path / "none.ply")


@pytest.mark.parametrize("order", ["<", ">"])
def test_table_of_all_types_round_trip(tmp_path, order):
    kinds = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
    table = np.zeros(3, np.dtype([(f"p{kind}", order + kind) for kind in kinds], align=True))
    for kind in kinds:
        limits = np.finfo(kind) if kind[0] == "f" else np.iinfo(kind)
        table[f"p{kind}"] = limits.min, limits.max, 1
    write_vertices(tmp_path / "a.ply", table)
    again = read_vertices(tmp_path / "a.ply")
    assert again.dtype == np.dtype([(f"p{kind}", "<" + kind) for kind in kinds])
    assert again.tolist() == table.tolist()
    write_vertices(tmp_path / "a.ply", table[:0])
    assert len(read_vertices(tmp_path / "a.ply")) == 0


def test_unsupported_table_keeps_old_file(tmp_path):
    write_vertices(tmp_path / "a.ply", np.zeros(1, [("x", "f4")]))
    before = (tmp_path / "a.ply").read_bytes()
    for field in ("i8", ("f4", 3), "U3"):
        with pytest.raises(ValueError, match="property wide"):
            write_vertices(tmp_path / "a.ply", np.zeros(1, [("x", "f4"), ("wide", field)]))
    assert (tmp_path / "a.ply").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_elements_after_vertices_are_ignored(tmp_path):
    path = tmp_path / "mesh.ply"
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nelement face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head.encode() + struct.pack("<fB3i", 2.5, 3, 0, 0, 0))
    assert read_vertices(path).tolist() == [(2.5,)]


def test_select_and_concatenate():
    a, b = some_splats(n=4, degree=0), some_splats(n=3, degree=2, seed=1)
    both = concatenate([a, b])
    assert len(both) == 7 and both.degree == 2
    assert np.array_equal(both.sh[:4, :1], a.sh) and (both.sh[:4, 1:] == 0).all()
    back = both.select(np.arange(7) >= 4)
    for name in ("means", "quats", "scales", "opacities", "sh", "object_ids"):
        assert np.array_equal(getattr(back, name), getattr(b, name)), name
    back.means += 1
    assert np.array_equal(both.means[4:], b.means)
    assert len(concatenate([])) == 0


def test_arrays_of_wrong_shape_are_rejected():
    good = some_splats(n=2)
    with pytest.raises(ValueError, match="quats"):
        Splats(good.means, good.quats[:, :3], good.scales, good.opacities, good.sh, good.object_ids)
    with pytest.raises(ValueError, match="5 coefficients"):
        Splats(good.means, good.quats, good.scales, good.opacities, np.zeros((2, 5, 3)), good.object_ids)
