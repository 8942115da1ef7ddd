"""Division of a model into cells, training of a cell with everything else fixed, and merging."""

import json
import shutil
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch

from backend.commands.cells import folder as opening
from backend.commands.cells import split
from backend.commands.training import memory
from backend.model.checkpoint import CURRENT, load_checkpoint, save_checkpoint
from backend.raster import devices
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, InputError
from backend.shared.reconstruction.checkpoint import PREVIOUS
from backend.shared.reconstruction.lock import locked
from backend.training.cells.division import NO_CELL, Cell, Division, divide, read_division, write_division
from backend.training.cells.parts import (
    anchors_of,
    begin_cell,
    begin_seams,
    in_core,
    merged,
    near_seams,
    shown,
    trained_in,
    without_anchors,
)
from backend.training.cells.region import EVERYWHERE, Region, inside
from backend.training.cells.visibility import shares
from backend.training.settings import GROW_UNTIL, Settings
from backend.training.state import model_from_checkpoint, read_checkpoint, read_result
from backend.training.trainer import Trainer

from .command_result import assert_rejected

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("--offsets", 4)


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_cells_fill_space_with_equal_shares_and_overlap(count):
    positions = np.random.default_rng(0).normal(size=(4000, 3)) * [5, 3, 0.5]
    cells = divide(positions, count, 0.2)
    owners = np.array([inside(positions, cell.core) for cell in cells])
    assert (owners.sum(0) == 1).all(), "each anchor belongs to one cell"
    assert owners.sum(1) == pytest.approx(4000 / count, abs=3) and [c.anchors for c in cells] == owners.sum(1).tolist()
    for cell, own in zip(cells, owners, strict=True):
        wider = inside(positions, cell.bounds)
        assert (wider >= own).all() and 1.02 < wider.sum() / own.sum() < 1.7
        assert not np.isfinite([cell.core[0][2], cell.core[1][2]]).any(), "a flat scene is cut vertically"


def test_division_without_overlap_has_no_seams():
    positions = np.random.default_rng(0).normal(size=(500, 3))
    cells = divide(positions, 4, 0.0)
    assert not Division("", 0.0, tuple(cells)).on_seams(positions).any()


@pytest.mark.parametrize("share", [0.3, 0.7, 0.999])
def test_no_cell_is_empty_where_many_anchors_have_the_same_coordinates(share):
    positions = np.random.default_rng(0).random((1000, 3)) * [5, 1, 1]
    positions[: int(1000 * share), 0] = positions[:, 0].min()
    for count in (2, 3, 4):
        cells = divide(positions, count, 0.2)
        assert len(cells) == count and all(cell.anchors > 0 for cell in cells)
        assert sum(cell.anchors for cell in cells) == 1000
    with pytest.raises(InputError, match="fewer --cells"):
        divide(np.ones((50, 3)), 2, 0.2)


def test_division_survives_its_file(tmp_path):
    cells = tuple(divide(np.random.default_rng(0).normal(size=(500, 3)), 3, 0.2))
    division = Division("0f", 0.2, cells, ("a.png",))
    write_division(tmp_path / "cells.json", division)
    assert read_division(tmp_path / "cells.json") == division


@pytest.mark.parametrize(
    "stored", [{"fixed": -1, "bounds": [[None] * 3] * 2}, {"fixed": 0, "bounds": [[1] * 3, [0] * 3]}]
)
def test_damaged_regions_are_refused(stored):
    with pytest.raises(ValueError, match="not valid"):
        Region.of({"region": stored})


def coarse_of(capture, ids, tmp_path, steps=40, **settings):
    """Train a coarse model; returns the checkpoint and its trainer."""
    trainer = Trainer.start(capture, ids, Settings(offsets=4, **settings))
    for step in range(steps):
        trainer.step(step / steps)
    trainer.save(tmp_path / "coarse")
    return read_result(tmp_path / "coarse")[:2], trainer


