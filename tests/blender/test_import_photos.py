# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Photos or Video: what the backend is asked for, of a folder, chosen photos and a video."""

import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

bpy = pytest.importorskip("bpy")

import objectgs as extension
from objectgs.backend.shared.errors import InputError
from objectgs.backend.shared.formats.photos_source import PhotosSource, write_source
from objectgs.backend.shared.photos.former_model import keep_former
from objectgs.backend.shared.photos.source_files import digest_of_files, has_poses_of
from objectgs.backend.shared.reconstruction.folder import Reconstruction
from objectgs.backend.shared.reconstruction.record import CaptureRecord, update_record
from objectgs.objectgs_addon.blender import messages
from objectgs.objectgs_addon.environment import locations
from objectgs.objectgs_addon.panels.capture import CapturePanel
from objectgs.objectgs_addon.process.jobs import Job, State
from objectgs.objectgs_addon.running import background, results
from objectgs.operators.capture import import_photos
from objectgs.operators.capture.open_reconstruction import OpenReconstruction

from .drawn import texts_of


@pytest.fixture
def submitted(fresh, tmp_path, monkeypatch):
    """The jobs that were submitted; captures are made in a folder of the test."""
    jobs = []
    extension.register()
    monkeypatch.setattr(locations, "user_folder", lambda: tmp_path / "user")
    monkeypatch.setattr(locations, "reconstructions_folder", lambda: tmp_path / "user")
    monkeypatch.setattr(locations, "backend_python", lambda: Path("/python"))
    monkeypatch.setattr(import_photos.background, "submit", lambda job, *_: jobs.append(job) or {"FINISHED"})
    for name in ("b.jpg", "a.heic", "walk.mov", "notes.txt"):
        (tmp_path / "trip").mkdir(exist_ok=True)
        (tmp_path / "trip" / name).write_bytes(b"")
    yield jobs
    extension.unregister()


@pytest.mark.parametrize(
    ("chosen", "sources", "name"),
    [
        ([], [""], "trip"),
        ([""], [""], "trip"),
        (["scene.blend"], [""], "trip"),
        (["b.jpg"], [""], "trip"),
        (["b.jpg", "a.heic"], ["a.heic", "b.jpg"], "trip"),
        (["walk.mov"], ["walk.mov"], "walk"),
    ],
)
def test_job_has_the_chosen_sources(submitted, tmp_path, chosen, sources, name):
    folder = tmp_path / "trip"
    files = [{"name": file} for file in chosen]
    bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(folder), files=files, frames=30)
    (job,) = submitted
    at = job.command.index("sfm")
    out = job.command.index("--out")
    assert job.command[at + 1 : out] == [str(folder / part if part else folder) for part in sources]
    assert job.command[job.command.index("--frames") + 1] == "30"
    assert job.folder == tmp_path / "user" / "captures" / name and job.kind == "sfm"


def test_calibration_must_exist_and_is_used_again(submitted, tmp_path):
    lenses = tmp_path / "cameras.txt"
    with pytest.raises(RuntimeError, match=r"cameras\.txt does not exist; choose another calibration"):
        bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(tmp_path / "trip"), calibration=str(lenses))
    lenses.write_text("1 SIMPLE_PINHOLE 640 480 600 320 240")
    bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(tmp_path / "trip"), calibration=str(lenses))
    capture = tmp_path / "capture"
    (capture / "sfm").mkdir(parents=True)
    write_source(capture, PhotosSource([tmp_path / "trip"], calibration=lenses))
    bpy.ops.objectgs.recompute_poses("EXEC_DEFAULT", capture=str(capture))
    for job in submitted:
        assert job.command[job.command.index("--calibration") + 1] == str(lenses)
    assert len(submitted) == 2


def test_button_of_the_file_browser_is_not_cut_off(submitted):
    """It has the name of the operator and room for 18 characters; the panel says more."""
    assert len(import_photos.ImportPhotos.bl_label) <= 18
    assert "objectgs.import_photos Import Photos or Video" in texts_of(CapturePanel)


def test_panel_tells_why_the_import_has_to_wait(submitted, tmp_path, monkeypatch):
    told = texts_of(CapturePanel)
    assert "The first button" in told and "wait for this job" not in told
    job = Job("Photos of trip", "sfm", tmp_path / "trip", ["true"], tmp_path)
    monkeypatch.setattr(background.queue, "jobs", [job])
    told = texts_of(CapturePanel)
    assert "To import something else, wait for this job or stop it." in told and "The first button" not in told


