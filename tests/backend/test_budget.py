"""Length of a training: steps, minutes, or until convergence."""

import math

import numpy as np
import pytest

from backend.training.budget import (
    DECAY_FROM,
    LOOKAHEAD,
    MAX_VALIDATION_VIEWS,
    OCTAVES,
    PRESETS,
    WARM_UP,
    WORTHWHILE_DB,
    Budget,
    TrainingProgress,
    choose_validation_views,
    convergence_step,
    plateau_end,
)
from backend.training.settings import GROW_UNTIL, PLATEAU_FROM, PLATEAU_UNTIL, rate


def curve_of(steps, psnr, **more):
    return [{"step": step, "validation_psnr": psnr(step), **more} for step in steps]


def walk(budget, psnr, longest=100_000, seconds_a_step=0.05, anchors=lambda step: step):
    """Return the progress at the end of a simulated training, given `psnr` and number of `anchors` as functions of the
    step."""
    p = TrainingProgress()
    budget.begin(p)
    progress, displayed = [], []
    while p.step < longest:
        if budget.evaluation_is_due(p):
            p.curve.append({"step": p.step, "validation_psnr": psnr(p.step), "anchors": anchors(p.step)})
            budget.check_convergence(p)
        progress.append(budget.progress(p))
        displayed.append(budget.displayed_progress(p))
        if progress[-1] >= 1:
            break
        p.step += 1
        p.seconds += seconds_a_step
    assert progress == sorted(progress) and min(displayed) == 0 and max(displayed) <= 1
    assert (displayed[-1] == 1) == (progress[-1] == 1)
    return p


def converged_after(octave):
    """Return the step from which more steps are not worthwhile, if doubling the steps gains `octave` dB."""
    return LOOKAHEAD / (2 ** (WORTHWHILE_DB / octave) - 1)


def test_convergence_step_follows_log_of_steps():
    steps = range(WARM_UP, 4100, 100)
    assert convergence_step(curve_of(steps, lambda s: 20 + 0.7 * math.log2(s))) == pytest.approx(converged_after(0.7))
    # Values before the latest octaves, and before convergence is first checked, have no effect.
    late = curve_of(steps, lambda s: 30.0 if s >= steps[-1] / 2**OCTAVES else 0.0)
    assert convergence_step(late) == 0.0
    early = curve_of(range(100, 3 * WARM_UP + 1, 100), lambda s: 30.0 if s >= WARM_UP else 0.0)
    assert convergence_step(early) == 0.0


@pytest.mark.parametrize("octave", [1e-9, 1e-3, 0.0, -1e-9, -1.0])
def test_nearly_flat_curve_has_converged(octave):
    assert convergence_step(curve_of(range(WARM_UP, 4100, 100), lambda s: 30 + octave * math.log2(s))) < 1


def test_short_curve_has_not_converged():
    assert convergence_step([]) is None
    assert convergence_step(curve_of([900, 950, 1000, 1010, 1020], lambda s: 30.0)) is None
    assert convergence_step(curve_of([700, 2000], lambda s: 30.0)) is None


def test_loss_is_used_without_validation_views():
    steps = range(WARM_UP, 3 * WARM_UP, 100)
    entries = [{"step": s, "psnr": 30.0, "loss_db": 10 + 2 * math.log2(s)} for s in steps]
    assert convergence_step(entries) == pytest.approx(converged_after(2.0)), "as in checkpoints of earlier versions"
    assert convergence_step([{**entry, "loss_db": None} for entry in entries]) is None


def test_losses_of_other_objectives_do_not_count():
    """Dropout, views that join and larger images make the loss worse, but say nothing of convergence."""
    steps = range(WARM_UP, 4 * WARM_UP, 100)
    before = [{"step": s, "loss_db": 10 + 2 * math.log2(s), "objective": "a"} for s in steps]
    after = [{**entry, "loss_db": entry["loss_db"] - 3, "objective": "b"} for entry in before]
    joined = [entry for entry in before if entry["step"] < 1200] + [entry for entry in after if entry["step"] >= 1200]
    assert convergence_step(joined[:-5]) is None, "too few of the same objective"
    longer = range(WARM_UP, 16 * WARM_UP, 100)
    settled = [{"step": s, "loss_db": 2 * math.log2(s) - 3 * (s >= 1200), "objective": s >= 1200} for s in longer]
    assert convergence_step(settled) == pytest.approx(converged_after(2.0))


