# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the backend's environment, or looks whether a Python has what the backend needs.

    BASE_PYTHON environment_worker.py setup --folder FOLDER --requirements DIR --device cpu|cuda
    PYTHON environment_worker.py probe --requirements DIR

A program of its own, run by the Python in question in the folder that holds backend/; standard library alone. It speaks
as the backend does: JSON lines out, `attached` and `stop` in; exit codes 0 done, 2 refused with a sentence, 130
stopped, 1 anything else.

FOLDER holds a stamp that says whose it is, venv/, tmp/ while packages come, and ready.json, which is written last:
without it nothing is installed. Whatever ends the set-up early also removes what is there.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import hashlib
import importlib.metadata
import json
import os
import platform
import queue
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path

MARKER = "ready.json"
STAMP = "objectgs-environment"
VENV = "venv"
TEMPORARY = "tmp"
REMOVED = ".removed-"
"""Follows the folder's name where it is on its way out."""

OLDEST, NEWEST = (3, 11), (3, 13)
VERSIONS = "3.11, 3.12 or 3.13"
REQUIREMENTS = ("torch.txt", "backend.txt")
CUDA_REQUIREMENTS = "cuda.txt"
"""What an environment for NVIDIA GPUs holds beside."""
WHEELS = "https://download.pytorch.org/whl/"
PROBE_SECONDS = 8
GIGABYTES = {"cpu": 2.5, "cuda": 9.0}
"""Free space that the set-up asks for: packages, and the wheels they come from."""
MEGABYTES = {"cpu": 180, "cuda": 2500}
"""What comes over the network beside torch, for the progress."""

