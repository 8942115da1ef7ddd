# SPDX-License-Identifier: GPL-3.0-or-later
"""Events of a program that is not the backend, or is broken: the job and the panel survive any of them."""

import json
import random

import pytest
from objectgs.objectgs_addon.process import backend_process
from objectgs.objectgs_addon.process.jobs import Job, State
from objectgs.objectgs_addon.running import job_display

EVENTS = [
    {"type": "status", "time": 1.0, "message": "Training"},
    {"type": "progress", "done": 0.5, "total": 1.0, "step": 10, "splats": 500, "seconds_left": 3.0, "what": "images"},
    {"type": "quality", "step": 10, "seconds": 1.0, "psnr": 20.0, "miou": 0.5, "mbiou": None},
    {"type": "preview", "path": "/tmp/render.png", "render": "/tmp/a.png"},
    {"type": "warning", "message": "Careful."},
    {"type": "error", "message": "It failed."},
    {"type": "done", "stopped": True, "message": "Stopped.", "steps": 10, "psnr": 20.0},
]
RAW = ["NaN", "Infinity", "-1e999", "1e999", "9" * 400, "9" * 5000, "[" * 5000, '{"a":' * 5000, "null", "true", "[]",
       "{}", '"\\ud800"', '""', '"' + "x" * 100_000 + '"', "-1", "1e308", "1e-320"]  # fmt: skip


def hostile_lines(seed):
    """Return 50 lines: events with a value replaced, removed or renamed, and damaged text."""
    rng = random.Random(seed)
    lines = []
    for _ in range(50):
        event = dict(rng.choice(EVENTS))
        key = rng.choice(sorted(event))
        if rng.random() < 0.8:
            event[key] = "@"
        else:
            del event[key]
        line = json.dumps(event).replace('"@"', rng.choice(RAW)).encode()
        if rng.random() < 0.2:
            at = rng.randrange(len(line))
            line = line[:at] + rng.randbytes(3) + line[at + 1 :]
        lines.append(line)
    return lines


@pytest.mark.parametrize("seed", range(20))
def test_any_event_is_taken_or_ignored(tmp_path, monkeypatch, seed):
    monkeypatch.setattr(job_display, "write", lambda layout, text, icon="NONE": None)
    job = Job("Train", "train", tmp_path, ["true"], tmp_path)
    job.state = State.RUNNING
    for line in hostile_lines(seed):
        event = backend_process._event(line)
        if event is not None:
            job._take(event)
            assert 0 <= job.progress <= 1
            assert job_display.summary(job).startswith("Train: ")
            job_display.draw_figures(None, job.quality, job.zero_is_background, job.splats)
    assert all(isinstance(text, str) for text in [job.message, *job.statuses, *job.warnings])
