# SPDX-License-Identifier: GPL-3.0-or-later
"""What training will do and leave out: the plan in the folder, and what the user wants otherwise."""

from pathlib import Path

from ..backend.planning.plan import Decision, Plan, read_plan
from ..backend.protocol import InputError, Reconstruction
from . import scene

_known: dict[Path, tuple[int, Plan]] = {}
"""Folder -> when its plan was written, and what it says: asked for whenever a panel is drawn."""


def plan_of(folder: Path) -> Plan:
    """The latest plan in a reconstruction's folder; one without decisions where there is none, or a broken one."""
    path = Reconstruction(folder).plan
    try:
        written = path.stat().st_mtime_ns
        if _known.get(folder, (None,))[0] != written:
            _known[folder] = (written, read_plan(path))
        return _known[folder][1]
    except (InputError, OSError):
        return Plan()


def is_wanted(properties, decision: Decision) -> bool | None:
    """Whether training is to do it: as the user chose, else as the plan has it (None: it is only known later)."""
    choice = properties.plan_choices.get(decision.key)
    return decision.done if choice is None else choice.done


def want(properties, key: str, done: bool) -> None:
    """Remember what the user chose."""
    choice = properties.plan_choices.get(key) or properties.plan_choices.add()
    choice.name, choice.done = key, done


def sentence_case(text: str) -> str:
    """A part of a sentence as one of its own."""
    return text[:1].upper() + text[1:]


def arguments(root) -> list[str]:
    """How to train, as options of the backend's commands `plan` and `train`."""
    properties = root.objectgs
    wanted = {decision.key: is_wanted(properties, decision) for decision in plan_of(scene.folder_of(root)).decisions
              if decision.can_override and is_wanted(properties, decision) != decision.planned}
    keep = [key for key, done in wanted.items() if done]
    leave_out = [key for key, done in wanted.items() if not done]
    return ["--mode", properties.mode, "--sh-degree", str(properties.sh_degree), "--primitive", properties.primitive,
            "--strategy", properties.strategy, "--max-size", str(properties.max_size),
            *(["--keep", *keep] if keep else []), *(["--leave-out", *leave_out] if leave_out else [])]
