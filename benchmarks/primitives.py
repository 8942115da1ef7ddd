"""3D Gaussians against 2D ones on one capture with a known truth: pictures, objects and meshes, in equal time.

    python benchmarks/primitives.py [--json] [--capture build/demo/capture] [--seconds 144]

Everything is made by the commands that a user runs. Quality is on the held-out views, F1 over the true surface that
training views see; of F1 and the texture's PSNR the median over the objects is shown, of F1 also the least.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.shared import from_photos_to_report


def main() -> None:
    """Print the table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--capture", type=Path, default=ROOT / "build/demo/capture")
    parser.add_argument("--seconds", type=float, default=144.0)
    options = parser.parse_args()
    found = {}
    for primitive in ("3d", "2d"):
        words = ("--minutes", options.seconds / 60, "--primitive", primitive)
        found[primitive] = from_photos_to_report(options.capture, *words)
    if options.json:
        print(json.dumps(found))
        return
    print(f"{'':16}" + "".join(f"{primitive:>10}" for primitive in found))
    for name in (name for name in found["3d"] if name != "curve"):
        values = [found[primitive][name] for primitive in found]
        print(f"{name:16}" + "".join(f"{'-' if value is None else format(value, '.4g'):>10}" for value in values))


if __name__ == "__main__":
    main()
