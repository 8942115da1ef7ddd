"""The command line: the whole chain, exit codes, events and errors."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from backend.capture import load_capture
from backend.cli import main as arguments
from backend.commands import folder as opening
from backend.commands import votes
from backend.commands.capture import check
from backend.commands.setup.machine import set_threads
from backend.commands.training import evaluate, render, report
from backend.export import FittedSplats, agreement, fit_splats, read_splats
from backend.labels import read_points
from backend.model.checkpoint import CURRENT, PREVIOUS, load_checkpoint
from backend.raster import devices
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED, InputError
from backend.shared.formats.ply import read_vertices
from backend.shared.reconstruction import lock
from backend.shared.reconstruction.objects import edit_objects, read_objects
from backend.training.settings import Settings
from backend.training.trainer import Trainer

from .command_result import CommandResult, assert_rejected

LOCK = ".lock"
ROOT = Path(__file__).resolve().parents[2]
FIXTURES = ROOT.parent / "shared" / "data" / "fixtures"
SMALL = ("--offsets", "4")


_trained_once: dict[str, Path] = {}


@pytest.fixture
def trained(write_capture, tmp_path, tmp_path_factory, run_command):
    """A capture and a copy of its reconstruction after 20 steps; both are made once."""
    if not _trained_once:
        place = tmp_path_factory.mktemp("trained")
        shutil.copytree(write_capture(name="first", views=9, size=(64, 48)).folder, place / "capture")
        assert run_command("train", place / "capture", "--out", place / "out", "--steps", 20, *SMALL).code == EXIT_DONE
        _trained_once.update(capture=place / "capture", out=place / "out")
    shutil.copytree(_trained_once["out"], tmp_path / "out")
    return _trained_once["capture"], tmp_path / "out"


def assert_no_temporary_files(folder: Path) -> None:
    """Check that no temporary file of a command is left."""
    assert not [*folder.rglob("*.part"), *folder.rglob(LOCK)]


def step_of(out: Path) -> int:
    return load_checkpoint(out / "checkpoint")[1]["progress"]["step"]


# --- the whole chain -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("masks", [True, False])
def test_full_pipeline(write_capture, tmp_path, run_command, masks):
    capture, out = write_capture(views=9, size=(64, 48), masks=masks).folder, tmp_path / "deep" / "out"
    found = run_command("check", capture, "--json")
    assert found.code == EXIT_DONE and found.events[-1]["check"]["problems"] == []
    assert not out.exists()

    voted = run_command("vote", capture, "--out", out, "--json")
    assert voted.code == EXIT_DONE
    objects = json.loads((out / "objects.json").read_text())["objects"]
    assert [entry["id"] for entry in objects] == ([1, 2, 5] if masks else [])
    assert any("masks" in message for message in voted.messages("warning")) is not masks
    assert any("Voting" in message for message in voted.messages("status")) is masks

    ended = run_command("train", capture, "--out", out, "--steps", 20, *SMALL, "--json")
    assert ended.code == EXIT_DONE and ended.events[-1]["steps"] == 20
    assert (ended.events[-1]["miou"] is not None) is masks
    measured = [event for event in ended.events if event["type"] == "quality"]
    assert [event["step"] for event in measured] == sorted({event["step"] for event in measured})
    assert measured[-1]["step"] == 20 and all(event["psnr"] > 5 and event["seconds"] >= 0 for event in measured)
    assert all((event["miou"] is not None) is masks and "mbiou" in event for event in measured)
    assert all((event["miou_all"] is not None) is masks and not event["zero_is_background"] for event in measured)
    previews = [event["path"] for event in ended.events if event["type"] == "preview"]
    assert previews and all(Path(path).exists() for path in previews)
    splats, warnings = read_splats(out / "splats.ply")
    assert len(splats) > 100 and warnings == []
    assert set(splats.object_ids.tolist()) == ({1, 2, 5} if masks else {0}) | ({0} & set(splats.object_ids.tolist()))

    assert run_command("evaluate", out, "--json").events[-1]["psnr"] > 5
    drawn = run_command("render", out, "--ids", "--depth", "--json")
    assert drawn.events[-1]["views"] == 2
    assert {path.name for path in (out / "renders").iterdir()} == {
        f"view_{i}.{suffix}" for i in ("000", "008") for suffix in ("png", "ids.png", "depth.npy")
    }
    ids = np.asarray(Image.open(out / "renders/view_008.ids.png"))
    assert ids.shape == (48, 64) and set(np.unique(ids)) <= {0, 1, 2, 5}
    depth = np.load(out / "renders/view_008.depth.npy")
    assert depth.shape == (48, 64) and 2 < np.median(depth[depth > 0]) < 6, "cameras are 4 units away"
    assert run_command("report", out, "--json").code == EXIT_DONE

    report = json.loads((out / "report.json").read_text())
    assert {"capture", "settings", "machine", "left_out", "stages", "curve", "model", "quality", "objects"} <= set(
        report
    )
    assert report["settings"]["steps"] == 20 and report["settings"]["minutes"] is None
    assert report["machine"]["device"] == devices.name_of(devices.pick("auto"))
    stages = {stage["name"]: stage for stage in report["stages"]}
    assert list(stages) == ["read", "vote", "train", "export", "evaluate", "render", "report"]
    assert all(stage["seconds"] >= 0 and 50 < stage["peak_rss_mb"] < 5000 for stage in stages.values())
    quality = report["quality"]
    of_images, of_objects = {"psnr", "psnr_corrected", "ssim"}, {"miou", "miou_all", "mbiou", "dice", "accuracy"}
    assert set(quality) == {*of_images, *of_objects, "lpips", "miou_alone"}
    measured = {name for name, value in quality.items() if value is not None}
    assert measured == (of_images | of_objects if masks else of_images)
    assert [(view["miou"] is None, view["miou_all"] is None) for view in report["views"]] == [(not masks,) * 2] * 2
    assert all((point["miou_all"] is not None) is masks for point in report["curve"])
    assert report["model"]["gaussians"] == len(splats)
    assert report["model"]["bytes"] == (out / "splats.ply").stat().st_size
    assert [entry["id"] for entry in report["objects"]] == ([1, 2, 5] if masks else [])
    assert all(entry["name"] == f"sphere {entry['id']}" and entry["anchors"] > 0 for entry in report["objects"])
    assert [point["step"] for point in report["curve"]][-1] == 20
    left_out = {entry["what"]: entry["why"] for entry in report["left_out"]}
    assert any("from the masks" in what and "no masks" in why for what, why in left_out.items()) is not masks
    assert any("undistortion" in what for what in left_out)
    assert (out / "report.md").exists()
    assert_no_temporary_files(out)


def test_terminal_output_has_no_duplicate_lines(write_capture, tmp_path, run_command):
    scene = write_capture(views=9, size=(64, 48))
    (scene.folder / "masks" / scene.names[1]).unlink()
    result = run_command("train", scene.folder, "--out", tmp_path / "out", "--steps", 2, *SMALL)
    assert result.code == EXIT_DONE
    lines = result.err.splitlines() + [line for line in result.out.splitlines() if not line.startswith("  ")]
    assert len(lines) == len(set(lines)), lines
    assert result.err.count("have no mask") == 1


@pytest.mark.parametrize(("mode", "far"), [("explicit", 0), ("explicit", 1e6), ("view", 0), ("paper", 0)])
@pytest.mark.long
def test_anchors_file_matches_splats(write_capture, tmp_path, run_command, mode, far):
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "out"
    for viewmat in scene.viewmats:
        viewmat[:3, 3] -= viewmat[:3, :3] @ np.full(3, far)
    scene.xyz += far
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    result = run_command("train", scene.folder, "--out", out, "--steps", 40, "--mode", mode, *SMALL, "--json")
    assert result.code == EXIT_DONE
    anchors, splats = read_vertices(out / "anchors.ply"), read_vertices(out / "splats.ply")
    names = ("x", "y", "z", "object_id", "scale_0", "scale_1", "scale_2", "opacity", "splats")
    assert anchors.dtype.names == names and anchors.dtype["splats"] == anchors.dtype["object_id"] == np.uint32
    assert anchors.dtype["x"] == splats.dtype["x"] == (np.float64 if far else np.float32)
    exported = json.loads((out / "objectgs.json").read_text())["export"]
    assert len(anchors) == exported["anchors"] == result.events[-1]["anchors"]
    assert anchors["splats"].sum() == len(splats) == exported["splats"] and 0 < anchors["splats"].max() <= 4
    for i in np.unique(anchors["object_id"]):
        assert anchors["splats"][anchors["object_id"] == i].sum() == (splats["object_id"] == i).sum()
    opacity = 1 / (1 + np.exp(-splats["opacity"].astype(float)))
    assert (anchors["opacity"] * anchors["splats"]).sum() == pytest.approx(opacity.sum(), rel=1e-3)
    xyz = np.stack([anchors[axis] for axis in "xyz"], 1) - far
    nearest = np.linalg.norm(xyz[:, None] - (scene.xyz - far), axis=2).min(1)
    assert nearest.max() < 0.5, "anchors are near the points"
    scale = np.stack([anchors[f"scale_{i}"] for i in range(3)], 1)
    assert np.isfinite(scale).all() and (scale > 1e-3).all() and (scale < 2).all()


def test_view_dependent_model_exports_fit(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    result = run_command("train", capture, "--out", out, "--steps", 40, "--mode", "view", *SMALL, "--json")
    assert result.code == EXIT_DONE
    (warning,) = [message for message in result.messages("warning") if "fit" in message]
    fidelity = result.events[-1]["psnr_of_export"]
    assert f"{fidelity:.1f} dB" in warning and fidelity > 25
    splats, _ = read_splats(out / "splats.ply")
    assert splats.degree == 2 and set(splats.object_ids.tolist()) <= {0, 1, 2, 5}
    for command in ("evaluate", "report"):
        assert run_command(command, out).code == EXIT_DONE
    model = json.loads((out / "report.json").read_text())["model"]
    assert model["psnr_of_export"] == fidelity and model["gaussians"] == len(splats)


def test_export_of_explicit_model_is_exact_but_for_the_background(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    result = run_command("train", capture, "--out", out, "--steps", 20, *SMALL, "--json")
    assert result.code == EXIT_DONE
    exported = json.loads((out / "objectgs.json").read_text())["export"]
    assert exported["psnr_of_export"] is None or exported["psnr_of_export"] > 80
    # The spheres fill a part of the images only; the rest is background.
    assert 5 < exported["psnr_on_black"] < 40 and len(exported["background"]) == 3
    statuses = result.messages("status")
    (advice,) = [place for place, message in enumerate(statuses) if "--bake-background" in message]
    assert statuses[advice + 1] == "Writing splats.ply", "the advice is no step of the training"
    header = (out / "splats.ply").read_bytes()[:200].decode("ascii", "replace")
    assert "comment background " + " ".join(f"{value:.4f}" for value in exported["background"]) in header


def test_unlabeled_pixels_can_be_an_object(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    assert run_command("train", capture, "--out", out, "--steps", 5, *SMALL, "--unlabeled-is-object").code == EXIT_DONE
    assert run_command("evaluate", out).code == EXIT_DONE
    found = json.loads((out / "evaluation.json").read_text())["objects"]
    assert [entry["id"] for entry in found] == [0, 1, 2, 5]
    assert run_command("report", out).code == EXIT_DONE


# --- import ----------------------------------------------------------------------------------------------------------


def cameras_of(out: Path) -> dict:
    return json.loads((out / "cameras.json").read_text())


@pytest.mark.parametrize("masks", [True, False])
@pytest.mark.parametrize("bent", [True, False])
def test_import_writes_cameras_and_points(write_capture, tmp_path, run_command, masks, bent):
    lens = {"model": "SIMPLE_RADIAL", "params": [90, 48, 36, 0.1]} if bent else {"size": (64, 48)}
    scene, out = write_capture(views=9, masks=masks, **lens), tmp_path / "deep" / "out"
    result = run_command("import", scene.folder, "--out", out, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["views"] == 9 and result.events[-1]["masks"] is masks
    written = cameras_of(out)
    assert written["capture"] == str(scene.folder.resolve()) and written["origin"] == [0, 0, 0]
    capture = load_capture(scene.folder, out / "cache")
    for index, (camera, view) in enumerate(zip(written["cameras"], capture.views, strict=True)):
        assert camera["name"] == view.name and camera["held_out"] is (index in (0, 8))
        assert (camera["width"], camera["height"]) == (view.width, view.height)
        assert camera["K"] == view.K.tolist() and camera["viewmat"] == view.viewmat.tolist()
        for place, file in ((camera["image"], view.image_file), (camera["mask"], view.mask_file)):
            assert (place is None) == (file is None)
            assert place is None or (out / place).resolve() == file.resolve(), (
                "relative paths start at the output folder"
            )
        assert camera["image"].startswith("cache/views/" if bent else str(scene.folder))
        with Image.open(out / camera["image"]) as image:
            assert image.size == (view.width, view.height)
    rotation = np.array(written["upright"]["rotation"])
    assert rotation[2] == pytest.approx([0, -1, 0], abs=0.02), "-Y points up in this capture"
    points = read_points(out / "points.ply")
    np.testing.assert_array_equal(points.xyz, capture.points.xyz)
    np.testing.assert_array_equal(points.rgb, capture.points.rgb)
    assert not points.ids.any() and not points.visible.any() and not (out / "objects.json").exists()
    assert json.loads((out / "objectgs.json").read_text())["capture"]["folder"] == str(scene.folder.resolve())
    assert_no_temporary_files(out)
    assert run_command("train", scene.folder, "--out", out, "--steps", 2, *SMALL).code == EXIT_DONE
    assert set(read_points(out / "points.ply").ids) - {0} == ({1, 2, 5} if masks else set())
    assert cameras_of(out) == written


def test_import_keeps_votes_of_unchanged_capture(write_capture, tmp_path, run_command):
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "out"
    for vote in ((), ("--strategy", "probability", "--seed", 3)):
        assert run_command("vote", scene.folder, "--out", out, *vote).code == EXIT_DONE
        before = (out / "points.ply").read_bytes(), (out / "objects.json").read_bytes()
        assert run_command("import", scene.folder, "--out", out).code == EXIT_DONE
        assert ((out / "points.ply").read_bytes(), (out / "objects.json").read_bytes()) == before
    edit_objects(out / "objects.json", {1: {"name": "cup"}})
    Image.fromarray(np.full((48, 64), 2, np.uint8)).save(scene.folder / "masks" / scene.names[1])
    assert run_command("import", scene.folder, "--out", out).code == EXIT_DONE
    assert not read_points(out / "points.ply").ids.any() and read_objects(out / "objects.json") == []
    assert run_command("vote", scene.folder, "--out", out).code == EXIT_DONE
    assert [entry.name for entry in read_objects(out / "objects.json")] == ["cup", "sphere 2", "sphere 5"]


def test_import_of_another_capture_blocks_training_and_evaluation(trained, write_capture, run_command):
    capture, out = trained
    other = write_capture(name="other", views=9, size=(64, 48), seed=1).folder
    assert run_command("import", other, "--out", out).code == EXIT_DONE
    assert_rejected(run_command("train", other, "--out", out, "--steps", 30, *SMALL), "another capture", str(other))
    assert_rejected(run_command("evaluate", out), str(other), "not the one")
    assert run_command("evaluate", out, "--capture", capture).code == EXIT_DONE
    assert cameras_of(out)["capture"] == str(capture.resolve())
    assert run_command("train", other, "--out", out, "--steps", 5, *SMALL, "--restart").code == EXIT_DONE


# --- the user's edits ------------------------------------------------------------------------------------------------


def test_left_out_object_has_no_splats(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    assert run_command("vote", capture, "--out", out).code == EXIT_DONE
    edit_objects(out / "objects.json", {2: {"left_out": True}, 5: {"name": "planet"}})
    assert run_command("vote", capture, "--out", out).code == EXIT_DONE
    assert 2 in read_points(out / "points.ply").ids and read_objects(out / "objects.json")[1].points > 0
    train = ("train", capture, "--out", out, *SMALL)
    ended = run_command(*train, "--steps", 20, "--json")
    assert ended.code == EXIT_DONE
    assert set(read_splats(out / "splats.ply")[0].object_ids.tolist()) <= {0, 1, 5}
    assert set(read_vertices(out / "anchors.ply")["object_id"].tolist()) <= {0, 1, 5}
    assert json.loads((out / "objectgs.json").read_text())["training"]["left_out"] == [2]

    edit_objects(out / "objects.json", {2: {"left_out": None}})
    assert_rejected(run_command(*train, "--steps", 30), "without 2", "objects.json leaves out none", "--restart")
    assert run_command("evaluate", out).code == EXIT_DONE and run_command("report", out).code == EXIT_DONE
    report = json.loads((out / "report.json").read_text())
    assert [(entry["id"], entry["name"]) for entry in report["objects"]] == [(1, "sphere 1"), (5, "planet")]
    assert all(entry["iou"] is not None for entry in report["objects"])
    assert any(entry["what"] == "splats of sphere 2" for entry in report["left_out"])
    assert run_command("render", out, "--ids").code == EXIT_DONE

    edit_objects(out / "objects.json", {2: {"left_out": True}})
    assert run_command(*train, "--steps", 25).code == EXIT_DONE and step_of(out) == 25
    edit_objects(out / "objects.json", {2: {"left_out": False}})
    assert run_command(*train, "--steps", 20, "--restart").code == EXIT_DONE
    assert 2 in read_splats(out / "splats.ply")[0].object_ids
    edit_objects(out / "objects.json", {1: {"left_out": True}})
    assert_rejected(run_command(*train, "--steps", 30), "with all objects", "leaves out 1", "--restart")


def test_all_objects_can_be_left_out(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    assert run_command("vote", capture, "--out", out).code == EXIT_DONE
    edit_objects(out / "objects.json", {i: {"left_out": True} for i in (1, 2, 5)})
    for words in (("train", capture, "--out", out, "--steps", 10, *SMALL), ("evaluate", out), ("report", out)):
        assert run_command(*words).code == EXIT_DONE
    assert set(read_splats(out / "splats.ply")[0].object_ids.tolist()) == {0}
    assert json.loads((out / "report.json").read_text())["quality"]["miou"] is None


def test_training_ignores_merges(trained, run_command):
    capture, out = trained
    edit_objects(out / "objects.json", {1: {"merged_into": 2}})
    assert run_command("train", capture, "--out", out, "--steps", 25, *SMALL).code == EXIT_DONE
    assert {1, 2} <= set(read_splats(out / "splats.ply")[0].object_ids.tolist())


# --- resuming --------------------------------------------------------------------------------------------------------


def test_training_again_skips_resumes_or_restarts(trained, run_command):
    capture, out = trained
    train = ("train", capture, "--out", out, *SMALL)
    again = run_command(*train, "--steps", 20, "--json")
    assert again.code == EXIT_DONE and any("Already trained for 20 steps" in m for m in again.messages("status"))
    assert step_of(out) == 20
    longer = run_command(*train, "--steps", 30, "--json")
    assert any("Resuming after step 20" in m for m in longer.messages("status"))
    assert longer.events[-1]["steps"] == 30 and step_of(out) == 30
    assert_rejected(run_command(*train, "--steps", 40, "--sh-degree", 2), "checkpoint", "sh_degree", "--restart")
    assert_rejected(
        run_command(*train, "--steps", 40, "--strategy", "correspondence"), "--strategy majority", "--restart"
    )
    assert_rejected(run_command(*train, "--steps", 40, "--max-size", 40), "--max-size 1600", "--restart")
    assert step_of(out) == 30
    anew = run_command(*train, "--steps", 10, "--sh-degree", 2, "--strategy", "correspondence", "--restart", "--json")
    assert anew.events[-1]["steps"] == 10 and step_of(out) == 10
    assert read_splats(out / "splats.ply")[0].degree == 2
    (out / "checkpoint" / CURRENT).unlink()
    assert step_of(out) == 0, "the previous checkpoint belongs to the new training"


def test_masks_that_changed_count_when_a_training_resumes(trained, tmp_path, run_command):
    capture, out = shutil.copytree(trained[0], tmp_path / "changed"), trained[1]
    for path in (capture / "masks").iterdir():
        ids = np.array(Image.open(path))
        Image.fromarray(np.where(ids == 1, 77, ids).astype(ids.dtype)).save(path)
    result = run_command("train", capture, "--out", out, "--steps", 30, *SMALL, "--json")
    assert result.code == EXIT_DONE and step_of(out) == 30
    assert any("objects that this training does not have (77)" in sentence for sentence in result.messages("warning"))
    assert 77 in {entry.id for entry in read_objects(out / "objects.json")}


def test_training_does_not_resume_with_another_capture(trained, write_capture, run_command):
    _, out = trained
    other = write_capture(name="other", views=9, size=(64, 48), seed=1).folder
    assert_rejected(
        run_command("train", other, "--out", out, "--steps", 40, *SMALL), "another capture", str(other), "--restart"
    )
    assert_rejected(run_command("render", out, "--capture", other), str(other), "not the one")


def test_training_does_not_resume_with_other_held_out_views(trained, tmp_path, run_command):
    shared, out = trained
    capture = shutil.copytree(shared, tmp_path / "capture")
    (capture / "test.txt").write_text("view_003.png\n")
    assert_rejected(run_command("train", capture, "--out", out, "--steps", 40, *SMALL), "held-out", "--restart")


@pytest.mark.long
def test_votes_are_reused_until_inputs_change(write_capture, tmp_path, run_command, monkeypatch):
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "out"
    cast = []
    original = votes.vote_points
    monkeypatch.setattr(votes, "vote_points", lambda *a, **k: (cast.append(a[1]), original(*a, **k))[1])
    train = ("train", scene.folder, "--out", out, "--steps", 1, *SMALL, "--restart")
    assert run_command("vote", scene.folder, "--out", out).code == EXIT_DONE
    assert run_command(*train).code == EXIT_DONE and cast == ["majority"]
    assert run_command(*train, "--seed", 3).code == EXIT_DONE and cast == ["majority"], (
        "majority votes do not depend on the seed"
    )
    assert run_command(*train, "--strategy", "probability").code == EXIT_DONE and cast[1:] == ["probability"]
    assert run_command(*train, "--strategy", "probability", "--seed", 3).code == EXIT_DONE and len(cast) == 3
    assert run_command(*train).code == EXIT_DONE and len(cast) == 4
    Image.fromarray(np.full((48, 64), 2, np.uint8)).save(scene.folder / "masks" / scene.names[1])
    assert run_command(*train).code == EXIT_DONE and len(cast) == 5, "a mask was edited"
    (out / "points.ply").write_bytes((out / "points.ply").read_bytes()[:200])
    assert run_command(*train).code == EXIT_DONE and len(cast) == 6, "points.ply was truncated"


def test_report_omits_outdated_evaluation(trained, run_command):
    capture, out = trained
    missing = run_command("report", out)
    assert "evaluation.json" in missing.err and "run `evaluate`" in missing.err
    report = json.loads((out / "report.json").read_text())
    assert set(report["quality"].values()) == {None}
    assert [(entry["id"], entry["iou"]) for entry in report["objects"]] == [(1, None), (2, None), (5, None)]
    assert run_command("evaluate", out).code == EXIT_DONE and run_command("report", out).err == ""
    assert json.loads((out / "report.json").read_text())["quality"]["psnr"] > 5
    assert run_command("train", capture, "--out", out, "--steps", 25, *SMALL).code == EXIT_DONE
    assert "earlier state" in run_command("report", out).err
    assert json.loads((out / "report.json").read_text())["quality"]["psnr"] is None


def test_moved_capture_is_found_with_capture_option(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    assert run_command("train", capture, "--out", out, "--steps", 5, *SMALL).code == EXIT_DONE
    moved = capture.rename(tmp_path / "moved")
    for command in ("evaluate", "render", "report"):
        assert_rejected(run_command(command, out), str(capture), "does not exist", "--capture")
    assert not (out / "renders").exists() and not (out / "report.json").exists()
    assert run_command("evaluate", out, "--capture", moved).code == EXIT_DONE
    assert run_command("render", out).code == EXIT_DONE, "the new location is stored"
    again = run_command("train", moved, "--out", out, "--steps", 5, *SMALL)
    assert again.code == EXIT_DONE and "Already trained" in again.out


def test_renders_of_same_stem_get_distinct_names(write_capture, tmp_path, run_command):
    names = ["a/1.png", "a/1.jpg", "a/2.png", "b/1.png"]
    capture, out = write_capture(views=4, size=(64, 48), names=names, masks=False).folder, tmp_path / "out"
    assert run_command("train", capture, "--out", out, "--steps", 2, *SMALL).code == EXIT_DONE
    assert run_command("render", out, "--views", "all").code == EXIT_DONE
    found = {path.relative_to(out / "renders").as_posix() for path in (out / "renders").rglob("*.png")}
    assert found == {"a/1.png.png", "a/1.jpg.png", "a/2.png", "b/1.png"}


def test_too_few_views_skip_evaluation(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=2, size=(64, 48)).folder, tmp_path / "out"
    assert run_command("train", capture, "--out", out, "--steps", 3, *SMALL).code == EXIT_DONE
    assert_rejected(run_command("evaluate", out), str(capture), "too few views")
    assert run_command("evaluate", out, "--json").events[-1]["nothing_made"] is True
    assert "nothing_made" not in run_command("evaluate", out / "missing", "--json").events[-1]
    assert run_command("render", out).code == EXIT_DONE and len(list((out / "renders").iterdir())) == 2
    assert run_command("report", out).code == EXIT_DONE
    report = json.loads((out / "report.json").read_text())
    assert report["quality"]["psnr"] is None and report["curve"][-1]["psnr"] is None


# --- invalid input ---------------------------------------------------------------------------------------------------


def corrupt(scene, what: str) -> tuple[str, ...]:
    """Break the capture and return the words that the error must contain."""
    model, images, masks = scene.folder / "sparse/0", scene.folder / "images", scene.folder / "masks"
    first = scene.names[0]
    if what == "no folder":
        shutil.rmtree(scene.folder)
        return str(scene.folder), "does not exist"
    if what.startswith("missing"):
        (model / what.split()[1]).unlink()
        return what.split()[1], "missing"
    if what.startswith("truncated"):
        path = model / what.split()[1]
        path.write_bytes(path.read_bytes()[:-7])
        return path.name, "truncated"
    data = bytearray((model / "images.bin").read_bytes())
    if what == "no pose":
        (model / "images.bin").write_bytes(struct.pack("<Q", 0))
        return "images.bin", "no image with a pose"
    if what == "NaN pose":
        struct.pack_into("<d", data, 12, np.nan)
        (model / "images.bin").write_bytes(data)
        return "images.bin", first
    if what == "3 points":
        points = b"".join(struct.pack("<Q3d3BdQ", i, i, 0, 0, 1, 2, 3, 0.1, 0) for i in range(3))
        (model / "points3D.bin").write_bytes(struct.pack("<Q", 3) + points)
        return "points3D.bin", "only 3 points"
    if what == "image size":
        Image.new("RGB", (48, 64)).save(images / first)
        return f"images/{first}", "48x64", "64x48"
    if what == "masks missing":
        for name in scene.names[:6]:
            (masks / name).unlink()
        return f"masks/{first}", "missing"
    if what == "mask size":
        Image.new("L", (50, 48)).save(masks / first)
        return f"masks/{first}", "50x48", "64x48"
    assert what == "mask is a photo"
    for name in scene.names:
        noise = np.random.default_rng(0).integers(0, 255, (96, 128, 3)).astype(np.uint8)
        Image.fromarray(noise).save(masks / name)
    return f"masks/{first}", "not an ID map"


@pytest.mark.parametrize(
    "what",
    ["no folder", "missing cameras.bin", "missing points3D.bin", "truncated images.bin", "truncated points3D.bin",
     "no pose", "NaN pose", "3 points", "image size", "masks missing", "mask size", "mask is a photo"],
)  # fmt: skip
def test_invalid_captures_are_rejected_without_files(write_capture, tmp_path, run_command, what):
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "made" / "out"
    words = corrupt(scene, what)
    assert_rejected(run_command("check", scene.folder), *words)
    for command in ("import", "vote", "train"):
        assert_rejected(run_command(command, scene.folder, "--out", out), *words)
        assert not out.parent.exists(), "a rejected command leaves no folder"
    events = run_command("train", scene.folder, "--out", out, "--json").events
    assert events[-1]["type"] == "error" and all(word in events[-1]["message"] for word in words)

    out.mkdir(parents=True)
    (out / "mine.txt").write_text("kept")
    assert run_command("train", scene.folder, "--out", out).code == EXIT_BAD_INPUT
    assert [path.name for path in out.iterdir()] == ["mine.txt"], "an existing folder is unchanged"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("truncated", ("images.bin", "truncated")),
        ("cameras_only", ("images.bin", "missing")),
        ("missing_cameras_subfolders_txt", ("images", "does not exist")),
        ("degenerate_two_images", ("cameras.bin", "degenerate")),
    ],
)
def test_invalid_real_models_are_rejected(tmp_path, run_command, name, words):
    if not (FIXTURES / name).is_dir():
        pytest.skip(f"fixture {name} is absent")
    assert_rejected(run_command("check", FIXTURES / name), name, *words)
    assert_rejected(run_command("train", FIXTURES / name, "--out", tmp_path / "out"), name, *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("below", ["file", "file/out"])
def test_unwritable_output_folder_is_rejected(write_capture, tmp_path, run_command, below):
    (tmp_path / "file").write_text("mine")
    assert_rejected(
        run_command("vote", write_capture().folder, "--out", tmp_path / below), str(tmp_path / below), "--out"
    )
    assert (tmp_path / "file").read_text() == "mine"


def test_folders_without_reconstruction_are_rejected(trained, write_capture, tmp_path, run_command):
    capture, out = trained
    (tmp_path / "empty").mkdir()
    assert run_command("vote", capture, "--out", tmp_path / "voted").code == EXIT_DONE
    for command in ("evaluate", "render", "report"):
        assert_rejected(run_command(command, tmp_path / "nowhere"), "nowhere", "does not exist")
        assert_rejected(run_command(command, tmp_path / "empty"), "empty", "train first")
        assert_rejected(run_command(command, tmp_path / "voted"), "voted", "train first")
    assert list((tmp_path / "empty").iterdir()) == []
    (out / "objectgs.json").write_text('{"stages": ')
    assert_rejected(run_command("report", out), "objectgs.json", "JSON")
    (out / "objectgs.json").write_text("{}")
    assert_rejected(run_command("report", out), "objectgs.json", "train")
    assert_rejected(run_command("train", capture, "--out", out, "--steps", 30, *SMALL), "objectgs.json", "--restart")


@pytest.mark.parametrize(
    "words",
    [[], ["fly"], ["train"], ["train", "x"], ["train", "x", "--out", "y", "--steps", "0"],
     ["train", "x", "--out", "y", "--minutes", "nan"], ["train", "x", "--out", "y", "--minutes", "-1"],
     ["train", "x", "--out", "y", "--minutes", "1", "--steps", "5"], ["train", "x", "--out", "y", "--seed", "-1"],
     ["train", "x", "--out", "y", "--semantic-weight", "-0.1"], ["train", "x", "--out", "y", "--sh-degree", "4"],
     ["check", "x", "--max-size", "many"], ["render", "x", "--views", "some"]],
)  # fmt: skip
def test_invalid_command_lines_are_rejected(capsys, words):
    assert arguments.main(words) == EXIT_BAD_INPUT
    captured = capsys.readouterr()
    assert_rejected(CommandResult(EXIT_BAD_INPUT, captured.out, captured.err), "--help")
    assert "_" not in captured.err.replace("command_line", ""), "no internal names"
    assert arguments.main([*words, "--json"]) == EXIT_BAD_INPUT
    assert CommandResult(EXIT_BAD_INPUT, *capsys.readouterr()).events[-1]["type"] == "error"


# --- a full disk, a damaged checkpoint -------------------------------------------------------------------------------


@pytest.fixture
def full_disk_for(monkeypatch):
    """Function that makes the disk full for files in a folder whose name has this ending."""
    original = os.fsync

    def start(folder: Path, ending: str) -> None:
        def fsync(descriptor):
            for path in folder.rglob(f"*{ending}.part"):
                if os.fstat(descriptor).st_ino == path.stat().st_ino:
                    raise OSError(28, "No space left on device")
            original(descriptor)

        monkeypatch.setattr(os, "fsync", fsync)

    return start


def test_full_disk_during_checkpoint_keeps_previous_one(trained, run_command, full_disk_for, monkeypatch):
    capture, out = trained
    train = ("train", capture, "--out", out, "--steps", 30, *SMALL)
    full_disk_for(out, "safetensors")
    assert_rejected(run_command(*train), str(out / "checkpoint" / CURRENT), "No space left on device")
    assert_no_temporary_files(out)
    assert step_of(out) == 20
    monkeypatch.undo()
    resumed = run_command(*train)
    assert resumed.code == EXIT_DONE and "Resuming after step 20" in resumed.out and step_of(out) == 30


@pytest.mark.parametrize(
    ("command", "ending"),
    [("train", "splats.ply"), ("train", "anchors.ply"), ("train", "cameras.json"), ("train", "objectgs.json"),
     ("evaluate", "evaluation.json"), ("render", "view_000.png"), ("render", "view_000.ids.png"),
     ("report", "report.md")],
)  # fmt: skip
def test_full_disk_during_other_files_keeps_training(trained, run_command, full_disk_for, command, ending):
    capture, out = trained
    words = ("train", capture, "--out", out, "--steps", 25, *SMALL) if command == "train" else (command, out)
    before = (out / "splats.ply").read_bytes()
    full_disk_for(out, ending)
    assert_rejected(
        run_command(*words, *(["--ids"] if command == "render" else [])), ending, "No space left on device", "free some"
    )
    assert_no_temporary_files(out)
    assert step_of(out) == {"splats.ply": 25, "anchors.ply": 25}.get(ending, 20), "the trained steps are kept"
    assert ((out / "splats.ply").read_bytes() == before) is (ending != "anchors.ply")


def test_full_disk_at_start_leaves_no_folder(write_capture, tmp_path, run_command, full_disk_for):
    full_disk_for(tmp_path, "")
    assert_rejected(
        run_command("vote", write_capture().folder, "--out", tmp_path / "out"), str(tmp_path / "out"), "No space left"
    )
    assert not (tmp_path / "out").exists()


def test_truncated_checkpoint_falls_back_with_warning(trained, run_command):
    capture, out = trained
    assert run_command("train", capture, "--out", out, "--steps", 25, *SMALL).code == EXIT_DONE
    current = out / "checkpoint" / CURRENT
    current.write_bytes(current.read_bytes()[:5000])
    for command in ("evaluate", "render", "report"):
        result = run_command(command, out)
        assert result.code == EXIT_DONE and f"{current} is truncated" in result.err
    result = run_command("train", capture, "--out", out, "--steps", 30, *SMALL)
    assert result.code == EXIT_DONE and f"{current} is truncated" in result.err
    assert "Resuming after step 20" in result.out and step_of(out) == 30
    for path in (current, out / "checkpoint" / PREVIOUS):
        path.write_bytes(b"")
    assert_rejected(run_command("render", out), str(out / "checkpoint"), "truncated")
    assert_rejected(
        run_command("train", capture, "--out", out, "--steps", 40, *SMALL), str(out / "checkpoint"), "--restart"
    )
    assert run_command("train", capture, "--out", out, "--steps", 5, *SMALL, "--restart").code == EXIT_DONE


# --- stopping --------------------------------------------------------------------------------------------------------


def signal_at(monkeypatch, owner, name: str, call: int, number=signal.SIGINT) -> None:
    """Raise a signal in the given call of `owner.name`."""
    original = getattr(owner, name)
    calls = []

    def wrapper(*args, **keywords):
        calls.append(1)
        if len(calls) == call:
            signal.raise_signal(number)
        return original(*args, **keywords)

    monkeypatch.setattr(owner, name, wrapper)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_saves_and_next_run_resumes(trained, run_command, monkeypatch, number):
    capture, out = trained
    train = ("train", capture, "--out", out, "--steps", 40, *SMALL)
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    signal_at(monkeypatch, Trainer, "step", 7, number)
    before = (out / "splats.ply").read_bytes()
    stopped = run_command(*train, "--json")
    assert stopped.code == EXIT_CANCELLED
    assert (out / "splats.ply").read_bytes() != before, "the stopped training exported its splats"
    assert stopped.events[-1]["stopped"] is True and "after 27 steps" in stopped.events[-1]["message"]
    assert step_of(out) == 27
    stages = {s["name"]: s["seconds"] for s in json.loads((out / "objectgs.json").read_text())["stages"]}
    spent = load_checkpoint(out / "checkpoint")[1]["progress"]["seconds"]
    assert stages["train"] == pytest.approx(spent, abs=0.02), "the time before the stop is included"
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == handlers
    monkeypatch.undo()
    resumed = run_command(*train)
    assert resumed.code == EXIT_DONE and "Resuming after step 27" in resumed.out and step_of(out) == 40


def test_stop_line_on_stdin_stops_training(trained, run_command, monkeypatch):
    capture, out = trained
    begun = threading.Event()

    class Typed:
        def __iter__(self):
            yield "hello\n"
            begun.wait(60)
            yield "stop\n"
            time.sleep(60)

    original = Trainer.step

    def step(self, progress):
        begun.set()
        return original(self, progress)

    monkeypatch.setattr(Trainer, "step", step)
    monkeypatch.setattr(sys, "stdin", Typed())
    stopped = run_command("train", capture, "--out", out, "--steps", 100_000, *SMALL, "--json")
    assert stopped.code == EXIT_CANCELLED and stopped.events[-1]["stopped"] is True
    assert 20 < step_of(out) < 100_000


def test_stopping_other_commands_leaves_no_partial_files(write_capture, trained, tmp_path, run_command, monkeypatch):
    import backend.labels.voting as voting

    capture, out = trained
    with monkeypatch.context() as patch:
        signal_at(patch, voting, "find_visible_points", 3)
        assert run_command("vote", capture, "--out", tmp_path / "voted").code == EXIT_CANCELLED
    assert not (tmp_path / "voted/points.ply").exists() and not (tmp_path / "voted/objects.json").exists()
    commands = (
        (render, "render", out, "--views", "all", "--ids"),
        (evaluate, "evaluate", out),
        (report, "report", out),
    )
    for module, *words in commands:
        with monkeypatch.context() as patch:
            signal_at(patch, module, "draw", 2)
            result = run_command(*words)
        assert result.code == EXIT_CANCELLED and "Stopped" in result.out and "error" not in result.err
        assert len(list((out / "renders").glob("view_???.png"))) == 2
        assert not (out / "evaluation.json").exists() and not (out / "report.md").exists()
    assert_no_temporary_files(out)
    assert_no_temporary_files(tmp_path / "voted")
    scene = write_capture(name="bent", views=5, model="SIMPLE_RADIAL", params=[90, 48, 36, 0.1])
    with monkeypatch.context() as patch:
        signal_at(patch, opening, "load_capture", 1)
        assert run_command("vote", scene.folder, "--out", tmp_path / "bent-out").code == EXIT_CANCELLED
    assert_no_temporary_files(tmp_path / "bent-out")
    assert run_command("vote", scene.folder, "--out", tmp_path / "bent-out").code == EXIT_DONE


def test_second_signal_stops_immediately(trained, run_command, monkeypatch):
    capture, out = trained

    def twice(*_):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "step", twice)
    result = run_command("train", capture, "--out", out, "--steps", 40, *SMALL)
    assert result.code == EXIT_CANCELLED and "Stopped immediately" in result.out and step_of(out) == 20


@pytest.mark.long
def test_process_stops_on_signal_and_closed_stdout(write_capture, tmp_path):
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "out"
    train = [sys.executable, "-m", "backend", "train", str(scene.folder), "--out", str(out), "--steps", "100000",
             *SMALL, "--threads", "1", "--json"]  # fmt: skip
    process = subprocess.Popen(train, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    lines = []
    for line in process.stdout:
        lines.append(line)
        if '"step"' in line:
            process.send_signal(signal.SIGTERM)
            break
    rest, err = process.communicate(timeout=60)
    result = CommandResult(process.returncode, "".join(lines) + rest, err)
    assert result.code == EXIT_CANCELLED and result.events[-1]["stopped"] is True and err == ""
    assert step_of(out) > 0

    process = subprocess.Popen(train, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=60) == EXIT_CANCELLED
    assert process.stderr.read() == ""
    assert step_of(out) > 0
    assert_no_temporary_files(out)


# --- locking ---------------------------------------------------------------------------------------------------------


def test_folder_in_use_is_named_by_a_field(write_capture, tmp_path, run_command):
    """The command `batch` of headless.py relies on it."""
    capture, out = write_capture(views=3, size=(64, 48)).folder, tmp_path / "out"
    out.mkdir()
    with lock.locked(out):
        event = run_command("import", capture, "--out", out, "--json").events[-1]
    assert event["type"] == "error" and event["in_use"] is True


@pytest.mark.long
def test_folder_is_locked_by_training_process(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    train = ("train", str(capture), "--out", str(out), *SMALL)
    process = subprocess.Popen(
        [sys.executable, "-m", "backend", *train, "--steps", "100000", "--threads", "1", "--json"],
        cwd=ROOT, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        try:
            assert any('"step"' in line for line in process.stdout)
            for words in (train, ("vote", capture, "--out", out), (*train, "--restart")):
                sentence = assert_rejected(run_command(*words))
                assert sentence == (
                    f"error: {out} is in use by another process (pid {process.pid}); wait for it to finish or stop it."
                )
            assert process.poll() is None and (out / "points.ply").exists()
        finally:
            process.kill()
        # The process has ended, but its exit status has not been collected.
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert (out / LOCK).read_text() == f"{process.pid}\n"
        assert run_command(*train, "--steps", 5).code == EXIT_DONE
    assert_no_temporary_files(out)


@pytest.mark.parametrize("left", ["", "no number", "999999999", "0", "-1", pytest.param(str(os.getpid()), id="own")])
def test_stale_lock_is_taken_over(trained, run_command, left):
    capture, out = trained
    (out / LOCK).write_text(left)
    assert run_command("train", capture, "--out", out, "--steps", 20, *SMALL).code == EXIT_DONE
    assert_no_temporary_files(out)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, OSError, MemoryError, InputError])
def test_lock_is_removed_after_any_error(trained, run_command, monkeypatch, error):
    capture, out = trained
    seen = []

    def step(*_):
        seen.append((out / LOCK).read_text())
        raise error("It ended.")

    monkeypatch.setattr(Trainer, "step", step)
    assert run_command("train", capture, "--out", out, "--steps", 30, *SMALL).code != EXIT_DONE
    assert seen == [f"{os.getpid()}\n"]
    assert_no_temporary_files(out)


def test_failed_lock_write_leaves_no_file(tmp_path, monkeypatch):
    def full():
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lock.os, "getpid", full)
    with pytest.raises(OSError) as failure, lock.locked(tmp_path):
        pass
    assert failure.value.filename == str(tmp_path / LOCK) and not list(tmp_path.iterdir())


# --- other errors ----------------------------------------------------------------------------------------------------


def test_library_that_cannot_be_loaded_is_named(run_command, monkeypatch):
    """As torch on Windows, whose error has no file, and which is imported again to describe it."""

    def refuse(*_):
        raise OSError(None, "The paging file is too small for this operation to complete")

    monkeypatch.setattr("backend.commands.command_of", refuse)
    monkeypatch.setattr("backend.raster.devices.is_out_of_memory", refuse)
    result = run_command("doctor", "--json")
    assert result.code == 1 and "paging file is too small" in result.messages("error")[0]


def test_unexpected_error_returns_exit_code_1(write_capture, run_command, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr(check, "check_capture", broken)
    result = run_command("check", write_capture().folder, "--json")
    assert result.code == EXIT_FAILED and "Traceback" in result.err
    assert result.messages("error") == ["Unexpected error: ZeroDivisionError: two lines"]


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 99 bytes."),
    ],
)
def test_out_of_memory_is_reported(write_capture, run_command, monkeypatch, error):
    def greedy(*_):
        raise error

    monkeypatch.setattr(check, "check_capture", greedy)
    assert_rejected(run_command("check", write_capture().folder), "not enough memory", "--max-size")


@pytest.mark.parametrize(("command", "more"), [
    ("train", " or try a smaller --max-size or --max-anchors, or --device cpu. The same command resumes from the last "
              "checkpoint."),
    ("film", " or use --device cpu."),
])  # fmt: skip
def test_full_memory_of_the_gpu_is_reported_with_options_of_the_command(run_command, monkeypatch, command, more):
    def greedy(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr("backend.commands.command_of", lambda _: greedy)
    result = run_command(command, "a", "--out", "b", *(["--shot", "c"] if command == "film" else []), "--json")
    assert result.code == EXIT_BAD_INPUT
    assert result.messages("error") == [f"The GPU's memory is full; close programs that use it,{more}"]


def test_nonfinite_figures_are_null(trained, run_command, monkeypatch):
    _, out = trained
    monkeypatch.setattr("backend.evaluation.metrics.psnr", lambda a, b: float("inf"))
    result = run_command("evaluate", out, "--json")
    assert result.code == EXIT_DONE and "Infinity" not in result.out
    assert json.loads((out / "evaluation.json").read_text())["quality"]["psnr"] is None


def test_doctor_runs_small_scene(run_command):
    result = run_command("doctor", "--json")
    assert result.code == EXIT_DONE and "works" in result.events[-1]["message"]
    if devices.why_not_cuda() is not None:
        assert result.events[-1]["machine"]["device"] == "cpu"
        assert f"CUDA is not used: {devices.why_not_cuda()}" in result.messages("status")


def test_help_has_examples_and_defaults(capsys):
    names = ["check", "import", "vote", "train", "render", "edit", "export", "import-splats", "evaluate", "report"]
    names.append("doctor")
    texts = {}
    for words in ([], *([name] for name in names)):
        with pytest.raises(SystemExit) as ended:
            arguments.main([*words, "--help"])
        assert ended.value.code == 0
        texts["".join(words)] = text = capsys.readouterr().out
        assert max(map(len, text.splitlines())) <= 90
    for name in names:
        assert re.search(f"^    {name}\\s", texts[""], re.M) and f"example:\n  python -m backend {name}" in texts[name]
    defaults = Settings()
    train = " ".join(texts["train"].split())
    for option, value in {
        "--max-anchors N": defaults.max_anchors, "--offsets N": defaults.offsets,
        "--semantic-weight W": defaults.semantic_weight, "--minutes M": 5,
    }.items():  # fmt: skip
        assert f"({value})" in train.rsplit(option + " ", 1)[1].split(" --")[0], option


# --- the fit of a view-dependent model -------------------------------------------------------------------------------


def test_fit_of_view_independent_model_is_exact(write_capture, tmp_path, run_command, monkeypatch):
    scene = write_capture(views=9, size=(64, 48))
    capture = load_capture(scene.folder, tmp_path / "cache")
    ids = np.repeat([1, 2, 5], len(capture.points.xyz) // 3)
    set_threads(1)
    trainer = Trainer.start(capture, ids, Settings(mode="view", offsets=4))
    for i in range(30):
        trainer.step(i / 30)
    model = trainer.model
    cameras = [trainer.scene.camera(i) for i in range(len(capture.views))]
    with torch.no_grad():
        model.heads.hidden.weight[:, -4:] *= 3.0
    assert 20 < agreement(model, FittedSplats(model, *fit_splats(model, cameras)), cameras).psnr < 60
    with torch.no_grad():
        model.heads.hidden.weight[:, -4:] = 0.0
    splats, source = fit_splats(model, cameras)
    fitted = FittedSplats(model, splats, source)
    assert agreement(model, fitted, cameras).psnr > 60
    assert set(splats.object_ids.tolist()) <= {0, 1, 2, 5}
    monkeypatch.setattr("backend.export.fit._ANCHORS_AT_ONCE", 50)
    monkeypatch.setattr("backend.export.fit._SPLATS_AT_ONCE", 70)
    parts, again = fit_splats(model, cameras)
    np.testing.assert_array_equal(again, source)
    assert (model.classes.ids_of(model.anchors.ids[source // 4].numpy()) == splats.object_ids).all()
    for name in ("means", "quats", "scales", "opacities", "sh", "object_ids"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(splats, name))
    assert agreement(model, fitted, []) is None
