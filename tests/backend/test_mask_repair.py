"""Repair of masks by all photos together, and the command that gives splats their objects anew."""

import json
import weakref

import numpy as np
import pytest
from PIL import Image

from backend.capture import load_capture
from backend.commands.objects import clean_labels
from backend.export import read_splats
from backend.labels import vote
from backend.model.draw import draw
from backend.pointing.mask_repair import contradicted, repair_masks
from backend.shared.errors import EXIT_DONE
from backend.shared.events import Reporter
from backend.shared.stopping import StoppingReporter, StopRequest
from backend.training.scene import Scene
from backend.training.state import load_model

from .command_result import assert_rejected

EXCHANGED = {1: 2, 2: 5, 5: 1}
STEPS = 150


def test_regions_that_show_something_else_are_contradicted() -> None:
    mask, shown = np.zeros((40, 60), np.int64), np.zeros((40, 60), np.int64)
    mask[5:20, 5:20], shown[5:20, 5:20] = 3, 4
    mask[5:20, 30:45], shown[5:20, 32:45] = 3, 3
    mask[39, 59] = 7
    assert np.array_equal(contradicted(mask, shown), mask[:, :] * (np.arange(60) < 25) == 3)


@pytest.fixture
def trained(write_capture, tmp_path, run_command):
    """A capture of three spheres of which seven photos have exchanged IDs and one has no mask; and its training.

    Two of them are held out.
    """
    scene = write_capture(views=18, size=(96, 72))
    for view in (0, 1, 4, 7, 8, 11, 14):
        ids = scene.ids[view]
        wrong = sum((np.where(ids == old, new, 0) for old, new in EXCHANGED.items()), np.zeros_like(ids))
        Image.fromarray(wrong.astype(np.uint16)).save(scene.folder / "masks" / f"{scene.names[view][:-4]}.png")
    (scene.folder / "masks" / f"{scene.names[10][:-4]}.png").unlink()
    out = tmp_path / "out"
    assert run_command("train", scene.folder, "--out", out, "--steps", STEPS, "--offsets", 4).code == EXIT_DONE
    return scene, out


def fraction_right(scene, found_of) -> float:
    """Return the fraction of the pixels of all views in which the found IDs are the true ones."""
    return float(np.mean([found_of(index) == ids for index, ids in enumerate(scene.ids)]))


def rendered(scene, out) -> float:
    """Return the fraction of the objects' pixels in all views whose rendered IDs are the true ones."""
    capture = load_capture(scene.folder, out / "cache")
    model, _, _ = load_model(out / "checkpoint")
    cameras = Scene(capture, model.classes, model.normalization)
    found = [(draw(model, cameras.camera(index)).ids == ids)[ids > 0] for index, ids in enumerate(scene.ids)]
    return float(np.concatenate(found).mean())


def mask_of(capture, index):
    mask = capture.mask(index)
    return np.zeros((72, 96), np.int64) if mask is None else mask


