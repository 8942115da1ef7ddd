"""The mesh command: output, errors, stopping and resuming."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from backend.commands.objects import mesh as command
from backend.labels.corrections import IGNORED
from backend.mesh.surface import NoSurface, Surface
from backend.shared.class_table import ClassTable
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, Cancelled
from backend.shared.formats.mesh_ply import read_mesh
from backend.shared.reconstruction.meshes import read_waiting
from backend.shared.reconstruction.objects import edit_objects

from .command_result import assert_rejected

TRAINING = ("--offsets", 4, "--background", "black")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Folder for the training that the tests share."""
    return tmp_path_factory.mktemp("spheres")


@pytest.fixture
def trained(kept, tmp_path, write_capture, run_command):
    """A copy of a reconstruction of three spheres, trained until the spheres have a shape."""
    if not (kept / "out").exists():
        scene = write_capture(views=24, size=(96, 72))
        for name, ids in zip(scene.names, scene.ids):
            # The background is black, so that no splats are needed to explain it.
            pixels = np.asarray(Image.open(scene.folder / "images" / name))
            Image.fromarray(pixels * (ids != 0).astype(np.uint8)[..., None]).save(scene.folder / "images" / name)
        shutil.copytree(scene.folder, kept / "capture")
        assert (
            run_command("train", kept / "capture", "--out", kept / "out", "--steps", 250, *TRAINING).code == EXIT_DONE
        )
    shutil.copytree(kept / "out", tmp_path / "out")
    return tmp_path / "out"


def entries(out) -> dict:
    return json.loads((out / "meshes" / "meshes.json").read_text())["meshes"]


@pytest.mark.long
def test_objects_become_meshes_of_correct_position_and_size(trained, run_command, write_capture):
    result = run_command("mesh", trained, "--faces", 2000, "--texture-size", 256, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["made"] == 3
    shares = [event["done"] / event["total"] for event in result.events if event.get("what") == "meshes"]
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1, abs=0.02) and len(shares) > 10
    for object_id, center, radius in ((1, (-0.7, 0, 0), 0.5), (2, (0.7, 0.1, 0), 0.45), (5, (0, -0.2, 0.9), 0.35)):
        entry = entries(trained)[str(object_id)]
        assert entry["name"] == f"sphere {object_id}" and entry["ids"] == [object_id] and entry["trained_steps"] == 250
        found = read_mesh(trained / "meshes" / entry["file"])
        assert len(found.faces) == entry["faces"] <= 2000 and len(found.vertices) == entry["vertices"]
        assert entry["watertight"] is True and entry["unobserved"] == pytest.approx(found.unobserved.mean(), abs=1e-3)
        distance = np.linalg.norm(found.vertices - center, axis=1)
        assert abs(np.median(distance) - radius) < 0.1 * radius, "position and size match the sphere"
        outward = (found.normals * (found.vertices - center)).sum(1) / distance
        assert np.median(outward) > 0.9
        assert found.uvs.min() >= 0 and found.uvs.max() <= 1
        with Image.open(trained / "meshes" / found.texture) as texture:
            assert texture.size == (256, 256)
            assert np.asarray(texture).std() > 1
    assert not list(trained.rglob("*.part")) and not (trained / ".lock").exists()


@pytest.mark.long
def test_merged_objects_sets_and_scene_are_meshed(trained, run_command):
    edit_objects(trained / "objects.json", {2: {"merged_into": 1}, 5: {"left_out": True}})
    quick = ("--faces", 1000, "--texture-size", 256)
    assert run_command("mesh", trained, *quick).code == EXIT_DONE
    assert set(entries(trained)) == {"1"} and entries(trained)["1"]["ids"] == [1, 2]
    xs = read_mesh(trained / "meshes" / "1.ply").vertices[:, 0]
    assert xs.min() < -0.9 and xs.max() > 0.9, "both spheres"
    assert (
        run_command("mesh", trained, *quick, "--set", "pair=1,sphere 5", "--scene", "--objects", "5").code == EXIT_DONE
    )
    found = entries(trained)
    assert set(found) == {"1", "5", "pair", "scene"}
    assert found["pair"]["ids"] == [1, 2, 5] and found["scene"]["ids"] is None
    assert (trained / "meshes" / "scene.ply").exists() and (trained / "meshes" / "pair.png").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--objects", "7"), ("no object 7", "1 sphere 1")),
        (("--objects", "teapot"), ("no object teapot", "sphere 5")),
        (("--set", "1=1,2"), ("--set 1=",)),
        (("--set", "a=1,2", "--set", "a=5"), ("--set a=", "twice")),
        (("--set", "pair"), ("NAME=ID,ID",)),
        (("--faces", "3"), ("of at least 100",)),
        (("--texture-size", "1000"), ("1000",)),
    ],
)
def test_invalid_mesh_options_are_rejected(trained, run_command, words, expected):
    assert_rejected(run_command("mesh", trained, *words), *expected)
    assert not (trained / "meshes").exists()


