"""Poses of photos and videos alone against known ones, and the time they take, beside COLMAP's own defaults.

    python benchmarks/poses.py [--set NAME ...] [--defaults] [--write]

Synthetic sets have exact poses; the real ones are compared with the models that come with them, which are estimates
themselves. Positions are compared after a similarity fit that wrong poses do not influence. --defaults also runs
COLMAP's feature extraction, exhaustive matching and incremental mapping with their default options, in the same run.
--write saves the figures to docs/figures/poses.json, beside those of sets that were measured before, and the table to
docs/poses.md.
"""

from __future__ import annotations

import argparse
import functools
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
import pycolmap
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import documents, shared

DATA = ROOT.parent / "shared" / "data"
BUILD = ROOT / "build" / "poses"
WRONG_DEGREES, WRONG_POSITION = 5.0, 0.05
"""Errors of the rotation, and of the position relative to the size of the scene, above which a pose is wrong."""
LONGEST = 600.0
"""Seconds after which COLMAP with its default options is ended."""
_STAGES = ("Photos", "Features", "Pairs", "Matching", "Poses", "Points")
_FRAMES_A_SECOND = 15
_SIZES = (42, 100, 200)
"""Numbers of photos of the same table."""


class Case(NamedTuple):
    """Photos and what is known of them.

    Attributes:
        text: what they show.
        photos: makes the photos if needed; returns the arguments of `sfm` that name them.
        truth: returns world-to-camera matrices (3, 4) by name of the photo; {} where a refusal is expected.
        options: further arguments of `sfm`.
    """

    text: str
    photos: Callable[[], list[str]]
    truth: Callable[[], Mapping[str, np.ndarray]]
    options: tuple[str, ...] = ()


def model_poses(folder: Path) -> dict[str, np.ndarray]:
    """Return the poses of a COLMAP model by name of the photo."""
    model = pycolmap.Reconstruction(folder)
    images = (model.image(number) for number in model.reg_image_ids())
    return {image.name: image.cam_from_world().matrix() for image in images}


