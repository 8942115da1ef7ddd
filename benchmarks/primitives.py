"""3D Gaussians against 2D ones on one capture with a known truth: pictures, objects and meshes, in equal time.

    python benchmarks/primitives.py [--json] [--capture build/demo/capture] [--seconds 144]

Everything is made by the commands that a user runs. Quality is on the held-out views, F1 over the true surface that
training views see; of F1 and the texture's PSNR the median over the objects is shown, of F1 also the least.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def measure(capture: Path, primitive: str, seconds: float, folder: Path) -> dict:
    """Train, mesh, evaluate; returns what the report says."""
    minutes = str(seconds / 60)
    for words in (
        ("train", capture, "--out", folder, "--minutes", minutes, "--primitive", primitive),
        ("mesh", folder),
        ("evaluate", folder),
        ("report", folder),
    ):
        subprocess.run(
            [sys.executable, "-m", "backend", *map(str, words)], cwd=ROOT, check=True, stdout=subprocess.DEVNULL
        )
    report = json.loads((folder / "report.json").read_text())
    seconds_of = {stage["name"]: stage["seconds"] for stage in report["stages"]}
    meshes = [entry["mesh"] for entry in report["objects"]]

    def over_objects(name: str, of: Callable[[list[float]], float] = statistics.median) -> float | None:
        known = [mesh[name] for mesh in meshes if mesh.get(name) is not None]
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
        "mesh_seconds": seconds_of["mesh"],
    }


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    parser.add_argument("--seconds", type=float, default=144.0)
    options = parser.parse_args()
    found = {}
    for primitive in ("3d", "2d"):
        with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as folder:
            found[primitive] = measure(options.capture, primitive, options.seconds, Path(folder) / "out")
    if options.json:
        print(json.dumps(found))
        return
    print(f"{'':16}" + "".join(f"{primitive:>10}" for primitive in found))
    for name in found["3d"]:
        values = [found[primitive][name] for primitive in found]
        print(f"{name:16}" + "".join(f"{'-' if value is None else format(value, '.4g'):>10}" for value in values))


if __name__ == "__main__":
    main()
