"""Expected duration and quality of a training."""

import pytest

from backend.shared import expectation
from backend.shared.expectation import shortfall


@pytest.fixture(autouse=True)
def measured(monkeypatch):
    monkeypatch.setattr(expectation, "SHORT_OF_FINAL", {100: (2.0, 4.0), 400: (1.0, 2.0), 1600: (0.0, 1.0)})
    monkeypatch.setattr(expectation, "NANOSECONDS_A_PIXEL", (500.0, 2000.0))


FINAL = "a training until it stops improving (measured on the demo)"


def expected(*arguments):
    return expectation.expectation(*arguments)


def test_shortfall_interpolates_over_log_steps():
    assert shortfall(400) == pytest.approx((1.0, 2.0))
    assert shortfall(200) == pytest.approx((1.5, 3.0)) and shortfall(800) == pytest.approx((0.5, 1.5))
    assert shortfall(10) == (2.0, 4.0) and shortfall(1e6) == (0.0, 1.0)


def test_steps_give_duration_and_quality():
    assert expected(400, None, 100_000) == (f"Expected in 20 to 80 s on a CPU: 1.0 to 2.0 dB below {FINAL}")
    assert expected(1600, None, 100_000) == (f"Expected in 80 s to 5 min on a CPU: up to 1.0 dB below {FINAL}")


def test_minutes_give_step_range():
    # 0.05 to 0.2 s per step: the lowest number of steps determines the largest loss of quality.
    assert expected(None, 80.0, 100_000) == (f"Expected of 400 to 1,600 steps on a CPU: up to 2.0 dB below {FINAL}")


def test_fewest_steps_of_a_time_are_those_told():
    assert expectation.expected_steps(80.0, 100_000) == 400
    assert expectation.expected_steps(100.0, 100_000, (200, 50.0)) == 400
    assert expectation.expected_steps(80.0, None) is None, "unknown device"
    assert [expectation.is_far_fewer(steps, 400) for steps in (27, 199, 200, 400)] == [True, True, False, False]
    assert not expectation.is_far_fewer(1, None)


def test_own_measurements_replace_typical_speed():
    assert expected(None, 100.0, 100_000, (200, 50.0)) == (f"Expected of 400 steps: 1.0 to 2.0 dB below {FINAL}")
    assert "in 1.7 min:" in expected(400, None, 100_000, (200, 50.0))


def test_very_short_trainings_have_lower_bound_only():
    assert expected(30, None, None) == f"Expected: more than 2.0 dB below {FINAL}"


def test_unknown_device_gives_no_duration():
    assert expected(None, 60.0, None) is None
    assert expected(400, None, None) == f"Expected: 1.0 to 2.0 dB below {FINAL}"
    assert expected(None, None, 100_000) is None


def test_negligible_loss_is_reported(monkeypatch):
    monkeypatch.setattr(expectation, "SHORT_OF_FINAL", {400: (1.0, 2.0), 1600: (0.0, 0.04)})
    assert expected(1600, None, None) == f"Expected: as good as {FINAL}"


def test_words_tell_duration_and_sharpness():
    words = expectation.expectation_in_words
    assert words(400, None, 100_000) == "about 20 to 80 s, softer than Best"
    assert words(1600, None, 400_000) == "about 5 to 21 min, a little softer than Best"
    assert words(1600, None, None) == "a little softer than Best"
    assert words(None, 400.0, 100_000, (200, 50.0)) == "a little softer than Best"
    assert words(400, None, 100_000, (200, 50.0)) == "about 1.7 min, softer than Best"
    assert words(None, 60.0, None) is None
    assert words(None, 120.0, 100_000) is None, "in this time, it gets softer or not"


def test_words_tell_lengths_apart(monkeypatch):
    monkeypatch.undo()
    words = expectation.expectation_in_words
    assert words(600, None, 500_000, (0, 0.0), 27.0) == "about 1.5 to 6 min, probably good, softer than Best"
    assert words(1500, None, 500_000, (0, 0.0), 27.0) == "about 4 to 15 min, probably good, nearly as sharp as Best"
    assert words(None, 300.0, 500_000, (0, 0.0), 27.0) == "probably good"
    assert words(None, None, 500_000, (0, 0.0), 27.0) == "probably good"


def test_typical_quality_of_the_capture_gives_an_interval(monkeypatch):
    monkeypatch.setattr(expectation, "PSNR_FIT", expectation.PsnrFit(-10.0, 1.0, -2.0, 3.0))
    typical = expectation.typical_psnr(40.0, 2e6)
    assert typical == pytest.approx(28.0)
    assert expectation.expected_psnr(typical, 400, None, None) == pytest.approx((23.5, 29.5))
    assert expectation.expected_psnr(typical, None, 60.0, None) == pytest.approx((25.0, 31.0)), "unknown speed"
    interval = "PSNR of 24 to 30 dB on held-out views with their colors corrected, as on 80% of captures"
    assert expected(400, None, None, (0, 0.0), typical) == f"Expected: {interval}; 1.0 to 2.0 dB below {FINAL}"
    assert expected(None, None, None, (0, 0.0), typical).startswith("Expected: PSNR of 25 to 31 dB")
    words = expectation.expectation_in_words
    assert words(400, None, 100_000, (0, 0.0), typical) == "about 20 to 80 s, probably good, softer than Best"
