# SPDX-License-Identifier: GPL-3.0-or-later
"""The plan in Blender: the panel, the user's overrides, and the arguments for training."""

import argparse
import dataclasses
import json
import shutil
from types import SimpleNamespace

import pytest

import headless

bpy = pytest.importorskip("bpy")

from objectgs.backend.shared.events import Reporter
from objectgs.backend.shared.reconstruction.folder import Reconstruction
from objectgs.backend.shared.reconstruction.objects import read_objects
from objectgs.backend.shared.reconstruction.plan import Decision, Plan, write_plan
from objectgs.objectgs_addon import scene
from objectgs.objectgs_addon.environment import locations
from objectgs.objectgs_addon.headless import commands
from objectgs.objectgs_addon.headless.arguments import parse
from objectgs.objectgs_addon.panels.training.plan import PlanPanel
from objectgs.objectgs_addon.process import jobs
from objectgs.objectgs_addon.running import background
from objectgs.objectgs_addon.state import folder_state, planning
from objectgs.operators.training import train

from .drawn import texts_of


@pytest.fixture
def root(fresh, trained, tmp_path):
    """A reconstruction with a plan, in a registered extension."""
    extension = headless.extension()
    extension.register()
    folder = shutil.copytree(trained, tmp_path / "demo")
    write_plan(
        folder / "plan.json",
        Plan(
            (
                Decision("votes", "votes", False, "the capture has no masks", can_override=False),
                Decision("labels", "the label loss", None, "the votes will tell"),
                Decision("exposure", "undoing of exposure", False, "it does not vary"),
                Decision("pyramid", "reduced pictures", True, "they are large"),
                Decision("blind-views", "training on 1 view", False, "it sees nothing", views=("a.png",), wanted=True),
            )
        ),
    )
    bpy.ops.objectgs.open_reconstruction(directory=str(folder))
    yield bpy.context.scene.objectgs.active
    extension.unregister()


def test_training_writes_plan(trained):
    assert planning.plan_of(trained).does("votes") and not planning.plan_of(trained / "none").decisions


def test_header_counts_parts_of_training_and_not_photos(root):
    assert texts_of(PlanPanel, "draw_header_preset") == "2 parts skipped"
    assert bpy.ops.objectgs.override_decision(key="exposure") == {"FINISHED"}
    assert texts_of(PlanPanel, "draw_header_preset") == "1 part skipped"
    assert "Undoing of exposure" in texts_of(PlanPanel)


def test_overrides_are_passed_to_training_and_undone(root):
    toggle = bpy.ops.objectgs.override_decision
    arguments = planning.arguments(root)
    assert arguments[arguments.index("--keep") :] == ["--keep", "blind-views"], "overrides in plan.json are kept"
    assert toggle(key="exposure") == {"FINISHED"} and toggle(key="pyramid") == {"FINISHED"}
    arguments = planning.arguments(root)
    assert arguments[arguments.index("--keep") :] == ["--keep", "exposure", "blind-views", "--leave-out", "pyramid"]
    assert toggle(key="exposure") == {"FINISHED"} and toggle(key="blind-views") == {"FINISHED"}
    arguments = planning.arguments(root)
    assert "--keep" not in arguments and arguments[-2:] == ["--leave-out", "pyramid"]
    for key in ("votes", "unheard-of"):
        with pytest.raises(RuntimeError, match="leaves no choice"):
            toggle(key=key)


def test_invalid_plan_counts_as_missing(root):
    path = Reconstruction(scene.folder_of(root)).plan
    path.write_text("[]")
    assert planning.plan_of(scene.folder_of(root)).decisions == () and "--keep" not in planning.arguments(root)
    path.unlink()
    assert planning.plan_of(scene.folder_of(root)).decisions == ()


def test_analyze_and_train_use_same_arguments(root, monkeypatch):
    calls = []
    monkeypatch.setattr(locations, "backend_python", lambda: "python")
    monkeypatch.setattr(
        locations,
        "backend_job",
        lambda title, kind, folder, *words: (
            calls.append(words) or jobs.Job(title=title, kind=kind, folder=folder, command=["true"], cwd=folder)
        ),
    )
    monkeypatch.setattr(background, "submit", lambda *_: {"FINISHED"})
    bpy.ops.objectgs.override_decision(key="exposure")
    assert bpy.ops.objectgs.analyze_capture() == {"FINISHED"} and bpy.ops.objectgs.train() == {"FINISHED"}
    wanted = tuple(planning.arguments(root))
    assert [words[0] for words in calls] == ["plan", "train"]
    assert all(words[-len(wanted) :] == wanted and "exposure" in words for words in calls)


def test_training_that_replaces_splats_of_others_is_asked_about(root, monkeypatch):
    asked, state = [], folder_state.folder_state(scene.folder_of(root))
    manager = SimpleNamespace(invoke_confirm=lambda *_, **options: asked.append(options) or {"RUNNING_MODAL"})
    context = SimpleNamespace(scene=bpy.context.scene, window_manager=manager)
    for steps in (0, 100):
        found = dataclasses.replace(state, trained=True, steps=steps)
        monkeypatch.setattr(train, "folder_state", lambda _folder, found=found: found)
        button = SimpleNamespace(restart=False, execute=lambda _: {"FINISHED"})
        assert train.Train.invoke(button, context, None) == ({"FINISHED"} if steps else {"RUNNING_MODAL"})
        assert button.restart is (steps == 0)
    (options,) = asked
    assert "a new one replaces the splats" in options["message"]


def test_labels_file_groups_objects(root, tmp_path):
    path = Reconstruction(scene.folder_of(root)).objects
    first, second, *_ = [entry.id for entry in read_objects(path)]
    labels = tmp_path / "groups.json"
    labels.write_text(json.dumps({str(first): "things", str(second): "things"}))
    assert bpy.ops.objectgs.group_objects(filepath=str(labels)) == {"FINISHED"}
    rows = {item.object_id: item for item in root.objectgs.objects}
    assert rows[first].name == "things" and rows[second].is_merged and rows[second].merged_into == first
    labels.write_text("[]")
    with pytest.raises(RuntimeError, match="no groups"):
        bpy.ops.objectgs.group_objects(filepath=str(labels))


def test_headless_passes_absolute_group_paths(monkeypatch, tmp_path):
    calls = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands, "find_backend", lambda _python: None)
    monkeypatch.setattr(commands, "run_backend", lambda _reporter, *words: calls.append(words))
    monkeypatch.setattr(argparse.Namespace, "reporter", Reporter(), raising=False)
    commands.plan(parse(["plan", "garden", "--no-meshes"]))
    commands.plan(parse(["plan", "garden", "--out", "made", "--groups", "g.json", "--keep", "all"]))
    commands.backend(parse(["vote", "garden", "--out", "made", "--groups", "g.json"]))
    garden, made, groups = tmp_path / "garden", tmp_path / "made", ("--groups", str(tmp_path / "g.json"))
    assert calls == [
        ("plan", None, garden, "--no-meshes"),
        ("plan", made, garden, "--out", made, *groups, "--keep", "all"),
        ("vote", made, garden, "--out", made, *groups),
    ]
