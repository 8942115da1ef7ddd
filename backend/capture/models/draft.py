"""A model while it is read from a file of another program: its cameras and poses, and the photos they belong to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...shared.errors import InputError
from ...shared.formats.json_file import LARGEST
from ...shared.formats.regular_file import read_regular
from ..colmap import Camera, Model, RawImage, RawPoints, export_again, validate
from .lens import Lens
from .photos import Photos, none_found, require_single
from .point_cloud import find_point_cloud, read_point_cloud, seen_in
from .visibility import color_agreement, with_observations

UNNAMED = "the program that wrote it"
"""The program, in messages, of formats that several programs write."""

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (x right, y up, z back) to OpenCV's (x right, y down, z forward), and back."""

_ORTHOGONAL_WITHIN = 0.01
_LEAST_SEEN = 0.5
"""Least fraction of a point cloud inside a view; with less, its coordinates are not those of the cameras."""

_FAR = 1e5
"""Translation, in meters, of cameras that are placed on the Earth rather than in a scene."""
_CLEARER = 0.8
"""Largest part of the second placement's disagreement in colors with which the first one is certain."""


class Draft:
    """The model of a file, image by image.

    Attributes:
        file: The file with the cameras, in the capture's folder.
        program: The program that wrote it, for messages.
        photos: The capture's photos.
        warnings: Warnings for the user.
    """

    def __init__(self, file: Path, program: str = UNNAMED) -> None:
        self.file, self.program = file, program
        self.photos = Photos(file.parent)
        self.warnings: list[str] = []
        self._absent: list[str] = []
        self._ambiguous: list[tuple[str, Sequence[str]]] = []
        self._cameras: dict[tuple[Lens, int, int], Camera] = {}
        self._images: list[RawImage] = []
        self._named: dict[str, str] = {}

    def refusal(self, why: str) -> InputError:
        """Return the error for a damaged file; `why` follows its name."""
        return InputError(f"{self.file} {why}; {export_again(self.program)}.")

    def text(self) -> str:
        """Return the content of the file; raises InputError if it cannot be read, is too large or is not UTF-8."""
        try:
            return read_regular(self.file, LARGEST).decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.file} is not text in UTF-8; save it as UTF-8.") from error
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            raise InputError(f"{self.file} cannot be read ({why}); check the file.") from error

    def add(
        self,
        reference: str,
        lens: Callable[[int, int], Lens],
        camera_to_world: np.ndarray,
        size: tuple[int, int] | None = None,
        observed: Callable[[int, int], tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> None:
        """Add an image if its photo exists.

        Args:
            reference: What the file calls the photo.
            lens: Returns the lens of an image with this width and height in pixels.
            camera_to_world: (4, 4), OpenCV axes; a uniform scale is removed.
            size: Width and height in pixels, as the file has them; None to read them from the photo.
            observed: Returns pixels (n, 2) and point IDs (n,) of an image with this width and height.

        Raises:
            InputError: The pose is not one of a camera, or the photo cannot be read or fits another image, too.
        """
        shown = shorten(reference)
        fitting = self.photos.fitting(reference)
        if len(fitting) != 1:
            self._absent.append(shown)
            if fitting:
                self._ambiguous.append((shown, fitting))
            return
        name = fitting[0]
        require_single(self._named, name, shown, self.file)
        width, height = size or self.photos.size(name)
        key = (lens(width, height), width, height)
        if key not in self._cameras:
            self._cameras[key] = Camera(len(self._cameras) + 1, key[0].model, width, height, key[0].params)
        xy, ids = observed(width, height) if observed else (np.zeros((0, 2)), np.zeros(0, np.int64))
        quaternion, translation = self._pose(shown, np.asarray(camera_to_world, np.float64))
        self._images.append(RawImage(name, self._cameras[key].id, quaternion, translation, xy, ids))

    def _pose(self, shown: str, pose: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the quaternion and translation from world to camera; NaN, which is refused later, for no pose."""
        invalid = (np.nan,) * 4, (np.nan,) * 3
        if not np.isfinite(pose).all():
            return invalid
        with np.errstate(over="ignore", invalid="ignore"):
            determinant = float(np.linalg.det(pose[:3, :3]))
            scale = np.cbrt(abs(determinant))
            if not (np.isfinite(scale) and scale > 1e-100):
                return invalid
            turn = pose[:3, :3] / scale
            off = float(np.abs(turn @ turn.T - np.eye(3)).max())
        if determinant < 0:
            raise self.refusal(f"gives image {shown} a mirrored pose")
        if not off < _ORTHOGONAL_WITHIN:
            raise self.refusal(f"gives image {shown} a pose that is not a rotation")
        left, _, right = np.linalg.svd(turn)
        world_to_camera = (left @ right).T
        quaternion = Rotation.from_matrix(world_to_camera).as_quat(scalar_first=True)
        return tuple(quaternion), tuple(-world_to_camera @ pose[:3, 3])

    def finish(self, points: RawPoints) -> Model:
        """Return the model with points that are in the file itself; raises InputError if it cannot be used."""
        return self._model(points, self.file)

    def finish_with_point_cloud(
        self, named: str | None = None, placements: Sequence[np.ndarray] = (np.eye(4),), export: str = "its point cloud"
    ) -> Model:
        """Return the model with the points of a point cloud beside the file.

        Args:
            named: The point cloud, relative to the file, if the file names it.
            placements: (4, 4) each, maps from the coordinates that the cloud may have to those of the cameras; of those
                with most of the points in the views, the one whose colors agree with the photos is used or, where they
                do not tell, the one with the most points in each view, the first of equal ones.
            export: What to export if there is no point cloud.

        Returns:
            The model, in which an image observes the points that are not hidden in it.

        Raises:
            InputError: There is no point cloud, it cannot be read, or most of it is outside all views.
        """
        if not self._images:
            # The first thing that is wrong, whether or not there are points.
            return self.finish(
                RawPoints(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))
            )
        cloud = find_point_cloud(self.file, named, self.program, export)
        points = read_point_cloud(cloud, self.warnings)
        # Photos that are missing may have seen the rest.
        least = _LEAST_SEEN * len(self._images) / (len(self._images) + len(self._absent))
        most = 0.0
        fitting: list[tuple[Model, float]] = []
        for number, placement in enumerate(placements):
            if any(np.array_equal(placement, other) for other in placements[:number]):
                continue
            with np.errstate(over="ignore", invalid="ignore"):
                xyz = points.xyz @ placement[:3, :3].T + placement[:3, 3]
            model = self._model(RawPoints(points.ids, xyz, points.rgb, points.error), cloud)
            seen, hits = seen_in(model)
            most = max(most, seen)
            if seen >= least:
                fitting.append((model, hits))
        if not fitting:
            advice = f"export both from {self.program} in the same coordinates"
            if any(np.abs(placement[:3, 3]).max() > _FAR for placement in placements):
                # Those of a map are curved, so that no placement leads from them to the cameras.
                advice = (
                    f"export the points from {self.program} in the chunk's local coordinates, not in those of a map"
                )
            raise InputError(f"Only {most:.0%} of the points of {cloud} lie in the views of {self.file}; {advice}.")
        return with_observations(self._best(fitting))

    def _best(self, fitting: Sequence[tuple[Model, float]]) -> Model:
        """Return the best of models that differ in the placement of their points, with the mean number of views."""
        best, most = fitting[0]
        for model, hits in fitting[1:]:
            if hits > most * (1 + 1e-9):
                best, most = model, hits
        if len(fitting) > 1:
            # The number of views alone favors clouds that are shrunk into the middle.
            models = [model for model, _ in fitting]
            agreement = color_agreement(models, self.photos.folder)
            *_, second, first = sorted(agreement)
            if 1 - first <= _CLEARER * (1 - max(second, 0.0)):
                best = models[agreement.index(first)]
        return best

    def _model(self, points: RawPoints, points_file: Path) -> Model:
        ambiguous = []
        if self._ambiguous:
            shown, fitting = self._ambiguous[0]
            ambiguous.append(
                f"{len(self._ambiguous)} images that {self.file} names fit several photos in {self.photos.folder}, for "
                f"instance {shown} both {fitting[0]} and {fitting[1]}; align photos with distinct names."
            )
        if self._absent and not self._images:
            raise InputError(ambiguous[0]) if ambiguous else none_found(self.photos.folder, self._absent, self.file)
        return validate(
            Model(
                self.file.parent,
                {"cameras": self.file, "images": self.file, "points3D": points_file},
                {camera.id: camera for camera in self._cameras.values()},
                [],
                points.xyz,
                points.rgb,
                points.error,
                points.ids,
                [*self.warnings, *ambiguous],
                self.program,
                tuple(self._absent),
            ),
            self._images,
        )


def shorten(text: str) -> str:
    """Return a name from a file for a message: in one line and not too long."""
    return " ".join(text.split())[:200]
