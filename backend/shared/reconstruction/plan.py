"""What is done for a capture and what is left out, and why: plan.json, which the commands write and Blender shows.

    {"decisions": [{"key": "exposure", "what": "undoing of exposure and white balance", "planned": false, "done": false,
                    "why": "the photos agree about their points within 0.4 %; it is undone from 2.0 % on",
                    "can_override": true, "views": []}, ...]}

Standard library only, so that Blender's own Python can import it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..formats.json_file import read_json, write_json

KEYS = (
    "votes", "objects", "groups", "rest", "labels", "undistortion", "duplicate-views", "blind-views", "other-views",
    "unseen-points", "exposure", "pyramid", "meshes", "surface",
)  # fmt: skip
"""What is decided about, in this order."""

EVERYTHING = "all"
"""As a key to keep: whatever can be done."""


@dataclass(frozen=True)
class Decision:
    """Whether something is needed, and why.

    key: its name on the command line; planned: whether it is needed (None: only known later), why: in a part of a
    sentence, with the figure that it rests on; done: what the user wants, else as planned; can_override: whether that
    may differ; views: the names of the views that it is about, where it is about some only.
    """

    key: str
    what: str
    planned: bool | None
    why: str
    can_override: bool = True
    views: tuple[str, ...] = ()
    wanted: bool | None = None

    @property
    def done(self) -> bool | None:
        return self.planned if self.wanted is None else self.wanted

    @property
    def overridden(self) -> bool:
        """Whether the user has it otherwise than planned."""
        return self.done != self.planned

    @property
    def reason(self) -> str:
        """Why it is as it is."""
        option = "--keep" if self.done else "--leave-out"
        return f"{option} {self.key} was asked for" if self.overridden else self.why

    def sentence(self) -> str:
        """For people: what becomes of it and why."""
        verdict = {True: "Done", False: "Left out", None: "Known later"}[self.done]
        return f"{verdict}: {self.what}, since {self.reason}"


@dataclass(frozen=True)
class Plan:
    """All decisions about one capture."""

    decisions: tuple[Decision, ...] = ()

    def __getitem__(self, key: str) -> Decision | None:
        return next((decision for decision in self.decisions if decision.key == key), None)

    def does(self, key: str) -> bool:
        """Whether something is done; so is what nothing was decided about."""
        decision = self[key]
        return decision is None or decision.done is not False

    @property
    def left_out(self) -> tuple[Decision, ...]:
        """What is not done."""
        return tuple(decision for decision in self.decisions if decision.done is False)

    @property
    def views_left_out(self) -> frozenset[str]:
        """The names of the views that are not trained on."""
        return frozenset(name for decision in self.left_out for name in decision.views)

    def overridden(self, keep: Iterable[str], leave_out: Iterable[str]) -> Plan:
        """The plan with what the user wants otherwise; `EVERYTHING` among `keep` is whatever can be done.

        InputError where a decision cannot be overridden. What is as wanted already stays as it is.
        """
        keep, leave_out = set(keep), set(leave_out)
        if both := sorted(keep & leave_out):
            raise InputError(f"--keep and --leave-out both name {both[0]}; choose one of them.")
        return Plan(tuple(_overridden(decision, keep, leave_out) for decision in self.decisions))

    def settled_by(self, other: Plan) -> Plan:
        """The plan where what is not decided yet is as another plan of the same capture has it."""
        return Plan(tuple((other[own.key] or own) if own.done is None else own for own in self.decisions))

    def difference(self, other: Plan, keys: Iterable[str]) -> list[str]:
        """Those of `keys` that one plan does and the other leaves out."""
        return [key for key in keys if self.does(key) != other.does(key)]

    def as_list(self) -> list[dict[str, Any]]:
        """For JSON."""
        return [
            {
                "key": own.key, "what": own.what, "planned": own.planned, "done": own.done, "why": own.why,
                "can_override": own.can_override, "views": list(own.views),
            }
            for own in self.decisions
        ]  # fmt: skip

    @classmethod
    def of(cls, entries: Iterable[Mapping[str, Any]]) -> Plan:
        """The plan that `as_list` gave; KeyError or TypeError where it is none."""
        return cls(
            tuple(
                Decision(
                    str(entry["key"]), str(entry["what"]), _verdict(entry["planned"]), str(entry["why"]),
                    bool(entry["can_override"]), tuple(map(str, entry["views"])),
                    None if entry["done"] == entry["planned"] else _verdict(entry["done"]),
                )
                for entry in entries
            )
        )  # fmt: skip


def _overridden(decision: Decision, keep: set[str], leave_out: set[str]) -> Decision:
    named = decision.key in keep or decision.key in leave_out
    if not named and not (EVERYTHING in keep and decision.can_override):
        return decision
    wanted = decision.key not in leave_out
    if wanted != decision.planned and not decision.can_override:
        option = "--keep" if wanted else "--leave-out"
        raise InputError(f"{option} {decision.key} is not possible: {decision.why}.")
    return replace(decision, wanted=wanted)


def _verdict(value: Any) -> bool | None:
    if value is None or isinstance(value, bool):
        return value
    raise TypeError(f"{value!r} is no decision")


def write_plan(path: Path, plan: Plan) -> None:
    """Write plan.json, atomically."""
    write_json(path, {"decisions": plan.as_list()})


def read_plan(path: Path) -> Plan:
    """Read plan.json; InputError that names the file where it is missing or was not written by this program."""
    content = read_json(path)
    try:
        return Plan.of(content["decisions"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} was not written by this program ({error!r}); run the plan again.") from error
