# SPDX-License-Identifier: GPL-3.0-or-later
"""Setup of the backend's environment, with two tiny local packages and a fake backend, without network."""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from objectgs.backend.shared.formats import atomic
from objectgs.objectgs_addon.environment import environment
from objectgs.objectgs_addon.environment.worker import checks, choice, events, layout, pip, programs, setup
from objectgs.objectgs_addon.process import backend_process
from objectgs.objectgs_addon.process.jobs import JobQueue, State

WAIT = 180.0

BACKEND = """
import json, sys
assert sys.argv[1:] == ["doctor", "--json"] and sys.stdin.readline() == "attached\\n"
import torch
def say(kind, **fields):
    print(json.dumps({"type": kind, **fields}), flush=True)
say("status", message="Trying it")
for i in range(4):
    say("progress", done=i, total=4)
mode = open("mode").read()
if mode == "crash":
    print("OSError: libsomething.so is missing", file=sys.stderr)
    sys.exit(1)
say("done", message="It works.", machine={"torch": "2.13.0"})
"""


def wheel(folder, name, version, requires=""):
    """Write a minimal package that pip can install; `requires` names another one."""
    needs = f"Requires-Dist: {requires}\n" if requires else ""
    info = f"{name}-{version}.dist-info"
    files = {
        f"{name}.py": f"__version__ = '{version}'\n",
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{needs}",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    files[f"{info}/RECORD"] = "".join(f"{path},,\n" for path in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as archive:
        for path, text in files.items():
            archive.writestr(path, text)


def lock(root, name, *packages):
    """Write a file of locked packages with the hashes of the wheels, or with a wrong hash if there is no wheel."""
    lines = []
    for package in packages:
        path = root / "wheels" / f"{package.replace('==', '-')}-py3-none-any.whl"
        digest = hashlib.sha256(path.read_bytes() if path.exists() else b"").hexdigest()
        lines.append(f"{package} \\\n    --hash=sha256:{digest}\n")
    (root / "requirements" / "locked" / f"{name}.txt").write_text("".join(lines))
    environment._wanted.cache_clear()


@pytest.fixture
def root(tmp_path, monkeypatch):
    """An extension folder with requirements/ and backend/; packages come only from its wheels/."""
    for name in ("wheels", "requirements/locked", "backend"):
        (tmp_path / name).mkdir(parents=True)
    for name, version in ("torch", "2.13.0"), ("smallnumba", "0.68"), ("smallcuda", "0.30"):
        wheel(tmp_path / "wheels", name, version)
    lock(tmp_path, layout.system(), "smallnumba==0.68")
    lock(tmp_path, f"{layout.system()}-cpu", "torch==2.13.0")
    lock(tmp_path, f"{layout.system()}-cuda", "torch==2.13.0", "smallcuda==0.30")
    (tmp_path / "requirements" / "torch.txt").write_text("torch==2.13.0\n")
    (tmp_path / "requirements" / "backend.txt").write_text("# Wheels only.\n\nsmallnumba==0.68  # kernels\n")
    (tmp_path / "backend" / "__init__.py").write_text("")
    (tmp_path / "backend" / "__main__.py").write_text(BACKEND)
    (tmp_path / "mode").write_text("work")
    for name in list(os.environ):
        if name.startswith("PIP_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "wheels"))
    monkeypatch.setattr(backend_process, "_NICENESS", 0)
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    monkeypatch.setattr(environment, "REQUIREMENTS", tmp_path / "requirements")
    environment._wanted.cache_clear()
    yield tmp_path
    environment._wanted.cache_clear()


def run(job, until=lambda: False, after=None):
    """Run a job to its end, call `after` once `until()` holds, and return all progress values."""
    queue, shares = JobQueue(), []
    queue.add(job)
    deadline = time.monotonic() + WAIT
    while not job.is_finished:
        assert time.monotonic() < deadline, (job.message, job.log)
        queue.poll()
        shares.append(job.progress)
        if after and until():
            after()
            after = None
        time.sleep(0.02)
    return shares


@pytest.mark.long
def test_setup_succeeds_after_killed_setup(root):
    folder = root / "user" / "environment"
    assert environment.inspect(folder).state == "absent"
    assert environment.inspect(folder).python is None

    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job, layout.environment_python(folder).exists, job.kill)
    assert job.state is State.STOPPED
    assert environment.inspect(folder).state == "incomplete" and environment.inspect(folder).python is None

    (folder / "venv" / "leftover").write_text("")
    job = environment.set_up_job(sys.executable, folder, "cpu")
    shares = run(job)
    assert job.state is State.DONE, (job.error, job.log)
    assert job.message == "It works." and shares == sorted(shares)
    state = environment.inspect(folder)
    assert state.state == "ready" and "PyTorch 2.13.0" in state.sentence
    assert not (folder / "venv" / "leftover").exists() and not (folder / "tmp").exists()

    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job, lambda: job.message == "Making an environment", job.stop)
    assert job.state is State.STOPPED and job.message == "Stopped; the earlier environment is kept."
    assert environment.inspect(folder) == state
    found = subprocess.run(
        [state.python, "-c", "import smallnumba, torch; print(torch.__version__)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout == "2.13.0\n"

    ready = json.loads((folder / "ready.json").read_text())
    assert ready["packages"]["smallnumba"] == "0.68" and ready["device"] == "cpu"
    lock(root, layout.system(), "smallnumba==0.69")
    assert environment.inspect(folder).state == "outdated"

    environment.remove(folder)
    assert environment.inspect(folder).state == "absent" and not folder.exists()


@pytest.mark.long
def test_cuda_packages_are_installed_only_for_cuda(root):
    for device in ("cpu", "cuda"):
        folder = root / f"environment-{device}"
        job = environment.set_up_job(sys.executable, folder, device)
        run(job)
        assert job.state is State.DONE, (job.error, job.log)
        packages = json.loads((folder / "ready.json").read_text())["packages"]
        assert ("smallcuda" in packages) == (device == "cuda") and "smallnumba" in packages
    lock(root, f"{layout.system()}-cuda", "torch==2.13.0", "smallcuda==0.31")
    assert environment.inspect(root / "environment-cuda").state == "outdated"
    assert environment.inspect(root / "environment-cpu").state == "ready"


@pytest.mark.long
def test_failed_setup_leaves_no_files(root):
    folder = root / "environment"
    lock(root, layout.system(), "smallnumba==0.69")
    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job)
    assert job.state is State.FAILED and job.exit_code == 2
    assert job.error.startswith("There is no ready-made package smallnumba==0.69 for this computer (")
    assert not folder.exists()

    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job, lambda: job.message == "Making an environment", job.stop)
    assert job.state is State.STOPPED and job.message == "Stopped; nothing of the environment is kept."
    assert not folder.exists()


