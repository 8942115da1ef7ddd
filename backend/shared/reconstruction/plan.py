"""plan.json: which steps are done for a capture, which are omitted, and why; the commands write it, Blender shows it.

{"decisions": [{"key": "exposure", "what": "exposure and white balance correction", "planned": false, "done": false,
                "why": "the photos show the same points with a difference in brightness or color of 0.4%; ...",
                "can_override": true, "views": []}, ...]}
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..formats.json_file import read_json, write_json

KEYS = (
    "votes", "objects", "groups", "plane-points", "surroundings", "rest", "labels", "undistortion", "duplicate-views",
    "blind-views", "blurred-views", "other-views", "validation-views", "unseen-points", "dense-points", "exposure",
    "pyramid", "meshes", "surface",
)  # fmt: skip
"""Keys of the decisions, in the order in which they are made."""

EVERYTHING = "all"
"""Key for --keep that stands for every step that can be done."""


@dataclass(frozen=True)
class Decision:
    """The decision whether to do a step, with its reason.

    Attributes:
        key: name on the command line.
        what: the step, as a noun phrase.
        planned: whether the step is needed; None if this is only known later.
        why: the reason as a clause, with the figure that it is based on.
        can_override: whether the user may override the plan.
        views: names of the views concerned, if the decision is about some views only.
        wanted: the user's override, or None.
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
        """Whether the step is done: the user's override, or else the plan."""
        return self.planned if self.wanted is None else self.wanted

    @property
    def overridden(self) -> bool:
        """Whether the user's choice differs from the plan."""
        return self.done != self.planned

    @property
    def reason(self) -> str:
        """The reason for `done` as a clause."""
        option = "--keep" if self.done else "--leave-out"
        return f"{option} {self.key} was given" if self.overridden else self.why

    def sentence(self) -> str:
        """Return the decision and its reason as a sentence for the user."""
        verdict = {True: "Planned", False: "Left out", None: "Decided later"}[self.done]
        return f"{verdict}: {self.what}, since {self.reason}"


@dataclass(frozen=True)
class Plan:
    """All decisions about a capture."""

    decisions: tuple[Decision, ...] = ()

    def __getitem__(self, key: str) -> Decision | None:
        return next((decision for decision in self.decisions if decision.key == key), None)

    def planned(self, key: str) -> Decision | None:
        """Return a decision without the user's override."""
        decision = self[key]
        return None if decision is None else replace(decision, wanted=None)

    def does(self, key: str) -> bool:
        """Return whether a step is done; True if there is no decision about it."""
        decision = self[key]
        return decision is None or decision.done is not False

    @property
    def left_out(self) -> tuple[Decision, ...]:
        """Decisions to omit a step."""
        return tuple(decision for decision in self.decisions if decision.done is False)

    @property
    def views_left_out(self) -> frozenset[str]:
        """Names of the views that are excluded from training."""
        return frozenset(name for decision in self.left_out for name in decision.views)

    @property
    def validation_views(self) -> tuple[str, ...]:
        """Names of the views that decide when a training until convergence ends."""
        decision = self["validation-views"]
        return decision.views if decision is not None and decision.done is False else ()

    def without(self, key: str) -> Plan:
        """Return the plan without a decision, which is to be made anew."""
        return Plan(tuple(decision for decision in self.decisions if decision.key != key))

    def revised(self, key: str, planned: bool, why: str) -> Plan:
        """Return the plan with a decision that later facts changed; the user's override stays."""
        changed = (replace(own, planned=planned, why=why) if own.key == key else own for own in self.decisions)
        return Plan(tuple(changed))

    def overridden(self, keep: Iterable[str], leave_out: Iterable[str]) -> Plan:
        """Return the plan with the user's overrides.

        Args:
            keep: Keys of steps to do; `EVERYTHING` stands for all that can be overridden.
            leave_out: Keys of steps to omit.

        Raises:
            InputError: A key is in both, or an override contradicts a decision that cannot be overridden.
        """
        keep, leave_out = set(keep), set(leave_out)
        if both := sorted(keep & leave_out):
            raise InputError(f"--keep and --leave-out both name {both[0]}; choose one of them.")
        return Plan(tuple(_overridden(decision, keep, leave_out) for decision in self.decisions))

    def settled_by(self, other: Plan) -> Plan:
        """Return the plan with open decisions taken from another plan of the same capture."""
        return Plan(tuple((other[own.key] or own) if own.done is None else own for own in self.decisions))

    def difference(self, other: Plan, keys: Iterable[str]) -> list[str]:
        """Return those of `keys` that one plan does and the other omits."""
        return [key for key in keys if self.does(key) != other.does(key)]

    def as_list(self) -> list[dict[str, Any]]:
        """Return the decisions as a list for JSON."""
        return [
            {
                "key": own.key, "what": own.what, "planned": own.planned, "done": own.done, "why": own.why,
                "can_override": own.can_override, "views": list(own.views),
            }
            for own in self.decisions
        ]  # fmt: skip

    @classmethod
    def of(cls, entries: Iterable[Mapping[str, Any]]) -> Plan:
        """Return the plan from the result of `as_list`; raise KeyError or TypeError if it is invalid."""
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
    raise TypeError(f"{value!r} is not a decision")


def write_plan(path: Path, plan: Plan) -> None:
    """Write plan.json, atomically."""
    write_json(path, {"decisions": plan.as_list()})


def read_plan(path: Path) -> Plan:
    """Read plan.json; raise InputError if it is missing or was not written by this program."""
    content = read_json(path)
    try:
        return Plan.of(content["decisions"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} was not written by this program ({error!r}); run the plan again.") from error
