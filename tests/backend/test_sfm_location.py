"""The size of a scene by GPS and what is up by elevations: of EXIF and XMP data, with noise and wrong values."""

import json

import numpy as np
import pytest
from PIL import ExifTags, Image

from backend.capture import compute_upright, load_capture
from backend.commands.cameras import read_upright, write_capture_cameras
from backend.sfm import location
from backend.shared.reconstruction.folder import Reconstruction

from .rendered_photos import pose


def degrees_minutes_seconds(value: float) -> tuple[float, float, float]:
    whole, rest = divmod(value * 3600.0, 3600.0)
    return whole, rest // 60, rest % 60


def test_positions_are_read_from_exif(tmp_path):
    """A degree of latitude is 111.2 km at 47 degrees, and one of longitude 76.1 km."""
    names = ("a.jpg", "b.jpg", "c.jpg", "none.jpg")
    for name, (north, east) in zip(names, ((47.0, -8.0), (47.001, -8.0), (47.0, -8.002), (0, 0)), strict=True):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.GPSInfo).update({
            ExifTags.GPS.GPSLatitudeRef: "N", ExifTags.GPS.GPSLatitude: degrees_minutes_seconds(north),
            ExifTags.GPS.GPSLongitudeRef: "W", ExifTags.GPS.GPSLongitude: degrees_minutes_seconds(-east),
        })  # fmt: skip
        Image.new("RGB", (64, 48)).save(tmp_path / name, exif=exif)
    Image.new("RGB", (64, 48)).save(tmp_path / "plain.png")
    places = location.positions_in_meters(tmp_path, [*names, "plain.png", "missing.jpg"])
    assert set(places) == set(names[:3])
    moved = [places[name] - places["a.jpg"] for name in names[1:3]]
    np.testing.assert_allclose(moved, [(0, 111.2, 0), (-152.2, 0, 0)], atol=0.3)


@pytest.mark.parametrize("wrong", [0, 6])
def test_size_in_spite_of_noise_and_wrong_positions(wrong):
    """Cameras 40 m around a scene, off by 1 m each; those without a position do not count."""
    rng = np.random.default_rng(1)
    centers = rng.normal(0, 1, (40, 3))
    places = 20.0 * centers + rng.normal(0, 1.0, centers.shape) + (300.0, -40.0, 5.0)
    places[:wrong] += rng.normal(0, 200.0, (wrong, 3))
    found = location.meters_per_unit(dict(enumerate(centers)), dict(enumerate(places[:35])))
    assert found == pytest.approx(20.0, rel=0.03 if wrong else 0.01)


def test_size_is_unknown_indoors_and_for_few_photos():
    rng = np.random.default_rng(2)
    centers = rng.normal(0, 1, (40, 3))
    nearby = 2.0 * centers + rng.normal(0, 5.0, centers.shape)
    assert location.meters_per_unit(dict(enumerate(centers)), dict(enumerate(nearby))) is None, "GPS is noise"
    assert location.meters_per_unit(dict(enumerate(centers)), dict.fromkeys(range(40), centers[0])) is None
    assert location.meters_per_unit(dict(enumerate(centers)), dict(enumerate(1.5 * centers))) is None, "too near"
    assert location.meters_per_unit(dict(enumerate(centers)), dict(enumerate(20 * centers[:4]))) is None
    assert location.meters_per_unit(dict(enumerate(centers)), {}) is None


def test_elevations_are_read_from_exif_and_from_gimbals(tmp_path):
    def save(name, xmp=None, elevation=None, orientation=1):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        if elevation is not None:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.CameraElevationAngle] = elevation
        Image.new("RGB", (64, 48)).save(tmp_path / name, exif=exif, **({"xmp": xmp} if xmp else {}))

    gimbal = 'drone-dji:GimbalRollDegree="{}"\n drone-dji:GimbalPitchDegree="{}"'
    save("exif.jpg", elevation=-30.5)
    save("drone.jpg", gimbal.format("+0.00", "-89.90").encode())
    save("element.jpg", b"<drone-dji:GimbalPitchDegree>+12.5</drone-dji:GimbalPitchDegree>")
    save("rolled.jpg", gimbal.format("+15.00", "-20.00").encode())
    save("turned.jpg", elevation=-30.5, orientation=6)
    save("wrong.jpg", elevation=400.0)
    save("plain.jpg")
    names = sorted(path.name for path in tmp_path.iterdir())
    found = location.elevations(tmp_path, [*names, "missing.jpg"])
    assert found == pytest.approx({"exif.jpg": -30.5, "drone.jpg": -89.9, "element.jpg": 12.5})


@pytest.fixture
def flight():
    """Rotations and elevations of cameras around a slope, in a world that is tilted by 35 degrees."""
    rng = np.random.default_rng(3)
    centers = np.stack([rng.uniform(-5, 5, 30), rng.uniform(-5, 5, 30), rng.uniform(3, 6, 30)], 1)
    level = [pose(center, rng.normal(0, 0.5, 3))[:, :3] for center in centers]
    angles = {str(i): float(np.degrees(np.arcsin(each[2, 2]))) for i, each in enumerate(level)}
    cosine, sine = np.cos(np.radians(35)), np.sin(np.radians(35))
    tilt = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return {str(i): each @ tilt.T for i, each in enumerate(level)}, angles, tilt[:, 2]


def test_elevations_tell_what_is_up(flight):
    rotations, angles, up = flight
    rng = np.random.default_rng(4)
    noisy = {name: angle + rng.normal(0, 1.0) for name, angle in angles.items()}
    noisy |= {str(i): -noisy[str(i)] for i in range(5)}
    found = location.up_by_elevations(rotations, noisy)
    assert np.degrees(np.arccos(found @ up)) < 0.7
    assert location.up_by_elevations(rotations, dict(list(angles.items())[:2])) is None
    assert location.up_by_elevations(rotations, {name: rng.uniform(-80, 80) for name in angles}) is None


def test_up_that_photos_told_is_used(write_capture, tmp_path):
    scene = write_capture(views=6)
    capture = load_capture(scene.folder, tmp_path / "cache")
    up = np.array([0.1, -0.9, 0.3])
    (scene.folder / "sfm").mkdir()
    (scene.folder / "sfm" / "sfm.json").write_text(json.dumps({"up": up.tolist()}))
    folder = Reconstruction(tmp_path / "out")
    folder.folder.mkdir()
    write_capture_cameras(folder, capture)
    np.testing.assert_allclose(read_upright(folder).rotation @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-6)
    for wrong in ([0, 0, 0], ["a", 0, 1], None, [0, float("nan"), 1]):
        (scene.folder / "sfm" / "sfm.json").write_text(json.dumps({"up": wrong}))
        write_capture_cameras(folder, capture)
        viewmats = np.array([view.viewmat for view in capture.views])
        expected = compute_upright(viewmats, capture.points.xyz).rotation
        np.testing.assert_allclose(read_upright(folder).rotation, expected)
