"""Surfaces from splats: views of an object, signed distance, and the closed mesh."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import binary_erosion, zoom

from backend.mesh.field.blocks import SAMPLES, Blocks
from backend.mesh.field.extract import extract, is_watertight
from backend.mesh.field.fusion import fuse
from backend.mesh.field.marching import march, parts
from backend.mesh.field.winding import Winding
from backend.mesh.surface import NoSurface
from backend.mesh.texture.zbuffer import draw_mesh
from backend.mesh.views import ObjectView, SceneMap, Views
from backend.model.generate import Generated
from backend.raster import Camera, rasterize
from backend.shared.class_table import ClassTable
from backend.shared.errors import Cancelled
from backend.shared.events import Reporter


def camera_at(camera_center, width=64, height=48, focal=60.0):
    """Return a camera at `camera_center` that looks at the origin, with z up."""
    camera_center = np.asarray(camera_center, float)
    forward = -camera_center / np.linalg.norm(camera_center)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ camera_center
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, width, height)


def sheet(x, class_index, half=0.5, step=0.05, color=0.5):
    """Return opaque splats on the plane at `x`, facing along x."""
    grid = np.arange(-half, half + 1e-6, step)
    y, z = (a.ravel() for a in np.meshgrid(grid, grid))
    n = len(y)
    return Generated(
        torch.tensor(np.stack([np.full(n, x), y, z], 1), dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.tensor([[0.002, step / 2, step / 2]]).repeat(n, 1),
        torch.full((n,), 0.97),
        torch.full((n, 1, 3), color),
        torch.full((n,), class_index, dtype=torch.int32),
        torch.arange(n),
    )


def together(*parts):
    """Concatenate the splats of all parts."""
    return Generated(*(torch.cat(tensors) for tensors in zip(*(part[:7] for part in parts))))


def views_of(splats, cameras, explicit=True, mask=None, primitive="3d", **options):
    """Return `Views` of plain splats; object IDs are ten times the class index."""

    def generate(seen=None, camera_center=None):
        assert explicit or camera_center is not None
        return splats if seen is None else splats.select(seen)

    anchors = SimpleNamespace(ids=splats.ids, positions=splats.means)
    model = SimpleNamespace(generate=generate, explicit=explicit, primitive=primitive, anchors=anchors)
    model.classes = ClassTable([0, 10, 20])
    capture = SimpleNamespace(mask=lambda index: mask)
    scene = SimpleNamespace(
        camera=lambda index: cameras[index], capture=capture,
        before_surroundings=lambda positions: torch.ones(len(positions), dtype=torch.bool),
    )  # fmt: skip
    return Views(model, scene, range(len(cameras)), **options)


@pytest.mark.parametrize("explicit", [True, False])
def test_object_view_has_unoccluded_depth_and_visibility(explicit):
    near, far = sheet(1.0, 1, half=0.3), sheet(0.0, 2)
    splats = together(near, far)
    cameras = [camera_at((4, 0, 0)), camera_at((-4, 0, 0)), camera_at((4, 0.5, 0.3))]
    views = views_of(splats, cameras, explicit)

    hidden = views.object_view(0, [2])
    y, x = 24 - hidden.y, 32 - hidden.x
    assert hidden.depth[y, x] == pytest.approx(4.0, abs=0.01)
    assert hidden.alpha[y, x] > 0.9
    assert hidden.visible[y, x] < 0.05
    assert hidden.visible[24 + 6 - hidden.y, 32 - hidden.x] < 0.05
    assert hidden.visible[24 + 7 - hidden.y, 32 + 7 - hidden.x] > 0.9
    assert hidden.color[y, x] == pytest.approx(0.5 + 0.282 * 0.5, abs=0.01)
    assert views.object_view(1, [2]).visible[y, x] > 0.99
    both = views.object_view(0, [2, 1])
    y, x = 24 - both.y, 32 - both.x
    assert both.visible[both.alpha > 0.9].min() > 0.99
    assert both.depth[y, x] == pytest.approx(3.0, abs=0.01)

    seen = views.scene_map(0)
    assert seen.ids[24, 32] == 1 and seen.ids[31, 39] == 2 and seen.ids[0, 0] == -1
    assert seen.depth[24, 32] == pytest.approx(3.0, abs=0.01)
    assert seen.depth[31, 39] == pytest.approx(4.0, abs=0.03)
    assert seen.depth[0, 0] == 0


def test_depth_is_certain_for_single_surface():
    veil, wall = sheet(1.0, 2, half=0.1), sheet(0.0, 2)
    veil = veil._replace(opacities=veil.opacities * 0.3)
    splats = together(veil, wall)
    camera = camera_at((4, 0, 0))
    for primitive in ("2d", "3d"):
        flat = {"quats": torch.tensor([[0.5, 0.5, 0.5, 0.5]]).repeat(len(splats.means), 1)} if primitive == "2d" else {}
        if flat:
            flat["scales"] = torch.full_like(splats.scales, 0.025)
        found = views_of(splats._replace(**flat), [camera], primitive=primitive).object_view(0, [2])
        y, x = 24 - found.y, 32 - found.x
        assert found.depth_uncertainty[y, x] > 0.2, primitive
        assert found.depth_uncertainty[y, x - 6] < 0.02 and found.depth[y, x - 6] == pytest.approx(4.0, abs=0.01)
        assert found.depth_uncertainty[found.alpha < 0.5].max() == 0
    # Where two discs share a surface, the depth lies between them; the median would lie on one of them.
    first, second = sheet(0.03, 2), sheet(0.0, 2)
    pair = together(first, second)
    pair = pair._replace(
        quats=torch.tensor([[0.5, 0.5, 0.5, 0.5]]).repeat(len(pair.means), 1),
        scales=torch.full_like(pair.scales, 0.025), opacities=pair.opacities * 0.3,
    )  # fmt: skip
    found = views_of(pair, [camera], primitive="2d").object_view(0, [2])
    depth = found.depth[24 - found.y, 32 - found.x]
    assert 3.972 < depth < 3.997


def test_depth_is_not_that_of_what_shines_through():
    front, back = sheet(0.0, 2), sheet(-2.0, 2, half=0.8)
    both = together(front._replace(opacities=front.opacities * 0.5), back)
    both = both._replace(
        quats=torch.tensor([[0.5, 0.5, 0.5, 0.5]]).repeat(len(both.means), 1),
        scales=torch.full_like(both.scales, 0.025),
    )
    found = views_of(both, [camera_at((4, 0, 0))], primitive="2d").object_view(0, [2])
    y, x = 24 - found.y, 32 - found.x
    assert found.alpha[y, x] > 0.5 and found.depth[y, x] == pytest.approx(4.0, abs=0.01)


def test_unlabeled_pixels_beside_object_are_not_visible():
    mask = np.zeros((48, 64), np.int32)
    mask[:, :32] = 20
    splats = sheet(0.0, 2)
    for given, seen in ((mask, 0), (np.zeros_like(mask), 1), (None, 1)):
        view = views_of(splats, [camera_at((4, 0, 0))], mask=given).object_view(0, [2])
        middle = 32 - view.x
        assert view.visible[:, :middle].max() > 0.99
        assert (view.visible[:, middle:].max() > 0.99) == seen
        assert view.alpha[:, middle:].max() > 0.9


def test_cropped_view_matches_full_view():
    splats = sheet(0.0, 2)
    camera = camera_at((4, 1.5, 0.3))
    view = views_of(splats, [camera]).object_view(0, [2])
    whole = rasterize(*splats[:6], camera, want_depth=True)
    h, w = view.alpha.shape
    assert h * w < camera.width * camera.height
    assert np.abs(view.alpha - whole.alpha.numpy()[view.y : view.y + h, view.x : view.x + w]).max() < 1e-4
    outside = whole.alpha.numpy().copy()
    outside[view.y : view.y + h, view.x : view.x + w] = 0
    assert outside.max() == 0


def test_out_of_view_and_absent_objects_have_no_view():
    views = views_of(sheet(0.0, 2), [camera_at((4, 0, 0)), camera_at((4, 0, 0))])
    assert views.object_view(0, [1]) is None
    behind = camera_at((4, 0, 0))
    behind.viewmat[2] *= -1
    behind.viewmat[0] *= -1
    assert views_of(sheet(0.0, 2), [behind]).object_view(0, [2]) is None


def test_view_cache_respects_memory_limit():
    cameras = [camera_at((4, 0.1 * i, 0)) for i in range(6)]
    views = views_of(sheet(0.0, 2), cameras, memory_mb=0.12)
    for _ in range(2):
        for i in range(6):
            assert views.object_view(i, [2]).depth.max() > 0
    held = [*views._maps.values(), *views._views.values()]
    size = sum(p.nbytes for v in held for p in vars(v).values() if isinstance(p, np.ndarray))
    assert 0 < size <= 0.12e6


def test_maps_are_rendered_once_for_each_object_and_kept_for_later_ones(monkeypatch):
    cameras = [camera_at((4, 0.1 * i, 0)) for i in range(6)]
    views = views_of(together(sheet(0.0, 1, half=0.3), sheet(1.0, 2, half=0.3)), cameras, memory_mb=0.25)
    drawn = []
    draw = Views._draw

    def counted(self, splats, camera):
        drawn.append(camera)
        return draw(self, splats, camera)

    monkeypatch.setattr(Views, "_draw", counted)

    def rendered_for(object_class, indices):
        """Return the number of renders of the whole scene, asked for twice, as for a mesh."""
        drawn.clear()
        for _ in range(2):
            for i in indices:
                views.object_view(i, [object_class])
                views.scene_map(i)
        return sum(any(camera is each for each in cameras) for camera in drawn)

    assert rendered_for(2, (0, 1, 2)) == 3
    assert rendered_for(1, (2, 3, 4)) == 2
    assert rendered_for(2, (3, 4, 5)) == 1
    held = [*views._maps.values(), *views._views.values()]
    assert sum(p.nbytes for v in held for p in vars(v).values() if isinstance(p, np.ndarray)) <= 0.25e6


# --- shapes that are seen exactly ------------------------------------------------------------------------------------


def ball(center=(0, 0, 0), radius=0.5):
    return lambda p: np.linalg.norm(p - np.array(center), axis=-1) - radius


def box(low, high):
    low, high = np.array(low, float), np.array(high, float)

    def distance(p):
        q = np.abs(p - (low + high) / 2) - (high - low) / 2
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)

    return distance


def ring(radius=0.4, thickness=0.15):
    def distance(p):
        across = np.hypot(p[..., 0], p[..., 2]) - radius
        return np.hypot(across, p[..., 1]) - thickness

    return distance


def bowl(radius=0.5, thickness=0.06):
    """Return the signed distance of the lower half of a hollow ball."""
    return lambda p: np.maximum(np.abs(np.linalg.norm(p, axis=-1) - radius) - thickness, p[..., 2])


def rod(a, b, radius):
    a, b = np.array(a, float), np.array(b, float)

    def distance(p):
        t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - radius

    return distance


class ExactViews:
    """Replacement for `Views` with exact depths and sharp edges, for shapes given by signed distance."""

    def __init__(self, shapes, cameras):
        self.shapes, self.cameras = list(shapes), list(cameras)
        self.indices = tuple(range(len(self.cameras)))
        self._alone = {}

    def depths(self, index):
        """Return the depth of each shape, (shapes, H, W), infinite where there is none."""
        if index not in self._alone:
            camera = self.cameras[index]
            u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
            K = camera.K
            rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
            rays = (rays @ camera.viewmat[:3, :3]).reshape(-1, 3)
            length = np.linalg.norm(rays, axis=1)
            self._alone[index] = np.array([self.trace(s, camera.center, rays / length[:, None]) for s in self.shapes])
            self._alone[index] = (self._alone[index] / length).reshape(len(self.shapes), *u.shape)
        return self._alone[index]

    @staticmethod
    def trace(shape, camera_center, rays):
        t, live = np.zeros(len(rays)), np.arange(len(rays))
        for _ in range(80):
            step = shape(camera_center + t[live, None] * rays[live])
            t[live] += step
            live = live[(np.abs(step) > 1e-6) & (t[live] < 20)]
            if not len(live):
                break
        t[live] = np.where(np.abs(shape(camera_center + t[live, None] * rays[live])) < 1e-4, t[live], np.inf)
        return np.where(t < 20, t, np.inf)

    def camera(self, index):
        return self.cameras[index]

    def scene_map(self, index):
        depths = self.depths(index)
        nearest = depths.min(0)
        hit = np.isfinite(nearest)
        ids = np.where(hit, depths.argmin(0), -1).astype(np.int32)
        one = hit.astype(np.float32)
        return SceneMap(self.cameras[index], np.where(hit, nearest, 0).astype(np.float32), 0 * one, ids, one)

    def object_view(self, index, classes):
        depth = self.depths(index)[list(classes)].min(0)
        hit = np.isfinite(depth)
        if not hit.any():
            return None
        v, u = np.nonzero(hit)
        place = np.s_[v.min() : v.max() + 1, u.min() : u.max() + 1]
        visible = np.isin(self.scene_map(index).ids, classes)[place].astype(np.float32)
        alpha = hit[place].astype(np.float32)
        depth = np.where(hit, depth, 0)[place].astype(np.float32)
        camera = self.cameras[index].crop(u.min(), v.min(), depth.shape[1], depth.shape[0])
        color = np.ones((*depth.shape, 3), np.float32)
        return ObjectView(camera, int(u.min()), int(v.min()), depth, 0 * alpha, alpha, color, visible)


def around(count=10, distance=2.5, heights=(-0.9, 0.2, 1.2), **options):
    """Return cameras around the origin at several heights."""
    cameras = []
    for i in range(count):
        height = heights[i % len(heights)]
        angle = 2 * np.pi * i / count + 0.1
        cameras.append(camera_at((distance * np.cos(angle), distance * np.sin(angle), height), **options))
    return cameras


def volume(surface):
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def holes(surface):
    """Return the genus: the number of handles, summed over the surface's parts."""
    count, _ = parts(surface.faces, len(surface.vertices))
    euler = len(surface.vertices) - len(surface.faces) // 2
    return count - euler / 2