def needed_by(coarse, division, number, cell_of, cameras):
    """Return the coarse model with the anchors that a cell needs, and the cells of those."""
    tensors, state = coarse
    every = model_from_checkpoint(tensors, state).anchors
    kept = trained_in(division, number, tensors["anchors.positions"], cell_of) | shown(every, cameras)
    of_cell = {name: value[kept] for name, value in tensors.items() if name.startswith("anchors.")}
    return ({**tensors, **of_cell}, state), cell_of[kept]


def in_two(coarse):
    """Divide a coarse model into two cells; returns the division and the cells of its anchors."""
    positions = coarse[0]["anchors.positions"]
    division = Division("", 0.2, tuple(divide(positions.astype(float), 2, 0.2)))
    return division, division.cells_of(positions)


@pytest.mark.parametrize("mode", ["explicit", "view"])
def test_cell_changes_its_own_anchors_only(tiny, tmp_path, mode, monkeypatch):
    capture, ids = tiny()
    coarse, whole = coarse_of(capture, ids, tmp_path, mode=mode, fit_colors=True)
    division, cell_of = in_two(coarse)
    cameras = [whole.scene.camera(i) for i in capture.train_indices]
    needed, of_needed = needed_by(coarse, division, 1, cell_of, cameras)
    tensors, state = begin_cell(needed, division, 1, of_needed)
    before = {name: value.copy() for name, value in tensors.items()}
    trainer = Trainer.restore(capture, tensors, state, 500, devices.CPU, whole.scene.gains)
    fixed = trainer.region.fixed
    assert 0 < fixed < len(trainer.model.anchors)
    for step in range(100):
        trainer.step(0.1 + 0.5 * step / 100)
    anchors = trainer.model.anchors
    assert len(anchors) != len(before["anchors.ids"]), "anchors grow"
    assert np.array_equal(anchors.rows[:fixed].numpy(), before["anchors.rows"][:fixed])
    assert not np.isclose(anchors.rows[fixed:][:50].numpy(), before["anchors.rows"][fixed:][:50]).all()
    assert inside(anchors.positions[fixed:].numpy(), division.cells[1].bounds).all()
    for name, value in trainer.model.heads.state_dict().items():
        assert np.array_equal(value.numpy(), before[f"heads.{name}"]), name
    assert np.array_equal(trainer.model.background.detach().numpy(), before["background"])
    assert np.array_equal(trainer.view_step.colors.values.numpy(), before["colors.values"])
    trainer.save(tmp_path / "cell")
    again, warning = Trainer.resume(capture, tmp_path / "cell")
    assert warning is None and again.region == trainer.region
    assert torch.equal(again.shown.anchors.rows, trainer.shown.anchors.rows)
    every = read_result(tmp_path / "cell")[0]
    assert np.array_equal(every["anchors.rows"], again.shown.anchors.rows.numpy())
    kept = np.arange(len(every["anchors.ids"])) % 3 == 0
    monkeypatch.setattr("backend.training.state._BLOCK", 30)
    some = read_result(tmp_path / "cell", lambda block: kept[[where(every, position) for position in block.positions]])[
        0
    ]
    for name, value in every.items():
        assert np.array_equal(some[name], value[kept] if name.startswith("anchors.") else value), name
    own = read_result(tmp_path / "cell", fixed=False)[0]
    for name, value in every.items():
        assert np.array_equal(own[name], value[fixed:] if name.startswith("anchors.") else value), name
    for with_fixed in (True, False):
        none = read_result(tmp_path / "cell", lambda block: np.zeros(len(block), bool), with_fixed)[0]
        assert none["anchors.rows"].shape == (0, every["anchors.rows"].shape[1])
    assert float(again.step(0.5)) == float(trainer.step(0.5)), "it goes on exactly as it would have"


def where(tensors, position):
    """Return the index of the anchor at a position."""
    return np.flatnonzero((tensors["anchors.positions"] == position.numpy()).all(1))[0]