def installed_torch(root, device):
    """Set up an environment for `device`; return the job, the version of torch and whether packages for GPUs are in."""
    folder = root / f"environment-{device}"
    job = environment.set_up_job(sys.executable, folder, device)
    run(job)
    assert job.state is State.DONE, (job.error, job.log)
    packages = json.loads((folder / "ready.json").read_text())["packages"]
    return job, packages["torch"], "smallcuda" in packages


@pytest.mark.long
def test_wheel_with_other_hash_is_rejected(root):
    """The file that an index serves is replaced; the packages before it in the list are not installed either."""
    with zipfile.ZipFile(root / "wheels" / "torch-2.13.0-py3-none-any.whl", "a") as archive:
        archive.writestr("malice.pth", "import os\n")
    folder = root / "user" / "environment"
    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job)
    assert job.state is State.FAILED and job.exit_code == 2
    assert job.error.startswith("torch==2.13.0 is not the file that ObjectGS was tested with (its hash differs), so no")
    assert not folder.exists() and list((root / "user").iterdir()) == []


@pytest.mark.long
def test_package_that_is_not_locked_is_rejected(root):
    wheel(root / "wheels", "smallnumba", "0.68", requires="extra")
    wheel(root / "wheels", "extra", "1.0")
    lock(root, layout.system(), "smallnumba==0.68")  # The wheel is new.
    job = environment.set_up_job(sys.executable, root / "environment", "cpu")
    run(job)
    assert job.state is State.FAILED and "hash" in job.error and not (root / "environment").exists()


@pytest.mark.slow
def test_build_from_another_index_brings_no_other_package(root):
    """Its version names the build, it brings no other package, and the locked packages are checked as always."""
    (root / "requirements" / "locked" / f"{layout.system()}-cpu.txt").unlink()
    wheel(root / "wheels", "torch", "2.13.0+cpu", requires="extra")
    wheel(root / "wheels", "extra", "1.0")
    job, torch, for_gpus = installed_torch(root, "cpu")
    assert (torch, for_gpus, job.warnings) == ("2.13.0+cpu", False, [])
    assert "extra" not in json.loads((root / "environment-cpu" / "ready.json").read_text())["packages"]