def test_greater_time_limit_continues_the_plateau():
    limited, longer = (Budget(seconds=seconds, until_converged=True) for seconds in (50.0, 500.0))
    p = walk(limited, lambda step: 5 * math.log2(step + 1))
    assert p.converged_at and limited.progress(p) == 1 and plateau_end(p).startswith("The time limit is near")
    limited.begin(p)
    assert p.converged_at, "the same limit"
    p.joined, p.queue = True, [1]
    longer.begin(p)
    assert not p.converged_at and not p.joined and not p.queue and longer.progress(p) < PLATEAU_UNTIL
    done = walk(PRESETS["final"], lambda step: 30.0)
    assert plateau_end(done).startswith("The training has converged")
    PRESETS["final"].begin(done)
    assert done.converged_at
    earlier = TrainingProgress(step=2000, converged_at=1800)
    PRESETS["final"].begin(earlier)
    assert PRESETS["final"].progress(earlier) == 1, "what an earlier version has ended stays so"
    earlier.curve = curve_of(range(WARM_UP, 1801, 100), lambda step: math.log2(step))
    PRESETS["final"].begin(earlier)
    assert not earlier.converged_at, "but for its limit"


def test_entries_of_a_decay_tell_nothing_of_the_plateau():
    steps = range(WARM_UP, 4 * WARM_UP, 100)
    plateau = curve_of(steps, lambda s: 0.7 * math.log2(s), objective="a")
    decay = [{"step": s, "loss_db": 50.0, "objective": "a, joined"} for s in (2350, 2380)]
    after = curve_of([2400], lambda s: 0.7 * math.log2(s), objective="a")
    assert convergence_step([*plateau, *decay, *after]) == pytest.approx(converged_after(0.7))


def test_validation_views_join_once():
    p = TrainingProgress(queue=[1, 2])
    assert not p.join(()) and not p.joined
    assert p.join((7, 8, 9)) and p.queue == [1, 2, 7, 8, 9]
    assert not p.join((7, 8, 9)) and len(p.queue) == 5
    before = TrainingProgress(watched=[3])
    assert p.joining(before, (7, 8)) == [7, 8, 3] and p.joining(p, (7, 8)) == before.joining(before, (7, 8)) == []


def test_stops_do_not_delay_the_end_of_a_training_until_convergence():
    """However often it is stopped, it is evaluated as often."""
    ends = []
    for stop_every in (10**9, 300):
        budget, p = PRESETS["final"], TrainingProgress()
        budget.begin(p)
        while budget.progress(p) < 1 and p.step < 20_000:
            if budget.evaluation_is_due(p):
                p.curve.append({"step": p.step, "validation_psnr": math.log2(min(p.step + 1, 3000)), "anchors": 5})
                budget.check_convergence(p)
            p.step += 1
            if p.step % stop_every == 0:
                budget.begin(p)
        ends.append(p.step)
    assert ends[0] == ends[1] < 20_000


@pytest.mark.parametrize("held_out", [lambda step: 30.0, lambda step: step, lambda step: None])
def test_held_out_views_do_not_decide_the_end(held_out):
    budget, ends = PRESETS["final"], []
    for measured in (held_out, lambda step: math.log2(step)):
        p = TrainingProgress()
        budget.begin(p)
        while budget.progress(p) < 1 and p.step < 20_000:
            p.step += 1
            if budget.evaluation_is_due(p):
                quality = {"psnr": measured(p.step), "validation_psnr": math.log2(min(p.step, 3000))}
                p.curve.append({"step": p.step, **quality, "anchors": 5})
                budget.check_convergence(p)
        ends.append((p.converged_at, p.step))
    assert ends[0] == ends[1] and 3000 < ends[0][0] < 20_000


@pytest.mark.parametrize(
    ("count", "chosen"),
    [(0, []), (1, []), (17, []), (18, [4, 12]), (36, [4, 12, 20, 28]), (160, list(range(4, 160, 8)))],
)
def test_validation_views_are_every_8th(count, chosen):
    views = tuple(range(100, 100 + count))
    assert choose_validation_views(views) == [100 + i for i in chosen]


def test_validation_views_are_limited_and_spread():
    for count in (161, 500, 999, 5000):
        chosen = choose_validation_views(range(count))
        assert 15 <= len(chosen) <= MAX_VALIDATION_VIEWS and len(set(np.diff(chosen))) == 1
        assert chosen[0] < count / 15 and chosen[-1] > count * 14 / 15