def assert_valid_surface(surface):
    """Check that a surface is closed, two-manifold, oriented outward and finite, without loose vertices."""
    assert len(surface.faces) and np.isfinite(surface.vertices).all()
    assert len(surface.unobserved) == len(surface.faces)
    assert len(np.unique(surface.faces)) == len(surface.vertices)
    assert is_watertight(surface.faces)
    solid = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert volume(surface) > 0


def errors(surface, shape, seen_only=True):
    """Return the distances of the vertices from the true surface."""
    keep = np.unique(surface.faces[~surface.unobserved]) if seen_only else slice(None)
    return np.abs(shape(surface.vertices[keep]))


def test_field_is_the_same_where_memory_for_observations_ends(monkeypatch):
    views = ExactViews([ball((0.0, 0.0, 0.0), 0.5)], around(6))
    kept = fuse(views, [0])
    monkeypatch.setattr("backend.mesh.field.fusion._KEPT_BYTES", 1e6)
    again = fuse(views, [0])
    assert np.array_equal(kept.values, again.values) and np.array_equal(kept.seen, again.seen)


def test_views_that_look_elsewhere_are_not_rendered(monkeypatch):
    there = around(6)
    away = [replace(camera, viewmat=np.diag([-1.0, 1, -1, 1]) @ camera.viewmat) for camera in there]
    few, many = (ExactViews([ball((0.0, 0.0, 0.0), 0.5)], cameras) for cameras in (there, there + away))
    wanted, rendered = fuse(few, [0]), []
    monkeypatch.setattr(many, "scene_map", lambda index: rendered.append(index) or few.scene_map(index))
    monkeypatch.setattr(many, "object_view", lambda index, _: few.object_view(index, [0]) if index < 6 else None)
    found = fuse(many, [0])
    assert set(rendered) == set(range(6))
    assert np.array_equal(wanted.values, found.values) and np.array_equal(wanted.seen, found.seen)


