"""The decisions of a plan, one function each, in the order in which they are made.

In case of doubt a step is done: a wrong omission costs more than unnecessary work.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..capture import BLURRED, Capture
from ..shared.defaults import MAX_SIZE
from ..shared.reconstruction.objects import SceneObject, default_name, merged
from ..shared.reconstruction.plan import KEYS, Decision, Plan
from ..shared.stopping import Check, proceed
from ..training.budget import choose_validation_views
from ..training.exposure.gains import VARIES_FROM, differences, measure_gains
from ..training.settings import Settings, background_is_masked, downscale_at
from .coverage import (
    VACANT,
    blind_views,
    blurred_views,
    duplicate_views,
    unseen_points,
    vacancy,
    views_like_held_out,
    views_without_objects,
)
from .plane_points import LEAST as LEAST_ON_PLANES
from .plane_points import PlanePoints, find_plane_points
from .surroundings import LEAST, Surroundings, find_surroundings, measure_surroundings

NO_POINTS = np.zeros((0, 3))

PIXELS_TO_READ = 3e8
"""Largest total number of pixels of photos that are read for a plan, in a few seconds; larger captures are only read
when training begins."""

MOST_LIKE_HELD_OUT = 0.25
"""Largest fraction of the different views that is left out since held-out views show the same."""

NAMED = 5
"""Largest number of objects or views that a reason names."""


@dataclass(frozen=True)
class Choices:
    """The user's choices that decisions depend on.

    settings: of the training, before the plan changes them. meshes: whether meshes are wanted. keep, leave_out: keys
    of the decisions to override. until_converged: whether the training ends when it has converged.
    """

    settings: Settings = field(default_factory=Settings)
    max_size: int = MAX_SIZE
    meshes: bool = True
    keep: Collection[str] = ()
    leave_out: Collection[str] = ()
    until_converged: bool = False


@dataclass
class PlanningContext:
    """The facts that decisions are based on.

    capture: with the user's names and without the objects left out. objects: of objects.json, or before a vote those
    of the masks. point_ids: (M,) int64, the points' objects; None before a vote. in_background: (M,) bool, the points
    that no mask, or hardly any, shows on an object; None: those without an object. thorough: whether to read all
    photos, however many. plan: the decisions so far, with the user's overrides. resumed: the plan of the training that
    is resumed, which keeps the views that it was begun with, and stays without masks if it was begun so; None for a new
    one. check: called at intervals; ends the planning by an exception once the user wants to stop.
    """

    capture: Capture
    choices: Choices
    objects: Sequence[SceneObject] = ()
    point_ids: np.ndarray | None = None
    in_background: np.ndarray | None = None
    thorough: bool = False
    plan: Plan = field(default_factory=Plan)
    resumed: Plan | None = None
    check: Check = proceed

    @cached_property
    def gains(self) -> np.ndarray:
        """The gains of the photos' color channels, (V, 3), measured on the training views."""
        return measure_gains(planned_capture(self.capture, self.plan), self.check)

    @cached_property
    def surroundings(self) -> Surroundings:
        """The surroundings without points that the training views show."""
        more = self.plane_points.xyz if self.plan.does("plane-points") else NO_POINTS
        return find_surroundings(planned_capture(self.capture, self.plan), more, self.check)

    @cached_property
    def plane_points(self) -> PlanePoints:
        """The points on planes without features that the training views show."""
        return find_plane_points(planned_capture(self.capture, self.plan), NO_POINTS, self.check)

    @property
    def labeled(self) -> bool:
        """Whether object IDs are available."""
        return self.capture.has_masks and self.plan.does("votes")

    def names(self, views: Sequence[int]) -> tuple[str, ...]:
        return tuple(self.capture.views[i].name for i in views)


def decide(context: PlanningContext) -> Plan:
    """Make all decisions of a plan.

    Args:
        context: The facts; its `plan` is extended by each decision.

    Returns:
        The plan, with the user's overrides.

    Raises:
        InputError: A decision cannot be overridden.
        Exception: That of the context's check, if the user has stopped the planning.
    """
    for decision_of in DECISIONS:
        context.check()
        decision = decision_of(context)
        if decision is not None:
            plan = Plan((*context.plan.decisions, decision))
            context.plan = plan.overridden(context.choices.keep, context.choices.leave_out)
    return context.plan


def planned_capture(capture: Capture, plan: Plan) -> Capture:
    """Return the capture that a plan trains on: without unused masks, with unused and validation views excluded from
    training."""
    capture = capture if plan.does("votes") else capture.without_masks()
    return capture.excluding_from_training(plan.views_left_out).validating_on(plan.validation_views)


