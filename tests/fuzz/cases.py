"""Random cases: a damaged input or an odd command line, and the command that is given it."""

from __future__ import annotations

import argparse
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backend.cli.parser import build_parser

from .mutations import NUMBERS, TEXTS, mutate_bytes, mutation_for, npz_bomb, png_bomb
from .templates import SHORT_TRAINING, Templates


@dataclass
class Case:
    """A command to run in a folder of its own.

    Attributes:
        kind: name of the generator.
        what: what was done to the input.
        arguments: the command line.
        writes: entries of the folder that the command may create and change; everything else must stay as it is.
        keeps: entries in `writes` that belong to someone else.
        named: a word that a refusal must contain.
    """

    kind: str
    what: str
    arguments: list[Any]
    writes: tuple[str, ...] = ("out",)
    keeps: tuple[str, ...] = ()
    named: str | None = None


Generator = Callable[[Path, Templates, random.Random], Case]


def make_case(seed: int, folder: Path, templates: Templates) -> Case:
    """Write the input of the case with this number to `folder`, among files that belong to others."""
    rng = random.Random(seed)
    folder.mkdir(parents=True)
    (folder / "thesis.txt").write_text("not yours")
    (folder / "others" / "out").mkdir(parents=True)
    (folder / "others" / "out" / "points.ply").write_bytes(b"not yours")
    generators, weights = zip(*GENERATORS.items())
    return rng.choices(generators, weights)[0](folder, templates, rng)


