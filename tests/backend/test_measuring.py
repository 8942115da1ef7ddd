"""Measurements during a training: the views that decide on it each time, held-out views as time allows."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from backend.commands.training import measuring
from backend.commands.training.measuring import SHARE, Measuring
from backend.shared.errors import Cancelled
from backend.shared.events import Reporter
from backend.shared.reconstruction.checkpoint import read_header
from backend.training.budget import Budget, TrainingProgress

SECONDS_A_VIEW = 2.0
HELD_OUT = tuple(range(5))


class Clock:
    """Time that passes only while views are drawn."""

    def __init__(self):
        self.now, self.drawn = 0.0, []

    def monotonic(self):
        return self.now

    def draw(self, model, camera, want_ids):
        self.now += SECONDS_A_VIEW
        self.drawn.append(camera)
        return SimpleNamespace(image=np.full((6, 8, 3), 0.5, np.float32), ids=np.ones((6, 8), np.int64))


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(measuring, "time", clock)
    monkeypatch.setattr(measuring, "draw", clock.draw)
    return clock


def scene(validation=()):
    photo, mask = np.full((6, 8, 3), 100, np.uint8), np.ones((6, 8), np.int64)
    capture = SimpleNamespace(
        test_indices=HELD_OUT, validation_indices=validation, names={1: "one"},
        image=lambda index: photo, mask=lambda index: mask,
    )  # fmt: skip
    return SimpleNamespace(capture=capture, zero_is_object=False, camera=lambda index: index)


def test_held_out_views_take_a_share_of_the_time(clock, tmp_path):
    previews = []
    reporter = Reporter()
    reporter.preview = lambda path, **_: previews.append(path)
    measure = Measuring(SimpleNamespace(previews=tmp_path), Budget(seconds=1000.0), reporter)
    all_views = SECONDS_A_VIEW * len(HELD_OUT)
    early = measure(None, scene(), TrainingProgress(seconds=0.9 * all_views / SHARE))
    assert early == {} and clock.drawn == [0] and len(previews) == 1, "only the preview"
    later = measure(None, scene(), TrainingProgress(seconds=(all_views + SECONDS_A_VIEW) / SHARE + 1.0))
    assert clock.drawn == [0, *HELD_OUT] and later["psnr"] == pytest.approx(-20 * math.log10(0.5 - 100 / 255), abs=1e-4)
    assert later["miou"] == 1.0
    again = measure(None, scene(), TrainingProgress(seconds=(all_views + SECONDS_A_VIEW) / SHARE + 2.0))
    assert again == {} and len(previews) == 3, "what earlier ones took counts"


def test_end_and_deciding_views_are_always_measured(clock, tmp_path):
    measure = Measuring(SimpleNamespace(previews=tmp_path), Budget(steps=10), Reporter())
    figures = measure(None, scene(validation=(7, 8)), TrainingProgress(step=5))
    assert set(figures) == {"validation_psnr"} and clock.drawn == [0, 7, 8]
    figures = measure(None, scene(), TrainingProgress(step=10))
    assert figures["psnr"] > 0 and clock.drawn[3:] == list(HELD_OUT)


@pytest.mark.parametrize("last", [3, 6])
def test_evaluation_ends_at_a_stop(clock, tmp_path, last):
    """Among the held-out views, and among those for validation."""

    def check():
        if len(clock.drawn) == last:
            raise Cancelled

    measure = Measuring(SimpleNamespace(previews=tmp_path), Budget(steps=10), Reporter(), check)
    with pytest.raises(Cancelled):
        measure(None, scene(validation=(7, 8)), TrainingProgress(step=10))
    assert clock.drawn == [*HELD_OUT, 7, 8][:last]


def test_previews_that_cannot_be_written_are_reported_once(clock, tmp_path, monkeypatch):
    def save(image, path, quick):
        raise PermissionError(13, "It is being used by another process", str(path))

    monkeypatch.setattr(measuring, "save_image", save)
    reporter, warnings, previews = Reporter(), [], []
    reporter.warning, reporter.preview = warnings.append, lambda *path, **_: previews.append(path)
    measure = Measuring(SimpleNamespace(previews=tmp_path), Budget(steps=10), reporter)
    assert all(measure(None, scene(), TrainingProgress(step=10))["psnr"] > 0 for _ in range(2))
    assert len(warnings) == 1 and "render.png could not be written (It is being used" in warnings[0] and not previews


def test_preview_of_a_training_view_has_no_object_for_unknown_pixels(clock, tmp_path, monkeypatch):
    without = scene()
    without.capture.test_indices = ()
    without.capture.mask = lambda index: np.array([[-1, 0, 1, 1]] * 6).repeat(2, 1)
    masks = []
    monkeypatch.setattr(measuring, "comparison", lambda *images: masks.append(images[2]) or Image.new("RGB", (8, 6)))
    measure = Measuring(SimpleNamespace(previews=tmp_path), Budget(steps=10), Reporter())
    assert measure(None, without, TrainingProgress(step=10))["psnr"] is None
    assert np.unique(masks).tolist() == [0, 1]


def test_latest_figures_are_those_of_the_latest_measured_entry(tmp_path):
    entries = [{"step": 1, "psnr": 20.0, "miou": 0.5}, {"step": 2, "psnr": 21.0, "miou": 0.6}, {"step": 3}]
    assert TrainingProgress(curve=entries).latest["step"] == 2
    assert TrainingProgress().latest == {} == TrainingProgress(curve=entries[2:]).latest
    state = json.dumps({"progress": {"step": 3, "seconds": 4.0, "curve": entries}})
    header = json.dumps({"__metadata__": {"state": state}}).encode()
    (tmp_path / "model.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
    assert read_header(tmp_path).quality == {"psnr": 21.0, "miou": 0.6}
