"""Shared helpers of the benchmarks: results that survive a stopped run, child processes, training quality and plots."""

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
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

import backend  # noqa: F401 - sets the thread wait policy, before torch is loaded

GRAY = "#8a8a92"
COLORS = ("#3b7dd8", "#d9731a", "#2a9d6f", "#b0479e", "#7a6a2f", "#5b5bd6")
MARKED = "#c8322b"
"""Color of the default in every plot."""

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
    """Return a digest of the content of files and of all other values that a result depends on."""
    sha = hashlib.sha256(repr(words).encode())
    for path in sorted(paths):
        sha.update(path.name.encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:16]


def sources(code: Path = ROOT) -> list[Path]:
    """Return the files that determine the results of a checkout's backend: all except that of earlier measurements."""
    return sorted(path for path in (code / "backend").rglob("*.py") if path.name != "expectation.py")


class Results:
    """Named results in a folder; each is computed once for the same code and input, and printed as one line.

    made_from: `digest` of everything that the results depend on. total: expected number of results, for the printed
    lines.
    """

    def __init__(self, folder: Path, made_from: str, total: int) -> None:
        self.folder, self.made_from, self.total = folder, made_from, total
        self.failures: dict[str, str] = {}
        self._done, self._started = 0, time.monotonic()
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, make: Callable[[], dict[str, Any]], line: Callable[[dict[str, Any]], str]) -> Any:
        """Return the result `name`, from disk if it is current; {} if `make` fails, with the reason in `failures`."""
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
            + (" (from an earlier run)" if again else ""),
            flush=True,
        )
        return result


def forget(folder: Path) -> None:
    """Remove the results of earlier runs."""
    shutil.rmtree(folder, ignore_errors=True)


def in_child(call: str, environment: Mapping[str, str] | None = None, **words: Any) -> dict[str, Any]:
    """Call `module:function` in a separate process and return its result.

    Args:
        call: `module:function`.
        environment: additional environment variables.
        words: keyword arguments, passed as JSON.

    Raises:
        RuntimeError: the process failed; the message is the end of its error output.
    """
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
    """Replace a module's attribute in this process and return the old value.

    Raises:
        RuntimeError: the module has no such attribute, so nothing would change.
    """
    if not hasattr(owner, name):
        raise RuntimeError(f"{owner.__name__} no longer has {name}, which this benchmark changes")
    old = getattr(owner, name)
    setattr(owner, name, value)
    return old


def compile_everything() -> None:
    """Compile all kernels to disk, so that no measurement includes compilation."""
    from backend.commands.setup.kernels import ensure_kernels
    from backend.raster.devices import CPU
    from backend.shared.events import Reporter
    from backend.shared.stopping import StoppingReporter, StopRequest

    print("Compiling missing kernels", flush=True)
    ensure_kernels(StoppingReporter(Reporter(), StopRequest()), CPU)


def train_and_measure(trainer: Any, capture: Any, budget: Any) -> dict[str, Any]:
    """Train, and measure the result on the held-out views."""
    import numpy as np

    from backend.evaluation import evaluate
    from backend.model.draw import draw
    from backend.shared.events import Reporter

    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as folder:
        trainer.run(budget, Path(folder), Reporter())

    def render(index: int) -> tuple[Any, Any]:
        rendered = draw(trainer.shown, trainer.scene.camera(index))
        return rendered.image, rendered.ids

    quality = evaluate(capture, render, capture.test_indices)["quality"]
    progress = trainer.progress
    return {
        **{name: quality[name] for name in ("psnr", "ssim", "miou", "miou_all", "mbiou")},
        "steps": progress.step,
        "steps_per_second": progress.step / progress.seconds,
        "anchors": len(trainer.model.anchors),
        "splats": len(trainer.shown.generate(camera_center=np.zeros(3)).source),
    }


def run_backend(*words: object) -> float:
    """Run a command of the backend; return the seconds it took. Raises RuntimeError with its message if it fails."""
    started = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "backend", *map(str, words)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or done.stdout)
    return time.monotonic() - started


def over_objects(
    report: Mapping[str, Any], name: str, of: Callable[[list[float]], float] = statistics.median
) -> float | None:
    """Return the median, or another figure, of a measure of a report's meshes; None if none of them has it."""
    meshes = [entry["mesh"] for entry in report["objects"] if entry["mesh"]]
    known = [mesh[name] for mesh in meshes if mesh.get(name) is not None]
    return of(known) if known else None


def from_photos_to_report(capture: Path, *options: object, meshes: bool = True) -> dict[str, Any]:
    """Train, mesh and evaluate with the user's commands and return figures of the report.

    F1 is measured on the part of the true surface that training views see. F1 and the texture's PSNR are medians over
    the objects; `f1_least` is the lowest F1.
    """
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "out"
        for words in (
            ("train", capture, "--out", out, *options),
            *([("mesh", out)] if meshes else []),
            ("evaluate", out),
            ("report", out),
        ):
            run_backend(*words)
        report = json.loads((out / "report.json").read_text())
    seconds_of = {stage["name"]: stage["seconds"] for stage in report["stages"]}
    return {
        "steps": report["model"]["trained_steps"],
        "psnr": report["quality"]["psnr"],
        "miou": report["quality"]["miou"],
        "miou_all": report["quality"]["miou_all"],
        "mbiou": report["quality"]["mbiou"],
        "seconds": sum(seconds_of.values()),
        "mesh_mb": max((stage["peak_rss_mb"] for stage in report["stages"] if stage["name"] == "mesh"), default=None),
        "f1": over_objects(report, "f1"),
        "f1_least": over_objects(report, "f1", min),
        "f1_005": over_objects(report, "f1_005"),
        "texture_psnr": over_objects(report, "texture_psnr"),
        "train_seconds": seconds_of["train"],
        "mesh_seconds": seconds_of.get("mesh"),
        "curve": report["curve"],
    }


def plot_style() -> AbstractContextManager[None]:
    """Return a context in which figures have the style of docs/."""
    from matplotlib import rc_context

    return rc_context(_STYLE)


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG of at most 300 KB."""
    import io

    from PIL import Image

    from backend.evaluation.mesh_sheet import save_sheet

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_sheet(Image.open(buffer).convert("RGB"), path)


def spread(values: Sequence[float | None], form: str) -> str:
    """Return the mean as text, with the standard deviation if there are several values; empty if a value is None."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return ""
    mean = form.format(statistics.fmean(known))
    return mean if len(known) < 2 else f"{mean} ± {form.replace('+', '').format(statistics.stdev(known))}"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Return the lines of a Markdown table; the first column is left-aligned, the others right-aligned."""
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(["---"] + ["---:"] * (len(head) - 1)) + "|"]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows)]
