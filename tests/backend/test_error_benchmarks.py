"""Verdicts of the benchmarks, and their changes of the kernels."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from backend.capture import load_capture
from backend.planning.coverage import blind_views, duplicate_views, unseen_points
from benchmarks import approximations, mask_noise, plan, plan_captures, raster_variants, scale, training_variants


def test_better_than_requires_no_worse_figure():
    default, noise = (1.0, 0.3), (0.03, 0.01)
    others = {
        "faster": (0.9, 0.305),
        "faster, further off": (0.9, 0.5),
        "closer": (1.02, 0.2),
        "equal but for noise": (0.98, 0.295),
        "slower": (1.2, 0.3),
    }
    assert approximations.better_than(default, others, noise) == ["faster", "closer"]


def test_choice_time_is_median_over_process_sets(monkeypatch):
    sets = iter([1.01, 1.09, 1.03, 1.04, 1.02])

    def measure_set(*_):
        time = next(sets)
        return {"a": {"picture": 0.3, "forward_ms": 1.0, "backward_ms": 2.0, "step_ms": 3.0, "times_default": time}}

    monkeypatch.setattr(approximations, "measure_set", measure_set)
    found = approximations.measure_choice(approximations.Choice("a choice", "a", {}), None, None, None, 5)
    assert found["a"]["times_default"] == 1.03 and max(found["a"]["times_default_of_sets"]) == 1.09
    sets = iter([1.01, 1.0, 1.0, 1.01])
    more = approximations.measure_choice(approximations.Choice("a choice", "a", {}), None, None, None, 4)
    assert approximations.joined([found, more])["a"]["times_default"] == 1.01
    assert approximations._raster_row({**found["a"], "largest": 1.0, "gradient": 0.1})[1] == "1.03 (1.01-1.09)"


def a_pair(psnr, miou, times_default):
    return {"variant": {"psnr": psnr, "miou": miou, "splats": 100}, "times_default": times_default}


def test_variant_is_compared_with_default_in_same_time():
    curve = training_variants.curve_of(
        {"steps": steps, "psnr": psnr, "miou": 0.9} for steps, psnr in ((50, 29), (100, 30), (100, 32), (200, 33))
    )
    assert list(curve) == [50, 100, 200] and curve[100]["psnr"] == 31
    row = approximations.training_row([a_pair(30.0, 0.90, 1.3), a_pair(31.0, 0.92, 2**0.5 * 2 - 1.3)], curve, 100)
    assert row["psnr_default"] == pytest.approx(32.0) and row["psnr"] == 30.5 and row["miou"] == pytest.approx(0.91)
    assert approximations.training_gains(row) == pytest.approx([-1.5, 0.01])
    with pytest.raises(ValueError, match="outside"):
        training_variants.in_time(curve, 201)


@pytest.mark.parametrize(("seeds", "better"), [(1, ["fast"]), (4, ["fast", "a little"])])
def test_training_verdict_uses_default_quality_in_same_time(seeds, better):
    choice = approximations.Choice("a choice", "default", {})

    def row(psnr, psnr_default):
        return {"psnr": psnr, "psnr_default": psnr_default, "miou": 0.9, "miou_default": 0.9, "seeds": seeds}

    rows = {"default": row(31, 31), "fast": row(30.5, 30), "a little": row(30.2, 30), "slow": row(31.5, 32)}
    assert approximations.training_verdict(choice, rows, [0.3, 0.002]).better == better


def test_plan_verdict_reports_savings_and_quality():
    whole = {"seconds": 100.0, "cpu_seconds": 150.0, "peak_mb": 1000.0, "psnr": 30.0, "error": 0.03}
    planned = {"seconds": 80.0, "cpu_seconds": 165.0, "peak_mb": 500.0, "psnr": 30.05, "error": 0.04}
    found = {"as planned": planned, "nothing left out": whole}
    text = "As planned, the same number of steps takes 20% less time, 10% more CPU time, 50% less memory; "
    assert plan.verdict(found) == f"{text}+0.05 ± 0.05 dB, equal."
    planned["psnr"] = 29.5
    assert plan.verdict(found).endswith("; -0.50 ± 0.05 dB, worse.")
    assert plan.judged({**planned, "error": 0.4}, whole) == "equal"
    planned["psnr"] = 32.0
    found[plan.AS_GOOD] = {**planned, "steps": 400, "seconds": 45.0, "psnr": 29.95, "error": 0.0}
    assert plan.verdict(found) == (
        f"{text}+2.00 ± 0.05 dB, better. "
        "In 400 steps it takes 55% less time, 10% more CPU time, 50% less memory; -0.05 ± 0.03 dB."
    )
    found[plan.EVERYWHERE] = {**whole, "seconds": 160.0, "psnr": 32.5}
    assert "everywhere" in plan.verdict(found) and plan.verdict(found).endswith("-0.50 ± 0.05 dB, worse.")


@pytest.mark.parametrize("slope", [0.7, 2.5])
def test_as_good_finds_steps_of_equal_quality(slope):
    tried = []

    def train(steps):
        tried.append(steps)
        return {"steps": steps, "psnr": 33.0 + slope * np.log2(steps / 800)}

    found = plan.as_good(train, {"steps": 800, "psnr": 33.0}, 31.5)
    assert found["psnr"] == pytest.approx(31.5, abs=plan.SAME_PSNR) and len(tried) <= 2


def test_with_masks_adds_uniform_masks(tmp_path):
    capture, other = tmp_path / "capture", tmp_path / "other"
    (capture / "images" / "left").mkdir(parents=True)
    other.mkdir()
    Image.new("RGB", (6, 4)).save(capture / "images" / "left" / "0.jpg")
    plan_captures.with_masks(capture, other, 1)
    ids = np.asarray(Image.open(other / "masks" / "left" / "0.png"))
    assert ids.shape == (4, 6) and (ids == 1).all() and (other / "images" / "left" / "0.jpg").exists()
    assert not (capture / "masks").exists()


def test_redundant_views_and_points_are_left_out(write_capture, tmp_path):
    scene = write_capture(views=9, size=(64, 48))
    given = load_capture(scene.folder, tmp_path / "cache")
    folder = tmp_path / "more"
    folder.mkdir()
    more = load_capture(plan_captures.with_surplus(scene.folder, folder), tmp_path / "cache of more")
    images = sorted(given.image(i).tobytes() for i in given.test_indices)
    assert sorted(more.image(i).tobytes() for i in more.test_indices) == sorted(2 * images)
    blind, alike, unseen = blind_views(more), duplicate_views(more), unseen_points(more)
    assert len(blind) == 14 and len(alike) == 7 and unseen.sum() == round(plan_captures.UNSEEN * len(scene.xyz))
    left = [i for i in more.train_indices if i not in {*blind, *alike}]

    def camera_centers(capture, views):
        return sorted(tuple(capture.views[i].viewmat[:3, 3].round(6)) for i in views)

    assert camera_centers(more, left) == camera_centers(given, given.train_indices)
    assert sorted(map(more.ids_in, left)) == sorted(map(given.ids_in, given.train_indices))


def test_nearly_straight_lens_changes_little(write_capture, tmp_path):
    scene = write_capture(views=3, size=(64, 48))
    given = load_capture(scene.folder, tmp_path / "cache")
    folder = tmp_path / "bent"
    folder.mkdir()
    bent = load_capture(plan_captures.through_a_lens(scene.folder, folder), tmp_path / "cache of bent")
    assert given.is_original(1) and not bent.is_original(1)
    assert 64 - bent.views[1].width <= 1 and 48 - bent.views[1].height <= 1
    cut = (given.views[1].K - bent.views[1].K)[:2, 2]
    moved = given.keypoints(1).xy - cut - bent.keypoints(1).xy
    assert 1e-6 < np.abs(moved).max() < 0.01


def test_each_choice_has_one_default_variant():
    for choices in (approximations.raster_choices, approximations.training_choices, approximations.mesh_choices):
        for choice in choices():
            assert choice.variants[choice.default] == {}
            assert sum(not changes for changes in choice.variants.values()) == 1


@pytest.mark.parametrize(("degree", "least"), [(2, 4e-3), (3, 2e-4), (5, 3e-7), (7, 1e-9)])
def test_exponential_polynomial_error_falls_with_degree(degree, least):
    f = np.linspace(-0.5, 0.5, 999)
    values = np.polyval(raster_variants.exp2_coefficients(degree), f)
    assert np.abs(values / np.exp2(f) - 1).max() < least


def test_kernels_can_be_converted_to_float64():
    finder, folder = raster_variants._DoubledFinder(), Path(raster_variants.__file__).parents[1] / "backend" / "raster"
    names = [f"backend.raster.{name}" for name in finder._SHARED]
    names += [f"backend.raster.cpu.{path.stem}" for path in (folder / "cpu").glob("[!_]*.py")]
    for name in names:
        spec = finder.find_spec(name, [str(folder / "cpu" if ".cpu." in name else folder)])
        assert isinstance(spec.loader, raster_variants._Doubled)
        assert spec.loader.get_code(spec.name)


def test_missing_constant_is_reported():
    with pytest.raises(RuntimeError, match="_NO_SUCH"):
        raster_variants._set_everywhere(_NO_SUCH=1.0)


def test_parts_cover_image_once():
    covered = np.zeros((100, 130), int)
    for x, y, width, height in raster_variants.parts_of(130, 100):
        covered[y : y + height, x : x + width] += 1
    assert (covered == 1).all()


def test_holes_are_enclosed_by_their_object():
    true = np.ones((30, 40), int)
    true[10:16, 10:16] = 2  # in front of 1, so it is not a hole
    found = true.copy()
    found[2:4, 2:6] = 0
    found[20:22, 20:22] = 2
    found[25, 30] = 0  # a speck
    found[0:5, 39] = 0  # at the border, so not enclosed
    assert mask_noise.holes_of(found, true) == (2, 12)


@pytest.mark.parametrize("kind", ["wrong IDs", "holes", "segmenter", "missing masks"])
def test_mask_noise_grows_with_level_and_keeps_truth(kind):
    true = np.repeat(np.arange(1, 9), 10)[None].repeat(60, 0)
    before = true.copy()
    mistake = mask_noise.KINDS[kind][0]

    def wrong(level):
        given = (mistake(true, level, np.random.default_rng(seed)) for seed in range(40))
        return np.mean([1.0 if ids is None else (ids != true).mean() for ids in given])

    low, high = wrong(0.1), wrong(0.5)
    assert 0.01 < low < 0.2 and low < high and (kind == "segmenter" or high == pytest.approx(0.5, abs=0.15))
    assert (true == before).all()


def test_cost_model_is_found_from_its_costs() -> None:
    rows = [
        {"photos": n, "points": n * d, "anchors": 0.9 * n * d, "disk_gb": 0.5 + 1e-4 * n + 2e-6 * 0.9 * n * d}
        for n in (100, 400, 1600)
        for d in (100, 400)
    ]
    found = scale.fit(rows, "disk_gb")
    assert found == pytest.approx({"": 0.5, "photos": 1e-4, "anchors": 2e-6})
    assert scale.predict(found, rows[3]) == pytest.approx(rows[3]["disk_gb"])
