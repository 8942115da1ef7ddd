"""The size of a scene by GPS: from EXIF data, with noise and wrong positions, and where it does not tell the size."""

import numpy as np
import pytest
from PIL import ExifTags, Image

from backend.sfm import location


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
