"""The alternatives to one-hot IDs that benchmarks/ablations.py compares."""

import numpy as np
import pytest
import torch

from backend.capture import load_capture
from backend.labels import vote
from backend.model.draw import draw
from backend.training import trainer as trainer_module
from backend.training.settings import Settings
from backend.training.trainer import Trainer
from benchmarks import ablations, semantics


@pytest.fixture
def capture(write_capture, tmp_path):
    return load_capture(write_capture().folder, tmp_path / "cache")


def started(capture, name, monkeypatch, **settings):
    monkeypatch.setattr(trainer_module, "ViewStep", semantics.STEPS[name])
    return Trainer.start(capture, vote(capture).ids, Settings(offsets=4, **settings))


@pytest.mark.long
def test_learnable_features_learn_the_masks(capture, monkeypatch):
    trainer = started(capture, "learnable", monkeypatch, seed=1)
    for i in range(150):
        trainer.step(0.1 + 0.8 * i / 150)
    # The cameras are far apart, so a training view is checked.
    index = capture.train_indices[0]
    mask = capture.mask(index)
    found = trainer.view_step.ids(trainer.model, trainer.scene.camera(index))
    assert (found == mask)[mask > 0].mean() > 0.9


def test_objects_rendered_alone_follow_their_masks(capture, monkeypatch):
    """With object-independent constraints, an object behind another one has a hole where it is hidden."""
    trainer = started(capture, "independent", monkeypatch)
    index = capture.train_indices[0]
    before = trainer.view_step.compute(index, 0.5).loss
    for i in range(60):
        trainer.step(0.1 + 0.5 * i / 60)
    assert trainer.view_step.compute(index, 0.5).loss < before
    for inside, union in semantics.iou_alone(trainer.model, trainer.scene.camera(index), capture.mask(index)).values():
        assert 0 < inside <= union


@pytest.mark.parametrize("name", ["learnable", "independent"])
def test_without_weight_the_semantics_change_nothing(capture, monkeypatch, name):
    index = capture.train_indices[0]
    losses = [
        started(capture, kind, monkeypatch, semantic_weight=0.0).view_step.compute(index, 0.5).loss
        for kind in ("one-hot", name)
    ]
    assert torch.equal(*losses)


def test_alone_counts_pixels_of_each_object(capture, monkeypatch):
    trainer = started(capture, "one-hot", monkeypatch)
    index = capture.test_indices[0]
    mask = capture.mask(index)
    found = semantics.iou_alone(trainer.model, trainer.scene.camera(index), mask)
    assert set(found) == set(np.unique(mask[mask > 0]).tolist())
    assert draw(trainer.model, trainer.scene.camera(index)).ids.shape == mask.shape


def test_document_has_paper_and_spread():
    row = {name: [0.5, 0.7] for name in ablations.FIGURES}
    figures = {key: {v.name: row for v in table.variants} for key, table in ablations.TABLES.items()}
    text = ablations.document({"steps": 9, "seeds": 2, "captures": {"demo": {"objects": 3, "figures": figures}}})
    assert "| one-hot IDs (default) | 0.8819 | 0.8522 | 26.75 | 0.9134 |" in text
    assert "0.6000 ± 0.1414" in text