_STAMP_TEXT = "ObjectGS for Blender keeps the Python packages of its backend here; its preferences remove them.\n"
# The end of the input means that whoever started it is gone, in whatever way; then it goes as well.
_GUARDED = """\
import os, runpy, sys, threading
def watch():
    while os.read(0, 1024):
        pass
    os._exit(1)
threading.Thread(target=watch, daemon=True).start()
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


class Refused(Exception):
    """The environment cannot be made or used; the message is one plain sentence."""


class Stopped(Exception):
    """The user asked to stop."""


def environment_python(folder: Path) -> Path:
    """The Python of the environment in `folder`, whether it is there or not."""
    return folder / VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def requirement_files(requirements: Path, device: str) -> list[Path]:
    """What to install for a device (cpu or cuda), torch first."""
    return [requirements / name for name in (*REQUIREMENTS, *([CUDA_REQUIREMENTS] if device == "cuda" else []))]


def requirements_digest(requirements: Path, device: str) -> str:
    """What tells environments apart: the requirements without comments and blank lines. OSError where files lack."""
    lines = [line for path in requirement_files(requirements, device) for line in requirement_lines(path)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def requirement_lines(path: Path) -> list[str]:
    """The requirements in a file, as `name==version`."""
    lines = (line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line]


def is_ours(folder: Path) -> bool:
    """Whether the set-up may use `folder` and remove its own things there: it is absent, empty, or bears the stamp."""
    if folder.is_symlink() or not folder.is_dir():
        return not os.path.lexists(folder)
    return (folder / STAMP).is_file() or not any(folder.iterdir())


def remove_own(folder: Path, seconds: float = 10.0) -> None:
    """Remove from `folder` what the set-up made, and the folder itself where that leaves it empty.

    The marker goes first and the stamp last. What is still written to or open is tried again for some seconds; then
    OSError.
    """
    deadline = time.monotonic() + seconds
    (folder / MARKER).unlink(missing_ok=True)
    for name in (VENV, TEMPORARY):
        while os.path.lexists(folder / name):
            try:
                shutil.rmtree(_any_length(folder / name))
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)
    (folder / (MARKER + ".part")).unlink(missing_ok=True)
    (folder / STAMP).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        folder.rmdir()


def _any_length(path: Path) -> str:
    """`path` so that Windows takes it however long the names in it are."""
    whole = str(path.absolute())
    return "\\\\?\\" + whole if os.name == "nt" and not whole.startswith("\\\\") else whole


@contextlib.contextmanager
def short_path(folder: Path):
    """`folder` under a short name where the system is Windows, which by itself refuses paths from 260 characters on.

    The user's folders of Blender lie deep, and the packages' own names are up to 171 characters long.
    """
    if os.name != "nt":
        yield folder
        return
    link = Path(tempfile.mkdtemp(prefix="ogs")) / "e"
    made = subprocess.run(["cmd", "/c", "mklink", "/J", str(link), str(folder)], capture_output=True, check=False)
    try:
        yield folder if made.returncode else link
    finally:
        with contextlib.suppress(OSError):
            # This removes the junction and not what it leads to.
            link.rmdir()
            link.parent.rmdir()


def say(kind: str, **fields) -> None:
    """One event."""
    sys.stdout.write(json.dumps({"type": kind, "time": round(time.time(), 3), **fields}) + "\n")
    sys.stdout.flush()


class Progress:
    """How far the set-up is: stages with the seconds that they usually take, each with a share that is done."""

    def __init__(self, stages: dict[str, float]) -> None:
        self.stages = stages
        self._stage = next(iter(stages))
        self._began = self._told = time.monotonic()
        self._share = 0.0

    def begin(self, stage: str, message: str) -> None:
        """The stages before are done; `message` says what is done now."""
        self._stage, self._began, self._share = stage, time.monotonic(), 0.0
        self.status(message)

    def status(self, message: str) -> None:
        """Another message within the stage."""
        say("status", message=message)
        self._tell()

    def at(self, share: float) -> None:
        """So much of the stage is done, 0..1; it never goes back. Told at most twice a second."""
        self._share = max(self._share, min(share, 1.0))
        if time.monotonic() - self._told >= 0.5:
            self._tell()

    def _tell(self) -> None:
        now = self._told = time.monotonic()
        names = list(self.stages)
        before = sum(self.stages[name] for name in names[:names.index(self._stage)])
        usual, total, elapsed = self.stages[self._stage], sum(self.stages.values()), now - self._began
        # By its own pace as soon as that says something, and as usual until then.
        paced = elapsed * (1 - self._share) / self._share if self._share > 0.05 and elapsed > 3 else None
        left = usual * (1 - self._share) if paced is None else paced
        say("progress", done=round(before + usual * self._share, 2), total=total,
            seconds_left=round(left + total - before - usual, 1))


class StopRequest:
    """Set by a line `stop`, by a signal, or by the end of the input after a line `attached`."""

    def __init__(self) -> None:
        self._event = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self._event.set())
        threading.Thread(target=self._read, daemon=True).start()

    def __call__(self) -> bool:
        return self._event.is_set()

    def _read(self) -> None:
        attached = False
        with contextlib.suppress(OSError, ValueError):
            for line in sys.stdin:
                attached = attached or line.strip() == "attached"
                if line.strip() == "stop":
                    self._event.set()
        if attached:
            self._event.set()


def run(command: list[str], stop: StopRequest, on_line, on_tick=lambda: None, environment=None, first=b"") -> int:
    """Run a program to its end; returns its exit code. Raises Stopped where that is asked, after ending the program.

    on_line: takes each line of its output and errors. on_tick: called some times a second. first: what it is told.
    """
    # A group of its own, so that a stop reaches its children as well; Windows ends those with their parent.
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                             env={**os.environ, **(environment or {})},
                             **({} if os.name == "nt" else {"process_group": 0}))
    lines: queue.Queue = queue.Queue()

    def read() -> None:
        with child.stdout:
            for line in child.stdout:
                lines.put(line.decode("utf-8", errors="replace").rstrip())
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    try:
        child.stdin.write(first)
        child.stdin.flush()
        while True:
            if stop():
                raise Stopped
            try:
                line = lines.get(timeout=0.2)
            except queue.Empty:
                line = ""
            if line is None:
                return child.wait()
            if line:
                on_line(line)
            on_tick()
    finally:
        if child.poll() is None:
            child.kill() if os.name == "nt" else os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        with contextlib.suppress(OSError):
            child.stdin.close()


def check_python() -> None:
    """Refuse a Python that the backend's packages are not made for."""
    if not OLDEST <= sys.version_info[:2] <= NEWEST:
        raise Refused(f"{sys.executable} is Python {platform.python_version()}, and the backend needs {VERSIONS}; "
                      "choose such a Python, from python.org or your system's packages.")
    if struct.calcsize("P") != 8:
        raise Refused(f"{sys.executable} is a 32-bit Python, and the backend needs a 64-bit one; choose another.")


def check_can_make_environments() -> None:
    """Refuse a Python without what makes environments; some systems leave it out."""
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError as error:
        package = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
        raise Refused(f"{sys.executable} cannot make environments, since its module {error.name} is missing; install "
                      f"it (on Debian and Ubuntu the package {package}) or choose another Python.") from error


def check_space(folder: Path, device: str) -> None:
    """Refuse where the disk that `folder` is on has too little room."""
    place = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    free, needed = shutil.disk_usage(place).free / 1e9, GIGABYTES[device]
    if free < needed:
        raise Refused(f"The backend needs about {needed:g} GB and the disk of {place} has {free:.1f} GB free; make "
                      "room and try again.")


