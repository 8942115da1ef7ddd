"""The decisions of a plan, a function each, in the order in which they are made.

What is not certain is done: a wrong omission costs more than work that was not needed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..capture import Capture
from ..objects import SceneObject, merged
from ..training.exposure import VARIES_FROM, differences, measure_gains
from ..training.settings import Settings, downscale_at, rest_is_taught
from .coverage import blind_views, duplicate_views, unseen_points, views_without
from .plan import KEYS, Decision, Plan

PIXELS_TO_READ = 3e8
"""Photos of so many pixels in all are read for a plan, in a few seconds; more than that only when training begins."""

NAMED = 5
"""So many objects or views are named at most."""


@dataclass(frozen=True)
class Choices:
    """What was asked for, as far as decisions depend on it. settings: of the training, before the plan changes them;
    meshes: whether meshes are to be made; keep, leave_out: keys of the decisions that are to be overridden."""

    settings: Settings = field(default_factory=Settings)
    max_size: int = 1600
    meshes: bool = True
    keep: Collection[str] = ()
    leave_out: Collection[str] = ()


@dataclass
class Look:
    """What decisions rest on. capture: with the user's names, without the objects that are left out; objects: of
    objects.json, none before a vote; point_ids: the points' objects ((M,) int64), None before a vote; thorough:
    whether all photos are read, however many; plan: what has been decided so far, as the user wants it."""

    capture: Capture
    choices: Choices
    objects: Sequence[SceneObject] = ()
    point_ids: np.ndarray | None = None
    thorough: bool = False
    plan: Plan = field(default_factory=Plan)

    @cached_property
    def gains(self) -> np.ndarray:
        """By how much each photo is brighter than the others: (V, 3), from the views that are trained on."""
        return measure_gains(planned_capture(self.capture, self.plan))

    @property
    def labelled(self) -> bool:
        """Whether there are object IDs to work with."""
        return self.capture.has_masks and self.plan.does("votes")

    def names(self, views: Sequence[int]) -> tuple[str, ...]:
        return tuple(self.capture.views[i].name for i in views)


def decide(look: Look) -> Plan:
    """The plan for a capture, as the user wants it; InputError where something cannot be overridden."""
    for decision_of in DECISIONS:
        decision = decision_of(look)
        if decision is not None:
            plan = Plan((*look.plan.decisions, decision))
            look.plan = plan.overridden(look.choices.keep, look.choices.leave_out)
    return look.plan


def planned_capture(capture: Capture, plan: Plan) -> Capture:
    """The capture as the plan has it: without masks that are not used and without views that are not trained on."""
    capture = capture if plan.does("votes") else capture.without_masks()
    return capture.without_training_on(plan.views_left_out)


def planned_settings(settings: Settings, plan: Plan) -> Settings:
    """The settings of a training as the plan has them."""
    if not plan.does("labels"):
        settings = replace(settings, semantic_weight=0.0)
    if not plan.does("surface"):
        settings = replace(settings, normal_weight=0.0, distortion_weight=0.0)
    pyramid = plan["pyramid"]
    return replace(settings, pyramid=pyramid.done) if pyramid and pyramid.overridden else settings


# --- objects ---------------------------------------------------------------------------------------------------------


def _votes(look: Look) -> Decision:
    views, masks = look.capture.views, sum(view.mask_file is not None for view in look.capture.views)
    what = "votes, object IDs and object scores"
    if not masks:
        return Decision("votes", what, False, "the capture has no masks", can_override=False)
    return Decision("votes", what, True, f"{masks} of {len(views)} views have masks")


def _objects(look: Look) -> Decision | None:
    left_out = look.capture.left_out.tolist()
    if not (look.labelled and left_out):
        return None
    names = {entry.id: entry.name for entry in look.objects}
    what = f"splats of {_listed([names.get(i, f'object {i}') for i in left_out])}"
    why = f"only {len(look.capture.object_ids)} objects are chosen; the others stay a part of the unlabelled rest"
    return Decision("objects", what, False, why, can_override=False)


def _groups(look: Look) -> Decision | None:
    into = merged([entry for entry in look.objects if not entry.left_out])
    parts = [i for i, shown_as in into.items() if shown_as != i]
    if not (look.labelled and parts):
        return None
    why = f"the {len(into)} IDs are grouped into {len(into) - len(parts)} objects"
    return Decision("groups", f"meshes and names of their own for {len(parts)} IDs", False, why, can_override=False)


def _rest(look: Look) -> Decision | None:
    if not look.labelled or look.choices.settings.zero_is_object:
        return None
    what = "teaching of unlabelled pixels"
    if look.point_ids is None:
        return Decision("rest", what, None, "the votes say how many points have no object")
    # Points that no view shows have no object since nothing voted for them.
    ids = look.point_ids[~unseen_points(look.capture)]
    share, taught = float(np.mean(ids == 0)), rest_is_taught(ids)
    meaning = "unlabelled pixels show something else" if taught else "they are taken for gaps in the masks"
    return Decision("rest", what, taught, f"{share:.1%} of the points in view have no object, so {meaning}")


def _labels(look: Look) -> Decision | None:
    if not look.labelled:
        return None
    what, capture = "the label loss and its ID channel", look.capture
    if look.choices.settings.semantic_weight == 0:
        return Decision("labels", what, False, "--semantic-weight 0 was asked for", can_override=False)
    ids = len(capture.object_ids)
    if ids > 1:
        return Decision("labels", what, True, f"the masks show {ids} objects")
    unlabelled = any(0 in capture.ids_in(i) for i in range(len(capture)))
    rest = look.plan["rest"]
    rest_taught = True if rest is None else rest.done
    if ids and unlabelled and rest_taught is not False:
        return Decision("labels", what, rest_taught, "the masks show one object, and unlabelled pixels beside it")
    shown = "one object, and nothing to tell it from" if ids else "no object"
    return Decision("labels", what, False, f"the masks show {shown}")


# --- pictures --------------------------------------------------------------------------------------------------------


def _undistortion(look: Look) -> Decision:
    capture, what = look.capture, "undistortion and reduction of the images"
    changed = [i for i in range(len(capture)) if not capture.is_original(i)]
    if not changed:
        why = f"all {len(capture)} are pinhole pictures of at most {look.choices.max_size} pixels already"
        return Decision("undistortion", what, False, why, can_override=False)
    models = _listed(sorted({capture.camera_of(i) for i in changed}))
    why = f"{len(changed)} of {len(capture)} images are bent by a lens or too large (cameras: {models})"
    return Decision("undistortion", what, True, why, can_override=False)


def _duplicate_views(look: Look) -> Decision | None:
    found = duplicate_views(look.capture) if look.capture.prepared else []
    if not found:
        return None
    why = f"each shows the same picture from the same place as an earlier view: {_listed(look.names(found))}"
    return Decision("duplicate-views", f"training on {_views(len(found))}", False, why, views=look.names(found))


def _blind_views(look: Look) -> Decision | None:
    found = blind_views(look.capture)
    if not found:
        return None
    why = f"none of the {len(look.capture.points.xyz):,} points lies in these: {_listed(look.names(found))}"
    return Decision("blind-views", f"training on {_views(len(found))}", False, why, views=look.names(found))


def _other_views(look: Look) -> Decision | None:
    """Needed all the same: they show the rest of the scene, and what stands where the objects could have been."""
    if not (look.labelled and len(look.capture.left_out)):
        return None
    found = views_without(look.capture)
    if not found:
        return None
    what = f"training on {_views(len(found))} without the chosen objects"
    return Decision("other-views", what, True, "they show the rest of the scene", views=look.names(found))


def _unseen_points(look: Look) -> Decision | None:
    unseen = unseen_points(planned_capture(look.capture, look.plan))
    if not unseen.any():
        return None
    why = f"{unseen.sum():,} of {len(unseen):,} points lie outside of every view that is trained on"
    return Decision("unseen-points", "anchors that no view shows", False, why)


def _exposure(look: Look) -> Decision:
    capture, what = look.capture, "undoing of exposure and white balance"
    pixels = sum(capture.views[i].width * capture.views[i].height for i in capture.train_indices)
    if not look.thorough and not (capture.prepared and pixels <= PIXELS_TO_READ):
        return Decision("exposure", what, None, "all photos have to be read for it, which training begins with")
    off = differences(look.gains)
    if off == 0:
        return Decision("exposure", what, False, "too few points are shared by photos to compare them")
    how = f"the photos differ by {off:.1%} in how bright or how blue they show the same points"
    return Decision("exposure", what, off > VARIES_FROM, f"{how}, and {VARIES_FROM:.0%} can be told from noise")


def _pyramid(look: Look) -> Decision:
    longest = max(max(view.width, view.height) for view in look.capture.views)
    times, what = downscale_at(0.0, longest), "reduced pictures at the start of training"
    if times == 1:
        return Decision("pyramid", what, False, f"{longest} pixels are few enough to train on from the start")
    return Decision("pyramid", what, True, f"pictures of {longest} pixels are first learned at {longest // times}")


# --- results ---------------------------------------------------------------------------------------------------------


def _meshes(look: Look) -> Decision | None:
    if look.choices.meshes:
        return None
    return Decision("meshes", "meshes and textures", False, "--no-meshes was asked for", can_override=False)


def _surface(look: Look) -> Decision | None:
    if look.choices.settings.primitive != "2d":
        return None
    why = "meshes are made of the surfaces" if look.choices.meshes else "no meshes are to be made of the surfaces"
    return Decision("surface", "normals and distortion of flat splats", look.choices.meshes, why)


DECISIONS: tuple[Callable[[Look], Decision | None], ...] = (
    _votes, _objects, _groups, _rest, _labels, _undistortion, _duplicate_views, _blind_views, _other_views,
    _unseen_points, _exposure, _pyramid, _meshes, _surface,
)  # fmt: skip
"""In the order of `KEYS`; one may build on those before it. None where the capture gives no cause to decide."""

OF_TRAINING = tuple(key for key in KEYS if key not in ("objects", "groups", "undistortion", "meshes"))
"""What cannot be changed once a training has begun."""


def _views(count: int) -> str:
    return f"{count} view{'s' if count != 1 else ''}"


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {rest} more" if rest > 0 else "")