def planned_settings(settings: Settings, plan: Plan) -> Settings:
    """Change the settings of a training as its plan decides.

    Args:
        settings: The settings that were asked for.
        plan: The plan, with the user's overrides.

    Returns:
        The settings without the weights of losses that the plan leaves out, with colors that are fitted if the plan
        compensates the exposure, and with an overridden image pyramid.
    """
    settings = replace(settings, fit_colors=plan.does("exposure"))
    if not plan.does("labels"):
        settings = replace(settings, semantic_weight=0.0)
    if not plan.does("surface"):
        settings = replace(settings, normal_weight=0.0, distortion_weight=0.0)
    pyramid = plan["pyramid"]
    return replace(settings, pyramid=pyramid.done) if pyramid and pyramid.overridden else settings


# --- objects ---------------------------------------------------------------------------------------------------------


def _votes(context: PlanningContext) -> Decision:
    views, masks = context.capture.views, sum(view.mask_file is not None for view in context.capture.views)
    what, begun = "objects from the masks", context.resumed["votes"] if context.resumed is not None else None
    if masks and begun is not None and begun.planned is False:
        return Decision("votes", what, False, "the training was begun without masks", can_override=False)
    if not masks:
        return Decision("votes", what, False, "the capture has no masks", can_override=False)
    return Decision("votes", what, True, f"{masks} of {len(views)} views have masks")


def _objects(context: PlanningContext) -> Decision | None:
    left_out = context.capture.left_out.tolist()
    if not (context.labeled and left_out):
        return None
    names = {entry.id: entry.name for entry in context.objects}
    what = f"splats of {_listed([names.get(i, default_name(i)) for i in left_out])}"
    why = f"only {len(context.capture.object_ids)} objects are selected; the others count as unlabeled"
    return Decision("objects", what, False, why, can_override=False)


def _groups(context: PlanningContext) -> Decision | None:
    into = merged([entry for entry in context.objects if not entry.left_out])
    parts = [i for i, shown_as in into.items() if shown_as != i]
    if not (context.labeled and parts):
        return None
    why = f"the {len(into)} IDs are grouped into {len(into) - len(parts)} objects"
    return Decision("groups", f"separate meshes and names for {len(parts)} IDs", False, why, can_override=False)


def _plane_points(context: PlanningContext) -> Decision | None:
    what = "points on planes without features, such as a plain table"
    if context.resumed is not None:
        # The training has begun with or without them.
        return context.resumed.planned("plane-points")
    if not _may_read_photos(context):
        return Decision("plane-points", what, None, "it requires reading all photos, which training does first")
    found = context.plane_points
    shown = f"{found.fraction:.1%} of the photos' area shows planes whose points are elsewhere"
    why = f"{shown}; the threshold is {LEAST_ON_PLANES:.0%}"
    return Decision("plane-points", what, found.fraction >= LEAST_ON_PLANES, why, can_override=len(found.xyz) > 0)


def _surroundings(context: PlanningContext) -> Decision | None:
    what = "distant splats where photos show no points, such as in the sky"
    if context.resumed is not None:
        # The training has begun with or without them.
        return context.resumed.planned("surroundings")
    if not _may_read_photos(context):
        return Decision("surroundings", what, None, "it requires reading all photos, which training does first")
    found = context.surroundings
    needed = found.fraction >= LEAST
    seen = f"{found.fraction:.1%} of the photos' pixels show neither points nor objects"
    why = f"{seen}, but a single color" if needed and found.uniform else f"{seen}; the threshold is {LEAST:.0%}"
    return Decision("surroundings", what, needed and not found.uniform, why, can_override=len(found.xyz) > 0)


def _rest(context: PlanningContext) -> Decision | None:
    if not context.labeled or context.choices.settings.zero_is_object:
        return None
    what = "learning from unlabeled pixels"
    if context.point_ids is None:
        return Decision("rest", what, None, "the votes determine how many points have no object")
    # Points outside all views are ignored: no mask votes on them.
    background = context.point_ids == 0 if context.in_background is None else context.in_background
    background = background[~unseen_points(context.capture, context.check)]
    fraction, supervised = float(np.mean(background)), background_is_masked(background)
    surroundings = context.plan["surroundings"]
    if surroundings is not None and surroundings.done and not supervised:
        return Decision("rest", what, True, "distant splats of no object show the surroundings")
    meaning = "unlabeled pixels are background" if supervised else "unlabeled pixels count as gaps in the masks"
    why = f"{fraction:.1%} of the visible points are on no object in the masks, so {meaning}"
    return Decision("rest", what, supervised, why)