def llff_poses(path: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Return the poses of a poses_bounds.npy (LLFF), whose axes point down, right and back, for photos in order."""
    rows = np.load(path)[:, :15].reshape(-1, 3, 5)
    found = {}
    for name, row in zip(names, rows, strict=True):
        rotation = np.stack([row[:, 1], row[:, 0], -row[:, 2]])
        found[name] = np.column_stack([rotation, -rotation @ row[:, 3]])
    return found


def _made(name: str) -> Path:
    """Return the folder of a synthetic set, rendered if needed."""
    python = next(
        path for path in (ROOT / ".venv-bpy" / part for part in ("bin/python", "Scripts/python.exe")) if path.exists()
    )
    subprocess.run([python, "benchmarks/poses_scenes.py", BUILD, name], cwd=ROOT, check=True)
    return BUILD / name


def _film() -> list[str]:
    """Return the walk as a film, H.264."""
    folder = _made("walk")
    path = folder / "walk.mp4"
    if not path.exists():
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=_FRAMES_A_SECOND, options={"crf": "18"})
            images = [Image.open(path).convert("RGB") for path in sorted((folder / "capture" / "images").iterdir())]
            stream.pix_fmt, (stream.width, stream.height) = "yuv420p", images[0].size
            for image in images:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(image), "rgb24")))
            container.mux(stream.encode(None))
    return [str(path)]


def _film_poses() -> dict[str, np.ndarray]:
    poses = model_poses(BUILD / "walk" / "capture" / "sparse" / "0")
    return {f"frame_{int(name[:4]):06d}.jpg": matrix for name, matrix in poses.items()}


def _turntable() -> list[str]:
    """Return photos of the turntable before a background at rest, with masks of what turns."""
    folder = _made("turntable")
    out = folder / "photos"
    if not out.exists():
        (out / "images").mkdir(parents=True)
        shutil.copytree(folder / "capture" / "truth" / "masks", out / "masks")
        wall = np.asarray(Image.open(BUILD / "panorama" / "capture" / "images" / "0000.png").convert("RGB"))
        for path in sorted((folder / "capture" / "images").iterdir()):
            image = np.array(Image.open(path).convert("RGB"))
            ids = np.asarray(Image.open(out / "masks" / path.name))
            image[ids == 0] = wall[ids == 0]
            Image.fromarray(image).save(out / "images" / path.name)
    return [str(out)]


def _images(folder: Path) -> Callable[[], list[str]]:
    return lambda: [str(folder / "images")]


def _panorama() -> list[str]:
    return [str(_made("panorama") / "capture" / "images")]


def _some(count: int) -> list[str]:
    """Return a folder with as many of the large photos, evenly chosen."""
    folder = _made("large")
    out = folder / f"{count} photos"
    if not out.exists():
        out.mkdir()
        photos = sorted((folder / "capture" / "images").iterdir())
        for number in np.linspace(0, len(photos) - 1, count).round().astype(int):
            shutil.copy(photos[number], out)
    return [str(out)]


CASES = {
    "demo": Case(
        "the demo's photos, 320x240", _images(ROOT / "build/demo/capture"),
        lambda: model_poses(ROOT / "build/demo/capture/sparse/0"),
    ),
    "walk": Case("a film of a walk through a room, 15 s, 640x480, H.264", _film, _film_poses),
    "panorama": Case("a room from one spot, to be refused", _panorama, dict),
    **{
        f"{count} photos": Case(
            f"{count} photos of a table with 24 objects, 1000x750", functools.partial(_some, count),
            lambda: model_poses(BUILD / "large/capture/sparse/0"),
        )
        for count in _SIZES
    },
    "turntable": Case(
        "72 photos of a turntable before a background at rest, with masks", _turntable,
        lambda: model_poses(BUILD / "turntable/capture/sparse/0"),
    ),
    "turntable, no masks": Case("the same without masks, to be refused", lambda: [f"{_turntable()[0]}/images"], dict),
    "tabletop": Case(
        "a real table with objects, 640x480", _images(DATA / "tabletop"),
        lambda: model_poses(DATA / "tabletop/sparse/0"),
    ),
    "banana": Case(
        "14 real photos, 997x663", _images(DATA / "banana"), lambda: model_poses(DATA / "banana/sparse/0")
    ),
    "mouse": Case(
        "59 real photos of a small glossy object, 1920x1440", _images(DATA / "mouse"),
        lambda: model_poses(DATA / "mouse/sparse/0"), ("--cameras", "each"),
    ),
    "liberty": Case(
        "135 photos of a statue by many people, 800x1200", _images(DATA / "liberty"),
        lambda: llff_poses(
            DATA / "liberty/poses_bounds.npy", sorted(path.name for path in (DATA / "liberty/images").iterdir())
        ),
    ),
}  # fmt: skip


def pose_errors(found: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of rotations in degrees and of positions relative to the size of the scene, (n,) each.

    The similarity is the one of many samples of three cameras that most cameras agree with, fitted again to these.
    """
    names = sorted(set(found) & set(true))
    here = np.array([-found[name][:, :3].T @ found[name][:, 3] for name in names])
    there = np.array([-true[name][:, :3].T @ true[name][:, 3] for name in names])
    size = float(np.linalg.norm(np.ptp(there, axis=0)))
    rng, best = np.random.default_rng(0), np.zeros(len(names), bool)
    for _ in range(500 if len(names) > 3 else 1):
        sample = rng.choice(len(names), 3, replace=False) if len(names) > 3 else np.arange(len(names))
        scale, turn, shift = similarity(here[sample], there[sample])
        agrees = np.linalg.norm(scale * here @ turn.T + shift - there, axis=1) < 0.02 * size
        if agrees.sum() > best.sum():
            best = agrees
    scale, turn, shift = similarity(here[best], there[best])
    positions = np.linalg.norm(scale * here @ turn.T + shift - there, axis=1) / size
    turns = [found[name][:, :3] @ turn.T @ true[name][:, :3].T for name in names]
    degrees = np.degrees([np.arccos(np.clip((np.trace(each) - 1) / 2, -1, 1)) for each in turns])
    return degrees, positions


def similarity(here: np.ndarray, there: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return scale, rotation (3, 3) and translation (3,) that map points (n, 3) to others best (Umeyama 1991)."""
    a, b = here - here.mean(0), there - there.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ flip @ vt
    scale = float((s * np.diag(flip)).sum() / max((a**2).sum(), 1e-12))
    return scale, turn, there.mean(0) - scale * turn @ here.mean(0)


def compared(found: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the median errors, and how many poses are wrong."""
    if len(set(found) & set(true)) < 3:
        return {"degrees": None, "position": None, "wrong": None}
    degrees, positions = pose_errors(found, true)
    wrong = (degrees > WRONG_DEGREES) | (positions > WRONG_POSITION)
    return {
        "degrees": float(np.median(degrees)), "position": float(np.median(positions)), "wrong": int(wrong.sum()),
        "compared": len(degrees),
    }  # fmt: skip


def ours(case: Case) -> dict[str, Any]:
    """Run `sfm` on photos alone, and compare its poses with the known ones."""
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        out = Path(scratch) / "capture"
        started = time.monotonic()
        stages: dict[str, float] = dict.fromkeys(_STAGES, 0.0)
        command = ["sfm", *case.photos(), "--out", str(out), *case.options, "--json"]
        process = subprocess.Popen(
            [sys.executable, "-m", "backend", *command], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        current, since, last = "Photos", started, {}
        assert process.stdout is not None
        for line in process.stdout:
            last = json.loads(line)
            stage = str(last.get("stage") or "").partition(" (")[0]
            if stage in stages and stage != current:
                now = time.monotonic()
                stages[current] += now - since
                current, since = stage, now
        code = process.wait()
        stages[current] += time.monotonic() - since
        row = {"seconds": time.monotonic() - started, "stages": stages}
        if code:
            return {**row, "refused": str(last.get("message", "")).replace(f"{ROOT}/", ""), "registered": 0}
        report = json.loads((out / "sfm" / "sfm.json").read_text())
        found = model_poses(out / "sparse" / "0")
        return {
            **row, "photos": report["photos"], "registered": report["registered"], "mapper": report["mapper"],
            "weak": len(report["weak"]), "error": report["reprojection_error"], **compared(found, case.truth()),
        }  # fmt: skip


def defaults(case: Case) -> dict[str, Any]:
    """Run COLMAP with its default options on the same photos, and compare its poses with the known ones."""
    (source,) = case.photos()
    if (Path(source) / "images").is_dir():
        source = str(Path(source) / "images")
    with tempfile.TemporaryDirectory(prefix="objectgs-benchmark-") as scratch:
        started = time.monotonic()
        script = (
            "import sys, pycolmap; from pathlib import Path; source, out = sys.argv[1:]\n"
            "pycolmap.extract_features(out + '/d.db', source, camera_mode=pycolmap.CameraMode.AUTO)\n"
            "pycolmap.match_exhaustive(out + '/d.db'); Path(out, 'm').mkdir()\n"
            "found = pycolmap.incremental_mapping(out + '/d.db', source, out + '/m')\n"
            "best = max(found.values(), key=lambda each: each.num_reg_images(), default=None)\n"
            "Path(out, 'best').mkdir(); best and best.write(out + '/best')\n"
        )
        try:
            subprocess.run(
                [sys.executable, "-c", script, source, scratch], check=True, capture_output=True, timeout=LONGEST
            )
        except subprocess.TimeoutExpired:
            return {"seconds": LONGEST, "registered": "ended"}
        best = Path(scratch) / "best"
        seconds = time.monotonic() - started
        found = model_poses(best) if (best / "images.bin").exists() else {}
        return {"seconds": seconds, "registered": len(found), **compared(found, case.truth())}


def document(found: Mapping[str, Any]) -> str:
    """Return the text of docs/poses.md."""
    lines = [
        "# Poses of photos alone",
        "",
        "Made by `python benchmarks/poses.py --defaults --write` on two cores of a server CPU. Errors are medians, in "
        "degrees and relative to the size of the cameras' path, after a similarity fit. *Wrong*: poses that are off by "
        f"more than {WRONG_DEGREES:g} degrees or {WRONG_POSITION:.0%}. The poses of real photos are compared with the "
        "models that come with them, which are estimates themselves. *COLMAP* has its default options: exhaustive "
        f"matching and incremental mapping, and is ended after {LONGEST:.0f} s.",
        "",
        *shared.table(("set", "photos"), [(name, CASES[name].text) for name in found]),
        "",
    ]
    rows = []
    for name, entry in found.items():
        for who, row in (("ours", entry["ours"]), ("COLMAP", entry.get("defaults"))):
            if row:
                rows.append((
                    name, who, f"{row['registered']}" + (f" of {row['photos']}" if "photos" in row else ""),
                    *(_cell(row.get(key), form) for key, form in (
                        ("degrees", "{:.3f}"), ("position", "{:.2%}"), ("wrong", "{}"), ("seconds", "{:.0f}")
                    )),
                ))  # fmt: skip
    lines += [*shared.table(("set", "by", "registered", "degrees", "position", "wrong", "seconds"), rows), ""]
    refused = [(name, entry["ours"]["refused"]) for name, entry in found.items() if "refused" in entry["ours"]]
    if refused:
        lines += ["Refused:", "", *(f"- *{name}*: {' '.join(text.split())}" for name, text in refused), ""]
    stages = [(name, *(f"{entry['ours']['stages'][stage]:.0f}" for stage in _STAGES)) for name, entry in found.items()]
    lines += ["Seconds of the stages:", "", *shared.table(("set", *_STAGES), stages)]
    lines += growth(found)
    return "\n".join(lines).rstrip() + "\n"


def growth(found: Mapping[str, Any]) -> list[str]:
    """Return a sentence on how the seconds grow with the number of photos of the same table, if there are several."""
    sizes = {count: found[name]["ours"] for count in _SIZES if (name := f"{count} photos") in found}
    if len(sizes) < 2:
        return []
    powers = {
        stage: float(np.polyfit(np.log(list(sizes)), np.log([row["stages"][stage] for row in sizes.values()]), 1)[0])
        for stage in _STAGES
        if all(row["stages"][stage] >= 1.0 for row in sizes.values())
    }
    total = float(np.polyfit(np.log(list(sizes)), np.log([row["seconds"] for row in sizes.values()]), 1)[0])
    each = ", ".join(f"{stage.lower()} {power:.1f}" for stage, power in powers.items())
    return [
        "",
        f"From {min(sizes)} to {max(sizes)} photos, the seconds grow with their number to the power of {total:.1f} "
        f"({each}).",
    ]


def _cell(value: Any, form: str) -> str:
    return "" if value is None else form.format(value)


def main() -> None:
    """Measure, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--defaults", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    found: dict[str, Any] = {}
    for name in options.set:
        case = CASES[name]
        if name in ("turntable", "turntable, no masks"):
            _made("panorama")
        try:
            found[name] = {"ours": ours(case)}
        except FileNotFoundError as error:
            print(f"{name} is left out: {error.filename} does not exist")
            continue
        if options.defaults and case.truth() and name not in ("walk", "turntable"):
            found[name]["defaults"] = defaults(case)
        print(name, json.dumps(found[name]), flush=True)
    if options.write:
        stored = documents.FIGURES / "poses.json"
        known = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {}
        found = {name: each for name in CASES if (each := found.get(name) or known.get(name))}
        documents.save("poses", found)
    print(document(found))


if __name__ == "__main__":
    main()
