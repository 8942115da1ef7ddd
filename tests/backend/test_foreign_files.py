"""Commands neither delete nor overwrite files of others."""

import os
import shutil
from pathlib import Path

import pytest

from backend.export import read_splats
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError
from backend.shared.formats.atomic import atomic_file, make_folder, recorded, write_atomic
from backend.shared.reconstruction.objects import edit_objects, read_objects
from backend.training.trainer import Trainer

from .command_result import assert_rejected
from .test_commands import SMALL, trained  # noqa: F401

LENGTH = ("--steps", 5, *SMALL)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def capture(write_capture):
    return write_capture(name="capture", views=9, size=(64, 48)).folder


@pytest.fixture
def bad_capture(tmp_path):
    (tmp_path / "bad" / "images").mkdir(parents=True)
    return tmp_path / "bad"


@pytest.mark.parametrize("command", ["import", "vote", "train", "plan"])
def test_rejected_run_removes_only_its_own_files(run_command, tmp_path, bad_capture, monkeypatch, command):
    """While the command runs, other programs write to the new parent folder and to the new folder."""
    parent = tmp_path / "new"

    def others_write(*_):
        (parent / "b").mkdir()
        (parent / "b" / "splats.ply").write_text("finished")
        if command != "vote":
            (parent / "a" / "notes.txt").write_text("mine")
        raise InputError("The capture is bad.")

    place = "plan" if command == "plan" else "folder"
    monkeypatch.setattr(f"backend.commands.{'capture.' if command == 'plan' else ''}{place}.load_capture", others_write)
    assert run_command(command, bad_capture, "--out", parent / "a").code == EXIT_BAD_INPUT
    left = {"b/splats.ply": b"finished"}
    assert contents(parent) == (left if command == "vote" else {**left, "a/notes.txt": b"mine"})
    assert (parent / "a").exists() == (command != "vote")


def test_rejected_run_keeps_existing_empty_folder(run_command, tmp_path, bad_capture):
    out = tmp_path / "empty"
    out.mkdir()
    assert run_command("train", bad_capture, "--out", out, *LENGTH).code == EXIT_BAD_INPUT
    assert out.is_dir() and not list(out.iterdir())
    assert run_command("train", bad_capture, "--out", tmp_path / "new" / "out", *LENGTH).code == EXIT_BAD_INPUT
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", ["import", "vote", "train", "plan", "import-splats"])
@pytest.mark.parametrize("foreign", ["points.ply", "cameras.json", "checkpoint/model.safetensors", "thesis.odt"])
def test_folder_with_foreign_files_is_rejected(run_command, tmp_path, capture, trained, command, foreign):  # noqa: F811
    out = tmp_path / "theirs"
    (out / foreign).parent.mkdir(parents=True)
    (out / foreign).write_text("not yours")
    before = contents(out)
    source = trained[1] / "splats.ply" if command == "import-splats" else capture
    options = ["--restart", *LENGTH] if command == "train" else []
    assert_rejected(run_command(command, source, "--out", out, *options), str(out), "choose an")
    assert contents(out) == before


def test_capture_may_be_in_the_folder(run_command, tmp_path, capture):
    """As in `make demo`: the capture is in the folder of the reconstruction."""
    out = tmp_path / "scene"
    inside = shutil.copytree(capture, out / "footage" / "capture")
    assert run_command("vote", inside, "--out", out).code == EXIT_DONE
    assert (out / "points.ply").exists() and contents(inside) == contents(capture)


def test_capture_in_place_of_own_files_is_rejected(run_command, tmp_path, capture):
    out = tmp_path / "scene"
    inside = shutil.copytree(capture, out / "cache")
    assert_rejected(run_command("vote", inside, "--out", out), str(out), "choose an")
    (out / "cache").rename(out / "capture")
    (out / "thesis.odt").write_text("not yours")
    assert_rejected(run_command("vote", out / "capture", "--out", out), "thesis.odt")


def test_overwrite_allows_folder_with_foreign_files(run_command, tmp_path, capture):
    out = tmp_path / "theirs"
    out.mkdir()
    (out / "thesis.odt").write_text("not yours")
    (out / "points.ply").write_text("to be replaced")
    assert run_command("vote", capture, "--out", out, "--overwrite").code == EXIT_DONE
    assert (out / "thesis.odt").read_text() == "not yours"
    assert (out / "points.ply").read_bytes()[:3] == b"ply" and run_command(
        "vote", capture, "--out", out
    ).code == EXIT_DONE


