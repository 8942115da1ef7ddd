# SPDX-License-Identifier: GPL-3.0-or-later
"""The training plan and the user's overrides of its decisions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.plan import Decision, Plan, read_plan
from .. import scene
from . import folder_trust

PRESETS = "objectgs/training"
"""Folder of the presets of training settings, below Blender's folders of presets."""

_known: dict[Path, tuple[int, Plan]] = {}
"""Folder -> modification time and content of its plan, cached for panels."""


def plan_of(folder: Path) -> Plan:
    """Return the plan in a reconstruction folder, or an empty plan if the file is missing or invalid."""
    path = Reconstruction(folder).plan
    try:
        written = path.stat().st_mtime_ns
        if _known.get(folder, (None,))[0] != written:
            _known[folder] = (written, read_plan(path))
        return _known[folder][1]
    except (InputError, OSError):
        return Plan()


def plan_for(root: bpy.types.Collection) -> Plan:
    """Return the plan of a reconstruction, or an empty plan if its folder is not accepted."""
    return plan_of(scene.folder_of(root)) if folder_trust.is_accepted(root) else Plan()


def is_wanted(properties: Any, decision: Decision) -> bool | None:
    """Return whether a decision applies: the user's choice, or else the plan's (None if not known yet)."""
    choice = properties.plan_choices.get(decision.key)
    return decision.done if choice is None else choice.done


def want(properties: Any, key: str, done: bool) -> None:
    """Store the user's choice for a decision."""
    choice = properties.plan_choices.get(key) or properties.plan_choices.add()
    choice.name, choice.done = key, done


def sentence_case(text: str) -> str:
    """Return `text` with a capital first letter."""
    return text[:1].upper() + text[1:]


def arguments(root: bpy.types.Collection) -> list[str]:
    """Return the training settings as options of the backend's commands `plan` and `train`."""
    properties = root.objectgs
    wanted = {
        decision.key: is_wanted(properties, decision)
        for decision in plan_for(root).decisions
        if decision.can_override and is_wanted(properties, decision) != decision.planned
    }
    keep = [key for key, done in wanted.items() if done]
    leave_out = [key for key, done in wanted.items() if not done]
    return [
        "--mode",
        properties.mode,
        "--sh-degree",
        str(properties.sh_degree),
        "--primitive",
        properties.primitive,
        "--strategy",
        properties.strategy,
        "--max-size",
        str(properties.max_size),
        *(["--keep", *keep] if keep else []),
        *(["--leave-out", *leave_out] if leave_out else []),
    ]
