"""The size of a scene by GPS and what is up by sensors: of EXIF and XMP data, with noise and wrong values."""

import json
import struct

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

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
    found = location.ups_in_cameras(tmp_path, [*names, "missing.jpg"])
    angles = {name: float(np.degrees(np.arctan2(up[2], -up[1]))) for name, up in found.items()}
    assert angles == pytest.approx({"exif.jpg": -30.5, "drone.jpg": -89.9, "element.jpg": 12.5})
    assert all(up[0] == 0 for up in found.values())


def maker_notes(gravity, order: str = ">") -> bytes:
    """Return maker notes of an Apple phone with a version and gravity, as its cameras write them."""
    entries = ((1, 9, 1, 14), (8, 10, 3, 14 + 2 + 2 * 12 + 4))
    directory = struct.pack(f"{order}H", 2) + b"".join(struct.pack(f"{order}HHII", *entry) for entry in entries)
    values = [number for value in gravity for number in (round(value * 1e6), 1_000_000)]
    head = b"Apple iOS\0\0\1" + {">": b"MM", "<": b"II"}[order]
    return head + directory + struct.pack(f"{order}I", 0) + struct.pack(f"{order}6i", *values)


def test_gravity_of_phones_is_read_however_they_were_held(tmp_path):
    """Phones hold gravity to their right, to their top and out of their screen, and stand on any of their sides."""

    def save(name, gravity, orientation=1, size=(64, 48), lens="back camera", turn=False, order=">"):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote] = maker_notes(gravity, order)
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.LensModel] = f"iPhone {lens}"
        Image.new("RGB", size).save(tmp_path / name, exif=exif)
        if turn:
            turned = ImageOps.exif_transpose(Image.open(tmp_path / name))
            turned.save(tmp_path / name, exif=turned.getexif())

    save("landscape.jpg", (-1, 0, 0))
    save("landscape-little-endian.jpg", (-1, 0, 0), order="<")
    save("landscape-down.jpg", (-0.8, 0, -0.6))
    save("landscape-rolled.jpg", (-0.8, 0.6, 0))
    save("portrait-stored.jpg", (0, -1, 0), 6)
    save("portrait-turned.jpg", (0, -0.8, -0.6), 6, turn=True)
    save("portrait-turned-rolled.jpg", (0.6, -0.8, 0), 6, turn=True)
    save("other-portrait-turned.jpg", (0, 0.8, 0.6), 8, turn=True)
    save("other-landscape-turned.jpg", (1, 0, 0), 3, turn=True)
    save("other-landscape-stored.jpg", (1, 0, 0), 3)
    save("flat.jpg", (-0.1, 0.1, -0.99))
    save("moved.jpg", (-1.3, 0, 0))
    save("front.jpg", (-1, 0, 0), lens="front camera")
    save("square.jpg", (-1, 0, 0), size=(48, 48))
    save("zero.jpg", (0, 0, 0))
    found = location.ups_in_cameras(tmp_path, sorted(path.name for path in tmp_path.iterdir()))
    expected = {
        "landscape.jpg": (0, -1, 0),
        "landscape-little-endian.jpg": (0, -1, 0),
        "landscape-down.jpg": (0, -0.8, -0.6),
        "landscape-rolled.jpg": (0.6, -0.8, 0),
        "portrait-stored.jpg": (-1, 0, 0),
        "portrait-turned.jpg": (0, -0.8, -0.6),
        "portrait-turned-rolled.jpg": (-0.6, -0.8, 0),
        "other-portrait-turned.jpg": (0, -0.8, 0.6),
        "other-landscape-turned.jpg": (0, -1, 0),
        "other-landscape-stored.jpg": (0, 1, 0),
    }
    assert set(found) == set(expected)
    for name, up in expected.items():
        np.testing.assert_allclose(found[name], up, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    "notes", [b"Apple iOS\0\0\1", b"Apple iOS\0\0\1XX\0\0", maker_notes((-1, 0, 0))[:40], b"Canon"]
)
def test_damaged_maker_notes_tell_nothing(notes, tmp_path):
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.MakerNote] = notes
    Image.new("RGB", (64, 48)).save(tmp_path / "a.jpg", exif=exif)
    assert not location.ups_in_cameras(tmp_path, ["a.jpg"])


@pytest.fixture
def flight():
    """Rotations of cameras around a slope, in a world that is tilted by 35 degrees, and what is up in each of them."""
    rng = np.random.default_rng(3)
    centers = np.stack([rng.uniform(-5, 5, 30), rng.uniform(-5, 5, 30), rng.uniform(3, 6, 30)], 1)
    level = [pose(center, rng.normal(0, 0.5, 3))[:, :3] for center in centers]
    ups = {str(i): each[:, 2] for i, each in enumerate(level)}
    cosine, sine = np.cos(np.radians(35)), np.sin(np.radians(35))
    tilt = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return {str(i): each @ tilt.T for i, each in enumerate(level)}, ups, tilt[:, 2]


def test_photos_tell_what_is_up(flight):
    rotations, ups, up = flight
    rng = np.random.default_rng(4)

    def about(direction, deviation):
        moved = direction + rng.normal(0, deviation, 3)
        return moved / np.linalg.norm(moved)

    noisy = {name: about(direction, np.radians(1.0)) for name, direction in ups.items()}
    noisy |= {str(i): about(ups[str(i)], 3.0) for i in range(5)}
    found = location.common_up(rotations, noisy)
    assert np.degrees(np.arccos(found @ up)) < 0.7
    assert location.common_up(rotations, dict(list(ups.items())[:2])) is None
    assert location.common_up(rotations, {name: about(np.zeros(3), 1.0) for name in ups}) is None


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
