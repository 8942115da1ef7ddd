"""The command line: what can be asked, and exit codes. What is done lives in `backend.commands`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from . import __version__
from .protocol import (
    EXIT_BAD_INPUT,
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_FAILED,
    Cancelled,
    InputError,
    JsonReporter,
    Reporter,
)

_OUT = "the reconstruction folder (made if it is not there)"


def parser() -> argparse.ArgumentParser:
    """Every command and option."""
    top = argparse.ArgumentParser(prog="python -m backend", description="From a COLMAP capture to labelled splats.")
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, help: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=help, description=help)
        sub.add_argument("--json", action="store_true", help="print events as JSON lines")
        sub.add_argument("--threads", type=_positive, help="how many processor threads to use (default: all)")
        return sub

    def capture_options(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("capture", type=Path, metavar="CAPTURE", help="folder with images/, sparse/0 and masks/")
        sub.add_argument("--max-size", type=_positive, default=1600, help="reduce images to this longest side (1600)")
        sub.add_argument("--memory-mb", type=_positive, default=2000, help="budget for decoded images (2000)")

    def vote_options(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--out", type=Path, required=True, metavar="DIR", help=_OUT)
        sub.add_argument("--seed", type=int, default=0, help="fixes everything that is drawn at random (0)")
        sub.add_argument(
            "--strategy", choices=("majority", "probability", "correspondence"), default="majority",
            help="how the views' masks decide a point's object (majority)",
        )  # fmt: skip

    check = command("check", "Say what a capture holds and what is wrong with it; writes nothing.")
    capture_options(check)

    vote = command("vote", "Lift the masks to the point cloud: points.ply with an object_id for each point.")
    capture_options(vote)
    vote_options(vote)

    train = command("train", "Train the splats; goes on where an earlier run stopped. Votes first if that is not done.")
    capture_options(train)
    vote_options(train)
    length = train.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=_positive_float, help="train this long in all (default: 5)")
    length.add_argument("--steps", type=_positive, help="train this many steps in all")
    train.add_argument("--mode", choices=("explicit", "view"), default="explicit", help="what the heads see (explicit)")
    train.add_argument("--sh-degree", type=int, choices=(0, 1, 2, 3), default=1, help="of explicit colour (1)")
    train.add_argument("--offsets", type=_positive, help="splats an anchor")
    train.add_argument("--voxel", type=_positive_float, help="edge of an anchor's cell (default: the points' spacing)")
    train.add_argument("--max-anchors", type=_positive, help="growth stops there")
    train.add_argument("--background", choices=("learned", "black", "white"), default="learned")
    train.add_argument("--semantic-weight", type=float, help="weight of the labels (0.1; 0.01 for poor masks)")
    train.add_argument("--unlabelled-is-object", action="store_true", help="teach pixels of ID 0 as a class")
    train.add_argument("--checkpoint-seconds", type=_positive_float, default=30.0, help="time between checkpoints (30)")
    train.add_argument("--restart", action="store_true", help="forget an earlier training in DIR")

    def result(name: str, help: str) -> argparse.ArgumentParser:
        sub = command(name, help)
        sub.add_argument("folder", type=Path, metavar="DIR", help="the reconstruction folder")
        sub.add_argument("--memory-mb", type=_positive, default=2000, help="budget for decoded images (2000)")
        return sub

    render = result("render", "Draw the trained model from the capture's cameras into DIR/renders.")
    render.add_argument("--views", choices=("held-out", "all"), default="held-out")
    render.add_argument("--ids", action="store_true", help="also 16-bit pictures of the object IDs")
    render.add_argument("--depth", action="store_true", help="also depth in world units, .npy")
    result("evaluate", "Measure the model on the held-out views: PSNR, SSIM, mIoU, mBIoU, Dice, accuracy.")
    result("report", "Write report.json and report.md with pictures and error against run time.")
    command("doctor", "Say which versions and devices are there and whether the kernels compile.")
    return top


def _positive(text: str) -> int:
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _positive_float(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


class StopRequest:
    """Set by an interrupt, a termination signal, or a line `stop` on standard input."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def __call__(self) -> bool:
        return self._event.is_set()

    def set(self) -> None:
        """Ask to stop."""
        self._event.set()

    def listen(self, read_stdin: bool) -> None:
        """Take over the signals, and standard input where another program drives this one."""

        def on_signal(number, frame):
            if self._event.is_set():
                raise KeyboardInterrupt
            self._event.set()

        signal.signal(signal.SIGINT, on_signal)
        signal.signal(signal.SIGTERM, on_signal)
        if read_stdin:

            def wait() -> None:
                for line in sys.stdin:
                    if line.strip() == "stop":
                        self._event.set()

            threading.Thread(target=wait, daemon=True).start()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = parser().parse_args(arguments)
    if options.json:
        reporter: Reporter = JsonReporter()
    else:
        from .console import ConsoleReporter

        reporter = ConsoleReporter()
    stop = StopRequest()
    try:
        if threading.current_thread() is threading.main_thread():
            stop.listen(read_stdin=options.json)
        from . import commands

        commands.set_threads(options.threads)
        getattr(commands, options.command)(options, reporter, stop)
        return EXIT_DONE
    except InputError as error:
        reporter.error(str(error))
        return EXIT_BAD_INPUT
    except (Cancelled, KeyboardInterrupt) as error:
        reporter.status(str(error) or "Stopped.")
        return EXIT_CANCELLED
    except MemoryError:
        reporter.error("There is not enough memory; try a smaller --max-size or --memory-mb.")
        return EXIT_FAILED
    except Exception as error:
        import traceback

        reporter.error(f"An unexpected failure: {type(error).__name__}: {error}")
        traceback.print_exc(file=sys.stderr)
        return EXIT_FAILED
    finally:
        if hasattr(reporter, "close"):
            reporter.close()