def test_ball_is_reconstructed_accurately():
    shape = ball((0.03, -0.02, 0.05), 0.5)
    field = fuse(ExactViews([shape], around(12)), [0])
    surface = extract(field, faces=10**6)
    assert_valid_surface(surface)
    error = errors(surface, shape)
    assert error.mean() < 0.1 * field.voxel and np.quantile(error, 0.95) < 0.35 * field.voxel
    assert np.abs(surface.vertices.mean(0) - [0.03, -0.02, 0.05]).max() < 0.1 * field.voxel
    assert volume(surface) == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.02)
    assert holes(surface) == 0
    assert surface.unobserved.mean() < 0.02


def test_many_pixels_need_little_memory(monkeypatch):
    shape = ball((0.03, -0.02, 0.05), 0.5)
    views = ExactViews([shape], around(12))
    whole = fuse(views, [0])
    monkeypatch.setattr("backend.mesh.field.fusion._MOST_POINTS", 3000)
    field = fuse(views, [0])
    assert field.voxel == pytest.approx(whole.voxel, rel=0.03)
    assert errors(extract(field), shape).mean() < 0.12 * field.voxel
    assert volume(extract(field)) == pytest.approx(volume(extract(whole)), rel=0.01)


def test_box_far_from_origin_is_accurate():
    low, high = np.array([1000.1, 0.2, -0.3]), np.array([1000.7, 0.5, 0.3])
    cameras = []
    for camera in around(12, heights=(-1.5, 0.3, 1.6)):
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] -= viewmat[:3, :3] @ (low + high) / 2
        cameras.append(replace(camera, viewmat=viewmat))
    shape = box(low, high)
    field = fuse(ExactViews([shape], cameras), [0])
    surface = extract(field)
    assert_valid_surface(surface)
    assert errors(surface, shape).mean() < 0.2 * field.voxel
    assert volume(surface) == pytest.approx(np.prod(high - low), rel=0.06)