def test_cell_learns_as_much_as_the_whole_model_where_it_is(tiny, tmp_path):
    """A cell of almost everything has nearly the losses of a training of everything, from the same start."""
    capture, ids = tiny()
    # By then the heads, which a cell does not train, have learned what they can.
    coarse, whole = coarse_of(capture, ids, tmp_path, steps=300)
    positions = coarse[0]["anchors.positions"]
    low = float(np.sort(positions[:, 0])[3])
    bounds = ((low, -np.inf, -np.inf), EVERYWHERE[1])
    division = Division("", 0.0, (Cell(bounds, bounds, len(positions) - 3),))
    cameras = [whole.scene.camera(i) for i in range(9)]
    needed, cell_of = needed_by(coarse, division, 0, division.cells_of(positions), cameras)
    part = begin_cell(needed, division, 0, cell_of)
    trainer = Trainer.restore(capture, *part, 500, devices.CPU, whole.scene.gains)
    assert 0 < trainer.region.fixed <= 3
    losses = [np.mean([float(t.step(0.5)) for _ in range(60)][-20:]) for t in (trainer, whole)]
    assert losses[0] < 1.15 * losses[1]


def test_parts_that_are_not_trained_merge_to_the_coarse_model(tiny, tmp_path):
    capture, ids = tiny()
    coarse, whole = coarse_of(capture, ids, tmp_path)
    division, cell_of = in_two(coarse)
    cell_of[:5] = NO_CELL
    cameras = [whole.scene.camera(i) for i in capture.train_indices]
    expected = anchors_of(coarse)
    assert np.array_equal(expected["rows"], whole.shown.anchors.rows.numpy())
    assert not {name for name in coarse[0] if name.startswith(("adam.", "growth.", "mean."))}
    cells = []
    for number in range(2):
        needed, of_needed = needed_by(coarse, division, number, cell_of, cameras)
        cells.append(begin_cell(needed, division, number, of_needed))
        save_checkpoint(tmp_path / str(number), *cells[-1])
    of_none = {name: value[cell_of == NO_CELL] for name, value in expected.items()}
    coarse = without_anchors(coarse)
    assert not {name for name in coarse[0] if name.startswith("anchors.")}

    def read(keep):
        found = [read_result(tmp_path / str(number), keep(number), fixed=False)[:2] for number in range(2)]
        return [anchors_of(checkpoint) for checkpoint in found]

    count, cores = len(expected["ids"]), read(lambda number: in_core(division, number))
    assert [len(core["ids"]) for core in cores] == [int((cell_of == number).sum()) for number in range(2)]
    for chosen_for in ([], cameras):
        near = near_seams(division, chosen_for)
        chosen = read(lambda number, near=near: lambda block: in_core(division, number)(block) & near(block))
        seams = begin_seams(coarse, division, of_none, chosen, count, chosen_for)
        on_seams = len(seams[0]["anchors.ids"]) - Region.of(seams[1]).fixed
        assert 0 < on_seams < count / 2
        assert len(seams[0]["anchors.ids"]) == (count if chosen_for else on_seams), "others are not even read"
    save_checkpoint(tmp_path / "seams", *seams)
    seams = read_result(tmp_path / "seams", fixed=False)[:2]
    assert len(seams[0]["anchors.ids"]) == on_seams
    tensors, state = merged(coarse, division, of_none, cores, count, seams, whole.progress, "0f")
    order, wanted = (np.lexsort(found.T) for found in (tensors["anchors.positions"], expected["positions"]))
    for name, values in expected.items():
        assert np.array_equal(tensors[f"anchors.{name}"][order], values[wanted]), name
    save_checkpoint(tmp_path / "merged", tensors, state)
    first = read_result(tmp_path / "merged", lambda block: np.arange(len(block)) < 3)[0]
    assert np.array_equal(first["anchors.rows"], tensors["anchors.rows"][:3]), "there is no mean"
    again = Trainer.resume(capture, tmp_path / "merged")[0]
    assert again.region.is_whole and np.isfinite(float(again.step(GROW_UNTIL)))


