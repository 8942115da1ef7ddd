"""Import rules, size limits of files and folders, and the single owner of each file of a reconstruction."""

import ast
import re
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("backend", "objectgs_addon", "operators")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
BLENDER = {
    "bpy",
    "bpy_extras",
    "bl_operators",
    "bl_ui",
    "blf",
    "bmesh",
    "gpu",
    "gpu_extras",
    "mathutils",
    "addon_utils",
    "imbuf",
}
MOST_MODULES = 12
MOST_LINES = 450


def module_of(path: Path) -> tuple[str, ...]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def imports_of(path: Path) -> list[tuple[tuple[str, ...], int]]:
    """Return the absolute names and lines of the modules that a file imports; `from package import module` counts as
    the module."""
    package = path.relative_to(ROOT).parent.parts
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(tuple(alias.name.split(".")), node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            base += tuple(node.module.split(".")) if node.module else ()
            for alias in node.names:
                inner = ROOT.joinpath(*base, alias.name)
                is_module = inner.with_suffix(".py").exists() or (inner / "__init__.py").exists()
                found.append(((*base, alias.name) if is_module else base, node.lineno))
    return found


def rule_folder_of(module: tuple[str, ...]) -> str:
    """Return the folder to which the rules apply: the top two levels, or the root package alone."""
    folder = ROOT.joinpath(*module[:2])
    return "/".join(module[:2]) if folder.is_dir() and len(module) > 1 else module[0]


def documented_rules() -> dict[str, set[str]]:
    """Return the table in docs/architecture.md: folder -> folders that it may import from."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    block = re.search(r"```imports\n(.*?)```", text, re.S)
    assert block, "docs/architecture.md has lost its table of imports"
    rules: dict[str, set[str]] = defaultdict(set)
    for line in filter(str.strip, block[1].splitlines()):
        folder, _, targets = line.partition("->")
        rules[folder.strip()] |= {target.strip().rstrip("/") for target in targets.split(",") if target.strip()}
    return rules


def project_imports() -> list[tuple[Path, int, str, str, tuple[str, ...]]]:
    """Return file, line, importing folder, imported folder and module of each import inside the project."""
    return [
        (path, line, rule_folder_of(module_of(path)), rule_folder_of(module), module)
        for path in SOURCES
        for module, line in imports_of(path)
        if module and module[0] in PACKAGES
    ]


def violations() -> list[str]:
    rules = documented_rules()
    return [
        f"{path.relative_to(ROOT)}:{line} imports {'.'.join(module)}"
        for path, line, here, there, module in project_imports()
        if there != here and there not in rules.get(here, set())
    ]


def test_imports_follow_the_documented_rules():
    assert not violations()


def test_every_documented_rule_is_used():
    used = {(here, there) for _, _, here, there, _ in project_imports()}
    documented = {(here, there) for here, targets in documented_rules().items() for there in targets}
    assert not documented - used


def test_documented_rules_are_acyclic():
    rules = documented_rules()
    done: set[str] = set()

    def visit(folder: str, above: tuple[str, ...]) -> None:
        assert folder not in above, f"{' -> '.join(above)} -> {folder}"
        if folder not in done:
            for target in rules.get(folder, ()):
                visit(target, (*above, folder))
            done.add(folder)

    for folder in list(rules):
        visit(folder, ())


def test_no_two_subfolders_import_each_other():
    pairs = set()
    for path, *_, module in project_imports():
        here, there = path.parent.relative_to(ROOT), Path(*module)
        there = there if (ROOT / there).is_dir() else there.parent
        if not here.is_relative_to(there) and not there.is_relative_to(here):
            pairs.add((here, there))
    assert not {pair for pair in pairs if pair[::-1] in pairs}


def outside_imports(folder: str) -> dict[str, str]:
    """Return external top-level packages that a folder imports -> one place where each is imported."""
    found = {}
    # Other Pythons run this file as a script, so it imports its own package under a top-level name.

    program = ROOT / "objectgs_addon" / "environment" / "worker" / "__main__.py"
    for path in (path for path in SOURCES if path.is_relative_to(ROOT / folder) and path != program):
        for module, line in imports_of(path):
            if module and module[0] not in PACKAGES and module[0] not in sys.stdlib_module_names:
                found[module[0]] = f"{path.relative_to(ROOT)}:{line}"
    return found


@pytest.mark.parametrize(
    ("folder", "allowed"),
    [
        ("backend/shared", {"numpy"}),
        ("objectgs_addon", {"numpy"} | BLENDER),
        ("operators", {"numpy"} | BLENDER),
    ],
)
def test_blender_side_imports_only_bundled_packages(folder, allowed):
    assert {name: place for name, place in outside_imports(folder).items() if name not in allowed} == {}


def test_backend_does_not_import_blender():
    assert not set(outside_imports("backend")) & BLENDER


def test_shared_modules_import_no_compute_packages():
    modules = [".".join(module_of(path)) for path in SOURCES if path.is_relative_to(ROOT / "backend" / "shared")]
    code = f"import sys, importlib; [importlib.import_module(m) for m in {modules}]; print(*sys.modules)"
    import subprocess

    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not {"torch", "numba", "pycolmap", "xatlas", "PIL", "scipy", "psutil"} & set(loaded.split())


def test_packages_use_relative_imports():
    absolute = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").split(".")[0] in PACKAGES
        for line in [node.lineno]
    ]
    assert not absolute


def test_folder_and_file_sizes_are_limited():
    folders = {path.parent for path in SOURCES}
    crowded = {
        str(folder.relative_to(ROOT)): n for folder in folders if (n := len(list(folder.glob("*.py")))) > MOST_MODULES
    }
    long = {
        str(path.relative_to(ROOT)): n
        for path in SOURCES
        if (n := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert (crowded, long) == ({}, {})


OWNERS = {
    "objectgs.json": "folder",
    "objects.json": "folder",
    "plan.json": "folder",
    "cameras.json": "cameras",
    "points.ply": "folder",
    "splats.ply": "folder",
    "splat-edits.ply": "folder",
    "anchors.ply": "folder",
    "meshes.json": "meshes",
    "report.json": "report",
    "evaluation.json": "report",
    "model.safetensors": "checkpoint",
    "previous.safetensors": "checkpoint",
    ".lock": "lock",
}
"""File of a reconstruction folder -> the only module of backend/shared/reconstruction that contains its name."""


def test_reconstruction_file_names_have_one_owner():
    places = defaultdict(set)
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and node.value in OWNERS:
                places[node.value].add(str(path.relative_to(ROOT)))
    # Captures have a separate truth/objects.json.
    places["objects.json"] -= {"objectgs_addon/demo/capture.py", "backend/evaluation/truth.py"}
    assert places == {name: {f"backend/shared/reconstruction/{owner}.py"} for name, owner in OWNERS.items()}


def test_the_properties_of_splats_have_one_owner():
    places = {
        str(path.relative_to(ROOT))
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in ("f_dc_0", "f_rest_", "rot_0")
    }
    assert places == {"backend/shared/formats/splat_ply.py"}