def test_ring_keeps_its_hole():
    shape = ring()
    surface = extract(fuse(ExactViews([shape], around(14)), [0]))
    assert_valid_surface(surface)
    assert holes(surface) == 1
    assert volume(surface) == pytest.approx(2 * np.pi**2 * 0.4 * 0.15**2, rel=0.06)


def test_bowl_stays_open():
    shape = bowl()
    field = fuse(ExactViews([shape], around(14, heights=(-1.5, 1.5, 2.5))), [0])
    surface = extract(field)
    assert_valid_surface(surface)
    assert volume(surface) == pytest.approx(2 / 3 * np.pi * (0.56**3 - 0.44**3), rel=0.06)
    assert errors(surface, shape).mean() < 0.2 * field.voxel


def test_object_on_table_gets_flat_base():
    cup = box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.7))
    table = box((-1.5, -1.5, -0.2), (1.5, 1.5, 0.0))
    views = ExactViews([cup, table], around(12, heights=(0.8, 1.4, 2.2)))
    field = fuse(views, [0])
    surface = extract(field)
    assert_valid_surface(surface)
    base = surface.faces[surface.unobserved]
    assert len(base)
    assert np.abs(surface.vertices[base][..., 2]).mean() < 0.5 * field.voxel
    assert surface.vertices[:, 2].min() > -1.2 * field.voxel
    assert volume(surface) == pytest.approx(0.6 * 0.6 * 0.7, rel=0.06)

    open_surface = extract(field, closed=False)
    assert not open_surface.unobserved.any()
    assert not is_watertight(open_surface.faces)
    assert open_surface.vertices[:, 2].min() > -field.voxel
    down = np.cross(*(open_surface.vertices[open_surface.faces[:, i]] - open_surface.vertices[open_surface.faces[:, 0]]
                      for i in (1, 2)))[:, 2]  # fmt: skip
    area = np.linalg.norm(down)
    assert (down < -0.9 * area).sum() == 0


