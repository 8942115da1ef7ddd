"""Drawing, unwrapping and texturing of meshes, on geometry with known results and scenes of known colors."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from backend.commands.objects.mesh import _unwrapped
from backend.mesh import refine as refinement
from backend.mesh.refine import refine
from backend.mesh.smooth import smooth
from backend.mesh.surface import Surface, neighbors
from backend.mesh.texture.atlas import fill, find_texels
from backend.mesh.texture.bake import bake_texture, texture_size
from backend.mesh.texture.unwrap import unwrap
from backend.mesh.texture.zbuffer import draw_mesh
from backend.raster import Camera
from backend.shared.class_table import ClassTable
from backend.shared.errors import Cancelled
from backend.shared.events import Reporter


def camera_at(camera_center, target=(0.0, 0.0, 0.0), width=64, height=48, focal=60.0) -> Camera:
    forward = np.asarray(target, np.float64) - camera_center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ camera_center
    return Camera(
        viewmat, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float64), width, height
    )


def test_drawn_pixels_match_ray_casting():
    mesh = trimesh.util.concatenate(
        [trimesh.creation.icosphere(2, 1.0), trimesh.creation.box((3.0, 0.4, 0.4)), trimesh.creation.torus(1.6, 0.2)]
    )
    camera = camera_at(np.array([2.5, -3.0, 1.8]), width=61, height=45)
    depth, face, weights = draw_mesh(mesh.vertices, mesh.faces, camera)
    y, x = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
    rays = np.stack([(x - camera.K[0, 2]) / 60, (y - camera.K[1, 2]) / 60, np.ones_like(x)], 1) @ camera.viewmat[:3, :3]
    corners = mesh.vertices[mesh.faces]
    nearest, hit = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for f, (a, b, c) in enumerate(corners):
        normal = np.cross(b - a, c - a)
        t = ((a - camera.center) @ normal) / (rays @ normal)
        p = camera.center + t[:, None] * rays
        inside = np.all([np.cross(q - o, p - o) @ normal >= 0 for o, q in ((a, b), (b, c), (c, a))], axis=0)
        closer = inside & (t > 0) & (t < nearest)
        nearest[closer], hit[closer] = t[closer], f
    assert (face.ravel() == hit).mean() > 0.998 and (hit >= 0).mean() > 0.2
    same = (face.ravel() == hit) & (hit >= 0)
    np.testing.assert_allclose(depth.ravel()[same], nearest[same], rtol=1e-6)
    assert (depth[face < 0] == 0).all()
    points = np.einsum("nij,ni->nj", corners[face.ravel()[same]], weights.reshape(-1, 3)[same].astype(np.float64))
    np.testing.assert_allclose(points, camera.center + nearest[same, None] * rays[same], atol=1e-5)


def test_faces_behind_camera_or_without_area_are_handled():
    camera = camera_at(np.zeros(3), (0.0, 1.0, 0.0))
    floor = np.array([[-90, -90, -0.5], [90, -90, -0.5], [90, 90, -0.5], [-90, 90, -0.5]], np.float64)
    depth, face, weights = draw_mesh(floor, np.array([[0, 1, 2], [0, 2, 3]]), camera)
    assert (face[25:] >= 0).all() and (face[:24] < 0).all()
    np.testing.assert_allclose(depth[47], 0.5 * 60 / 23.5, rtol=1e-6)
    behind = floor - [0, 100, 0]
    assert (draw_mesh(behind, np.array([[0, 1, 2]]), camera)[1] < 0).all()
    broken = np.array([[0, 1, 0], [0, 1, 0], [1, 1, 0], [np.nan, 1, 0], [2, 1, 0], [0, 0, 0]], np.float64)
    flat = np.array([[0, 1, 2], [0, 2, 4], [2, 3, 4], [5, 5, 5], [5, 0, 2]])
    depth, face, weights = draw_mesh(broken, flat, camera)
    assert (face < 0).all() and np.isfinite(depth).all() and np.isfinite(weights).all()
    depth, face, weights = draw_mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), camera)
    assert depth.shape == face.shape == (48, 64) and (face < 0).all()


def test_drawn_faces_have_no_gaps_and_first_of_equal_faces_wins():
    mesh = trimesh.creation.icosphere(4, 1.0)
    _, face, _ = draw_mesh(mesh.vertices, mesh.faces, camera_at(np.zeros(3), (1.0, 1.0, 0.0)))
    assert (face >= 0).all()
    camera = camera_at(np.array([3.0, 0.5, 0.2]))
    _, once, _ = draw_mesh(mesh.vertices, mesh.faces, camera)
    _, twice, _ = draw_mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces]), camera)
    np.testing.assert_array_equal(once, twice)


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int32), np.zeros(len(mesh.faces), bool))


def areas(uvs: np.ndarray) -> np.ndarray:
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


@pytest.mark.parametrize("size", [1024, 4096])
def test_uv_layout_has_no_overlaps_and_is_proportional_to_area(size):
    mesh = trimesh.creation.torus(1.0, 0.3, major_sections=60, minor_sections=30)
    mesh.vertices += np.random.default_rng(0).normal(0, 0.004, mesh.vertices.shape)
    uvs = unwrap(surface_of(mesh), size)
    assert uvs.shape == (len(mesh.faces), 3, 2) and uvs.dtype == np.float32
    assert uvs.min() >= 0 and uvs.max() <= 1
    flat = areas(uvs.astype(np.float64))
    assert (flat > 0).all()  # no mirrored faces
    assert flat.sum() > 0.35
    ratio = flat / mesh.area_faces
    assert ratio.std() / ratio.mean() < 0.35
    # If faces overlapped, their areas would add up to more than the covered texels.
    texels = find_texels(uvs, 512, 0, 512)
    covered = (texels.weights >= 0).all(1).sum() / 512**2
    np.testing.assert_allclose(covered, flat.sum(), rtol=0.02)


def test_tiny_mesh_and_degenerate_faces_are_unwrapped():
    tetrahedron = trimesh.Trimesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 1e-4 + 7,
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    )
    uvs = unwrap(surface_of(tetrahedron), 1024)
    np.testing.assert_allclose(areas(uvs) / tetrahedron.area_faces, areas(uvs).sum() / tetrahedron.area, rtol=0.05)
    vertices = np.vstack([tetrahedron.vertices, tetrahedron.vertices[:2].mean(0)])
    faces = np.vstack([tetrahedron.faces, [[0, 4, 1], [0, 0, 0], [0, 1, 1]]]).astype(np.int32)
    uvs = unwrap(Surface(vertices, faces, np.zeros(len(faces), bool)), 1024)
    assert np.isfinite(uvs).all() and (areas(uvs[:4]) > 0).all() and np.abs(areas(uvs[4:])).max() < 1e-6
    line = Surface(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), np.array([[0, 1, 2]], np.int32), np.zeros(1, bool))
    assert np.isfinite(unwrap(line, 1024)).all()
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, bool))
    assert unwrap(nothing, 1024).shape == (0, 3, 2)


def test_texels_have_barycentric_weights():
    uvs = np.array([[[0.1, 0.1], [0.6, 0.1], [0.1, 0.8]]], np.float32)
    whole = find_texels(uvs, 64, 0, 64)
    x, y = (whole.indices % 64 + 0.5) / 64, 1 - (whole.indices // 64 + 0.5) / 64
    np.testing.assert_allclose(np.einsum("ij,nj->ni", uvs[0].T, whole.weights), np.stack([x, y], 1), atol=1e-5)
    inside = (x > 0.1) & (y > 0.1) & ((x - 0.1) / 0.5 + (y - 0.1) / 0.7 < 1)
    np.testing.assert_array_equal(inside, (whole.weights > 0).all(1))
    assert (~inside).sum() > 60  # a rim of one texel around it
    parts = [find_texels(uvs, 64, first, 24) for first in (0, 24, 48)]
    np.testing.assert_array_equal(np.concatenate([part.indices for part in parts]), whole.indices)
    np.testing.assert_allclose(np.concatenate([part.weights for part in parts]), whole.weights, atol=1e-5)


def test_fill_extrapolates_known_texels():
    values = np.zeros((33, 50, 3), np.float32)
    known = np.zeros((33, 50), bool)
    values[:, :20] = [0.2, 0.4, 0.6]
    values[:, 30:] = [0.4, 0.4, 0.2]
    known[:, :20] = known[:, 30:] = True
    fill(values, known)
    assert values.min() >= 0.2 - 1e-6 and values.max() <= 0.6 + 1e-6
    np.testing.assert_allclose(values[:, 20], np.broadcast_to([0.2, 0.4, 0.6], (33, 3)), atol=0.1)
    assert (np.diff(values[16, 18:32, 0]) >= -1e-6).all()
    fill(values, np.zeros_like(known))
    assert (values == 0).all()


def colors_at(points: np.ndarray) -> np.ndarray:
    """Return the colors of the surface, (N, 3) in 0..1: stripes on a gradient."""
    waves = 0.15 * np.sin(points @ np.array([[5, 1, 0], [0, 4, 2], [2, 0, 5]]).T)
    return np.clip(0.5 + 0.15 * points + waves, 0, 1).astype(np.float32)


LOUD = np.array([1.0, 0.0, 1.0], np.float32)


class StubViews:
    """Photos of a mesh of known colors (class 1), partly hidden by another mesh of one loud color (class 2)."""

    def __init__(self, mesh, other=None, view_count=24, size=160, masks=True, below=False):
        self.model = SimpleNamespace(classes=ClassTable([0, 7, 9]))
        self.scene = self
        angles = np.arange(view_count) * 2.4
        heights = np.linspace(-0.9 if below else 0.1, 0.9, view_count)
        self.cameras = [
            camera_at(
                4 * np.array([np.sqrt(1 - h * h) * np.cos(a), np.sqrt(1 - h * h) * np.sin(a), h]),
                width=size, height=size * 3 // 4, focal=size * 1.2,
            )
            for a, h in zip(angles, heights)
        ]  # fmt: skip
        self.indices = tuple(i for i in range(view_count) if i % 6)
        self.held_out = tuple(i for i in range(view_count) if i % 6 == 0)
        self.masks = masks
        self.images, self.labels, self.drawn = [], [], []
        for camera in self.cameras:
            image, label, drawn = self._photo(mesh, other, camera)
            self.images.append(image)
            self.labels.append(label)
            self.drawn.append(drawn)

    @staticmethod
    def _photo(mesh, other, camera):
        # Four samples per pixel, so that border pixels mix both sides as in a photo.
        fine = Camera(camera.viewmat, camera.K * [[2], [2], [1]], camera.width * 2, camera.height * 2)
        depth, face, weights = draw_mesh(mesh.vertices, mesh.faces, fine)
        image = np.full((fine.height, fine.width, 3), [0.0, 1.0, 0.0], np.float32)
        points = np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[face[face >= 0]]], weights[face >= 0])
        image[face >= 0] = colors_at(points)
        label = np.where(face >= 0, 1, 0)
        if other is not None:
            before, hit, _ = draw_mesh(other.vertices, other.faces, fine)
            hides = (hit >= 0) & ((face < 0) | (before < depth))
            image[hides], label[hides] = LOUD, 2
        image = image.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))
        depth, face, _ = draw_mesh(mesh.vertices, mesh.faces, camera)
        return image, label[1::2, 1::2].astype(np.int32), (depth, face)

    def camera(self, index):
        return self.cameras[index]

    def target(self, index, downscale=1):
        labels = torch.from_numpy(self.labels[index]) if self.masks else None
        return torch.from_numpy(np.ascontiguousarray(self.images[index].transpose(2, 0, 1))), labels

    def scene_map(self, index):
        assert index in self.indices
        return SimpleNamespace(ids=self.labels[index])

    def object_view(self, index, classes):
        assert index in self.indices and list(classes) == [1]
        depth, face = self.drawn[index]
        alpha = (face >= 0).astype(np.float32)
        color = np.where(face[..., None] >= 0, np.float32([0.25, 0.5, 0.75]), LOUD)
        return SimpleNamespace(
            camera=self.cameras[index], x=0, y=0, depth=depth, alpha=alpha, color=color, visible=alpha
        )


def draw_textured(texture, uvs, mesh, camera):
    """Draw the textured mesh; return its colors (H, W, 3) float32 and its mask (H, W)."""
    _, face, weights = draw_mesh(mesh.vertices, mesh.faces, camera)
    image = np.zeros((*face.shape, 3), np.float32)
    uv = np.einsum("nij,ni->nj", uvs[face[face >= 0]], weights[face >= 0])
    size = len(texture)
    x, y = (uv[:, 0] * size).astype(int), ((1 - uv[:, 1]) * size).astype(int)
    image[face >= 0] = texture[np.clip(y, 0, size - 1), np.clip(x, 0, size - 1)] / np.float32(255)
    return image, face >= 0


def psnr(a, b):
    return 10 * np.log10(1 / np.mean((a - b) ** 2))


def test_baked_texture_matches_surface_colors():
    mesh = trimesh.creation.icosphere(3, 1.0)
    views = StubViews(mesh, below=True)
    surface = surface_of(mesh)
    uvs = unwrap(surface, 512)
    texture, colors = bake_texture(surface, uvs, 512, views, [1])
    assert texture.shape == (512, 512, 3) and texture.dtype == np.uint8
    for index in views.held_out:
        image, shown = draw_textured(texture, uvs, mesh, views.cameras[index])
        whole = shown & (views.labels[index] == 1)
        inner = whole & (views.images[index][..., 1] < 0.99)
        assert psnr(image[inner], views.images[index][inner]) > 30
    # No foreign color bleeds in at the charts' edges.
    texels = find_texels(uvs, 512, 0, 512)
    points = np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[texels.face]], texels.weights)
    assert np.abs(texture.reshape(-1, 3)[texels.indices] / 255 - colors_at(points)).max() < 0.2
    assert colors.shape == (len(mesh.vertices), 3) and colors.dtype == np.uint8
    np.testing.assert_allclose(colors / 255, np.broadcast_to([0.25, 0.5, 0.75], colors.shape), atol=0.01)


def test_view_dependent_highlights_are_rejected():
    mesh = trimesh.creation.icosphere(4, 1.0)
    views = StubViews(mesh, view_count=48, below=True)
    y, x = np.mgrid[:120, :160]
    for index, image in enumerate(views.images[::2]):
        place = np.random.default_rng(index).uniform([60, 40], [100, 80])
        away = ((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 14.0**2)
        image += 0.35 * np.exp(-away)[..., None].astype(np.float32)
    surface = surface_of(mesh)
    uvs = unwrap(surface, 512)
    texture, _ = bake_texture(surface, uvs, 512, views, [1])
    texels = find_texels(uvs, 512, 0, 512)
    points = np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[texels.face]], texels.weights)
    wrong = np.abs(texture.reshape(-1, 3)[texels.indices] / 255 - colors_at(points))
    # Plain blending of the photos gives 0.046 and 0.29.
    assert wrong.mean() < 0.022 and np.quantile(wrong, 0.99) < 0.14


@pytest.mark.parametrize("masks", [True, False])
def test_occluding_object_does_not_color_texture(masks):
    mesh = trimesh.creation.box((1.6, 1.6, 1.6)).subdivide().subdivide().subdivide()
    other = trimesh.creation.icosphere(3, 0.4)
    other.vertices += [1.3, 0.2, 0.3]
    views = StubViews(mesh, other, masks=masks)
    surface = surface_of(mesh)
    uvs = unwrap(surface, 512)
    texture, _ = bake_texture(surface, uvs, 512, views, [1])
    texels = find_texels(uvs, 512, 0, 512)
    points = np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[texels.face]], texels.weights)
    color = texture.reshape(-1, 3)[texels.indices] / 255
    seen = points[:, 2] > -0.7  # no camera looks from below
    truth = colors_at(points)
    assert np.abs(color - truth)[seen].mean() < 0.03
    # The loud color is bright in red and blue and dark in green; no color tends toward it or the green background.
    towards = ((color - truth) * (LOUD - 0.5) * 2).min(1)
    assert towards.max() < 0.1 and (-towards)[seen].max() < 0.35
    # The bottom continues the sides.
    bottom = points[:, 2] < -0.79
    assert bottom.sum() > 1000 and np.isfinite(color).all()
    sides = color[(points[:, 2] > -0.75) & (points[:, 2] < -0.5)]
    assert (color[bottom] >= sides.min(0) - 0.1).all() and (color[bottom] <= sides.max(0) + 0.1).all()


def test_occluded_part_does_not_take_colors_of_occluder():
    box = trimesh.creation.box((1.6, 1.6, 1.6)).subdivide().subdivide().subdivide()
    ball = trimesh.creation.icosphere(3, 0.5)
    ball.vertices += [1.5, 0.2, 0.3]
    mesh = trimesh.util.concatenate([box, ball])
    surface = surface_of(mesh)
    uvs = unwrap(surface, 512)
    texture, _ = bake_texture(surface, uvs, 512, StubViews(mesh, below=True), [1])
    texels = find_texels(uvs, 512, 0, 512)
    points = np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[texels.face]], texels.weights)
    behind = (points[:, 0] > 0.79) & (points[:, 0] < 0.81) & (np.abs(points[:, 1:] - [0.2, 0.3]) < 0.5).all(1)
    assert behind.sum() > 1000
    wrong = np.abs(texture.reshape(-1, 3)[texels.indices] / 255 - colors_at(points)).max(1)
    assert wrong[behind].mean() < 0.03 and np.quantile(wrong, 0.99) < 0.12


def test_parts_too_thin_for_photos_get_splat_colors(monkeypatch):
    def colors(points):
        return np.where(np.abs(points[:, :1]) > 0.52, np.float32([0.9, 0.1, 0.1]), np.float32([0.1, 0.2, 0.8]))

    monkeypatch.setitem(globals(), "colors_at", colors)
    rod = trimesh.creation.cylinder(0.012, 3.0, sections=12).subdivide().subdivide().subdivide()
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    mesh = trimesh.util.concatenate([trimesh.creation.icosphere(3, 0.5), rod])
    views = StubViews(mesh, below=True)

    def object_view(index, classes):
        (depth, face), camera = views.drawn[index], views.cameras[index]
        _, _, weights = draw_mesh(mesh.vertices, mesh.faces, camera)
        color = np.zeros((*face.shape, 3), np.float32)
        color[face >= 0] = colors(
            np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[face[face >= 0]]], weights[face >= 0])
        )
        alpha = (face >= 0).astype(np.float32)
        return SimpleNamespace(camera=camera, x=0, y=0, depth=depth, alpha=alpha, color=color, visible=alpha)

    views.object_view = object_view
    surface = surface_of(mesh)
    uvs = unwrap(surface, 512)
    texture, _ = bake_texture(surface, uvs, 512, views, [1])
    texels = find_texels(uvs, 512, 0, 512)
    points = np.einsum("nij,ni->nj", mesh.vertices[mesh.faces[texels.face]], texels.weights)
    wrong = np.abs(texture.reshape(-1, 3)[texels.indices] / 255 - colors(points)).max(1) > 0.3
    # The rod is 1.2 pixels wide; with colors of the ball, 95% are wrong.
    assert wrong[np.abs(points[:, 0]) > 0.6].mean() < 0.3


def test_unseen_texels_get_splat_colors_and_baking_stops():
    mesh = trimesh.creation.icosphere(2, 1.0)
    views = StubViews(mesh, view_count=6)
    views.labels = [np.where(label == 1, 2, label) for label in views.labels]
    surface = surface_of(mesh)
    uvs = unwrap(surface, 64)
    texture, _ = bake_texture(surface, uvs, 64, views, [1])
    np.testing.assert_allclose(
        texture.reshape(-1, 3) / 255, np.broadcast_to([0.25, 0.5, 0.75], (64 * 64, 3)), atol=0.01
    )
    views.indices = ()
    texture, colors = bake_texture(surface, uvs, 64, views, [1])
    assert np.ptp(texture) <= 1 and np.ptp(colors) == 0

    class Stopping(Reporter):
        def progress(self, done, total, **fields):
            raise Cancelled("")

    views.indices = (1,)
    with pytest.raises(Cancelled):
        bake_texture(surface, uvs, 64, views, [1], Stopping())


@pytest.mark.parametrize("pixels_off", [0.8, 3.0])
def test_refinement_moves_surface_to_photo_consistency(pixels_off):
    mesh = trimesh.creation.icosphere(4, 1.0)
    views = StubViews(mesh, below=True)
    surface = surface_of(mesh)
    pixel = 4 / views.cameras[0].K[0, 0]
    bumps = 1 - pixel * (pixels_off + 0.5 * np.sin(mesh.vertices @ [7, 2, 3]))
    surface.vertices = mesh.vertices * bumps[:, None]
    refined = refine(surface, views, [1])
    np.testing.assert_array_equal(refined.faces, surface.faces)
    before = np.abs(np.linalg.norm(surface.vertices, axis=1) - 1)
    after = np.abs(np.linalg.norm(refined.vertices, axis=1) - 1)
    assert np.median(after) < 0.25 * np.median(before) and after.max() < before.max()
    a, b, c = np.moveaxis(refined.vertices[refined.faces], 1, 0)
    assert ((np.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).all()  # nothing folded


def test_median_is_that_of_vertices_around_on_the_same_wall():
    """The other side of a thin plate is nearer than the radius, but not along the surface within it."""
    rows = np.stack(np.meshgrid(np.arange(60), np.arange(40), indexing="ij"), -1).reshape(-1, 2)
    corners = np.concatenate([np.c_[rows, np.full(len(rows), z)] for z in (0.0, 0.1)])
    at = np.arange(len(rows)).reshape(60, 40)
    half = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:]], -1).reshape(-1, 3)
    faces = np.concatenate([half, half[:, ::-1] + len(rows)])
    near = neighbors(corners, faces)
    values = np.random.default_rng(2).normal(size=len(corners)) + np.where(corners[:, 2] > 0, 100.0, 0.0)
    reach = np.where(corners[:, 0] < 30, 1.5, 3.0)
    found = np.empty(len(corners))
    refinement._medians(values, corners, reach, near.indptr, near.indices, found)
    for n in (0, 45, 1234, 1790, len(rows) + 1234, len(corners) - 42):
        same = corners[:, 2] == corners[n, 2]
        inside = same & (np.linalg.norm(corners - corners[n], axis=1) <= reach[n])
        assert found[n] == np.median(values[inside]), n


def test_refinement_keeps_surface_without_texture():
    mesh = trimesh.creation.icosphere(3, 0.97)
    views = StubViews(trimesh.creation.icosphere(3, 1.0))
    for image in views.images:
        image[:] = 0.5
    surface = surface_of(mesh)
    moved = np.linalg.norm(refine(surface, views, [1]).vertices - mesh.vertices, axis=1)
    assert moved.max() < 0.2 * 4 / views.cameras[0].K[0, 0]
    views.labels = [np.zeros_like(label) for label in views.labels]
    views.masks = False
    np.testing.assert_allclose(refine(surface, views, [1]).vertices, mesh.vertices, atol=1e-12)
    views.indices = ()
    np.testing.assert_allclose(refine(surface, views, [1]).vertices, mesh.vertices, atol=1e-12)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [0.0, 1e-9])
def test_refinement_of_almost_nothing_is_finite(size):
    views = StubViews(trimesh.creation.icosphere(2, 1.0))
    vertices = 0.3 + size * np.eye(3)
    refined = refine(Surface(vertices, np.array([[0, 1, 2]], np.int32), np.zeros(1, bool)), views, [1])
    assert np.abs(refined.vertices - vertices).max() < 3 * 4 / views.cameras[0].K[0, 0]
    empty = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, bool))
    assert refine(empty, views, [1]) is empty


def face_normals(vertices, faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    across = np.cross(b - a, c - a)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_smoothing_removes_bumps_and_keeps_edges_and_size(shape):
    mesh = trimesh.creation.box((2, 2, 2)) if shape == "box" else trimesh.creation.icosphere(4, 1.0)
    while len(mesh.faces) < 5000:
        mesh = mesh.subdivide()
    surface = surface_of(mesh)
    edge = np.linalg.norm(
        mesh.vertices[mesh.edges_unique[:, 0]] - mesh.vertices[mesh.edges_unique[:, 1]], axis=1
    ).mean()
    noise = np.random.default_rng(0).normal(0, 0.15 * edge, len(mesh.vertices))
    surface.vertices = mesh.vertices + noise[:, None] * mesh.vertex_normals
    found = smooth(surface)
    np.testing.assert_array_equal(found.faces, surface.faces)

    def error_of(vertices):
        """Return the median angle in degrees to the true normals, and the median distance to the true surface."""
        cosine = (face_normals(vertices, mesh.faces) * face_normals(mesh.vertices, mesh.faces)).sum(1)
        size = np.abs(vertices).max(1) if shape == "box" else np.linalg.norm(vertices, axis=1)
        return np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))), np.median(np.abs(size - 1))

    (angle, distance), (before, far) = error_of(found.vertices), error_of(surface.vertices)
    assert angle < 0.35 * before and distance < far
    corners = np.abs(np.abs(mesh.vertices) - 1).max(1) < 1e-9
    if shape == "box":
        assert np.linalg.norm(found.vertices[corners] - mesh.vertices[corners], axis=1).max() < edge
    assert np.allclose(smooth(surface_of(mesh)).vertices, mesh.vertices, atol=0.05 * edge)


def test_smoothing_takes_open_and_degenerate_surfaces():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 2]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 4, 4], [1, 2, 2]], np.int32)
    for count in range(len(faces) + 1):
        surface = Surface(vertices, faces[:count], np.zeros(count, bool))
        np.testing.assert_allclose(smooth(surface).vertices, vertices, atol=1e-9)


def test_texture_size_follows_photo_resolution():
    mesh = trimesh.creation.icosphere(2, 1.0)
    views = StubViews(mesh, view_count=7, size=80)
    assert texture_size(surface_of(mesh), views) == 512
    for factor, size in ((2, 512), (4, 1024), (8, 2048), (16, 4096), (40, 4096)):
        views.cameras = [
            Camera(c.viewmat, np.diag([factor, factor, 1.0]) @ c.K, c.width * factor, c.height * factor)
            for c in StubViews(mesh, view_count=7, size=80).cameras
        ]
        assert texture_size(surface_of(mesh), views) == size


def test_texture_of_a_long_object_is_as_fine_as_its_photos():
    mesh = trimesh.creation.box((1.6, 0.1, 0.04)).subdivide().subdivide().subdivide()
    views = StubViews(mesh, view_count=7, size=16)
    views.cameras = [
        Camera(c.viewmat, np.diag([100.0, 100.0, 1.0]) @ c.K, c.width * 100, c.height * 100) for c in views.cameras
    ]
    surface = surface_of(mesh)
    assert texture_size(surface, views) == 512
    uvs, size = _unwrapped(surface, views, None)
    assert size == 1024 and areas(uvs).sum() < 0.3
    np.testing.assert_array_equal(uvs, unwrap(surface, 1024))
    assert _unwrapped(surface, views, 512)[1] == 512