def test_shares_of_views_tell_which_cell_they_show(tiny, tmp_path):
    capture, ids = tiny()
    coarse, whole = coarse_of(capture, ids, tmp_path, steps=80)
    division, cell_of = in_two(coarse)
    model, scene = whole.shown, whole.scene
    found = np.array(list(shares(model, division, cell_of, map(scene.camera, capture.train_indices))))
    assert found.shape == (len(capture.train_indices), 3) and (found >= 0).all()
    assert (found[:, :2].sum(1) < 1.001).all() and (found[:, 2] <= found[:, :2].sum(1) + 1e-9).all()
    for number in range(2):
        kept = cell_of == number
        alone = [int(inside(scene.camera(i).center[None], division.cells[number].core).sum()) for i in range(9)]
        assert kept.any() and found[:, number].max() > 0.05, alone


def test_checkpoints_are_valid_safetensors(tmp_path):
    rng = np.random.default_rng(0)
    tensors = {
        "a": rng.normal(size=(5, 3)).astype(np.float32), "ids": np.arange(7), "none": np.zeros((0, 4), np.float32),
        "view": rng.normal(size=(6, 4)).astype(np.float32)[::2, ::2], "n": np.arange(3, dtype=np.int32),
        "scalar": np.float32(2).reshape(()),
    }  # fmt: skip
    save_checkpoint(tmp_path, tensors, {"x": 1})
    read = safetensors.numpy.load_file(tmp_path / CURRENT)
    assert read.keys() == tensors.keys() and read["scalar"].shape == (1,)
    for name, values in tensors.items():
        assert np.array_equal(read[name].reshape(values.shape), values) and read[name].dtype == values.dtype, name


@pytest.fixture(scope="module")
def divided_once(tmp_path_factory):
    """A capture, and its trained reconstruction in two cells."""
    from .conftest import write_scene

    folder = tmp_path_factory.mktemp("cells")
    scene = write_scene(folder / "capture", views=9, size=(64, 48))
    for words in (
        ("train", scene.folder, "--out", folder / "out", "--steps", 60, *SMALL),
        ("split", folder / "out", "--cells", 2),
    ):
        subprocess.run(command(*words), cwd=ROOT, check=True, capture_output=True, timeout=240)
    return scene.folder, folder / "out"


def command(*words):
    return [sys.executable, "-m", "backend", *map(str, words), "--threads", "1"]


@pytest.fixture
def divided(divided_once, tmp_path):
    """Folder of a reconstruction in two cells, which a test may change."""
    shutil.copytree(divided_once[1], tmp_path / "out")
    return tmp_path / "out"


def test_cells_are_trained_and_merged_by_commands(divided, run_command):
    before = load_checkpoint(divided / "checkpoint")
    assert_rejected(run_command("merge", divided), "Cell 0", "train-cell")
    assert_rejected(run_command("train-cell", divided, "--cell", 2), "no cell 2")
    assert_rejected(run_command("split", divided, "--cells", 3), "2 cells", "--restart")
    again = run_command("split", divided, "--cells", 2)
    assert again.code == EXIT_DONE and "already divided" in again.out
    for number in range(2):
        result = run_command("train-cell", divided, "--cell", number, "--steps", 30, "--json")
        assert result.code == EXIT_DONE and result.events[-1]["steps"] == 30
    again = run_command("train-cell", divided, "--cell", 1, "--steps", 30)
    assert again.code == EXIT_DONE and "already trained" in again.out
    result = run_command("merge", divided, "--steps", 10, "--json")
    assert result.code == EXIT_DONE, result
    assert result.events[-1]["steps"] == 60 + 2 * 30 + 10
    tensors, state, warning = load_checkpoint(divided / "checkpoint")
    assert warning is None and "region" not in state and state["progress"]["step"] == 130
    division = read_division(divided / "cells" / "cells.json")
    positions = tensors["anchors.positions"]
    for number, cell in enumerate(division.cells):
        own = read_result(divided / "cells" / str(number) / "checkpoint")[:2]
        mine, fixed = anchors_of(own), Region.of(own[1]).fixed
        inner = inside(mine["positions"], cell.core) & ~division.on_seams(mine["positions"])
        inner[:fixed] = False
        rows = {tuple(p): row for p, row in zip(mine["positions"][inner].tolist(), mine["rows"][inner], strict=True)}
        found = [p for p in range(len(positions)) if tuple(positions[p].tolist()) in rows]
        assert len(found) == len(rows) > 0
        assert all(np.array_equal(tensors["anchors.rows"][p], rows[tuple(positions[p].tolist())]) for p in found)
    for name, value in before[0].items():
        if name.startswith("mean.heads."):
            assert np.array_equal(tensors[name.removeprefix("mean.")], value), "all parts share the heads"
    assert run_command("evaluate", divided).code == EXIT_DONE
    assert json.loads((divided / "objectgs.json").read_text())["training"]["steps"] == 130