def test_folders_relative_to_an_unsaved_file_are_refused(fresh, registered, tmp_path, monkeypatch):
    """They would be in the working folder: for the backend, that of the extension, which an update deletes."""
    jobs, preferences = [], SimpleNamespace(reconstructions="//recs/", backend_python="", detector="", segmenter="")
    monkeypatch.setattr(background, "submit", lambda job, *_: jobs.append(job) or {"FINISHED"})
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    monkeypatch.setattr(locations, "preferences", lambda: preferences)
    (tmp_path / "trip").mkdir()
    refusal = r"The folder //recs/? is relative to the \.blend; save the \.blend first"
    for operator in (bpy.ops.objectgs.import_capture, bpy.ops.objectgs.import_photos):
        for chosen in ("", "//recs"):
            with pytest.raises(RuntimeError, match=refusal):
                operator("EXEC_DEFAULT", directory=str(tmp_path / "trip"), folder=chosen)
    # An absolute folder for the capture leaves that of the import that follows.
    with pytest.raises(RuntimeError, match=refusal):
        bpy.ops.objectgs.import_photos(directory=str(tmp_path / "trip"), folder=str(tmp_path / "capture"))
    with pytest.raises(RuntimeError, match=refusal):
        bpy.ops.objectgs.make_demo()
    assert not jobs
    assert results.trained_on(tmp_path / "trip") == []
    opened = SimpleNamespace(directory="")
    context = SimpleNamespace(window_manager=SimpleNamespace(fileselect_add=lambda _: None))
    assert OpenReconstruction.invoke(opened, context, None) == {"RUNNING_MODAL"} and opened.directory == ""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    with pytest.raises(RuntimeError, match="The folder recs/trip is relative, or without a drive; choose another"):
        bpy.ops.objectgs.import_capture(directory=str(tmp_path / "trip"), folder="recs/trip")
    for chosen, folder in (("", tmp_path / "recs" / "trip"), ("//mine", tmp_path / "mine")):
        bpy.ops.objectgs.import_capture(directory=str(tmp_path / "trip"), folder=chosen)
        assert jobs.pop().folder == folder and not jobs


@pytest.mark.parametrize(
    "make", [locations.demo_job, lambda: locations.sfm_job(Path("/trip"), PhotosSource([Path("/trip")]))]
)
def test_a_capture_that_cannot_be_imported_is_named(fresh, registered, monkeypatch, make):
    """The folder in the preferences, or the .blend, can change while the capture is made."""
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    job = make()
    monkeypatch.setattr(locations, "reconstructions_folder", lambda: locations.absolute("//recs/"))
    background._submitted_in[job] = bpy.context.scene.session_uid
    with pytest.raises(InputError) as caught:
        background.finish(job)
    start = f"The new capture is in {job.folder}; use Import Capture, since this failed: The folder //recs/ is relative"
    assert str(caught.value).startswith(start)


def test_same_sources_continue_in_their_capture(submitted, tmp_path):
    folder, first = tmp_path / "trip", tmp_path / "user" / "captures" / "trip"
    (first / "sfm").mkdir(parents=True)
    write_source(first, PhotosSource([folder], leave_out=["1.jpg"]))
    assert locations.new_capture([folder]) == first
    assert locations.new_capture([folder / "a.heic", folder / "b.jpg"]).name == "trip-2"
    bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(folder))
    assert submitted[0].folder == first and "--frames" not in submitted[0].command


@pytest.fixture
def shown(monkeypatch):
    """Texts and options of the messages that are shown."""
    found = []
    monkeypatch.setattr(background.messages, "show", lambda text, **options: found.append({"text": text, **options}))
    return found


def test_weak_photos_are_left_out(submitted, shown, tmp_path):
    """The button of the message computes the poses again, also without those that were left out before."""
    capture = tmp_path / "capture"
    (capture / "sfm").mkdir(parents=True)
    networks = tmp_path / "networks"
    write_source(capture, PhotosSource([tmp_path / "trip"], "one", 12, ["1.jpg"], "objects", 3, matcher=networks))
    job = locations.sfm_job(capture, PhotosSource([tmp_path / "trip"]))
    job.result = {"weak": ["a b.jpg", "2.jpg"], "separate_sets": [], "set": 1}
    job.message = "2 of 2 photos have a pose. The photos of the scene do not tell its true size."
    background._show_poses(job)
    (options,) = shown
    assert options.pop("text").endswith("Set Distance in the panel Placement gives it.")
    assert options.pop("label") == "Leave Out 2 Weak Photos" and options.pop("operator") == "objectgs.recompute_poses"
    bpy.ops.objectgs.recompute_poses("EXEC_DEFAULT", **options)
    command = submitted[0].command
    assert command[command.index("--leave-out") + 1 :][:3] == ["1.jpg", "a b.jpg", "2.jpg"]
    assert command[command.index("--cameras") + 1] == "one" and command[command.index("--frames") + 1] == "12"
    assert command[command.index("--features") + 1] == "objects" and command[command.index("--set") + 1] == "3"
    assert command[command.index("--matcher") + 1] == str(networks)
    with pytest.raises(RuntimeError, match="was not made by Import Photos"):
        bpy.ops.objectgs.recompute_poses("EXEC_DEFAULT", capture=str(tmp_path))