@pytest.mark.slow
def test_other_build_is_installed_if_index_is_unreachable(root):
    (root / "requirements" / "locked" / f"{layout.system()}-cpu.txt").unlink()
    job, torch, for_gpus = installed_torch(root, "cpu")
    assert (torch, for_gpus) == ("2.13.0", True) and "takes about 9 GB" in job.warnings[0]
    assert environment.inspect(root / "environment-cpu").state == "ready"


def test_index_of_a_build_is_used_for_torch_alone(root):
    """And only if the user's own indexes lack the build."""
    (root / "requirements" / "locked" / f"{layout.system()}-cpu.txt").unlink()

    class Indexes:
        asked = []

        def offers(self, requirement, build, index):
            self.asked.append((requirement, build, index))
            return index is not None

    chosen = choice.choose(Indexes(), root / "requirements", "cpu", 9.0)
    index = "https://download.pytorch.org/whl/cpu"
    assert Indexes.asked == [("torch==2.13.0", "cpu", None), ("torch==2.13.0", "cpu", index)]
    assert chosen.torch == ["--index-url", index, "torch==2.13.0+cpu"]
    assert [path.stem for path in chosen.files] == [layout.system()]
    assert choice.choose(Indexes(), root / "requirements", "cuda", 9.0).torch == [] and len(Indexes.asked) == 2


def test_system_without_locked_packages_is_rejected(root, monkeypatch):
    for name in ("", "-cpu", "-cuda"):
        path = root / "requirements" / "locked" / f"{layout.system()}{name}.txt"
        path.rename(path.with_name(f"amiga-m68k{name}.txt"))
    job = environment.set_up_job(sys.executable, root / "environment", "cpu")
    run(job)
    assert job.state is State.FAILED and "only for amiga-m68k; choose" in job.error
    for name in ("", "-cpu"):
        path = root / "requirements" / "locked" / f"amiga-m68k{name}.txt"
        path.rename(path.with_name(f"macos-m68k{name}.txt"))
    monkeypatch.setattr(layout, "system", lambda: "macos-m68k")
    with pytest.raises(events.Refused, match="choose the device CPU"):
        choice.check_system(root / "requirements", "cuda")
    choice.check_system(root / "requirements", "cpu")


def test_macos_without_wheels_is_rejected(root, monkeypatch):
    monkeypatch.setattr(choice.platform, "mac_ver", lambda: ("13.6.1", ("", "", ""), "arm64"))
    with pytest.raises(events.Refused, match="need macOS 14 or newer, and this is 13"):
        choice.check_system(root / "requirements", "cpu")
    monkeypatch.setattr(choice.platform, "mac_ver", lambda: ("14.0", ("", "", ""), "arm64"))
    choice.check_system(root / "requirements", "cpu")


def test_children_of_a_guarded_program_have_no_input():
    """The program's own input says that its parent lives; on Windows, children that look at it would hang."""
    read = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'], stderr=subprocess.STDOUT)"
    lines = []
    command = programs.guarded(Path(sys.executable), "timeit", "-n1", "-r1", read)
    assert programs.run(command, lambda: False, lines.append) == 0
    assert any("EOFError" in line for line in lines)


@pytest.mark.parametrize(
    ("of_python", "machine", "build", "name"),
    [
        ("Linux", "x86_64", "linux-x86_64", "linux-x86_64"),
        ("Linux", "aarch64", "linux-aarch64", "linux-aarch64"),
        ("Darwin", "arm64", "macosx-11.0-universal2", "macos-arm64"),
        ("Windows", "AMD64", "win-amd64", "windows-x86_64"),
        ("Windows", "ARM64", "win-amd64", "windows-x86_64"),
    ],
)
def test_names_of_systems(monkeypatch, of_python, machine, build, name):
    monkeypatch.setattr(layout.platform, "system", lambda: of_python)
    monkeypatch.setattr(layout.platform, "machine", lambda: machine)
    monkeypatch.setattr(layout.sysconfig, "get_platform", lambda: build)
    assert layout.system() == name


def test_setup_stops_when_stdin_closes(root):
    """When its input ends, the setup stops its child processes and cleans up."""
    folder = root / "environment"
    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job, lambda: (folder / "venv").exists(), lambda: job._process._process.stdin.close())
    assert job.state is State.STOPPED and not folder.exists()


