"""Paths of the files in a reconstruction folder."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import InputError
from . import cameras, report


class Reconstruction:
    """Paths in a reconstruction folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.settings = self.folder / "objectgs.json"
        self.objects = self.folder / "objects.json"
        self.plan = self.folder / "plan.json"
        self.cameras = self.folder / cameras.NAME
        self.points = self.folder / "points.ply"
        self.checkpoint = self.folder / "checkpoint"
        self.splats = self.folder / "splats.ply"
        self.anchors = self.folder / "anchors.ply"
        self.meshes = self.folder / "meshes"
        self.previews = self.folder / "previews"
        self.renders = self.folder / "renders"
        self.cache = self.folder / "cache"
        self.evaluation = self.folder / report.EVALUATION
        self.report_json = self.folder / report.REPORT
        self.report_md = self.folder / "report.md"
        self.pictures = self.folder / "pictures"

    def create(self) -> Reconstruction:
        """Create the folder and return self; raise InputError if it is not writable."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            probe = self.folder / f".write-test-{os.getpid()}"
            probe.write_bytes(b"")
            probe.unlink()
        except OSError as error:
            raise InputError(
                f"The folder {self.folder} cannot be written to ({error.strerror}); choose another with --out."
            ) from error
        return self