def test_cells_of_a_former_model_or_division_do_not_count(divided, divided_once, run_command):
    for number in range(2):
        assert run_command("train-cell", divided, "--cell", number, "--steps", 6).code == EXIT_DONE
    trained = run_command("train", divided_once[0], "--out", divided, "--steps", 70, *SMALL)
    assert trained.code == EXIT_DONE
    before = (divided / "checkpoint" / CURRENT).read_bytes()
    for words in (("merge", divided), ("split", divided, "--cells", 2)):
        assert_rejected(run_command(*words), "was changed", "split --restart")
    assert (divided / "checkpoint" / CURRENT).read_bytes() == before
    part = json.loads((divided / "cells" / "0" / "part.json").read_text())
    (divided / "cells" / "0" / "part.json").write_text(json.dumps({**part, "made_of": ["another"]}))
    result = run_command("train-cell", divided, "--cell", 0, "--steps", 4, "--json")
    assert result.events[-1]["steps"] == 4, "it begins anew"


def test_cells_without_overlap_merge_and_merge_again(divided, run_command):
    assert run_command("split", divided, "--cells", 2, "--overlap", 0, "--restart").code == EXIT_DONE
    for number in range(2):
        assert run_command("train-cell", divided, "--cell", number, "--steps", 6).code == EXIT_DONE
    for _ in range(2):
        assert run_command("merge", divided).code == EXIT_DONE
        assert load_checkpoint(divided / "checkpoint")[1]["progress"]["step"] == 60 + 12


def test_stopped_cell_and_merge_go_on(divided, run_command, monkeypatch):
    def stop_at(step):
        original = Trainer.step

        def wrapper(self, progress):
            if self.progress.step == step:
                signal.raise_signal(signal.SIGINT)
            return original(self, progress)

        monkeypatch.setattr(Trainer, "step", wrapper)

    train = ("train-cell", divided, "--cell", 0, "--steps", 24)
    stop_at(9)
    assert run_command(*train).code == EXIT_CANCELLED
    monkeypatch.undo()
    assert load_checkpoint(divided / "cells" / "0" / "checkpoint")[1]["progress"]["step"] == 10
    assert_rejected(run_command("merge", divided), "Cell 0")
    assert run_command(*train).code == EXIT_DONE
    assert run_command("train-cell", divided, "--cell", 1, "--steps", 24).code == EXIT_DONE
    stop_at(4)
    before = (divided / "checkpoint" / CURRENT).read_bytes()
    assert run_command("merge", divided, "--steps", 12).code == EXIT_CANCELLED
    assert (divided / "checkpoint" / CURRENT).read_bytes() == before
    monkeypatch.undo()
    result = run_command("merge", divided, "--steps", 12)
    assert result.code == EXIT_DONE and load_checkpoint(divided / "checkpoint")[1]["progress"]["step"] == 60 + 48 + 12
    for broken in ("part.json", f"checkpoint/{CURRENT}"):
        (divided / "cells" / "seams" / broken).write_text("{")
        result = run_command("merge", divided, "--steps", 12)
        assert result.code == EXIT_DONE and "begins anew" in result.err