def test_foreign_files_are_kept(root):
    folder = root / "photos"
    folder.mkdir()
    (folder / "holiday.jpg").write_text("")
    job = environment.set_up_job(sys.executable, folder, "cpu")
    run(job)
    assert job.state is State.FAILED and "not used" in job.error
    assert environment.inspect(folder).state == "broken" and "holiday" not in environment.inspect(folder).sentence
    with pytest.raises(OSError, match="not ObjectGS's"):
        environment.remove(folder)
    (folder / layout.STAMP).write_text("")
    with pytest.raises(OSError, match="not ObjectGS's"):
        environment.remove(folder)
    layout.remove_own(folder)
    assert [path.name for path in folder.iterdir()] == ["holiday.jpg"]
    (root / "link").symlink_to(folder)
    assert not layout.is_ours(root / "link") and layout.is_ours(root / "new")


def test_invalid_environment_states_are_detected(root):
    folder = root / "environment"
    python = layout.environment_python(folder)
    python.parent.mkdir(parents=True)
    python.write_text("")
    (folder / layout.STAMP).write_text("")
    marker = {"python": "3.11.7", "base": str(python), "packages": {}, "requirements": "old", "device": "cpu"}
    for at, (text, state) in enumerate(
        [
            ("{", "broken"),
            ("[]", "broken"),
            ('{"python": "3.11.7"}', "broken"),
            (json.dumps({**marker, "base": str(root / "gone")}), "broken"),
            (json.dumps(marker), "outdated"),
        ]
    ):
        (folder / layout.MARKER).write_text(text)
        os.utime(folder / layout.MARKER, (at, at))
        assert environment.inspect(folder).state == state, text
    python.unlink()
    state = environment.inspect(folder)
    assert state.state == "broken" and str(python) in state.sentence and state.python is None


def test_inspect_is_fast(root):
    folder = root / "environment"
    layout.environment_python(folder).parent.mkdir(parents=True)
    layout.environment_python(folder).write_text("")
    (folder / layout.STAMP).write_text("")
    marker = {
        "python": "3.11.7",
        "base": sys.executable,
        "packages": {},
        "device": "cpu",
        "requirements": environment._wanted("cpu", layout.system()),
    }
    (folder / layout.MARKER).write_text(json.dumps(marker))
    assert environment.inspect(folder).state == "ready"
    started = time.perf_counter()
    for _ in range(100):
        environment.inspect(folder)
    assert time.perf_counter() - started < 1.0


def test_concurrent_setups_are_rejected(root):
    folder = root / "environment"
    with setup.claimed(folder):
        with pytest.raises(events.Refused, match="Another Blender"), setup.claimed(folder):
            pass
        assert (folder / layout.STAMP).is_file()


def test_next_setup_deletes_remains_of_removal(root):
    old = root / "environment.removed-7-0"
    (old / "venv").mkdir(parents=True)
    (old / layout.STAMP).write_text("")
    with setup.claimed(root / "environment"):
        assert not old.exists()


def test_remains_that_are_in_use_do_not_end_a_setup(root, monkeypatch):
    """Blender may be deleting them at the same time, so that files vanish."""
    old = root / "environment.removed-7-0"
    old.mkdir()
    (old / layout.STAMP).write_text("")

    def vanished(_):
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(layout, "remove_own", vanished)
    with setup.claimed(root / "environment"):
        assert old.exists()


def test_unsuitable_pythons_are_rejected(root, monkeypatch):
    options = argparse.Namespace(folder=root / "environment", requirements=root / "requirements", device="cpu")

    def error():
        with pytest.raises(events.Refused) as caught:
            setup.set_up(options, lambda: False)
        assert not options.folder.exists()
        return str(caught.value)

    with monkeypatch.context() as patch:
        patch.setattr(layout, "OLDEST", (3, 99))
        assert "needs 3.11, 3.12 or 3.13" in error()
    with monkeypatch.context() as patch:
        patch.setattr(checks.struct, "calcsize", lambda _: 4)
        assert "32-bit" in error()
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "ensurepip", None)
        assert "ensurepip is missing" in error()
    monkeypatch.setitem(layout.GIGABYTES, "cpu", 1e9)
    assert "free; make room" in error()


