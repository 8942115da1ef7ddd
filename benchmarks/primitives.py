"""Compare 3D Gaussians with 2D Gaussians on one capture with exact truth: images, objects and meshes, in equal time.

    python benchmarks/primitives.py [--json] [--capture build/demo/capture] [--seconds 144]

Training, meshing and evaluation run through the user's commands. Quality is measured on the held-out views, and F1 on
the part of the true surface that training views see. F1 and the texture's PSNR are medians over the objects; the lowest
F1 is printed, too.
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
