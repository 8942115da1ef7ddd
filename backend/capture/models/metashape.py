"""Reader of Metashape's cameras as XML ("Export Cameras", Agisoft XML).

Poses are from the camera, with OpenCV's axes, to the chunk's own coordinates. The transform of the chunk or, in later
versions, of its component leads from there to the world, in which point clouds are exported.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ..colmap import Model
from ..xml_text import parse_xml
from .draft import Draft, shorten
from .lens import Lens, brown, fisheye

_PROGRAM = "Metashape"
_FISHEYE = ("fisheye", "equidistant_fisheye")
"""The name of equidistant lenses up to Metashape 2.2, and since."""
_LARGEST_SKEW = 0.5
"""Pixels by which the skew B2 may move the border of an image before it is worth a warning."""


def recognizes(head: bytes) -> bool:
    """Return whether a file that starts with these bytes is a document of Metashape."""
    return b"<document" in head and b"<chunk" in head


def read(file: Path) -> Model:
    """Read the XML file and the point cloud beside it.

    Args:
        file: The file, in the folder with the photos or beside images/.

    Returns:
        The model, in the coordinates of the world that the chunk's transform leads to.

    Raises:
        InputError: The file is damaged or contains a DTD, or there is no point cloud.
    """
    draft = Draft(file, _PROGRAM)
    chunks = _parse(draft).findall("chunk")
    chunk = next((chunk for chunk in chunks if chunk.find("cameras") is not None), None)
    if chunk is None:
        raise draft.refusal("has no chunk with cameras")
    if len(chunks) > 1:
        draft.warnings.append(f"{file} contains {len(chunks)} chunks: the first one with cameras is used.")
    sensors = {sensor.get("id"): sensor for sensor in chunk.findall("sensors/sensor")}
    own = _placement(draft, chunk.find("transform"))
    placed = {
        component.get("id"): _placement(draft, component.find("transform"))
        for component in chunk.findall("components/component")
        if component.find("transform") is not None
    }
    cameras = list(chunk.iterfind("cameras//camera"))
    posed = [
        camera
        for camera in cameras
        if camera.find("transform") is not None and camera.get("enabled", "true").lower() not in ("false", "0")
    ]
    usable = _with_usable_lens(draft, posed, sensors)
    # Components are not aligned with each other.
    components = Counter(camera.get("component_id") for camera in usable)
    component = components.most_common(1)[0][0] if usable else None
    used = [camera for camera in usable if camera.get("component_id") == component]
    if left_out := len(cameras) - len(posed) + len(usable) - len(used):
        reasons = ["are disabled", "have no pose"]
        if any(camera.get("master_id") and camera.find("transform") is None for camera in cameras):
            reasons.append("have only the pose of another camera of their rig")
        if len(components) > 1:
            reasons.append("are not in the largest component")
        draft.warnings.append(
            f"{left_out} of {len(cameras)} cameras in {file} {', '.join(reasons[:-1])} or {reasons[-1]}; they are left "
            "out."
        )
    placement = placed.get(component, own)
    lenses: dict[str | None, tuple[tuple[int, int], Lens]] = {}
    for camera in used:
        label, sensor_id = camera.get("label", ""), camera.get("sensor_id")
        if sensor_id not in lenses:
            if sensor_id not in sensors:
                raise draft.refusal(f"gives image {shorten(label)} a sensor that it does not hold")
            lenses[sensor_id] = _lens(draft, sensors[sensor_id])
        size, lens = lenses[sensor_id]
        pose = _numbers(draft, camera.find("transform"), 16, f"the transform of {shorten(label)}").reshape(4, 4)
        with np.errstate(over="ignore", invalid="ignore"):
            draft.add(label, partial(_same, lens), placement @ pose, size)
    return draft.finish_with_point_cloud(placements=[np.eye(4), placement], export="the tie points or the point cloud")


def _same(lens: Lens, _width: int, _height: int) -> Lens:
    return lens


def _parse(draft: Draft) -> Element:
    """Parse the file."""
    try:
        return parse_xml(draft.text())
    except ValueError as error:
        raise draft.refusal(str(error)) from error


def _numbers(draft: Draft, element: Element | None, count: int, what: str) -> np.ndarray:
    """Return the numbers (count,) in an element's text."""
    try:
        values = np.array((element.text or "").split() if element is not None else [], np.float64)
        if len(values) != count:
            raise ValueError
    except ValueError as error:
        raise draft.refusal(f"does not have {count} numbers as {what}") from error
    return values


