"""Checkpoints that the backend writes, as Blender reads them."""

import importlib

import numpy as np

import headless
from backend.model.checkpoint import save_checkpoint


def test_blender_reads_steps_and_seconds_of_checkpoint(tmp_path):
    root = headless.extension().__name__
    folder_state = importlib.import_module(f"{root}.objectgs_addon.state.folder_state").folder_state
    save_checkpoint(tmp_path / "checkpoint", {"a": np.zeros(3, np.float32)}, {"progress": {"step": 3, "seconds": 0.5}})
    state = folder_state(tmp_path)
    assert (state.steps, state.seconds) == (3, 0.5)
