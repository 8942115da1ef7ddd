# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension as a package: content of its zip, unregistering, and packages that it must not import."""

import json
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

import pytest

bpy = pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[2]
TOOL = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"


def tool(*arguments):
    return subprocess.run([sys.executable, TOOL, *map(str, arguments)], capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """The zip that Blender's tool builds from this checkout, including its environments and caches."""
    folder = tmp_path_factory.mktemp("zip")
    built = tool("build", "--source-dir", ROOT, "--output-dir", folder)
    assert built.returncode == 0, built.stdout + built.stderr
    (file,) = folder.glob("*.zip")
    return file


def test_zip_is_valid(package):
    checked = tool("validate", package)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert package.name == "objectgs-0.1.0.zip"
    # Code and text alone but for the manual: what is bulky is a picture, or data, of which nothing belongs here.
    with zipfile.ZipFile(package) as archive:
        entries = [entry for entry in archive.infolist() if not entry.filename.startswith("docs/manual/")]
    assert max(entry.compress_size for entry in entries) < 20_000
    assert package.stat().st_size < 3_500_000


def test_zip_has_expected_files_only(package):
    with zipfile.ZipFile(package) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    assert {
        "__init__.py",
        "blender_manifest.toml",
        "headless.py",
        "LICENSE",
        "README.md",
        "backend/__main__.py",
        "docs/manual/manual.html",
        "objectgs_addon/headless/commands.py",
        "operators/__init__.py",
        "requirements/backend.txt",
        "requirements/torch.txt",
    } <= names
    tracked = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
    )
    if tracked.returncode == 0:
        assert names <= set(tracked.stdout.splitlines())
    tops = {PurePosixPath(name).parts[0] for name in names}
    assert tops == {
        "__init__.py",
        "blender_manifest.toml",
        "headless.py",
        "LICENSE",
        "README.md",
        "backend",
        "docs",
        "objectgs_addon",
        "operators",
        "requirements",
    }
    pictures = {path.name for path in (ROOT / "docs" / "manual" / "images").iterdir()}
    assert {name for name in names if name.startswith("docs/")} == {
        "docs/manual/manual.html",
        *(f"docs/manual/images/{name}" for name in pictures),
    }
    assert {name for name in names if name.startswith("requirements/")} == {
        "requirements/backend.txt",
        "requirements/models.txt",
        "requirements/torch.txt",
        *(f"requirements/locked/{path.name}" for path in (ROOT / "requirements" / "locked").iterdir()),
    }
    kinds = {".py", ".toml", ".txt", ".md", ".json", ".cu", ".h", ".html", ".jpg", ""}
    assert {PurePosixPath(name).suffix for name in names} <= kinds


def test_versions_match():
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    from objectgs.backend.shared.version import __version__

    assert manifest["version"] == project["project"]["version"] == __version__


def in_blender(script, *arguments):
    """Run a script with the bpy module in a child process, and return the JSON object that it prints last.

    The script exits early: after a property had a callback, Blender 4.2's module crashes when Python shuts down.
    """
    script += "\nimport os\nsys.stdout.flush()\nos._exit(0)\n"
    ran = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stdout[-3000:] + ran.stderr[-3000:]
    return json.loads(ran.stdout.splitlines()[-1])


REGISTER_TEN_TIMES = """
import json, sys
import bpy, headless

root = headless.extension()
owners, timers = [], []
subscribe, clear, add_timer = bpy.msgbus.subscribe_rna, bpy.msgbus.clear_by_owner, bpy.app.timers.register

def subscribe_rna(*, owner, **rest):
    owners.append(owner)
    return subscribe(owner=owner, **rest)

def clear_by_owner(owner):
    owners[:] = [other for other in owners if other is not owner]
    return clear(owner)

def register_timer(function, *rest, **named):
    timers.append(function)
    return add_timer(function, *rest, **named)

bpy.msgbus.subscribe_rna, bpy.msgbus.clear_by_owner = subscribe_rna, clear_by_owner
bpy.app.timers.register = register_timer

def menu_entries():
    found = {}
    for name in dir(bpy.types):
        draw = getattr(getattr(bpy.types, name), "draw", None)
        ours = [entry.__name__ for entry in getattr(draw, "_draw_funcs", ())
                if entry.__module__.split(".")[0] == root.__name__]
        if ours:
            found[name] = ours
    return found

def state():
    return {
        "classes": sorted(dir(bpy.types)),
        "operators": [name for name in dir(bpy.ops.objectgs) if not name.startswith("_")],
        "properties": {kind.__name__: sorted(kind.bl_rna.properties.keys()) for kind in (
            bpy.types.Scene, bpy.types.Collection, bpy.types.Object, bpy.types.WindowManager)},
        "handlers": {name: len(value) for name in dir(bpy.app.handlers)
                     if isinstance(value := getattr(bpy.app.handlers, name), list)},
        "menus": menu_entries(),
        "owners": len(owners),
        "timers": sum(map(bpy.app.timers.is_registered, timers)),
    }

menu_entries()  # looking at a class for the first time may itself add to bpy.types
before = state()
for _ in range(10):
    root.register()
    during = state()
    root.unregister()
print(json.dumps([before, during, state()]))
"""


def test_unregister_removes_everything():
    before, during, after = in_blender(REGISTER_TEN_TIMES)
    assert during["operators"] and during["menus"] and during["owners"]
    assert "objectgs" in during["properties"]["Scene"]
    assert after == before


IMPORT_A_RESULT = """
import json, sys
from pathlib import Path
import bpy, headless

root = headless.extension()
root.register()
try:
    from objectgs.objectgs_addon import scene
    folder = Path(sys.argv[1])
    shown = scene.show_capture(bpy.context.scene, folder)
    result = scene.show_result(shown, folder)
    assert result.splats > 0
finally:
    root.unregister()
print(json.dumps(sorted({name.split(".")[0] for name in sys.modules})))
"""


def test_blender_side_imports_no_backend_packages(trained):
    loaded = in_blender(IMPORT_A_RESULT, trained)
    assert "objectgs" in loaded
    assert not {"torch", "numba", "llvmlite", "pycolmap", "xatlas", "scipy", "matplotlib", "safetensors"} & set(loaded)
