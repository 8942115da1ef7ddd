# SPDX-License-Identifier: GPL-3.0-or-later
"""Import Masks: what the backend is asked for, and what follows."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.backend.shared.reconstruction.edits.splat_edits import SplatEdits
from objectgs.objectgs_addon import scene as blender_scene
from objectgs.objectgs_addon.environment import locations
from objectgs.objectgs_addon.process.jobs import Job
from objectgs.objectgs_addon.running import background, results
from objectgs.objectgs_addon.state.folder_state import folder_state
from objectgs.operators.capture import import_masks

import headless

from .building import look_at, write_cameras, write_folder


@pytest.fixture
def root(fresh, tmp_path, monkeypatch):
    """A reconstruction whose capture has no masks; jobs are collected instead of run."""
    folder = write_folder(tmp_path / "table")
    write_cameras(folder, [look_at(np.array([3.0, 0.0, 1.0]), np.zeros(3))])
    monkeypatch.setenv("OBJECTGS_PYTHON", __import__("sys").executable)
    extension = headless.extension()
    extension.register()
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    yield bpy.context.scene.objectgs.active
    extension.unregister()


@pytest.fixture
def submitted(monkeypatch):
    jobs: list[Job] = []
    monkeypatch.setattr(import_masks.background, "submit", lambda job, *_: jobs.append(job) or {"FINISHED"})
    return jobs


def test_job_has_the_capture_and_the_chosen_masks(root, submitted, tmp_path):
    given = tmp_path / "annotations.json"
    given.write_text("{}")
    assert bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath=str(given), objects="find") == {"FINISHED"}
    (job,) = submitted
    at = job.command.index("masks")
    assert job.command[at + 1 : at + 5] == [str(tmp_path / "table"), str(given), "--objects", "find"]
    assert job.kind == "masks" and job.folder == tmp_path / "table"


def test_names_are_asked_for_with_the_model_of_the_preferences(root, submitted, tmp_path, monkeypatch):
    given, detector = tmp_path / "sam2", str(tmp_path / "dino")
    given.mkdir()
    for names, chosen, options in (
        ("red cup; book", detector, ["--text", "red cup; book", "--detector", detector]),
        ("red cup; book", "", ["--text", "red cup; book"]),
        (" ", detector, []),
    ):
        own = SimpleNamespace(detector=chosen, backend_python="", reconstructions="")
        monkeypatch.setattr(locations, "preferences", lambda own=own: own)
        bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath=str(given), names=names)
        command = submitted[-1].command
        assert command[command.index("--objects") + 2 :] == [*options, "--json"]
    kept = bpy.ops.objectgs.import_masks.get_rna_type().properties["names"]
    assert kept.is_skip_save, "the masks of the next import may have no model"


def test_folder_is_chosen_with_or_without_a_name_in_it(root, submitted, tmp_path):
    given = tmp_path / "segments"
    given.mkdir()
    (given / "a.png").write_bytes(b"")
    (given / "scene.blend").write_bytes(b"")
    for path in (f"{given}/", f"{given}/untitled", f"{given}/a.png", f"{given}/scene.blend", f"{given}/gone.blend"):
        bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath=path)
        assert str(given) in submitted[-1].command
    (given / "coco.json").write_text("{}")
    bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath=f"{given}/coco.json")
    assert f"{given}/coco.json" in submitted[-1].command
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath=str(tmp_path / "gone" / "a.json"))


def test_links_of_a_downloaded_model_keep_their_names(root, submitted, tmp_path):
    """The downloads of Hugging Face are links to files that have no names."""
    (tmp_path / "blobs").mkdir()
    (tmp_path / "blobs" / "0123abcd").write_text("{}")
    (tmp_path / "snapshot").mkdir()
    (tmp_path / "snapshot" / "config.json").symlink_to(tmp_path / "blobs" / "0123abcd")
    bpy.ops.objectgs.import_masks("EXEC_DEFAULT", filepath=str(tmp_path / "snapshot" / "config.json"))
    assert str(tmp_path / "snapshot" / "config.json") in submitted[-1].command


def test_result_is_told_and_points_get_their_objects(root, tmp_path, monkeypatch):
    told, asked = [], []
    monkeypatch.setattr(results.messages, "show", lambda text, *_: told.append(text))
    monkeypatch.setattr(background, "submit", lambda job, *_: asked.append(job.kind))
    (tmp_path / "table" / "masks").mkdir(exist_ok=True)
    root.objectgs.objects.clear()
    job = Job("Import masks", "masks", Path(tmp_path / "table"), ["python"], tmp_path)
    job.result = {"photos": 42, "masks": "/table/masks", "result": {"objects": [{}, {}, {}]}}
    job.warnings.append("No photo shows book; --text may have other words.")
    monkeypatch.setitem(background._submitted_in, job, bpy.context.scene.session_uid)
    background.finish(job)
    assert told == [
        "The masks show 3 objects in 42 photos; /table/masks has a picture. No photo shows book; Names may have other "
        "words."
    ]
    # With a window, `finish` does this, too: at once on splats, and before a training on points.
    state = folder_state(tmp_path / "table")
    background._assign_objects(job, bpy.context.scene)
    monkeypatch.setattr(background.folder_trust, "state_of", lambda _root: replace(state, trained=False))
    background._assign_objects(job, bpy.context.scene)
    assert state.trained and asked == ["label", "vote"]
    root.objectgs.objects.add().object_id = 1
    background._assign_objects(job, bpy.context.scene)
    assert asked == ["label", "vote", "vote"], "later masks replace the objects"
    imported = Job("Import", "import", Path(tmp_path / "table"), ["python"], tmp_path)
    background._assign_objects(imported, bpy.context.scene)
    assert len(asked) == 3, "an import keeps the objects"
    blender_scene.remember_edits(root, SplatEdits().delete(np.array([5], np.uint64)), missing=0)
    monkeypatch.setattr(background.folder_trust, "state_of", lambda _root: replace(state, steps=100))
    monkeypatch.setattr(background.messages, "show", lambda text, **more: told.append((text, more["operator"])))
    background._assign_objects(job, bpy.context.scene)
    assert len(asked) == 3 and told[-1][1] == "objectgs.clean_up_labels", "deleted splats would come back"