def test_damaged_files_of_cells_are_named(divided, run_command):
    division = divided / "cells" / "cells.json"
    text = division.read_text()
    stored = json.loads(text)
    first = stored["cells"][0]
    low, high = (
        [-9.0 if x is None else x for x in first["core"][0]],
        [9.0 if x is None else x for x in first["core"][1]],
    )
    cells = (
        [], [{"core": 3}], [{**first, "core": [low, low]}], [{**first, "core": [high, low]}],
        [{**first, "bounds": [low, low]}],
    )  # fmt: skip
    division.write_text("{")
    assert_rejected(run_command("train-cell", divided, "--cell", 0), "cells.json")
    for broken in ("[]", *(json.dumps({**stored, "cells": each}) for each in cells)):
        division.write_text(broken)
        assert_rejected(run_command("train-cell", divided, "--cell", 0), "cells.json", "split --restart")
    division.write_text(json.dumps({**stored, "checkpoint": "00"}))
    assert_rejected(run_command("train-cell", divided, "--cell", 0), "split --restart")
    division.write_text(text)
    (divided / "cells" / "0").mkdir()
    (divided / "cells" / "0" / "part.json").write_text('{"made_of": 3}')
    assert_rejected(run_command("merge", divided), "part.json", "train-cell", "--restart")
    assert run_command("train-cell", divided, "--cell", 0, "--steps", 3, "--restart").code == EXIT_DONE
    assert run_command("train-cell", divided, "--cell", 1, "--steps", 3).code == EXIT_DONE
    folder = divided / "cells" / "0" / "checkpoint"
    shutil.copyfile(folder / CURRENT, folder / PREVIOUS)
    (folder / CURRENT).unlink()
    assert_rejected(run_command("merge", divided), "missing")
    (folder / CURRENT).write_bytes(b"damaged")
    assert_rejected(run_command("merge", divided), "run `train-cell` for this cell again")
    assert run_command("train-cell", divided, "--cell", 0, "--steps", 3).code == EXIT_DONE
    assert run_command("merge", divided).code == EXIT_DONE, "what the message says has helped"
    shutil.rmtree(divided / "cells" / "seams")
    part = divided / "cells" / "1" / "part.json"
    part.write_text(json.dumps({**json.loads(part.read_text()), "anchors": 1}))
    assert_rejected(run_command("merge", divided), "instead of 1", "run `train-cell`")
    assert not list((divided / "cells" / "seams").rglob(CURRENT)), "it is noticed before anything is trained"
    assert run_command("train-cell", divided, "--cell", 1, "--steps", 3).code == EXIT_DONE
    assert run_command("merge", divided).code == EXIT_DONE, "what the message says has helped"


def test_damaged_model_is_not_divided(divided, run_command):
    shutil.copyfile(divided / "checkpoint" / CURRENT, divided / "checkpoint" / PREVIOUS)
    (divided / "checkpoint" / CURRENT).write_bytes(b"damaged")
    assert_rejected(run_command("split", divided, "--cells", 2, "--restart"), CURRENT, "train")
    assert (divided / "cells" / "cells.json").exists()


def test_folders_in_use_are_neither_read_nor_deleted(divided, run_command, monkeypatch):
    for number in range(2):
        assert run_command("train-cell", divided, "--cell", number, "--steps", 3).code == EXIT_DONE
    commands = (("merge", divided), ("split", divided, "--cells", 2, "--restart"))
    with locked(divided / "cells" / "1"):
        for words in commands:
            assert_rejected(run_command(*words), "Cell 1", "in use")
    assert (divided / "cells" / "1" / "part.json").exists()
    original = opening.open_trained

    def divide_meanwhile(*arguments):
        path = divided / "cells" / "cells.json"
        path.write_text(path.read_text() + "\n")
        return original(*arguments)

    monkeypatch.setattr(opening, "open_trained", divide_meanwhile)
    assert_rejected(run_command("train-cell", divided, "--cell", 0, "--steps", 6), "divided anew")
    for module in (opening, split):
        monkeypatch.setattr(module, "open_trained", None)
    with locked(divided):
        for words in commands:
            assert_rejected(run_command(*words), "in use")