def _labels(context: PlanningContext) -> Decision | None:
    if not context.labeled:
        return None
    what, capture = "learning the object IDs of the masks", context.capture
    if context.choices.settings.semantic_weight == 0:
        return Decision("labels", what, False, "--semantic-weight 0 was given", can_override=False)
    ids = len(capture.object_ids)
    if ids > 1:
        return Decision("labels", what, True, f"the masks show {ids} objects")
    unlabeled = any(0 in capture.ids_in(i) for i in range(len(capture)))
    rest = context.plan["rest"]
    supervised = True if rest is None else rest.done
    if ids and unlabeled and supervised is not False:
        return Decision("labels", what, supervised, "the masks show one object and unlabeled pixels")
    shown = "one object and nothing else" if ids else "no object"
    return Decision("labels", what, False, f"the masks show {shown}")


# --- images --------------------------------------------------------------------------------------------------------


def _undistortion(context: PlanningContext) -> Decision:
    capture, what = context.capture, "undistortion and reduction of the images"
    changed = [i for i in range(len(capture)) if not capture.is_original(i)]
    if not changed:
        why = f"all {len(capture)} are pinhole images of at most {context.choices.max_size} pixels"
        return Decision("undistortion", what, False, why, can_override=False)
    models = _listed(sorted({capture.camera_model_of(i) for i in changed}))
    why = f"{len(changed)} of {len(capture)} images are distorted or too large (cameras: {models})"
    return Decision("undistortion", what, True, why, can_override=False)


def _duplicate_views(context: PlanningContext) -> Decision | None:
    capture = context.capture
    if context.resumed is not None:
        return context.resumed.planned("duplicate-views")
    if not capture.prepared:
        return None
    repeated, flattering = duplicate_views(capture, context.check), views_like_held_out(capture, context.check)
    different = len(capture.train_indices) - len(repeated)
    # Of photos in bursts, one of almost each may be held out.
    needed = len({*flattering} - {*repeated}) > MOST_LIKE_HELD_OUT * different
    left_out, kept = ([], [i for i in flattering if i not in repeated]) if needed else (flattering, [])
    repeated = [i for i in repeated if i not in left_out]
    reasons = []
    for views, other in (
        (repeated, "an earlier view"),
        (left_out, "a held-out view, whose figures would be too good if they were trained on"),
        (kept, "a held-out view, whose figures will be too good, but they are needed; test.txt may name others"),
    ):
        if views:
            each = f"each shows the same image from the same position as {other}"
            reasons.append(f"{each}: {_listed(context.names(views))}")
    if not reasons:
        return None
    why, found = "; ".join(reasons), sorted([*repeated, *left_out])
    if not found:
        what, names = f"training on {_views(len(kept))}", context.names(kept)
        return Decision("duplicate-views", what, True, why, len(kept) < len(capture.train_indices), views=names)
    return Decision("duplicate-views", f"training on {_views(len(found))}", False, why, views=context.names(found))


def _blind_views(context: PlanningContext) -> Decision | None:
    found = blind_views(context.capture, context.check)
    if not found:
        return None
    why = f"none of the {len(context.capture.points.xyz):,} points is visible in them: {_listed(context.names(found))}"
    return Decision("blind-views", f"training on {_views(len(found))}", False, why, views=context.names(found))


def _blurred_views(context: PlanningContext) -> Decision | None:
    if context.resumed is not None:
        return context.resumed.planned("blurred-views")
    if not _may_read_photos(context):
        return None
    found = blurred_views(planned_capture(context.capture, context.plan), context.check)
    if not found:
        return None
    names = context.names(list(found))
    shares = [f"{name} ({share:.0%})" for name, share in zip(names, found.values(), strict=True)]
    why = (
        f"details have less than {BLURRED:.0%} of the contrast that other views show at the same points: "
        f"{_listed(shares)}"
    )
    return Decision("blurred-views", f"training on {_views(len(found))}", False, why, views=names)


def _other_views(context: PlanningContext) -> Decision | None:
    """Keep these views: they show the rest of the scene, and constrain where the objects are not."""
    if not (context.labeled and len(context.capture.left_out)):
        return None
    found = views_without_objects(context.capture)
    if not found:
        return None
    what = f"training on {_views(len(found))} without the selected objects"
    return Decision("other-views", what, True, "they show the rest of the scene", views=context.names(found))


