# SPDX-License-Identifier: GPL-3.0-or-later
"""Package installation with pip, with progress and plain error messages."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import re
import sys
import urllib.parse
from collections.abc import Callable
from pathlib import Path

from .events import Progress, Refused, print_error
from .layout import TEMPORARY, VENV, environment_python
from .programs import guarded, run

PROBE_SECONDS = 8
_BROKEN = (
    "ReadTimeoutError", "ConnectionResetError", "ProtocolError", "Connection broken", "Max retries exceeded",
    "incomplete-download",
)  # fmt: skip
"""What pip says where a connection ended during a download."""
_DISTRUSTED = re.compile("CERTIFICATE_VERIFY_FAILED|SSLCertVerificationError")
"""What pip says where a certificate is not accepted, by its own list and by that of the system."""


class Pip:
    """The pip of a Python of the same version as this one.

    Args:
        python: the Python.
        site: its folder of packages.
        temporary: an existing folder for temporary files.
        progress: receives what pip does.
        stop: returns whether to stop.
    """

    def __init__(self, python: Path, site: Path, temporary: Path, progress: Progress, stop: Callable[[], bool]) -> None:
        self.python, self.site, self.temporary = python, site, temporary
        self.progress, self.stop = progress, stop
        self.lines: list[str] = []
        self._trusts_system = False

    @classmethod
    def of_environment(cls, folder: Path, progress: Progress, stop: Callable[[], bool]) -> Pip:
        """Return the pip of the environment in `folder`."""
        version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        site = folder / VENV / ("Lib" if os.name == "nt" else f"lib/{version}") / "site-packages"
        temporary = folder / TEMPORARY
        temporary.mkdir()
        return cls(environment_python(folder), site, temporary, progress, stop)

    @property
    def packages(self) -> dict[str, str]:
        """Names and versions of the installed packages."""
        # What an interrupted pip has left behind may have no metadata.
        return {
            name.lower(): found.version
            for found in importlib.metadata.distributions(path=[str(self.site)])
            if (name := found.metadata["Name"]) and found.version
        }

    def install(self, arguments: list[str], megabytes: float) -> None:
        """Run `pip install` with wheels only and the user's pip configuration.

        Args:
            arguments: arguments of `pip install`.
            megabytes: expected size of the downloads in MB, for the progress.

        Raises:
            Refused: pip failed.
        """
        self._downloaded, self._file, self._file_size = 0.0, "", 0.0
        self._installing: list[str] = []
        self._before = len(self._installed())
        command = ["install", "--no-input", "--progress-bar", "off", "--only-binary", ":all:", *arguments]
        if self._run(command, lambda: self._tick(megabytes)) != 0:
            raise Refused(why_pip_failed(self.lines))

    def offers(self, requirement: str, build: str, index: str | None = None) -> bool:
        """Return whether a package index offers a build of a requirement; an unreachable index delays this by seconds.

        Args:
            requirement: `name==version`.
            build: local version label, such as cpu or cu130.
            index: URL of the index; None for the user's indexes.
        """
        name, _, version = requirement.partition("==")
        where = ["--index-url", index] if index else []
        self._run(["index", "versions", name, *where, "--retries", "0", "--timeout", str(PROBE_SECONDS)])
        return any(re.search(rf"\b{re.escape(version)}\+{build}", line) for line in self.lines)

    def _run(self, arguments: list[str], on_tick: Callable[[], None] = lambda: None) -> int:
        """Run pip; if its own list of certificates lacks one, once more and from then on with that of the system."""
        code = self._run_once(arguments, on_tick)
        is_distrusted = code != 0 and any(map(_DISTRUSTED.search, self.lines))
        if not is_distrusted or self._trusts_system or not self._can_trust_system():
            return code
        self._trusts_system = True
        print_error("Trying again with the certificates that the system trusts")
        return self._run_once(arguments, on_tick)

    def _can_trust_system(self) -> bool:
        """Return whether this pip can use the system's certificates and does not by itself: 23.3 to 24.1."""
        version = tuple(map(int, re.findall(r"\d+", self.packages.get("pip", ""))[:2]))
        return version < (24, 2) and (self.site / "pip" / "_vendor" / "truststore").is_dir()

    def _run_once(self, arguments: list[str], on_tick: Callable[[], None]) -> int:
        self.lines = []
        # Temporary files can exceed the space in /tmp. `user = true` in pip's configuration fails in environments.
        folder = str(self.temporary)
        environment = {
            "TMPDIR": folder,
            "TEMP": folder,
            "TMP": folder,
            "PIP_USER": "0",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        }
        if self._trusts_system:
            environment["PIP_USE_FEATURE"] = f"{os.environ.get('PIP_USE_FEATURE', '')} truststore".strip()
        return run(guarded(self.python, "pip", *arguments), self.stop, self._line, on_tick, environment)

    def _line(self, line: str) -> None:
        print_error(line)
        self.lines.append(line)
        words = line.split()
        size = re.search(r"\(([\d.]+) ([kMG])B\)$", line)
        address = next((word.partition("?")[0] for word in words if ".whl" in word), "")
        if words[0] == "Collecting" and len(words) > 1:
            self.progress.status(f"Resolving {re.split('[^A-Za-z0-9._-]', words[1])[0]}")
        elif words[0] in ("Downloading", "Using") and size and address.endswith(".whl"):
            self._downloaded += self._file_size
            self._file = urllib.parse.unquote(address.rsplit("/", 1)[-1])
            self._file_size = float(size[1]) * {"k": 1e-3, "M": 1, "G": 1e3}[size[2]]
            if words[0] == "Downloading":
                self.progress.status(f"Downloading {self._file.split('-')[0]} ({size[1]} {size[2]}B)")
        elif line.startswith("Installing collected packages: "):
            self._installing = line.partition(": ")[2].split(", ")
            self.progress.status(f"Installing {len(self._installing)} packages")

    def _tick(self, megabytes: float) -> None:
        """Update the progress from files, since pip reports none: 2/3 for the download, 1/3 for unpacking."""
        if self._installing:
            fraction = (len(self._installed()) - self._before) / len(self._installing)
            self.progress.at((2 + fraction) / 3)
        elif self._file:
            received = self._received() / 1e6
            total = max(megabytes, self._downloaded + self._file_size)
            self.progress.at((self._downloaded + min(received, self._file_size)) / total * 2 / 3)

    def _received(self) -> int:
        """Return the size of the file that is being downloaded, 0 while pip moves or deletes it."""
        with contextlib.suppress(OSError):
            return max((path.stat().st_size for path in self.temporary.rglob(self._file) if path.is_file()), default=0)
        return 0

    def _installed(self) -> list[Path]:
        return [path for path in self.site.iterdir() if path.name.endswith(".dist-info")]