@pytest.mark.parametrize("name", [".DS_Store", "Thumbs.db", "desktop.ini"])
def test_folder_with_only_system_files_is_used(run_command, tmp_path, capture, name):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_bytes(b"made by the file browser")
    assert run_command("vote", capture, "--out", out).code == EXIT_DONE


def test_restart_keeps_old_checkpoint_until_new_one_exists(run_command, trained, monkeypatch):  # noqa: F811
    capture, out = trained
    before = contents(out / "checkpoint")

    def full(*_):
        raise InputError("The disk is full.")

    monkeypatch.setattr(Trainer, "save", full)
    assert run_command("train", capture, "--out", out, *LENGTH, "--restart").code == EXIT_BAD_INPUT
    assert contents(out / "checkpoint") == before


@pytest.mark.skipif(os.name != "posix", reason="links need a privilege on Windows")
def test_atomic_write_does_not_follow_links(tmp_path):
    theirs = tmp_path / "theirs.txt"
    theirs.write_text("not yours")
    for name in ("objects.json", "objects.json.part"):
        (tmp_path / name).symlink_to(theirs)
    write_atomic(tmp_path / "objects.json", b"{}")
    assert theirs.read_text() == "not yours"
    assert (tmp_path / "objects.json").read_text() == "{}" and not (tmp_path / "objects.json").is_symlink()


def test_concurrent_writers_use_separate_temporary_files(tmp_path):
    path = tmp_path / "objects.json"
    with atomic_file(path) as first, atomic_file(path) as second:
        first.write(b"first")
        second.write(b"second")
    assert path.read_text() == "first" and [entry.name for entry in tmp_path.iterdir()] == ["objects.json"]


def test_long_names_can_be_written(tmp_path):
    write_atomic(tmp_path / ("x" * 240 + ".ply"), b"content")
    write_atomic(tmp_path / ("\U0001f600" * 60), b"content")
    assert len(list(tmp_path.iterdir())) == 2


def test_only_new_files_and_folders_are_recorded(tmp_path):
    write_atomic(tmp_path / "old", b"old")
    with recorded() as created:
        make_folder(tmp_path / "a" / "b")
        write_atomic(tmp_path / "old", b"replaced")
        write_atomic(tmp_path / "a" / "b" / "new", b"new")
    write_atomic(tmp_path / "a" / "later", b"later")
    created.remove_files()
    created.remove_folders()
    assert contents(tmp_path) == {"old": b"replaced", "a/later": b"later"} and not (tmp_path / "a" / "b").exists()


OWN = ("splats.ply", "objects.json", "objectgs.json", "anchors.ply", "meshes/1.ply", "checkpoint/model.safetensors")


@pytest.mark.parametrize("name", OWN)
def test_export_does_not_replace_reconstruction_files(run_command, trained, name):  # noqa: F811
    _, out = trained
    before = contents(out)
    assert_rejected(
        run_command("export", out, "--out", out / name, "--format", "ply"), name, "belongs to the reconstruction"
    )
    (out.parent / "link.ply").symlink_to(out / name)
    assert_rejected(
        run_command("export", out, "--out", out.parent / "link.ply"), "link.ply", "belongs to the reconstruction"
    )
    assert_rejected(
        run_command("export", out, "--out", out / "meshes", "--per-object"), "meshes", "belongs to the reconstruction"
    )
    assert contents(out) == before


def test_export_per_object_handles_conflicting_names(run_command, trained):  # noqa: F811
    _, out = trained
    ids = [entry.id for entry in read_objects(out / "objects.json")]
    names = dict(zip(ids, ["CON", "mug", "MUG", "mug_3", "x" * 300]))
    edit_objects(out / "objects.json", {i: {"name": name} for i, name in names.items()})
    result = run_command("export", out, "--out", out.parent / "each", "--per-object", "--json")
    files = list((out.parent / "each").iterdir())
    assert result.code == EXIT_DONE and len(files) == result.events[-1]["files"] >= len(names)
    assert (
        len({path.name.casefold() for path in files}) == len(files) and not (out.parent / "each" / "CON.ply").exists()
    )
    assert sum(len(read_splats(path)[0]) for path in files) == result.events[-1]["splats"]


def test_old_temporary_files_are_removed(run_command, tmp_path, capture):
    assert run_command("vote", capture, "--out", tmp_path / "out").code == EXIT_DONE
    old, new = (tmp_path / "out" / "cache" / f".objectgs-{name}-a.ply.part" for name in ("0a", "0b"))
    for path in (old, new):
        path.write_bytes(b"left by a killed process")
    os.utime(old, (0, 0))
    assert run_command("vote", capture, "--out", tmp_path / "out").code == EXIT_DONE
    assert new.exists() and not old.exists()