@pytest.mark.parametrize(
    ("used", "label", "number"), [(1, "Use Set 2 (12 Photos)", "2"), (2, "Use Set 1 (40 Photos)", "")]
)
def test_another_set_of_photos_is_used(submitted, shown, tmp_path, used, label, number):
    """Separate sets are offered one after another, before weak photos."""
    capture = tmp_path / "capture"
    (capture / "sfm").mkdir(parents=True)
    write_source(capture, PhotosSource([tmp_path / "trip"], set=used))
    job = locations.sfm_job(capture, PhotosSource([tmp_path / "trip"]))
    job.result = {"weak": ["2.jpg"], "separate_sets": [40, 12], "set": used}
    background._show_poses(job)
    (options,) = shown
    assert options.pop("label") == label
    bpy.ops.objectgs.recompute_poses("EXEC_DEFAULT", **{key: options[key] for key in ("capture", "photo_set")})
    command = submitted[0].command
    assert "--leave-out" not in command
    assert command[command.index("--set") + 1] == number if number else "--set" not in command


@pytest.fixture
def computed(submitted, tmp_path):
    """A capture with poses of the photos in a folder."""
    capture = tmp_path / "user" / "captures" / "trip"
    (capture / "sparse" / "0").mkdir(parents=True)
    (capture / "sfm").mkdir()
    write_source(capture, PhotosSource([tmp_path / "trip"], features="objects", leave_out=["1.jpg"]))
    files = digest_of_files(PhotosSource([tmp_path / "trip"]), capture)
    (capture / "sfm" / "sfm.json").write_text(json.dumps({"files": files}))
    return capture


def test_photos_with_poses_are_imported_as_they_are(submitted, computed, shown, tmp_path):
    def imported(**options):
        bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(tmp_path / "trip"), **options)
        return submitted.pop()

    job = imported()
    assert job.kind == "import" and job.folder == tmp_path / "user" / "trip"
    assert job.command[job.command.index("import") + 1] == str(computed) and "--max-size" not in job.command
    (message,) = shown
    assert message.pop("text").endswith(f"are in {computed} already, and are imported as they are.")
    assert message == {"operator": "objectgs.recompute_poses", "label": "Compute Poses Again", "capture": str(computed)}
    job.folder.mkdir()
    update_record(Reconstruction(job.folder), capture=CaptureRecord(str(computed), 800, "digest"))
    assert imported().command[-3:-1] == ["--max-size", "800"]
    assert imported(cameras="one").kind == "sfm"


def test_poses_before_a_killed_run_are_imported(submitted, computed, shown, tmp_path):
    (computed / "sparse" / "0" / "images.bin").write_bytes(b"whole")
    keep_former(computed)
    (computed / "sparse" / "0" / "images.bin").write_bytes(b"half-made")
    write_source(computed, PhotosSource([tmp_path / "trip"], cameras="one"))
    bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(tmp_path / "trip"))
    assert submitted[0].kind == "import" and shown[0]["text"].endswith("are imported as they are.")
    assert (computed / "sparse" / "0" / "images.bin").read_bytes() == b"whole"


def test_only_changes_of_photos_count(submitted, computed, tmp_path):
    folder = tmp_path / "trip"
    wanted = PhotosSource([folder])
    earlier = (folder / "b.jpg").stat().st_mtime_ns - 10**12
    (folder / "earlier" / "sfm").mkdir(parents=True)
    (folder / "splats" / "meshes").mkdir(parents=True)
    results = ("earlier/sfm/source.json", "earlier/1.jpg", "splats/objectgs.json", "splats/meshes/mug.png")
    for name in (".DS_Store", "._b.jpg", "b.xmp", "labels.json", *results):
        (folder / name).write_bytes(b"")
    (folder / "notes.txt").write_bytes(b"more")
    (folder / "b.jpg").chmod(0o600)
    assert has_poses_of(computed, wanted)
    (folder / "c.jpg").write_bytes(b"")
    os.utime(folder / "c.jpg", ns=(earlier, earlier))
    assert not has_poses_of(computed, wanted), "a photo that was taken before"
    (folder / "c.jpg").unlink()
    assert has_poses_of(computed, wanted)
    os.utime(folder / "b.jpg")
    assert not has_poses_of(computed, wanted)
    (folder / "b.jpg").unlink()
    assert not has_poses_of(computed, wanted)
    (computed / "sfm" / "sfm.json").write_text("{}")
    assert has_poses_of(computed, wanted), "as of an earlier version"
    later = (computed / "sfm" / "sfm.json").stat().st_mtime_ns + 10**9
    os.utime(folder / "notes.txt", ns=(later, later))
    assert has_poses_of(computed, wanted)
    (folder / "c.jpg").write_bytes(b"")
    os.utime(folder / "c.jpg", ns=(later, later))
    assert not has_poses_of(computed, wanted), "as of an earlier version, with a new photo"


