"""Output of the command line before a command starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

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
