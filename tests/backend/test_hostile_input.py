"""Inputs made to block, to exhaust memory or to mislead, and output that cannot be written."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save

from backend.capture.files import mask_size
from backend.commands.objects.film import frame_path
from backend.export import read_splats
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED, InputError
from backend.shared.formats.json_file import read_json
from backend.shared.reconstruction.checkpoint import CURRENT, PREVIOUS
from tests.fuzz.mutations import npz_bomb, png_bomb

from .command_result import assert_rejected
from .test_commands import SMALL, trained  # noqa: F401

resource = pytest.importorskip("resource", reason="Windows has no limits and pipes as these tests need them")
ROOT = Path(__file__).resolve().parents[2]
posix = pytest.mark.skipif(os.name != "posix", reason="Windows has no such files or signals")


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


@posix
@pytest.mark.parametrize("command", ["check", "import"])
@pytest.mark.parametrize("kind", ["png", "npz", "photo"])
@pytest.mark.long
def test_decompression_bomb_is_rejected_by_its_header(write_capture, run_command, tmp_path, command, kind):
    capture = write_capture(views=4, size=(64, 48)).folder
    mask, photo = capture / "masks" / "view_001.png", capture / "images" / "view_001.png"
    if kind == "npz":
        mask.unlink()
        mask = mask.with_suffix(".npz")
        mask.write_bytes(npz_bomb(1 << 26))
    elif kind == "png":
        mask.write_bytes(png_bomb(13_000, 9_750))
    else:
        photo.write_bytes(png_bomb(13_000, 9_750))
    before = peak_bytes()
    out = ["--out", tmp_path / "out"] if command == "import" else []
    assert_rejected(run_command(command, capture, *out), "view_001", "64x48")
    assert peak_bytes() - before < 50 << 20


def test_mask_size_is_read_from_the_header(tmp_path):
    for shape in ((3, 5), (1, 3, 5), (3, 5, 1)):
        np.save(tmp_path / "ids.npy", np.zeros(shape, np.int32))
        np.savez(tmp_path / "ids.npz", ids=np.zeros(shape, np.int32))
        assert mask_size(tmp_path / "ids.npy") == mask_size(tmp_path / "ids.npz") == (5, 3)


@posix
@pytest.mark.parametrize(
    "name",
    ["images/view_001.png", "masks/view_001.png", "labels.json", "sparse/0/images.bin", "sparse/0/points3D.bin"],
)
@pytest.mark.parametrize("kind", ["pipe", "device", "loop"])
def test_special_file_in_a_capture_is_rejected(write_capture, run_command, tmp_path, name, kind):
    path = write_capture(views=4).folder / name
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero" if kind == "device" else path.name)
    result = run_command("import", tmp_path / "capture", "--out", tmp_path / "out")
    # A link to itself is like a missing file, and masks and labels may be missing.
    assert result.code == EXIT_BAD_INPUT or (kind == "loop" and result.code == EXIT_DONE)
    assert "Traceback" not in result.err and (kind == "loop" or path.name in result.err)


@posix
def test_pipe_in_a_reconstruction_is_rejected(trained, run_command, tmp_path):  # noqa: F811
    _, out = trained
    for name, command in (("splats.ply", ["export", out, "--out", tmp_path / "a.ply"]), ("objects.json", ["edit", out]),
                          ("objectgs.json", ["evaluate", out])):  # fmt: skip
        kept = (out / name).read_bytes()
        (out / name).unlink()
        os.mkfifo(out / name)
        assert_rejected(run_command(*command), name)
        (out / name).unlink()
        (out / name).write_bytes(kept)
    with pytest.raises(InputError, match="a pipe or a device"):
        read_json(Path("/dev/zero"))


CHANGES = {
    "missing tensor": lambda tensors: tensors.pop("adam.exp_avg"),
    "other shape": lambda tensors: tensors.update({"anchors.rows": tensors["anchors.rows"][:, :-1].copy()}),
    "other type": lambda tensors: tensors.update({"anchors.ids": tensors["anchors.ids"].astype(np.float32)}),
    "not finite": lambda tensors: tensors["heads.color.weight"].fill(np.nan),
    "class that does not exist": lambda tensors: tensors["anchors.ids"].fill(1000),
    "moments of another shape": lambda tensors: tensors.update({"head_adam.0.exp_avg": np.zeros(3, np.float32)}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_checkpoint_with_invalid_tensors_counts_as_damaged(trained, run_command, change):  # noqa: F811
    capture, out = trained
    folder = out / "checkpoint"
    shutil.copyfile(folder / CURRENT, folder / PREVIOUS)
    tensors = {name: tensor.copy() for name, tensor in load((folder / CURRENT).read_bytes()).items()}
    CHANGES[change](tensors)
    (folder / CURRENT).write_bytes(save(tensors, {"state": _state(folder / PREVIOUS)}))
    result = run_command("train", capture, "--out", out, "--steps", 22, *SMALL)
    assert result.code == EXIT_DONE and "damaged; continuing from the previous checkpoint" in result.err
    (folder / CURRENT).write_bytes(save(tensors, {"state": _state(folder / PREVIOUS)}))
    (folder / PREVIOUS).unlink()
    assert_rejected(run_command("evaluate", out), CURRENT, "damaged")


def _state(path: Path) -> str:
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as file:
        return file.metadata()["state"]


@pytest.mark.parametrize("value", [1e300, -1e308])
def test_far_points_are_left_out(write_capture, run_command, tmp_path, value):
    capture = write_capture(views=4, suffix=".txt").folder
    path = capture / "sparse" / "0" / "points3D.txt"
    lines = path.read_text().split("\n")
    words = lines[3].split(" ")
    lines[3] = " ".join([words[0], repr(value), *words[2:]])
    path.write_text("\n".join(lines))
    result = run_command("train", capture, "--out", tmp_path / "out", "--steps", 3, *SMALL)
    assert result.code == EXIT_DONE and "1 points whose coordinates are not finite or exceed 1e+12" in result.err


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e308, -1e308])
def test_huge_errors_of_points_give_no_warning(write_capture, run_command, value):
    capture = write_capture(views=4, suffix=".txt").folder
    path = capture / "sparse" / "0" / "points3D.txt"
    lines = path.read_text().split("\n")
    words = lines[3].split(" ")
    lines[3] = " ".join([*words[:7], repr(value), *words[8:]])
    path.write_text("\n".join(lines))
    assert run_command("check", capture).code == EXIT_DONE


def test_spherical_harmonics_beyond_degree_3_are_rejected(trained, tmp_path):  # noqa: F811
    data = (trained[1] / "splats.ply").read_bytes()
    extra = b"".join(b"property float f_rest_%d\n" % i for i in range(9, 3 * (32**2 - 1)))
    (tmp_path / "many.ply").write_bytes(
        data.replace(b"property float opacity", extra + b"property float opacity", 1) + bytes(1 << 23)
    )
    with pytest.raises(InputError, match="3069 properties"):
        read_splats(tmp_path / "many.ply")


def test_film_without_png_keeps_foreign_images(trained, run_command, tmp_path):  # noqa: F811
    from backend.shared.reconstruction.shot import Frame, Sample, Shot, write_shot

    K = np.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[2, 3] = 4
    write_shot(tmp_path / "shot.json", Shot(16, 12, [Frame(1, (1, 1), [Sample(1.0, viewmat, K, (0.1, 100.0))])]))
    folder = tmp_path / "film"
    folder.mkdir()
    image = frame_path(folder, 1).with_suffix(".png")
    image.write_text("not yours")
    film = ("film", trained[1], "--shot", tmp_path / "shot.json", "--out", folder)
    assert run_command(*film).code == EXIT_DONE and image.read_text() == "not yours"


def run_shell(script: str, *words: object, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["bash", "-c", f'set -o pipefail; "$@" {script}', "bash", sys.executable, "-m", "backend", *map(str, words)],
        cwd=ROOT, capture_output=True, env={**os.environ, **environment}, timeout=120, check=False,
    )  # fmt: skip


@posix
@pytest.mark.parametrize(
    ("script", "environment", "codes"),
    [
        (">&- 2>&-", {}, {EXIT_BAD_INPUT}),
        (" --json >/dev/full 2>&1", {}, {EXIT_BAD_INPUT, EXIT_FAILED}),
        ("2>&1 | true", {}, {EXIT_BAD_INPUT, EXIT_CANCELLED}),
        ("", {"PYTHONIOENCODING": "ascii"}, {EXIT_BAD_INPUT}),
    ],
)
@pytest.mark.long
def test_lost_output_leaves_exit_code_and_no_traceback(tmp_path, script, environment, codes):
    if "/dev/full" in script and not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    result = run_shell(script, "check", tmp_path / "g\u00e4rten \U0001f33b", **environment)
    assert result.returncode in codes, result
    assert b"Traceback" not in result.stderr and b"Exception ignored" not in result.stderr
    if environment:
        assert rb"g\xe4rten \U0001f33b" in result.stderr


@posix
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.long
def test_signal_during_imports_stops_the_command(write_capture, number):
    capture = write_capture(views=4).folder
    command = [sys.executable, "-m", "backend", "check", str(capture)]
    for moment in (0.5, 1.0):
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            time.sleep(moment)
            process.send_signal(number)
            out, err = process.communicate(timeout=120)
        assert (process.returncode, err) == (EXIT_CANCELLED, "") and "Stopped" in out
