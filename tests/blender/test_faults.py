# SPDX-License-Identifier: GPL-3.0-or-later
"""Bad input and faults: one plain sentence for the user, and no damage to Blender's data or the folder."""

import dataclasses
import errno
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import headless

bpy = pytest.importorskip("bpy")

from objectgs import operators
from objectgs.backend.shared.errors import InputError
from objectgs.backend.shared.reconstruction.folder import Reconstruction
from objectgs.backend.shared.reconstruction.objects import read_objects
from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.blender import messages
from objectgs.objectgs_addon.environment import locations
from objectgs.objectgs_addon.environment.worker import layout
from objectgs.objectgs_addon.panels.objects import ObjectsPanel
from objectgs.objectgs_addon.panels.training.train import TrainPanel
from objectgs.objectgs_addon.process.jobs import Job, State
from objectgs.objectgs_addon.running import background, handlers, results
from objectgs.objectgs_addon.state import folder_trust, object_list
from objectgs.objectgs_addon.state.folder_state import folder_state
from objectgs.operators.setup import set_up_backend

from .drawn import texts_of

FIXTURES = headless.ROOT.parent / "shared" / "data" / "fixtures"
WAIT = 60.0

WORKS = """
import json, sys, time
print(json.dumps({"type": "status", "message": "Working"}), flush=True)
"""
ENDS = WORKS + 'print(json.dumps({"type": "done"}), flush=True)\n'
UNTIL_STOPPED = (
    WORKS
    + """
for line in sys.stdin:
    if line.strip() == "stop":
        break
print(json.dumps({"type": "done", "stopped": True, "message": "Saved"}), flush=True)
sys.exit(130)
"""
)


@pytest.fixture
def extension(fresh, tmp_path, monkeypatch):
    """The extension, registered in an empty file, with its folders in tmp_path."""
    root = headless.extension()
    monkeypatch.setattr(locations, "user_folder", lambda: tmp_path / "user")
    monkeypatch.setattr(locations.Path, "home", lambda: tmp_path / "home")
    monkeypatch.setattr(locations, "backend_environment", lambda _cache: {})  # reuse compiled kernels
    monkeypatch.delenv("OBJECTGS_PYTHON", raising=False)
    root.register()
    yield root
    root.unregister()
    background.queue.remove_finished()


@pytest.fixture
def popups(monkeypatch):
    """Messages of pop-ups."""
    sentences = []
    monkeypatch.setattr(messages, "show", lambda text, kind="INFO": sentences.append(text))
    return sentences


@pytest.fixture
def folder(trained, tmp_path) -> Path:
    """A copy of the trained reconstruction folder."""
    return Path(shutil.copytree(trained, tmp_path / "demo"))


@pytest.fixture
def shown(extension, folder):
    """Root collection of `folder` in the scene."""
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    return bpy.context.scene.objectgs.active


def error_report(operator, **options) -> str:
    """Return the error message of an operator that fails."""
    with pytest.raises(RuntimeError) as failed:
        operator(**options)
    return str(failed.value)


def is_plain_sentence(sentence: str) -> bool:
    return sentence.strip() != "" and "Traceback" not in sentence and "Errno" not in sentence


def job(tmp_path, code=ENDS, kind="train", folder=None, title="Fake") -> Job:
    """Return a job that runs the Python `code`."""
    script = tmp_path / f"fake-{len(list(tmp_path.glob('fake-*')))}.py"
    script.write_text(code, encoding="utf-8")
    return Job(title=title, kind=kind, folder=folder, command=[sys.executable, str(script)], cwd=tmp_path)


def start(job: Job, owner) -> Job:
    """Submit a job as `background.submit` does in a window."""
    background._submitted_in[job] = owner.session_uid
    background.queue.add(job)
    return job


def tick_until(condition) -> None:
    """Run the background timer until `condition()` holds."""
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline, "condition timed out"
        background._tick()
        time.sleep(0.01)


def run(job: Job, owner) -> Job:
    """Run a job until its result has been shown."""
    start(job, owner)
    tick_until(lambda: job.is_finished and not background._results)
    return job


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def blocks() -> dict[str, list[str]]:
    return {
        kind: sorted(block.name for block in getattr(bpy.data, kind))
        for kind in ("collections", "objects", "meshes", "cameras", "images", "materials")
    }


# The backend


def test_missing_backend_is_reported(extension, shown, capture):
    for operator in (bpy.ops.objectgs.assign_objects, bpy.ops.objectgs.train, bpy.ops.objectgs.check_backend):
        assert not operator.poll()
    assert "is not set up; allow online access, then press Set Up Backend" in error_report(bpy.ops.objectgs.train)
    assert "is not set up" in error_report(bpy.ops.objectgs.import_capture, directory=str(capture))


