"""The export of large models: the memory that it takes, and files that do not depend on the size of its blocks."""

from __future__ import annotations

import tracemalloc
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from backend.commands.exported import export_model
from backend.commands.training import train
from backend.export import ExactSplats, FittedSplats, fit
from backend.model.anchors import Anchors, Layout, seed_anchors
from backend.model.heads import Heads
from backend.model.object_model import Normalization, ObjectModel
from backend.raster import Camera
from backend.shared.class_table import ClassTable
from backend.shared.errors import EXIT_DONE
from backend.shared.events import Reporter
from backend.shared.formats.anchors_ply import read_anchor_table
from backend.shared.formats.ply import read_vertices
from backend.shared.reconstruction.folder import Reconstruction
from backend.training.optimizer.model_optimizer import ModelOptimizer

BLOCK = "backend.model.splats.ROWS_AT_ONCE"
OF_FIT = ("backend.export.fit._ANCHORS_AT_ONCE", "backend.export.fit._SPLATS_AT_ONCE")


def model_of(count: int, mode: str = "explicit", primitive: str = "3d", center: float = 0.0) -> ObjectModel:
    """A model with `count` anchors of three objects and of none, whose world's origin is `center` away."""
    rng, generator, layout = np.random.default_rng(0), torch.Generator().manual_seed(0), Layout()
    xyz, classes = rng.uniform(-1, 1, (count, 3)), rng.integers(0, 4, count)
    anchors = seed_anchors(xyz, rng.uniform(0, 1, (count, 3)), classes, 1e-4, layout, rng)
    anchors.rows += torch.randn(anchors.rows.shape, generator=generator) * 0.2
    heads = Heads(layout, mode, 1, generator).requires_grad_(False)
    return ObjectModel(
        anchors, heads, torch.tensor([0.2, 0.4, 0.6]), ClassTable(np.array([0, 2, 7, 2**32 - 1])),
        Normalization((center, 0.0, 0.0), 0.3), primitive,
    )  # fmt: skip


def export(model: ObjectModel, out: Path, focal: float = 64.0) -> Reconstruction:
    """Export a model that four cameras see, those with a large focal length only a small part of it."""

    def camera(index: int) -> Camera:
        c, s = np.cos(np.pi / 2 * index), np.sin(np.pi / 2 * index)
        viewmat = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 3], [0, 0, 0, 1]])
        return Camera(viewmat, np.array([[focal, 0, 32], [0, focal, 24], [0, 0, 1]]), 64, 48)

    capture = SimpleNamespace(test_indices=[0, 2], train_indices=[1, 3])
    out.mkdir()
    export_model(model, SimpleNamespace(capture=capture, camera=camera), Reconstruction(out), Reporter())
    return Reconstruction(out)


@pytest.mark.parametrize(("focal", "most"), [(2000.0, 20), (64.0, 260)], ids=["few in view", "all in view"])
def test_export_takes_little_memory(tmp_path, monkeypatch, focal, most):
    monkeypatch.setattr(BLOCK, 1 << 11)
    model = model_of(20_000)
    export(model_of(100), tmp_path / "small")  # loads the kernels
    tracemalloc.start()
    folder = export(model, tmp_path / "large", focal)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # All splats would take 133 bytes each; only those in view are compared with the model.
    assert peak < most * len(read_vertices(folder.splats))