class Stub:
    """Replacement for meshing: records the targets, and can stop the command or find no surface."""

    def __init__(self, monkeypatch, stop_at: int | None = None, without=()) -> None:
        self.made: list[str] = []
        self._stop_at = stop_at

        def make(target, options, trained, views, part):
            if len(self.made) == self._stop_at:
                raise Cancelled("Stopped. Run the same command again to continue.")
            self.made.append(target.key)
            entry = command._entry_of(target, options, trained)
            if target.key in without:
                return replace(entry, why=f"No view shows {target.name}.")
            for suffix in ("ply", "png"):
                (trained.folder.meshes / f"{target.key}.{suffix}").write_bytes(b"")
            return replace(entry, file=f"{target.key}.ply", texture=f"{target.key}.png")

        monkeypatch.setattr(command, "_make", make)


def test_existing_meshes_are_not_made_again(trained, run_command, monkeypatch):
    first = Stub(monkeypatch, stop_at=2)
    assert run_command("mesh", trained).code == EXIT_CANCELLED and first.made == ["1", "2"]
    assert set(entries(trained)) == {"1", "2"} and not (trained / ".lock").exists()
    assert read_waiting(trained / "meshes") == ["5"], "an interrupted job leaves what it was to make"
    second = Stub(monkeypatch)
    assert run_command("mesh", trained).code == EXIT_DONE and second.made == ["5"]
    assert set(entries(trained)) == {"1", "2", "5"} and not read_waiting(trained / "meshes")
    assert run_command("mesh", trained).code == EXIT_DONE and second.made == ["5"], "all meshes exist"
    (trained / "meshes" / "2.png").unlink()
    assert run_command("mesh", trained).code == EXIT_DONE and second.made == ["5", "2"]
    assert run_command("mesh", trained, "--objects", "1", "--faces", 500).code == EXIT_DONE and second.made[2:] == ["1"]
    assert run_command("mesh", trained, "--faces", 500, "--restart").code == EXIT_DONE and second.made[3:] == [
        "1",
        "2",
        "5",
    ]


def test_meshes_are_made_by_corrected_masks(trained, run_command, monkeypatch):
    """As the training: what other photos contradict is ignored, here all that one photo shows."""
    seen = []

    def corrected(trained, _reporter):
        index = trained.capture.train_indices[0]
        return trained.capture.with_corrected_masks({index}, lambda _, mask: np.full_like(mask, IGNORED))

    def make(target, options, trained, views, part):
        for index in views.indices[:2]:
            assert (trained.capture.mask(index) > 0).any()
            seen.append((views.scene.target(index)[1] >= 0).any().item())
            views._turn_to([1])
            seen.append(views._claimed(index).any())
        raise Cancelled("Stopped.")

    monkeypatch.setattr(command, "with_corrected_masks", corrected)
    monkeypatch.setattr(command, "_make", make)
    assert run_command("mesh", trained).code == EXIT_CANCELLED and seen == [False, True, True, True]


def test_objects_that_a_mesh_of_several_lacks_are_named():
    """Here the third one; those of few anchors and the background do not count."""
    rng = np.random.default_rng(0)
    ids = np.repeat([0, 1, 2, 3, 4], [20, 20, 20, 20, 3])
    anchors = SimpleNamespace(ids=torch.tensor(ids), positions=torch.tensor(4.0 * ids[:, None] + rng.random((83, 3))))
    model = SimpleNamespace(anchors=anchors, classes=ClassTable([0, 7, 8, 9, 12]))
    surface = Surface(np.array([[4.5, 4.5, 4.5], [8.0, 8.5, 8.9], [8.5, 12.5, 12.5]]), np.zeros((0, 3)), np.zeros(0))
    assert command._lacking(surface, model, np.arange(5)) == [9]
    assert command._lacking(surface, model, np.array([1, 2])) == command._lacking(surface, model, np.array([3])) == []


