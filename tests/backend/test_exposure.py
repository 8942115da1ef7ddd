"""Estimated gains of photos with varying exposure, against known gains."""

import tracemalloc
from types import SimpleNamespace

import numpy as np

from backend.training.exposure import gains as of_photos
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
    whole, used, log_gains = measure_gains(views), [], of_photos._log_gains
    monkeypatch.setattr(of_photos, "_log_gains", lambda *args: used.append(args[1]) or log_gains(*args))
    monkeypatch.setattr(of_photos, "_MOST_OBSERVATIONS", 3000)
    found = measure_gains(views)
    np.testing.assert_allclose(found, whole, rtol=0.01)
    # The same points in all views.
    assert len(used) == 3
    assert all(len(points) == 2000 and (np.bincount(points)[::4] == 8).all() for points in used)


def test_photos_with_few_points_keep_them(monkeypatch):
    truth = np.exp(np.random.default_rng(1).normal(0, 0.15, (8, 3)))
    views = photos(truth, [1] * 8, points=1000, noise=0.01)
    every = views.keypoints(0)
    few = SimpleNamespace(xy=every.xy[:60], point_index=every.point_index[:60])
    views.keypoints = lambda index: few if index == 5 else every
    monkeypatch.setattr(of_photos, "_MOST_OBSERVATIONS", 1000)
    np.testing.assert_allclose(measure_gains(views), truth / np.exp(np.log(truth).mean(0)), rtol=0.01)


def test_points_in_many_photos_take_little_memory():
    """Without a matrix of the photos, which share each point."""
    views, points = 4000, 20
    view, point = np.divmod(np.arange(views * points), points)
    truth = np.random.default_rng(1).normal(0, 0.15, views)
    tracemalloc.start()
    found = of_photos._log_gains(view, point, truth[view] + 0.1 * point - 3, views, points, lambda: None)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(found - found.mean(), truth - truth.mean(), atol=1e-3)
    assert most < 8 * views**2


def observing(points, count):
    """Return a stand-in for a capture of `count` points, of which each view observes those of the indices `points`."""
    views = range(len(points))
    return SimpleNamespace(
        views=views,
        train_indices=views,
        points=SimpleNamespace(xyz=np.zeros((count, 3))),
        keypoints=lambda index: SimpleNamespace(point_index=points[index]),
    )


def orbit(monkeypatch, gains, brightness, wrong=0.0):
    """Return a stand-in for a capture of 60 photos around something, each of whose points 8 neighbors show.

    gains: (60,) of the photos. brightness: of what the 60 photos show. wrong: fraction of the observations that show
    another point.
    """
    rng = np.random.default_rng(0)
    points, first = 60 * 40, rng.integers(0, 60, 60 * 40)
    colors = brightness[first][:, None] * rng.uniform(0.5, 1.5, (points, 3))
    point = np.repeat(np.arange(points), 8)
    view = (first[point] + np.tile(np.arange(8), points)) % 60
    seen = colors[np.where(rng.random(len(point)) < wrong, rng.permutation(point), point)]
    seen = np.clip(seen * np.exp(rng.normal(0, 0.05, seen.shape)) * gains[view][:, None], 0, 1)
    monkeypatch.setattr(of_photos, "_observations", lambda _, i, __: (point[view == i], seen[view == i]))
    return observing([point[view == i] for i in range(60)], points)


def test_exposure_that_changes_along_a_path_is_found(monkeypatch):
    """No point connects photos that are far apart."""
    truth = np.exp(0.4 * np.sin(2 * np.pi * np.arange(60) / 60))
    found = measure_gains(orbit(monkeypatch, truth, np.full(60, 0.3)))
    np.testing.assert_allclose(found, np.repeat(truth[:, None], 3, 1), rtol=0.03)


def test_a_dark_half_is_no_other_exposure(monkeypatch):
    """Although what is wrong there is mostly too bright."""
    found = measure_gains(orbit(monkeypatch, np.ones(60), np.repeat([0.12, 0.5], 30), wrong=0.05))
    assert not varies(found)


def test_photos_without_common_points_have_no_gain(monkeypatch):
    """Photos are compared within their groups; black photos and channels have finite gains."""
    gains = np.array([1, 1.25, 0.8, 0.5, 0.4, 0.625, 1, 0])
    colors = np.random.default_rng(0).uniform(0.1, 0.6, (200, 3)) * [1, 1, 0]
    points = [np.arange(100) + 100 * (i >= 3) for i in range(6)] + [np.arange(200, 300), np.arange(100)]
    seen = [gains[i] * colors[points[i] % 200] for i in range(8)]
    monkeypatch.setattr(of_photos, "_observations", lambda _, i, __: (points[i], seen[i]))
    found = measure_gains(observing(points, 300))
    assert np.isfinite(found).all() and (found[6] == 1).all() and (found[:, 2] == 1).all()
    np.testing.assert_allclose(found[:3, 0] / found[0, 0], gains[:3] / gains[0], rtol=1e-2)
    np.testing.assert_allclose(found[3:6, 0] / found[3, 0], gains[3:6] / gains[3], rtol=1e-2)


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
