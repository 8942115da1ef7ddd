"""Blurred views: found by the contrast of details, whatever their direction, brightness and noise, and left out."""

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import correlate1d, gaussian_filter

from backend.capture import BLURRED, load_capture, measure_contrasts
from backend.planning.coverage import blurred_views
from backend.planning.decisions import Choices, PlanningContext, decide

VIEWS = 14


@pytest.fixture
def spheres(write_capture):
    """A capture of textured spheres, and its images (H, W, 3) as floats."""
    scene = write_capture(views=VIEWS, size=(240, 180), points=150)
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(60, 3)) * np.geomspace(4, 60, 60)[:, None]
    phases = rng.uniform(0, 2 * np.pi, (60, 3))
    rays = write_capture.rays_of(scene.lens())
    images = []
    for viewmat, depth in zip(scene.viewmats, scene.depths):
        hit = np.isfinite(depth)
        local = rays * np.where(hit, depth, 0)[..., None]
        world = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
        color = 128 + 9 * np.sin(np.einsum("hwc,kc->hwk", world, waves)[..., None] + phases).sum(2)
        images.append(np.where(hit[..., None], color, 40.0))
    return scene, images


def write_images(scene, images) -> None:
    for name, image in zip(scene.names, images):
        Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(scene.folder / "images" / name)


def shaken(image: np.ndarray, axis: int) -> np.ndarray:
    return correlate1d(image, np.full(17, 1 / 17), axis)


def test_blurred_views_are_found_and_others_are_not(spheres, tmp_path):
    scene, images = spheres
    images[2] = gaussian_filter(images[2], (3, 3, 0))
    images[5], images[9] = shaken(images[5], 0), shaken(images[9], 1)
    images[7] = 0.4 * images[7]
    images[11] = images[11] + np.random.default_rng(0).normal(0, 4, images[11].shape)
    write_images(scene, images)
    capture = load_capture(scene.folder, tmp_path / "cache")
    found = blurred_views(capture)
    assert set(found) == {2, 5, 9} & set(capture.train_indices) and all(share < BLURRED for share in found.values())
    contrasts = measure_contrasts(capture, range(VIEWS))
    sharp = [index for index in range(VIEWS) if index not in (2, 5, 9)]
    assert (contrasts[sharp] > 0.75).all() and (contrasts[[2, 5, 9]] < BLURRED).all()
    plan = decide(PlanningContext(capture, Choices()))
    assert plan.views_left_out == set(scene.names[index] for index in found)
    assert all(f"{scene.names[index]} (" in plan["blurred-views"].why for index in found)
    kept = decide(PlanningContext(capture, Choices(keep=["blurred-views"])))
    assert not kept.views_left_out


def test_blurred_views_that_alone_show_something_are_kept(spheres, tmp_path):
    scene, images = spheres
    images[2] = gaussian_filter(images[2], (3, 3, 0))
    write_images(scene, images)
    capture = load_capture(scene.folder, tmp_path / "cache")
    near = {scene.names[index] for index in (1, 3)}
    assert set(blurred_views(capture)) == {2}
    # Two other views see each point, of which the neighbors are gone: those across see the other side.
    assert blurred_views(capture.excluding_from_training(near | {scene.names[0], scene.names[4]})) == {}


@pytest.mark.long
def test_sharp_views_and_captures_without_points_in_common_are_not_blurred(spheres, tmp_path):
    scene, images = spheres
    write_images(scene, images)
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert blurred_views(capture) == {}
    assert (measure_contrasts(capture, [0, 7]) == 1.0).all()
    assert (measure_contrasts(capture, []) == []).all()
