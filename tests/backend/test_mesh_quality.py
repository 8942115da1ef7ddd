"""Quality figures of meshes, on shapes with known results, and images of meshes."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import manifold3d
import numpy as np
import pytest
import torch
from PIL import Image

from backend.capture import load_capture
from backend.commands.training import report
from backend.evaluation.mesh_shape import self_intersecting, shape_of
from backend.evaluation.mesh_sheet import Card, camera_for, draw_card, mesh_sheet, save_sheet, view_of
from backend.evaluation.meshes import (
    SampledSurface,
    agreement,
    evaluate_mesh,
    mesh_entries,
    sample_texture,
    texture_score,
)
from backend.evaluation.truth import load_truth
from backend.model.object_model import Normalization
from backend.raster import Camera
from backend.shared.class_table import ClassTable
from backend.shared.errors import EXIT_DONE, InputError
from backend.shared.events import Reporter
from backend.shared.formats.mesh_ply import Mesh, write_mesh
from backend.shared.reconstruction.meshes import MeshEntry


def box(low=(0, 0, 0), high=(1, 1, 1)):
    """Return vertices (8, 3) and outward faces (12, 3) of a box."""
    vertices = np.array(list(itertools.product(*zip(low, high))), float)
    faces = [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]  # fmt: skip
    return vertices, np.array(faces, np.int32)


def sphere(radius=1.0, center=(0, 0, 0), detail=64):
    made = manifold3d.Manifold.sphere(radius, detail).to_mesh()
    return np.array(made.vert_properties[:, :3], float) + center, np.array(made.tri_verts, np.int32)


def joined(*meshes):
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, first)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def textured(vertices, faces, uvs=None, texture="", unobserved=None):
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Mesh(
        vertices, normals.astype(np.float32), np.full((len(vertices), 3), 90, np.uint8), faces,
        np.zeros((len(faces), 3, 2), np.float32) if uvs is None else uvs,
        np.zeros(len(faces), bool) if unobserved is None else unobserved, texture,
    )  # fmt: skip


# --- defects ---------------------------------------------------------------------------------------------------------


def test_box_defects_are_detected():
    vertices, faces = box()
    assert vars(shape_of(vertices, faces)) == {
        "watertight": True, "manifold": True, "components": 1, "self_intersections": 0,
    }  # fmt: skip
    assert not shape_of(vertices, faces[1:]).watertight
    turned = faces.copy()
    turned[3] = turned[3, ::-1]
    assert not shape_of(vertices, turned).watertight
    assert not shape_of(vertices, np.concatenate([faces, faces[:1]])).watertight
    assert shape_of(np.concatenate([vertices, [[9.0, 9, 9]]]), faces).components == 1, (
        "unused vertices are not components"
    )
    two = joined(box(), box((3, 0, 0), (4, 1, 1)))
    assert shape_of(*two).components == 2 and shape_of(*two).manifold


def test_boxes_sharing_a_corner_are_not_manifold():
    vertices, faces = joined(box(), box((1, 1, 1), (2, 2, 2)))
    faces[faces == 8] = 7
    pinched = shape_of(vertices, faces)
    assert (pinched.watertight, pinched.manifold, pinched.components) == (True, False, 1)
    assert pinched.self_intersections == 0


def test_boxes_sharing_an_edge_are_not_watertight():
    vertices, faces = joined(box(), box((1, 1, 0), (2, 2, 1)))
    faces[faces == 8], faces[faces == 9] = 6, 7
    assert not shape_of(vertices, faces).watertight


def test_large_sphere_has_no_defects():
    vertices, faces = sphere(detail=200)
    assert len(faces) > 19_000
    shape = shape_of(vertices + 1e6, faces)
    assert (shape.watertight, shape.manifold, shape.self_intersections) == (True, True, 0)


def test_crossing_boxes_intersect_and_near_ones_do_not():
    cut = self_intersecting(*joined(box(), box((0.3, 0.3, 0.5), (0.6, 0.6, 2))))
    # All 8 wall faces of the pillar cross the lid, but perhaps only one of the lid's two faces.
    assert cut[12:].sum() == 8 and 1 <= cut[:12].sum() <= 2
    assert not self_intersecting(*joined(box(), box((0.3, 0.3, 1.001), (0.6, 0.6, 2)))).any()
    assert not self_intersecting(*joined(box(), box((0.3, 0.3, 0.2), (0.6, 0.6, 0.8)))).any(), "one inside the other"


@pytest.mark.parametrize(
    ("last", "cuts"),
    [
        ((1, 1, 0), False),  # flat neighbors
        ((0.3, 0.3, 0), True),  # folded back onto itself
        ((1, 1, 0.5), False),
        ((0.3, 0.3, 1e-3), False),
    ],
)
def test_folded_neighbors_intersect(last, cuts):
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), last], float)
    assert self_intersecting(vertices, np.array([(0, 1, 2), (2, 1, 3)])).tolist() == [cuts, cuts]


def exactly_intersect(p, q):
    """Return whether two triangles with integer corners intersect beyond shared corners, by exact arithmetic."""

    def minus(a, b):
        return [a[i] - b[i] for i in range(3)]

    def cross(a, b):
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    def dot(a, b):
        return sum(x * y for x, y in zip(a, b))

    def side(a, b, c, d):
        volume = dot(cross(minus(b, a), minus(c, a)), minus(d, a))
        return (volume > 0) - (volume < 0)

    p, q = [[int(x) for x in corner] for corner in p], [[int(x) for x in corner] for corner in q]
    for one, other in ((p, q), (q, p)):
        for k in range(3):
            start, end = one[k], one[(k + 1) % 3]
            if start in other or end in other or side(*other, start) * side(*other, end) >= 0:
                continue
            turns = {side(start, end, other[m], other[(m + 1) % 3]) for m in range(3)}
            if not {1, -1} <= turns:
                return True
    if any(side(*p, corner) for corner in q):
        return False
    normal = cross(minus(p[1], p[0]), minus(p[2], p[0]))
    for one in (p, q):
        for k in range(3):
            axis = cross(normal, minus(one[(k + 1) % 3], one[k]))
            of_p, of_q = [Fraction(dot(axis, c)) for c in p], [Fraction(dot(axis, c)) for c in q]
            if max(of_p) <= min(of_q) or max(of_q) <= min(of_p):
                return False
    return True


def test_intersections_match_exact_arithmetic():
    rng = np.random.default_rng(3)
    corners = rng.integers(0, 4, (60, 3, 3))
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners = corners[(across != 0).any(1)]
    pairs = [
        (i, j) for i, j in itertools.combinations(range(len(corners)), 2) if exactly_intersect(corners[i], corners[j])
    ]
    # Each pair is tested alone, so that the result belongs to that pair.
    for i, j in itertools.combinations(range(0, len(corners), 2), 2):
        found = self_intersecting(corners[[i, j]].reshape(-1, 3).astype(float), np.arange(6).reshape(2, 3))
        assert found.tolist() == [(i, j) in pairs] * 2, corners[[i, j]].tolist()
    together = self_intersecting(corners.reshape(-1, 3) / 7 + 1000, np.arange(3 * len(corners)).reshape(-1, 3))
    assert set(np.flatnonzero(together)) == {i for pair in pairs for i in pair}


# --- distances -------------------------------------------------------------------------------------------------------


def compared(made, wanted):
    a, b = SampledSurface(*made), SampledSurface(*wanted)
    return agreement(b.distances(a.points)[0], a.distances(b.points)[0])


def test_distance_of_concentric_spheres_and_f1_threshold():
    detail = 256
    near, far = (compared(sphere(1 + gap, detail=detail), sphere(1, detail=detail)) for gap in (0.019, 0.021))
    assert near["chamfer"] == pytest.approx(0.019, rel=0.02) and far["chamfer"] == pytest.approx(0.021, rel=0.02)
    assert near["f1"] > 0.999 and far["f1"] < 0.001
    assert near["f1_005"] == 0.0
    same = compared(sphere(1), sphere(1))
    assert same["chamfer"] < 1e-9 and same["f1_005"] == 1.0


def test_half_surface_has_full_precision_and_half_recall():
    vertices, faces = sphere(detail=128)
    half = faces[vertices[faces][:, :, 2].min(1) >= 0]
    found = compared((vertices, half), (vertices, faces))
    assert found["precision"] == 1.0
    assert found["recall"] == pytest.approx(0.5 + 0.02 / 2, abs=0.01)
    assert found["f1"] == pytest.approx(2 * found["recall"] / (1 + found["recall"]))
    assert compared((vertices, faces), (vertices, half))["recall"] == 1.0


def test_sampled_points_are_uniform_and_distances_exact():
    vertices = np.array([(0, 0, 0), (3, 0, 0), (0, 1, 0), (0, 0, 5), (1, 0, 5), (0, 1, 5), (7, 7, 7)], float)
    surface = SampledSurface(vertices, np.array([(0, 1, 2), (3, 4, 5), (6, 6, 6)]))
    assert (surface.points[:, 2] < 1).mean() == pytest.approx(0.75, abs=0.01)
    lower = surface.points[surface.points[:, 2] < 1]
    assert lower.mean(0) == pytest.approx([1, 1 / 3, 0], abs=0.02)
    assert (surface.normals == [0, 0, 1]).all()
    queries = np.array([(0.5, 0.3, 0.7), (-3, -4, 0), (3.0, 0, 0), (1, 1, 5), (6, 0, -4)])
    assert surface.distances(queries)[0] == pytest.approx([0.7, 5, 0, math.sqrt(0.5), 5])
    with pytest.raises(ValueError, match="without area"):
        SampledSurface(vertices, np.array([(6, 6, 6)]))


def test_agreement_without_points_is_none():
    assert set(agreement(np.zeros(0), np.ones(4)).values()) == {None}
    apart = agreement(np.ones(3), np.ones(4))
    assert apart["f1"] == 0.0 and apart["chamfer"] == 1.0


# --- truth -----------------------------------------------------------------------------------------------------------


def write_truth(scene, write_capture, spheres):
    """Write the spheres of a capture to its truth/."""
    truth = scene.folder / "truth"
    for name in ("meshes", "depth", "masks"):
        (truth / name).mkdir(parents=True)
    rays = write_capture.rays_of(scene.lens())
    for name, viewmat in zip(scene.names, scene.viewmats):
        ids, depth = write_capture.sphere_ids(rays, viewmat, spheres)
        np.save(truth / "depth" / name.replace(".png", ".npy"), np.where(ids > 0, depth, 0).astype(np.float32))
        Image.fromarray(ids.astype(np.uint16)).save(truth / "masks" / name)
    rows = []
    for i, center, radius in spheres:
        vertices, faces = sphere(radius, center)
        table = np.empty(len(faces), [("n", "u1"), ("v", "<i4", 3)])
        table["n"], table["v"] = 3, faces
        header = (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\n"
            f"property float y\nproperty float z\nelement face {len(faces)}\n"
            "property list uchar int vertex_indices\nend_header\n"
        )
        (truth / "meshes" / f"{i}.ply").write_bytes(
            header.encode() + vertices.astype("<f4").tobytes() + table.tobytes()
        )
        rows.append({"id": i, "name": f"sphere {i}", "mesh": f"meshes/{i}.ply"})
    (truth / "objects.json").write_text(json.dumps({"unit": "meter", "objects": rows}))


SPHERES = [(1, (0.0, 0.0, 0.0), 0.5), (5, (0.0, 0.0, 1.2), 0.3)]


@pytest.fixture
def true_capture(write_capture, tmp_path):
    """A capture of two spheres with exact truth, and its `Scene`."""
    scene = write_capture(views=9, size=(96, 72), spheres=SPHERES)
    write_truth(scene, write_capture, SPHERES)
    return load_capture(scene.folder, tmp_path / "cache"), scene


def test_points_are_seen_if_two_views_show_them(true_capture):
    capture, scene = true_capture
    points, _ = sphere(0.5)
    normals = points / 0.5
    every = load_truth(capture, range(9)).seen(points, normals, [1])
    assert every[np.abs(points[:, 1] + 0.2) < 0.2].all(), "cameras surround the sphere at y = -0.8"
    assert not every[points[:, 1] > 0.48].any(), "no camera looks from below"
    # With two cameras, only points that both see count, and not those behind the other sphere.
    nine = load_truth(capture, [1, 2])
    two = nine.seen(points, normals, [1])
    centers = [-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in (scene.viewmats[1], scene.viewmats[2])]
    facing = [((center - points) * normals).sum(1) > 0 for center in centers]
    assert not two[~(facing[0] & facing[1])].any()
    assert two[facing[0] & facing[1]].mean() > 0.7
    assert not load_truth(capture, [1]).seen(points, normals, [1]).any(), "two views are required"
    front = np.array([(0, 0, 0.5)])
    assert not load_truth(capture, [0, 0]).seen(front, front / 0.5, [1]).any(), "the other sphere occludes it"
    assert not nine.seen(points, normals, [5]).any(), "the masks show another object there"


def test_unseen_parts_count_only_over_whole_surface(true_capture, tmp_path):
    capture, _ = true_capture
    truth = load_truth(capture, capture.train_indices)
    vertices, faces = sphere(0.5)
    low = vertices[faces][:, :, 1].min(1) > 0.44
    without = textured(vertices, faces[~low])
    write_mesh(tmp_path / "1.ply", without)
    scene = FakeScene([], [])

    def measured(name):
        return evaluate_mesh(tmp_path, MeshEntry("1", "ball", (1,), file=name), scene, truth, [], Reporter())

    found = measured("1.ply")
    assert found["f1"] > 0.999 and found["f1_005"] > 0.99 and not found["watertight"]
    assert found["recall_all"] < 0.97 and found["precision_all"] > 0.999 and 0.6 < found["seen"] < 0.95
    assert found["texture_psnr"] is None and found["texture_coverage"] is None
    # A bulge that no camera sees counts only over the whole surface.
    bulged = vertices.copy()
    bulged[vertices[:, 1] > 0.47] *= 1.2
    write_mesh(tmp_path / "2.ply", textured(bulged, faces))
    found = measured("2.ply")
    assert found["precision"] > 0.995 and found["precision_all"] < 0.97
    # A bulge that cameras see counts.
    bulged = vertices.copy()
    bulged[vertices[:, 1] < -0.3] *= 1.2
    write_mesh(tmp_path / "3.ply", textured(bulged, faces))
    assert measured("3.ply")["precision"] < 0.9
    # An inner wall, which no camera sees, counts only over the whole surface; an outer wall is seen.
    inner = joined((vertices, faces), sphere(0.4))
    write_mesh(tmp_path / "4.ply", textured(*inner))
    found = measured("4.ply")
    assert found["precision"] > 0.999 and found["precision_all"] < 0.7
    write_mesh(tmp_path / "5.ply", textured(*joined((vertices, faces), sphere(0.56))))
    assert measured("5.ply")["precision"] < 0.05


def test_truth_of_several_objects_is_joined(true_capture):
    capture, _ = true_capture
    truth = load_truth(capture, capture.train_indices)
    both = truth.of([1, 5])
    assert len(both.vertices) == sum(len(mesh.vertices) for mesh in truth.meshes.values())
    assert both.vertices[both.faces[-1]] == pytest.approx(truth.meshes[5].vertices[truth.meshes[5].faces[-1]])
    assert truth.of([1, 7]) is None and truth.of([]) is None


def test_missing_truth_is_none_and_invalid_truth_is_reported(true_capture):
    capture, scene = true_capture
    place = scene.folder / "truth"
    mesh = place / "meshes" / "5.ply"
    mesh.write_bytes(mesh.read_bytes()[:-5])
    with pytest.raises(InputError, match=r"5\.ply"):
        load_truth(capture, [0])
    (place / "objects.json").write_text('{"objects": [{"name": "mug"}]}')
    with pytest.raises(InputError, match=r"objects\.json"):
        load_truth(capture, [0])
    (place / "objects.json").unlink()
    assert load_truth(capture, [0]) is None


# --- texture ---------------------------------------------------------------------------------------------------------


class FakeScene:
    """Cameras at the origin that look along +z, each with a photo and labels."""

    classes = ClassTable([0, 4, 9])
    normalization = Normalization((10.0, 0.0, 0.0), 0.5)

    def __init__(self, photos, labels):
        self.photos, self.labels, self.read = photos, labels, []
        self.capture = SimpleNamespace(ids_in=self.ids_in)

    def ids_in(self, index):
        if self.labels[index] is None:
            return ()
        return tuple(self.classes.ids_of(np.unique(self.labels[index])).tolist())

    def camera(self, index):
        height, width = self.photos[index].shape[:2]
        return Camera(np.eye(4), np.array([[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]]), width, height)

    def target(self, index):
        self.read.append(index)
        photo = torch.from_numpy(self.photos[index].transpose(2, 0, 1).astype(np.float32))
        return photo, None if self.labels[index] is None else torch.from_numpy(self.labels[index])


def poster(share=1.0):
    """Return a sheet at depth 2 that fills the left `share` of a 40 x 30 image, with UVs along the image."""
    right = -1 + 2 * share
    seen = np.array([(-1, -0.75, 2), (right, -0.75, 2), (right, 0.75, 2), (-1, 0.75, 2)])
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    uv = np.array([(0, 1), (share, 1), (share, 0), (0, 0)], np.float32)
    return textured(FakeScene.normalization.to_world(seen), faces, uv[faces])


ramp = np.stack(np.meshgrid(np.arange(400), np.arange(300)), -1) / [400, 300]
texture = np.rint(255 * np.concatenate([ramp, np.full((300, 400, 1), 0.5)], -1)).astype(np.uint8)
photo = texture.reshape(30, 10, 40, 10, 3).mean((1, 3)) / 255


def test_texture_sampling_matches_blender():
    corners = np.array([[(1, 0, 0), (0, 1, 0)], [(0, 0, 1), (1, 1, 1)]], np.uint8) * 255
    found = sample_texture(corners, np.array([(0.0, 0.0), (1, 0), (0, 1), (0.5, 0.5), (0.25, 0.75)]))
    assert found == pytest.approx(np.array([(0, 0, 1), (1, 1, 1), (1, 0, 0), (0.5, 0.5, 0.5), (1, 0, 0)]))


def test_texture_psnr_uses_only_masked_pixels(monkeypatch):
    labels = np.zeros((30, 40), np.int32)
    labels[5:20, 4:30] = 1
    elsewhere = np.where((labels == 1)[..., None], photo, 0)
    good = texture_score(poster(), texture, FakeScene([elsewhere], [labels]), [4], [0])
    assert good.pixels == good.covered == 15 * 26
    assert good.figures()["texture_psnr"] > 45 and good.figures()["texture_coverage"] == 1
    darker = texture_score(poster(), texture, FakeScene([elsewhere + 0.1], [labels]), [4], [0])
    assert darker.figures()["texture_psnr"] == pytest.approx(20, abs=0.2)
    assert texture_score(poster(), texture, FakeScene([elsewhere], [labels]), [9], [0]).pixels == 0
    both = texture_score(poster(), texture, FakeScene([photo], [labels]), [4, 9], [0, 0])
    assert both.pixels == 2 * good.pixels
    whole = texture_score(poster(), texture, FakeScene([photo], [None]), None, [0])
    assert whole.pixels == 1200 and whole.figures()["texture_psnr"] > 45
    assert texture_score(poster(), texture, FakeScene([photo], [None]), [4], [0]).pixels == 0
    monkeypatch.setattr("backend.evaluation.meshes._PIXELS_AT_ONCE", 100)
    bands = texture_score(poster(), texture, FakeScene([photo], [None]), None, [0])
    assert (bands.pixels, bands.covered) == (whole.pixels, whole.covered)
    assert bands.squares == pytest.approx(whole.squares, rel=1e-6)


def test_photos_whose_masks_lack_the_object_are_not_read():
    scene = FakeScene([photo] * 4, [np.full((30, 40), 1), np.full((30, 40), 2), None, np.zeros((30, 40), int)])
    assert texture_score(poster(), texture, scene, [4], range(4)).pixels == 1200 and scene.read == [0]
    assert texture_score(poster(), texture, scene, None, range(4)).pixels == 4800 and scene.read == [0, 0, 1, 2, 3]


def test_holes_lower_texture_coverage():
    labels = np.full((30, 40), 1, np.int32)
    half = texture_score(poster(0.5), texture, FakeScene([photo], [labels]), [4], [0]).figures()
    assert half["texture_coverage"] == pytest.approx(0.5) and half["texture_psnr"] > 45
    behind = replace(poster(), vertices=FakeScene.normalization.to_world(np.array([(0, 0, -2.0)] * 4)))
    none = texture_score(behind, texture, FakeScene([photo], [labels]), [4], [0]).figures()
    assert none == {"texture_psnr": None, "texture_coverage": 0.0}


# --- one mesh, and what cannot be measured ---------------------------------------------------------------------------


class RecordingReporter(Reporter):
    def __init__(self):
        self.warnings = []

    def warning(self, message):
        self.warnings.append(message)


def test_unmeasurable_figures_are_none(true_capture, tmp_path):
    reporter = RecordingReporter()

    def measured(entry):
        return evaluate_mesh(
            tmp_path, MeshEntry("4", "box", (4,), **entry), FakeScene([photo], [None]), None, [0], reporter
        )

    absent = measured({"why": "too few views show it"})
    assert absent.pop("why") == "too few views show it" and set(absent.values()) == {None}
    gone = measured({"file": "4.ply"})
    assert "4.ply" in reporter.warnings[-1] and gone["faces"] is None and gone["why"]
    write_mesh(tmp_path / "4.ply", textured(*box(), texture="4.png"))
    found = measured({"file": "4.ply", "texture": "4.png"})
    assert "4.png" in reporter.warnings[-1] and found["texture_psnr"] is None
    assert found["faces"] == 12 and found["watertight"] is True and found["f1"] is None and found["chamfer_all"] is None
    empty = textured(*box())
    empty.faces, empty.uvs, empty.unobserved = empty.faces[:0], empty.uvs[:0], empty.unobserved[:0]
    write_mesh(tmp_path / "4.ply", empty)
    assert measured({"file": "4.ply"})["why"] == "it has no surface"
    flat = textured(*box())
    flat.vertices[:] = 1
    image = np.asarray(draw_card(Card("", "", flat, None, true_capture[0].views[1]), 40)[0])
    assert (image == image[0, 0]).all()
    write_mesh(tmp_path / "4.ply", flat)
    assert measured({"file": "4.ply"})["watertight"] is None


def test_meshes_of_earlier_state_are_left_out(tmp_path):
    reporter = RecordingReporter()
    assert mesh_entries(tmp_path, 20, reporter) == {} and reporter.warnings == []
    ids = {"scene": None, "77": [2, 10], "10": [10], "2": [2, 3], "old": [2]}
    entries = {key: {"ids": value, "trained_steps": 20 if key != "old" else 15} for key, value in ids.items()}
    (tmp_path / "meshes.json").write_text(json.dumps({"trained_steps": 20, "meshes": entries}))
    found = mesh_entries(tmp_path, 20, reporter)
    assert list(found) == ["2", "10", "77", "scene"], "objects by ID, then a set called 77 and the scene"
    assert [entry.object_id for entry in found.values()] == [2, 10, None, None]
    [warning] = reporter.warnings
    assert "1 of 5 meshes" in warning and "earlier state" in warning
    assert list(mesh_entries(tmp_path, 15, reporter)) == ["old"]
    for broken in ([1], {"1": 7}, {"one": {"ids": ["x"]}}):
        (tmp_path / "meshes.json").write_text(json.dumps({"trained_steps": 20, "meshes": broken}))
        with pytest.raises(InputError, match=r"meshes\.json"):
            mesh_entries(tmp_path, 20, reporter)


# --- images ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_mesh_fits_panel(true_capture, scale):
    capture, _ = true_capture
    vertices, _ = sphere(0.3 * scale, (5 * scale, 0, 0))
    vertices[:, 1] *= 3
    camera = camera_for(vertices, capture.views[1], 300)
    seen = vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * camera.K[0, 0] + 150
    assert seen[:, 2].min() > camera.near
    assert pixels.min() > 5 and pixels.max() < 295
    assert np.ptp(pixels, axis=0).max() == pytest.approx(0.88 * 300, rel=0.02)


def test_room_is_shown_from_inside(true_capture):
    capture, _ = true_capture
    vertices, _ = box((-9, -9, -9), (9, 9, 9))
    camera = camera_for(vertices, capture.views[1], 300)
    assert camera.center == pytest.approx(-capture.views[1].viewmat[:3, :3].T @ capture.views[1].viewmat[:3, 3])


def test_view_with_most_pixels_is_chosen(true_capture):
    capture, scene = true_capture
    pixels = [(ids == 5).sum() for ids in scene.ids]
    assert view_of(capture, [5], range(9)).name == capture.views[int(np.argmax(pixels))].name
    assert view_of(capture, None, [3, 4]).name == capture.views[3].name


def test_only_masks_that_show_a_mesh_are_read_for_its_view(true_capture, monkeypatch):
    capture, _ = true_capture
    read, mask = [], capture.mask
    monkeypatch.setattr(capture, "mask", lambda index: read.append(index) or mask(index))
    monkeypatch.setattr(capture, "ids_in", lambda index: (0, 5) if index in (4, 6) else (0, 1))
    view_of(capture, None, range(9))
    assert not read
    view_of(capture, [5, 7], range(9))
    assert read == [4, 6]


def test_sheet_keeps_no_more_of_textures_than_it_shows():
    texture = np.arange(4096, dtype=np.uint16).astype(np.uint8)[:, None, None] + np.zeros((4096, 4096, 3), np.uint8)
    shown = report._shown_texels(texture)
    assert shown.shape == (1024, 1024, 3) and shown.base is None and (shown[:, 0] == texture[::4, 0]).all()
    assert report._shown_texels(texture[:1000, :1000]).shape == (1000, 1000, 3)


def test_panels_show_surface_wires_unobserved_faces_and_texture(true_capture):
    capture, _ = true_capture
    vertices, faces = box()
    uvs = np.zeros((12, 3, 2), np.float32)
    blue = np.zeros((4, 4, 3), np.uint8) + np.uint8([10, 20, 250])
    card = Card("box", "", textured(vertices, faces, uvs), blue, capture.views[1])
    surface, wires, texture = (np.asarray(image).astype(int) for image in draw_card(card, 120))
    assert (surface[0, 0] == surface[-1, -1]).all() and surface.shape == (120, 120, 3)
    drawn = (surface != surface[0, 0]).any(2)
    assert 0.2 < drawn.mean() < 0.8
    gray = surface[drawn]
    assert np.ptp(gray, axis=1).max() < 40 and np.ptp(gray[:, 0]) > 20, "gray and shaded"
    assert (np.abs(texture - [10, 20, 250]).max(2) <= 1).sum() > 0.9 * drawn.sum()
    assert (wires != surface)[drawn].any()
    card.mesh.unobserved[:] = True
    orange = np.asarray(draw_card(card, 120)[1]).astype(int)[drawn]
    assert (orange[:, 0] - orange[:, 2] > 40).mean() > 0.7 > (wires[drawn][:, 0] - wires[drawn][:, 2] > 40).mean()
    card.texture = None
    plain = np.asarray(draw_card(card, 120)[2]).astype(int)
    assert (np.abs(plain - 90).max(2) <= 1).sum() > 0.9 * drawn.sum(), "vertex colors are shown without a texture"


def test_sheet_shows_all_meshes_within_size_limit(true_capture, tmp_path):
    capture, _ = true_capture
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (256, 256, 3)).astype(np.uint8)
    vertices, faces = box()
    uvs = rng.random((12, 3, 2)).astype(np.float32)
    cards = [
        Card("a" * 200, "F1", textured(vertices, faces, uvs), noise, capture.views[1]),
        Card("none", "", why="x " * 99),
    ]
    one, two = mesh_sheet(cards[:1]), mesh_sheet(cards)
    assert two.width == one.width and two.height > 1.5 * one.height
    many = mesh_sheet(cards * 2)
    assert many.width > 1.5 * two.width and many.height == two.height
    path = save_sheet(many, tmp_path / "meshes.png", 100_000)
    assert path.name == "meshes.png" and path.stat().st_size <= 100_000
    kept = Image.open(path)
    assert kept.convert("RGB").getpixel((0, 0)) == (255, 255, 255)
    assert kept.format == "PNG" and kept.width / kept.height == pytest.approx(many.width / many.height, rel=0.02)
    exact = save_sheet(one, tmp_path / "one.png")
    assert (np.asarray(Image.open(exact)) == np.asarray(one)).all()


# --- the commands ----------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_evaluate_and_report_measure_meshes(write_capture, tmp_path, run_command):
    scene, out = write_capture(views=9, size=(64, 48), spheres=SPHERES), tmp_path / "out"
    write_truth(scene, write_capture, SPHERES)

    def run(*words):
        result = run_command(*words)
        assert result.code == EXIT_DONE, result
        return result.err

    def reported():
        stderr = run("report", out)
        report = json.loads((out / "report.json").read_text())
        return stderr, report, {entry["id"]: entry["mesh"] for entry in report["objects"]}

    run("train", scene.folder, "--out", out, "--steps", 12, "--offsets", 4)
    folder = out / "meshes"
    folder.mkdir()
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(folder / "1.png")
    vertices, faces = sphere(0.51)
    write_mesh(folder / "1.ply", textured(vertices, faces, texture="1.png"))
    write_mesh(folder / "scene.ply", textured(*joined(sphere(0.5), sphere(0.3, (0, 0, 1.2)))))
    record = {
        "trained_steps": 12,
        "meshes": {
            "1": {"ids": [1], "name": "sphere 1", "trained_steps": 12, "file": "1.ply", "texture": "1.png",
                  "vertices": len(vertices), "faces": len(faces), "watertight": True, "unobserved": 0.0,
                  "seconds": 1.0},
            "5": {"ids": [5], "name": "sphere 5", "trained_steps": 12, "why": "too few views show it"},
            "scene": {"ids": None, "name": "the whole scene", "trained_steps": 12, "file": "scene.ply", "texture": "",
                      "vertices": 1, "faces": 1, "watertight": True},
        },
    }  # fmt: skip
    (folder / "meshes.json").write_text(json.dumps(record))
    stderr, _, meshes = reported()
    assert "have not been measured" in stderr
    assert meshes[1]["faces"] == len(faces) and meshes[1]["f1"] is None
    assert (out / "pictures" / "meshes.png").exists()

    run("evaluate", out)
    stderr, report, meshes = reported()
    assert stderr == ""
    assert meshes[1]["f1"] == 1.0 and meshes[1]["f1_005"] < 0.5
    assert meshes[1]["chamfer"] == pytest.approx(0.01, rel=0.1)
    assert meshes[1]["watertight"] and meshes[1]["manifold"] and meshes[1]["self_intersections"] == 0
    assert 3 < meshes[1]["texture_psnr"] < 40 and meshes[1]["texture_coverage"] > 0.9
    assert meshes[5]["why"] == "too few views show it" and meshes[5]["faces"] is None
    [whole] = report["meshes"]
    assert whole["name"] == "the whole scene" and whole["components"] == 2 and whole["f1"] > 0.99
    guide = (Path(__file__).parents[2] / "docs" / "guide.md").read_text()
    section = guide.split("### report.json\n")[1].split("\n### ")[0]
    keys = {*report, *report["quality"], *report["objects"][0], *meshes[1]}
    assert keys <= set(re.findall(r"`(\w+)`", section))
    text = (out / "report.md").read_text()
    assert "1 of 2 objects have a mesh; all watertight" in text and "| too few views show it |" in text
    assert "(pictures/meshes.png)" in text and "| the whole scene |" in text
    assert (out / "pictures" / "meshes.png").stat().st_size < 300_000

    # meshes.json belongs to another state of the model, so it is not used.
    for entry in record["meshes"].values():
        entry["trained_steps"] = 11
    (folder / "meshes.json").write_text(json.dumps(record))
    assert "earlier state" in run("evaluate", out)
    assert json.loads((out / "evaluation.json").read_text())["meshes"] == {}
    _, _, meshes = reported()
    assert "## Meshes" not in (out / "report.md").read_text()
    assert meshes[1]["faces"] is None and not (out / "pictures" / "meshes.png").exists()
