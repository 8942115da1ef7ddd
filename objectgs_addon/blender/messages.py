# SPDX-License-Identifier: GPL-3.0-or-later
"""Messages from timers, handlers and properties, which cannot report through an operator.

The ObjectGS tab and the status bar show the latest one until the user dismisses it.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass, field
from typing import Any

import bpy

_MOST = 20
"""Number of messages that are kept; older ones are only in the console."""


@dataclass(frozen=True)
class Message:
    """A message to the user.

    Attributes:
        text: one or more sentences.
        kind: INFO or ERROR.
        operator: operator that helps, or None.
        label: text of its button; empty for none.
        options: properties of the operator.
    """

    text: str
    kind: str = "INFO"
    operator: str | None = None
    label: str = ""
    options: dict[str, Any] = field(default_factory=dict)


_messages: list[Message] = []


def sentence(error: Exception) -> str:
    """Format an error as a sentence; for an OSError, include the file's name and a suggested remedy."""
    if not isinstance(error, OSError):
        return str(error)
    what = error.filename or "A file"
    full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
    advice = "free some space and try again" if full else "check it and its permissions"
    return f"{what} cannot be read or written ({error.strerror or error}); {advice}."


def show(text: str, kind: str = "INFO", operator: str | None = None, label: str = "", **options: Any) -> None:
    """Print a message to the console and, unless in background mode, show it until it is dismissed.

    The arguments are those of `Message`. A message that is already there moves to the front.
    """
    print(f"ObjectGS: {text}", flush=True)
    if bpy.app.background:
        return
    _messages[:] = [message for message in _messages if message.text != text][1 - _MOST :]
    _messages.append(Message(text, kind, operator, label, options))


def latest() -> Message | None:
    """Return the latest message that is not dismissed, or None."""
    return _messages[-1] if _messages else None


def count() -> int:
    """Return the number of messages that are not dismissed."""
    return len(_messages)


def dismiss() -> None:
    """Remove the latest message."""
    if _messages:
        _messages.pop()


def withdraw(text: str) -> None:
    """Remove a message that no longer applies."""
    _messages[:] = [message for message in _messages if message.text != text]


def settle(title: str, operator: str | None, **options: Any) -> None:
    """Remove the messages about failures that a later success has settled.

    Args:
        title: title of the job that succeeded.
        operator: operator that the failures of such jobs offer, or None.
        options: properties that the operator must have.
    """
    _messages[:] = [
        message
        for message in _messages
        if message.operator is None
        or not (
            message.text.startswith(f"{title}: ")
            or (message.operator == operator and options.items() <= message.options.items())
        )
    ]


def clear() -> None:
    """Remove all messages."""
    _messages.clear()