@pytest.mark.parametrize("with_backend", [False, True])
def test_every_disabled_operator_says_why(extension, folder, backend_python, monkeypatch, with_backend):
    """Without a reason, Blender's error names the context, and the tooltip of the button says nothing."""
    if with_backend:
        monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    disabled = set()
    for place in (None, folder):
        if place is not None:
            bpy.ops.objectgs.open_reconstruction(directory=str(place))
        for cls in operators._classes():
            operator = getattr(bpy.ops.objectgs, cls.bl_idname.partition(".")[2])
            if "INTERNAL" not in getattr(cls, "bl_options", ()) and not operator.poll():
                disabled.add(cls.bl_idname)
                assert "context is incorrect" not in error_report(operator), cls.bl_idname
    assert {"objectgs.stop_marking", "objectgs.remove_marked_object", "objectgs.train"} <= disabled
    assert ("objectgs.import_capture" in disabled) is not with_backend


def test_starts_of_jobs_are_undo_steps_that_are_not_repeated():
    """Undo during a training must not remove the import, and Adjust Last Operation must not train again."""
    names = ("train", "assign_objects", "analyze_capture", "import_masks", "clean_up_labels", "separate_marked")
    options = {cls.bl_idname: getattr(cls, "bl_options", set()) for cls in operators._classes()}
    for name in (*names, "extract_meshes"):
        assert "UNDO" in options[f"objectgs.{name}"] and "REGISTER" not in options[f"objectgs.{name}"]


