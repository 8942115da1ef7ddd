"""Surroundings without points, such as the sky: where they are, what the plan does, and what training makes of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from backend.capture import load_capture
from backend.mesh.views import Views
from backend.model.draw import draw
from backend.model.object_model import ObjectModel
from backend.planning.decisions import Choices, PlanningContext, decide
from backend.planning.surroundings import find_surroundings
from backend.training.extent import SURROUNDINGS, extent_of
from backend.training.initial_model import DistantPoints
from backend.training.settings import Settings
from backend.training.trainer import Trainer

NONE = np.zeros((0, 3))


def shade(directions: np.ndarray) -> np.ndarray:
    """Return the color (..., 3) of a sky in these directions, 0 .. 255."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return 128 + 100 * np.sin(3 * unit[..., [0, 1, 2]] + [0, 1, 2])


@pytest.fixture
def outdoors(write_capture, tmp_path):
    """Function that writes a capture of spheres before a sky, and returns it with the objects of its points."""

    def make(color=shade, **options):
        scene = write_capture(views=16, size=(96, 72), points=200, **options)
        rays = write_capture.rays_of(scene.lens())
        for name, viewmat, ids in zip(scene.names, scene.viewmats, scene.ids, strict=True):
            path = scene.folder / "images" / name
            image = np.array(Image.open(path))
            image[ids == 0] = color(rays @ viewmat[:3, :3])[ids == 0]
            Image.fromarray(image).save(path)
        return load_capture(scene.folder, tmp_path / "cache"), scene

    return make


def plan_of(capture, scene, **choices):
    return decide(PlanningContext(capture, Choices(**choices), point_ids=scene.point_objects, thorough=True))


@pytest.mark.parametrize("masks", [True, False])
def test_surroundings_are_where_no_points_are(outdoors, masks):
    capture, scene = outdoors(masks=masks)
    found = find_surroundings(capture, NONE)
    unlabeled = np.mean([(ids == 0).mean() for ids in scene.ids])
    assert 0.5 * unlabeled < found.fraction < unlabeled, "those beside the spheres, without a margin"
    center, radius = extent_of(capture)
    directions = (found.xyz - center) / (SURROUNDINGS * radius)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.abs(found.rgb - shade(directions)).mean() < 4
    nearest = np.sort(np.linalg.norm(found.xyz[:, None] - found.xyz, axis=2), axis=1)[:, 1]
    assert np.median(nearest) == pytest.approx(found.spacing, rel=0.2)


def test_plan_gives_surroundings_splats_unless_they_have_one_color(outdoors):
    capture, scene = outdoors()
    plan = plan_of(capture, scene)
    assert plan["surroundings"].done and plan["rest"].done and "show the surroundings" in plan["rest"].why
    plan = plan_of(capture, scene, leave_out=["surroundings"])
    assert not plan.does("surroundings") and not plan.does("rest")

    capture, scene = outdoors(color=lambda rays: np.full(rays.shape, 90), name="gray")
    plan = plan_of(capture, scene)
    assert not plan["surroundings"].done and "a single color" in plan["surroundings"].why and not plan["rest"].done
    assert plan_of(capture, scene, keep=["surroundings"]).does("surroundings")


def test_covered_photos_have_no_surroundings(outdoors):
    capture, scene = outdoors(spheres=[(3, np.zeros(3), 3.0)])
    plan = plan_of(capture, scene)
    found = find_surroundings(capture, NONE)
    assert found.fraction == 0 and not len(found.xyz)
    assert not plan["surroundings"].done and not plan["surroundings"].can_override and not plan["rest"].done


def test_training_starts_with_distant_anchors_of_no_object(outdoors):
    capture, scene = outdoors()
    found = find_surroundings(capture, NONE)
    far = DistantPoints(*found[:3])
    without, model = (
        Trainer.start(capture, scene.point_objects, Settings(offsets=2), surroundings=given).model
        for given in (None, far)
    )
    count = len(without.anchors)
    assert model.normalization == without.normalization and model.anchors.voxel == without.anchors.voxel
    assert torch.equal(model.anchors.rows[:count], without.anchors.rows)
    added = model.anchors.positions[count:].double().numpy()
    assert np.allclose(model.normalization.to_world(added), found.xyz, rtol=1e-5)
    assert not model.classes.ids[model.anchors.ids[count:]].any()
    extents = model.anchors.rows[count:, model.anchors.layout.extent_columns]
    assert np.allclose(extents.exp().numpy(), found.spacing * model.normalization.scale, rtol=1e-5)


@pytest.mark.long
def test_distant_splats_make_held_out_skies_better(outdoors):
    capture, scene = outdoors()
    far = DistantPoints(*find_surroundings(capture, NONE)[:3])
    errors = []
    for given in (None, far):
        trainer = Trainer.start(
            capture, scene.point_objects, Settings(offsets=4), surroundings=given, supervise_background=True
        )
        for step in range(120):
            trainer.step(step / 120)
        held_out = [sky_error(trainer.model, trainer.scene, i, scene.ids[i] == 0) for i in capture.test_indices]
        errors.append(float(np.mean(held_out)))
    assert errors[1] < 0.5 * errors[0], errors


def sky_error(model: ObjectModel, scene, index: int, sky: np.ndarray) -> float:
    """Return the root mean square error of the rendered sky, 0 .. 255."""
    rendered, photo = draw(model, scene.camera(index), want_ids=False).image, scene.capture.image(index)
    return float(np.sqrt(np.mean((255 * rendered[sky] - photo[sky]) ** 2)))


def test_no_mesh_is_made_of_surroundings(outdoors):
    capture, scene = outdoors()
    far = DistantPoints(*find_surroundings(capture, NONE)[:3])
    trainer = Trainer.start(capture, scene.point_objects, Settings(offsets=2), surroundings=far)
    views = Views(trainer.model, trainer.scene, capture.train_indices)
    views._turn_to(range(len(trainer.model.classes)))
    means = views._own_splats(views.camera(0)).means
    assert 0 < len(means) < len(trainer.model.generate().means)
    center, radius = extent_of(capture)
    world = trainer.model.normalization.to_world(means.double().numpy())
    assert np.linalg.norm(world - center, axis=1).max() < 0.5 * SURROUNDINGS * radius
