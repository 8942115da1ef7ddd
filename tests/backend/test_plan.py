"""The plan: basis and override of each decision, and its effect on training, evaluation and report."""

from __future__ import annotations

import itertools
import json
import shutil
import signal
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image

from backend.capture import load_capture, sharpness
from backend.commands.training import points
from backend.labels import corrections, read_points
from backend.labels.mask_points import place_points
from backend.model.checkpoint import load_checkpoint
from backend.planning import agreement, coverage, decisions, surroundings
from backend.planning.coverage import blind_views, duplicate_views, unseen_points, vacancy, views_like_held_out
from backend.planning.decisions import (
    DECISIONS,
    Choices,
    PlanningContext,
    decide,
    planned_capture,
    planned_settings,
)
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, Cancelled, InputError
from backend.shared.events import Reporter
from backend.shared.grouping import changed, chosen, grouped, read_groups
from backend.shared.reconstruction.objects import edit_objects, merged, read_objects
from backend.shared.reconstruction.plan import KEYS, Decision, Plan, read_plan, write_plan
from backend.training import trainer
from backend.training.exposure import gains
from backend.training.settings import Settings, downscale_at
from backend.training.step import ViewStep
from backend.training.trainer import Trainer

from .command_result import assert_rejected

SMALL = ("--offsets", "2")


def planned(capture, objects=(), point_ids=None, thorough=False, **choices) -> Plan:
    return decide(PlanningContext(capture, Choices(**choices), objects, point_ids, thorough=thorough))


def loaded(scene, tmp_path, **options):
    return load_capture(scene.folder, tmp_path / "cache", **options)


# --- a plan ----------------------------------------------------------------------------------------------------------


def test_plan_overrides_apply_only_to_overridable_decisions(tmp_path):
    plan = Plan((
        Decision("votes", "votes", False, "there are no masks", can_override=False),
        Decision("exposure", "exposure", False, "it does not vary"),
        Decision("pyramid", "pyramid", True, "they are large"),
        Decision("labels", "labels", None, "votes will tell"),
    ))  # fmt: skip
    assert plan.does("pyramid") and plan.does("labels") and plan.does("unknown key") and not plan.does("exposure")
    changed_plan = plan.overridden(["exposure", "pyramid"], ["labels"])
    assert [own.done for own in changed_plan.decisions] == [False, True, True, False]
    assert [own.overridden for own in changed_plan.decisions] == [False, True, False, True]
    assert changed_plan["exposure"].reason == "--keep exposure was given"
    assert changed_plan["votes"].reason == "there are no masks"
    assert [own.done for own in plan.overridden(["all"], []).decisions] == [False, True, True, True]
    assert plan.overridden(["all"], ["exposure"])["exposure"].done is False
    with pytest.raises(InputError, match="--keep votes is not possible: there are no masks"):
        plan.overridden(["votes"], [])
    with pytest.raises(InputError, match="both name pyramid"):
        plan.overridden(["pyramid"], ["pyramid"])
    write_plan(tmp_path / "plan.json", changed_plan)
    assert read_plan(tmp_path / "plan.json") == Plan(
        tuple(own if own.key != "pyramid" else plan["pyramid"] for own in changed_plan.decisions)
    )
    (tmp_path / "plan.json").write_text('{"decisions": [{"key": "votes"}]}')
    with pytest.raises(InputError, match="was not written by this program"):
        read_plan(tmp_path / "plan.json")


def test_undecided_steps_are_done_until_settled():
    later, known = Decision("labels", "", None, ""), Decision("labels", "", False, "")
    assert Plan((later,)).does("labels")
    assert Plan((later,)).settled_by(Plan((known,)))["labels"] == known
    assert Plan((known,)).settled_by(Plan((later,)))["labels"] == known
    assert Plan((later,)).settled_by(Plan())["labels"] == later


def test_points_are_looked_for_where_photos_have_none(write_capture, tmp_path):
    capture = loaded(write_capture(views=9, size=(64, 48)), tmp_path)
    plan = planned(capture)
    assert plan["dense-points"].done and "has no points" in plan["dense-points"].why
    assert not planned(capture, leave_out=["dense-points"])["dense-points"].done
    around = {"spheres": [(3, np.zeros(3), 3.0)], "points": 20_000}
    many = loaded(write_capture(name="many", views=9, size=(64, 48), **around), tmp_path)
    assert vacancy(many) < 0.05 and not planned(many)["dense-points"].done
    assert planned(many, keep=["dense-points"])["dense-points"].done
    begun = Plan((Decision("dense-points", "", True, ""),))
    assert decide(PlanningContext(many, Choices(), resumed=begun))["dense-points"].done, "as the training began"


