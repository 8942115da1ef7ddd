"""Lock of a reconstruction folder, which one process at a time can hold."""

import errno
import os
import signal
import subprocess
import sys
import time

import pytest

from backend.shared.reconstruction import lock
from backend.shared.reconstruction.lock import FolderInUse, lock_holder, locked
from backend.shared.reconstruction.objects import read_objects, write_objects

HOLD = """
import sys, time
from pathlib import Path
from backend.shared.reconstruction.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
COUNT = """
import sys, time
from pathlib import Path
from backend.shared.reconstruction.lock import FolderInUse, locked
folder = Path(sys.argv[1])
for _ in range(100):
    try:
        with locked(folder):
            inside = folder / "inside"
            inside.touch(exist_ok=False)  # Fails where another one is in here.
            inside.unlink()
    except FolderInUse:
        pass
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock of tmp_path."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_second_process_gets_pid_of_holder(tmp_path, holder):
    assert lock_holder(tmp_path) == holder.pid
    with (
        pytest.raises(FolderInUse, match=rf"another process \(pid {holder.pid}\); wait for it to finish or stop it"),
        locked(tmp_path),
    ):
        pass
    assert lock_holder(tmp_path) == holder.pid


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_other_users_of_a_group_can_take_a_lock_over(tmp_path):
    before = os.umask(0o002)
    try:
        with locked(tmp_path):
            assert (tmp_path / lock.NAME).stat().st_mode & 0o777 == 0o664
    finally:
        os.umask(before)


def test_lock_of_killed_process_is_released(tmp_path, holder):
    os.kill(holder.pid, signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
    holder.wait()
    assert lock_holder(tmp_path) is None
    with locked(tmp_path):
        assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"
    assert list(tmp_path.iterdir()) == []


def test_lock_file_content_alone_does_not_lock(tmp_path):
    (tmp_path / ".lock").write_text("1\n")
    assert lock_holder(tmp_path) is None
    with locked(tmp_path):
        pass


def test_process_cannot_lock_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "_PATIENCE", 0.05)
    with locked(tmp_path), pytest.raises(FolderInUse), locked(tmp_path):
        pass


def test_lock_holder_query_does_not_block_locking(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", COUNT.replace("100", "50"), tmp_path], stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None:
        lock_holder(tmp_path)
        time.sleep(0.001)
    assert process.returncode == 0, process.stderr.read()


def test_racing_processes_lock_exclusively(tmp_path):
    racers = [
        subprocess.Popen([sys.executable, "-c", COUNT, tmp_path], stderr=subprocess.PIPE, text=True) for _ in range(4)
    ]
    assert [(racer.wait(), racer.stderr.read()) for racer in racers] == [(0, "")] * 4
    assert list(tmp_path.iterdir()) == []


EDITS = """
import sys
from pathlib import Path
from backend.shared.errors import InputError
from backend.shared.reconstruction.objects import edit_objects
path, first = Path(sys.argv[1]), int(sys.argv[2])
refused = 0
for number in range(first, first + 50):
    try:
        edit_objects(path, {number: {"name": f"name {number}"}})
    except InputError:
        refused += 1
print(refused)
"""


def test_concurrent_edits_are_all_applied(tmp_path):
    """300 edits by 6 concurrent processes."""
    path = tmp_path / "objects.json"
    write_objects(path, [{"id": i, "name": "", "color": [0, 0, 0], "points": 1} for i in range(1, 301)])
    editors = [
        subprocess.Popen([sys.executable, "-c", EDITS, str(path), str(first)], stdout=subprocess.PIPE)
        for first in range(1, 301, 50)
    ]
    assert [int(editor.communicate(timeout=120)[0]) for editor in editors] == [0] * 6
    assert [entry.name for entry in read_objects(path)] == [f"name {i}" for i in range(1, 301)]
    assert [entry.name for entry in tmp_path.iterdir()] == ["objects.json"]


@pytest.mark.skipif(lock.fcntl is None, reason="Windows has locks of another kind")
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, 45])
def test_file_systems_without_locks_can_be_used(tmp_path, monkeypatch, number):
    """45 is ENOTSUP of macOS."""

    def refuse(_descriptor, _operation):
        raise OSError(number, "No locks available")

    monkeypatch.setattr(lock.fcntl, "flock", refuse)
    with locked(tmp_path):
        assert lock_holder(tmp_path) is None
