# SPDX-License-Identifier: GPL-3.0-or-later
"""The camera that moves along the captured views, and the step that the first panel offers."""

import itertools
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.film.camera_path import make_path, path_order
from objectgs.objectgs_addon.panels.capture import CapturePanel
from objectgs.objectgs_addon.process.jobs import Job
from objectgs.objectgs_addon.running import background
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.state import folder_trust
from objectgs.objectgs_addon.state.folder_state import UNKNOWN
from objectgs.objectgs_addon.state.next_step import next_step

import headless

from .building import look_at, write_cameras, write_folder
from .drawn import texts_of


@pytest.fixture
def root(fresh, tmp_path):
    """A reconstruction with 30 cameras on a part of a circle, in a registered extension."""
    extension = headless.extension()
    extension.register()
    folder = write_folder(tmp_path / "table")
    write_cameras(folder, [look_at(3 * center + (0, 0, 1)) for center in circle(30)])
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    yield bpy.context.scene.objectgs.active
    extension.unregister()


def circle(count: int) -> np.ndarray:
    angles = np.linspace(0, 1.5 * np.pi, count)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], 1)


def test_ordered_cameras_keep_their_order():
    assert path_order(circle(20)).tolist() == list(range(20))
    assert path_order(circle(2)).tolist() == [0, 1] and path_order(np.zeros((1, 3))).tolist() == [0]


def test_unordered_cameras_are_put_in_order():
    shuffle = np.random.default_rng(0).permutation(20)
    shuffle[[0, int(np.flatnonzero(shuffle == 0)[0])]] = 0, shuffle[0]
    centers = circle(20)[shuffle]
    found = shuffle[path_order(centers)]
    assert found.tolist() == list(range(20))


def test_path_passes_through_views_of_an_excluded_capture(root):
    capture = kinds.capture_of(root)
    first = min((part for part in capture.objects if scene.kind_of(part) == "camera"), key=lambda part: part.name)
    first.data.clip_end = 77.0
    bpy.context.view_layer.layer_collection.children[root.name].children[capture.name].exclude = True
    kinds.parent_of(root).scale = (3, 3, 3)
    bpy.context.view_layer.update()
    assert bpy.ops.objectgs.camera_path() == {"FINISHED"}
    moving = bpy.context.scene.camera
    bpy.context.scene.frame_set(bpy.context.scene.frame_start)
    assert np.linalg.norm(moving.location) == pytest.approx(np.linalg.norm(scene.matrix_to_world(first)[:3, 3]), 1e-4)
    assert np.linalg.norm(moving.location) > 8 and moving.data.clip_end == 77.0


def test_path_passes_through_captured_views(root):
    owner = bpy.context.scene
    owner.frame_start, owner.frame_end = 1, 100
    assert bpy.ops.objectgs.camera_path() == {"FINISHED"}
    camera = owner.camera
    bpy.context.view_layer.update()
    start = np.array(camera.matrix_world)
    captured = sorted(
        (part for part in root.all_objects if scene.kind_of(part) == "camera"), key=lambda part: part["objectgs_image"]
    )
    assert scene.kind_of(camera) is None and camera.data.lens == pytest.approx(captured[0].data.lens)
    for frame, view in ((1, captured[0]), (100, captured[-1])):
        owner.frame_set(frame)
        assert np.allclose(np.array(camera.matrix_world), np.array(view.matrix_world), atol=1e-4)
    assert np.allclose(start, np.array(captured[0].matrix_world), atol=1e-4), "the frame is shown without a change"
    turns = []
    for frame in range(1, 101):
        owner.frame_set(frame)
        turns.append(camera.matrix_world.to_quaternion())
    steps = [first.rotation_difference(second).angle for first, second in itertools.pairwise(turns)]
    assert max(min(step, 2 * np.pi - step) for step in steps) < 0.2


def test_path_follows_numbers_without_zeros(root):
    """The names of 14 photos in the order of letters, 1, 10, 11, ..., 2, are a path that jumps back and forth."""
    cameras = sorted((part for part in root.all_objects if scene.kind_of(part) == "camera"), key=lambda part: part.name)
    for camera in cameras[14:]:
        bpy.data.objects.remove(camera)
    for number, camera in enumerate(cameras[:14], 1):
        camera["objectgs_image"] = f"IMG_{number}.jpg"
    owner = bpy.context.scene
    assert bpy.ops.objectgs.camera_path() == {"FINISHED"}
    places = []
    for frame in range(owner.frame_start, owner.frame_end + 1):
        owner.frame_set(frame)
        places.append(np.array(owner.camera.matrix_world)[:3, 3])
    travelled = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    direct = sum((b.location - a.location).length for a, b in itertools.pairwise(cameras[:14]))
    assert travelled == pytest.approx(direct, rel=0.05)


def test_path_of_many_cameras_needs_little_memory(fresh):
    data, cameras = bpy.data.cameras.new("lens"), []
    for center in np.random.default_rng(0).permutation(circle(3000))[:2500]:
        cameras.append(bpy.data.objects.new("photo", data))
        cameras[-1].location = center
    tracemalloc.start()
    moving = make_path(bpy.context.scene, cameras, 1, 100)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    bpy.context.scene.frame_set(1)
    assert (moving.location - cameras[0].location).length < 1e-6