def test_planes_without_features_get_points(write_capture, tmp_path, run_command, monkeypatch):
    """Points on the edges of a plain floor below the spheres; the plan says how much of the photos it fills."""
    scene = write_capture(views=9, size=(64, 48), points=200, masks=False)
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 150)
    edge = np.column_stack([2 * np.cos(angle), np.full(150, 1.2), 2 * np.sin(angle)]) + rng.normal(0, 0.005, (150, 3))
    scene.xyz, scene.rgb = np.concatenate([scene.xyz, edge]), np.concatenate([scene.rgb, np.zeros((150, 3), np.uint8)])
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    capture = loaded(scene, tmp_path)
    found = planned(capture)["plane-points"]
    assert found.done and found.can_override and "shows planes" in found.why
    assert not planned(capture, leave_out=["plane-points"])["plane-points"].done
    begun = Plan((Decision("plane-points", "", False, ""),))
    assert not decide(PlanningContext(capture, Choices(), resumed=begun))["plane-points"].done, "as the training began"
    assert decide(PlanningContext(capture, Choices(), resumed=Plan()))["plane-points"] is None, "of a former version"
    train = ("train", scene.folder, *SMALL)
    for name, added, words in (
        ("with", True, ()),
        ("without", False, ("--leave-out", "plane-points")),
        ("dense points suffice", False, ()),
        ("wanted", True, ("--keep", "plane-points")),
    ):
        monkeypatch.setattr(points, "LEAST", 1.0 if name in ("dense points suffice", "wanted") else 0.1)
        result = run_command(*train, "--steps", 1, "--out", tmp_path / name, *words)
        assert result.code == EXIT_DONE, result
        assert ("points added on planes without features" in result.out) is added
        decision = read_plan(tmp_path / name / "plan.json")["plane-points"]
        assert decision.done is added and ("once dense points are added" in decision.why) is (name != "without")
        assert run_command(*train, "--steps", 2, "--out", tmp_path / name, *words).code == EXIT_DONE, "resumed"


# --- basis of decisions ----------------------------------------------------------------------------------------------


def test_plan_of_capture_with_objects(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))
    plan = planned(loaded(scene, tmp_path), point_ids=scene.point_objects, thorough=True)
    done = {own.key: own.done for own in plan.decisions}
    assert done == {
        "votes": True, "plane-points": False, "surroundings": False, "rest": False, "labels": True,
        "undistortion": False, "dense-points": True, "exposure": True, "pyramid": False,
    }  # fmt: skip
    assert len(DECISIONS) == len(KEYS) and list(done) == [key for key in KEYS if key in done]
    assert planned_settings(Settings(), plan) == Settings(fit_colors=True)


def test_plan_without_masks_has_no_object_steps(write_capture, tmp_path):
    plan = planned(loaded(write_capture(views=9, size=(64, 48), masks=False), tmp_path))
    assert plan["votes"].done is False and not plan["votes"].can_override
    assert plan["labels"] is None and plan["rest"] is None
    with pytest.raises(InputError, match="--keep votes is not possible: the capture has no masks"):
        planned(loaded(write_capture(name="again", masks=False), tmp_path), keep=["votes"])


def test_labels_of_single_object_need_unlabeled_rest(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48), spheres=[(7, np.zeros(3), 1.0)], points=200)
    beside = loaded(scene, tmp_path)
    assert planned(beside)["labels"].done is None, "undecided before votes: unlabeled pixels may be gaps or background"
    ids = scene.point_objects.copy()
    gaps = planned(beside, point_ids=ids)
    assert gaps["labels"].done is False and planned_settings(Settings(), gaps).semantic_weight == 0
    assert planned_settings(Settings(), planned(beside, point_ids=ids, keep=["labels"])).semantic_weight > 0
    assert planned(beside, settings=Settings(zero_is_object=True))["labels"].done
    ids[:40] = 0
    rest = planned(beside, point_ids=ids)
    assert rest["rest"].done and "20.0%" in rest["rest"].why and rest["labels"].done
    assert planned(beside, point_ids=ids, leave_out=["rest"])["labels"].done is False
    for mask in (scene.folder / "masks").iterdir():
        Image.fromarray(np.full((48, 64), 7, np.uint16)).save(mask)
    assert planned(loaded(scene, tmp_path))["labels"].done is False
    assert "--semantic-weight 0" in planned(beside, settings=Settings(semantic_weight=0.0))["labels"].why