def test_covered_part_of_sheet_is_closed():
    cup = box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.7))
    sheet_of_paper = box((-0.9, -0.9, -0.02), (0.9, 0.9, 0.0))
    views = ExactViews([cup, sheet_of_paper], around(14, distance=3.0, heights=(1.8, 2.2, 2.8), width=96, height=72))
    field = fuse(views, [1])
    surface = extract(field)
    assert_valid_surface(surface)
    assert holes(surface) == 0
    centers = surface.vertices[surface.faces].mean(1)
    normals = np.cross(*(surface.vertices[surface.faces[:, i]] - surface.vertices[surface.faces[:, 0]] for i in (1, 2)))
    cover = (np.abs(centers[:, :2]) < 0.2).all(1) & (normals[:, 2] > 0)
    assert cover.sum() > 10 and surface.unobserved[cover].all()
    assert np.abs(centers[cover, 2]).max() < field.voxel
    assert np.ptp(surface.vertices[:, 2]) < 6 * field.voxel


def test_occluded_space_is_unknown():
    target, wall = ball(radius=0.4), box((0.8, -1.5, -1.5), (0.9, 1.5, 1.5))
    views = ExactViews([target, wall], around(12))
    hidden = sum(views.scene_map(i).ids[24, 32] == 1 for i in views.indices)
    assert hidden >= 4
    surface = extract(fuse(views, [0]))
    assert_valid_surface(surface)
    # The other views fix the visible half of the ball; the hidden part is closed smoothly and not removed.
    assert volume(surface) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.12)


@pytest.mark.parametrize("finer", [1, 2])
def test_touching_objects_are_separated(finer):
    left, right = box((-0.6, -0.3, -0.3), (0.0, 0.3, 0.3)), box((0.0, -0.3, -0.3), (0.6, 0.3, 0.3))
    cameras = around(14, heights=(-1.5, 0.2, 1.6), width=64 * finer, height=48 * finer, focal=60.0 * finer)
    views = ExactViews([left, right], cameras)
    surfaces = [extract(fuse(views, [c])) for c in (0, 1)]
    for surface in surfaces:
        assert_valid_surface(surface)
        assert volume(surface) == pytest.approx(0.6**3, rel=0.08)
    two_pixels = 2 * 2.5 / (60 * finer)
    assert surfaces[0].vertices[:, 0].max() < two_pixels and surfaces[1].vertices[:, 0].min() > -two_pixels
    both = extract(fuse(views, [0, 1]))
    assert_valid_surface(both)
    assert parts(both.faces, len(both.vertices))[0] == 1
    assert volume(both) == pytest.approx(2 * 0.6**3, rel=0.06)


def test_poster_becomes_thin_slab():
    poster = box((-0.5, -0.01, -0.4), (0.5, 0.0, 0.4))
    cameras = [camera_at((x, 2.2, z)) for x in (-0.8, 0, 0.8) for z in (-0.5, 0.5)]
    field = fuse(ExactViews([poster], cameras), [0])
    surface = extract(field)
    assert_valid_surface(surface)
    assert np.ptp(surface.vertices[:, 1]) < 6 * field.voxel
    front = surface.vertices[np.unique(surface.faces[~surface.unobserved])]
    inner = np.abs(front[:, 0]) < 0.4
    assert np.abs(front[inner & (np.abs(front[:, 2]) < 0.3), 1]).max() < 0.3 * field.voxel
    assert surface.vertices[:, 0].max() == pytest.approx(0.5, abs=2 * field.voxel)


