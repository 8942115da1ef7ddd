"""The documents of docs/ and the figures in README, made from the figures that the benchmarks measured.

    python benchmarks/documents.py [--check]

A benchmark with --write leaves what it measured in docs/figures/NAME.json and makes its document of it. This program
makes all documents anew from these files; with --check, it changes nothing and names the documents that differ, with
exit code 1. docs/results.md and the figures in README have texts of their own, in benchmarks/templates.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

DOCS, README = ROOT / "docs", ROOT / "README.md"
FIGURES, TEMPLATES = DOCS / "figures", Path(__file__).with_name("templates")

MADE_FROM_FIGURES = {
    "ablations": "benchmarks.ablations:document",
    "cells": "benchmarks.cells:document",
    "gpu": "benchmarks.gpu_costs:document",
    "length": "benchmarks.length:document",
    "mask-noise": "benchmarks.mask_noise:document",
    "objects": "benchmarks.objects:document",
    "pointing": "benchmarks.pointing:document",
    "poses": "benchmarks.poses:document",
    "reliability": "tests.fuzz.report:document",
    "scale": "benchmarks.scale:document",
    "stability": "benchmarks.stability:document",
    "suite": "benchmarks.suite:document",
}
"""Name of figures and document -> the function that returns the document's text for the figures."""

WRITTEN_WHOLE = ("error-against-time", "plan")
"""Documents whose text alone is kept: docs/figures/NAME.json has its digest, as the benchmark wrote it."""

_QUOTED = re.compile(r"(?<=<!-- figures -->\n).*?(?=\n<!-- end of figures -->)", re.DOTALL)
_DIGITS = 6


def save(name: str, figures: Mapping[str, Any]) -> None:
    """Write docs/figures/NAME.json, and all documents that depend on it."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_rounded(figures), indent=1, ensure_ascii=False)
    (FIGURES / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    for path, content in documents().items():
        path.write_text(content, encoding="utf-8")


def save_text(name: str, text: str) -> None:
    """Write a document of WRITTEN_WHOLE, and its digest."""
    (DOCS / f"{name}.md").write_text(text, encoding="utf-8")
    save(name, {"sha256": hashlib.sha256(text.encode()).hexdigest()})


def load(name: str) -> dict[str, Any]:
    """Return the figures NAME."""
    return json.loads((FIGURES / f"{name}.json").read_text(encoding="utf-8"))


def documents() -> dict[Path, str]:
    """Return path -> text of every document whose figures are there."""
    known = {path.stem for path in FIGURES.glob("*.json")}
    made = {}
    for name, maker in MADE_FROM_FIGURES.items():
        if name in known:
            module, function = maker.split(":")
            made[DOCS / f"{name}.md"] = getattr(importlib.import_module(module), function)(load(name))
    from benchmarks import quoted

    if known >= set(quoted.SOURCES):
        values = quoted.values({name: load(name) for name in quoted.SOURCES})
        made[DOCS / "results.md"] = filled("results.md", values)
        quotes = filled("readme.md", values).rstrip()
        made[README] = _QUOTED.sub(lambda _: quotes, README.read_text(encoding="utf-8"))
    return made


def filled(template: str, values: Mapping[str, str]) -> str:
    """Return a text of benchmarks/templates with the values in the place of {names}.

    Raises:
        KeyError: a value is missing.
    """
    return (TEMPLATES / template).read_text(encoding="utf-8").format_map(values)


def differing() -> list[str]:
    """Return the documents that are not as the figures make them, as paths below the repository."""
    found = [path for path, text in documents().items() if path.read_text(encoding="utf-8") != text]
    for name in WRITTEN_WHOLE:
        digest = hashlib.sha256((DOCS / f"{name}.md").read_bytes()).hexdigest()
        if load(name)["sha256"] != digest:
            found.append(DOCS / f"{name}.md")
    return [path.relative_to(ROOT).as_posix() for path in found]


def _rounded(value: Any) -> Any:
    """Round the floats in a JSON value to _DIGITS significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, Mapping):
        return {str(key): _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value


def main() -> int:
    """Make or check the documents."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    if parser.parse_args().check:
        different = differing()
        print("\n".join(different) or "All documents are as their figures make them.")
        return bool(different)
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