def test_training_ends_soon_after_plateau():
    flat = 3000
    end = walk(PRESETS["final"], lambda step: 20 + 3 * math.log2(min(step, flat) + 1))
    assert flat < end.converged_at < 2.5 * flat
    assert end.step == pytest.approx(end.converged_at / DECAY_FROM, abs=2)
    assert end.curve[-1]["step"] == end.step


def test_single_outlier_does_not_end_training():
    def psnr(step):
        return 20 + 2 * math.log2(step + 1) - 5 * (3000 < step < 3200)

    assert walk(PRESETS["final"], psnr, longest=int(0.95 * converged_after(2.0))).converged_at == 0


def test_training_ends_when_gain_falls_below_threshold():
    where = converged_after(1.0)
    known = curve_of(range(WARM_UP, 2000, 100), lambda step: math.log2(step))
    assert convergence_step(known) == pytest.approx(where)
    settled = walk(PRESETS["final"], lambda step: math.log2(step + 1), longest=20_000).converged_at
    assert where <= settled < 1.1 * where
    assert walk(PRESETS["final"], lambda step: step / LOOKAHEAD, longest=20_000).converged_at == 0


def test_convergence_is_robust_to_noise():
    rng = np.random.default_rng(0)
    where = converged_after(0.6)
    for noise, times in ((0.05, 1.4), (0.2, 2.0)):
        for _ in range(20):
            end = walk(
                PRESETS["final"],
                lambda step, noise=noise: 30 + 0.6 * math.log2(step + 1) + rng.normal(0, noise),
                longest=20_000,
            )
            assert where / times < end.converged_at < times * where


def test_no_convergence_before_warm_up():
    assert walk(PRESETS["final"], lambda step: 30.0).converged_at >= WARM_UP


def test_growth_lasts_while_anchor_count_rises():
    def until(anchors):
        """Return the step of the measurement that ends growth; None: anchors grow to the end."""
        budget, p = PRESETS["final"], TrainingProgress()
        while p.step < 20_000:
            p.step += 1
            if budget.evaluation_is_due(p):
                p.curve.append({"step": p.step, "validation_psnr": math.log2(p.step) ** 2, "anchors": anchors(p.step)})
                assert not budget.check_convergence(p)
                if budget.progress(p) > GROW_UNTIL:
                    return p.step
        return None

    assert until(lambda step: 1000 * step**0.1) is None
    assert until(lambda step: min(step, 5000)) == pytest.approx(5000 * math.sqrt(2), rel=0.1)
    # The number of anchors falls at first if many start in the wrong place; this ends growth only after the warm-up.
    assert WARM_UP < until(lambda step: 1e6 / step) < 1.6 * WARM_UP
    # Growth that has ended does not restart.
    assert walk(PRESETS["final"], math.log1p, 5000, anchors=lambda step: 1000 + 500 * (step > 2500)).grown


@pytest.mark.parametrize("stop_every", [10**9, 300])
def test_growth_begins_again_after_a_training_of_known_length(stop_every):
    """The anchors of its last part, in which nothing grew, tell nothing of the growth on the plateau."""
    p, final = TrainingProgress(), PRESETS["final"]
    for budget, last in ((Budget(steps=3000), 3000), (final, 3000 * math.sqrt(2) * 1.2)):
        budget.begin(p)
        while p.step < last:
            p.step += 1
            if budget.evaluation_is_due(p):
                anchors = min(p.step, 1800) + max(p.step - 3000, 0) // 20
                p.curve.append({"step": p.step, "validation_psnr": math.log2(p.step) ** 2, "anchors": anchors})
                assert not budget.check_convergence(p)
            if p.step % stop_every == 0:
                budget.begin(p)
            assert not p.grown
    assert p.plateau_at == 3000
    grown = p.curve[-1]["anchors"]
    while not p.grown:
        p.step += 1
        if final.evaluation_is_due(p):
            p.curve.append({"step": p.step, "validation_psnr": math.log2(p.step) ** 2, "anchors": grown})
            final.check_convergence(p)
    assert p.step < 3 * 3000
    Budget(steps=p.step + 1000).begin(p)
    assert p.plateau_at is None


def test_growth_begins_again_where_a_longer_limit_extends_the_plateau():
    p = walk(Budget(seconds=100.0, until_converged=True), lambda step: math.log2(step + 1))
    assert p.limited and p.plateau_at == 0
    Budget(seconds=300.0, until_converged=True).begin(p)
    assert p.plateau_at == p.step and not p.converged_at


