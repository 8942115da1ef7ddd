# SPDX-License-Identifier: GPL-3.0-or-later
"""A .blend from someone else: its folder is neither read nor changed until the user accepts it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import headless

bpy = pytest.importorskip("bpy")

from objectgs.backend.shared.reconstruction.objects import edit_objects, read_objects
from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.environment import known_folders
from objectgs.objectgs_addon.film import properties as film
from objectgs.objectgs_addon.panels import CLASSES
from objectgs.objectgs_addon.process.jobs import Job
from objectgs.objectgs_addon.running import background
from objectgs.objectgs_addon.scene import kinds
from objectgs.objectgs_addon.state import folder_trust, object_edits
from objectgs.operators.film.output_folder import UsesOutputFolder

from .building import HUGE, write_folder
from .drawn import texts_of

REMOTE = r"\\elsewhere\share\rec"


@pytest.fixture
def extension(fresh, monkeypatch):
    """The extension with a backend that must not be started."""
    monkeypatch.setenv("OBJECTGS_PYTHON", sys.executable)
    monkeypatch.setattr(background, "submit", lambda job, *_: pytest.fail(f"{job.title} was started"))
    registered = headless.extension()
    registered.register()
    yield registered
    registered.unregister()


@pytest.fixture
def folder(tmp_path) -> Path:
    """Someone's reconstruction, beside the folder of their .blend files."""
    (tmp_path / "project").mkdir()
    return write_folder(tmp_path / "project" / "rec")


@pytest.fixture
def blend(extension, folder, known) -> Path:
    """Someone's .blend that shows `folder`, which this user has never opened."""
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    return save(folder.parent / "scenes" / "theirs.blend", known)


@pytest.fixture
def root(blend):
    """The reconstruction's collection in the .blend as opened by this user."""
    return opened(blend)


def save(path: Path, known: Path) -> Path:
    """Save the open file as someone else, and return to an empty one."""
    path.parent.mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    known.unlink(missing_ok=True)
    return path


def opened(path: Path):
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return active()


def active():
    """Return the reconstruction's collection, which undo replaces."""
    return bpy.context.scene.objectgs.active


def snapshot(folder: Path) -> dict:
    return {
        path.relative_to(folder): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in [folder, *folder.rglob("*")]
    }


def item_of(object_id: int):
    return next(item for item in active().objectgs.objects if scene.from_stored(item.object_id) == object_id)


def pivot_of(object_id: int):
    return kinds.part_of(scene.object_collections(active())[object_id], kinds.OBJECT_PARENT)


def edit() -> None:
    """Change everything that the panels and Blender's own tools can change without an operator of the extension."""
    item_of(1).name = "cup"
    item_of(1).color = (1.0, 0.0, 0.0)
    item_of(2).chosen = False
    item_of(HUGE).hue = 0.25
    pivot_of(1).location.x += 2.0


def entries(folder: Path) -> dict:
    return {entry.id: entry for entry in read_objects(folder / "objects.json")}


def edits(folder: Path) -> dict:
    return json.loads((folder / "objects.json").read_text())["edits"]


def error_report(operator, **options) -> str:
    with pytest.raises(RuntimeError) as failed:
        operator(**options)
    return str(failed.value)


def run_timers() -> None:
    object_edits._flush_later()
    background._tick()


def test_nothing_changes_in_a_folder_that_is_not_accepted(root, folder, tmp_path):
    before = snapshot(folder)
    bpy.ops.ed.undo_push(message="opened")
    edit()
    bpy.ops.ed.undo_push(message="edited")
    run_timers()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "mine.blend"))
    bpy.ops.ed.undo()
    assert item_of(1).name == "mug"
    bpy.ops.ed.redo()
    run_timers()
    assert item_of(1).name == "cup" and not item_of(2).chosen
    bpy.ops.wm.save_mainfile()
    assert opened(tmp_path / "mine.blend") and folder_trust.is_in_question(active())
    assert item_of(1).name == "cup", "it is kept in the .blend"
    assert snapshot(folder) == before and not background.queue.jobs


