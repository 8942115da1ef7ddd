"""The test of a GPU before its first use: what it compares, and what follows from its outcome."""

import signal
import sys
import time
from threading import Event

import numpy as np
import pytest
import torch

from backend.commands.setup import device as chosen
from backend.commands.setup.self_test import PRIMITIVES, difference, problem_of, results
from backend.raster import devices
from backend.shared.errors import Cancelled, InputError
from backend.shared.events import Reporter
from backend.shared.stopping import StoppingReporter, StopRequest

GPU = torch.device("cuda")

wait = Event().wait
"""As time.sleep, which tests replace."""


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return results(devices.CPU, tmp_path_factory.mktemp("scene") / "files")


def test_everything_that_trainings_need_is_compared(expected):
    for name in PRIMITIVES.values():
        assert {f"{what} of {name}" for what in ("color", "alpha", "depth", "objects", "losses")} <= set(expected)
        for of in ("positions", "rotations", "scales", "opacities", "colors"):
            assert np.abs(expected[f"gradients of the {of} of {name}"]).max() > 0
    assert "normals of discs" in expected and "distortion of discs" in expected
    # Splats are visible in most pixels, and not everywhere opaque.
    assert (expected["alpha of Gaussians"] > 0.3).mean() > 0.5 and (expected["alpha of Gaussians"] < 0.9).mean() > 0.1


def test_a_device_that_computes_the_same_passes(tmp_path, emulate_gpu, expected):
    emulate_gpu()
    found = results(devices.CPU, tmp_path / "files")
    assert any(not np.array_equal(found[name], right) for name, right in expected.items())
    assert difference(found, expected) == ""


@pytest.mark.parametrize("name", ["color of Gaussians", "normals of discs", "objects of discs", "losses of Gaussians",
                                  "gradients of the scales of discs"])  # fmt: skip
def test_what_differs_is_named(expected, name):
    rng = np.random.default_rng(0)
    wrong = expected[name].copy()
    if "gradients" in name or "losses" in name:
        # One lane of each warp does nothing, or the first step is wrong.
        wrong[::32] = 0
        what = f"the {name} differ for "
    else:
        # A block of 16 x 16 pixels, as with a missing barrier.
        wrong[..., 100:116, 100:116] += 1
        what = f"the {name} differ in 0.3% of the pixels"
    assert difference(expected | {name: wrong}, expected).startswith(what)
    # Rounding does not count.
    near = expected[name] * (1 + 1e-5 * rng.normal(size=expected[name].shape))
    assert difference(expected | {name: near}, expected) == ""


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_values_that_are_not_finite_are_named(expected, wrong):
    name = "gradients of the opacities of discs"
    values = expected[name].copy()
    values[7] = wrong
    assert difference(expected | {name: values}, expected) == f"the {name} are not finite"


class Messages(Reporter):
    def __init__(self):
        self.found = []

    def status(self, message, **_):
        self.found.append(message)

    def warning(self, message):
        self.found.append(f"Warning: {message}")


@pytest.fixture
def with_gpu(tmp_path, monkeypatch):
    """Function that sets what the test of a GPU runs, as Python code, and returns a function that chooses a device."""
    monkeypatch.setattr(devices, "pick", lambda requested: devices.CPU if requested == "cpu" else GPU)
    monkeypatch.setattr(devices, "name_of", lambda device: "cuda (Card)" if device == GPU else "cpu")
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    runs, limited = tmp_path / "runs.txt", []
    monkeypatch.setattr(devices, "limit_memory", limited.append)

    def use(code):
        counted = f"open({str(runs)!r}, 'a').write('x')\n{code}"
        monkeypatch.setattr(chosen, "_TEST", (sys.executable, "-c", counted))

        def choose(requested="auto", **options):
            messages = Messages()
            return chosen.choose_device(requested, messages, **options), messages.found

        choose.limited = limited
        choose.runs = lambda: len(runs.read_text()) if runs.exists() else 0
        return choose

    return use


PASSES = "print('a line of a library')\nprint('{\"problem\": \"\"}')"


def test_a_gpu_is_tested_once(with_gpu, monkeypatch):
    choose = with_gpu(PASSES)
    assert choose("cpu") == (devices.CPU, []) and choose.runs() == 0 and not choose.limited
    assert choose() == (GPU, ["Testing cuda (Card), once"]) and choose.limited == [GPU]
    assert choose() == choose("cuda") == (GPU, []) and choose.runs() == 1
    assert choose(again=True)[0] == GPU and choose.runs() == 2
    monkeypatch.setattr(chosen, "_driver", lambda: "a newer one")
    assert choose()[0] == GPU and choose.runs() == 3


