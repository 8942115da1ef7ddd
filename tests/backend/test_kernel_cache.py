"""Compiled kernels, which numba stores as pickles, are loaded only from a folder that nobody else can write."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from backend.cli import kernel_cache
from backend.cli.kernel_cache import use_private_cache

ROOT = Path(__file__).parents[2]
posix = pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An empty home, in whose cache folder kernels are kept unless another folder is named."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    # Set first, so that it is restored afterward.
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    return tmp_path


def used() -> Path:
    return Path(os.environ["NUMBA_CACHE_DIR"])


@posix
def test_new_folders_are_for_their_user_alone(home, monkeypatch):
    before = os.umask(0)
    try:
        assert use_private_cache() is None
        assert used().is_relative_to(home) and used().stat().st_mode & 0o777 == 0o700
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "kernels"))
        assert use_private_cache() is None
        assert used() == home / "kernels" and used().stat().st_mode & 0o777 == 0o700
    finally:
        os.umask(before)


def test_a_folder_of_the_user_that_others_can_only_read_is_used(home, monkeypatch):
    (home / "kernels").mkdir(mode=0o755)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "kernels"))
    assert use_private_cache() is None and used() == home / "kernels"


@posix
@pytest.mark.parametrize("mode", [0o770, 0o722, 0o1777])
def test_a_folder_that_others_can_write_is_not_used(home, monkeypatch, mode):
    (home / "kernels").mkdir()
    (home / "kernels").chmod(mode)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "kernels"))
    assert use_private_cache() == (
        f"{home / 'kernels'} can be written by other users, so it is not used for compiled kernels, which run as code; "
        "delete it, or name another folder in NUMBA_CACHE_DIR."
    )
    assert used() != home / "kernels" and used().is_relative_to(home)


@posix
def test_a_folder_of_someone_else_is_not_used(home, monkeypatch):
    monkeypatch.setattr(kernel_cache.os, "geteuid", lambda: home.stat().st_uid + 1)
    assert " belongs to another user, so it is not used" in use_private_cache()
    assert not used().is_relative_to(home / ".cache") and used().stat().st_mode & 0o777 == 0o700


def test_without_a_usable_folder_kernels_are_kept_for_one_process(home, monkeypatch):
    (home / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "file" / "kernels"))
    monkeypatch.setattr(kernel_cache, "_user_cache", lambda: home / "file")
    assert f"{home / 'file' / 'kernels'} cannot be used (" in use_private_cache()
    assert used().is_dir() and not any(used().iterdir())


def test_a_folder_that_cannot_be_written_is_not_used(home, monkeypatch):
    (home / "kernels").mkdir(mode=0o500)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "kernels"))
    create = kernel_cache.tempfile.TemporaryFile

    def read_only(dir):
        if dir == home / "kernels":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(dir))
        return create(dir=dir)

    monkeypatch.setattr(kernel_cache.tempfile, "TemporaryFile", read_only)
    assert f"{home / 'kernels'} cannot be used (Read-only file system), so it is not used" in use_private_cache()
    assert used() != home / "kernels" and used().is_relative_to(home)
    assert not any((home / "kernels").iterdir())


def test_a_user_without_a_home(home, monkeypatch):
    def missing():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(kernel_cache.Path, "home", missing)
    assert use_private_cache() is None and used().is_dir() and not used().is_relative_to(home / ".cache")


@posix
@pytest.mark.long
def test_a_command_says_so_and_goes_on(home, monkeypatch):
    (home / "kernels").mkdir()
    (home / "kernels").chmod(0o777)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(home / "kernels"))
    script = """
from backend.cli.main import main
code = main(["check", "nowhere", "--json"])
import numba
print(code, numba.config.CACHE_DIR)
"""
    ran = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    *events, last = ran.stdout.splitlines()
    messages = [json.loads(line) for line in events]
    assert [event["type"] for event in messages if event["type"] not in ("status", "progress")] == ["warning", "error"]
    assert messages[0]["message"].startswith(f"{home / 'kernels'} can be written by other users")
    code, folder = last.split(" ", 1)
    assert code == "2" and Path(folder).is_relative_to(home) and folder != str(home / "kernels")
