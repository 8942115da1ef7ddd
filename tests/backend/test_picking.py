"""The object at a pixel: against the renderer's object map, and in cases that the renderer does not support."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from backend.raster import Camera, object_map, rasterize
from backend.shared.splats.picking import BLOCK, Cloud, PickObject, View, ids_in, pick

SIZE = (64, 48)


def splats(count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Return means, quats, scales, opacities and IDs of six objects around the origin, with splats of all sizes."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * 0.5
    scales = np.exp(rng.uniform(np.log(0.002), np.log(0.3), (count, 3)))
    ids = 3 + (np.arctan2(means[:, 1], means[:, 0]) // (np.pi / 3)).astype(int)
    return means, rng.normal(size=(count, 4)), scales, rng.uniform(0.0, 1.0, count), ids


def objects_of(means, quats, scales, opacities, ids, matrix=None, blur=0.05) -> list[PickObject]:
    matrix = np.eye(4) if matrix is None else matrix
    return [
        PickObject(int(i), Cloud(*(of[ids == i] for of in (means, quats, scales, opacities)), blur), matrix)
        for i in np.unique(ids)
    ]


def view(distance: float = 3.0, **options) -> View:
    """Return a view from `distance` along z, slightly rolled, with an off-center principal point."""
    turned = np.array([[0.96, 0.28, 0, 0], [-0.28, 0.96, 0, 0], [0, 0, 1, distance], [0, 0, 0, 1]])
    return View(turned, 55.0, 60.0, 30.0, 26.0, *SIZE, **options)


def drawn(view: View, means, quats, scales, opacities, ids, blur=0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the renderer's IDs (-1: nothing), their probability, and alpha."""
    K = np.array([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1.0]])
    tensors = [torch.from_numpy(np.asarray(a, np.float32)) for a in (means, quats, scales, opacities)]
    sh = torch.zeros(len(means), 1, 3)
    rendered = rasterize(
        *tensors, sh, torch.from_numpy(ids.astype(np.int32)), Camera(view.viewmat, K, *SIZE, view.near, blur)
    )
    found, probability = object_map(rendered)
    return found, probability, rendered.alpha.numpy()


def assert_agrees(objects: list[PickObject], view: View, ids: np.ndarray, probability: np.ndarray) -> None:
    """Check on every third pixel that the pick has the rendered ID and its probability."""
    compared = 0
    for y in range(1, SIZE[1], 3):
        for x in range(1, SIZE[0], 3):
            seen = pick(objects, view, x + 0.5, y + 0.5)
            compared += 1
            if seen is None:
                assert ids[y, x] == -1
                continue
            assert seen.probability == pytest.approx(probability[y, x], abs=2e-4)
            assert seen.object_id == ids[y, x] or abs(seen.probability - probability[y, x]) < 1e-5
    assert compared > 300


@pytest.mark.parametrize(("distance", "blur"), [(3.0, 0.05), (0.4, 0.05), (3.0, 0.3)])
def test_pick_matches_renderer(distance, blur):
    """From outside and from inside the scene, where many splats are behind the camera or huge."""
    given = splats(600)
    seen = view(distance)
    ids, probability, _ = drawn(seen, *given, blur)
    assert (ids >= 0).mean() > 0.3
    assert_agrees(objects_of(*given, blur=blur), seen, ids, probability)


def test_transformed_object_is_picked():
    """An affine map has the same effect on the object as on the camera."""
    given = splats(200, seed=1)
    outer = np.array([[0.9, -0.3, 0, 0.4], [0.3, 0.9, 0.1, 0], [0, -0.1, 1.4, 0.2], [0, 0, 0, 1]])
    moved = view()
    seen = View(moved.viewmat @ outer, moved.fx, moved.fy, moved.cx, moved.cy, *SIZE)
    for x, y in ((30.5, 24.5), (20.5, 30.5), (40.5, 15.5)):
        assert pick(objects_of(*given, matrix=outer), moved, x, y) == pytest.approx(
            pick(objects_of(*given), seen, x, y), rel=1e-6
        )


