"""Adam for the heads against torch.optim.Adam."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.training.optimizer.adam import BETA1, BETA2, EPSILON, LARGEST_GRADIENT
from backend.training.optimizer.head_adam import HeadAdam

ROOT = Path(__file__).parents[2]
SHAPES = {"mlp": [(5, 7), (5,)], "color": [(3, 2)], "unused": [(4,)]}


def parameters(seed=0):
    rng = torch.Generator().manual_seed(seed)
    return {name: [torch.randn(s, generator=rng).requires_grad_() for s in shapes] for name, shapes in SHAPES.items()}


def rates(step):
    return {name: 0.01 / (step + 1) * (number + 1) for number, name in enumerate(SHAPES)}


def set_gradients(groups, step):
    rng = torch.Generator().manual_seed(100 + step)
    for name, group in groups.items():
        for parameter in group:
            # A group that gets its first gradient later.
            parameter.grad = None if name == "unused" and step < 3 else torch.randn(parameter.shape, generator=rng)


def stepped(optimizer, groups, steps, skipping=()):
    for step in steps:
        set_gradients(groups, step)
        optimizer.step(rates(step), torch.tensor(step not in skipping))
    return [parameter.detach().clone() for group in groups.values() for parameter in group]


@pytest.mark.parametrize("skipping", [(), (0, 4)])
def test_steps_are_those_of_torch(skipping):
    groups, theirs = parameters(), parameters()
    found = stepped(HeadAdam(groups), groups, range(6), skipping)
    adam = torch.optim.Adam(
        [{"params": group, "name": name} for name, group in theirs.items()], betas=(BETA1, BETA2), eps=EPSILON,
        fused=True,
    )  # fmt: skip
    for step in range(6):
        set_gradients(theirs, step)
        for group in adam.param_groups:
            group["lr"] = rates(step)[group["name"]]
        adam.found_inf = torch.tensor(float(step in skipping))
        adam.step()
    for a, b in zip(found, (parameter for group in theirs.values() for parameter in group), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("unusable", [None, torch.inf, 2 * LARGEST_GRADIENT])
def test_steps_of_an_emulated_gpu_are_those_of_the_cpu(emulate_gpu, unusable):
    """A step with a gradient that is not finite, or whose square is not, changes nothing."""
    found = []
    for on_gpu in (False, True):
        emulate_gpu(on_gpu)
        groups = parameters()
        optimizer = HeadAdam(groups)
        stepped(optimizer, groups, range(5), (1,))
        set_gradients(groups, 6)
        if unusable is not None:
            groups["color"][0].grad[1, 1] = unusable
        updated = optimizer.step(rates(6), torch.tensor(True))
        assert bool(updated) == (unusable is None)
        found.append(
            {**optimizer.tensors(), **{f"{n}{i}": p.detach() for n, g in groups.items() for i, p in enumerate(g)}}
        )
    assert found[0].keys() == found[1].keys()
    for name, value in found[0].items():
        torch.testing.assert_close(found[1][name], value, rtol=1e-5, atol=1e-7, msg=name)


def test_restored_state_goes_on_as_before():
    groups = parameters()
    optimizer = HeadAdam(groups)
    stepped(optimizer, groups, range(2))
    saved = {name: np.atleast_1d(value.numpy()).copy() for name, value in optimizer.tensors().items()}
    assert set(saved) == {f"head_adam.{i}.{name}" for i in range(3) for name in ("step", "exp_avg", "exp_avg_sq")}
    copies = {name: [each.detach().clone().requires_grad_() for each in group] for name, group in groups.items()}
    restored = HeadAdam(copies)
    restored.restore(saved)
    expected = stepped(optimizer, groups, range(2, 6))
    for a, b in zip(stepped(restored, copies, range(2, 6)), expected, strict=True):
        assert torch.equal(a, b)


def test_gradients_are_removed():
    groups = parameters()
    optimizer = HeadAdam(groups)
    set_gradients(groups, 5)
    optimizer.zero_grad()
    assert all(parameter.grad is None for group in groups.values() for parameter in group)


def test_training_does_not_import_the_compiler(tiny):
    """Its import takes as long as that of all others together."""
    capture, _ = tiny()
    script = f"""
import sys
from pathlib import Path
from backend.capture import load_capture
from backend.labels import vote
from backend.training.settings import Settings
from backend.training.trainer import Trainer
capture = load_capture(Path({str(capture.folder)!r}), Path({str(capture.folder.parent / "cache")!r}))
Trainer.start(capture, vote(capture).ids, Settings(offsets=4)).step(0.5)
assert "torch._dynamo" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_parameters_are_ahead_only_within_the_context():
    groups = parameters()
    optimizer = HeadAdam(groups)
    start = [parameter.detach().clone() for group in groups.values() for parameter in group]

    def values():
        return [parameter.detach().clone() for group in groups.values() for parameter in group]

    with optimizer.ahead(3, rates(0)):
        assert all(map(torch.equal, values(), start)), "nothing is expected before the first step"
    constant = {name: [torch.randn(p.shape) for p in group] for name, group in groups.items()}

    def step(count):
        for _ in range(count):
            for name, group in groups.items():
                for parameter, gradient in zip(group, constant[name], strict=True):
                    parameter.grad = gradient.clone()
            optimizer.step(rates(0))

    step(5)
    before = values()
    found = []

    def fail():
        with optimizer.ahead(3, rates(0)):
            found.extend(values())
            raise ValueError

    with pytest.raises(ValueError):
        fail()
    assert all(map(torch.equal, values(), before))
    step(3)
    for a, b, c in zip(found, values(), before, strict=True):
        assert not torch.equal(a, c)
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)


def test_skipped_first_step_is_no_reason_to_expect_a_change():
    groups = parameters()
    optimizer = HeadAdam(groups)
    before = stepped(optimizer, groups, range(1), skipping=(0,))
    with optimizer.ahead(2, rates(0)):
        found = [parameter.detach().clone() for group in groups.values() for parameter in group]
    assert all(map(torch.equal, found, before))
