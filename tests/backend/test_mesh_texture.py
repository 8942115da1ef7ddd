"""Meshes drawn, unwrapped and dressed: against geometry worked out by hand and scenes of known colours."""

from __future__ import annotations

import numpy as np
import trimesh

from backend.mesh.zbuffer import draw_mesh
from backend.raster import Camera


def camera_at(eye, target=(0.0, 0.0, 0.0), width=64, height=48, focal=60.0) -> Camera:
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return Camera(
        viewmat, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float64), width, height
    )


def test_each_pixel_sees_what_a_ray_hits_first():
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
        t = ((a - camera.centre) @ normal) / (rays @ normal)
        p = camera.centre + t[:, None] * rays
        inside = np.all([np.cross(q - o, p - o) @ normal >= 0 for o, q in ((a, b), (b, c), (c, a))], axis=0)
        closer = inside & (t > 0) & (t < nearest)
        nearest[closer], hit[closer] = t[closer], f
    assert (face.ravel() == hit).mean() > 0.998 and (hit >= 0).mean() > 0.2
    same = (face.ravel() == hit) & (hit >= 0)
    np.testing.assert_allclose(depth.ravel()[same], nearest[same], rtol=1e-6)
    assert (depth[face < 0] == 0).all()
    points = np.einsum("nij,ni->nj", corners[face.ravel()[same]], weights.reshape(-1, 3)[same].astype(np.float64))
    np.testing.assert_allclose(points, camera.centre + nearest[same, None] * rays[same], atol=1e-5)


def test_faces_that_reach_behind_the_camera_or_have_no_area():
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


def test_no_pixel_falls_between_faces_and_the_first_of_equal_faces_wins():
    mesh = trimesh.creation.icosphere(4, 1.0)
    _, face, _ = draw_mesh(mesh.vertices, mesh.faces, camera_at(np.zeros(3), (1.0, 1.0, 0.0)))
    assert (face >= 0).all()
    camera = camera_at(np.array([3.0, 0.5, 0.2]))
    _, once, _ = draw_mesh(mesh.vertices, mesh.faces, camera)
    _, twice, _ = draw_mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces]), camera)
    np.testing.assert_array_equal(once, twice)
