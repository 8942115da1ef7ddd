"""Conversion of 3D Gaussians to discs, and the fit of discs that meshes are made of."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from backend.model.anchors import Layout, seed_anchors
from backend.model.discs import to_discs
from backend.model.heads import Heads
from backend.model.object_model import Normalization, ObjectModel
from backend.shared.class_table import ClassTable
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, Cancelled
from backend.shared.stopping import StopRequest
from backend.training.budget import TrainingProgress
from backend.training.fine_tuning import fit_discs
from backend.training.trainer import Trainer

DRAWN = ("--offsets", 4, "--background", "black")


def model_of(mode: str = "explicit", primitive: str = "3d") -> ObjectModel:
    """A model with splats of all shapes."""
    rng, generator, layout = np.random.default_rng(0), torch.Generator().manual_seed(0), Layout(4)
    xyz = rng.uniform(-1, 1, (40, 3))
    anchors = seed_anchors(xyz, rng.uniform(0, 1, (40, 3)), np.zeros(40, np.int64), 0.05, layout, rng)
    anchors.rows += torch.randn(anchors.rows.shape, generator=generator) * 0.7
    heads = Heads(layout, mode, 1, generator)
    return ObjectModel(
        anchors, heads, torch.zeros(3), ClassTable(np.zeros(1)), Normalization((0.0, 0.0, 0.0), 1.0), primitive
    )


def axes_of(quats: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions."""
    w, x, y, z = torch.nn.functional.normalize(quats.double(), dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


def test_discs_are_gaussians_without_their_smallest_axis() -> None:
    model = model_of()
    before, discs = model.generate(), to_discs(model)
    after = discs.generate()
    assert discs.primitive == "2d" and model.primitive == "3d"
    for name in ("means", "opacities", "sh", "ids", "source"):
        assert torch.equal(getattr(before, name), getattr(after, name)), name
    scales = before.scales.double()
    assert len(scales) > 50 and len(scales.argmin(1).unique()) == 3
    flat = torch.where(torch.arange(3) == scales.argmin(1)[:, None], 0.0, scales)
    axes = axes_of(before.quats) * flat[:, None]
    discs_axes = (
        axes_of(after.quats) * torch.cat([after.scales[:, :2].double(), torch.zeros(len(scales), 1)], 1)[:, None]
    )
    covariance = discs_axes @ discs_axes.mT
    size = scales.amax(1)[:, None, None] ** 2
    assert ((covariance - axes @ axes.mT).abs() / size).max() < 1e-3


@pytest.mark.parametrize(("mode", "primitive"), [("view", "3d"), ("explicit", "2d")])
def test_other_models_are_not_converted(mode: str, primitive: str) -> None:
    with pytest.raises(ValueError, match="only explicit models of 3D Gaussians"):
        to_discs(model_of(mode, primitive))


def test_fit_begins_on_plateau_and_ends() -> None:
    budget, progress = fit_discs.budget_of_discs(1000), TrainingProgress()
    assert budget.progress(progress) == pytest.approx(fit_discs.FIRST) and budget.displayed_progress(progress) == 0
    progress.step = 100
    assert budget.displayed_progress(progress) == pytest.approx(0.5)
    progress.step = 200
    assert budget.progress(progress) == 1.0 and budget.displayed_progress(progress) == pytest.approx(1.0)


@pytest.fixture
def steps(monkeypatch):
    """Record the type and the progress of each step, and stop at a step."""
    taken: list[tuple[str, float]] = []
    step = Trainer.step

    def recorded(trainer, progress):
        if len(taken) == recorded.stop_at:
            raise Cancelled("Stopped.")
        taken.append((trainer.settings.primitive, progress))
        return step(trainer, progress)

    recorded.stop_at = None
    monkeypatch.setattr(Trainer, "step", recorded)
    return taken, recorded


@pytest.mark.long
def test_meshes_are_made_of_discs_that_are_fitted_once(write_capture, run_command, tmp_path, steps) -> None:
    taken, recorded = steps
    out = tmp_path / "out"
    train = ("train", write_capture(views=9, size=(64, 48)).folder, "--out", out, *DRAWN)
    assert run_command(*train, "--steps", 50).code == EXIT_DONE
    splats, mesh = (out / "splats.ply").read_bytes(), ("mesh", out, "--faces", 500, "--texture-size", 256)
    taken.clear()
    recorded.stop_at = 0
    assert run_command(*mesh).code == EXIT_CANCELLED and not taken
    recorded.stop_at = None
    result = run_command(*mesh, "--json")
    assert result.code == EXIT_DONE and len(taken) == 10 and {kind for kind, _ in taken} == {"2d"}
    assert all(fit_discs.FIRST <= progress < 1 for _, progress in taken)
    assert any(event.get("stage") == "Fitting discs" for event in result.events)
    (kept,) = (out / "cache").glob("discs-*")
    assert run_command(*mesh, "--restart").code == EXIT_DONE and len(taken) == 10, "the fit is kept"
    assert (out / "splats.ply").read_bytes() == splats, "the model that is displayed remains"
    for file in kept.iterdir():
        file.write_bytes(b"damaged")
    assert run_command(*mesh, "--restart").code == EXIT_DONE and len(taken) == 20, "a damaged fit is made anew"
    assert run_command(*train, "--steps", 60).code == EXIT_DONE
    taken.clear()
    assert run_command(*mesh).code == EXIT_DONE and len(taken) == 12
    assert [path.name for path in (out / "cache").glob("discs-*")] != [kept.name], "another state has its own discs"


def test_stopped_fit_is_continued(write_capture, run_command, tmp_path, steps, monkeypatch) -> None:
    taken, _ = steps
    out = tmp_path / "out"
    scene = write_capture(views=9, size=(64, 48))
    assert run_command("train", scene.folder, "--out", out, "--steps", 50, *DRAWN).code == EXIT_DONE
    taken.clear()
    with monkeypatch.context() as context:
        context.setattr(StopRequest, "__call__", lambda _: len(taken) == 4)
        assert run_command("mesh", out).code == EXIT_CANCELLED
    assert run_command("mesh", out, "--faces", 500, "--texture-size", 256).code == EXIT_DONE
    assert len(taken) == 10 and len({progress for _, progress in taken}) == 10


def test_model_of_discs_is_meshed_as_it_is(write_capture, run_command, tmp_path, steps) -> None:
    taken, _ = steps
    out = tmp_path / "out"
    train = ("train", write_capture(views=9, size=(64, 48)).folder, "--out", out, "--primitive", "2d", *DRAWN)
    assert run_command(*train, "--steps", 20).code == EXIT_DONE
    taken.clear()
    run_command("mesh", out, "--faces", 500, "--texture-size", 256)
    assert not taken and not list((out / "cache").glob("discs-*"))
