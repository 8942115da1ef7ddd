"""What several benchmarks share: results that outlive a run that was stopped, work in processes of their own, the
quality of a training, and plots for docs/."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

import backend  # noqa: E402, F401 - says how threads wait, before torch is loaded

GREY = "#8a8a92"
COLOURS = ("#3b7dd8", "#d9731a", "#2a9d6f", "#b0479e", "#7a6a2f", "#5b5bd6")
MARKED = "#c8322b"
"""The colour of the default in every plot."""

_STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.edgecolor": "#b9b9bf",
    "axes.labelcolor": "#3c3c42",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#ececf0",
    "xtick.color": "#55555b",
    "ytick.color": "#55555b",
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def digest(paths: Iterable[Path], *words: object) -> str:
    """Tells the content of files, and what else a result depends on, from others."""
    sha = hashlib.sha256(repr(words).encode())
    for path in sorted(paths):
        sha.update(path.name.encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:16]


def sources() -> list[Path]:
    """The files that decide what the backend computes: all but what it says of earlier measurements."""
    return sorted(path for path in (ROOT / "backend").rglob("*.py") if path.name != "expectation.py")


class Results:
    """Results by name in a folder, each one computed once for the same code and input; one line is printed for each.

    made_from: `digest` of what all of them depend on. total: how many are to come, for the lines.
    """

    def __init__(self, folder: Path, made_from: str, total: int) -> None:
        self.folder, self.made_from, self.total = folder, made_from, total
        self.failures: dict[str, str] = {}
        self._done, self._started = 0, time.monotonic()
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, make: Callable[[], dict[str, Any]], line: Callable[[dict[str, Any]], str]) -> Any:
        """The result `name`, from disk where it is there; {} where it fails, which `failures` then holds."""
        path = self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.json"
        stored = json.loads(path.read_text()) if path.exists() else {}
        again = stored.get("made_from") == self.made_from
        result, text = stored.get("result", {}) if again else {}, ""
        if not again:
            try:
                result = make()
            except (OSError, RuntimeError, ValueError) as error:
                self.failures[name] = text = f"failed: {error}"
            else:
                content = json.dumps({"name": name, "made_from": self.made_from, "result": result})
                fresh = path.with_suffix(".new")
                fresh.write_text(content)
                fresh.replace(path)
        self._done += 1
        spent = int(time.monotonic() - self._started)
        print(
            f"[{self._done:3d}/{self.total} {spent // 60:3d}:{spent % 60:02d}] {name}: {text or line(result)}"
            + (" (from before)" if again else ""),
            flush=True,
        )
        return result


def forget(folder: Path) -> None:
    """Remove what earlier runs have left."""
    shutil.rmtree(folder, ignore_errors=True)


def in_child(call: str, environment: Mapping[str, str] | None = None, **words: Any) -> dict[str, Any]:
    """What `module:function`, called with `words` (as JSON goes) in a process of its own, returns; RuntimeError with
    the end of what it said where it fails."""
    module, function = call.split(":")
    script = (
        f"import json, sys; from {module} import {function} as call; "
        "found = call(**json.loads(sys.argv[1])); print(); print(json.dumps(found))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, json.dumps(words)],
        cwd=ROOT, capture_output=True, text=True, env={**os.environ, **(environment or {})},
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(" | ".join(done.stderr.strip().splitlines()[-3:]) or f"exit code {done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def replace(owner: Any, name: str, value: Any) -> Any:
    """Give a module's name another value, in this process; returns the old one. RuntimeError where it has no such name,
    for then nothing would change."""
    if not hasattr(owner, name):
        raise RuntimeError(f"{owner.__name__} has no {name} any more, which this benchmark changes")
    old = getattr(owner, name)
    setattr(owner, name, value)
    return old


def compile_everything() -> None:
    """Have all kernels of the product ready on disk, so that no measurement waits for one."""
    from backend.commands.kernels import have_kernels_ready
    from backend.device import CPU
    from backend.protocol import Reporter
    from backend.stopping import StoppingReporter, StopRequest

    print("Kernels are compiled where that was not done yet.", flush=True)
    have_kernels_ready(StoppingReporter(Reporter(), StopRequest()), CPU)


def train_and_measure(trainer: Any, capture: Any, budget: Any) -> dict[str, Any]:
    """Train, and measure what comes of it on the held-out views."""
    import numpy as np

    from backend.evaluation import evaluate
    from backend.protocol import Reporter
    from backend.raster.draw import draw

    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as folder:
        trainer.run(budget, Path(folder), Reporter())

    def render(index: int) -> tuple[Any, Any]:
        picture = draw(trainer.shown, trainer.scene.camera(index))
        return picture.image, picture.ids

    quality = evaluate(capture, render, capture.test_indices)["quality"]
    progress = trainer.progress
    return {
        **{name: quality[name] for name in ("psnr", "ssim", "miou", "mbiou")},
        "steps": progress.step,
        "steps_per_second": progress.step / progress.seconds,
        "anchors": len(trainer.model.anchors),
        "splats": len(trainer.shown.generate(eye=np.zeros(3)).source),
    }


def from_photos_to_report(capture: Path, *options: object, meshes: bool = True) -> dict[str, Any]:
    """Train, mesh and evaluate by the commands that a user runs; returns what the report says. F1 is over the true
    surface that training views see; of it and of the texture's PSNR the median over the objects, of F1 also the least.
    """
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "out"
        for words in (
            ("train", capture, "--out", out, *options),
            *([("mesh", out)] if meshes else []),
            ("evaluate", out),
            ("report", out),
        ):
            subprocess.run(
                [sys.executable, "-m", "backend", *map(str, words)], cwd=ROOT, check=True, stdout=subprocess.DEVNULL
            )
        report = json.loads((out / "report.json").read_text())
    seconds_of = {stage["name"]: stage["seconds"] for stage in report["stages"]}
    made = [entry["mesh"] for entry in report["objects"] if entry["mesh"]]

    def over_objects(name: str, of: Callable[[list[float]], float] = statistics.median) -> float | None:
        known = [mesh[name] for mesh in made if mesh.get(name) is not None]
        return of(known) if known else None

    return {
        "steps": report["model"]["trained_steps"],
        "psnr": report["quality"]["psnr"],
        "miou": report["quality"]["miou"],
        "f1": over_objects("f1"),
        "f1_least": over_objects("f1", min),
        "f1_005": over_objects("f1_005"),
        "texture_psnr": over_objects("texture_psnr"),
        "train_seconds": seconds_of["train"],
        "mesh_seconds": seconds_of.get("mesh"),
        "curve": report["curve"],
    }


def plot_style() -> AbstractContextManager[None]:
    """Within it, figures look like those of docs/."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG of at most 300 KB."""
    import io

    from PIL import Image

    from backend.evaluation.mesh_pictures import save_sheet

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_sheet(Image.open(buffer).convert("RGB"), path)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a Markdown table: first column to the left, the others to the right."""
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(["---"] + ["---:"] * (len(head) - 1)) + "|"]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows)]
