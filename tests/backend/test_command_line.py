"""Output of the command line before a command starts."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from backend.cli.parser import build_parser

HEAVY = {"torch", "numba", "pycolmap", "scipy", "PIL"}


@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["--version"]])
def test_help_and_version_import_no_compute_packages(words):
    code = (
        "import sys\n"
        "from backend.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "finally:\n    print(*sys.modules, file=sys.stderr)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=Path(__file__).parents[2], capture_output=True, text=True
    )
    assert ran.returncode == 0 and ran.stdout
    assert not HEAVY & set(ran.stderr.split())


@pytest.mark.parametrize(("system", "value"), [("darwin", "TRUE"), ("linux", None), ("win32", None)])
def test_torch_and_pycolmap_may_each_have_an_openmp_on_macos(system, value):
    """Their wheels contain one each, and the second that starts would end the process."""
    code = f"import os, sys; sys.platform = {system!r}; import backend; print(os.environ.get('KMP_DUPLICATE_LIB_OK'))"
    environment = {name: text for name, text in os.environ.items() if name != "KMP_DUPLICATE_LIB_OK"}
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True
    )
    assert ran.stdout == f"{value}\n", ran.stderr


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["edit", "d", "--remove", "mug", "--remove", "can"], "remove"),
        (["mesh", "d", "--objects", "mug", "--objects", "can"], "objects"),
        (["train", "c", "--out", "d", "--only", "mug", "--only", "can"], "only"),
    ],
)
def test_repeated_options_add_to_each_other(words, name):
    assert vars(build_parser().parse_args(words))[name] == ["mug", "can"]
    assert vars(build_parser().parse_args(words[:-2]))[name] == ["mug"], "the default is unchanged"