def why_pip_failed(lines: list[str]) -> str:
    """Return one sentence that explains why pip failed.

    Args:
        lines: output of pip.
    """
    text = "\n".join(lines)
    lacking = re.search(r"No matching distribution found for (\S+)", text)
    unreached = re.search(r"Retrying \(|Could not fetch URL|connection error|Connection to \S+ timed out", text)
    # Warnings may be about attempts that were repeated.
    failure = text[text.find("ERROR: ") :] if "ERROR: " in text else text
    broken = any(words in failure for words in _BROKEN)
    if "No space left on device" in text or "not enough space on the disk" in text:
        return "The disk is full; make room and try again."
    if "ssl module in Python is not available" in text:
        return (
            "This Python cannot open encrypted connections, as happens with Anaconda's on Windows; choose another, "
            "such as one from python.org."
        )
    if _DISTRUSTED.search(text if lacking else failure):
        return (
            "The certificate of Python's package index is not accepted, as happens where a virus scanner or a proxy "
            "reads encrypted connections, or the clock is wrong; allow this connection there, or name the proxy's "
            "certificate in pip's setting cert, and try again."
        )
    if (lacking and unreached) or broken:
        return (
            "Python's package index could not be reached; check the network connection (or pip's proxy or "
            "mirror settings) and try again."
        )
    if lacking:
        system = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
        return f"There is no ready-made package {lacking[1]} for this computer ({system})."
    if "Windows Long Path" in text:
        return (
            "Windows refuses paths as long as the packages need; allow long paths in Windows "
            "(LongPathsEnabled) and try again."
        )
    if "DO NOT MATCH THE HASHES" in text:
        other = re.search(r"DO NOT MATCH THE HASHES.*\n\s+(\S+)", text)
        return (
            f"{other[1] if other else 'A package'} is not the file that ObjectGS was tested with (its hash differs), "
            "so nothing was installed; try again or, if that does not help, check pip's mirror settings."
        )
    if "ResolutionImpossible" in text:
        return (
            "The packages that are needed do not fit others of this Python, so nothing was installed; choose another "
            "Python, or use Set Up Backend."
        )
    if "externally-managed-environment" in text:
        return (
            "The system manages the packages of this Python, so nothing was installed; choose a Python of a virtual "
            "environment, or use Set Up Backend."
        )
    errors = [line for line in lines if line.startswith("ERROR: ")]
    # A traceback follows, whose last line says what happened.
    if not errors or errors[-1].startswith("ERROR: Exception:"):
        errors = lines or ["it said nothing"]
    return f"The packages could not be installed: {errors[-1].replace('ERROR: ', '', 1).rstrip('.')}."