def test_undo_after_the_start_of_a_training_keeps_the_import(extension, folder, backend_python, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    monkeypatch.setattr(background, "submit", lambda *_: {"FINISHED"})
    bpy.ops.ed.undo_push(message="Empty")
    for operator, options in (
        (bpy.ops.objectgs.open_reconstruction, {"directory": str(folder)}),
        (bpy.ops.objectgs.train, {}),
    ):
        assert operator("EXEC_DEFAULT", True, **options) == {"FINISHED"}
    bpy.ops.ed.undo()
    assert bpy.context.scene.objectgs.active is not None, "the start of the training was undone"
    bpy.ops.ed.undo()
    assert bpy.context.scene.objectgs.active is None


def test_disabled_imports_say_that_the_backend_is_being_set_up(extension, tmp_path):
    place = locations.environment_folder()
    start(job(tmp_path, UNTIL_STOPPED, kind="setup", folder=place), bpy.context.scene)
    assert "is being set up" in error_report(bpy.ops.objectgs.import_photos)


def test_outdated_backend_is_reported(extension, shown):
    place = locations.environment_folder()
    python = layout.environment_python(place)
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    (place / layout.STAMP).write_text("")
    marker = {
        "python": "3.11",
        "base": sys.executable,
        "requirements": "of another version",
        "packages": {},
        "device": "cpu",
    }
    (place / layout.MARKER).write_text(json.dumps(marker))
    assert "was set up for another version of ObjectGS" in error_report(bpy.ops.objectgs.train)
    (place / layout.MARKER).write_text("{")
    assert "ready.json cannot be read" in error_report(bpy.ops.objectgs.train)


def test_missing_python_is_reported(extension, shown, monkeypatch, tmp_path):
    monkeypatch.setenv("OBJECTGS_PYTHON", str(tmp_path / "gone"))
    assert f"{tmp_path / 'gone'} does not exist" in error_report(bpy.ops.objectgs.train)


@pytest.mark.parametrize("chosen", ["variable", "preference"])
def test_backend_that_would_not_be_used_is_not_set_up(extension, monkeypatch, chosen):
    monkeypatch.setattr(set_up_backend, "_online", lambda _cls: True)
    python, where = sys.executable, "unset OBJECTGS_PYTHON"
    if chosen == "preference":
        where = "clear Backend Python in the preferences"
        preferences = SimpleNamespace(backend_python=python, base_python="", device="cpu")
        monkeypatch.setattr(locations, "preferences", lambda: preferences)
    else:
        monkeypatch.setenv("OBJECTGS_PYTHON", python)
    report = error_report(bpy.ops.objectgs.set_up_backend)
    assert f"go on using {python}; {where}" in report and is_plain_sentence(report)
    assert not background.queue.jobs
    assert where in locations.backend_job("Train", "train", None, "train").if_silent


@pytest.mark.parametrize(
    ("name", "program", "sentence"),
    [
        ("no program", None, "could not be started (Permission denied); choose another Python"),
        ("no Python", "#!/bin/sh\nexit 0\n", "cannot run the backend; choose a Python 3.11"),
        ("too old", "#!/bin/sh\necho 'SyntaxError: invalid syntax' >&2\nexit 1\n", "cannot run the backend; choose a"),
    ],
)
def test_unsuitable_python_is_reported(extension, monkeypatch, capture, tmp_path, name, program, sentence):
    python = tmp_path / "python"
    python.write_text(program or "text")
    python.chmod(0o755 if program else 0o644)
    monkeypatch.setenv("OBJECTGS_PYTHON", str(python))
    before = blocks()
    report = error_report(bpy.ops.objectgs.import_capture, directory=str(capture), folder=str(tmp_path / "out"))
    assert sentence in report and str(python) in report and is_plain_sentence(report)
    assert blocks() == before and not (tmp_path / "out").exists()


def test_user_folder_that_cannot_be_made_is_not_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BLENDER_USER_DATAFILES", str(tmp_path / "file"))
    monkeypatch.setenv("BLENDER_USER_EXTENSIONS", str(tmp_path / "file"))
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    monkeypatch.chdir(tmp_path)
    assert locations.user_folder() == tmp_path / "file" / "objectgs"
    monkeypatch.setattr(locations, "PACKAGE", "bl_ext.user_default.objectgs")
    assert locations.user_folder() == tmp_path / "file" / ".user" / "user_default" / "objectgs"
    assert "is not set up" in locations.backend_sentence()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_headless_of_another_folder_uses_what_the_extension_set_up():
    addons, own = bpy.context.preferences.addons, locations.user_folder()
    assert not locations.PACKAGE.startswith("bl_ext.")
    addon = addons.new()
    try:
        addon.module = "bl_ext.user_default.objectgs"
        assert locations.user_folder() == Path(bpy.utils.extension_path_user(addon.module)) != own
    finally:
        addons.remove(addon)
    assert locations.user_folder() == own


def test_python_without_packages_is_reported(extension, monkeypatch, capture, tmp_path):
    """The Python of these tests has only bpy and NumPy."""
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    report = error_report(bpy.ops.objectgs.import_capture, directory=str(capture), folder=str(tmp_path / "out"))
    assert "lacks the package" in report and sys.executable in report and not (tmp_path / "out").exists()


# Importing


@pytest.mark.parametrize(
    "name", ["cameras_only", "truncated", "degenerate_two_images", "missing_cameras_subfolders_txt"]
)
@pytest.mark.long
def test_invalid_model_is_rejected(extension, backend_python, monkeypatch, tmp_path, name):
    if not (FIXTURES / name).is_dir():
        pytest.skip(f"{FIXTURES / name} is not here")
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    before = blocks()
    report = error_report(bpy.ops.objectgs.import_capture, directory=str(FIXTURES / name), folder=str(tmp_path / "out"))
    assert name in report and is_plain_sentence(report) and len(report.strip().splitlines()) == 1
    assert blocks() == before and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda place: None, "does not exist"),
        (lambda place: place.mkdir(), "cannot be read|does not|no COLMAP|missing"),
        (lambda place: place.write_text("a file"), "does not exist"),
    ],
)
@pytest.mark.long
def test_folder_without_capture_is_rejected(extension, backend_python, monkeypatch, tmp_path, make, sentence):
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    make(tmp_path / "capture")
    report = error_report(
        bpy.ops.objectgs.import_capture, directory=str(tmp_path / "capture"), folder=str(tmp_path / "out")
    )
    assert is_plain_sentence(report) and str(tmp_path / "capture") in report
    assert not (tmp_path / "out").exists() and not bpy.data.collections


