"""The comparison of poses in `benchmarks/poses.py`."""

import numpy as np
import pytest

from benchmarks import poses

from .rendered_photos import ring


def moved(matrix: np.ndarray, scale: float, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the pose of a camera in a world that is scaled, turned and shifted."""
    center = scale * turn @ (-matrix[:, :3].T @ matrix[:, 3]) + shift
    rotation = matrix[:, :3] @ turn.T
    return np.column_stack([rotation, -rotation @ center])


def test_errors_are_measured_after_a_fit_that_wrong_poses_do_not_change():
    true = {str(number): matrix for number, matrix in enumerate(ring(12))}
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    found = {name: moved(matrix, 3.0, turn, np.array([1.0, -2.0, 0.5])) for name, matrix in true.items()}
    degrees, positions = poses.pose_errors(found, true)
    assert degrees.max() < 1e-4 and positions.max() < 1e-9
    for name in ("2", "7", "9"):
        found[name] = moved(ring(3, turn=1.5)[int(name) % 3], 3.0, turn, np.zeros(3))
    result = poses.compared(found, true)
    assert result["wrong"] == 3 and result["degrees"] < 1e-4 and result["position"] < 1e-9
    assert poses.compared({"1": found["1"]}, true)["wrong"] is None


def test_llff_poses_have_axes_down_right_back(tmp_path):
    (matrix,) = ring(1)
    center = -matrix[:, :3].T @ matrix[:, 3]
    right, down, forward = matrix[:, :3]
    row = np.column_stack([down, right, -forward, center, (480, 640, 500)])
    np.save(tmp_path / "poses_bounds.npy", np.concatenate([row.ravel(), [0.1, 9.0]])[None])
    (found,) = poses.llff_poses(tmp_path / "poses_bounds.npy", ["a.jpg"]).values()
    assert found == pytest.approx(matrix)


def test_document_has_a_row_for_each_program():
    ours = {
        "seconds": 30.0, "stages": dict.fromkeys(poses._STAGES, 5.0), "photos": 48, "registered": 48, "weak": 0,
        "degrees": 0.01, "position": 0.001, "wrong": 0, "compared": 48,
    }  # fmt: skip
    refused = {**ours, "registered": 0, "refused": "They were taken\nfrom one spot."}
    found = {"demo": {"ours": ours, "defaults": {**ours, "seconds": 60.0}}, "panorama": {"ours": refused}}
    text = poses.document(found)
    assert "| demo | ours | 48 of 48 | 0.010 | 0.10% | 0 | 30 |" in text and "| demo | COLMAP |" in text
    assert "- *panorama*: They were taken from one spot." in text
