# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes of the worker."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .events import Stopped

# The program ends when its input ends, which means that its parent has ended. Programs that it starts have no input: on
# Windows they would wait at their start until that which is being read here ends.
_GUARDED = """\
import os, runpy, sys, threading
parent, nothing = os.dup(0), os.open(os.devnull, os.O_RDONLY)
os.dup2(nothing, 0)
os.close(nothing)
def watch():
    while os.read(parent, 1024):
        pass
    os._exit(1)
threading.Thread(target=watch, daemon=True).start()
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def guarded(python: Path, module: str, *arguments: str) -> list[str]:
    """Return a command line for a module that ends with this process and ignores PYTHON* variables and user folders."""
    return [str(python), "-I", "-u", "-X", "utf8", "-c", _GUARDED, module, *arguments]


def run(
    command: list[str],
    stop: Callable[[], bool],
    on_line: Callable[[str], None],
    on_tick: Callable[[], None] = lambda: None,
    environment: dict[str, str] | None = None,
    first: bytes = b"",
) -> int:
    """Run a program until it ends.

    Args:
        command: program and arguments.
        stop: callback that returns whether to stop.
        on_line: callback for each line from stdout and stderr.
        on_tick: callback that is called several times per second.
        environment: additional environment variables.
        first: first input of the program.

    Returns:
        The exit code.

    Raises:
        Stopped: `stop` returned true; the program was killed.
    """
    # With a process group, a stop also reaches the program's children.
    options: dict[str, Any] = {} if os.name == "nt" else {"process_group": 0}
    child = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, **(environment or {})},
        **options,
    )
    assert child.stdin is not None and child.stdout is not None
    lines: queue.Queue[str | None] = queue.Queue()
    threading.Thread(target=_read_lines, args=(child.stdout, lines), daemon=True).start()
    try:
        child.stdin.write(first)
        child.stdin.flush()
        while True:
            if stop():
                raise Stopped
            try:
                line = lines.get(timeout=0.2)
            except queue.Empty:
                line = ""
            if line is None:
                return child.wait()
            if line:
                on_line(line)
            on_tick()
    finally:
        if child.poll() is None:
            _kill(child)
            child.wait()
        with contextlib.suppress(OSError):
            child.stdin.close()


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End a program and its children, which on Windows include the Python that an environment's python.exe starts."""
    if os.name != "nt":
        os.killpg(child.pid, signal.SIGKILL)
        return
    tree = ["taskkill", "/F", "/T", "/PID", str(child.pid)]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        subprocess.run(tree, stdin=subprocess.DEVNULL, capture_output=True, timeout=5, check=False)
    child.kill()


def _read_lines(stream: Any, lines: queue.Queue[str | None]) -> None:
    """Put the lines of a pipe into a queue, followed by None."""
    with stream:
        for line in stream:
            lines.put(line.decode("utf-8", errors="replace").rstrip())
    lines.put(None)
