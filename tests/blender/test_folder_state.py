# SPDX-License-Identifier: GPL-3.0-or-later
"""State of a reconstruction folder, from its files alone."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

from objectgs.backend.shared.reconstruction.cameras import Cameras, CameraView, write_cameras
from objectgs.backend.shared.reconstruction.folder import Reconstruction
from objectgs.backend.shared.reconstruction.record import TrainingRecord, VotesRecord, update_record
from objectgs.objectgs_addon.state.folder_state import folder_state


def write_checkpoint(folder, step, seconds, curve=()):
    """Write a safetensors file with the backend's header and no tensors."""
    progress = {"step": step, "seconds": seconds, "curve": list(curve)}
    state = json.dumps({"format": 1, "supervise_background": True, "progress": progress})
    header = json.dumps({"__metadata__": {"state": state}}).encode()
    (folder / "checkpoint").mkdir(exist_ok=True)
    (folder / "checkpoint" / "model.safetensors").write_bytes(struct.pack("<Q", len(header)) + header)


def test_missing_folder_has_no_state(tmp_path):
    state = folder_state(tmp_path / "gone")
    assert not state.exists and not state.imported and state.capture is None and state.steps == 0


def test_folder_state_follows_each_step(tmp_path):
    folder = tmp_path / "rec"
    folder.mkdir()
    assert folder_state(folder).exists and not folder_state(folder).imported
    (folder / "points.ply").write_bytes(b"ply")
    views = [
        CameraView(f"{width}.png", folder / "image.png", None, width, height, np.eye(3), np.eye(4), False)
        for width, height in ((40, 30), (20, 10))
    ]
    write_cameras(folder, Cameras(Path("/somewhere/else"), np.zeros(3), np.eye(4), views))
    state = folder_state(folder)
    assert state.imported and str(state.capture) == "/somewhere/else" and not state.voted
    assert state.pixels == (1200 + 200) / 2
    (folder / "objects.json").write_text("{}")
    write_checkpoint(folder, 700, 12.5)
    state = folder_state(folder)
    assert state.voted and (state.steps, state.seconds) == (700, 12.5) and not state.trained
    (folder / "splats.ply").write_bytes(b"ply")
    assert folder_state(folder).trained


@pytest.mark.parametrize(
    ("length", "unfinished"),
    [
        ({"steps": 800}, True),
        ({"steps": 700}, False),
        ({"minutes": 0.25}, True),
        ({"minutes": 0.2}, False),
        ({"minutes": 5.0, "preset": "final"}, False),
        ({}, False),
    ],
)
def test_training_that_was_stopped_is_unfinished(tmp_path, length, unfinished):
    write_checkpoint(tmp_path, 700, 12.5)
    record = TrainingRecord(settings={}, votes=VotesRecord("majority", None, 800, "0f", None), **length)
    update_record(Reconstruction(tmp_path), training=record)
    assert folder_state(tmp_path).unfinished is unfinished


def test_quality_is_that_of_the_last_entry_of_the_curve(tmp_path):
    write_checkpoint(tmp_path, 500, 9.0)
    assert folder_state(tmp_path).quality == {}
    write_checkpoint(tmp_path, 700, 12.5, [{"psnr": 20.0, "miou": 0.5}, {"psnr": 30.5, "miou": None, "miou_all": 0.75}])
    state = folder_state(tmp_path)
    assert state.quality == {"psnr": 30.5, "miou_all": 0.75} and state.zero_is_background


@pytest.mark.parametrize("content", [b"", b"\xff" * 8, b'\x05\0\0\0\0\0\0\0{"a":', struct.pack("<Q", 2) + b"{}"])
def test_invalid_files_count_as_missing(tmp_path, content):
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "model.safetensors").write_bytes(content)
    (tmp_path / "cameras.json").write_text("{nonsense")
    state = folder_state(tmp_path)
    assert state.steps == 0 and state.capture is None
