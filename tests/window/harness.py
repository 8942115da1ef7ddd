# SPDX-License-Identifier: GPL-3.0-or-later
"""Control of a real Blender in a window on a virtual screen, with scripts, clicks and keys."""

import json
import os
import shutil
import signal
import subprocess
import textwrap
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SIZE = (1600, 900)
PACKAGE = "bl_ext.user_default.objectgs"


def blenders() -> dict[str, tuple[list[str], dict[str, str]]]:
    """Return name -> (command that opens a window, additional environment variables) of each Blender on this machine.

    This is the Blender at the path OBJECTGS_BLENDER, or else those that ../shared/tools/real-blender has set up.
    """
    chosen = os.environ.get("OBJECTGS_BLENDER")
    if chosen:
        return {"blender": ([chosen], {})}
    tool = ROOT.parent / "shared" / "tools" / "real-blender"
    if not tool.is_file():
        return {}
    suites = {"4.3": "trixie", "5.2": "sid"}
    return {
        version: ([str(tool), "gui"], {"REAL_BLENDER_SUITE": suite})
        for version, suite in suites.items()
        if Path(f"/var/tmp/real-blender-{suite}/usr/bin/blender").exists()
    }


class Failed(Exception):
    """A script failed inside Blender, or Blender ended or did not respond."""


class Blender:
    """A running Blender with a window of `size` pixels, a scratch folder, and a folder for screenshots (`shots`)."""

    def __init__(self, command, variables, folder: Path, shots: Path, size=SIZE) -> None:
        self.folder, self.shots, self.display = folder, shots, _free_display()
        self.scripts = folder / "scripts"
        self.scripts.mkdir(parents=True)
        shots.mkdir(parents=True, exist_ok=True)
        self._count = 0
        self._screen = subprocess.Popen(
            ["Xvfb", self.display, "-screen", "0", f"{size[0]}x{size[1]}x24"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _wait(lambda: Path(f"/tmp/.X11-unix/X{self.display[1:]}").exists(), 10, "the virtual screen does not start")
        environment = {
            # The Python in the preferences counts: OBJECTGS_PYTHON, which the Makefile exports, would win over it.
            **{name: value for name, value in os.environ.items() if name != "OBJECTGS_PYTHON"},
            **variables,
            "DISPLAY": self.display,
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "BLENDER_USER_RESOURCES": str(folder / "user"),
        }
        (folder / "user").mkdir()
        self._log = (folder / "blender.log").open("wb")
        self._process = subprocess.Popen(
            [
                *command,
                "--window-geometry",
                "0",
                "0",
                str(size[0]),
                str(size[1]),
                "--python",
                str(Path(__file__).with_name("driver.py")),
                "--",
                str(self.scripts),
            ],
            cwd=ROOT,
            env=environment,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def install(self, archive: Path, backend_python: Path) -> None:
        """Install the extension's zip, set the Python of the backend, and remove all objects of the scene."""
        self.key("Escape")  # close the splash screen
        self.run(
            f"""
            bpy.ops.extensions.package_install_files(
                filepath={str(archive)!r}, repo="user_default", enable_on_install=True)
            preferences = bpy.context.preferences.addons["{PACKAGE}"].preferences
            preferences.backend_python = {str(backend_python)!r}
            preferences.reconstructions = {str(self.folder / "reconstructions")!r}
            for obj in list(bpy.data.objects):
                bpy.data.objects.remove(obj)
        """,
            timeout=120,
        )

    def run(self, script: str, timeout: float = 60.0):
        """Execute a script inside Blender and return its variable `result`."""
        self._count += 1
        part = self.scripts / "next.part"
        part.write_text(textwrap.dedent(script), encoding="utf-8")
        part.rename(self.scripts / f"{self._count}.py")
        answer = self.scripts / f"{self._count}.json"
        _wait(
            lambda: answer.exists() or self._process.poll() is not None, timeout, f"Blender does not answer:\n{script}"
        )
        if not answer.exists():
            raise Failed(f"Blender has ended with code {self._process.returncode}; see {self._log.name}")
        content = json.loads(answer.read_text(encoding="utf-8"))
        if "error" in content:
            raise Failed(content["error"])
        return content["result"]

    def wait_for(self, expression: str, timeout: float = 60.0):
        """Wait until the expression is true and return its value."""
        found = []

        def true() -> bool:
            found[:] = [self.run(f"result = {expression}")]
            return bool(found[0])

        _wait(true, timeout, f"condition timed out: {expression}", 0.3)
        return found[0]

    def shot(self, name: str) -> Path:
        """Save a screenshot and return its path."""
        path = self.shots / f"{name}.png"
        self._tool("import", "-window", "root", str(path))
        return path

    def click(self, x: float, y: float, button: int = 1, key: str | None = None) -> None:
        """Move the mouse to a position (pixels from the upper left) and click there, with `key` held."""
        self._tool("xdotool", "mousemove", str(round(x)), str(round(y)))
        time.sleep(0.4)
        held = ["keydown", key] if key else []
        self._tool("xdotool", *held, "click", str(button), *(["keyup", key] if key else []))
        time.sleep(0.6)

    def move(self, x: float, y: float) -> None:
        """Move the mouse."""
        self._tool("xdotool", "mousemove", str(round(x)), str(round(y)))
        time.sleep(0.4)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the left button at a position (pixels from the upper left) and release it at another."""
        self.move(*start)
        self._tool("xdotool", "mousedown", "1")
        for fraction in (0.2, 0.6, 1.0):
            self.move(*(a + fraction * (b - a) for a, b in zip(start, end)))
        self._tool("xdotool", "mouseup", "1")
        time.sleep(0.6)

    def hold(self, key: str) -> None:
        """Press a key and keep it pressed."""
        self._tool("xdotool", "keydown", key)
        time.sleep(0.3)

    def release(self, key: str) -> None:
        """Release a held key."""
        self._tool("xdotool", "keyup", key)
        time.sleep(0.3)

    def key(self, *keys: str) -> None:
        """Press keys, for instance "ctrl+z"."""
        for name in keys:
            self._tool("xdotool", "key", name)
            time.sleep(0.3)

    def close(self) -> None:
        """End Blender and the screen."""
        for process in (self._process, self._screen):
            if process.poll() is None:
                if process is self._process:
                    os.killpg(process.pid, signal.SIGTERM)
                else:
                    process.terminate()
                try:
                    process.wait(10)
                except subprocess.TimeoutExpired:
                    process.kill()
        self._log.close()

    def quit(self, timeout: float = 30.0) -> int:
        """Quit Blender as a user would and return its exit code."""
        part = self.scripts / "next.part"
        part.write_text("bpy.ops.wm.quit_blender()", encoding="utf-8")
        part.rename(self.scripts / f"{self._count + 1}.py")
        return self._process.wait(timeout)

    def _tool(self, *command: str) -> None:
        subprocess.run(
            command, env={**os.environ, "DISPLAY": self.display}, check=True, timeout=30, stdout=subprocess.DEVNULL
        )


def missing_tools() -> list[str]:
    """Return the names of missing programs that the harness requires."""
    return [tool for tool in ("Xvfb", "xdotool", "import") if shutil.which(tool) is None]


def _free_display() -> str:
    """Return a free display, since other tests may run at the same time."""
    return next(f":{number}" for number in range(97, 1000) if not Path(f"/tmp/.X11-unix/X{number}").exists())


def _wait(done, timeout: float, sentence: str, interval: float = 0.1) -> None:
    deadline = time.monotonic() + timeout
    while not done():
        if time.monotonic() > deadline:
            raise Failed(sentence)
        time.sleep(interval)