@pytest.mark.parametrize("place", ["images", "masks"])
@pytest.mark.parametrize("name", ["labels.json", "test.txt"])
def test_lists_count_where_they_are_copied(submitted, computed, tmp_path, place, name):
    """They lie beside a folder of photos or of masks; those of a capture are its own."""
    folder = tmp_path / "trip"
    (folder / place).mkdir()
    (folder / place / "b.jpg").write_bytes(b"")
    wanted = PhotosSource([folder])
    before, own = digest_of_files(wanted, computed), digest_of_files(wanted, folder)
    for other in ("notes.json", f"{place}/{name}"):
        (folder / other).write_text("{}")
    assert digest_of_files(wanted, computed) == before
    (folder / name).write_text("{}")
    assert digest_of_files(wanted, computed) != before and digest_of_files(wanted, folder) == own


def test_messages_about_earlier_poses_go_with_new_ones(submitted, computed, monkeypatch):
    """Those of other captures stay."""
    told = [
        messages.Message("about", operator="objectgs.recompute_poses", options={"capture": str(capture), "set": 2})
        for capture in (computed, computed.parent / "other")
    ]
    monkeypatch.setattr(messages, "_messages", list(told))
    bpy.ops.objectgs.recompute_poses("EXEC_DEFAULT", capture=str(computed))
    assert messages._messages == told[1:]


def test_message_about_poses_goes_when_they_have_been_trained_on(submitted, computed, shown, tmp_path, monkeypatch):
    poses = locations.sfm_job(computed, PhotosSource([tmp_path / "trip"]))
    poses.result = {"weak": ["2.jpg"]}
    background._show_poses(poses)
    told = [messages.Message(shown[0]["text"], operator="objectgs.recompute_poses"), messages.Message("Other.")]
    monkeypatch.setattr(messages, "_messages", list(told))
    monkeypatch.setattr(results, "roots_of", lambda _folder: ["root"])
    monkeypatch.setattr(background.folder_trust, "state_of", lambda _root: SimpleNamespace(capture=computed))
    for kind, left in (("import", told), ("train", told[1:])):
        job = Job("Job", kind, tmp_path / "trip", ["true"], tmp_path)
        job.state = State.DONE
        background._handle_end(job)
        background._results.clear()
        assert messages._messages == left


def test_new_poses_for_a_training_are_asked_about(submitted, computed, shown, tmp_path, monkeypatch):
    """The training need not be in this file."""
    monkeypatch.setattr(results, "folder_state", lambda _folder: SimpleNamespace(steps=100, capture=computed))
    assert results.trained_on(computed) == ["trip"]
    bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(tmp_path / "trip"), cameras="one")
    assert not submitted
    (options,) = shown
    assert "training of trip cannot go on with other poses" in options.pop("text")
    assert options.pop("label") == "Compute Poses Again" and options.pop("operator") == "objectgs.recompute_poses"
    bpy.ops.objectgs.recompute_poses("EXEC_DEFAULT", **options)
    (job,) = submitted
    assert job.kind == "sfm" and job.command[job.command.index("--cameras") + 1] == "one"
    assert "--leave-out" not in job.command


def test_names_that_are_too_long_for_a_command_line_are_given_in_a_file(submitted, tmp_path):
    photos, leave_out = [[f"photo {number:04}.jpg" for number in numbers] for numbers in (range(500), range(7))]
    sources = [tmp_path / "trip" / name for name in photos]
    job = locations.sfm_job(tmp_path / "capture", PhotosSource(sources, leave_out=leave_out))
    assert len(" ".join(job.command)) < 2000 and "--leave-out" not in job.command
    assert job.command[job.command.index("sfm") + 1 : job.command.index("--out")] == [str(sources[0])]
    listed = json.loads(Path(job.command[job.command.index("--list") + 1]).read_text(encoding="utf-8"))
    assert listed == {"photos": [str(path) for path in sources[1:]], "leave_out": leave_out}


def test_missing_folder_is_refused(submitted, tmp_path):
    with pytest.raises(RuntimeError, match="does not exist; choose another"):
        bpy.ops.objectgs.import_photos("EXEC_DEFAULT", directory=str(tmp_path / "gone"))
    assert not submitted