def _placement(draft: Draft, transform: Element | None) -> np.ndarray:
    """Return the map (4, 4) of a transform with a rotation, a translation and a scale, each of which may be missing."""
    placement = np.eye(4)
    if transform is None:
        return placement
    found = {name: transform.find(name) for name in ("rotation", "translation", "scale")}
    if found["rotation"] is not None:
        placement[:3, :3] = _numbers(draft, found["rotation"], 9, "the rotation of a transform").reshape(3, 3)
    if found["scale"] is not None:
        placement[:3, :3] *= _numbers(draft, found["scale"], 1, "the scale of a transform")
    if found["translation"] is not None:
        placement[:3, 3] = _numbers(draft, found["translation"], 3, "the translation of a transform")
    if not np.isfinite(placement).all():
        raise draft.refusal("has a transform of the chunk that is not a number (NaN or infinite)")
    return placement


def _with_usable_lens(draft: Draft, cameras: Sequence[Element], sensors: Mapping[str | None, Element]) -> list[Element]:
    """Return the cameras whose lens can be used, with warnings about others; raises InputError if none can.

    Chunks may contain panoramas or laser scans beside the photos.
    """
    unusable = {number: why for number, sensor in sensors.items() if (why := _why_unusable(sensor))}
    found = [camera for camera in cameras if camera.get("sensor_id") not in unusable]
    left_out = Counter(camera.get("sensor_id") for camera in cameras if camera.get("sensor_id") in unusable)
    for number, count in left_out.items():
        if not found:
            raise draft.refusal(f"has {unusable[number]}")
        draft.warnings.append(
            f"{draft.file} has {unusable[number]}, so {count} of {len(cameras)} cameras with a pose are left out."
        )
    return found


def _why_unusable(sensor: Element) -> str | None:
    """Return what is wrong with the kind of a sensor's lens, or None."""
    who, kind = _who(sensor), _kind(sensor)
    if kind == "equisolid_fisheye":
        return f"the camera type {kind} {who}, which must be an equidistant fisheye"
    if kind not in ("frame", *_FISHEYE):
        return f"the camera type {shorten(kind)} {who}, which is neither frame nor fisheye"
    return f"no calibration {who}" if _calibration(sensor) is None else None


def _who(sensor: Element) -> str:
    return f"for the sensor {shorten(sensor.get('label') or sensor.get('id') or '')}"


def _kind(sensor: Element) -> str:
    calibration = _calibration(sensor)
    own = None if calibration is None else calibration.get("type")
    return own or sensor.get("type") or "frame"


def _calibration(sensor: Element) -> Element | None:
    known = sensor.findall("calibration")
    return next((entry for entry in known if entry.get("class") == "adjusted"), next(iter(known), None))


def _lens(draft: Draft, sensor: Element) -> tuple[tuple[int, int], Lens]:
    """Return the size in pixels and the lens of a sensor of a kind that can be used."""
    who, calibration = _who(sensor), _calibration(sensor)
    assert calibration is not None
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    try:
        assert resolution is not None
        width, height = int(resolution.get("width", "")), int(resolution.get("height", ""))
    except (AssertionError, ValueError) as error:
        raise draft.refusal(f"has no resolution {who}") from error

    def value(name: str) -> float:
        element = calibration.find(name)
        return 0.0 if element is None else float(_numbers(draft, element, 1, f"{name} {who}")[0])

    f, k = value("f"), (value("k1"), value("k2"), value("k3"), value("k4"))
    if not f:
        raise draft.refusal(f"has no focal length f {who}")
    if value("p3") or value("p4"):
        raise draft.refusal(f"has the coefficients P3 and P4 {who}; fit the lens without them in {_PROGRAM}")
    skew = abs(value("b2")) * height / 2 / abs(f)
    if skew > _LARGEST_SKEW:
        draft.warnings.append(f"{draft.file} has a skew {who}, which is left out; it moves pixels by up to {skew:.1f}.")
    focal, center = (f + value("b1"), f), (width / 2 + value("cx"), height / 2 + value("cy"))
    # Metashape's P1 is OpenCV's p2, and its P2 is p1.
    tangential = value("p2"), value("p1")
    if _kind(sensor) in _FISHEYE:
        return (width, height), fisheye(focal, center, k, tangential)
    try:
        return (width, height), brown(focal, center, k, tangential, (width, height))
    except ValueError as error:
        raise draft.refusal(f"has a lens that cannot be used {who}: {error}") from error