def test_the_folder_is_not_even_looked_at(root, monkeypatch, tmp_path):
    """On Windows, looking at a folder of another computer sends it the user's login."""
    root[kinds.FOLDER] = REMOTE
    touched = []

    def watched(function):
        def call(path, *arguments, **options):
            if "elsewhere" in str(path):
                touched.append(path)
            return function(path, *arguments, **options)

        return call

    for name in ("stat", "lstat", "open", "scandir", "listdir", "mkdir"):
        monkeypatch.setattr(os, name, watched(getattr(os, name)))
    monkeypatch.setattr("io.open", watched(open))
    bpy.ops.ed.undo_push(message="opened")
    edit()
    bpy.ops.ed.undo_push(message="edited")
    run_timers()
    bpy.ops.ed.undo()
    bpy.ops.ed.redo()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "remote.blend"))
    opened(tmp_path / "remote.blend")
    for name in dir(bpy.ops.objectgs):
        getattr(bpy.ops.objectgs, name).poll()
    for panel in (cls for cls in CLASSES if issubclass(cls, bpy.types.Panel) and not hasattr(cls, "preset_subdir")):
        if getattr(panel, "poll", lambda _context: True)(bpy.context):
            texts_of(panel)
    assert not background.is_busy(active()) and background.job_of(active()) is None
    assert not folder_trust.state_of(active()).exists and not touched
    assert not edits_of_plan(active())


def edits_of_plan(root):
    from objectgs.objectgs_addon.state import planning

    return planning.plan_for(root).decisions


def test_operators_say_why_they_do_nothing(root, folder):
    before = snapshot(folder)
    operators = bpy.ops.objectgs
    for operator in (
        operators.assign_objects,
        operators.analyze_capture,
        operators.override_decision,
        operators.group_objects,
        operators.train,
        operators.extract_meshes,
        operators.show_result,
        operators.show_preview,
        operators.merge_objects,
        operators.split_objects,
        operators.choose_objects,
        operators.remove_object,
        operators.restore_object,
        operators.fill_hole,
        operators.duplicate_object,
        operators.reset_object,
        operators.export_splats,
        operators.export_meshes,
        operators.film_frames,
        operators.set_up_compositor,
    ):
        told = error_report(operator)
        assert told.strip().endswith(folder_trust.REFUSAL)
    with pytest.raises(Exception, match="comes from elsewhere"):
        object_edits.remove(root, [1], floaters=False)
    with pytest.raises(Exception, match="comes from elsewhere"):
        object_edits.choose(root, {1: False})
    assert snapshot(folder) == before
    for operator in (operators.select_object, operators.solo_object, operators.set_ground, operators.use_folder):
        assert operator.poll(), "it does not use the folder"


def test_no_hole_is_filled_unasked(blend, folder, known):
    """A .blend whose reconstruction lacks the fill of a removed object."""
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    edit_objects(folder / "objects.json", {1: {"removed": True, "fill": True}})
    known.unlink()
    root = opened(blend)
    before = snapshot(folder)
    background.fill_holes(root)
    bpy.ops.ed.undo_push(message="one")
    bpy.ops.ed.undo_push(message="two")
    bpy.ops.ed.undo()
    assert snapshot(folder) == before


def test_edits_are_written_once_the_folder_is_accepted(root, blend, folder):
    edit_objects(folder / "objects.json", {2: {"name": "tin"}})
    edit()
    assert bpy.ops.objectgs.use_folder() == {"FINISHED"}
    assert not folder_trust.is_in_question(active()) and not bpy.ops.objectgs.use_folder.poll()
    now = entries(folder)
    assert now[1].name == "cup" and now[1].color == (255, 0, 0) and now[1].transform[0][3] == pytest.approx(2.0)
    assert now[2].left_out and now[2].name == "tin", "only what was edited is written"
    assert now[HUGE].recolor.hue == pytest.approx(0.25)
    item_of(1).name = "jug"
    assert entries(folder)[1].name == "jug"
    opened(blend)
    assert not folder_trust.is_in_question(active()), "it is asked once"


def test_kept_edits_are_saved_with_the_file(root, folder, tmp_path):
    edit()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "mine.blend"))
    opened(tmp_path / "mine.blend")
    bpy.ops.objectgs.use_folder()
    assert set(edits(folder)) == {"1", "2", str(HUGE)}


def test_opening_the_folder_accepts_it_too(root, folder):
    edit()
    assert bpy.ops.objectgs.open_reconstruction(directory=str(folder)) == {"FINISHED"}
    assert not folder_trust.is_in_question(active())
    assert set(edits(folder)) == {"1", "2", str(HUGE)} and item_of(1).name == "cup"
    assert [scene.kind_of(child) for child in bpy.context.scene.collection.children] == ["reconstruction"]


def test_undo_keeps_the_acceptance_and_undoes_the_edits(root, folder):
    bpy.ops.ed.undo_push(message="opened")
    item_of(1).name = "cup"
    bpy.ops.ed.undo_push(message="edited")
    bpy.ops.objectgs.use_folder("EXEC_DEFAULT", True)
    assert entries(folder)[1].name == "cup"
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    assert item_of(1).name == "mug" and not folder_trust.is_in_question(active())
    assert entries(folder)[1].name == "mug"
    bpy.ops.ed.redo()
    assert entries(folder)[1].name == "cup"