def test_fit_renders_only_views_that_see_the_part(monkeypatch):
    model = model_of(100, "view")
    model.anchors.positions[50:] -= torch.tensor([0.0, 0.0, 100.0])
    monkeypatch.setattr(OF_FIT[0], 50)
    rendered, rasterize = [], fit.rasterize
    monkeypatch.setattr(fit, "rasterize", lambda *args, **named: rendered.append(args[6]) or rasterize(*args, **named))
    K = np.array([[64.0, 0, 32], [0, 64.0, 24], [0, 0, 1]])
    forward, backward = np.diag([1.0, 1, 1, 1]), np.diag([-1.0, 1, -1, 1])
    forward[2, 3], backward[2, 3] = 3, -97
    cameras = [Camera(viewmat, K, 64, 48) for viewmat in (forward, backward)]
    _, source = fit.fit_splats(model, cameras)
    assert [camera is cameras[1] for camera in rendered] == [False, True]
    assert source.min() < 500 <= source.max()


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_parts_are_all_splats(monkeypatch, primitive):
    model = model_of(300, "explicit", primitive)
    model.anchors.rows[[7, 200], model.anchors.layout.shape_columns] = torch.nan
    splats, source = model.splats()
    chosen = torch.tensor([2, 7, 150, 299])
    expected = np.isin(source // 10, chosen)
    monkeypatch.setattr(BLOCK, 37)
    for made in (ExactSplats(model), FittedSplats(model, splats, source)):
        parts = list(made.parts())
        assert max(len(part.source) for part in parts) <= 37
        assert np.array_equal(np.concatenate([part.source for part in parts]), source)
        of_chosen, none = made.of(chosen), made.of(chosen[:0])
        assert np.array_equal(of_chosen.source, source[expected]) and len(none.splats) == len(none.source) == 0
        assert {part.splats.blur for part in parts} == {splats.blur}
        arrays = {name: values for name, values in vars(splats).items() if name != "blur"}
        for name, values in arrays.items():
            found = np.concatenate([getattr(part.splats, name) for part in parts])
            np.testing.assert_array_equal(found, values, name)
            np.testing.assert_array_equal(getattr(of_chosen.splats, name), values[expected], name)


@pytest.mark.parametrize("mode", ["explicit", "view"])
def test_model_without_anchors_is_exported(tmp_path, mode):
    model = model_of(4, mode)
    anchors = model.anchors
    model.anchors = Anchors(anchors.layout, anchors.voxel, anchors.positions[:0], anchors.rows[:0], anchors.ids[:0])
    folder = export(model, tmp_path / "out")
    assert len(read_vertices(folder.splats)) == len(read_anchor_table(folder.anchors)) == 0


@pytest.mark.parametrize("mode", ["explicit", "view"])
@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_files_do_not_depend_on_the_size_of_blocks(tmp_path, monkeypatch, mode, primitive):
    model = model_of(300, mode, primitive, center=1e6)
    model.anchors.rows[[7, 200], model.anchors.layout.shape_columns] = torch.nan
    whole = export(model, tmp_path / "whole")
    monkeypatch.setattr(BLOCK, 37)
    for name in OF_FIT:
        monkeypatch.setattr(name, 41)
    parts = export(model, tmp_path / "parts")
    assert parts.splats.read_bytes() == whole.splats.read_bytes()
    assert parts.anchors.read_bytes() == whole.anchors.read_bytes()
    splats, anchors = read_vertices(whole.splats), read_anchor_table(whole.anchors)
    assert len(anchors) == 300 and anchors["splats"].sum() == len(splats) > 1000
    assert (anchors["splats"][[7, 200]] == 0).all() and splats["x"].dtype == anchors["x"].dtype == np.float64


def test_optimizer_is_freed_before_the_export(write_capture, tmp_path, run_command, monkeypatch):
    optimizers: weakref.WeakSet[ModelOptimizer] = weakref.WeakSet()
    living = []

    class Watched(ModelOptimizer):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            optimizers.add(self)
            living.append(len(optimizers))

    def watched_export(*arguments):
        living.append(len(optimizers))
        return export_model(*arguments)

    monkeypatch.setattr("backend.training.trainer.ModelOptimizer", Watched)
    monkeypatch.setattr(train, "export_model", watched_export)
    capture = write_capture(views=9, size=(64, 48)).folder
    assert run_command("train", capture, "--out", tmp_path / "out", "--steps", 2, "--offsets", 2).code == EXIT_DONE
    assert max(living) > 0 and living[-1] == 0