def test_depth_uncertainty_prevents_holes_in_sheet():
    class NoisyViews(ExactViews):
        """Views with independent depth errors up to `most`, which are reported as uncertainty if `reported`."""

        def __init__(self, *scene, most, reported):
            super().__init__(*scene)
            self.most, self.reported = most, reported

        def wrong(self, index):
            rough = np.random.default_rng(index).uniform(-self.most, self.most, (12, 16))
            return zoom(rough, 8, order=1).astype(np.float32)

        def object_view(self, index, classes):
            view = super().object_view(index, classes)
            wrong = self.wrong(index)[view.y :, view.x :][: view.alpha.shape[0], : view.alpha.shape[1]]
            depth = np.where(view.depth > 0, view.depth + wrong, 0).astype(np.float32)
            return replace(view, depth=depth, depth_uncertainty=np.abs(wrong) * self.reported)

        def scene_map(self, index):
            scene = super().scene_map(index)
            wrong = self.wrong(index)
            depth = np.where(scene.depth > 0, scene.depth + wrong, 0).astype(np.float32)
            return replace(scene, depth=depth, depth_uncertainty=np.abs(wrong) * self.reported)

    poster = box((-0.5, -0.01, -0.4), (0.5, 0.0, 0.4))
    cameras = [camera_at((x, 2.2, z), 128, 96, 120.0) for x in (-0.9, -0.3, 0.3, 0.9) for z in (-0.5, 0, 0.5)]
    in_front = camera_at((0, 2.2, 0), 128, 96, 120.0)
    seen = {}
    for reported in (False, True):
        surface = extract(fuse(NoisyViews([poster], cameras, most=0.25, reported=reported), [0]))
        assert_valid_surface(surface)
        depth, _, _ = draw_mesh(surface.vertices, surface.faces, in_front)
        seen[reported] = depth[48 - 17 : 48 + 17, 64 - 22 : 64 + 22]
    assert (seen[False] == 0).any() and (seen[True] > 0).all()
    wrong = {reported: np.abs(depth[depth > 0] - 2.2).mean() for reported, depth in seen.items()}
    assert wrong[True] < 0.04 and wrong[True] < wrong[False] / 2


@pytest.mark.parametrize("pixels", [0.0, 3.0, 6.0])
def test_walls_that_few_views_see_are_whole(pixels):
    """A floor and two walls, which have no inside behind them, with depths that are uncertain by some pixels."""

    class UncertainViews(ExactViews):
        def object_view(self, index, classes):
            view = super().object_view(index, classes)
            return replace(view, depth_uncertainty=view.depth * np.float32(pixels / self.cameras[index].K[0, 0]))

        def scene_map(self, index):
            scene = super().scene_map(index)
            return replace(scene, depth_uncertainty=scene.depth * np.float32(pixels / self.cameras[index].K[0, 0]))

    slabs = (
        box((-1.5, -1.5, -1.0), (1.5, 1.5, -0.9)),
        box((-1.5, 1.4, -1), (1.5, 1.5, 1)),
        box((1.4, -1.5, -1), (1.5, 1.5, 1)),
    )
    cameras = [camera_at((-2.4 + 0.5 * i, -2.6 - 0.3 * i, 0.5 - 0.3 * i), 96, 72, 60.0) for i in range(3)]
    field = fuse(UncertainViews([lambda p: np.min([s(p) for s in slabs], 0)], cameras), [0])
    surface = extract(field)
    assert_valid_surface(surface)
    shown, _, _ = draw_mesh(surface.vertices, surface.faces, cameras[1])
    true = UncertainViews([lambda p: np.min([s(p) for s in slabs], 0)], cameras).depths(1)[0]
    inner = binary_erosion(np.isfinite(true), iterations=6)
    assert (shown[inner] > 0).mean() > 0.97
    assert np.median(np.abs(shown[inner] - true[inner])) < field.voxel


def test_thin_handle_and_second_part_are_kept():
    shapes = [ball((-0.3, 0, 0), 0.25), rod((-0.1, 0, 0), (0.5, 0, 0.1), 0.035), ball((0.1, 0, 0.6), 0.12)]
    views = ExactViews([lambda p: np.min([s(p) for s in shapes], 0)], around(14))
    surface = extract(fuse(views, [0]))
    assert_valid_surface(surface)
    assert surface.vertices[:, 0].max() > 0.48
    assert parts(surface.faces, len(surface.vertices))[0] == 2


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_views_give_visible_side(count):
    shape = ball(radius=0.5)
    surface = extract(fuse(ExactViews([shape], around(6)[:count]), [0]))
    assert_valid_surface(surface)
    assert errors(surface, shape).mean() < 0.02
    assert 0.15 < surface.unobserved.mean() < 0.8
    assert np.linalg.norm(surface.vertices, axis=1).max() < 0.6


