"""How well photos agree with their neighbors, and the expectation that follows from it."""

import json

import numpy as np
import pytest
from PIL import Image

from backend.capture import load_capture
from backend.planning.agreement import measure_agreement
from backend.shared import expectation
from backend.shared.errors import EXIT_DONE
from benchmarks import suite

VIEWS = 24
AROUND = {"spheres": [(1, np.zeros(3), 1.0)], "points": 3000}


def painted(write_capture, name="capture", noise=0.0, gains=None, **options):
    """Write a capture of a sphere whose colors are a smooth function of the position, and return its folder."""
    scene = write_capture(name, views=VIEWS, size=(96, 72), **{**AROUND, **options})
    rng = np.random.default_rng(0)
    rays = write_capture.rays_of(scene.lens())
    for i, (file, viewmat, depth) in enumerate(zip(scene.names, scene.viewmats, scene.depths, strict=True)):
        hit = np.isfinite(depth)
        world = (rays * np.where(hit, depth, 0.0)[..., None] - viewmat[:3, 3]) @ viewmat[:3, :3]
        colors = np.where(hit[..., None], 0.5 + 0.3 * np.sin(4 * world), 0.1)
        colors = colors * (1.0 if gains is None else gains[i]) + rng.normal(0, noise, colors.shape)
        Image.fromarray(np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)).save(scene.folder / "images" / file)
    return scene.folder


def agreement_of(folder, tmp_path):
    return measure_agreement(load_capture(folder, tmp_path / "cache" / folder.name))


def test_noise_and_wrong_poses_lower_the_agreement_and_exposure_does_not(write_capture, tmp_path):
    exact = agreement_of(painted(write_capture), tmp_path)
    gains = np.linspace(0.6, 1.2, VIEWS)
    assert agreement_of(painted(write_capture, "gains", gains=gains), tmp_path) == pytest.approx(exact, abs=2.5)
    noisy = [agreement_of(painted(write_capture, f"noise-{n}", noise=n), tmp_path) for n in (0.02, 0.06)]
    assert exact > noisy[0] + 3 and noisy[0] > noisy[1] + 6
    scene = write_capture("swapped", views=VIEWS, size=(96, 72), **AROUND)
    folder = painted(write_capture, "other")
    for i, name in enumerate(scene.names):
        (scene.folder / "images" / name).write_bytes((folder / "images" / scene.names[i * 5 % VIEWS]).read_bytes())
    assert agreement_of(scene.folder, tmp_path) < exact - 6


def test_photos_without_common_points_have_no_agreement(write_capture, tmp_path):
    folder = painted(write_capture, points=4)
    assert agreement_of(folder, tmp_path) is None


def test_expectation_is_recorded_and_compared_in_the_report(write_capture, tmp_path, run_command, monkeypatch):
    folder, out = painted(write_capture), tmp_path / "out"
    assert run_command("import", folder, "--out", out).code == EXIT_DONE
    record = json.loads((out / "objectgs.json").read_text())
    assert record["capture"]["agreement"] == pytest.approx(agreement_of(folder, tmp_path))
    trained = run_command("train", folder, "--out", out, "--steps", 4, "--offsets", 2, "--json")
    assert any("PSNR of " in text and " dB on held-out views" in text for text in trained.messages("status"))
    record = json.loads((out / "objectgs.json").read_text())
    low, high = record["training"]["expected_psnr"]
    assert high - low == pytest.approx(2 * expectation.PSNR_FIT.margin, abs=0.02)
    assert run_command("evaluate", out).code == run_command("report", out).code == EXIT_DONE
    assert f"{low:.1f} to {high:.1f} dB" in (out / "report.md").read_text(encoding="utf-8")
    assert json.loads((out / "report.json").read_text())["model"]["expected_psnr"] == [low, high]


def test_far_fewer_steps_than_expected_are_told(write_capture, tmp_path, run_command, monkeypatch):
    monkeypatch.setattr(expectation, "NANOSECONDS_A_PIXEL", (0.1, 0.1))
    folder, out = painted(write_capture), tmp_path / "out"
    trained = run_command("train", folder, "--out", out, "--minutes", 0.01, "--offsets", 2, "--json")
    (told,) = (text for text in trained.messages("warning") if "steps that were expected in 0.01 minutes" in text)
    assert trained.code == EXIT_DONE and told.startswith(f"Only {trained.events[-1]['steps']:,} of the ")
    assert run_command("evaluate", out).code == run_command("report", out).code == EXIT_DONE
    model = json.loads((out / "report.json").read_text())["model"]
    said = f"Only {model['trained_steps']:,} steps were trained in the time that was given, of "
    assert f"{said}{model['expected_steps']:,} or more" in (out / "report.md").read_text(encoding="utf-8")
    longer = run_command("train", folder, "--out", out, "--steps", model["trained_steps"] + 1, "--offsets", 2, "--json")
    assert not [text for text in longer.messages("warning") if "expected" in text], "the length is no time"


def test_fit_is_found_again_and_its_margin_covers_most_captures():
    rng = np.random.default_rng(1)
    found = {}
    for i in range(200):
        agreement, pixels, error = rng.uniform(25, 45), rng.uniform(1e5, 2e6), rng.normal(0, 2)
        psnr = 5 + 0.7 * agreement - 2 * np.log2(pixels / 1e6) + error
        row = {"agreement": agreement, "pixels": pixels, "psnr_corrected_mean": psnr, "steps": 10**6}
        found[str(i)] = {"1.0": {**row, "psnr_corrected_mean": 0.0}, "5.0": row}
    fit, errors = suite.fit_of_psnr(found)
    assert np.allclose(fit[:3], (5, 0.7, -2), atol=1.5) and fit.margin == pytest.approx(1.28 * 2, abs=0.4)
    assert 0.79 <= np.mean([abs(error) <= fit.margin for error in errors.values()]) <= 0.82