def test_a_gpu_with_other_results_is_not_used(with_gpu):
    choose = with_gpu('print(\'{"problem": "the losses of discs differ by 7.0%"}\')')
    failure = "cuda (Card) fails a test (the losses of discs differ by 7.0%)"
    warning = (
        f"Warning: {failure}, so the CPU is used; a newer driver of the GPU may help, and `doctor` tests it again."
    )
    assert choose() == (devices.CPU, ["Testing cuda (Card), once", warning])
    assert choose() == (devices.CPU, [warning]) and choose.runs() == 1
    with pytest.raises(InputError) as error:
        choose("cuda")
    advice = "choose --device cpu, or install a newer driver of the GPU; `doctor` tests it again."
    assert str(error.value) == f"{failure}; {advice}"


@pytest.mark.parametrize(("code", "problem", "kept"), [
    ("raise RuntimeError('CUDA error: an illegal memory access was encountered')",
     "RuntimeError: CUDA error: an illegal memory access was encountered", True),
    ("raise RuntimeError('CUDA out of memory.')", "RuntimeError: CUDA out of memory", False),
    ("raise RuntimeError('CUDA error: CUDA-capable device(s) is/are busy or unavailable')",
     "RuntimeError: CUDA error: CUDA-capable device(s) is/are busy or unavailable", False),
    ("raise RuntimeError('CUDA error: out of memory\\nCompile with `TORCH_USE_CUDA_DSA` to enable assertions.')",
     "RuntimeError: CUDA error: out of memory", False),
    ("raise ValueError('The GPU Card has 0.9 GB of memory free, and 1 GB are needed; close programs that use it.')",
     "ValueError: The GPU Card has 0.9 GB of memory free, and 1 GB are needed; close programs that use it", False),
    ("raise RuntimeError('CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`')",
     "RuntimeError: CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`", False),
    ("raise OSError('[WinError 1455] Die Auslagerungsdatei ist zu klein.')",
     "OSError: [WinError 1455] Die Auslagerungsdatei ist zu klein", False),
    ("raise OSError(28, 'No space left on device')", "OSError: [Errno 28] No space left on device", False),
    ("raise MemoryError", "MemoryError", False),
    ("import signal; signal.raise_signal(signal.SIGTERM)", f"it ended with exit code {-signal.SIGTERM}", False),
    ("raise KeyboardInterrupt", "KeyboardInterrupt", False),
    ("import os; os.abort()", f"it ended with exit code {-signal.SIGABRT}", True),
    ("import os; os._exit(7)", "it ended with exit code 7", True),
    ("print('nothing of use')", "it ended with exit code 0", True),
])  # fmt: skip
def test_a_gpu_whose_test_fails_is_not_used(with_gpu, code, problem, kept):
    choose = with_gpu(code)
    device, messages = choose()
    assert device == devices.CPU and f"fails a test ({problem})" in messages[-1]
    choose()
    assert choose.runs() == (1 if kept else 2)


def test_a_gpu_that_blocks_is_not_used(with_gpu, monkeypatch):
    monkeypatch.setattr(chosen, "_LONGEST", 1.0)
    started = time.monotonic()
    device, messages = with_gpu("import time; time.sleep(60)")()
    assert device == devices.CPU and "it did not end in" in messages[-1] and time.monotonic() - started < 30


def test_the_test_can_be_stopped(with_gpu, tmp_path):
    choose = with_gpu("import time; time.sleep(60)")
    stop = StopRequest()
    stop._stopped = True
    with pytest.raises(Cancelled):
        chosen.choose_device("auto", StoppingReporter(Reporter(), stop))
    assert not list(tmp_path.glob("*.json"))
    assert choose.runs() <= 1


def test_an_interrupt_that_also_ends_the_test_is_no_failure_of_it(with_gpu, tmp_path, monkeypatch):
    with_gpu("raise KeyboardInterrupt")
    stop = StopRequest()
    # The test ends in the first sleep, before the stop is noticed.
    monkeypatch.setattr(chosen.time, "sleep", lambda _: (wait(2.0), setattr(stop, "_stopped", True)))
    with pytest.raises(Cancelled):
        chosen.choose_device("auto", StoppingReporter(Reporter(), stop))
    assert (tmp_path / "runs.txt").exists() and not list(tmp_path.glob("*.json"))


def test_without_a_place_for_the_outcome_a_gpu_is_tested_each_time(with_gpu, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    choose = with_gpu(PASSES)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "file" / "kernels"))
    assert choose()[0] == choose()[0] == GPU and choose.runs() == 2


def test_a_damaged_outcome_is_replaced(with_gpu, tmp_path):
    choose = with_gpu(PASSES)
    choose()
    (outcome,) = tmp_path.glob("*.device.json")
    for content in ("{", "[]", "{}", '{"problem": '):
        outcome.write_text(content)
        assert choose()[0] == GPU
    assert choose.runs() == 5 and choose()[0] == GPU and choose.runs() == 5


def test_the_real_test_ends_with_its_outcome(tmp_path, expected):
    assert problem_of(devices.CPU, tmp_path) == ""
