"""Estimated gains of photos with varying exposure, against known gains."""

from types import SimpleNamespace

import numpy as np

from backend.training.exposure.gains import differences, measure_gains, varies


def photos(gains, cameras, held_out=(), points=200, noise=0.0, hidden=0.0):
    """Return a stand-in for a capture: each view shows each point as a 3 x 3 patch of its color times the view's gain,
    except a fraction `hidden` of the points, which are covered by something bright."""
    rng = np.random.default_rng(0)
    colors = rng.uniform(0.1, 0.6, (points, 3))
    columns = int(np.ceil(np.sqrt(points)))
    x, y = np.arange(points) % columns, np.arange(points) // columns

    def image(index, downscale=1):
        pixels = np.zeros((3 * columns + 3, 3 * columns + 3, 3))
        for dx in range(3):
            for dy in range(3):
                pixels[3 * y + dy, 3 * x + dx] = colors * gains[index] + rng.normal(0, noise, (points, 3))
        for i in np.random.default_rng(index).permutation(points)[: round(hidden * points)]:
            pixels[3 * y[i] : 3 * y[i] + 3, 3 * x[i] : 3 * x[i] + 3] = 0.9
        return np.round(np.clip(pixels, 0, 1) * 255).astype(np.uint8)

    keypoints = SimpleNamespace(xy=np.stack([3 * x + 1.5, 3 * y + 1.5], 1), point_index=np.arange(points))
    return SimpleNamespace(
        views=[SimpleNamespace(camera_id=c) for c in cameras],
        train_indices=tuple(i for i in range(len(cameras)) if i not in held_out),
        points=SimpleNamespace(xyz=np.zeros((points, 3))),
        image=image,
        keypoints=lambda index: keypoints,
    )


def test_known_gains_are_recovered():
    truth = np.exp(np.random.default_rng(1).normal(0, 0.15, (8, 3)))
    found = measure_gains(photos(truth, [1] * 8, noise=0.01))
    truth /= np.exp(np.log(truth).mean(0))
    np.testing.assert_allclose(found, truth, rtol=0.01)
    assert varies(found)


def test_occluded_points_are_ignored():
    truth = np.exp(np.random.default_rng(1).normal(0, 0.15, (8, 3)))
    shares = np.linspace(0, 0.2, 8)
    views = photos(truth, [1] * 8, noise=0.01)
    images = [photos(truth, [1] * 8, noise=0.01, hidden=share).image for share in shares]
    views.image = lambda index, downscale=1: images[index](index)
    np.testing.assert_allclose(measure_gains(views), truth / np.exp(np.log(truth).mean(0)), rtol=0.1)


def test_few_of_many_observations_suffice(monkeypatch):
    truth = np.exp(np.random.default_rng(1).normal(0, 0.15, (8, 3)))
    views = photos(truth, [1] * 8, points=1000, noise=0.01)
    whole, used = measure_gains(views), []
    bincount = np.bincount
    monkeypatch.setattr(np, "bincount", lambda x, *args, **options: used.append(x) or bincount(x, *args, **options))
    monkeypatch.setattr("backend.training.exposure.gains._MOST_OBSERVATIONS", 3000)
    found = measure_gains(views)
    np.testing.assert_allclose(found, whole, rtol=0.01)
    # The same points in all views.
    assert all(len(points) == 2000 and (bincount(points)[::4] == 8).all() for points in used)


def test_equal_photos_have_no_exposure_variation():
    assert not varies(measure_gains(photos(np.ones((8, 3)), [1] * 8, noise=0.02)))


def test_held_out_views_are_at_the_common_exposure():
    truth = np.array([[1.0] * 3, [1.1] * 3, [3.0] * 3, [1.3] * 3, [0.8] * 3])
    cameras = [1, 1, 1, 1, 2]
    found = measure_gains(photos(truth, cameras, held_out=(2,)))
    assert (found[2] == 1).all() and found[3, 0] > found[4, 0]
    darker = truth.copy()
    darker[2] = 0.2
    np.testing.assert_array_equal(found, measure_gains(photos(darker, cameras, held_out=(2,))))


def test_gains_without_observations_are_one():
    assert (measure_gains(photos(np.full((4, 3), 0.5), [1] * 4, points=5)) == 1).all()


def test_views_without_a_gain_do_not_hide_a_variation():
    own = np.repeat(np.exp([[-0.05], [0.05]]), 3, 1)
    assert abs(differences(np.concatenate([own, np.ones((30, 3))])) - 0.05) < 1e-9
    assert differences(np.ones((5, 3))) == 0.0
