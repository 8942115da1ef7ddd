"""The packages that Set Up Backend installs are those of the requirement files, locked with hashes."""

import re
import shutil
from pathlib import Path

import pytest

REQUIREMENTS = Path(__file__).parents[2] / "requirements"
SYSTEMS = ("linux-x86_64", "macos-arm64", "windows-x86_64")
FOR_GPUS = ("nvidia-", "cuda-", "triton")
AGAIN = "run `make lock`"


def named(path: Path) -> dict[str, str]:
    """Return name -> version of the packages in a requirements file, without extras and markers."""
    if not path.is_file():
        return {}
    lines = (re.match(r"([\w.-]+)(?:\[\w+\])?==([\w.]+)", line) for line in path.read_text().splitlines())
    return {found[1].lower().replace("_", "-"): found[2] for found in lines if found}


def locked(folder: Path, system: str) -> dict[str, dict[str, str]]:
    return {part: named(folder / "locked" / f"{system}{part}.txt") for part in ("", "-cpu", "-cuda")}


def unlike_locked(folder: Path) -> list[str]:
    """Return what differs between the requirement files of `folder` and its locked files."""
    found = []
    for system in SYSTEMS:
        files = locked(folder, system)
        wanted = [("backend.txt", files[""]), ("torch.txt", files["-cpu"] | files["-cuda"])]
        found += [
            f"{system}: {name}=={version} is not locked; {AGAIN}"
            for source, present in wanted
            for name, version in named(folder / source).items()
            if present.get(name) != version
        ]
    return found


def test_every_requirement_is_locked():
    assert unlike_locked(REQUIREMENTS) == []


@pytest.mark.parametrize(("file", "systems"), [("backend.txt", 3), ("torch.txt", 3)])
def test_a_change_without_locking_again_is_noticed(tmp_path, file, systems):
    shutil.copytree(REQUIREMENTS, tmp_path / "requirements")
    path = tmp_path / "requirements" / file
    path.write_text(re.sub(r"==[\d.]+", "==99.0", path.read_text(), count=1))
    assert len(unlike_locked(tmp_path / "requirements")) == systems


def test_files_hold_versions_and_hashes_alone():
    """No index is named, so that the user's own is used, and all builds of a package are covered by hashes."""
    paths = sorted((REQUIREMENTS / "locked").iterdir())
    assert {path.name.rpartition(".")[0].removesuffix("-cpu").removesuffix("-cuda") for path in paths} == set(SYSTEMS)
    for path in paths:
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        text = "".join(f"{line}\n" for line in lines)
        assert re.fullmatch(r"([a-z0-9-]+==[\w.]+( \\\n    --hash=sha256:[0-9a-f]{64})+\n)+", text), path.name


@pytest.mark.parametrize("system", SYSTEMS)
def test_packages_for_gpus_are_apart_and_torch_is_of_one_device(system):
    files = locked(REQUIREMENTS, system)
    for part in ("", "-cpu"):
        assert not [name for name in files[part] if name.startswith(FOR_GPUS)]
    assert ["torch" in files[part] for part in ("", "-cpu", "-cuda")].count(True) == 1 and "torch" not in files[""]
    assert not set(files[""]) & (set(files["-cpu"]) | set(files["-cuda"]))


def test_one_version_for_all_systems():
    """What is tested on one system is what the others get."""
    versions: dict[str, set[str]] = {}
    for system in SYSTEMS:
        for packages in locked(REQUIREMENTS, system).values():
            for name, version in packages.items():
                versions.setdefault(name, set()).add(version)
    assert {name: found for name, found in versions.items() if len(found) > 1} == {}