def test_a_damaged_folder_can_be_accepted_and_repaired(root, folder):
    item_of(1).name = "cup"
    (folder / "objects.json").write_text("{")
    assert "objects.json" in error_report(bpy.ops.objectgs.use_folder)
    assert not folder_trust.is_in_question(active()) and item_of(1).name == "cup"


def test_a_moved_project_needs_one_click(root, blend, folder, tmp_path):
    shutil.move(folder.parent, tmp_path / "moved")
    moved = tmp_path / "moved" / "rec"
    opened(tmp_path / "moved" / "scenes" / blend.name)
    edit()
    before = snapshot(moved)
    assert folder_trust.offered(active()) == moved and snapshot(moved) == before
    assert bpy.ops.objectgs.use_folder() == {"FINISHED"}
    assert scene.folder_of(active()) == moved and not folder.exists()
    assert set(edits(moved)) == {"1", "2", str(HUGE)}
    bpy.ops.wm.save_mainfile()
    opened(tmp_path / "moved" / "scenes" / blend.name)
    assert scene.folder_of(active()) == moved and not folder_trust.is_in_question(active())


def test_a_moved_project_of_the_user_is_asked_about_when_its_folder_is_gone(extension, folder, tmp_path):
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "objectgs.blend"))
    del active()[kinds.RELATIVE_FOLDER]  # as in older files
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "objectgs.blend"), check_existing=False)
    shutil.move(folder, tmp_path / "rec")
    opened(tmp_path / "rec" / "objectgs.blend")
    assert folder_trust.is_in_question(active()) and folder_trust.offered(active()) == tmp_path / "rec"
    bpy.ops.objectgs.use_folder()
    assert scene.folder_of(active()) == tmp_path / "rec"


@pytest.mark.parametrize(
    "path", ["../../../rec", "/rec", "rec/../../rec", "C:/rec", r"\\elsewhere\share", "//elsewhere/rec", "", 7]
)
def test_a_relative_path_leads_only_to_the_surroundings(root, folder, path):
    root[kinds.RELATIVE_FOLDER] = path
    root[kinds.FOLDER] = REMOTE
    assert folder_trust.moved_folder(root) is None


def test_a_file_in_the_folder_of_another_reconstruction_keeps_its_own(extension, folder, known, tmp_path):
    """As where the reconstruction that the file was built of has been removed from it."""
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    other = write_folder(folder.parent / "other")
    opened(save(other / "objectgs.blend", known))
    assert scene.folder_of(active()) == folder
    assert folder_trust.moved_folder(active()) is None and folder_trust.offered(active()) == folder


def test_a_path_relative_to_the_blend_is_accepted_by_one_click(root, folder):
    del root[kinds.RELATIVE_FOLDER]
    root[kinds.FOLDER] = "//../rec"
    assert folder_trust.offered(root) == folder
    bpy.ops.objectgs.use_folder()
    assert scene.folder_of(root) == folder


@pytest.mark.parametrize("path", ["", "rec", 7, "rec\0"])
def test_a_file_without_a_folder_can_only_choose_another(root, path):
    root[kinds.FOLDER] = path
    del root[kinds.RELATIVE_FOLDER]
    told = error_report(bpy.ops.objectgs.use_folder)
    assert "does not name its reconstruction folder" in told
    assert folder_trust.is_in_question(root) and not (Path.cwd() / "objects.json").exists()


def test_another_folder_is_shown_in_the_same_collection(root, folder, tmp_path):
    other = write_folder(tmp_path / "other")
    edit_objects(other / "objects.json", {1: {"name": "bowl"}})
    before, edited = snapshot(folder), snapshot(other)
    item_of(1).name = "cup"
    assert bpy.ops.objectgs.open_reconstruction(directory=str(other), instead=True) == {"FINISHED"}
    assert scene.folder_of(active()) == other and item_of(1).name == "bowl"
    assert len(bpy.context.scene.collection.children) == 1
    assert snapshot(folder) == before and snapshot(other) == edited


def test_an_appended_reconstruction_is_asked_about(blend, folder, tmp_path):
    mine = write_folder(tmp_path / "mine")
    bpy.ops.objectgs.open_reconstruction(directory=str(mine))
    with bpy.data.libraries.load(str(blend)) as (_, here):
        here.collections = ["rec"]
    theirs = next(collection for collection in here.collections)
    bpy.context.scene.collection.children.link(theirs)
    before = snapshot(folder)
    bpy.context.scene.objectgs.active = theirs
    edit()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "both.blend"))
    assert snapshot(folder) == before and folder_trust.is_in_question(theirs)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'"folders"',
        b'{"folders": 3}',
        b'{"folders": [1, null, {}]}',
        b"\xff\xfe\0",
        b"[" * 100_000,
        b" " * (known_folders._LARGEST + 1),
    ],
)
def test_a_damaged_list_is_replaced(root, folder, known, content):
    known.write_bytes(content)
    assert folder_trust.is_in_question(root)
    bpy.ops.objectgs.use_folder()
    assert json.loads(known.read_text()) == {"folders": [str(folder)]}
    assert not folder_trust.is_in_question(root)