@contextlib.contextmanager
def claimed(folder: Path):
    """`folder` with the stamp and nothing else of ours in it, for this process alone; gone again on any exception."""
    if not is_ours(folder):
        raise Refused(f"{folder} is not empty and was not made by ObjectGS, so it is left alone; move it away.")
    for old in folder.parent.glob(folder.name + REMOVED + "*"):
        if is_ours(old):
            remove_own(old)
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as opened:
        stamp = opened.enter_context(open(folder / STAMP, "a+", encoding="utf-8"))
        if not _locked(stamp):
            raise Refused(f"Another Blender sets up the backend in {folder} at the moment; wait for it.")
        (folder / MARKER).unlink(missing_ok=True)
        try:
            for name in (VENV, TEMPORARY):
                if (folder / name).is_dir():
                    say("status", message="Removing the environment that was there")
                    shutil.rmtree(_any_length(folder / name))
            stamp.truncate(0)
            stamp.write(_STAMP_TEXT)
            stamp.flush()
            yield
        except BaseException:
            # Windows does not remove what is open.
            opened.close()
            remove_own(folder)
            raise


def _locked(file) -> bool:
    """Lock an open file until it is closed or this process ends; False where another process has it."""
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # Some network folders know no locks; then two at once are the user's own affair.
        return error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
    return True