def test_curve_without_anchor_counts_keeps_growth():
    p = TrainingProgress(step=3000, curve=curve_of(range(WARM_UP, 3000, 300), lambda step: step))
    assert not PRESETS["final"].check_convergence(p) and not p.grown


def test_time_limit_ends_training_until_converged():
    for a_step in (0.05, 1.0):
        end = walk(Budget(seconds=100.0, until_converged=True), lambda step: math.log2(step + 1), seconds_a_step=a_step)
        assert end.seconds == pytest.approx(100, abs=3 * a_step)
        assert end.converged_at


def test_time_limit_holds_where_the_last_steps_are_slower():
    """As they are where images are not reduced any more."""
    budget, p = (
        Budget(seconds=100.0, until_converged=True),
        TrainingProgress(step=1000, seconds=100 * DECAY_FROM, converged_at=1000, ends_at=1250),
    )
    assert budget.progress(p) < 0.81
    p.step, p.seconds = 1020, 50 * (1 + DECAY_FROM)
    assert budget.progress(p) == pytest.approx(0.9)
    assert budget.remaining(p, 0.25) == pytest.approx(50 * (1 - DECAY_FROM))
    p.seconds = 100.0
    assert budget.progress(p) == 1.0


def test_limit_below_the_time_so_far_leaves_the_decay_its_steps():
    p = TrainingProgress(step=30_000, seconds=3600.0, curve=[{"step": 30_000, "seconds": 3600.0, "loss_db": 20.0}])
    shorter = Budget(seconds=1800.0, until_converged=True)
    shorter.begin(p)
    assert shorter.evaluation_is_due(p) and shorter.check_convergence(p) and p.ends_at == 37_500
    p.step, p.seconds = 33_750, 3900.0
    assert shorter.progress(p) == pytest.approx((1 + PLATEAU_UNTIL) / 2)
    assert shorter.remaining(p, 0.1) == pytest.approx(375.0) and shorter.displayed_progress(p) == pytest.approx(0.9)
    p.step = 37_500
    assert shorter.progress(p) == shorter.displayed_progress(p) == 1 and shorter.remaining(p, 0.1) == 0


def test_remaining_time_is_estimated_from_curve():
    p, final = TrainingProgress(step=1000, seconds=50.0), PRESETS["final"]
    assert final.remaining(p, 0.05) is None and final.displayed_progress(p) == 1000 / (1000 + LOOKAHEAD)
    assert Budget(seconds=80.0, until_converged=True).remaining(p, 0.05) == pytest.approx(30.0)
    p.curve = curve_of(range(WARM_UP, 1600, 100), lambda step: math.log2(step))
    end = converged_after(1.0) / DECAY_FROM
    assert final.remaining(p, 0.05) == pytest.approx((end - 1000) * 0.05)
    assert final.displayed_progress(p) == pytest.approx(1000 / end)
    p.converged_at, p.ends_at = 960, 1200
    assert final.remaining(p, 0.05) == pytest.approx((1200 - 1000) * 0.05)
    falling = TrainingProgress(step=2000, curve=curve_of(range(WARM_UP, 2000, 100), lambda step: -step))
    assert final.remaining(falling, 0.05) == pytest.approx((2000 / DECAY_FROM - 2000) * 0.05)
    assert final.displayed_progress(falling) == DECAY_FROM
    assert Budget(steps=3000).remaining(p, 0.05) == pytest.approx(100.0)
    assert Budget(seconds=80.0).remaining(p, 0.05) == pytest.approx(30.0)


def test_fixed_length_training_is_evaluated_at_ten_steps():
    end = walk(Budget(steps=1000), lambda step: 30.0)
    assert [entry["step"] for entry in end.curve] == [20, 50, 100, 200, 350, 500, 650, 800, 900, 1000]


def test_finished_training_has_full_progress():
    end = walk(PRESETS["final"], lambda step: 30.0)
    assert PRESETS["final"].progress(end) == 1.0


def test_learning_rates_decay_slowly_on_plateau():
    ends = (1.0, 0.01)
    assert rate(ends, 0.0) == 1.0 and rate(ends, 1.0) == pytest.approx(0.01)
    assert rate(ends, PLATEAU_UNTIL) > 0.7 * rate(ends, PLATEAU_FROM)
    assert rate(ends, PLATEAU_FROM) < 0.4
