# SPDX-License-Identifier: GPL-3.0-or-later
"""ObjectGS without a window.

    blender -b -P headless.py -- demo OUT
    python headless.py demo OUT            (a Python that has the bpy wheel)

Exit codes: 0 done, 2 bad input (one sentence says what), 130 cancelled, 1 anything else.
"""

import argparse
import importlib
import importlib.util
import signal
import sys
import traceback
from pathlib import Path


ROOT = Path(__file__).resolve().parent


def extension():
    """The extension's root package: the one Blender has loaded from this folder, or else loaded as `objectgs`.

    Loaded by its place, so Blender's module search path stays as it is.
    """
    init = ROOT / "__init__.py"
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and getattr(module, "__path__", None) and Path(file).name == init.name and Path(file).resolve() == init:
            return module
    spec = importlib.util.spec_from_file_location("objectgs", init, submodule_search_locations=[str(ROOT)])
    module = importlib.util.module_from_spec(spec)
    sys.modules["objectgs"] = module
    spec.loader.exec_module(module)
    return module


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="headless.py", description="ObjectGS without a window.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser("demo", help="render the demo capture", description=(
        "Render the built-in demo capture: objects on a table, with masks, a sparse model and the truth."))
    demo.add_argument("out", metavar="OUT", help="folder to make")
    demo.add_argument("--objects", type=int, default=8, help="objects on the table, 1 to 60 (default 8)")
    demo.add_argument("--views", type=int, default=48, help="pictures on two rings (default 48)")
    demo.add_argument("--width", type=int, default=320, help="pixels (default 320)")
    demo.add_argument("--height", type=int, default=240, help="pixels (default 240)")
    demo.add_argument("--seed", type=int, default=0, help="same seed, same capture (default 0)")
    demo.add_argument("--mask-noise", type=float, default=0.0, metavar="X", help=(
        "mistakes in masks/, 0 (none, default) to 1 (poor): borders wander up to 4X pixels; an object of a view is "
        "1-3 pixels too large or small with probability X, has a wrong ID with 0.15 X, is missing with 0.10 X"))
    demo.add_argument("--samples", type=int, default=20, help="rays a pixel at most, denoised (default 20)")
    demo.add_argument("--overwrite", action="store_true", help="replace a demo capture with other settings in OUT")
    return parser


def _demo(options) -> None:
    import bpy

    demo_capture = importlib.import_module(f"{extension().__name__}.objectgs_addon.demo_capture")
    if bpy.app.background:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    settings = demo_capture.Settings(
        objects=options.objects, views=options.views, width=options.width, height=options.height, seed=options.seed,
        mask_noise=options.mask_noise, samples=options.samples)
    demo_capture.make(options.out, settings, options.overwrite, report=lambda line: print(line, flush=True))


def _stop(*_):
    raise KeyboardInterrupt


def main(arguments: list[str]) -> int:
    """Run one command line and return the exit code."""
    options = _parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, _stop)
    try:
        {"demo": _demo}[options.command](options)
    except KeyboardInterrupt:
        print("Cancelled.", file=sys.stderr)
        return 130
    except Exception as error:
        if type(error).__name__ == "Cancelled":
            print("Cancelled.", file=sys.stderr)
            return 130
        if type(error).__name__ == "DemoError":
            print(error, file=sys.stderr)
            return 2
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    if "--" in sys.argv:
        _arguments = sys.argv[sys.argv.index("--") + 1:]
    else:
        _arguments = sys.argv[1:]
    sys.exit(main(_arguments))
