# SPDX-License-Identifier: GPL-3.0-or-later
"""Command line of ObjectGS, for use without a window.

    blender -b -P headless.py -- COMMAND ...
    python headless.py COMMAND ...            (a Python that has the bpy wheel)

`--help` lists the commands; objectgs_addon/headless implements them. Exit codes: 0 done, 2 bad input, 130 cancelled,
1 any other failure.
"""

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parent
OLDEST = (4, 2)
"""The oldest version of Blender that has all that ObjectGS needs, as in blender_manifest.toml."""


def extension() -> ModuleType:
    """Return the extension's root package: the one that Blender loaded from this folder, or else a new `objectgs`.

    A new package is loaded by path, which leaves the module search path unchanged.
    """
    init = ROOT / "__init__.py"
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and Path(file).name == init.name and Path(file).resolve() == init:
            return module
    spec = importlib.util.spec_from_file_location("objectgs", init, submodule_search_locations=[str(ROOT)])
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["objectgs"] = module
    spec.loader.exec_module(module)
    return module


def main(arguments: list[str]) -> int:
    """Run one command line and return the exit code."""
    return importlib.import_module(f"{extension().__name__}.objectgs_addon.headless").main(arguments)


def _arguments() -> list[str]:
    """Return the arguments after `--`, which ends Blender's own; plain Python requires no `--`."""
    if "--" in sys.argv:
        return sys.argv[sys.argv.index("--") + 1 :]
    return sys.argv[1:] if Path(sys.argv[0]).name == Path(__file__).name else []


def _run() -> int:
    """Run the command line of this process and return the exit code.

    Nothing is raised, since Blender would print the exception and end with exit code 0.
    """
    try:
        version = importlib.import_module("bpy").app.version
        if version[:2] < OLDEST:
            needed, own = (".".join(map(str, each)) for each in (OLDEST, version))
            print(f"error: ObjectGS needs Blender {needed} or newer; this is Blender {own}.", file=sys.stderr)
            return 2
        return main(_arguments())
    except Exception:
        traceback.print_exc()
        return 1


if __name__ == "__main__":
    sys.exit(_run())