def _validation_views(context: PlanningContext) -> Decision | None:
    if context.resumed is not None:
        return context.resumed.planned("validation-views")
    if not context.choices.until_converged:
        return None
    training = planned_capture(context.capture, context.plan).train_indices
    found = choose_validation_views(training)
    if not found:
        why = "they are too few to spare any for validation, so their loss decides when the training ends"
        what = f"training on all {_views(len(training))}"
        return Decision("validation-views", what, True, why, can_override=False)
    why = f"until their PSNR has converged, which ends the training: {_listed(context.names(found))}"
    return Decision("validation-views", f"training on {_views(len(found))}", False, why, views=context.names(found))


def _unseen_points(context: PlanningContext) -> Decision | None:
    unseen = unseen_points(planned_capture(context.capture, context.plan), context.check)
    if not unseen.any():
        return None
    why = f"{unseen.sum():,} of {len(unseen):,} points lie outside every training view"
    return Decision("unseen-points", "anchors outside every view", False, why)


def _dense_points(context: PlanningContext) -> Decision | None:
    what = "points on surfaces without features, from patches of the photos"
    if context.resumed is not None:
        # The training has begun with or without them.
        return context.resumed.planned("dense-points")
    if not _may_read_photos(context):
        return Decision("dense-points", what, None, "it requires reading all photos, which training does first")
    capture = planned_capture(context.capture, context.plan)
    # Points on planes are no reason to look for none there, since they are less exact.
    of_sky = context.surroundings.fraction
    if context.plan.does("plane-points"):
        of_sky = measure_surroundings(capture, context.check)
    vacant = max(vacancy(capture, context.check) - of_sky, 0.0)
    why = f"{vacant:.0%} of the photos' area, without the sky, has no points; the threshold is {VACANT:.0%}"
    return Decision("dense-points", what, vacant >= VACANT, why)


def _exposure(context: PlanningContext) -> Decision:
    what = "exposure and white balance correction"
    if not _may_read_photos(context):
        return Decision("exposure", what, None, "it requires reading all photos, which training does first")
    off = differences(context.gains)
    if off == 0:
        return Decision("exposure", what, True, "the photos share too few points to be compared before training")
    why = f"the photos show the same points with a difference in brightness or color of {off:.1%}"
    return Decision("exposure", what, off > VARIES_FROM, f"{why}; the threshold is {VARIES_FROM:.0%}")


def _pyramid(context: PlanningContext) -> Decision:
    longest = max(max(view.width, view.height) for view in context.capture.views)
    times, what = downscale_at(0.0, longest), "reduced images at the start of training"
    if times == 1:
        return Decision("pyramid", what, False, f"images of {longest} pixels are small enough from the start")
    return Decision("pyramid", what, True, f"images of {longest} pixels are first reduced to {longest // times} pixels")


# --- results ---------------------------------------------------------------------------------------------------------


def _meshes(context: PlanningContext) -> Decision | None:
    if context.choices.meshes:
        return None
    return Decision("meshes", "meshes and textures", False, "--no-meshes was given", can_override=False)


def _surface(context: PlanningContext) -> Decision | None:
    if context.choices.settings.primitive != "2d":
        return None
    why = "meshes are extracted from the surfaces" if context.choices.meshes else "no meshes are wanted"
    return Decision("surface", "the normal and distortion losses of flat splats", context.choices.meshes, why)


DECISIONS: tuple[Callable[[PlanningContext], Decision | None], ...] = (
    _votes, _objects, _groups, _plane_points, _surroundings, _rest, _labels, _undistortion, _duplicate_views,
    _blind_views, _blurred_views, _other_views, _validation_views, _unseen_points, _dense_points, _exposure,
    _pyramid, _meshes, _surface,
)  # fmt: skip
"""In the order of `KEYS`; a decision may depend on earlier ones. None if a decision does not apply to the capture."""

OF_TRAINING = tuple(key for key in KEYS if key not in ("objects", "groups", "undistortion", "meshes"))
"""Keys of decisions that cannot be changed once a training has begun."""


def _may_read_photos(context: PlanningContext) -> bool:
    """Return whether all photos may be read for the plan."""
    capture = context.capture
    pixels = sum(capture.views[i].width * capture.views[i].height for i in capture.train_indices)
    return context.thorough or (capture.prepared and pixels <= PIXELS_TO_READ)


def _views(count: int) -> str:
    return f"{count} view{'s' if count != 1 else ''}"


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {rest} more" if rest > 0 else "")