def test_the_list_is_short_and_ends_with_the_latest(known, tmp_path):
    folders = [str(tmp_path / f"folder {number}") for number in range(known_folders.MOST)]
    known.write_text(json.dumps({"folders": folders}))
    assert known_folders.remember(tmp_path / "folder 5") and known_folders.remember(tmp_path / "new")
    there = json.loads(known.read_text())["folders"]
    assert len(there) == known_folders.MOST and there[-2:] == [folders[5], str(tmp_path / "new")]
    assert not known_folders.is_known(tmp_path / "folder 0") and known_folders.is_known(tmp_path / "folder 1")
    assert known_folders.is_known(tmp_path / "other" / ".." / "new") and not known_folders.is_known(tmp_path)
    assert not known_folders.remember(Path("relative")) and not known_folders.is_known(Path("relative"))
    assert [path.name for path in known.parent.iterdir()] == [known.name]


def test_a_list_that_cannot_be_written_counts_until_blender_is_closed(root, folder, known, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied", str(known))

    monkeypatch.setattr(known_folders, "write_json", refuse)
    assert bpy.ops.objectgs.use_folder() == {"FINISHED"}
    assert not folder_trust.is_in_question(root) and not known.exists()
    item_of(1).name = "cup"
    assert entries(folder)[1].name == "cup"


def test_the_list_is_not_in_the_blend(extension, folder, tmp_path):
    known_folders.remember(tmp_path / "secret")
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "mine.blend"), compress=False)
    content = (tmp_path / "mine.blend").read_bytes()
    assert str(folder).encode() in content
    assert str(tmp_path / "secret").encode() not in content and known_folders.NAME.encode() not in content


@pytest.mark.parametrize("kind", ["import", "import-splats"])
def test_an_import_makes_its_folder_known(extension, folder, kind):
    assert not known_folders.is_known(folder)
    background.finish(Job(title="Import", kind=kind, folder=folder, command=[], cwd=folder))
    assert known_folders.is_known(folder)


def test_a_capture_on_another_computer_must_be_imported_again(root, folder, monkeypatch):
    content = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps({**content, "capture": REMOTE}))
    bpy.ops.objectgs.use_folder()
    monkeypatch.setattr(Path, "is_dir", lambda path: pytest.fail(f"{path} was touched"))
    assert "is on another computer; import it again" in error_report(bpy.ops.objectgs.train)


def test_an_output_folder_of_the_file_is_asked_about(root, folder, tmp_path, known):
    owner = bpy.context.scene
    bpy.ops.objectgs.use_folder()
    assert film.is_accepted(owner, folder), "the folder film in the reconstruction"
    owner.objectgs_film.folder = str(tmp_path / "frames")
    assert film.is_accepted(owner, folder), "the user has just chosen it"
    second = bpy.data.collections.new("second")
    owner.collection.children.link(second)
    kinds.mark(second, "reconstruction")
    assert film.folder_of(owner, folder).parent == tmp_path / "frames" and film.is_accepted(owner, folder)
    bpy.data.collections.remove(second)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film.blend"))
    known.write_text(json.dumps({"folders": [str(folder)]}))
    opened(tmp_path / "film.blend")
    owner, asked = bpy.context.scene, []

    def confirm(operator, event, **options):
        asked.append(options["message"])
        return {"RUNNING_MODAL"}

    button = UsesOutputFolder()
    button.execute = lambda _context: {"FINISHED"}
    context = SimpleNamespace(scene=owner, window_manager=SimpleNamespace(invoke_confirm=confirm))
    assert button.invoke(context, None) == {"RUNNING_MODAL"} and str(tmp_path / "frames") in asked[0]
    button.remember_output(context)
    assert button.invoke(context, None) == {"FINISHED"} and len(asked) == 1


def test_film_of_a_folder_on_another_computer_needs_the_command_line(root, folder, tmp_path):
    owner = bpy.context.scene
    owner.camera = next(obj for obj in owner.objects if obj.type == "CAMERA")
    root[kinds.FOLDER] = REMOTE
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film.blend"))
    command = [sys.executable, headless.__file__, "film", tmp_path / "film.blend", "--out", tmp_path / "frames"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 2 and "give it with --dir" in ran.stderr + ran.stdout
    assert not (tmp_path / "frames").exists()