def test_front_splats_occlude_and_hidden_objects_are_ignored():
    front = PickObject(7, one_splat((0, 0, -1), 0.2, 0.999), np.eye(4))
    behind = PickObject(9, one_splat((0, 0, 1), 0.4, 0.999), np.eye(4))
    middle = View(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1.0]]), 60, 60, 32, 24, *SIZE)
    seen = pick([behind, front], middle, 32, 24)
    assert seen.object_id == 7 and seen.depth == pytest.approx(2.0) and seen.probability == pytest.approx(0.99)
    assert pick([behind, PickObject(7, front.cloud, np.eye(4), hidden=True)], middle, 32, 24).object_id == 9
    # Two transparent splats of one object together outweigh the splat between them.
    parts = [PickObject(1, one_splat((0, 0, z), 0.5, 0.4), np.eye(4)) for z in (0, 1)]
    between = PickObject(2, one_splat((0, 0, 0.5), 0.5, 0.5), np.eye(4))
    assert pick([*parts, between], middle, 32, 24).object_id == 1
    assert pick([between], middle, 2, 2) is None and pick([], middle, 2, 2) is None
    assert (
        pick([PickObject(1, Cloud(*(np.zeros((0, n)) for n in (3, 4, 3)), np.zeros(0)), np.eye(4))], middle, 2, 2)
        is None
    )


def one_splat(place, size: float, opacity: float) -> Cloud:
    return Cloud(np.array([place], float), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), size), np.array([opacity]))


def test_pick_in_orthographic_view():
    """A splat's size is the same at every depth, and nearer splats hide farther ones."""
    flat = View(np.eye(4), 20.0, 20.0, 32.0, 24.0, *SIZE, near=-50.0, orthographic=True)
    far = PickObject(1, one_splat((0.5, 0, 30.0), 0.25, 0.9), np.eye(4))
    reach = np.sqrt(2 * np.log(0.9 * 255) * ((0.25 * 20) ** 2 + 0.3))
    assert pick([far], flat, 42 + reach - 0.1, 24).object_id == 1
    assert pick([far], flat, 42 + reach + 0.1, 24) is None
    near = PickObject(2, one_splat((0.5, 0, -30.0), 0.1, 0.9), np.eye(4))
    assert pick([far, near], flat, 42, 24).object_id == 2


def test_objects_in_rectangle():
    """Small objects in large rectangles are found; hidden objects are not."""
    camera = View(np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1.0]]), 600, 600, 320, 240, 640, 480)
    wall = PickObject(5, one_splat((0, 0, 1), 5.0, 0.999), np.eye(4))
    speck = PickObject(6, one_splat((0.41, 0.2, 0), 0.002, 0.999), np.eye(4))
    lost = PickObject(8, one_splat((0.41, 0.2, 9), 0.02, 0.999), np.eye(4))
    everything = [wall, speck, lost]
    assert ids_in(everything, camera, (0, 0, 640, 480)) == {5, 6}
    assert ids_in(everything, camera, (0, 0, 200, 480)) == {5}
    assert ids_in([speck], camera, (395, 275, 410, 290)) == {6}
    assert ids_in(everything, camera, (640, 0, 700, 480)) == set() == ids_in([], camera, (0, 0, 9, 9))


def test_view_from_opengl_matrices():
    """A `View` from OpenGL matrices projects to the same pixels as the matrices."""
    near, far = 0.1, 50.0
    perspective = np.array(
        [
            [1.5, 0, 0.2, 0],
            [0, 2.0, -0.1, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )
    parallel = np.array([[0.3, 0, 0, 0.1], [0, 0.4, 0, -0.2], [0, 0, -2 / (far + far), 0], [0, 0, 0, 1.0]])
    place = np.array([[1, 0, 0, 0.3], [0, 1, 0, -0.2], [0, 0, 1, -4.0], [0, 0, 0, 1]])
    point = np.array([0.5, 0.25, -1.0, 1.0])
    for projection, nearest in ((perspective, near), (parallel, -far)):
        found = View.of_matrices(place, projection, *SIZE)
        clip = projection @ place @ point
        expected = (clip[:2] / clip[3] * (1, -1) + 1) * 0.5 * SIZE
        assert found.pixels((found.viewmat @ point)[None, :3])[0] == pytest.approx(expected)
        assert found.near == pytest.approx(nearest) and found.orthographic == (projection is parallel)


def test_undrawable_splats_are_left_out():
    means, quats, scales, opacities, _ = splats(8)
    means[0, 0], quats[1], scales[2, 1], opacities[3], opacities[4] = np.nan, 0.0, np.inf, 0.003, np.nan
    assert Cloud(means, quats, scales, opacities).count == 3 < BLOCK


def test_picking_imports_no_compute_packages():
    code = "import sys; import backend.shared.splats.picking; sys.exit(bool({'torch', 'numba'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