@pytest.mark.parametrize("longest", [1000, 50])
def test_wrong_masks_and_labels_are_corrected(trained, tmp_path, run_command, monkeypatch, longest) -> None:
    """Larger images vote in a reduced size. What compares the splats does not take memory from the training."""
    in_use = []

    def repair(pointer, *arguments):
        in_use.append(weakref.ref(pointer))
        return repair_masks(pointer, *arguments)

    def train(*arguments):
        in_use.append(in_use[0]())
        train_borders(*arguments)

    train_borders = clean_labels.train_borders
    monkeypatch.setattr(clean_labels, "repair_masks", repair)
    monkeypatch.setattr(clean_labels, "train_borders", train)
    monkeypatch.setattr("backend.pointing.splat_graph.LONGEST", longest)
    scene, out = trained
    before = rendered(scene, out)
    given = load_capture(scene.folder, tmp_path / "given")
    masks_before = fraction_right(scene, lambda index: mask_of(given, index))
    result = run_command("clean-labels", out, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["steps"] == STEPS * 6 // 5
    assert in_use[1:] == [None]
    again = load_capture(scene.folder, tmp_path / "again")
    masks_after = fraction_right(scene, lambda index: mask_of(again, index))
    assert masks_before < 0.96 and masks_after > 0.98
    assert rendered(scene, out) > max(before, 0.96)
    assert min((mask_of(again, index) == scene.ids[index]).mean() for index in again.test_indices) > 0.95
    record = json.loads((scene.folder / "masks" / "repair.json").read_text())
    assert record["changed"][scene.names[10]] == 1.0
    # What was right is kept as it was, but for a few pixels at most.
    assert max(record["changed"][scene.names[view]] for view in (2, 3, 5, 6)) < 0.01
    kept = sorted(path.name for path in (scene.folder / "masks-given").iterdir())
    assert len(kept) == 17 and (scene.folder / "labels.json").exists()
    # Once more, the masks as they were given are still kept.
    assert run_command("clean-labels", out).code == EXIT_DONE
    assert sorted(path.name for path in (scene.folder / "masks-given").iterdir()) == kept


def test_record_tells_whether_ids_are_those_of_the_given_masks(write_capture, tmp_path) -> None:
    scene, reporter = write_capture(views=6), StoppingReporter(Reporter(), StopRequest())
    for keeps_ids, expected in ((True, True), (True, True), (False, False), (True, False)):
        capture = load_capture(scene.folder, tmp_path / "cache")
        clean_labels._write(capture, {}, {"changed": {}, "moved": []}, keeps_ids, reporter)
        assert json.loads((scene.folder / "masks" / "repair.json").read_text())["same_ids"] is expected


def test_masks_made_after_the_training_give_splats_their_objects(write_capture, tmp_path, run_command) -> None:
    scene = write_capture(views=18, size=(96, 72))
    out, later = tmp_path / "out", tmp_path / "later"
    (scene.folder / "masks").rename(later)
    (scene.folder / "labels.json").unlink()
    training = ("train", scene.folder, "--out", out, "--steps", 2 * STEPS, "--offsets", 4, "--seed", 1)
    assert run_command(*training).code == EXIT_DONE
    assert_rejected(run_command("clean-labels", out), "has no masks")
    masks = later.rename(scene.folder / "masks")
    # As the command that made them of others has written it.
    (masks / "masks.json").write_text('{"source": "other", "objects": [{"id": 1, "name": "ball"}], "largest_id": 9}')
    given = {path.name: path.read_bytes() for path in masks.iterdir()}
    assert run_command("clean-labels", out).code == EXIT_DONE
    assert rendered(scene, out) > 0.95
    made = {path.name: path.read_bytes() for path in masks.iterdir()}
    held_out = [scene.names[index] for index in load_capture(scene.folder, tmp_path / "cache").test_indices]
    for name in ("masks.json", *(f"{name[:-4]}.png" for name in held_out)):
        assert made[name] == given[name], "they are kept as they are"
    for name in ("masks.json", "repair.json"):
        (masks / name).unlink()
    assert_rejected(run_command("clean-labels", out), "masks-given", "move it elsewhere")
    assert {path.name for path in masks.iterdir()} == made.keys() - {"masks.json", "repair.json"}


def test_splats_of_another_program_get_objects_by_later_masks(write_capture, tmp_path, run_command) -> None:
    """Only their objects change; there is nothing to train."""
    scene = write_capture(views=18, size=(96, 72))
    out, imported, later = tmp_path / "out", tmp_path / "imported", tmp_path / "later"
    (scene.folder / "masks").rename(later)
    assert run_command("train", scene.folder, "--out", out, "--steps", 2 * STEPS, "--offsets", 4).code == EXIT_DONE
    before = read_splats(out / "splats.ply")[0]
    options = ("--out", imported, "--capture", scene.folder)
    assert run_command("import-splats", out / "splats.ply", *options).code == EXIT_DONE
    later.rename(scene.folder / "masks")
    result = run_command("clean-labels", imported, "--json")
    assert result.code == EXIT_DONE and "steps" not in result.events[-1]
    after = read_splats(imported / "splats.ply")[0]
    assert np.array_equal(after.means, before.means) and np.array_equal(after.opacities, before.opacities)
    voted = vote(load_capture(scene.folder, tmp_path / "cache"), positions=after.means).ids
    assert (after.object_ids == voted)[voted > 0].mean() > 0.8
    assert {1, 2, 5} <= set(after.object_ids.tolist()) and (imported / "objects.json").exists()
    assert not (imported / "checkpoint").exists()
    alone = tmp_path / "alone"
    assert run_command("import-splats", out / "splats.ply", "--out", alone).code == EXIT_DONE
    assert_rejected(run_command("clean-labels", alone), "has no capture with masks", "import the splats again")


@pytest.mark.parametrize("words", [(), ("--max-size", 48)])
def test_masks_of_distorted_and_reduced_photos_that_do_not_change_are_kept(
    write_capture, tmp_path, run_command, words
) -> None:
    scene = write_capture(views=18, size=(96, 72), model="OPENCV", params=[90, 90, 48, 36, -0.2, 0.05, 0, 0])
    out, given = tmp_path / "out", scene.folder / "masks"
    before = {path.name: path.read_bytes() for path in given.iterdir()}
    train = ("train", scene.folder, "--out", out, "--steps", 20, "--offsets", 4, *words)
    assert run_command(*train).code == EXIT_DONE
    assert run_command("clean-labels", out).code == EXIT_DONE
    for index in load_capture(scene.folder, tmp_path / "cache").test_indices:
        name = f"{scene.names[index][:-4]}.png"
        assert (given / name).read_bytes() == before[name]


def test_captures_without_masks_are_refused(write_capture, tmp_path, run_command) -> None:
    scene = write_capture(views=9, size=(64, 48), masks=False)
    out = tmp_path / "out"
    assert run_command("train", scene.folder, "--out", out, "--steps", 20, "--offsets", 2).code == EXIT_DONE
    assert_rejected(run_command("clean-labels", out), "has no masks", "import masks, or mark objects")
    assert not (scene.folder / "masks").exists()