@pytest.mark.parametrize("local", [False, True])
def test_camera_from_view_has_the_lens_of_the_camera_that_is_seen(root, local):
    """The viewport's local camera, if it has one, which is then replaced by the new one."""
    owner, (window,) = bpy.context.scene, bpy.context.window_manager.windows
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    space, region = area.spaces.active, next(region for region in area.regions if region.type == "WINDOW")
    of_scene, own = (bpy.data.objects.new(name, bpy.data.cameras.new(name)) for name in ("of scene", "own"))
    of_scene.data.lens, own.data.lens = 33.0, 77.0
    for camera in (of_scene, own):
        owner.collection.objects.link(camera)
    owner.camera = of_scene
    space.use_local_camera = local
    if local:
        space.camera = own
    space.region_3d.view_perspective = "CAMERA"
    with bpy.context.temp_override(window=window, area=area, region=region):
        assert bpy.ops.objectgs.camera_from_view() == {"FINISHED"}
    assert owner.camera not in (of_scene, own) and owner.camera.data.lens == (77.0 if local else 33.0)
    assert space.camera == owner.camera and space.region_3d.view_perspective == "CAMERA"


def test_next_step_follows_the_state(root, monkeypatch):
    owner = bpy.context.scene
    monkeypatch.setenv("OBJECTGS_PYTHON", "/no/such/python")
    assert next_step(root, owner).operator == "objectgs.set_up_backend"
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    assert next_step(None, owner).operator == "objectgs.import_capture"
    step = next_step(root, owner)
    assert (step.operator, step.options) == ("objectgs.clean_floaters", (("everything", True),))
    bpy.ops.objectgs.clean_floaters(everything=True)
    # The splats are not of a training, so there is nothing to extract meshes from.
    owner.view_settings.view_transform = "Raw"
    assert next_step(root, owner).operator == "objectgs.set_up_render"
    bpy.ops.objectgs.set_up_render()
    assert next_step(root, owner).operator == "objectgs.film_frames"


def test_next_step_that_waits_for_a_job_says_so(root, tmp_path, monkeypatch):
    """Either its tooltip does, where the operator refuses, or the panel."""
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    told = "wait for this job or stop it"
    assert told not in texts_of(CapturePanel)
    monkeypatch.setattr(background.queue, "jobs", [Job("Job", "mesh", scene.folder_of(root), ["true"], tmp_path)])
    assert f"For Clean Floaters, {told}." in texts_of(CapturePanel)
    bpy.ops.objectgs.clean_floaters(everything=True)
    bpy.ops.objectgs.set_up_render()
    assert next_step(root, bpy.context.scene).operator == "objectgs.film_frames" and told not in texts_of(CapturePanel)
    with pytest.raises(RuntimeError, match="A job is using"):
        bpy.ops.objectgs.film_frames()


def test_next_step_of_a_training_whose_capture_has_changed(root, tmp_path, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    (tmp_path / "capture" / "masks").mkdir(parents=True)
    trained = replace(UNKNOWN, imported=True, trained=True, steps=100, capture=tmp_path / "capture")
    root.objectgs.objects.clear()
    monkeypatch.setattr(folder_trust, "state_of", lambda _: trained)
    assert next_step(root, bpy.context.scene).operator == "objectgs.clean_up_labels"
    (tmp_path / "capture" / "masks" / "strokes.json").write_text("{}")
    assert next_step(root, bpy.context.scene).operator == "objectgs.start_marking"
    monkeypatch.setattr(folder_trust, "state_of", lambda _: replace(trained, outdated=True))
    step = next_step(root, bpy.context.scene)
    assert (step.operator, step.options) == ("objectgs.train", (("restart", True),))


def test_next_step_of_a_training_that_was_stopped(root, tmp_path, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    stopped = replace(UNKNOWN, imported=True, trained=True, steps=100, capture=tmp_path, unfinished=True)
    monkeypatch.setattr(folder_trust, "state_of", lambda _: stopped)
    (tmp_path / "masks").mkdir()
    assert next_step(root, bpy.context.scene).label == "Resume"
    bpy.ops.objectgs.clean_floaters(everything=True)
    assert next_step(root, bpy.context.scene).operator == "objectgs.extract_meshes", "it is good enough for the user"


def test_next_step_is_to_find_a_capture_that_was_moved(root, tmp_path, monkeypatch):
    """Only where photos are needed."""
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    capture = tmp_path / "capture"
    state = replace(UNKNOWN, imported=True, capture=capture)
    monkeypatch.setattr(folder_trust, "state_of", lambda _: state)
    step = next_step(root, bpy.context.scene)
    assert step.label == "Find Capture"
    assert dict(step.options) == {"folder": str(scene.folder_of(root)), "max_size": root.objectgs.max_size}
    job = Job("Extract Meshes", "mesh", scene.folder_of(root), ["false"], tmp_path)
    assert background._remedy(job)[:2] == ("objectgs.import_capture", "Find Capture...")
    capture.mkdir()
    photos = Job("Import a", "import", tmp_path, ["python", "-m", "backend", "import", "/a", "--out", "b"], tmp_path)
    photos.error = "/a contains 9 photos, but not where they were taken; compute that with Import Photos or Video."
    assert background._remedy(photos)[::2] == ("objectgs.import_photos", {"directory": "/a"})
    photos.error = "/a is damaged."
    assert background._remedy(photos)[0] == "objectgs.import_capture"
    assert next_step(root, bpy.context.scene).label == "Train" and background._remedy(job)[1] == "Try Again"
    state = replace(state, trained=True, steps=100, capture=tmp_path / "gone", meshes=3)
    bpy.context.scene.view_settings.view_transform = "Raw"
    assert next_step(root, bpy.context.scene).operator == "objectgs.set_up_render"