def test_duplicate_views_are_found(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))

    def repeat(at: int, of: int, shift: float = 0.0) -> None:
        scene.quaternions[at], scene.viewmats[at] = scene.quaternions[of], scene.viewmats[of].copy()
        scene.viewmats[at][0, 3] += shift
        scene.seen[at], scene.pixels[at] = scene.seen[of], scene.pixels[of]
        for part, suffix in (("images", ".png"), ("masks", ".png")):
            source = scene.folder / part / scene.names[of]
            shutil.copy(source.with_suffix(suffix), (scene.folder / part / scene.names[at]).with_suffix(suffix))

    for at, of, shift in ((3, 1, 0.0), (4, 1, 1e-4), (6, 5, 0.5)):
        repeat(at, of, shift)
    repeat(2, 0)  # View 0 is held out.
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    assert duplicate_views(loaded(scene, tmp_path)) == [3, 4], "view 6 has a different pose"
    assert views_like_held_out(loaded(scene, tmp_path)) == [2]
    plan = planned(loaded(scene, tmp_path))
    assert plan.views_left_out == {"view_002.png", "view_003.png", "view_004.png"}
    repeated, flattering = plan["duplicate-views"].why.split("; ")
    assert "an earlier view: view_003.png, view_004.png" in repeated
    assert "a held-out view" in flattering and flattering.endswith(": view_002.png")
    assert not planned(loaded(scene, tmp_path), keep=["duplicate-views"]).views_left_out

    pixels = np.asarray(Image.open(scene.folder / "images/view_003.png")).astype(int)
    Image.fromarray(np.clip(pixels + 4, 0, 255).astype(np.uint8)).save(scene.folder / "images/view_003.png")
    other = scene.folder / "masks/view_004.png"
    Image.fromarray(np.full((48, 64), 1, np.uint16)).save(other)
    assert duplicate_views(loaded(scene, tmp_path)) == [], "exposure and mask differ"
    Image.fromarray(np.full((48, 64), 1, np.uint16)).save(scene.folder / "masks/view_002.png")
    assert views_like_held_out(loaded(scene, tmp_path)) == [2], "another mask does not make the photo unseen"
    photo = np.asarray(Image.open(scene.folder / "images/view_002.png")).astype(int)
    Image.fromarray(np.clip(photo + 4, 0, 255).astype(np.uint8)).save(scene.folder / "images/view_002.png")
    assert views_like_held_out(loaded(scene, tmp_path)) == []