def test_object_cut_off_by_images_is_closed():
    beam = box((-5, -0.2, -0.2), (5, 0.2, 0.2))
    cameras = [camera_at((0.3 * i - 0.7, *at)) for i in range(5) for at in ((2.5, 1.2), (-2.5, 1.2), (0.1, -2.5))]
    surface = extract(fuse(ExactViews([beam], cameras), [0]))
    assert_valid_surface(surface)
    assert errors(surface, beam).mean() < 0.02
    assert 1.5 < np.ptp(surface.vertices[:, 0]) < 6


def test_room_that_is_seen_from_inside_has_its_walls():
    room = box((-1.0, -1.0, -0.7), (1.0, 1.0, 0.7))
    cameras = []
    for i in range(30):
        angle, pitch = 2 * np.pi * i / 10, (-0.9, 0.0, 0.9)[i // 10]
        across = np.array([np.cos(angle), np.sin(angle), 0.0])
        camera = camera_at(-across * np.cos(pitch) + [0, 0, -np.sin(pitch)], 96, 72, 43.0)
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] = -viewmat[:3, :3] @ across * 0.3
        cameras.append(replace(camera, viewmat=viewmat))
    surface = extract(fuse(ExactViews([lambda p: -room(p)], cameras), [0], resolution=32))
    assert is_watertight(surface.faces) and surface.unobserved.mean() < 0.1
    assert volume(surface) == pytest.approx(-2 * 2 * 1.4, rel=0.02), "it faces the inside of the room"
    assert errors(surface, room).mean() < 0.01


def test_part_that_reaches_far_out_is_cut_off_and_closed():
    def lamp(p):
        return np.minimum(box((-0.3, -0.3, 0), (0.3, 0.3, 0.8))(p), rod((-0.3, 0, 0.3), (-4.5, 0, 0.3), 0.04)(p))

    views = ExactViews([lamp], around(12, distance=3.0, heights=(0.8, 1.6, 2.4), width=160, height=120, focal=150.0))
    field = fuse(views, [0])
    surface = extract(field, faces=4000)
    assert_valid_surface(surface)
    assert surface.vertices[:, 0].min() < -3 and 2000 < len(surface.faces) <= 4000
    at_end = surface.vertices[surface.faces].mean(1)[:, 0] < surface.vertices[:, 0].min() + 0.5 * field.voxel
    assert surface.unobserved[at_end].all()


def test_more_faces_than_allowed_are_reported(monkeypatch):
    warnings = []
    reporter = Reporter()
    reporter.warning = warnings.append
    field = fuse(ExactViews([ball()], around(6)), [0])
    assert len(extract(field, faces=1000, reporter=reporter).faces) <= 1000 and not warnings
    monkeypatch.setattr("backend.mesh.field.extract._sound", lambda *_: None)
    assert len(extract(field, faces=1000, reporter=reporter).faces) > 1000
    assert len(warnings) == 1 and "more than 1,000" in warnings[0]


def test_object_without_views_is_reported():
    wall, hidden = box((1.0, -2, -2), (1.1, 2, 2)), ball(radius=0.3)
    views = ExactViews([hidden, wall], [camera_at((2.5, 0.1 * i, 0)) for i in range(3)])
    for classes in ([0], []):
        with pytest.raises(NoSurface, match=r"^[A-Z].*\.$"):
            fuse(views, classes) if classes else fuse(ExactViews([ball((9, 9, 9))], around(3)), [0])


def test_tiny_object_gives_mesh_or_error():
    for radius in (0.02, 0.05, 0.08):
        shape = ball((0.1, 0.2, 0), radius)
        try:
            surface = extract(fuse(ExactViews([shape], around(6)), [0]))
        except NoSurface:
            assert radius < 0.05
            continue
        assert_valid_surface(surface)
        assert errors(surface, shape, seen_only=False).mean() < 0.03


def test_three_splats_give_closed_mesh():
    cloud = sheet(0.0, 1, half=0.1, step=0.1)
    splats = cloud.select(slice(3))
    splats.scales[:] = 0.06
    surface = extract(fuse(views_of(splats, around(8)), [1]))
    assert_valid_surface(surface)
    assert np.abs(surface.vertices).max() < 0.4


def test_memory_scales_with_surface_and_respects_limit():
    views = ExactViews([ball()], around(6, width=128, height=96, focal=120.0))
    coarse, fine = (len(fuse(views, [0], resolution=n).blocks) for n in (32, 64))
    assert fine < 5 * coarse
    warnings = []
    reporter = Reporter()
    reporter.warning = warnings.append
    fuse(views, [0], resolution=32, memory_mb=(coarse - 1) * SAMPLES * 32 / 1e6, reporter=reporter)
    assert not warnings, "10 % coarser is not visible"
    small = fuse(views, [0], memory_mb=5, reporter=reporter, name="ball")
    assert len(small.blocks) * SAMPLES * 16 < 5e6
    assert warnings == ["The mesh of ball is coarser than the photos allow, to save memory."]
    surface = extract(small)
    assert_valid_surface(surface)
    assert errors(surface, ball()).mean() < 0.3 * small.voxel
    assert_valid_surface(extract(fuse(views, [0], memory_mb=0.1)))