def test_supported_python_is_found_beside_newer_blender(root, monkeypatch):
    """A Debian or Arch Blender has the system's Python; a version manager's link may start nothing."""
    assert environment.find_python() == Path(sys.executable)
    names = root / "names"
    names.mkdir()
    monkeypatch.setattr(environment.layout, "NEWEST", (3, 10))
    monkeypatch.setattr(environment.layout, "OLDEST", (3, 8))
    monkeypatch.setenv("PATH", str(names))
    assert environment.find_python() == Path(sys.executable)
    for name, code in (("python3.10", 1), ("python3.9", 0)):
        (names / name).write_text(f"#!/bin/sh\nexit {code}\n")
        (names / name).chmod(0o755)
    assert environment.find_python() == names / "python3.9"


def test_probe_checks_packages_and_backend(root, monkeypatch):
    folder = root / "environment"
    job = environment.probe_job(sys.executable, folder)
    run(job)
    assert job.state is State.FAILED and "lacks torch and smallnumba; install them" in job.error
    assert not folder.exists()

    packages = root / "packages"
    packages.mkdir()
    with zipfile.ZipFile(root / "wheels" / "torch-2.13.0-py3-none-any.whl") as archive:
        archive.extractall(packages)
    (root / "requirements" / "backend.txt").write_text("pytest==0.1\n")
    job = environment.probe_job(sys.executable, folder)
    job.environment["PYTHONPATH"] = str(packages)
    run(job)
    assert job.state is State.DONE and job.message == "It works.", (job.error, job.log)
    assert len(job.warnings) == 1 and job.warnings[0].startswith("pytest is version ")

    (root / "mode").write_text("crash")
    job = environment.probe_job(sys.executable, folder)
    job.environment["PYTHONPATH"] = str(packages)
    run(job)
    assert job.error == (
        "The packages are installed, but the backend does not work with them (exit code 1): "
        "OSError: libsomething.so is missing."
    )


@pytest.mark.long
def test_packages_for_models_are_added_and_those_of_the_backend_keep_their_versions(root):
    folder = root / "environment"
    run(environment.set_up_job(sys.executable, folder, "cpu"))
    python = environment.inspect(folder).python
    models = root / "requirements" / layout.MODELS
    models.write_text("smallmodels>=5,<6\n")
    run(job := environment.add_models_job(python, folder))
    assert job.state is State.FAILED and "no ready-made package smallmodels" in job.error

    wheel(root / "wheels", "smallnumba", "0.69")
    wheel(root / "wheels", "smallmodels", "5.1", requires="smallnumba")
    run(job := environment.add_models_job(python, folder))
    assert job.state is State.DONE and job.message == "Installed smallmodels 5.1.", (job.error, job.log)
    wheel(root / "wheels", "smallmodels", "5.2", requires="smallnumba>=0.69")
    models.write_text("smallmodels==5.2\n")
    run(job := environment.add_models_job(python, folder))
    assert job.state is State.FAILED, job.log
    names = "import smallnumba, smallmodels; print(smallnumba.__version__, smallmodels.__version__)"
    found = subprocess.run([python, "-c", names], capture_output=True, text=True, check=True)
    assert found.stdout == "0.68 5.1\n"
    assert environment.inspect(folder).state == "ready"

    wheel(root / "wheels", "smalltokens", "0.2")
    wheel(root / "wheels", "smallmodels", "5.3", requires="smalltokens==0.2")
    wheel(root / "wheels", "smalltokens", "0.3")
    wheel(root / "wheels", "smallmodels", "5.4", requires="smalltokens==0.3")
    for version in ("5.3", "5.4"):
        models.write_text(f"smallmodels=={version}\n")
        run(job := environment.add_models_job(python, folder))
        assert job.state is State.DONE and job.message == f"Installed smallmodels {version}.", (job.error, job.log)


