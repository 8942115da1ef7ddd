# SPDX-License-Identifier: GPL-3.0-or-later
"""headless.py: output of its commands, exit codes, and stopping at any time."""

import errno
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.backend.cli.parser import build_parser
from objectgs.backend.shared.console import ConsoleReporter
from objectgs.backend.shared.formats.ply import read_vertices
from objectgs.backend.shared.reconstruction.lock import locked
from objectgs.backend.shared.reconstruction.objects import edit_objects
from objectgs.objectgs_addon.headless import COMMANDS, commands
from objectgs.objectgs_addon.headless.batch import _Summary, fingerprint
from objectgs.objectgs_addon.headless.picture import open_blend, write_picture

import headless

from .building import look_at, tetrahedron, write_cameras, write_folder, write_meshes, write_objects, write_points

SIZE = ("--size", "48x36", "--samples", "1")


def start(*arguments, **variables):
    environment = {**os.environ, **variables}
    return subprocess.Popen(
        [sys.executable, headless.__file__, *map(str, arguments)],
        env=environment,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def run(*arguments, **variables):
    process = start(*arguments, **variables)
    process.output, process.errors = process.communicate(timeout=400)
    return process


def error_report(*arguments, **variables):
    """Return the error of a command that must fail with one sentence and exit code 2."""
    ran = run(*arguments, **variables)
    assert ran.returncode == 2, ran.output + ran.errors
    assert ran.errors.count("\n") == 1 and "Traceback" not in ran.output, ran.errors
    return ran.errors


def size_of(path):
    image = bpy.data.images.load(str(path))
    try:
        return tuple(image.size)
    finally:
        bpy.data.images.remove(image)


@pytest.fixture(scope="module")
def blend(trained, tmp_path_factory):
    """The .blend that `build` creates from the reconstruction."""
    file = tmp_path_factory.mktemp("blend") / "made" / "scene.blend"
    ran = run("build", trained, "--blend", file)
    assert ran.returncode == 0, ran.output + ran.errors
    return file


def test_help_lists_commands(capsys):
    ran = run("--help")
    assert ran.returncode == 0
    for command in COMMANDS:
        assert f"\n    {command}" in ran.output
        with pytest.raises(SystemExit) as ended:
            headless.main([command, "--help"])
        assert ended.value.code == 0
        assert capsys.readouterr().out.startswith(f"usage: headless.py {command}")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "COMMAND"),
        (("grow",), "grow"),
        (("build",), "DIR"),
        (("train", "somewhere"), "--out"),
        (("train", "--out", "x"), "CAPTURE must come first"),
        (("run", "--steps", "5", "somewhere", "--out", "x"), "CAPTURE must come first"),
        (("build", "x", "--color", "red"), "--color"),
        (("render", "x", "--out", "a.png", "--size", "640"), "640x480"),
        (("render", "x", "--out", "a.png", "--samples", "0"), "'0'"),
        (("render", "x", "--out", "a.png", "--show", "points"), "points"),
        (("mesh", "--scene"), "DIR must come first: headless.py mesh DIR."),
        (("edit", "--remove", "mug"), "DIR must come first: headless.py edit DIR."),
        (("export", "somewhere"), "--out"),
        (("export-meshes", "somewhere"), "--out"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, words, capsys):
    assert headless.main(list(arguments)) == 2
    captured = capsys.readouterr()
    assert words in captured.err and captured.err.count("\n") == 1 and not captured.out