class Pip:
    """pip of an environment: what it does as progress, and its errors as sentences."""

    def __init__(self, folder: Path, progress: Progress, stop: StopRequest) -> None:
        self.folder, self.progress, self.stop = folder, progress, stop
        self.temporary = folder / TEMPORARY
        self.temporary.mkdir()
        self.lines: list[str] = []

    @property
    def packages(self) -> dict[str, str]:
        """Names and versions of what is installed."""
        return {found.metadata["Name"].lower(): found.version
                for found in importlib.metadata.distributions(path=[str(self.site)])}

    @property
    def site(self) -> Path:
        """Where packages are installed."""
        version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        return self.folder / VENV / ("Lib" if os.name == "nt" else f"lib/{version}") / "site-packages"

    def install(self, arguments: list[str], megabytes: float) -> None:
        """`pip install`, wheels only; about `megabytes` will come. The user's own settings of pip hold."""
        self._downloaded, self._file, self._file_size = 0.0, "", 0.0
        self._installing: list[str] = []
        self._before = len(self._installed())
        command = ["install", "--no-input", "--progress-bar", "off", "--only-binary", ":all:", *arguments]
        if self._run(command, lambda: self._tick(megabytes)) != 0:
            raise Refused(why_pip_failed(self.lines))

    def offers(self, requirement: str, build: str, index: str | None = None) -> bool:
        """Whether the user's indexes, or another one, have this build; one that is not reached costs a few seconds."""
        name, _, version = requirement.partition("==")
        where = ["--index-url", index] if index else []
        self._run(["index", "versions", name, *where, "--retries", "0", "--timeout", str(PROBE_SECONDS)])
        return any(re.search(rf"\b{re.escape(version)}\+{build}", line) for line in self.lines)

    def _run(self, arguments: list[str], on_tick=lambda: None) -> int:
        self.lines = []
        # Temporary files can be larger than /tmp; and `user = true` in pip's settings does not go with environments.
        place = str(self.temporary)
        environment = {"TMPDIR": place, "TEMP": place, "TMP": place, "PIP_USER": "0",
                       "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
        return run(guarded(environment_python(self.folder), "pip", *arguments), self.stop, self._line, on_tick,
                   environment)

    def _line(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)
        self.lines.append(line)
        words = line.split()
        size = re.search(r"\(([\d.]+) ([kMG])B\)$", line)
        if words[0] == "Collecting":
            self.progress.status(f"Looking for {re.split('[^A-Za-z0-9._-]', words[1])[0]}")
        elif line.lstrip().startswith(("Downloading ", "Using cached ")) and size and ".metadata" not in line:
            self._downloaded += self._file_size
            self._file = next(word for word in words if word.endswith(".whl")).rsplit("/", 1)[-1]
            self._file_size = float(size[1]) * {"k": 1e-3, "M": 1, "G": 1e3}[size[2]]
            if words[0] == "Downloading":
                self.progress.status(f"Downloading {self._file.split('-')[0]} ({size[1]} {size[2]}B)")
        elif line.startswith("Installing collected packages: "):
            self._installing = line.partition(": ")[2].split(", ")
            self.progress.status(f"Installing {len(self._installing)} packages")

    def _tick(self, megabytes: float) -> None:
        """Two thirds of the time go into what comes, one into unpacking it; nobody tells either, so files do."""
        if self._installing:
            share = (len(self._installed()) - self._before) / len(self._installing)
            self.progress.at((2 + share) / 3)
        elif self._file:
            come = max((path.stat().st_size for path in self._partial()), default=0) / 1e6
            self.progress.at(min((self._downloaded + min(come, self._file_size)) / megabytes, 1.0) * 2 / 3)

    def _partial(self) -> list[Path]:
        return [path for path in self.temporary.rglob(self._file) if path.is_file()]

    def _installed(self) -> list[str]:
        return [name for name in os.listdir(self.site) if name.endswith(".dist-info")]


def why_pip_failed(lines: list[str]) -> str:
    """What pip said, in one sentence."""
    text = "\n".join(lines)
    lacking = re.search(r"No matching distribution found for (\S+)", text)
    unreached = re.search(r"Retrying \(|Could not fetch URL|connection error|Connection to \S+ timed out", text)
    if "No space left on device" in text or "not enough space on the disk" in text:
        return "The disk is full; make room and set the backend up again."
    if (lacking and unreached) or "ReadTimeoutError" in text or "ConnectionResetError" in text:
        return ("Python's package index could not be reached; look after the network connection (or pip's proxy or "
                "mirror settings) and set the backend up again.")
    if lacking:
        system = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
        return f"There is no ready-made package {lacking[1]} for this computer ({system})."
    if "Windows Long Path" in text:
        return ("Windows refuses paths as long as the packages need; allow long paths in Windows "
                "(LongPathsEnabled) and set the backend up again.")
    if "DO NOT MATCH THE HASHES" in text:
        return "A package came damaged; set the backend up again."
    errors = [line for line in lines if line.startswith("ERROR: ")] or lines or ["it said nothing"]
    return f"The packages could not be installed: {errors[-1].replace('ERROR: ', '', 1).rstrip('.')}."


def guarded(python: Path, module: str, *arguments: str) -> list[str]:
    """The command line of a module that ends by itself when this process is gone; apart from variables and folders."""
    return [str(python), "-I", "-u", "-X", "utf8", "-c", _GUARDED, module, *arguments]


def check_backend(python: Path, progress: Progress, stop: StopRequest) -> dict:
    """Try the backend on a tiny scene (`doctor`), which also compiles its kernels; returns what it found out."""
    result, last, compiled, at = {}, ["it said nothing"], [False], [0.0]

    def on_line(line: str) -> None:
        try:
            event = json.loads(line)
        except ValueError:
            event = None
        if not isinstance(event, dict):
            print(line, file=sys.stderr, flush=True)
            last[0] = line
            return
        kind, message = event.get("type"), str(event.get("message", ""))
        if kind == "status":
            progress.status(message)
        elif kind == "progress" and event.get("total"):
            share = event["done"] / event["total"]
            # It compiles, which takes most of the time, and then trains.
            compiled[0] = compiled[0] or share < at[0]
            at[0] = share
            progress.at(0.8 + 0.2 * share if compiled[0] else 0.8 * share)
        elif kind == "warning":
            say("warning", message=message)
        elif kind == "error":
            last[0] = message
        elif kind == "done":
            result.update(event)

    code = run([str(python), "-m", "backend", "doctor", "--json"], stop, on_line, first=b"attached\n")
    if code != 0:
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        words = last[0].rstrip(".")
        raise Refused(f"The packages are there, but the backend does not work with them ({how}): {words}.")
    return result


def set_up(options: argparse.Namespace, stop: StopRequest) -> None:
    """Make the environment; see the module's text for what is left and when."""
    folder, device = options.folder.absolute(), options.device
    check_python()
    check_can_make_environments()
    check_space(folder, device)
    torch = requirement_lines(options.requirements / "torch.txt")[0]
    digest = requirements_digest(options.requirements, device)
    progress = Progress({"venv": 5, "torch": 60, "packages": 60 if device == "cpu" else 300, "check": 60})
    with claimed(folder), short_path(folder) as place:
        progress.begin("venv", "Making an environment")
        if run(guarded(Path(sys.executable), "venv", str(place / VENV)), stop, _to_stderr) != 0:
            raise Refused(f"{sys.executable} could not make an environment in {folder}; choose another Python.")
        pip = Pip(place, progress, stop)
        progress.begin("torch", "Looking for PyTorch")
        pip.install(["--no-deps", *_build(pip, torch, device), torch], megabytes=500)
        comes = device
        if device == "cpu" and _brings_cuda(pip):
            comes = "cuda"
            say("warning", message="PyTorch's builds for processors could not be reached, so its build for NVIDIA GPUs "
                f"is installed, which also works without one but takes about {GIGABYTES['cuda']:g} GB.")
            check_space(folder, "cuda")
        progress.begin("packages", "Looking for the other packages")
        files = requirement_files(options.requirements, device)
        pip.install([argument for path in files for argument in ("-r", str(path))], MEGABYTES[comes])
        progress.begin("check", "Checking the backend")
        checked = check_backend(environment_python(folder), progress, stop)
        shutil.rmtree(pip.temporary)
        base = getattr(sys, "_base_executable", None) or sys.executable
        ready = {"python": platform.python_version(), "base": base, "device": device, "requirements": digest,
                 "packages": pip.packages, "machine": checked.get("machine", {})}
        part = folder / (MARKER + ".part")
        with open(part, "w", encoding="utf-8") as file:
            json.dump(ready, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        if stop():
            raise Stopped
        os.replace(part, folder / MARKER)
    say("done", message=checked.get("message", "The backend works."), machine=ready["machine"], folder=str(folder))


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _build(pip: Pip, torch: str, device: str) -> list[str]:
    """pip's options for the build of PyTorch that fits; on the usual index Linux has CUDA's and Windows the CPU's."""
    build = {("Linux", "cpu"): "cpu", ("Windows", "cuda"): "cu130"}.get((platform.system(), device))
    if build is None or pip.offers(torch, build):
        return []
    if pip.offers(torch, build, WHEELS + build):
        return ["--extra-index-url", WHEELS + build]
    if device == "cuda":
        say("warning", message="PyTorch's builds for NVIDIA GPUs could not be reached, so the one for processors is "
            "installed; set the backend up again when they can be.")
    return []


def _brings_cuda(pip: Pip) -> bool:
    """Whether the PyTorch that is installed wants CUDA's packages on this system."""
    wanted = next(iter(importlib.metadata.distributions(name="torch", path=[str(pip.site)]))).requires or []
    return platform.system() == "Linux" and any(line.startswith("nvidia-") for line in wanted)


def probe(options: argparse.Namespace, stop: StopRequest) -> None:
    """Look whether this Python has the backend's packages, then try the backend with it."""
    check_python()
    missing, other = [], []
    for name in REQUIREMENTS:
        for line in requirement_lines(options.requirements / name):
            package, _, wanted = line.partition("==")
            try:
                found = importlib.metadata.version(package)
            except importlib.metadata.PackageNotFoundError:
                missing.append(package)
                continue
            if found.partition("+")[0] != wanted:
                other.append(f"{package} is version {found}; ObjectGS was tested with {wanted}.")
    if missing:
        files = " ".join(f'-r "{options.requirements / name}"' for name in REQUIREMENTS)
        raise Refused(f"{sys.executable} lacks {' and '.join(filter(None, [', '.join(missing[:-1]), missing[-1]]))}; "
                      f"install them (pip install {files}) or choose another Python.")
    for sentence in other:
        say("warning", message=sentence)
    progress = Progress({"check": 60})
    progress.begin("check", "Checking the backend")
    checked = check_backend(Path(sys.executable), progress, stop)
    say("done", message=checked.get("message", "The backend works."), machine=checked.get("machine", {}))


def main() -> int:
    """Do what the command line says; returns the exit code."""
    parser = argparse.ArgumentParser(description="Make or check the environment of ObjectGS's backend.")
    commands = parser.add_subparsers(dest="command", required=True)
    setup = commands.add_parser("setup", help="make an environment")
    setup.add_argument("--folder", type=Path, required=True, help="where; it must be new, empty or an earlier one")
    setup.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    looking = commands.add_parser("probe", help="check this Python")
    for command in (setup, looking):
        command.add_argument("--requirements", type=Path, required=True, help="folder of torch.txt and backend.txt")
    options = parser.parse_args()
    try:
        {"setup": set_up, "probe": probe}[options.command](options, StopRequest())
        return 0
    except Refused as refusal:
        say("error", message=str(refusal))
        return 2
    except Stopped:
        what = "nothing of the environment stays" if options.command == "setup" else "nothing was changed"
        say("done", stopped=True, message=f"Stopped; {what}.")
        return 130
    except OSError as error:
        say("error", message=f"{error.filename or 'A file'} cannot be used ({error.strerror or error}); free it, or "
            "make room, and try again.")
        return 2
    except Exception as error:
        traceback.print_exc()
        say("error", message=f"An unexpected failure: {type(error).__name__}: {' '.join(str(error).split())}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