@pytest.mark.skipif(os.name != "posix", reason="POSIX programs")
@pytest.mark.parametrize("program", ["/bin/ls", "/bin/true", "/bin/sh"])
def test_probe_rejects_other_programs(root, program):
    job = environment.probe_job(program, root / "environment")
    run(job)
    assert job.error == f"{program} is not a Python, or it is older than 3.11; choose a Python 3.11, 3.12 or 3.13."


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (
            [
                "WARNING: Retrying (Retry(total=4)) after connection broken by 'NewConnectionError'",
                "ERROR: Could not find a version that satisfies the requirement numpy==2.4.6 (from versions: none)",
                "ERROR: No matching distribution found for numpy==2.4.6",
            ],
            "could not be reached",
        ),
        (
            [
                "WARNING: pip is configured with locations that require TLS/SSL, however the ssl module in Python is "
                "not available.",
                "Could not fetch URL https://pypi.org/simple/: There was a problem confirming the ssl certificate",
                "ERROR: No matching distribution found for numpy==2.4.6",
            ],
            "cannot open encrypted connections",
        ),
        (["ERROR: No matching distribution found for numpy==2.4.6"], "no ready-made package numpy==2.4.6 for this"),
        (["ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device"], "disk is full"),
        (["ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE."], "A package is not the file"),
        (["Collecting x", "ERROR: Some new trouble."], "could not be installed: Some new trouble."),
        (
            [
                "WARNING: Retrying (Retry(total=0)) after connection broken by 'SSLError(SSLCertVerificationError(1, "
                "'[SSL: CERTIFICATE_VERIFY_FAILED] certificate verify failed: self-signed certificate in chain'))'",
                "ERROR: No matching distribution found for numpy==2.4.6",
            ],
            "virus scanner",
        ),
        (
            [
                "WARNING: Retrying (Retry(total=0)) after connection broken by "
                "'SSLError(SSLCertVerificationError('A certificate chain processed, but terminated in a root'))'",
                "ERROR: No matching distribution found for numpy==2.4.6",
            ],
            "virus scanner",
        ),
        (
            ["ERROR: Exception:", "Traceback (most recent call last):", "ProtocolError: Connection broken: 10053"],
            "could not be reached",
        ),
        (
            ["ERROR: Exception:", "Traceback (most recent call last):", "KeyError: 'wheel'"],
            "could not be installed: KeyError: 'wheel'.",
        ),
        (
            ["error: externally-managed-environment", "hint: See PEP 668 for the detailed specification."],
            "virtual environment",
        ),
        (
            ["ERROR: Cannot install x and y", "ERROR: ResolutionImpossible: for help visit https://pip.pypa.io/"],
            "The packages that are needed do not fit others of this Python",
        ),
        ([], "it said nothing"),
    ],
)
def test_pip_failures_are_explained(lines, sentence):
    assert sentence in pip.why_pip_failed(lines)


def test_remains_of_a_package_do_not_count_as_one(tmp_path):
    """pip renames what it could not remove, and warns of it from then on."""
    for name, text in ("good-1.0", "Name: Good\nVersion: 1.0\n"), ("~orch-2.1.0", None), ("empty-1.0", "Name: empty\n"):
        (tmp_path / f"{name}.dist-info").mkdir()
        if text is not None:
            (tmp_path / f"{name}.dist-info" / "METADATA").write_text(text)
    assert pip.Pip(Path(sys.executable), tmp_path, tmp_path, None, None).packages == {"good": "1.0"}


@pytest.mark.parametrize(
    ("version", "has_truststore", "features"),
    [
        ("24.0", True, [None, "truststore", "truststore"]),
        ("23.2.1", False, [None, None]),
        ("24.2", True, [None, None]),
        ("25.3", True, [None, None]),
    ],
)
def test_certificates_that_the_system_trusts_are_tried(tmp_path, monkeypatch, version, has_truststore, features):
    """The pip that comes with Python 3.11 knows only those of its own list unless it is told to."""
    (tmp_path / f"pip-{version}.dist-info").mkdir()
    (tmp_path / f"pip-{version}.dist-info" / "METADATA").write_text(f"Name: pip\nVersion: {version}\n")
    if has_truststore:
        (tmp_path / "pip" / "_vendor" / "truststore").mkdir(parents=True)
    used = []

    def run_pip(_command, _stop, on_line, _on_tick, environment):
        used.append(environment.get("PIP_USE_FEATURE"))
        if used[-1] is None:
            on_line("WARNING: Retrying: SSLError(SSLCertVerificationError(1, '[SSL: CERTIFICATE_VERIFY_FAILED] ...'))")
            on_line("ERROR: No matching distribution found for torch==2.13.0")
            return 1
        on_line("torch (2.13.0+cpu)")
        return 0

    monkeypatch.delenv("PIP_USE_FEATURE", raising=False)
    monkeypatch.setattr(pip, "run", run_pip)
    installer = pip.Pip(Path(sys.executable), tmp_path, tmp_path, SimpleNamespace(), lambda: False)
    found = [installer.offers("torch==2.13.0", "cpu") for _ in range(2)]
    assert (found, used) == ([len(features) == 3] * 2, features)