@pytest.mark.parametrize(
    ("version", "code", "words"),
    [((4, 1, 1), 2, "needs Blender 4.2 or newer; this is Blender 4.1.1."), ((4, 2, 0), 1, "ImportError: no StrEnum")],
)
def test_failures_to_start_have_exit_codes(monkeypatch, capsys, version, code, words):
    def fail(_arguments):
        raise ImportError("no StrEnum")

    monkeypatch.setattr(headless, "main", fail)
    monkeypatch.setitem(sys.modules, "bpy", SimpleNamespace(app=SimpleNamespace(version=version)))
    assert headless._run() == code
    assert words in capsys.readouterr().err
    manifest = tomllib.loads((headless.ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert manifest["blender_version_min"].startswith(".".join(map(str, headless.OLDEST)))


def test_build_contains_reconstruction(blend, trained):
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    kinds = {collection.get("objectgs_kind") for collection in bpy.data.collections}
    assert {"reconstruction", "capture", "object"} <= kinds
    names = {collection.name for collection in bpy.data.collections if collection.get("objectgs_kind") == "object"}
    wanted = {entry["name"] for entry in json.loads((trained / "objects.json").read_text())["objects"]}
    assert wanted <= names
    assert bpy.context.scene.camera is not None
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_build_keeps_a_file_that_was_saved_since(tmp_path, monkeypatch, capsys):
    write_cameras(tmp_path, [look_at((0, -1, 10.0))])
    write_points(tmp_path, np.random.default_rng(0).normal(size=(9, 3)), np.ones(9, int))
    write_objects(tmp_path, {1: "mug"})
    first, second = tmp_path / "objectgs.blend", tmp_path / "objectgs-2.blend"
    for _ in range(2):
        assert headless.main(["build", str(tmp_path)]) == 0
    assert not second.exists() and "kept" not in capsys.readouterr().err
    bpy.ops.wm.save_as_mainfile(filepath=str(first))
    saved = first.read_bytes()
    for _ in range(2):
        assert headless.main(["build", str(tmp_path)]) == 0
        assert "kept; objectgs-2.blend is written instead." in capsys.readouterr().err
    assert first.read_bytes() == saved and second.exists() and not (tmp_path / "objectgs-3.blend").exists()
    rendered = []
    monkeypatch.setattr(commands, "render_picture", lambda _reporter, blend, *_: rendered.append(blend))
    words = ["render", str(tmp_path), "--out", str(tmp_path / "a.png")]
    assert headless.main(words) == 0 and rendered == [second]
    assert f"Rendering {second}" in capsys.readouterr().out
    second.write_bytes(b"saved, too")
    assert headless.main(words) == 0 and rendered == [second, second]
    second.unlink()
    assert headless.main(words) == 0 and rendered == [second, second, first]
    assert "Rendering" not in capsys.readouterr().out.splitlines()[-1]
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.long
def test_build_and_render_reject_invalid_input(trained, blend, tmp_path):
    assert "no reconstruction" in error_report("build", tmp_path)
    assert "build" in error_report("render", tmp_path, "--out", tmp_path / "a.png")
    assert ".png" in error_report("render", blend, "--out", tmp_path / "a.tiff")
    assert "no camera 'nobody'" in error_report("render", blend, "--out", tmp_path / "a.png", "--camera", "nobody")
    broken = tmp_path / "broken.blend"
    broken.write_bytes(b"not a blend")
    assert str(broken) in error_report("render", broken, "--out", tmp_path / "a.png")
    (tmp_path / "file").write_text("")
    assert str(tmp_path / "file") in error_report("build", trained, "--blend", tmp_path / "file" / "a.blend")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["broken.blend", "file"]


@pytest.mark.parametrize("options", [[], ["-y"]])
def test_python_drivers_run_only_if_allowed(tmp_path, monkeypatch, capsys, options):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.driver_add("location", 0).driver.expression = "bpy.data.version[0]"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "driven.blend"))
    monkeypatch.setattr(sys, "argv", ["blender", "-b", *options, "-P", "headless.py", "--", "render"])
    assert open_blend(tmp_path / "driven.blend", ConsoleReporter()) == bpy.context.scene
    assert bpy.data.objects["Camera"].location[0] == (bpy.app.version[0] if options else 0.0)
    assert ("the option -y" in capsys.readouterr().err) is not bool(options)
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.long
def test_render_uses_chosen_camera(blend, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    camera = next(
        entry.name
        for entry in bpy.context.scene.objects
        if entry.type == "CAMERA" and entry != bpy.context.scene.camera
    )
    bpy.ops.wm.read_factory_settings(use_empty=True)
    before = blend.read_bytes()
    for name in ("default.png", "other.jpg", "other.exr"):
        chosen = () if name == "default.png" else ("--camera", camera)
        ran = run("render", blend, "--out", tmp_path / name, "--engine", "CYCLES", *SIZE, *chosen)
        assert ran.returncode == 0, ran.output + ran.errors
        assert size_of(tmp_path / name) == (48, 36)
    assert blend.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.long
def test_edit_export_and_import_commands(trained, backend_python, tmp_path, monkeypatch):
    folder = shutil.copytree(trained, tmp_path / "made")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OBJECTGS_PYTHON", backend_python)
    first, second, *_ = json.loads((folder / "objects.json").read_text())["objects"]
    ran = run("edit", "made", "--remove", first["name"], "--recolor", f"{second['id']}:hue=0.3")
    assert ran.returncode == 0 and f"{first['name']}: removed" in ran.output, ran.output + ran.errors
    ran = run("export", "made", "--out", "all.ply")
    assert ran.returncode == 0, ran.output + ran.errors
    ids = read_vertices(tmp_path / "all.ply")["object_id"]
    assert first["id"] not in ids and second["id"] in ids
    ran = run("import-splats", "all.ply", "--out", "again")
    assert ran.returncode == 0, ran.output + ran.errors
    ran = run("build", "again")
    assert ran.returncode == 0, ran.output + ran.errors
    shown = {obj.name for obj in opened(tmp_path / "again" / "objectgs.blend") if obj.get("objectgs_kind") == "splats"}
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # The file tells the names, too.
    assert f"{second['name']} splats" in shown and f"{first['name']} splats" not in shown
    assert "no object nobody" in error_report("edit", "made", "--remove", "nobody")
    assert "not a PLY" in error_report("import-splats", "made/objects.json", "--out", "third")
    assert not (tmp_path / "third").exists()


@pytest.fixture(scope="module")
def meshed(trained, tmp_path_factory):
    """A trained folder with its .blend and a mesh for each object but the last: a ring of meshes inside a room."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("meshed") / "demo")
    ids = [entry["id"] for entry in json.loads((folder / "objects.json").read_text())["objects"]]
    meshes = {str(i): tetrahedron((math.cos(i), math.sin(i), 0.0), 0.8) for i in ids[:-1]}
    meshes[str(ids[0])] = tetrahedron((-9, -9, -9), 40.0)  # a room
    write_meshes(folder, meshes)
    ran = run("build", folder)
    assert ran.returncode == 0, ran.output + ran.errors
    return folder


def opened(blend):
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    return bpy.data.objects


def pixels(path):
    """Return the pixels (H, W, 3) of an image file, 0 .. 1."""
    image = bpy.data.images.load(str(path))
    try:
        return np.array(image.pixels[:]).reshape(image.size[1], image.size[0], -1)[..., :3]
    finally:
        bpy.data.images.remove(image)


def test_build_contains_meshes_with_textures(meshed, tmp_path):
    moved = shutil.copytree(meshed, tmp_path / "moved")
    meshes = [obj for obj in opened(moved / "objectgs.blend") if obj.get("objectgs_kind") == "mesh"]
    assert len(meshes) >= 3 and not any(obj.hide_render for obj in meshes)
    splats = [obj for obj in bpy.data.objects if obj.get("objectgs_kind") == "splats"]
    assert [obj.hide_render for obj in splats].count(False) == 1, "only the object without a mesh shows its splats"
    for obj in meshes:
        image = next(node for node in obj.data.materials[0].node_tree.nodes if node.type == "TEX_IMAGE").image
        assert image.filepath.startswith("//meshes/") and tuple(image.size) == (4, 4)
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_render_shows_chosen_kind(meshed, tmp_path):
    images = {}
    for which in ("splats", "meshes", "both"):
        ran = run("render", meshed, "--out", tmp_path / f"{which}.png", "--engine", "CYCLES", "--show", which, *SIZE)
        assert ran.returncode == 0, ran.output + ran.errors
        images[which] = pixels(tmp_path / f"{which}.png")
    for one, other in (("splats", "meshes"), ("splats", "both")):
        assert np.abs(images[one] - images[other]).mean() > 0.02
    assert images["meshes"].max() > 0.3, "the file has a light"


def test_render_apart_shows_separated_objects(meshed, tmp_path):
    before = (meshed / "objectgs.blend").read_bytes()
    for size in ("96x60", "60x96"):
        ran = run("render", meshed, "--apart", "--out", tmp_path / f"{size}.png", "--size", size, "--samples", "4")
        assert ran.returncode == 0, ran.output + ran.errors
        seen = pixels(tmp_path / f"{size}.png")
        bright = seen.min(2) > 0.6
        assert seen.shape[1::-1] == tuple(map(int, size.split("x")))
        assert bright[[0, -1]].all() and bright[:, [0, -1]].all(), "all objects are in the image, without the room"
        assert 0.02 < 1 - bright.mean() < 0.7
    assert (meshed / "objectgs.blend").read_bytes() == before
    assert "omit --camera" in error_report("render", meshed, "--apart", "--camera", "x", "--out", tmp_path / "a.png")


def test_render_apart_requires_meshes(blend, tmp_path):
    assert "no meshes to pull apart" in error_report("render", blend, "--apart", "--out", tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def fake_python(place, backend_python, meshes: str):
    """Return a fake Python that runs `meshes` as shell code instead of the mesh command, and the file of its calls."""
    calls, python = place / "calls", place / "python"
    python.write_text(f"""#!/bin/sh
echo "$3" >> '{calls}'
[ "$3" = mesh ] || exec '{backend_python}' "$@"
{meshes}
""")
    python.chmod(0o755)
    return python, calls


@pytest.mark.long
def test_run_makes_meshes_before_evaluation(capture, trained, meshed, backend_python, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "out")
    python, calls = fake_python(
        tmp_path, backend_python, f'cp -r \'{meshed}/meshes\' "$4/meshes" && echo \'{{"type": "done"}}\''
    )
    ran = run("run", capture, "--out", folder, "--steps", "30", *SIZE, "--backend-python", python)
    assert ran.returncode == 0, ran.output + ran.errors
    assert calls.read_text().split() == ["train", "mesh", "evaluate", "report"]
    assert size_of(folder / "render.png") == size_of(folder / "pulled-apart.png") == (48, 36)
    assert np.abs(pixels(folder / "render.png") - pixels(folder / "pulled-apart.png")).mean() > 0.02
    assert any(obj.get("objectgs_kind") == "mesh" for obj in opened(folder / "objectgs.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.mark.long
def test_make_demo_reconstructs_around_its_capture(capture, backend_python, tmp_path):
    recipe = (headless.ROOT / "Makefile").read_text(encoding="utf-8")
    assert "run $(DEMO)/capture --out $(DEMO) " in recipe
    folder = tmp_path / "demo"
    shutil.copytree(capture, folder / "capture")
    ran = run(
        "run", folder / "capture", "--out", folder, "--steps", "5", *SIZE, "--no-meshes", OBJECTGS_PYTHON=backend_python
    )
    assert ran.returncode == 0, ran.output + ran.errors
    assert (folder / "report.md").exists() and (folder / "objectgs.blend").exists()
    assert not (folder / "meshes").exists() and not (folder / "pulled-apart.png").exists()


@pytest.mark.long
def test_run_succeeds_without_meshes(capture, trained, backend_python, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "out")
    python, _ = fake_python(
        tmp_path,
        backend_python,
        'echo \'{"type": "error", "message": "No mesh can be made.", "nothing_made": true}\'; exit 2',
    )
    ran = run("run", capture, "--out", folder, "--steps", "30", *SIZE, "--backend-python", python)
    assert ran.returncode == 0, ran.output + ran.errors
    assert "warning: No mesh can be made." in ran.errors
    assert (folder / "render.png").is_file() and not (folder / "pulled-apart.png").exists()
    assert "No mesh can be made" in error_report("mesh", folder, "--backend-python", python)


def test_run_passes_the_device_to_every_step(capture, tmp_path, monkeypatch):
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    calls, python = tmp_path / "calls", tmp_path / "python"
    python.write_text(f"""#!/bin/sh\nshift 2; echo "$@" >> '{calls}'; echo '{{"type": "done"}}'\n""")
    python.chmod(0o755)
    words = ["--device", "cpu", "--threads", "1", "--memory-mb", "700", "--backend-python", str(python)]
    assert headless.main(["run", str(capture), "--out", str(tmp_path / "out"), "--max-size", "99", *words]) == 2
    found = [build_parser().parse_args(line.split()) for line in calls.read_text().splitlines()]
    assert [options.command for options in found] == ["train", "mesh", "evaluate", "report"]
    assert {(options.device, options.threads, options.memory_mb) for options in found} == {("cpu", 1, 700)}
    assert found[0].max_size == 99


def test_meshes_that_fail_for_another_reason_end_a_run(capture, tmp_path, monkeypatch, capsys):
    """The backend has the same exit code for them as for splats without a surface."""
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    python = tmp_path / "python"
    python.write_text("""#!/bin/sh
[ "$3" = mesh ] || exec echo '{"type": "done"}'
echo '{"type": "error", "message": "The memory of the GPU is full."}'
exit 2
""")
    python.chmod(0o755)
    out = tmp_path / "out"
    assert headless.main(["run", str(capture), "--out", str(out), "--backend-python", str(python)]) == 2
    assert "error: The memory of the GPU is full." in capsys.readouterr().err and not (out / "objectgs.blend").exists()
    shutil.copytree(capture, tmp_path / "captures" / "one")
    assert headless.main(["batch", str(tmp_path / "captures"), "--out", str(out), "--backend-python", str(python)]) == 2
    assert summary(out)["one"]["state"] == "bad input" and "memory" in summary(out)["one"]["error"]


@pytest.mark.long
def test_run_succeeds_without_held_out_views(capture, backend_python, tmp_path):
    copied, folder = shutil.copytree(capture, tmp_path / "capture"), tmp_path / "out"
    (copied / "test.txt").write_text("")
    ran = run("run", copied, "--out", folder, "--steps", "5", *SIZE, "--no-meshes", OBJECTGS_PYTHON=backend_python)
    assert ran.returncode == 0, ran.output + ran.errors
    assert "holds out no view" in ran.errors
    assert (folder / "report.md").is_file() and (folder / "render.png").is_file()


@pytest.mark.long
def test_missing_backend_is_reported(capture, tmp_path):
    user = {"OBJECTGS_PYTHON": "", "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    for command in ("import", "vote", "train", "run"):
        assert "not set up" in error_report(command, capture, "--out", tmp_path / "out", **user)
    assert "not set up" in error_report("mesh", tmp_path, **user)
    assert "nowhere" in error_report(
        "train", capture, "--out", tmp_path / "out", "--backend-python", tmp_path / "nowhere"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_backend_commands_run(capture, backend_python, tmp_path):
    for command in ("import", "vote"):
        out = tmp_path / command
        ran = run(command, capture, "--out", out, "--backend-python", backend_python, OBJECTGS_PYTHON="")
        assert ran.returncode == 0, ran.output + ran.errors
        assert (out / "cameras.json").is_file() and (out / "points.ply").is_file()
    assert "images" in error_report("vote", tmp_path, "--out", tmp_path / "x", OBJECTGS_PYTHON=backend_python)
    assert "--wrong" in error_report(
        "train", capture, "--out", tmp_path / "x", "--wrong", OBJECTGS_PYTHON=backend_python
    )
    assert not (tmp_path / "x").exists()


@pytest.mark.long
def test_paths_are_relative_to_working_directory(capture, backend_python, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = os.path.relpath(capture)
    ran = run("import", here, "--out", "made", OBJECTGS_PYTHON=os.path.relpath(backend_python))
    assert ran.returncode == 0, ran.output + ran.errors
    assert (tmp_path / "made" / "cameras.json").is_file()


def wait_for_any(folder, pattern, process):
    """Wait until a file of this pattern exists, which must happen while the process runs."""
    until = time.monotonic() + 120
    while not any(folder.glob(pattern)):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.05)


def wait_for(path, process):
    for _ in range(1200):
        if path.exists():
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    raise AssertionError(f"{path} was not written")


@pytest.mark.long
def test_stopped_training_keeps_checkpoint(capture, backend_python, tmp_path):
    process = start(
        "run",
        capture,
        "--out",
        tmp_path / "out",
        "--steps",
        "100000",
        "--checkpoint-seconds",
        "1",
        OBJECTGS_PYTHON=backend_python,
    )
    wait_for(tmp_path / "out" / "checkpoint", process)
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130, output + errors
    assert errors.count("\n") == 1
    assert (tmp_path / "out" / "checkpoint").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.long
def test_stopped_demo_leaves_no_files(tmp_path, number):
    process = start("demo", tmp_path / "demo", "--views", "500")
    wait_for_any(tmp_path, ".demo-*.part", process)
    process.send_signal(number)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130, output + errors
    assert not list(tmp_path.iterdir())


def test_demo_prints_json_events(tmp_path):
    small = ("--objects", "1", "--views", "4", "--width", "32", "--height", "32", "--samples", "1")
    ran = run("demo", tmp_path / "demo", "--json", *small)
    assert ran.returncode == 0, ran.errors
    events = [json.loads(line) for line in ran.output.splitlines() if line.startswith("{")]
    assert events[-1]["type"] == "done"
    shares = [event["done"] / event["total"] for event in events if event["type"] == "progress"]
    assert shares == sorted(shares) and 0.9 < shares[-1] < 1
    stages = [event["stage"] for event in events if event["type"] == "status" and "stage" in event]
    assert list(dict.fromkeys(stages)) == ["Rendering", "Saving"]
    refused = run("demo", tmp_path / "demo", "--json", "--objects", "0")
    assert refused.returncode == 2
    assert json.loads(refused.output.splitlines()[-1])["type"] == "error"


def test_demo_stops_when_stdin_closes(tmp_path):
    process = start("demo", tmp_path / "demo", "--views", "500", "--json")
    process.stdin.write("attached\n")
    process.stdin.flush()
    wait_for_any(tmp_path, ".demo-*.part", process)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130, output + errors
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "stereo"), [("a{b}c", False), ("{blend_name}", False), ("a", True)])
def test_picture_is_written_to_paths_with_braces_and_from_stereo_files(fresh, tmp_path, name, stereo):
    target = bpy.context.scene
    target.camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    target.collection.objects.link(target.camera)
    target.render.engine, target.cycles.samples = "CYCLES", 1
    target.render.resolution_x = target.render.resolution_y = 16
    target.render.use_multiview = stereo
    write_picture(target, tmp_path / name / f"{name}.png")
    assert [path.relative_to(tmp_path) for path in tmp_path.rglob("*.png")] == [Path(name, f"{name}.png")]


@pytest.mark.long
def test_stopped_rendering_ends_quickly(blend, tmp_path):
    process = start(
        "render", blend, "--out", tmp_path / "a.png", "--engine", "CYCLES", "--size", "4000x3000", "--samples", "4000"
    )
    time.sleep(10)
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, output + errors
    assert not list(tmp_path.iterdir())


def summary(out):
    return {entry["name"]: entry for entry in json.loads((out / "batch.json").read_text())["captures"]}


@pytest.mark.long
def test_batch_continues_after_invalid_capture_and_resumes(capture, backend_python, tmp_path):
    captures, out = tmp_path / "captures", tmp_path / "out"
    shutil.copytree(capture, captures / "good")
    (captures / "bad" / "images").mkdir(parents=True)
    (captures / "notes").mkdir()
    arguments = ("batch", captures, "--out", out, "--steps", "5", "--no-meshes", *SIZE)
    ran = run(*arguments, OBJECTGS_PYTHON=backend_python)
    assert ran.returncode == 2, ran.output + ran.errors
    bad, good = summary(out).values()
    assert (bad["name"], bad["state"], good["name"], good["state"]) == ("bad", "bad input", "good", "done")
    assert good["splats"] > 0 and good["seconds"] > 0 and 5 < good["psnr"] < 60 and good["error"] is None
    assert str(captures / "bad") in bad["error"]
    table = (out / "batch.md").read_text()
    assert bad["error"] in table and "notes" not in table
    assert "| [good](good/report.md) | [image](good/render.png) | done |" in table
    assert "| mIoU (all) | mIoU (labeled) |" in table and good["miou_all"] <= good["miou"]
    assert (out / "good" / "objectgs.blend").is_file() and size_of(out / "good" / "render.png") == (48, 36)

    first = summary(out)
    shutil.copytree(capture, captures / "bad", dirs_exist_ok=True)
    again = run(*arguments, OBJECTGS_PYTHON=backend_python)
    assert again.returncode == 0, again.output + again.errors
    second = summary(out)
    assert second["good"] == first["good"] and "good (2 of 2): already done" in again.output
    assert second["bad"]["state"] == "done" and second["bad"]["error"] is None


def test_batch_fingerprint_changes_with_capture(capture, tmp_path):
    shutil.copytree(capture, tmp_path / "a")
    before = fingerprint(tmp_path / "a")
    assert fingerprint(tmp_path / "a") == before
    for name in (".DS_Store", "Thumbs.db", "._photo.jpg", ".thumbs/a.jpg", "@eaDir/a.jpg/SYNOPHOTO_THUMB_M.jpg"):
        (tmp_path / "a" / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "a" / "images" / name).write_bytes(b"made by a file browser")
    assert fingerprint(tmp_path / "a") == before
    mask = min((tmp_path / "a" / "masks").iterdir())
    mask.write_bytes(mask.read_bytes())
    assert fingerprint(tmp_path / "a") != before


def test_batch_goes_on_after_unreadable_folders(capture, tmp_path, monkeypatch, capsys):
    """As with "System Volume Information" of Windows, or a capture whose photos another user may not read."""
    captures, out, echo = tmp_path / "captures", tmp_path / "out", tmp_path / "python"
    for name in ("a", "b"):
        shutil.copytree(capture, captures / name)
    (captures / "System Volume Information").mkdir()
    stat = Path.stat

    def refuse(path, **options):
        if path.parent.name == "System Volume Information" or path.is_relative_to(captures / "a" / "images"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", refuse)
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    echo.write_text("""#!/bin/sh\necho '{"type": "error", "message": "Reached."}'\nexit 2\n""")
    echo.chmod(0o755)
    assert headless.main(["batch", str(captures), "--out", str(out), "--backend-python", str(echo)]) == 2
    assert [entry["name"] for entry in summary(out).values()] == ["a", "b"]
    assert "cannot be used (Permission denied)" in summary(out)["a"]["error"], capsys.readouterr()
    assert summary(out)["b"]["error"] == "Reached."


def answering(place, *, when="true", field=""):
    """Return a stand-in for the backend that refuses every input, after the shell command `when`."""
    python = place / "python"
    event = json.dumps({"type": "error", "message": "Reached."})[:-1] + field + "}"
    python.write_text(f"""#!/bin/sh\n{when}\necho '{event}'\nexit 2\n""")
    python.chmod(0o755)
    return str(python)


def test_batch_goes_on_after_a_name_that_is_no_text(capture, tmp_path, monkeypatch, capsys):
    captures, out = tmp_path / "captures", tmp_path / "out"
    shutil.copytree(capture, captures / "good")
    try:
        shutil.copytree(capture, captures / os.fsdecode(b"caf\xe9"))
    except OSError:
        pytest.skip("this file system has no such names")
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    words = ["batch", str(captures), "--out", str(out), "--backend-python", answering(tmp_path)]
    assert headless.main(words) == 2
    assert "2 of 2 captures cannot be used" in capsys.readouterr().err
    assert "caf? is a name that is not text in UTF-8; rename it." in summary(out)["caf?"]["error"]
    assert summary(out)["good"]["error"] == "Reached."


def test_batches_of_two_computers_leave_captures_to_each_other(capture, tmp_path, monkeypatch, capsys):
    """The other one finishes "b" while this one runs "a", and runs "c", between two commands of the backend."""
    captures, out = tmp_path / "captures", tmp_path / "out"
    for name in ("a", "b", "c"):
        shutil.copytree(capture, captures / name)
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    other = tmp_path / "other.json"
    swap = f"[ ! -e '{other}' ] || mv '{other}' '{out / 'batch.json'}'"
    words = ["batch", str(captures), "--out", str(out), "--backend-python"]
    assert headless.main([*words, answering(tmp_path)]) == 2
    entries = summary(out)
    for name in ("render.png", "objectgs.blend"):
        (out / "b").mkdir(exist_ok=True)
        (out / "b" / name).touch()
    entries["a"] |= {"state": "unfinished", "error": None}
    entries["b"] |= {"state": "done", "error": None, "psnr": 30.0}
    entries["c"] |= {"state": "unfinished", "error": None}
    other.write_text(json.dumps({"captures": list(entries.values())}))
    capsys.readouterr()

    with locked(out, ".c.run.lock"):
        assert headless.main([*words, answering(tmp_path, when=swap)]) == 2
        captured = capsys.readouterr()
        assert "b (2 of 3): already done." in captured.out and "1 done, 1 bad input, 1 unfinished." in captured.out
        assert "c (3 of 3): left to another batch, which runs it." in captured.out
        assert summary(out)["b"] == entries["b"] and summary(out)["c"] == entries["c"]
        with locked(out, ".a.run.lock"):
            entries["a"] |= {"state": "unfinished", "error": None}
            (out / "batch.json").write_text(json.dumps({"captures": list(entries.values())}))
            assert headless.main([*words, answering(tmp_path)]) == 0
    assert not list(out.glob(".*.lock"))


def test_batch_keeps_results_of_captures_that_another_one_runs(tmp_path):
    """Of a capture that was added since this batch began, or of another folder of captures."""
    own = _Summary(tmp_path, [Path("one"), Path("two")])
    other = _Summary(tmp_path, [Path("one"), Path("three"), Path("gone"), Path("broken")])
    broken = other.entry("broken") | {"state": "bad input", "error": "There are no cameras."}
    other.update(broken)
    (tmp_path / "three").mkdir()
    three = other.entry("three") | {"state": "done", "psnr": 30.0}
    other.update(three)
    own.update(own.entry("one") | {"state": "done"})
    assert other.entry("three") == three and other.entry("broken") == broken
    assert list(summary(tmp_path)) == ["one", "two", "three", "broken"]
    table = (tmp_path / "batch.md").read_text()
    assert table.startswith("4 captures: 2 done, 1 bad input, 1 not begun.") and "/render.png) | done |" in table
    assert own.count("done") == 1


def test_batch_summary_tells_what_was_begun(tmp_path):
    own = _Summary(tmp_path, [Path("a [b] | c"), Path("stopped"), Path("broken"), Path("next")])
    own.update(own.entry("a [b] | c") | {"state": "done", "settings": {}})
    own.update(own.entry("stopped") | {"settings": {}, "step": "mesh", "error": "Cancelled."})
    own.update(own.entry("broken") | {"state": "bad input", "step": "train", "error": "A | long sentence."})
    head, table, errors = (tmp_path / "batch.md").read_text().split("\n\n")
    assert head == "4 captures: 1 done, 1 bad input, 1 unfinished, 1 not begun."
    rows = [line.split(" | ")[:3] for line in table.splitlines()[2:]]
    link = "a%20%5Bb%5D%20%7C%20c"
    assert table.splitlines()[2].startswith(
        f"| [a \\[b\\] \\| c]({link}/report.md) | [image]({link}/render.png) | done |"
    )
    assert rows[1:] == [
        ["| stopped", "", "unfinished, in mesh"],
        ["| broken", "", "bad input, in train"],
        ["| next", "", "not begun"],
    ]
    assert errors == "- stopped: Cancelled.\n- broken: A | long sentence.\n"


def test_batch_help_speaks_of_folders(capsys):
    with pytest.raises(SystemExit):
        headless.main(["batch", "--help"])
    text = capsys.readouterr().out
    assert "after FOLDER" in text and "CAPTURE" not in text and "folder of all reconstructions" in text


def test_batch_tells_of_captures_that_another_program_uses(capture, tmp_path, monkeypatch, capsys):
    """As where Blender trains one; no other batch is going to finish it."""
    captures, out = tmp_path / "captures", tmp_path / "out"
    shutil.copytree(capture, captures / "one")
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    python = answering(tmp_path, field=', "in_use": true')
    assert headless.main(["batch", str(captures), "--out", str(out), "--backend-python", python]) == 2
    captured = capsys.readouterr()
    assert "one: Reached." in captured.out and "1 of 1 captures cannot be used." in captured.err
    assert summary(out)["one"]["state"] == "unfinished" and summary(out)["one"]["error"] == "Reached."
    assert summary(out)["one"]["step"] == "train"


@pytest.mark.parametrize(
    ("command", "option"), [("mesh", "--capture"), ("batch", "--groups"), ("import-splats", "--capture")]
)
def test_relative_paths_are_those_of_the_working_folder(capture, tmp_path, monkeypatch, command, option):
    shutil.copytree(capture, tmp_path / "captures" / "one")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OBJECTGS_PYTHON", "")
    python = tmp_path / "python"
    python.write_text(f"""#!/bin/sh\necho "$@" >> '{tmp_path / "called"}'\nexit 1\n""")
    python.chmod(0o755)
    out = [] if command == "mesh" else ["--out", "out"]
    assert headless.main([command, "captures", *out, option, "../moved", "--backend-python", str(python)]) == 1
    words = (tmp_path / "called").read_text().split()
    assert words[words.index(option) + 1] == str(tmp_path.parent / "moved")


def test_characters_that_the_output_lacks_are_escaped(tmp_path):
    python = tmp_path / "python"
    event = json.dumps({"type": "status", "message": "Reading \u82b1"}).replace("\\", "\\\\")
    python.write_text(f"""#!/bin/sh\nprintf '{event}\\n{{"type": "done"}}\\n'\n""")
    python.chmod(0o755)
    ran = run("mesh", tmp_path, "--backend-python", python, PYTHONIOENCODING="ascii")
    assert ran.returncode == 0 and "Reading \\u82b1" in ran.output, ran.output + ran.errors


@pytest.fixture
def edited(tmp_path):
    """A folder with a mug and a can that have meshes, where the can is removed."""
    folder = write_folder(tmp_path / "made")
    write_meshes(folder, {"1": tetrahedron(), "2": tetrahedron()})
    edit_objects(folder / "objects.json", {2: {"removed": True}})
    yield folder
    bpy.ops.wm.read_factory_settings(use_empty=True)


def names_in(path):
    """Return the names of the nodes of a GLB file."""
    content = path.read_bytes()
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    return [node["name"] for node in header["nodes"]]


def test_export_meshes_has_the_edits(edited, tmp_path, capsys):
    out = tmp_path / "new" / "all.glb"
    assert headless.main(["export-meshes", str(edited), "--out", str(out)]) == 0
    assert names_in(out) == ["mug mesh"]
    assert f"Wrote {out}." in capsys.readouterr().out
    edit_objects(edited / "objects.json", {2: {"removed": None}})
    words = ["--per-object", "--objects", "can", "--coordinates", "capture"]
    assert headless.main(["export-meshes", str(edited), "--out", str(out.with_suffix(".obj")), *words]) == 0
    assert [path.name for path in out.with_suffix("").glob("*.obj")] == ["can.obj"]
    lines = (out.with_suffix("") / "can.obj").read_text().splitlines()
    places = [[float(number) for number in line.split()[1:4]] for line in lines if line.startswith("v ")]
    assert places == pytest.approx(tetrahedron().vertices, abs=1e-5)


@pytest.mark.parametrize(
    ("out", "words", "message"),
    [
        ("all.gltf", [], "name it .glb, .usdc or .obj."),
        ("all.glb", ["--objects", "nobody"], "no object nobody"),
        ("all.glb", ["--objects", "can"], "all of them are removed"),
        ("made/meshes/1.obj", [], "belongs to the reconstruction"),
    ],
)
def test_export_meshes_rejects_invalid_input(edited, tmp_path, capsys, out, words, message):
    assert headless.main(["export-meshes", str(edited), "--out", str(tmp_path / out), *words]) == 2
    assert message in capsys.readouterr().err
    assert headless.main(["export-meshes", str(tmp_path), "--out", str(tmp_path / "all.obj")]) == 2
    assert "contains no reconstruction" in capsys.readouterr().err


def test_export_meshes_tells_that_a_file_cannot_be_written(edited, tmp_path, capsys):
    (tmp_path / "all.obj").mkdir()
    assert headless.main(["export-meshes", str(edited), "--out", str(tmp_path / "all.obj")]) == 2
    assert "all.obj could not be written; check its folder" in capsys.readouterr().err


def test_batch_rejects_invalid_arguments(tmp_path):
    assert "captures" in error_report("batch", tmp_path, "--out", tmp_path / "out")
    assert "nowhere" in error_report("batch", tmp_path / "nowhere", "--out", tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_stopped_batch_writes_summary(capture, backend_python, tmp_path):
    shutil.copytree(capture, tmp_path / "captures" / "a")
    process = start(
        "batch",
        tmp_path / "captures",
        "--out",
        tmp_path / "out",
        "--steps",
        "100000",
        "--checkpoint-seconds",
        "1",
        OBJECTGS_PYTHON=backend_python,
    )
    wait_for(tmp_path / "out" / "a" / "checkpoint", process)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130, output + errors
    entry = summary(tmp_path / "out")["a"]
    assert entry["state"] == "unfinished" and "Cancelled" in entry["error"] and entry["seconds"] > 0


def test_backend_crash_is_reported(capture, tmp_path):
    python = tmp_path / "python"
    python.write_text("""#!/bin/sh\necho '{"type": "status", "message": "Hello"}'\necho 'out of luck' >&2\nexit 3\n""")
    python.chmod(0o755)
    ran = run("train", capture, "--out", tmp_path / "out", "--backend-python", python)
    assert ran.returncode == 1 and "out of luck" in ran.errors and "Traceback" not in ran.errors
