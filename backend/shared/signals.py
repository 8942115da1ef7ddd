"""Signals that stop a command, held back while its packages are imported."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

STOPPING = (signal.SIGINT, signal.SIGTERM)


def block_signals() -> None:
    """Hold the stopping signals back until `held_signals` ends; does nothing on Windows."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)


def ignore_signals() -> None:
    """Ignore the stopping signals from now on. Blocking them would not do, since other threads receive them too."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def held_signals() -> Iterator[None]:
    """Hold the stopping signals back; at the end, those that have arrived are delivered to the handlers of then.

    Otherwise an interrupt during an import may be swallowed by it or leave a package half imported.
    """
    block_signals()
    try:
        yield
    finally:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