def damaged_capture(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Damage one to three files of a capture, then import it, vote, plan, train or check."""
    capture = folder / "capture"
    shutil.copytree(rng.choice(templates.captures), capture)
    files = sorted(path for path in capture.rglob("*") if path.is_file())
    # Every kind of file alike, although there are more images than anything else.
    kinds = sorted({(path.parent.name, path.suffix, path.name[:2]) for path in files})
    what = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        kind = rng.choice(kinds)
        path = rng.choice([path for path in files if (path.parent.name, path.suffix, path.name[:2]) == kind])
        if path.is_file():
            what.append(_damage(path, rng))
    command = rng.choice(("check", "import", "vote", "plan", "train", "train"))
    arguments: list[Any] = [command, capture]
    if command not in ("check", "plan"):
        arguments += ["--out", folder / rng.choice(("out", "new/out", "new/deep/out"))]
    if command == "train":
        arguments += SHORT_TRAINING
    if command == "vote":
        arguments += ["--strategy", rng.choice(("majority", "probability", "correspondence"))]
    return Case("damaged capture", "; ".join(what), arguments, writes=("out", "new"))


def odd_capture(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Make numbers of a capture extreme without damaging its format, then train."""
    capture = folder / "capture"
    shutil.copytree(templates.captures[1], capture)
    what = []
    for _ in range(rng.choice((1, 1, 4, 40))):
        path = capture / "sparse" / "0" / rng.choice(("cameras.txt", "images.txt", "points3D.txt", "points3D.txt"))
        lines = path.read_text().split("\n")
        rows = [i for i, line in enumerate(lines) if line and not line.startswith("#")]
        at = rng.choice(rows)
        words = lines[at].split(" ")
        column = rng.randrange(1, min(len(words), 10))
        words[column] = rng.choice((*NUMBERS[:14], str(rng.uniform(-1e6, 1e6))))
        what.append(f"{path.name} {at + 1}:{column} = {words[column]}")
        lines[at] = " ".join(words)
        path.write_text("\n".join(lines))
    arguments = [rng.choice(("train", "train", "plan", "vote", "check")), capture]
    if arguments[0] not in ("check", "plan"):
        arguments += ["--out", folder / "out"]
    if arguments[0] == "train":
        arguments += [*SHORT_TRAINING, "--primitive", rng.choice(("3d", "2d"))]
    return Case("odd numbers in a capture", "; ".join(what)[:300], arguments)


def damaged_masks(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Replace masks or photos by other kinds of files: bombs, arrays, pipes, folders, links."""
    capture = folder / "capture"
    shutil.copytree(templates.captures[0], capture)
    path = rng.choice(sorted((capture / rng.choice(("masks", "images"))).iterdir()))
    path.unlink()
    kind = rng.choice(("png", "npz", "npy", "pipe", "folder", "loop", "absent", "zero", "deep", "labels", "split"))
    if kind == "png":
        path.write_bytes(png_bomb(*rng.choice(((40_000, 40_000), (65_535, 1), (3, 500_000), (13_000, 13_000)))))
    elif kind == "npz":
        path.with_suffix(".npz").write_bytes(npz_bomb(rng.choice((1 << 20, 1 << 26, 3 << 28))))
    elif kind == "npy":
        header = b"\x93NUMPY\x01\x00v\x00{'descr': '<i8', 'fortran_order': False, 'shape': (900000000, 90), }"
        path.with_suffix(".npy").write_bytes(header.ljust(127) + b"\n" + rng.randbytes(200))
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "deep":
        path.with_suffix(".npy").write_bytes(b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535)
    elif kind == "labels":
        shutil.copyfile(templates.captures[0] / "images" / path.name, path)
        (capture / "labels.json").write_bytes(mutation_for("a.json")(b'{"1": "mug", "2": "box"}', rng))
    elif kind == "split":
        shutil.copyfile(templates.captures[0] / "images" / path.name, path)
        names = b"".join(b"view_%03d.png\n" % i for i in rng.sample(range(9), rng.randrange(10)))
        (capture / "test.txt").write_bytes(mutation_for("a.txt")(names, rng) if rng.random() < 0.7 else names)
    arguments = [rng.choice(("check", "import", "train")), capture]
    if arguments[0] != "check":
        arguments += ["--out", folder / "out"]
    if arguments[0] == "train":
        arguments += SHORT_TRAINING
    return Case("odd files in a capture", f"{path.parent.name}/{path.name}: {kind}", arguments)


def damaged_reconstruction(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Damage a file of a reconstruction, then run a command on it."""
    out = folder / "out"
    shutil.copytree(templates.trained, out)
    (out / "notes.txt").write_text("not yours")
    (out / "scenes").mkdir()
    (out / "scenes" / "my.blend").write_bytes(b"not yours")
    files = sorted(path for path in out.rglob("*") if path.is_file() and path.name != "notes.txt")
    top = [path for path in files if path.parent in (out, out / "checkpoint") or path.suffix in (".json", ".ply")]
    path = rng.choice(top if rng.random() < 0.9 else files)
    what = _damage(path, rng)
    if rng.random() < 0.1 and (second := rng.choice(top)).is_file():
        what += "; " + _damage(second, rng)
    return Case(
        "damaged reconstruction", what, _command_for(folder, templates, rng), writes=("out", "made"),
        keeps=("out/notes.txt", "out/scenes"),
    )  # fmt: skip


def _command_for(folder: Path, templates: Templates, rng: random.Random) -> list[Any]:
    """Return a command on the reconstruction `out`."""
    out, made = folder / "out", folder / "made"
    command = rng.choice(("train", "train", "vote", "render", "mesh", "edit", "export", "film", "evaluate", "report"))
    return {
        "train": ["train", templates.captures[0], "--out", out, "--steps", 14, "--offsets", 3,
                  *rng.choice(([], ["--restart"]))],
        "vote": ["vote", templates.captures[0], "--out", out],
        "render": ["render", out],
        "mesh": ["mesh", out, "--objects", 1, "--faces", 150, "--texture-size", 256, *rng.choice(([], ["--restart"]))],
        "edit": ["edit", out, *rng.choice((["--remove", "1", "--fill"], ["--reset", "all"], ["--move", "2:x=1"]))],
        "export": ["export", out, "--out", made / f"splats.{rng.choice(('ply', 'spz', 'splat', 'glb', 'usdc'))}"],
        "film": ["film", out, "--shot", templates.shot, "--out", made],
        "evaluate": ["evaluate", out],
        "report": ["report", out],
    }[command]  # fmt: skip


def damaged_splats(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Damage splats of another program, then import them."""
    splats = folder / "point_cloud.ply"
    shutil.copyfile(templates.splats, splats)
    what = _damage(splats, rng)
    capture = ["--capture", templates.captures[0]] if rng.random() < 0.3 else []
    arguments = ["import-splats", splats, "--out", folder / "out", *capture]
    return Case("damaged splats", what, arguments, named="point_cloud.ply" if not capture else None)


def damaged_shot(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Damage a shot file, then render it."""
    shot = folder / "shot.json"
    shutil.copyfile(templates.shot, shot)
    what = _damage(shot, rng)
    arguments = ["film", templates.trained, "--shot", shot, "--out", folder / "made"]
    return Case("damaged shot", what, arguments, writes=("made",), named="shot.json")


def odd_arguments(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Run a command with random options and values."""
    parsers = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    name = rng.choice(sorted(set(parsers) - {"doctor"}))
    out = folder / "out"
    if name not in ("check", "import", "vote", "plan", "import-splats", "film"):
        shutil.copytree(templates.trained, out)
    arguments: list[Any] = [name]
    for action in parsers[name]._actions:
        if not action.option_strings:
            inputs = {"folder": out if out.exists() else templates.trained, "splats": templates.splats}
            arguments.append(inputs.get(action.dest, templates.captures[0]))
    chosen = [action for action in parsers[name]._actions if action.option_strings and action.dest != "help"]
    for action in chosen:
        fixed = {"out": folder / ("made" if name in ("film", "export") else "out"), "steps": 3, "shot": templates.shot}
        if action.dest == "json":
            continue
        if action.dest in fixed and (action.required or rng.random() < 0.9):
            arguments += [action.option_strings[-1], fixed[action.dest]]
        elif action.dest not in fixed and rng.random() < 0.25:
            arguments += [action.option_strings[-1], *_values(action, rng)]
    if name == "train" and "--steps" not in arguments:
        arguments += ["--steps", 3]
    if rng.random() < 0.15:
        arguments.insert(rng.randrange(len(arguments) + 1), _argument(rng.choice(TEXTS)))
    return Case("odd arguments", " ".join(map(str, arguments))[:300], arguments, writes=("out", "made"))


def _values(action: argparse.Action, rng: random.Random) -> list[str]:
    """Return words for an option: mostly such as it takes, some that it does not."""
    if action.nargs == 0:
        return []
    words = [
        *NUMBERS, *TEXTS, "0.5", "1", "2", "3", "7", "100", "sphere", "sphere 1", "1:hue=0.1", "1:x=1e300",
        "2:scale=1e-300", "a=1,2", "1:tint=#ff0000", "1-2", "all", "1:rx=90,ry=1e308", "5",
    ]  # fmt: skip
    if action.choices and rng.random() < 0.8:
        words = [str(choice) for choice in action.choices]
    count = rng.choice((1, 1, 2, 5)) if action.nargs == "+" else 1
    return [_argument(rng.choice(words)) for _ in range(count)]


def _argument(text: str) -> str:
    """Return the text as an operating system passes it: without zero bytes, at most 100,000 characters, and with bytes
    that are not UTF-8 as Python represents them."""
    return text.replace("\0", "0").replace("\ud800", "\udcff")[:100_000]


def numerics(folder: Path, templates: Templates, rng: random.Random) -> Case:
    """Train 200 steps on an extreme capture: points in one place, thousands of IDs, the largest ID, images of 1x1."""
    import numpy as np

    from tests.backend.conftest import write_scene

    capture = folder / "capture"
    kind = rng.choice(("one place", "many objects", "largest ID", "1x1", "far", "tiny", "line"))
    size = (1, 1) if kind == "1x1" else (32, 24)
    spheres = [(1, (0.0, 0.0, 0.0), 0.5), (2, (0.9, 0.0, 0.0), 0.4)]
    scene = write_scene(capture, views=4, size=size, points=30, suffix=".txt", spheres=spheres)
    if kind in ("many objects", "largest ID"):
        for number, path in enumerate(sorted((capture / "masks").iterdir())):
            ids = scene.ids[number].astype(np.uint32)
            if kind == "many objects":
                ids = (np.arange(ids.size, dtype=np.uint32).reshape(ids.shape) * 85) % 65_536
            else:
                ids[ids == 2] = 4_294_967_295
            path.unlink()
            np.savez_compressed(path.with_suffix(".npz"), ids=ids)
    points = capture / "sparse" / "0" / "points3D.txt"
    factor = {"one place": (0, 0, 0), "far": (1e6,) * 3, "tiny": (1e-4,) * 3, "line": (1, 0, 0)}.get(kind)
    if factor:
        lines = []
        for line in points.read_text().split("\n"):
            words = line.split(" ")
            if line and not line.startswith("#"):
                words[1:4] = [repr(float(word) * by) for word, by in zip(words[1:4], factor)]
            lines.append(" ".join(words))
        points.write_text("\n".join(lines))
    arguments = ["train", capture, "--out", folder / "out", "--steps", 200, "--offsets", 3,
                 "--primitive", rng.choice(("3d", "2d")), "--mode", rng.choice(("explicit", "view"))]  # fmt: skip
    return Case("200 steps on extremes", kind, arguments)


def _damage(path: Path, rng: random.Random) -> str:
    """Damage a file; returns what was done."""
    kind = rng.random()
    if kind < 0.04:
        path.unlink()
        return f"{path.name} removed"
    if kind < 0.06:
        path.unlink()
        path.mkdir()
        return f"{path.name} is a folder"
    if kind < 0.07:
        path.unlink()
        os.mkfifo(path)
        return f"{path.name} is a pipe"
    mutate = mutate_bytes if kind < 0.2 else mutation_for(path.name)
    path.write_bytes(mutate(path.read_bytes(), rng))
    return f"{path.name} changed"


GENERATORS: dict[Generator, int] = {
    damaged_capture: 25,
    odd_capture: 12,
    damaged_masks: 8,
    damaged_reconstruction: 30,
    damaged_splats: 8,
    damaged_shot: 7,
    odd_arguments: 15,
    numerics: 1,
}
"""The generators and how often each is chosen."""