@pytest.mark.parametrize(("repeats", "held_out"), [(7, 1), (2, 6), (2, 7)])
def test_each_place_of_bursts_is_trained_on(write_capture, tmp_path, repeats, held_out):
    """Also if nothing but held-out views is repeated, the plan says that these flatter."""
    scene, places = write_capture(views=14, size=(64, 48)), 14 // repeats
    for view in range(14):
        first = repeats * (view // repeats)
        for part in (scene.quaternions, scene.viewmats, scene.seen, scene.pixels):
            part[view] = part[first]
        for part in ("images", "masks"):
            source, target = (scene.folder / part / scene.names[i] for i in (first, view))
            if first != view:
                shutil.copy(source, target)
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    (scene.folder / "test.txt").write_text("\n".join(scene.names[::repeats][:held_out]))
    plan = planned(loaded(scene, tmp_path))
    kept = [i for i in loaded(scene, tmp_path).train_indices if scene.names[i] not in plan.views_left_out]
    assert [i // repeats for i in kept] == list(range(places))
    assert "figures will be too good, but they are needed" in plan["duplicate-views"].why


def test_capture_of_one_photo_keeps_a_training_view(write_capture, tmp_path):
    scene = write_capture(views=4, size=(64, 48))
    for view in (1, 2, 3):
        for part in (scene.quaternions, scene.viewmats, scene.seen, scene.pixels):
            part[view] = part[0]
        for part in ("images", "masks"):
            shutil.copy(scene.folder / part / scene.names[0], scene.folder / part / scene.names[view])
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    assert planned(loaded(scene, tmp_path)).views_left_out == {"view_002.png", "view_003.png"}


def test_blind_views_and_unseen_points_are_found(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    for view in (3, 5):
        scene.quaternions[view] = np.array([0.0, 0, 1, 0])
        scene.viewmats[view] = away.copy()
        scene.viewmats[view][2, 3] = -40.0
        scene.seen[view], scene.pixels[view] = np.zeros(0, int), np.zeros((0, 2))
    scene.xyz = np.concatenate([scene.xyz, [[0.0, 500.0, 0.0], [2.5, 0.0, 0.0]]])
    scene.rgb = np.concatenate([scene.rgb, np.zeros((2, 3), np.uint8)])
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    capture = loaded(scene, tmp_path)
    assert blind_views(capture) == [3, 5]
    assert np.flatnonzero(unseen_points(capture)).tolist() == [len(scene.xyz) - 2]
    plan = planned(capture)
    assert plan.views_left_out == {"view_003.png", "view_005.png"} and "1 of" in plan["unseen-points"].why
    assert plan["duplicate-views"] is None, "blind views are not duplicates"
    ids = np.append(scene.point_objects, [0, 0])
    seeds = ~unseen_points(capture)
    for chosen_points, highest in ((seeds, 1), (None, 500)):
        model = Trainer.start(capture, ids, Settings(offsets=2), seeds=chosen_points).model
        reach = model.normalization.to_world(model.anchors.positions.numpy())[:, 1].max()
        assert reach == pytest.approx(highest, rel=0.5)

    nothing = capture.excluding_from_training(set(scene.names) - {"view_003.png"})
    assert blind_views(nothing) == [] and not unseen_points(nothing).any(), "at least one view and point remain"


def test_unseen_points_are_those_outside_of_each_view(write_capture, tmp_path, monkeypatch):
    """Points are looked for in groups, which are left out for most views that show none of them."""
    scene = write_capture(views=9, size=(64, 48))
    scene.seen = [np.zeros(0, int) for _ in scene.seen]
    scene.pixels = [np.zeros((0, 2)) for _ in scene.pixels]
    scene.xyz = np.random.default_rng(0).normal(size=(3000, 3)) * 8
    scene.rgb = np.zeros((3000, 3), np.uint8)
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    capture = loaded(scene, tmp_path)
    expected = np.ones(len(capture.points.xyz), bool)
    for index in capture.train_indices:
        expected &= ~coverage._inside(capture, index, capture.points.xyz)
    tests, original = [], coverage._inside
    monkeypatch.setattr(coverage, "_TOGETHER", 20)
    monkeypatch.setattr(coverage, "_inside", lambda *inputs: tests.append(len(inputs[2])) or original(*inputs))
    assert np.array_equal(unseen_points(capture), expected) and 0.1 < expected.mean() < 0.9
    assert sum(tests) < 0.7 * len(expected) * len(capture.train_indices)


def test_planning_stops_when_it_is_asked_to(write_capture, tmp_path, run_command, monkeypatch):
    scene = write_capture(views=9, size=(64, 48))
    scene.xyz = np.concatenate([scene.xyz, [[0.0, 500.0, 0.0]]])
    scene.rgb = np.concatenate([scene.rgb, np.zeros((1, 3), np.uint8)])
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    steps = (
        (surroundings, "_vacant_cells"), (sharpness, "_energies"), (coverage, "occupied_cells"),
        (gains, "_observations"), (corrections, "_regions"), (coverage, "_inside"), (agreement, "_agreement_of"),
    )  # fmt: skip
    for module, name in steps:
        calls, original = [], getattr(module, name)

        def stop(*inputs, calls=calls, original=original):
            if not calls:
                signal.raise_signal(signal.SIGINT)
            calls.append(inputs)
            return original(*inputs)

        with monkeypatch.context() as patch:
            patch.setattr(module, name, stop)
            result = run_command("train", scene.folder, "--out", tmp_path / "out", "--steps", 1, *SMALL)
        assert result.code == EXIT_CANCELLED and len(calls) == 1, (name, len(calls), result)

    def cancel():
        raise Cancelled("Stopped.")

    capture = loaded(scene, tmp_path)
    for work in (
        duplicate_views,
        views_like_held_out,
        blind_views,
        lambda capture, cancel: place_points(capture, [1], 0, Mock(Reporter, check=cancel)),
    ):
        with pytest.raises(Cancelled):
            work(capture, cancel)


def test_unseen_points_do_not_affect_scene(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))
    ids = scene.point_objects
    alone = Trainer.start(loaded(scene, tmp_path), ids, Settings(offsets=2))
    assert planned(loaded(scene, tmp_path), point_ids=ids)["rest"].done is False

    far = np.random.default_rng(0).uniform((-50, 400, -50), (50, 500, 50), (len(ids), 3))
    scene.xyz, scene.rgb = np.concatenate([scene.xyz, far]), np.concatenate([scene.rgb, scene.rgb])
    ids = np.concatenate([ids, np.zeros_like(ids)])
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    crowded = loaded(scene, tmp_path)
    seeds = ~unseen_points(crowded)
    assert seeds.sum() == len(seeds) / 2
    found = Trainer.start(crowded, ids, Settings(offsets=2), seeds=seeds)
    assert found.model.normalization == alone.model.normalization
    assert found.model.anchors.voxel == alone.model.anchors.voxel
    assert torch.equal(found.model.anchors.rows, alone.model.anchors.rows)
    assert found.scene.supervise_background == alone.scene.supervise_background
    assert planned(crowded, point_ids=ids)["rest"].done is False, "unseen points do not count as unlabeled"


def test_converging_training_sets_validation_views_aside(write_capture, tmp_path):
    scene = write_capture(views=21, size=(64, 48))
    capture = loaded(scene, tmp_path)
    assert capture.test_indices == (0, 8, 16) and planned(capture)["validation-views"] is None
    plan = planned(capture, until_converged=True)
    assert plan["validation-views"].views == ("view_005.png", "view_014.png") and not plan.does("validation-views")
    assert "converged" in plan["validation-views"].why and plan.does("duplicate-views")
    used = planned_capture(capture, plan)
    assert used.validation_indices == (5, 14) and used.test_indices == (0, 8, 16)
    assert used.train_indices == tuple(i for i in range(21) if i not in (0, 5, 8, 14, 16))
    kept = planned_capture(capture, planned(capture, until_converged=True, keep=["validation-views"]))
    assert kept.validation_indices == () and kept.train_indices == capture.train_indices
    # Views that are left out for other reasons do not validate; too few others are left then.
    fewer = capture.excluding_from_training(["view_005.png"])
    few = planned(fewer, until_converged=True)
    assert few["validation-views"].done and "17 views" in few["validation-views"].what and not few.validation_views
    assert planned(fewer, until_converged=True, keep=["all"])["validation-views"] == few["validation-views"]
    with pytest.raises(InputError, match="too few to spare any"):
        planned(fewer, until_converged=True, leave_out=["validation-views"])
    assert planned_capture(capture, planned(capture)).train_indices == capture.train_indices


def test_chosen_objects_limit_labels_and_views(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))
    mask = scene.folder / "masks/view_003.png"
    ids = np.array(Image.open(mask))
    Image.fromarray(np.where(ids == 5, 0, ids).astype(np.uint16)).save(mask)
    capture = loaded(scene, tmp_path).edited({}, [1, 2])
    plan = planned(capture)
    assert "object 1, object 2" in plan["objects"].what and plan["objects"].done is False
    assert plan["other-views"].done and plan["other-views"].views == ("view_003.png",) and not plan.views_left_out
    assert planned(capture, leave_out=["other-views"]).views_left_out == {"view_003.png"}


def test_undistortion_exposure_and_pyramid_are_planned(write_capture, tmp_path):
    size = (640, 480)
    bent = write_capture(views=3, size=size, model="SIMPLE_RADIAL", params=[640.0, 320.0, 240.0, 0.05])
    unprepared = load_capture(bent.folder, None)
    assert not unprepared.prepared and not (tmp_path / "cache").exists()
    plan = planned(unprepared)
    assert plan["undistortion"].done and "SIMPLE_RADIAL" in plan["undistortion"].why
    assert plan["exposure"].done is None and plan["pyramid"].done
    assert planned_settings(Settings(), planned(unprepared, leave_out=["pyramid"])).pyramid is False
    few_points = planned(loaded(bent, tmp_path))
    assert few_points["exposure"].done and "too few points" in few_points["exposure"].why
    assert planned_settings(Settings(), few_points).fit_colors
    assert not planned_settings(Settings(), planned(loaded(bent, tmp_path), leave_out=["exposure"])).fit_colors
    with pytest.raises(InputError, match="--leave-out undistortion is not possible"):
        planned(unprepared, leave_out=["undistortion"])
    assert [downscale_at(0.0, 640, pyramid) for pyramid in (None, True, False)] == [2, 4, 1]
    assert [downscale_at(0.0, 320, pyramid) for pyramid in (None, True, False)] == [1, 4, 1]
    assert downscale_at(1.0, 640, True) == 1


def test_large_images_stay_small_for_longer():
    progress = (0.0, 0.2, 0.3, 0.65, 0.75)
    assert [downscale_at(done, 1600) for done in progress] == [4, 4, 2, 2, 1]
    assert [downscale_at(done, 1000) for done in progress] == [2, 2, 1, 1, 1]
    assert [downscale_at(done, 4000) for done in progress] == [4, 4, 4, 4, 1]


def test_surface_losses_need_meshes(write_capture, tmp_path):
    capture = loaded(write_capture(views=3), tmp_path)
    flat = Settings(primitive="2d")
    assert planned(capture)["surface"] is None and planned(capture, settings=flat)["surface"].done
    plan = planned(capture, settings=flat, meshes=False)
    assert not plan.does("meshes") and planned_settings(flat, plan).normal_weight == 0
    assert planned_settings(flat, plan).distortion_weight == 0
    kept = planned(capture, settings=flat, meshes=False, keep=["surface"], leave_out=["exposure"])
    assert planned_settings(flat, kept) == flat


# --- which objects ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[]", "no groups"), ('{"one": "chair"}', "'one', which is not an object ID"), ('{"1": 3}', "the group 3"),
        ('{"1": " "}', "expected a name"), ('{"9": "chair"}', "none of the IDs in the masks; available IDs: 1, 2"),
    ],
)  # fmt: skip
def test_invalid_groups_are_rejected(tmp_path, content, words):
    path = tmp_path / "groups.json"
    path.write_text(content)
    edit = {"objects": [{"id": i, "name": f"thing {i}", "color": [0, 0, 0], "points": 1} for i in (1, 2)]}
    (tmp_path / "objects.json").write_text(json.dumps(edit))
    with pytest.raises(InputError, match=r"groups\.json") as found:
        grouped(read_objects(tmp_path / "objects.json"), read_groups(path), path)
    assert words in str(found.value)