def test_simplification_respects_face_budget_and_keeps_unobserved_marks():
    cup = box((-0.3, -0.3, 0.0), (0.3, 0.3, 0.7))
    views = ExactViews([cup, box((-1.5, -1.5, -0.2), (1.5, 1.5, 0.0))], around(12, heights=(0.8, 1.4, 2.2)))
    field = fuse(views, [0])
    for budget in (4000, 500):
        surface = extract(field, faces=budget)
        assert_valid_surface(surface)
        assert budget // 2 < len(surface.faces) <= budget
        centers = surface.vertices[surface.faces].mean(1)
        inner = (np.abs(centers[:, :2]) < 0.22).all(1)
        assert surface.unobserved[inner & (centers[:, 2] < 0.1)].all()
        assert not surface.unobserved[inner & (centers[:, 2] > 0.4)].any()
        assert errors(surface, cup).mean() < 0.3 * field.voxel
    assert len(extract(field, closed=False, faces=500).faces) <= 500


def test_fusion_reports_progress_and_stops():
    class Stopping(Reporter):
        seen = 0

        def progress(self, done, total, **fields):
            assert 0 <= done <= total
            self.seen += 1
            if self.seen == 3:
                raise Cancelled

    with pytest.raises(Cancelled):
        fuse(ExactViews([ball()], around(6)), [0], reporter=Stopping())


def test_marching_cubes_blocks_join_without_seam():
    grid = np.stack(np.meshgrid(*[np.arange(-5, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    blocks = Blocks(grid)
    local = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = grid[:, None] * 8 + local
    distance = np.linalg.norm(points - [0.4, -0.3, 1.2], axis=-1) - 30.0
    near = (np.abs(distance) < 14).any(1)
    blocks = Blocks(grid[near])
    values = distance[near].astype(np.float32)
    vertices, faces, seen = march(blocks, values, np.ones(values.shape, bool), True)
    assert is_watertight(faces) and seen.all()
    assert len(np.unique(np.round(vertices, 4), axis=0)) == len(vertices)
    assert len(vertices) - len(faces) // 2 == 2
    assert np.abs(np.linalg.norm(vertices - [0.4, -0.3, 1.2], axis=1) - 30).max() < 0.02


def test_winding_number_closes_hole_flat():
    points = trimesh.creation.icosphere(5, 20.0)
    grid = np.stack(np.meshgrid(*[np.arange(-5, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    local = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    place = (grid[:, None] * 8 + local).reshape(-1, 3)
    off = np.abs(np.linalg.norm(place, axis=1) - 20)
    every = np.ones((len(grid), SAMPLES), bool)
    found = Winding(points.vertices, points.faces).at(grid, every).ravel()
    inside = np.linalg.norm(place, axis=1) < 20
    assert np.abs(found - inside)[off > 3].max() < 0.05
    upper = points.faces[points.vertices[points.faces].mean(1)[:, 2] > 0]
    found = Winding(points.vertices, upper).at(grid, every).ravel()
    hole = np.linalg.norm(place[:, :2], axis=1) < 14
    assert (found[hole & (place[:, 2] == 2)] > 0.5).all()
    assert (found[hole & (place[:, 2] == -2)] < 0.5).all()


def test_open_surfaces_are_not_watertight():
    solid = trimesh.creation.box()
    assert is_watertight(solid.faces)
    assert not is_watertight(solid.faces[1:])
    assert not is_watertight(np.concatenate([solid.faces, solid.faces[:1]]))
    turned = solid.faces.copy()
    turned[0] = turned[0][::-1]
    assert not is_watertight(turned)
    assert not is_watertight(np.zeros((0, 3), int))


def test_surface_on_block_border_appears_once():
    # The surface is so close below sample 64, a border of the marching cubes, that float32 rounds it to the sample.
    grid = np.stack(np.meshgrid([0, 1], [0, 1], [7, 8], indexing="ij"), -1).reshape(-1, 3)
    blocks = Blocks(grid)
    places = 8 * grid[:, None] + np.stack(np.unravel_index(np.arange(SAMPLES), (8, 8, 8)), 1)
    values = (places[..., 2] - 64 + 1e-6).astype(np.float32)
    vertices, faces, seen = march(blocks, values, np.ones(values.shape, bool), True)
    assert seen.all() and np.abs(vertices[:, 2] - 64).max() < 1e-4
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(15 * 15)