def test_cell_keeps_to_its_folder_and_to_what_it_needs(divided, divided_once, tmp_path, run_command, monkeypatch):
    shutil.move(shutil.copytree(divided_once[0], tmp_path / "copy"), tmp_path / "moved")
    coarse, kept, anchors = [], [], len(load_checkpoint(divided / "checkpoint")[0]["anchors.ids"])

    def watch(name):
        original = getattr(opening, name)

        def wrapper(*arguments, **named):
            found = original(*arguments, **named)
            if name == "open_trained":
                assert len(found.model.anchors) == 0
            elif arguments[0].name == "coarse":
                kept.append(len(found[0]["anchors.ids"]))
                of_anchors = (value for key, value in found[0].items() if key.startswith("anchors."))
                coarse.extend(weakref.ref(value if value.base is None else value.base) for value in of_anchors)
            return found

        monkeypatch.setattr(opening, name, wrapper)

    def restore(cls, *arguments, original=Trainer.restore.__func__):
        assert not [reference for reference in coarse if reference() is not None]
        coarse.clear()
        return original(cls, *arguments)

    watch("open_trained")
    watch("read_part")
    whole = Trainer.restore
    monkeypatch.setattr(Trainer, "restore", classmethod(restore))
    monkeypatch.setattr(memory, "free_memory", lambda: 1e6)
    before = contents_of(divided)
    train = ("train-cell", divided, "--cell", 0, "--steps", 3, "--capture", tmp_path / "moved")
    result = run_command(*train, "--max-anchors", 4321, "--json")
    assert result.code == EXIT_DONE and any("4,321 anchors" in message for message in result.messages("warning"))
    assert {name: value for name, value in contents_of(divided).items() if not name.startswith("cells/0")} == before
    state = read_checkpoint(divided / "cells" / "0" / "checkpoint")[1]
    assert state["settings"]["max_anchors"] == 4321
    assert_rejected(run_command(*train, "--max-anchors", 5), "4321", "--restart")
    coarse.clear()
    assert run_command("train-cell", divided, "--cell", 1, "--steps", 3).code == EXIT_DONE and not coarse
    monkeypatch.setattr(Trainer, "restore", whole)
    result = run_command("merge", divided, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["anchors"] > 100
    assert kept[-1] < 0.1 * anchors < kept[0] <= anchors, "merging needs only the anchors that belong to no cell"


def contents_of(place):
    """Return the contents of all files in a folder by their names."""
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in place.rglob("*") if path.is_file()}


@pytest.mark.long
def test_killed_cell_and_merge_give_the_same_model(divided_once, tmp_path):
    """Both are killed between two checkpoints, and the same commands go on to the same result."""
    folders = []
    for name in ("whole", "killed"):
        folders.append(tmp_path / name)
        shutil.copytree(divided_once[1], folders[-1])
    killed = folders[1]

    def kill(part, *words):
        process = subprocess.Popen(command(*words), cwd=ROOT, stdout=subprocess.DEVNULL)
        current = killed / "cells" / part / "checkpoint" / CURRENT
        deadline = time.monotonic() + 120
        while not current.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert current.exists()

    cell = ("--cell", 0, "--steps", 150)
    kill("0", "train-cell", killed, *cell, "--checkpoint-seconds", 0.1)
    for folder in folders:
        for words in (("train-cell", folder, *cell), ("train-cell", folder, "--cell", 1, "--steps", 40)):
            subprocess.run(command(*words), cwd=ROOT, check=True, capture_output=True, timeout=240)
    kill("seams", "merge", killed, "--steps", 40)
    for folder in folders:
        subprocess.run(command("merge", folder, "--steps", 40), cwd=ROOT, check=True, capture_output=True, timeout=240)
    found = [load_checkpoint(folder / "checkpoint")[0] for folder in folders]
    assert found[0].keys() == found[1].keys()
    assert all(np.array_equal(found[0][name], found[1][name]) for name in found[0])