def test_only_and_groups_are_revertible_edits(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    groups = tmp_path / "groups.json"
    groups.write_text('{"0": "rest", "2": "planet", "5": "planet", "77": "nobody"}')
    assert run_command("vote", capture, "--out", out, "--groups", groups, "--only", "planet").code == EXIT_DONE
    objects = {entry.id: entry for entry in read_objects(out / "objects.json")}
    assert merged(list(objects.values())) == {1: 1, 2: 2, 5: 2} and objects[2].name == "planet"
    assert [i for i, entry in objects.items() if entry.left_out] == [1]
    plan = read_plan(out / "plan.json")
    assert "sphere 1" in plan["objects"].what and "2 IDs are grouped into 1" in plan["groups"].why
    edit_objects(out / "objects.json", {5: {"merged_into": None}, 1: {"left_out": None}})
    assert read_objects(out / "objects.json")[0].left_out is False
    assert run_command("vote", capture, "--out", out, "--only", "sphere 1", "5").code == EXIT_DONE
    assert [entry.id for entry in read_objects(out / "objects.json") if entry.left_out] == [2]
    assert_rejected(run_command("vote", capture, "--out", out, "--only", "moon"), "no object moon", "objects.json")


def test_chosen_objects_include_merged_ones(tmp_path):
    (tmp_path / "objects.json").write_text(
        json.dumps({
            "objects": [{"id": i, "name": f"thing {i}", "color": [0, 0, 0], "points": 1} for i in (1, 2, 3)],
            "edits": {"3": {"merged_into": 1, "left_out": True}},
        })
    )  # fmt: skip
    objects = read_objects(tmp_path / "objects.json")
    found = changed(objects, chosen(objects, ["thing 3"], tmp_path / "objects.json"))
    assert [entry.left_out for entry in found] == [False, True, False]


# --- the commands ----------------------------------------------------------------------------------------------------


def test_plan_command_reports_decisions_and_writes_only_out(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "deep" / "out"
    before = sorted(path.name for path in tmp_path.rglob("*"))
    result = run_command("plan", capture, "--minutes", 3, "--primitive", "2d", "--no-meshes", "--keep", "all", "--json")
    assert result.code == EXIT_DONE and sorted(path.name for path in tmp_path.rglob("*")) == before
    plan = Plan.of(result.events[-1]["plan"])
    assert plan["pyramid"].overridden and plan["surface"].overridden and not plan.does("meshes")
    assert len([text for text in result.messages("status") if text.startswith(("Planned: ", "Left out: "))]) > 5
    assert result.messages("status")[-1].startswith("Expected of ")
    assert_rejected(run_command("plan", capture, "--keep", "everything"), "invalid choice: 'everything'")
    assert_rejected(run_command("plan", tmp_path / "none", "--out", out), "does not exist")
    assert not out.parent.exists()
    assert run_command("plan", capture, "--out", out, "--only", "sphere 2").code == EXIT_DONE
    assert {path.name for path in out.iterdir()} == {"objectgs.json", "plan.json"}
    assert read_plan(out / "plan.json")["objects"].done is False
    assert run_command("import", capture, "--out", out).code == EXIT_DONE
    assert read_plan(out / "plan.json")["rest"].done is None
    assert run_command("vote", capture, "--out", out).code == EXIT_DONE
    assert read_plan(out / "plan.json")["rest"].done is False


def test_plan_affects_training_evaluation_and_report(write_capture, tmp_path, run_command):
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "out"
    shutil.copy(scene.folder / "images/view_001.png", scene.folder / "images/view_002.png")
    shutil.copy(scene.folder / "masks/view_001.png", scene.folder / "masks/view_002.png")
    for part in (scene.quaternions, scene.viewmats, scene.seen, scene.pixels):
        part[2] = part[1]
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    train = ("train", scene.folder, "--out", out, *SMALL)
    began = run_command(*train, "--steps", 4, "--keep", "pyramid", "--leave-out", "exposure", "labels", "--json")
    assert began.code == EXIT_DONE
    statuses = began.messages("status")
    assert any(text.startswith("Left out: training on 1 view, since") for text in statuses)
    assert any(text.startswith("Planned: reduced images") and "--keep pyramid" in text for text in statuses)
    assert any(text.startswith("Expected in ") and "dB below" in text for text in statuses)
    training = json.loads((out / "objectgs.json").read_text())["training"]
    assert Plan.of(training["plan"]) == read_plan(out / "plan.json")
    kept = ("--keep", "pyramid", "--leave-out")
    assert_rejected(run_command(*train, "--steps", 6, *kept, "labels"), "another plan (exposure)", "--restart")
    assert_rejected(run_command(*train, "--steps", 6, *kept, "exposure"), "semantic_weight")
    assert run_command(*train, "--steps", 6, *kept, "labels", "exposure").code == EXIT_DONE
    assert run_command("evaluate", out).code == EXIT_DONE and run_command("report", out).code == EXIT_DONE
    report = json.loads((out / "report.json").read_text())
    left_out = {entry["what"]: entry["why"] for entry in report["left_out"]}
    assert left_out["learning the object IDs of the masks"] == "--leave-out labels was given"
    assert "view_002.png" in left_out["training on 1 view"]
    assert not report["capture"]["exposure_varies"] and report["quality"]["miou"] is not None
    assert [own["key"] for own in report["plan"]] == [own.key for own in read_plan(out / "plan.json").decisions]

    assert run_command(*train, "--steps", 3, "--restart", "--leave-out", "votes").code == EXIT_DONE
    assert set(read_points(out / "points.ply").ids.tolist()) == {0}
    assert run_command("evaluate", out, "--json").events[-1].get("miou") is None


def test_begun_training_keeps_its_views(write_capture, tmp_path, run_command, monkeypatch):
    """A training of an earlier version, which did not look for views like held-out ones, resumes with its views."""
    scene, out = write_capture(views=9, size=(64, 48)), tmp_path / "out"
    for part in (scene.quaternions, scene.viewmats, scene.seen, scene.pixels):
        part[2], part[4] = part[0], part[3]
    for at, of in ((2, 0), (4, 3)):
        shutil.copy(scene.folder / "images" / scene.names[of], scene.folder / "images" / scene.names[at])
        shutil.copy(scene.folder / "masks" / scene.names[of], scene.folder / "masks" / scene.names[at])
    write_capture.write_model(scene, scene.folder / "sparse/0", ".bin")
    train = ("train", scene.folder, "--out", out, *SMALL, "--steps")
    with monkeypatch.context() as earlier:
        earlier.setattr(decisions, "views_like_held_out", lambda *_: [])
        assert run_command(*train, 2).code == EXIT_DONE
    assert read_plan(out / "plan.json").views_left_out == {"view_004.png"}
    assert run_command(*train, 3).code == EXIT_DONE
    assert read_plan(out / "plan.json").views_left_out == {"view_004.png"}
    assert_rejected(run_command(*train, 4, "--keep", "duplicate-views"), "another plan (duplicate-views)")
    assert run_command(*train, 2, "--restart").code == EXIT_DONE
    assert read_plan(out / "plan.json").views_left_out == {"view_002.png", "view_004.png"}


def views_trained_on(capture, monkeypatch) -> set[int]:
    """The indices of the views that trainings on a capture use from now on."""
    seen, compute = set(), ViewStep.compute

    def noted(self, index, *arguments, **options):
        if self.scene.capture.folder == capture:  # Not a training that compiles kernels.
            seen.add(index)
        return compute(self, index, *arguments, **options)

    monkeypatch.setattr(ViewStep, "compute", noted)
    return seen


def test_validation_views_stay_the_same_after_resuming(write_capture, tmp_path, run_command, monkeypatch):
    capture, out = write_capture(views=21, size=(64, 48)).folder, tmp_path / "out"
    seen = views_trained_on(capture, monkeypatch)
    ticks = itertools.count()  # The machine may be busy with other work, and both views take a step at least.
    monkeypatch.setattr(trainer, "awake_seconds", lambda: 0.001 * next(ticks))
    train = ("train", capture, "--out", out, *SMALL)
    with monkeypatch.context() as failing:
        step = Trainer.step

        def fail(self, progress):
            if self.scene.capture.folder == capture and self.progress.step == 130:
                raise InputError("an image cannot be read.")
            return step(self, progress)

        failing.setattr(Trainer, "step", fail)
        assert_rejected(run_command(*train, "--preset", "final"), "an image cannot be read")
    trained = set(range(21)) - {0, 5, 8, 14, 16}
    assert seen == trained
    began = read_plan(out / "plan.json")
    assert began.validation_views == ("view_005.png", "view_014.png")
    ended = run_command(*train, "--preset", "final", "--minutes", 0.02, "--json")
    assert ended.code == EXIT_DONE and any("Resuming after step 130" in text for text in ended.messages("status"))
    assert any("view_005.png, view_014.png" in text for text in ended.messages("status"))
    assert read_plan(out / "plan.json") == began
    assert seen == trained | {5, 14}, "they join once they have nothing left to decide"
    progress = load_checkpoint(out / "checkpoint")[1]["progress"]
    *validated, last = curve = progress["curve"]
    assert all(entry["validation_psnr"] > 5 and entry.get("psnr", 6.0) > 5 for entry in validated)
    assert validated and "validation_psnr" not in last and progress["joined"]
    assert last["step"] > progress["converged_at"]
    assert curve[0]["objective"] != last["objective"]
    steps = ended.events[-1]["steps"]
    assert run_command(*train, "--steps", steps + 40).code == EXIT_DONE
    assert read_plan(out / "plan.json") == began and not seen & {0, 8, 16}, "also for another length"

    assert run_command("evaluate", out).code == EXIT_DONE and run_command("report", out).code == EXIT_DONE
    report = json.loads((out / "report.json").read_text())
    assert report["capture"]["validation"] == 2 and report["capture"]["held_out"] == 3
    assert any("view_014.png" in entry["why"] for entry in report["left_out"])
    assert "2 other views were trained on in the last part alone" in (out / "report.md").read_text()


def test_final_extends_training_of_known_length(write_capture, tmp_path, run_command, monkeypatch):
    """As from an earlier version, whose checkpoint and plan have no validation views."""
    capture, out = write_capture(views=21, size=(64, 48)).folder, tmp_path / "out"
    train = ("train", capture, "--out", out, *SMALL)
    assert run_command(*train, "--steps", 3).code == EXIT_DONE
    seen = views_trained_on(capture, monkeypatch)
    assert run_command(*train, "--preset", "final", "--minutes", 0.03).code == EXIT_DONE
    assert {5, 14} & seen and not {0, 8, 16} & seen
    assert read_plan(out / "plan.json")["validation-views"] is None
    assert "validation_psnr" not in load_checkpoint(out / "checkpoint")[1]["progress"]["curve"][-1]


def test_training_without_plan_resumes(write_capture, tmp_path, run_command):
    capture, out = write_capture(views=9, size=(64, 48)).folder, tmp_path / "out"
    train = ("train", capture, "--out", out, *SMALL, "--steps")
    assert run_command(*train, 2).code == EXIT_DONE
    memory = json.loads((out / "objectgs.json").read_text())
    del memory["training"]["plan"]
    (out / "objectgs.json").write_text(json.dumps(memory))
    (out / "plan.json").unlink()
    assert run_command("report", out).code == EXIT_DONE and run_command(*train, 3).code == EXIT_DONE
    assert read_plan(out / "plan.json")["votes"].done


def test_masks_may_have_another_size_than_the_photos(write_capture, run_command):
    scene = write_capture(views=8)
    for path in (scene.folder / "masks").glob("*.png"):
        mask = Image.open(path)
        mask.resize((mask.width // 2, mask.height // 2), Image.Resampling.NEAREST).save(path)
    assert run_command("plan", scene.folder).code == EXIT_DONE