def test_captures_of_equal_name_get_separate_folders(extension, tmp_path):
    from objectgs.objectgs_addon.state.folder_state import reconstruction_for

    first, second = tmp_path / "a" / "mug", tmp_path / "b" / "mug"
    taken = reconstruction_for(first, locations.new_reconstruction)
    taken.mkdir(parents=True)
    upright = {"rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}
    cameras = {"capture": str(first), "origin": [0.0, 0.0, 0.0], "upright": upright, "cameras": []}
    (taken / "cameras.json").write_text(json.dumps(cameras))
    (taken / "objectgs.json").write_text("{}")
    assert reconstruction_for(first, locations.new_reconstruction) == taken and reconstruction_for(
        second, locations.new_reconstruction
    ) == taken.with_name("mug-2")


def test_import_into_folder_in_use_is_rejected(extension, shown, folder, capture, tmp_path, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    running = start(job(tmp_path, UNTIL_STOPPED, folder=folder), bpy.context.scene)
    before = snapshot(folder)
    assert f"A job is using {folder}" in error_report(
        bpy.ops.objectgs.import_capture, directory=str(capture), folder=str(folder)
    )
    assert f"A job is using {folder}" in error_report(bpy.ops.objectgs.train)
    running.stop()
    tick_until(lambda: running.is_finished)
    hold_lock = f"""
from pathlib import Path
from types import SimpleNamespace
from backend.shared.reconstruction.lock import locked
with locked(Path({str(folder)!r})):
    print("locked", flush=True)
    input()
"""
    command, pipes = [sys.executable, "-c", hold_lock], {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, cwd=Path(headless.__file__).parent, **pipes) as other:
        assert other.stdout.readline().strip() == b"locked"
        report = error_report(bpy.ops.objectgs.import_capture, directory=str(capture), folder=str(folder))
        assert f"Another program (process {other.pid}) is using {folder}" in report
        other.communicate(b"\n")
    assert snapshot(folder) == before


# Files that disappear or break while in use


@pytest.mark.long
def test_deleted_capture_is_reported(extension, backend_python, capture, tmp_path, monkeypatch):
    """A running training keeps its result or reports an error; the Train operator then reports the missing capture."""
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    place = Path(shutil.copytree(capture, tmp_path / "capture"))
    bpy.ops.objectgs.import_capture(directory=str(place), folder=str(tmp_path / "out"))
    root = bpy.context.scene.objectgs.active
    training = locations.backend_job(
        "Train", "train", tmp_path / "out", "train", str(place), "--out", str(tmp_path / "out"), "--steps", "40"
    )
    start(training, bpy.context.scene)
    tick_until(lambda: training.step or training.is_finished)
    shutil.rmtree(place)
    tick_until(lambda: training.is_finished and not background._results)
    assert training.state is State.DONE or is_plain_sentence(training.error)
    assert not (tmp_path / "out" / ".lock").exists() and not list((tmp_path / "out").rglob("*.part"))
    assert scene.kind_of(root) == "reconstruction"
    assert f"The capture {place} is missing" in error_report(bpy.ops.objectgs.train)
    (tmp_path / "out" / "cameras.json").write_text("{}")
    assert "does not name the capture" in error_report(bpy.ops.objectgs.train)


def test_panels_name_a_missing_capture_before_its_masks(shown, folder, tmp_path):
    """Masks of a folder that is gone cannot be looked for, so that there are none would be wrong."""
    (folder / "splats.ply").unlink()
    shutil.rmtree(folder / "checkpoint")
    shown.objectgs.objects.clear()
    cameras = json.loads((folder / "cameras.json").read_text())
    gone = str(tmp_path / "gone")
    for name, trouble in ((gone, "gone is missing; put it back"), (None, "does not name the capture")):
        (folder / "cameras.json").write_text(json.dumps({**cameras, "capture": name}))
        texts = texts_of(TrainPanel)
        assert trouble in texts and "masks" not in texts
    (folder / "cameras.json").write_text(json.dumps({**cameras, "capture": gone}))
    assert "has no masks" not in texts_of(ObjectsPanel)
    (tmp_path / "gone").mkdir()
    assert "There are no masks" in texts_of(TrainPanel) and "has no masks" in texts_of(ObjectsPanel)


@pytest.fixture
def tiny_disk(tmp_path):
    """A mounted file system of 96 KiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=96k", "tmpfs", place], capture_output=True)
    if mounted.returncode:
        pytest.skip("mounting a tiny disk is not allowed here")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


@pytest.mark.long
def test_full_disk_is_reported(extension, backend_python, capture, tiny_disk, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    (tiny_disk / "filler").write_bytes(bytes(88 * 1024))
    report = error_report(bpy.ops.objectgs.import_capture, directory=str(capture), folder=str(tiny_disk / "out"))
    assert "No space left" in report and "free some space" in report and is_plain_sentence(report)
    assert not bpy.data.collections and not list(tiny_disk.rglob("*.part"))


def test_full_disk_reverts_edits(shown, folder, popups, monkeypatch):
    def full(_descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before, row = snapshot(folder), shown.objectgs.objects[1]
    name, color = row.name, tuple(row.color)
    monkeypatch.setattr(os, "fsync", full)
    row.name, row.color, row.chosen = "cup", (0.1, 0.2, 0.3), False
    assert (row.name, tuple(row.color), row.chosen) == (name, color, True)
    assert len(popups) == 3 and all("objects.json" in text and "free some space" in text for text in popups)
    assert "free some space" in error_report(
        bpy.ops.objectgs.merge_objects, into=str(scene.from_stored(shown.objectgs.objects[2].object_id))
    )
    assert snapshot(folder) == before


def test_file_without_folder_reports_errors(shown, folder, popups, tmp_path, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    shutil.rmtree(folder)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "old.blend"))
    root = bpy.context.scene.objectgs.active
    before = blocks()
    operators = bpy.ops.objectgs
    for operator in (
        operators.assign_objects,
        operators.train,
        operators.show_result,
        operators.show_preview,
        operators.merge_objects,
        operators.split_objects,
        operators.choose_objects,
    ):
        assert f"The folder {folder} of this reconstruction is missing" in error_report(operator)
    for operator in (operators.set_ground, operators.set_distance, operators.solo_object, operators.select_object):
        assert operator.poll(), "it does not use the folder"
    row = root.objectgs.objects[1]
    name, color = row.name, tuple(row.color)
    row.name, row.color, row.chosen = "cup", (0.1, 0.2, 0.3), False
    row.name = "  "
    assert (row.name, tuple(row.color), row.chosen) == (name, color, True)
    assert len(popups) == 3 and all(
        is_plain_sentence(text) and "objects.json does not exist" in text for text in popups
    )
    assert "has no cameras.json" in error_report(operators.open_reconstruction, directory=str(folder))
    assert blocks() == before and not folder.exists()


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"objects": null}',
        '{"objects": [{"id": 5e12, "name": "a", "color": [1, 2, 3], "points": 1}]}',
        '{"objects": [{"id": 1, "name": "a", "color": [1, 2, Infinity], "points": 1}]}',
    ],
)
def test_invalid_objects_file_is_reported(shown, folder, popups, tmp_path, content):
    (folder / "objects.json").write_text(content)
    before, there = snapshot(folder), blocks()
    row = shown.objectgs.objects[1]
    name = row.name
    row.name = "cup"
    assert row.name == name and len(popups) == 1 and "objects.json" in popups[0]
    report = error_report(bpy.ops.objectgs.show_result)
    assert "objects.json" in report and "delete it" in report and is_plain_sentence(report)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "broken.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "broken.blend"))
    handlers._undone()
    assert snapshot(folder) == before and blocks() == there


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cameras.json", b"{"),
        ("cameras.json", b'{"cameras": [{"name": "\\ud800"}]}'),
        ("points.ply", b"ply\n"),
        ("objects.json", b"[]"),
    ],
)
def test_invalid_folder_adds_no_data_blocks(extension, folder, name, content):
    (folder / name).write_bytes(content)
    before = blocks()
    report = error_report(bpy.ops.objectgs.open_reconstruction, directory=str(folder))
    assert name in report and is_plain_sentence(report) and blocks() == before
    assert bpy.context.scene.objectgs.active is None


def test_invalid_splats_keep_cameras_and_points(extension, folder):
    (folder / "splats.ply").write_bytes((folder / "splats.ply").read_bytes()[:-7])
    assert "splats.ply" in error_report(bpy.ops.objectgs.open_reconstruction, directory=str(folder))
    root = bpy.context.scene.objectgs.active
    assert not scene.object_collections(root) and len(root.objectgs.objects)


# Jobs whose scene changes while they run


def test_results_are_shown_in_their_scenes(extension, folder, trained, tmp_path):
    first = bpy.context.scene
    second, third = bpy.data.scenes.new("second"), bpy.data.scenes.new("third")
    other = Path(shutil.copytree(trained, tmp_path / "other"))
    (folder / "splats.ply").unlink()
    jobs = [
        start(job(tmp_path, kind="import", folder=folder, title="a"), first),
        start(job(tmp_path, kind="import", folder=other, title="b"), second),
        start(job(tmp_path, kind="import", folder=folder, title="c"), third),
        start(job(tmp_path, kind="train", folder=other, title="d"), second),
    ]
    background._tick()
    assert [entry.state for entry in jobs[1:]] == [State.WAITING] * 3
    first.name, second.name = "second", "renamed"
    tick_until(lambda: all(entry.is_finished for entry in jobs) and not background._results)
    for owner, place in ((first, folder), (second, other), (third, folder)):
        roots = [child for child in owner.collection.children_recursive if scene.kind_of(child) == "reconstruction"]
        assert roots == [owner.objectgs.active] and scene.folder_of(roots[0]) == place
    assert scene.object_collections(second.objectgs.active) and not scene.object_collections(first.objectgs.active)


def test_import_shows_what_was_trained_before(extension, folder, tmp_path):
    run(job(tmp_path, kind="import", folder=folder), bpy.context.scene)
    assert scene.object_collections(bpy.context.scene.objectgs.active)


@pytest.mark.parametrize("kind", ["import", "vote", "train"])
def test_result_after_scene_and_collection_were_deleted(extension, folder, popups, tmp_path, kind):
    owner = bpy.data.scenes.new("owner")
    root = scene.show_capture(owner, folder)
    work = start(job(tmp_path, kind=kind, folder=folder), owner)
    bpy.data.collections.remove(root)
    bpy.data.scenes.remove(owner)
    before = blocks()
    tick_until(lambda: work.is_finished and not background._results)
    assert len(popups) == 1 and "Open Reconstruction" in popups[0] and str(folder) in popups[0]
    assert blocks() == before
    popups.clear()
    run(job(tmp_path, kind=kind, folder=folder), bpy.context.scene)
    assert bool(bpy.context.scene.objectgs.active) == (kind == "import") and bool(popups) == (kind != "import")


def test_result_after_collection_was_renamed_and_unlinked(shown, folder, popups, tmp_path):
    work = start(job(tmp_path, folder=folder), bpy.context.scene)
    shown.name = "mine"
    bpy.context.scene.collection.children.unlink(shown)
    tick_until(lambda: work.is_finished and not background._results)
    assert shown.name == "mine" and shown in list(bpy.context.scene.collection.children) and not popups


def positions(root) -> dict[str, list[float]]:
    """Return rounded world positions: the first vertex of each mesh, and the origin of other objects."""
    bpy.context.view_layer.update()
    return {
        part.name: [
            round(value, 4)
            for value in (
                part.matrix_world @ part.data.vertices[0].co
                if part.type == "MESH" and part.data.vertices
                else part.matrix_world.translation
            )
        ]
        for part in root.all_objects
    }


def test_result_after_parents_were_deleted(shown, folder, tmp_path):
    before = positions(shown)
    parents = [part for part in shown.all_objects if scene.kind_of(part) in ("parent", "object_parent")]
    for part in parents[:3]:
        bpy.data.objects.remove(part)
    run(job(tmp_path, folder=folder), bpy.context.scene)
    assert bpy.ops.objectgs.show_result() == {"FINISHED"}
    assert positions(shown) == before


@pytest.mark.parametrize("with_objects", [True, False])
def test_result_after_collections_were_deleted(shown, folder, tmp_path, with_objects):
    """As with Delete in the Outliner, which moves objects to the parent collection, and with Delete Hierarchy."""
    before = positions(shown)
    for collection in list(shown.children_recursive):
        for part in list(collection.objects):
            if with_objects:
                bpy.data.objects.remove(part)
            else:
                shown.objects.link(part)
        bpy.data.collections.remove(collection)
    run(job(tmp_path, folder=folder), bpy.context.scene)
    assert bpy.ops.objectgs.show_result() == {"FINISHED"}
    assert positions(shown) == before
    assert [scene.kind_of(part) for part in shown.objects] == ["parent"]


@pytest.mark.parametrize("mode", ["EDIT", "SCULPT"])
def test_result_waits_for_object_mode(shown, folder, popups, tmp_path, mode):
    part = next(part for part in shown.all_objects if scene.kind_of(part) == "splats")
    name = part.name
    part.hide_set(False)
    bpy.context.view_layer.objects.active = part
    bpy.ops.object.mode_set(mode=mode)
    row = shown.objectgs.objects[1]
    row.name = "cup"
    assert row.name != "cup" and f"{name} is in {mode.title()} Mode" in popups.pop()
    assert f"is in {mode.title()} Mode" in error_report(bpy.ops.objectgs.show_result)
    work = start(job(tmp_path, folder=folder), bpy.context.scene)
    tick_until(lambda: work.is_finished)
    for _ in range(5):
        assert background._tick() is not None
    assert popups == [f"Fake has finished; the result will be shown when {name} is in Object Mode again."]
    assert background._results == [work]
    bpy.ops.object.mode_set(mode="OBJECT")
    background._tick()
    assert not background._results and len(popups) == 1


def test_result_waits_for_end_of_rendering(shown, folder, popups, tmp_path, monkeypatch):
    class Rendering:
        """bpy.app during a render."""

        def __getattr__(self, name):
            return getattr(bpy.app, name)

        def is_job_running(self, kind):
            return kind == "RENDER"

    class Blender:
        app = Rendering()

        def __getattr__(self, name):
            return getattr(bpy, name)

    monkeypatch.setattr(background, "bpy", Blender())
    calls = []
    monkeypatch.setattr(background, "finish", calls.append)
    work = start(job(tmp_path, folder=folder), bpy.context.scene)
    tick_until(lambda: work.is_finished)
    assert background._tick() is not None and not calls
    monkeypatch.setattr(background, "bpy", bpy)
    background._tick()
    assert calls == [work] and popups == ["Fake has finished; the result will be shown when rendering ends."]


def test_failed_result_does_not_stop_other_jobs(extension, folder, popups, tmp_path, monkeypatch):
    def fails(_job, _owner):
        raise ZeroDivisionError("on purpose")

    monkeypatch.setitem(results.SHOW_BY_KIND, "vote", fails)
    broken = start(job(tmp_path, kind="vote", folder=folder, title="Vote"), bpy.context.scene)
    works = start(job(tmp_path, kind="import", folder=folder), bpy.context.scene)
    tick_until(lambda: works.is_finished and not background._results)
    assert broken.state is State.DONE and bpy.context.scene.objectgs.active is not None
    assert popups == ["Vote: the result could not be shown (ZeroDivisionError: on purpose)"]


def imported(folder) -> Job:
    """Return an import of a folder, which has ended."""
    work = Job(title="Import", kind="import", folder=folder, command=[], cwd=folder)
    background._submitted_in[work] = bpy.context.scene.session_uid
    return work


def test_points_of_splats_that_cannot_be_shown_are_an_undo_step(extension, folder, monkeypatch):
    pushed = []
    monkeypatch.setattr(background.undo, "push", pushed.append)
    (folder / "splats.ply").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"splats\.ply"):
        background.finish(imported(folder))
    assert bpy.context.scene.objectgs.active is not None and pushed == ["Import"]


@pytest.mark.parametrize("is_outdated", [False, True])
def test_import_shows_only_splats_of_its_poses(extension, folder, monkeypatch, is_outdated):
    state = dataclasses.replace(folder_state(folder), outdated=is_outdated)
    monkeypatch.setattr(results, "folder_state", lambda _folder: state)
    background.finish(imported(folder))
    assert bool(scene.object_collections(bpy.context.scene.objectgs.active)) is not is_outdated


def test_new_poses_of_a_trained_capture_are_visible(extension, folder, monkeypatch):
    background.finish(imported(folder))
    root, layer = bpy.context.scene.objectgs.active, bpy.context.view_layer

    def seen() -> list[bool]:
        layer.update()
        return [part.visible_get() for part in root.all_objects if scene.kind_of(part) in ("camera", "points")]

    assert scene.object_collections(root) and not any(seen())
    state = dataclasses.replace(folder_state(folder), outdated=True)
    monkeypatch.setattr(results, "folder_state", lambda _folder: state)
    background.finish(imported(folder))
    assert len(seen()) > 1 and all(seen())


def test_folder_that_fails_does_not_stop_other_jobs(shown, folder, tmp_path, monkeypatch):
    """As a folder on a network at the moment when a job ends."""

    def fails(_folder):
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(folder / "points.ply"))

    refused = json.dumps({"type": "error", "message": "No image is there."})
    broken = start(job(tmp_path, f"print({refused!r})\nraise SystemExit(2)", folder=folder), bpy.context.scene)
    trained, waiting = start(job(tmp_path, folder=folder), bpy.context.scene), start(job(tmp_path), bpy.context.scene)
    told, finished = [], []
    monkeypatch.setattr(messages, "show", lambda message, *_options, **_more: told.append(message))
    monkeypatch.setattr(background, "finish", finished.append)
    monkeypatch.setattr(folder_trust, "folder_state", fails)
    tick_until(lambda: waiting.is_finished and not background._results)
    assert broken.state is State.FAILED and told == ["Fake: No image is there."] and finished == [trained, waiting]
    monkeypatch.setattr(background, "_remedy", fails)
    broken, waiting = start(job(tmp_path, folder=folder), bpy.context.scene), start(job(tmp_path), bpy.context.scene)
    tick_until(lambda: waiting.is_finished)
    assert "points.ply" in told[1]


def test_unregister_stops_running_job(extension, folder, popups, tmp_path):
    for _ in range(10):
        work = start(job(tmp_path, UNTIL_STOPPED, folder=folder), bpy.context.scene)
        tick_until(lambda work=work: work.message)
        extension.unregister()
        assert work.state is State.STOPPED and work.exit_code == 130
        extension.register()
        assert not background.busy(folder) and not background._submitted_in
    assert not popups


# Names and numbers


def rename(folder, names: dict[int, str]) -> None:
    """Change the names from the vote, as other labels would."""
    path = Reconstruction(folder).objects
    content = json.loads(path.read_text())
    for entry in content["objects"]:
        entry["name"] = names.get(entry["id"], entry["name"])
    path.write_text(json.dumps(content))


def test_unusual_names_are_shown(shown, folder):
    ids = [scene.from_stored(row.object_id) for row in shown.objectgs.objects if row.object_id][:5]
    odd = ["", 'Tasse\n☕\t/ \\ % "q"', "x" * 5000, "\ud800\0", "same", "same"]
    for names in (dict(zip(ids, odd)), dict(zip(ids, odd[2:])), dict.fromkeys(ids, "same")):
        rename(folder, names)
        assert bpy.ops.objectgs.show_result() == {"FINISHED"}
        collections = scene.object_collections(shown)
        assert set(ids) <= set(collections) and len({entry.name for entry in collections.values()}) == len(collections)
        assert all(collections[object_id].name and row.name for object_id, row in zip(ids, shown.objectgs.objects))
    row = shown.objectgs.objects[1]
    row.name = "  Größe \n 日本 "
    assert row.name == "Größe 日本" and row.name in {entry.name for entry in read_objects(folder / "objects.json")}


def test_many_objects_and_large_ids_are_supported(shown, folder):
    """300 rows with IDs up to 2^32 - 1 can be listed, chosen, merged, split and selected."""
    path = Reconstruction(folder).objects
    content = json.loads(path.read_text())
    small = [entry["id"] for entry in content["objects"]]
    large = [2**31 - 1, 2**31, 2**32 - 1]
    content["objects"] += [
        {"id": object_id, "name": f"thing {object_id}", "color": [1, 2, 3], "points": 0}
        for object_id in [*range(1000, 1300), *large]
    ]
    path.write_text(json.dumps(content))
    (folder / "splats.ply").write_bytes(with_large_ids(folder / "splats.ply", dict(zip(small[1:], large[1:]))))
    assert bpy.ops.objectgs.show_result() == {"FINISHED"}
    rows = shown.objectgs.objects
    listed = [scene.from_stored(row.object_id) for row in rows]
    assert len(rows) == len(small) + 303 and listed[-3:] == large
    assert set(large[1:]) <= set(scene.object_collections(shown))
    shown.objectgs.active_object = 9999
    assert object_list.active_item(shown) == rows[-1]
    shown.objectgs.active_object = len(rows) - 2
    assert bpy.ops.objectgs.select_object() == {"FINISHED"}
    assert {scene.object_id_of(part) for part in bpy.context.selected_objects} == {2**31}
    for part in bpy.context.selected_objects:
        part.select_set(False)
    assert bpy.ops.objectgs.merge_objects(into=str(2**32 - 1)) == {"FINISHED"}
    assert 2**31 not in scene.object_collections(shown)
    assert {entry.id: entry.merged_into for entry in read_objects(path)}[2**31] == 2**32 - 1
    shown.objectgs.active_object = len(rows) - 1
    assert bpy.ops.objectgs.split_objects() == {"FINISHED"}
    assert 2**31 in scene.object_collections(shown)
    assert bpy.ops.objectgs.choose_objects(which="ACTIVE") == {"FINISHED"}
    assert [entry.id for entry in read_objects(path) if not entry.left_out] == [2**32 - 1]
    assert bpy.ops.objectgs.solo_object() == {"FINISHED"}


def with_large_ids(path: Path, ids: dict[int, int]) -> bytes:
    """Return the bytes of splats.ply with some IDs replaced and object_id as an unsigned integer."""
    from objectgs.backend.shared.formats.ply import read_vertices, vertex_header

    table = read_vertices(path)
    dtype = np.dtype([(name, "<u4" if name == "object_id" else table.dtype[name]) for name in table.dtype.names])
    changed = np.empty(len(table), dtype)
    for name in table.dtype.names:
        changed[name] = table[name]
    for old, new in ids.items():
        changed["object_id"][table["object_id"] == old] = new
    return vertex_header(dtype, len(changed)) + changed.tobytes()


# Placing


def test_degenerate_points_are_rejected(shown):
    assert "on one line" in error_report(bpy.ops.objectgs.set_ground, points=(0, 0, 0, 1, 0, 0, 2, 0, 0))
    assert "coincide" in error_report(bpy.ops.objectgs.set_distance, points=(1, 1, 1, 1, 1, 1))
    bpy.data.objects.remove(next(part for part in shown.objects if scene.kind_of(part) == "parent"))
    report = error_report(bpy.ops.objectgs.set_ground, points=(0, 0, 0, 1, 0, 0, 0, 1, 0))
    assert "has lost its parent empty" in report


def test_folder_with_foreign_files_is_not_used(extension, tmp_path, monkeypatch):
    """A folder that the user names is refused; the automatic name gets a number."""
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    monkeypatch.setattr(locations, "reconstructions_folder", lambda: tmp_path / "all")
    jobs = []
    monkeypatch.setattr(background, "submit", lambda job, *_: jobs.append(job) or {"FINISHED"})
    (tmp_path / "garden").mkdir()
    (tmp_path / "all" / "garden").mkdir(parents=True)
    (tmp_path / "all" / "garden" / "thesis.odt").write_text("not yours")
    capture = str(tmp_path / "garden")
    report = error_report(bpy.ops.objectgs.import_capture, directory=capture, folder=str(tmp_path / "all" / "garden"))
    assert "thesis.odt" in report and not jobs
    bpy.ops.objectgs.import_capture(directory=capture)
    assert jobs[0].folder == tmp_path / "all" / "garden-2"