def test_time_left_of_the_setup_goes_over_to_its_pace(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(events.time, "monotonic", lambda: clock[0])
    progress = events.Progress({"packages": ("Installing", 60.0), "kernels": ("Compiling", 40.0)})
    progress.begin("packages", "Resolving")
    for second in range(1, 31):
        clock[0] = float(second)
        progress.at(0.0)
    for second in range(31, 151):
        clock[0] = float(second)
        progress.at((second - 30) / 120)
    left = [json.loads(line).get("seconds_left") for line in capsys.readouterr().out.splitlines()][1:]
    assert left[:31] == list(range(100, 69, -1)), "until the pace is known, the usual time is counted down"
    assert left[90] == pytest.approx(100, rel=0.5) and left[130] == pytest.approx(60, rel=0.1) and left[150] == 40


def test_download_of_a_local_version_is_found(root):
    """pip prints its address quoted, and writes a file that is not."""
    shown = []
    progress = SimpleNamespace(status=shown.append, at=shown.append)
    installer = pip.Pip(Path(sys.executable), root, root, progress, lambda: False)
    installer._downloaded = installer._file_size = 0.0
    installer._installing = []
    installer._line("Downloading https://example.org/whl/torch-2.13.0%2Bcu130-cp311-win_amd64.whl (2000.0 MB)")
    (root / "unpack").mkdir()
    with (root / "unpack" / "torch-2.13.0+cu130-cp311-win_amd64.whl").open("wb") as file:
        file.truncate(500_000_000)
    installer._tick(megabytes=500)
    assert shown == ["Downloading torch (2000.0 MB)", pytest.approx(0.25 * 2 / 3)]


@pytest.mark.parametrize(
    ("line", "file"),
    [
        ("  Downloading https://mirror/get/foo-1.0-py3-none-any.whl?sig=a/b (12.3 kB)", "foo-1.0-py3-none-any.whl"),
        ("  Using cached foo-1.0-py3-none-any.whl (12.3 MB)", "foo-1.0-py3-none-any.whl"),
        ("  Downloading https://mirror/get?file=foo-1.0-py3-none-any.whl (12.3 kB)", ""),
        ("  Downloading foo-1.0-py3-none-any.whl.metadata (12.3 kB)", ""),
        ("Collecting", ""),
    ],
)
def test_lines_of_pip_tell_which_file_is_downloaded(root, line, file):
    """A mirror's addresses may have a query, such as a signature."""
    progress = SimpleNamespace(status=lambda _text: None)
    installer = pip.Pip(Path(sys.executable), root, root, progress, lambda: False)
    installer._downloaded, installer._file, installer._file_size, installer._installing = 0.0, "", 0.0, []
    installer._line(line)
    assert installer._file == file


def test_download_that_vanishes_does_not_end_the_setup(root, monkeypatch):
    """As when pip deletes its temporary folder while it is searched."""
    shown = []
    progress = SimpleNamespace(status=shown.append, at=shown.append)
    installer = pip.Pip(Path(sys.executable), root, root, progress, lambda: False)
    installer._downloaded, installer._file, installer._file_size, installer._installing = 0.0, "torch.whl", 100.0, []

    def vanished(_folder, _pattern):
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(pip.Path, "rglob", vanished)
    installer._tick(megabytes=500)
    assert shown == [0.0]


def test_environment_that_python_cannot_make_is_explained(root, monkeypatch):
    monkeypatch.setattr(setup, "guarded", lambda *_: [sys.executable, "-c", "raise SystemExit('No space left.')"])
    options = argparse.Namespace(folder=root / "environment", device="cpu", requirements=root / "requirements")
    with pytest.raises(events.Refused, match=r"could not make an environment in .* \(No space left\); make sure"):
        setup.set_up(options, lambda: False)
    assert not options.folder.exists()


def test_crash_is_named_by_its_first_line():
    output = checks._DoctorOutput(SimpleNamespace())
    for line in (
        "Fatal Python error: Illegal instruction",
        "Current thread 0x1:",
        "Extension modules: numpy (total: 9)",
    ):
        output.take(line)
    assert output.last_message == "Fatal Python error: Illegal instruction"


def test_missing_runtime_of_windows_is_named(monkeypatch):
    checks.check_runtime()
    monkeypatch.setattr(checks.sys, "platform", "win32")
    with pytest.raises(events.Refused, match=r"vcruntime140\.dll.*vc_redist"):
        checks.check_runtime()


@pytest.mark.parametrize(
    ("system", "base", "flags", "sentence"),
    [
        ("darwin", "/private/var/folders/x/T/AppTranslocation/A1/d/Blender.app/python3.11", 0, "into Applications"),
        ("darwin", "/Volumes/Blender/Blender.app/python3.11", os.ST_RDONLY, "into Applications"),
        ("darwin", "/Volumes/Disk/Blender.app/python3.11", 0, None),
        ("darwin", "/usr/bin/python3", os.ST_RDONLY, None),
        ("linux", "/Volumes/Blender/python3.11", os.ST_RDONLY, None),
        (
            "win32",
            r"C:\Users\me\AppData\Local\Microsoft\WindowsApps\PythonSoftwareFoundation.Python.3.11_q\python.exe",
            0,
            "Microsoft Store.*clear",
        ),
        ("win32", r"C:\Program Files\WindowsApps\BlenderFoundation.Blender4.5LTS_p\python\python.exe", 0, None),
    ],
)
def test_python_in_a_place_that_does_not_last_is_rejected(monkeypatch, system, base, flags, sentence):
    """Blender itself from the Microsoft Store sees what its own Python writes."""
    monkeypatch.setattr(checks.sys, "platform", system)
    monkeypatch.setattr(checks.sys, "_base_executable", base)
    monkeypatch.setattr(checks.os, "statvfs", lambda _: SimpleNamespace(f_flag=flags))
    if sentence is None:
        checks.check_place()
        return
    with pytest.raises(events.Refused, match=sentence):
        checks.check_place()


def test_environment_in_use_is_kept(root, monkeypatch):
    """Windows refuses to rename a folder with a loaded library."""
    folder = root / "environment"
    (folder / "venv").mkdir(parents=True)
    for name in (layout.STAMP, layout.MARKER):
        (folder / name).write_text("{}")
    with monkeypatch.context() as patched:

        def refuse(*_):
            raise PermissionError(13, "Access is denied")

        patched.setattr(setup.os, "replace", refuse)
        with pytest.raises(events.Refused, match=r"in use.*Access is denied"), setup.claimed(folder):
            pass
    assert (folder / "venv").is_dir() and (folder / layout.MARKER).is_file()
    with setup.claimed(folder):
        assert environment.inspect(folder).state == "incomplete"
    assert [path.name for path in folder.iterdir()] == [layout.STAMP]


def test_removal_waits_for_a_process_that_was_ended(root, monkeypatch):
    """Windows lets go of its files a moment after that."""
    folder, rename, refused = root / "environment", Path.replace, []
    folder.mkdir()
    (folder / layout.STAMP).write_text("")

    def busy(self, target):
        if not refused:
            refused.append(target)
            raise PermissionError(13, "Access is denied")
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", busy)
    monkeypatch.setattr(atomic, "_PATIENCE", 1.0)
    environment.remove(folder)
    assert refused and environment.inspect(folder).state == "absent"


def make(folder, text):
    """Make a complete environment whose marker has a text."""
    with setup.claimed(folder):
        (folder / "venv").mkdir()
        (folder / "venv" / text).touch()
        (folder / layout.MARKER).write_text(text)


def stop(folder):
    """Stop while an environment is being made."""
    with setup.claimed(folder):
        assert not (folder / "venv").exists()
        for name in ("venv", "tmp"):
            (folder / name).mkdir()
        (folder / "ready.json.part").touch()
        raise events.Stopped


def assert_complete(folder, text):
    assert sorted(path.name for path in folder.iterdir()) == [layout.STAMP, layout.MARKER, "venv"]
    assert (folder / layout.MARKER).read_text() == text
    assert [path.name for path in (folder / "venv").iterdir()] == [text]


def test_failed_setup_puts_earlier_environment_back(root):
    folder = root / "environment"
    make(folder, "first")
    with pytest.raises(events.Stopped):
        stop(folder)
    assert_complete(folder, "first")
    make(folder, "second")
    assert_complete(folder, "second")


def test_environment_survives_killed_setup(root):
    folder = root / "environment"
    make(folder, "first")
    setup._put_aside(folder)
    (folder / "venv" / "leftover").mkdir(parents=True)
    assert environment.inspect(folder).state == "incomplete"
    with pytest.raises(events.Stopped):
        stop(folder)
    assert_complete(folder, "first")
    setup._put_aside(folder)
    environment.remove(folder)
    assert not folder.exists()


def test_requirements_are_pinned():
    for name in layout.REQUIREMENTS:
        for line in layout.requirement_lines(environment.REQUIREMENTS / name):
            assert line.count("==") == 1 and line == line.replace(" ", ""), line