def test_meshes_that_are_made_anew_continue_after_a_stop(trained, run_command, monkeypatch):
    Stub(monkeypatch)
    assert run_command("mesh", trained).code == EXIT_DONE
    stopped = Stub(monkeypatch, stop_at=1)
    result = run_command("mesh", trained, "--restart")
    assert result.code == EXIT_CANCELLED and stopped.made == ["1"]
    assert "Run the same command again without --restart" in result.out
    rest = Stub(monkeypatch)
    assert run_command("mesh", trained).code == EXIT_DONE and rest.made == ["2", "5"]


def test_a_job_that_ends_before_its_first_mesh_leaves_all_of_them(trained, run_command, monkeypatch):
    Stub(monkeypatch, stop_at=0)
    assert run_command("mesh", trained, "--objects", "1", "5").code == EXIT_CANCELLED
    assert not entries(trained) and read_waiting(trained / "meshes") == ["1", "5"]
    Stub(monkeypatch)
    assert run_command("mesh", trained, "--objects", "1").code == EXIT_DONE
    assert not read_waiting(trained / "meshes"), "it is the latest job that counts"
    (trained / "meshes" / "meshes.json").write_text('{"waiting": 5, "meshes": {}}')
    assert not read_waiting(trained / "meshes")


def test_further_training_outdates_meshes(trained, kept, run_command, monkeypatch):
    made = Stub(monkeypatch).made
    assert run_command("mesh", trained, "--objects", "1").code == EXIT_DONE
    more = run_command("train", kept / "capture", "--out", trained, "--steps", 252, *TRAINING)
    assert more.code == EXIT_DONE
    assert run_command("mesh", trained, "--objects", "1").code == EXIT_DONE and made == ["1", "1"]
    assert entries(trained)["1"]["trained_steps"] == 252


def test_new_training_of_as_many_steps_outdates_meshes_and_evaluation(trained, kept, run_command, monkeypatch):
    made = Stub(monkeypatch).made
    assert run_command("mesh", trained, "--objects", "1").code == EXIT_DONE
    (trained / "evaluation.json").write_text("{}")
    anew = run_command("train", kept / "capture", "--out", trained, "--steps", 250, *TRAINING, "--restart")
    assert anew.code == EXIT_DONE and not (trained / "evaluation.json").exists()
    assert entries(trained)["1"]["trained_steps"] is None
    assert run_command("mesh", trained, "--objects", "1").code == EXIT_DONE and made == ["1", "1"]
    assert entries(trained)["1"]["trained_steps"] == 250


def test_object_without_surface_is_reported(trained, run_command, monkeypatch):
    Stub(monkeypatch, without={"2"})
    result = run_command("mesh", trained, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["without"] == 1
    assert result.messages("warning") == ["No view shows sphere 2."] == [entries(trained)["2"]["why"]]
    again = run_command("mesh", trained, "--json").messages("status")
    assert "2 of 3 meshes exist already" in again and "1 of 3 meshes cannot be made; --restart tries again" in again
    Stub(monkeypatch, without={"1", "2", "5"})
    assert_rejected(run_command("mesh", trained, "--restart", "--objects", "2"), "No view shows sphere 2.")
    result = run_command("mesh", trained, "--objects", "2", "--json")
    assert result.events[-1]["nothing_made"] is True
    assert not any("exist already" in message for message in result.messages("status"))


def test_missing_surface_removes_earlier_mesh(trained, run_command, monkeypatch):
    (trained / "meshes").mkdir()
    (trained / "meshes" / "1.ply").write_bytes(b"old")

    def fuse(*_, **__):
        raise NoSurface("No view shows sphere 1.")

    monkeypatch.setattr(command, "fuse", fuse)
    assert_rejected(run_command("mesh", trained, "--objects", "1"), "No view shows sphere 1.")
    assert not (trained / "meshes" / "1.ply").exists() and entries(trained)["1"]["why"] == "No view shows sphere 1."
