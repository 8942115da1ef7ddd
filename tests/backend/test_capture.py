"""Captures: all camera models, mask formats and kinds of bad input; real COLMAP files if ../shared/data exists."""

from __future__ import annotations

import json
import os
import struct
import threading
import unicodedata
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageCms

from backend.capture import check_capture, load_capture
from backend.capture.capture import HOLDOUT_EVERY
from backend.capture.colmap import CAMERA_MODELS, Camera, read_model
from backend.capture.files import Files, image_size, mask_names, read_image, read_mask
from backend.capture.undistort import distort, pinhole_for, source_pixels, to_pycolmap
from backend.commands.folder import digest
from backend.shared.errors import InputError
from backend.shared.events import Reporter

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FIXTURES = DATA / "fixtures"


def fixture(name: str) -> Path:
    if not (FIXTURES / name).is_dir():
        pytest.skip(f"fixture {name} is absent")
    return FIXTURES / name


def assert_load_rejected(folder: Path, tmp_path: Path, *words: str, **options) -> str:
    """Check that loading fails with a sentence that contains `words`, leaves no partial files, and that `check_capture`
    reports the same problem."""
    cache = tmp_path / "cache-of-rejected"
    with pytest.raises(InputError) as caught:
        load_capture(folder, cache, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence and sentence.endswith(".") and len(sentence) < 600
    for word in words:
        assert word in sentence, sentence
    assert not list(cache.rglob("*.part"))
    problems = check_capture(folder)["problems"]
    assert sentence in problems or any(all(word in problem for word in words) for problem in problems), problems
    return sentence


# Loading


def test_loading_restores_views_points_and_masks(write_capture, tmp_path):
    scene = write_capture(views=9)
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert [view.name for view in capture.views] == sorted(scene.names)
    assert capture.warnings == []
    for index, view in enumerate(capture.views):
        assert view.image_file == scene.folder / "images" / view.name
        assert view.mask_file == scene.folder / "masks" / view.name
        np.testing.assert_allclose(view.viewmat, scene.viewmats[index], atol=1e-12)
        np.testing.assert_array_equal(view.K, [[96, 0, 48], [0, 96, 36], [0, 0, 1]])
        assert capture.image(index).shape == (72, 96, 3) and capture.image(index).dtype == np.uint8
        mask = capture.mask(index)
        assert mask is not None and mask.dtype == np.int64
        np.testing.assert_array_equal(mask, scene.ids[index])
        keypoints = capture.keypoints(index)
        np.testing.assert_allclose(keypoints.xy, scene.pixels[index], atol=1e-9)
        np.testing.assert_array_equal(keypoints.point_index, scene.seen[index])
    np.testing.assert_array_equal(capture.points.xyz, scene.xyz)
    np.testing.assert_array_equal(capture.points.ids, 10 * np.arange(len(scene.xyz)) + 3)
    np.testing.assert_array_equal(capture.points.rgb[:, 2], np.arange(len(scene.xyz)) % 256)
    assert (capture.points.error == 0.5).all()
    assert capture.names == {1: "sphere 1", 2: "sphere 2", 5: "sphere 5"}
    assert capture.object_ids.tolist() == [1, 2, 5]
    assert capture.test_indices == (0, HOLDOUT_EVERY) and len(capture.train_indices) == 7
    assert not set(capture.test_indices) & set(capture.train_indices)
    assert capture.counts["registered"] == capture.counts["masks"] == 9
    assert list((tmp_path / "cache" / "views").glob("*.png")) == [], "pinhole images are used in place"


def test_text_and_binary_models_load_equally(write_capture, tmp_path):
    names = ["a b.png", "日本/x  y.png", " #1.png".strip(), "UPPER name.PNG", "back\\slash.png", "z.png"]
    one = write_capture(name="one", names=names, suffix=".bin")
    two = write_capture(name="two", names=names, suffix=".txt")
    a, b = load_capture(one.folder, tmp_path / "a"), load_capture(two.folder, tmp_path / "b")
    assert [v.name for v in a.views] == [v.name for v in b.views] == sorted(names)
    np.testing.assert_array_equal(a.points.xyz, b.points.xyz)
    for i in range(len(names)):
        np.testing.assert_array_equal(a.views[i].viewmat, b.views[i].viewmat)
        np.testing.assert_array_equal(a.keypoints(i).xy, b.keypoints(i).xy)
        np.testing.assert_array_equal(a.keypoints(i).point_index, b.keypoints(i).point_index)


def test_read_model_matches_pycolmap(write_capture):
    scene = write_capture(model="OPENCV", params=[80, 82, 47, 37, 0.05, -0.02, 0.001, 0.002])
    folder = scene.folder / "sparse" / "0"
    theirs, ours = pycolmap.Reconstruction(str(folder)), read_model(folder)
    assert len(theirs.images) == len(ours.images) and len(theirs.points3D) == len(ours.xyz)
    by_name = {image.name: image for image in ours.images}
    for image in theirs.images.values():
        np.testing.assert_allclose(image.cam_from_world().matrix(), by_name[image.name].viewmat[:3], atol=1e-12)
    assert list(theirs.cameras[1].params) == list(ours.cameras[1].params)


def test_camera_models_match_colmap():
    for number, (name, count) in CAMERA_MODELS.items():
        model = getattr(pycolmap.CameraModelId, name)
        assert int(model) == number
        made = pycolmap.Camera.create_from_model_id(1, model, 100.0, 64, 48)
        assert len(made.params) == count


def test_downscaled_images_and_masks_match(write_capture, tmp_path):
    scene = write_capture(size=(97, 74))
    capture = load_capture(scene.folder, tmp_path / "cache")
    full = np.asarray(Image.open(capture.views[1].image_file)).astype(float)
    for downscale in (2, 3, 5):
        width, height = 97 // downscale, 74 // downscale
        image, mask = capture.image(1, downscale), capture.mask(1, downscale)
        assert image.shape == (height, width, 3) and mask is not None and mask.shape == (height, width)
        cropped = full[: height * downscale, : width * downscale]
        mean = cropped.reshape(height, downscale, width, downscale, 3).mean((1, 3))
        assert np.abs(image - mean).max() <= 0.6
        assert set(np.unique(mask)) <= {0, 1, 2, 5}
        center = downscale // 2
        np.testing.assert_array_equal(mask, scene.ids[1][center::downscale, center::downscale][:height, :width])
    with pytest.raises(ValueError):
        capture.image(1, 100)


def test_few_views_have_no_held_out_views(write_capture, tmp_path):
    capture = load_capture(write_capture(views=2).folder, tmp_path / "cache")
    assert capture.test_indices == () and capture.train_indices == (0, 1)
    assert any("held out" in warning for warning in capture.warnings)


def test_test_file_names_held_out_views(write_capture, tmp_path):
    scene = write_capture(views=9)
    (scene.folder / "test.txt").write_text("\ufeffview_003.png\r\n\n  view_005.png  \n", encoding="utf-8")
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert capture.test_indices == (3, 5) and capture.train_indices == (0, 1, 2, 4, 6, 7, 8)
    assert check_capture(scene.folder)["problems"] == []


@pytest.mark.parametrize("views", [2, 9])
def test_empty_test_file_holds_out_none(write_capture, tmp_path, views):
    scene = write_capture(views=views)
    (scene.folder / "test.txt").write_text("\n")
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert capture.test_indices == () and capture.train_indices == tuple(range(views))
    assert not any("held out" in warning for warning in capture.warnings), "this is what the file asks for"


def test_test_file_may_hold_out_one_of_two_views(write_capture, tmp_path):
    scene = write_capture(views=2)
    (scene.folder / "test.txt").write_text("view_001.png")
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert capture.test_indices == (1,) and capture.train_indices == (0,)


def test_views_without_photos_may_be_held_out(write_capture, tmp_path):
    scene = write_capture(views=9)
    (scene.folder / "test.txt").write_text("view_003.png\nview_005.png")
    (scene.folder / "images" / "view_003.png").unlink()
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert [capture.views[i].name for i in capture.test_indices] == ["view_005.png"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"view_001.png\nphoto 7.png\n", ("photo 7.png", "images.bin", "remove")),
        (b"view_000.png\nview_001.png\nview_002.png", ("all 3 views", "remove")),
        (b"\xff\xfe\x00view", ("UTF-8",)),
    ],
)
def test_unusable_test_files_are_rejected(write_capture, tmp_path, content, words):
    scene = write_capture(views=3)
    (scene.folder / "test.txt").write_bytes(content)
    assert_load_rejected(scene.folder, tmp_path, str(scene.folder / "test.txt"), *words)


def test_test_file_that_is_a_folder_is_rejected(write_capture, tmp_path):
    scene = write_capture(views=3)
    (scene.folder / "test.txt").mkdir()
    assert_load_rejected(scene.folder, tmp_path, str(scene.folder / "test.txt"))


def test_digest_depends_on_held_out_views(write_capture, tmp_path):
    scene, listed = write_capture(views=9), "view_000.png\nview_008.png"
    found = {}
    for name, content in (("default", None), ("same", listed), ("one", "view_003.png"), ("none", "")):
        if content is not None:
            (scene.folder / "test.txt").write_text(content)
        found[name] = digest(load_capture(scene.folder, tmp_path / "cache"))
    assert found["default"] == found["same"] and len(set(found.values())) == 3


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_pixels_of_tiffs_are_taken_as_stored(tmp_path, orientation, compression):
    """As COLMAP takes them, whatever their orientation tags say."""
    pixels = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    path = tmp_path / "a.tif"
    Image.fromarray(pixels).save(path, compression=compression, tiffinfo={274: orientation})
    assert image_size(path) == (30, 20)
    assert np.array_equal(np.asarray(read_image(path)), pixels)


def exchanged_profile() -> bytes:
    """Return an ICC profile like sRGB, whose red is blue and whose blue is red."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    end = 132 + 12 * int.from_bytes(profile[128:132], "big")
    table = profile[:end].replace(b"rXYZ", b"_XYZ").replace(b"bXYZ", b"rXYZ").replace(b"_XYZ", b"bXYZ")
    return table + profile[end:].replace("sRGB".encode("utf-16-be"), "mine".encode("utf-16-be"))


@pytest.mark.parametrize(
    ("mode", "name"), [("RGB", "a.png"), ("RGB", "a.jpg"), ("RGB", "a.tif"), ("RGBA", "a.png"), ("RGBA", "a.tif")]
)
def test_colors_are_those_of_the_profile(tmp_path, mode, name):
    pixels = np.kron(np.random.default_rng(0).integers(0, 256, (4, 6, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    image = Image.fromarray(pixels)
    if mode == "RGBA":
        image.putalpha(0)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile, expected in ((exchanged_profile(), pixels[..., ::-1]), (srgb, pixels), (b"damaged", pixels)):
        image.save(tmp_path / name, icc_profile=profile, quality=100, subsampling=0)
        found = np.asarray(read_image(tmp_path / name), int)
        assert np.abs(found - expected).max() <= (6 if name == "a.jpg" else 2 if profile != srgb else 0), len(profile)


def test_gray_and_cmyk_photos_are_read(tmp_path):
    gray = np.random.default_rng(0).integers(0, 256, (20, 30)).astype(np.uint8)
    Image.fromarray(gray).save(tmp_path / "gray.png", icc_profile=exchanged_profile())
    assert np.array_equal(np.asarray(read_image(tmp_path / "gray.png"))[..., 1], gray), "a profile of other channels"
    Image.new("CMYK", (30, 20), (0, 255, 255, 0)).save(tmp_path / "ink.tif")
    assert np.asarray(read_image(tmp_path / "ink.tif"))[5, 5].tolist() == [255, 0, 0]


def test_image_cache_limits_memory_across_threads(write_capture, tmp_path):
    scene = write_capture(views=8)
    size = 96 * 72 * 3
    capture = load_capture(scene.folder, tmp_path / "cache", memory_mb=2.5 * size / 1e6)
    expected = [np.asarray(Image.open(view.image_file)) for view in capture.views]
    wrong = []

    def work(seed: int) -> None:
        for i in np.random.default_rng(seed).integers(0, 8, 60):
            if not np.array_equal(capture.image(int(i)), expected[i]):
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert 0 < capture._cache.bytes <= 2.5 * size
    assert capture._cache.bytes == sum(array.nbytes for array in capture._cache._arrays.values())
    assert capture.image(7) is capture.image(7), "the last image stays cached"
    with pytest.raises(ValueError):
        capture.image(7)[0] = 0


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "I;16", "CMYK", "1"])
def test_image_modes_are_converted_to_rgb(write_capture, tmp_path, mode):
    scene = write_capture(views=3, names=[f"{i}.{'tif' if mode == 'CMYK' else 'png'}" for i in range(3)])
    for name in scene.names:
        gray = np.tile(np.linspace(0, 255, 96).astype(np.uint8), (72, 1))
        if mode == "I;16":
            image = Image.fromarray(gray.astype(np.uint16) * 257)
        elif mode == "RGBA":
            image = Image.fromarray(np.stack([gray, gray, gray, np.zeros_like(gray)], -1), "RGBA")
        elif mode == "P":
            image = Image.fromarray(gray).convert("P")
        else:
            image = Image.fromarray(gray).convert("RGB").convert(mode)
        image.save(scene.folder / "images" / name)
    capture = load_capture(scene.folder, tmp_path / "cache")
    image = capture.image(0)
    assert image.shape == (72, 96, 3) and image.dtype == np.uint8
    if mode != "1":
        assert np.abs(image.astype(int) - gray[..., None]).max() <= 1


# Undistortion

LENSES = {
    "SIMPLE_RADIAL": [500, 320, 240, 0.05],
    "RADIAL": [500, 320, 240, 0.05, 0.01],
    "OPENCV": [500, 510, 320, 240, 0.05, 0.01, 0.001, 0.002],
    "OPENCV_FISHEYE": [300, 310, 320, 240, 0.02, 0.01, 0.001, 0.0005],
    "FULL_OPENCV": [500, 510, 320, 240, 0.05, 0.01, 0.001, 0.002, 0.001, 0.01, 0.002, 0.0001],
    "FOV": [500, 510, 320, 240, 0.5],
    "SIMPLE_RADIAL_FISHEYE": [300, 320, 240, 0.02],
    "RADIAL_FISHEYE": [300, 320, 240, 0.02, 0.01],
    "THIN_PRISM_FISHEYE": [300, 310, 320, 240, 0.02, 0.01, 0.001, 0.0005, 0.001, 0.002, 0.0001, 0.0002],
    "RAD_TAN_THIN_PRISM_FISHEYE": [300, 310, 320, 240, 0.02, 0.01, 0, 0, 0, 0, 0.001, 0.001, 0.001, 0, 0.001, 0],
    "SIMPLE_DIVISION": [500, 320, 240, -0.1],
    "DIVISION": [500, 510, 320, 240, -0.1],
    "SIMPLE_FISHEYE": [300, 320, 240],
    "FISHEYE": [300, 310, 320, 240],
    "EUCM": [300, 310, 320, 240, 0.6, 1.1],
    "RADIAL with a barrel": [500, 300, 250, -0.25, 0.08],
    "OPENCV off center": [700, 700, 500, 100, 0.1, -0.2, 0.0, 0.0],
}


def lens_of(name: str, width: int = 640, height: int = 480) -> Camera:
    return Camera(7, name.split()[0], width, height, tuple(map(float, LENSES[name])))


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("max_size", [0, 400])
def test_undistorted_points_match_pinhole_projection(write_capture, tmp_path, name, max_size):
    """Spots painted at the projections of pycolmap's distorted camera appear at those of the undistorted K."""
    camera = lens_of(name)
    scene = write_capture(
        views=3, size=(640, 480), model=camera.model, params=list(camera.params), masks=False, points=2
    )
    lens = scene.lens()
    target = pinhole_for(camera, Path("cameras.bin"), max_size)
    assert max(target.width, target.height) <= (max_size or 10_000)
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(0.08, 0.92, 6) * target.width, np.linspace(0.08, 0.92, 5) * target.height)
    spots = np.stack([x.ravel(), y.ravel()], 1) + rng.uniform(-0.5, 0.5, (30, 2))
    depth = rng.uniform(1, 5, 30)
    xyz = np.column_stack([(spots - target.K[:2, 2]) / [target.K[0, 0], target.K[1, 1]], np.ones(30)]) * depth[:, None]
    seen = np.asarray(lens.img_from_cam(xyz))
    assert (seen > 0).all() and (seen < [640, 480]).all()
    # Spots are round in the pinhole view; the inverse camera model gives their shape in the distorted image.
    canvas = np.zeros((480, 640))
    rays = write_capture.rays_of(lens)[..., :2] * [target.K[0, 0], target.K[1, 1]] + target.K[:2, 2]
    for (u, v), (a, b) in zip(spots, seen.astype(int)):
        near = np.s_[max(b - 15, 0) : b + 16, max(a - 15, 0) : a + 16]
        spot = np.exp(-((rays[near] - [u, v]) ** 2).sum(-1) / (2 * 2.5**2))
        canvas[near] = np.maximum(canvas[near], spot)
    for image_name in scene.names:
        gray = (255 * canvas[..., None]).round().astype(np.uint8)
        Image.fromarray(np.repeat(gray, 3, 2)).save(scene.folder / "images" / image_name)
    capture = load_capture(scene.folder, tmp_path / "cache", max_size=max_size)
    image = capture.image(0)[..., 0].astype(float)
    assert image.shape == (target.height, target.width)
    off = np.empty((30, 2))
    for i, (u, v) in enumerate(spots.astype(int)):
        patch = image[v - 7 : v + 8, u - 7 : u + 8]
        gy, gx = np.mgrid[v - 7 : v + 8, u - 7 : u + 8] + 0.5
        off[i] = np.array([(patch * gx).sum(), (patch * gy).sum()]) / patch.sum() - spots[i]
    assert np.abs(off).max() < 0.1 and np.abs(np.median(off, 0)).max() < 0.03


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_images_have_no_blank_pixels(name):
    camera = lens_of(name)
    target = pinhole_for(camera, Path("cameras.bin"), 0)
    at = source_pixels(camera, target)
    assert (at >= -0.01).all() and (at[0] <= 480.01).all() and (at[1] <= 640.01).all()
    # The view is as large as possible: its border reaches the image's border or the limit.
    reach = [-target.K[0, 2] / target.K[0, 0], (target.width - target.K[0, 2]) / target.K[0, 0]]
    touches = min(at.min(), (480 - at[0]).min(), (640 - at[1]).min()) < 2
    assert touches or max(map(abs, reach)) > 1.72


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.long
def test_keypoints_are_undistorted(write_capture, tmp_path, name):
    camera = lens_of(name)
    scene = write_capture(views=2, size=(640, 480), model=camera.model, params=list(camera.params))
    capture = load_capture(scene.folder, tmp_path / "cache", max_size=500)
    for index, view in enumerate(capture.views):
        keypoints = capture.keypoints(index)
        assert len(keypoints.xy) == len(scene.seen[index]) > 20
        xyz = capture.points.xyz[keypoints.point_index] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        projected = xyz @ view.K.T
        np.testing.assert_allclose(keypoints.xy, projected[:, :2] / projected[:, 2:], atol=0.02)


@pytest.mark.parametrize("name", ["OPENCV", "THIN_PRISM_FISHEYE", "RADIAL with a barrel"])
def test_undistorted_masks_match_pinhole_rendering(write_capture, tmp_path, name):
    sphere_ids = write_capture.sphere_ids

    camera = lens_of(name)
    spheres = [(1, (-0.7, 0.0, 0.0), 0.5), (70_000, (0.7, 0.1, 0.0), 0.45), (4_000_000_000, (0.0, -0.2, 0.9), 0.35)]
    scene = write_capture(views=3, size=(640, 480), model=camera.model, params=list(camera.params), spheres=spheres)
    for index, image_name in enumerate(scene.names):
        path = (scene.folder / "masks" / image_name).with_suffix(".npy")
        path.with_suffix(".png").unlink()
        np.save(path, scene.ids[index].astype(np.uint32))
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert capture.object_ids.tolist() == [1, 70_000, 4_000_000_000]
    for index, view in enumerate(capture.views):
        x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T
        truth, _ = sphere_ids(rays, view.viewmat, spheres)
        mask = capture.mask(index)
        assert mask is not None and mask.shape == truth.shape
        assert set(np.unique(mask)) <= {0, 1, 70_000, 4_000_000_000}
        assert (mask == truth).mean() > 0.995


def test_distortion_fold_over_is_cropped():
    """The view must end before the fold, beyond which rays project into the image a second time."""
    camera = Camera(1, "SIMPLE_RADIAL", 200, 150, (100.0, 100.0, 75.0, -0.5))
    target = pinhole_for(camera, Path("cameras.bin"), 0)
    corner = np.hypot(target.K[0, 2] / target.K[0, 0], target.K[1, 2] / target.K[1, 1])
    assert 0.6 < corner < np.sqrt(1 / 1.5), "the fold lies at sqrt(1 / (3 * 0.5))"
    at = source_pixels(camera, target)
    assert (np.diff(at[1], axis=1) > 0).all() and (np.diff(at[0], axis=0) > 0).all()


def test_wide_fisheye_is_limited_to_120_degrees():
    camera = Camera(1, "OPENCV_FISHEYE", 1000, 1000, (260.0, 260.0, 500.0, 500.0, 0.0, 0.0, 0.0, 0.0))
    target = pinhole_for(camera, Path("cameras.bin"), 0)
    assert 2 * np.degrees(np.arctan(target.width / 2 / target.K[0, 0])) == pytest.approx(120, abs=0.5)


@pytest.mark.parametrize(
    "params",
    [(4.95, 960, 540, 343.1), (400, 960, 540, 343.1), (1000, 960, 540, -40.0), (0.0, 960, 540, 0.0),
     (1e9, 960, 540, 0.1), (-900.0, 960, 540, 0.0), (900.0, 1e7, 540, 0.0)],
)  # fmt: skip
def test_degenerate_lenses_are_rejected(params):
    with pytest.raises(InputError, match=r"cameras\.bin gives camera 1 \(SIMPLE_RADIAL\).*degenerate"):
        pinhole_for(Camera(1, "SIMPLE_RADIAL", 1920, 1080, tuple(map(float, params))), Path("cameras.bin"), 0)


def test_random_lenses_give_valid_pinholes_or_errors():
    rng = np.random.default_rng(0)
    made = 0
    for _ in range(200):
        strength = 10.0 ** rng.uniform(-2, 1)
        params = (rng.uniform(50, 900), rng.uniform(50, 900), *rng.uniform(0, 200, 2), *rng.normal(size=8) * strength)
        camera = Camera(1, "FULL_OPENCV", 200, 150, params)
        try:
            target = pinhole_for(camera, Path("cameras.bin"), 0)
        except InputError:
            continue
        made += 1
        assert 0.2 * 200 <= target.width < 20_000 and 0.2 * 150 <= target.height < 20_000
        at = source_pixels(camera, target)
        assert (at >= -0.6).all() and (at[0] <= 150.6).all() and (at[1] <= 200.6).all()
    assert made > 5


def test_panorama_camera_is_rejected(write_capture, tmp_path):
    scene = write_capture(masks=False)
    (scene.folder / "sparse/0/cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 1, 17, 96, 72, 96, 72))
    assert_load_rejected(scene.folder, tmp_path, "cameras.bin", "EQUIRECTANGULAR", "panorama")


# The cache


def test_cache_is_reused_and_updated_with_sources(write_capture, tmp_path):
    scene = write_capture(views=3, model="SIMPLE_RADIAL", params=[90, 48, 36, 0.1])
    cache = tmp_path / "cache"

    def load():
        capture = load_capture(scene.folder, cache)
        return capture, [view.image_file.stat().st_mtime_ns for view in capture.views]

    first, times = load()
    assert all(view.image_file.parent == cache / "views" for view in first.views)
    second, again = load()
    assert times == again, "unchanged files are not recreated"
    np.testing.assert_array_equal(second.object_ids, first.object_ids)
    path = scene.folder / "images" / scene.names[1]
    Image.fromarray(np.full((72, 96, 3), 200, np.uint8)).save(path)
    third, changed = load()
    assert changed[0] == times[0] and changed[1] != times[1] and (third.image(1) == 200).all()
    third.views[0].image_file.write_bytes(b"")
    fourth, _ = load()
    np.testing.assert_array_equal(fourth.image(0), first.image(0))
    np.save((scene.folder / "masks" / scene.names[0]).with_suffix(".png.npy"), np.full((72, 96), 9))
    assert 9 in load()[0].object_ids
    assert {path.suffix for path in (cache / "views").iterdir()} <= {".png", ".json"}


@pytest.mark.parametrize("max_size", [0, 48])
def test_objects_before_a_background_at_rest_are_cut_out(write_capture, tmp_path, max_size):
    """What is no object has one color, also in photos that need no resampling; the photos themselves are kept."""
    scene = write_capture(views=4)
    photos = {path: path.read_bytes() for path in (scene.folder / "images").iterdir()}
    before = load_capture(scene.folder, tmp_path / "cache", max_size=max_size)
    assert load_capture(scene.folder, None, max_size=0).prepared
    (scene.folder / "sfm").mkdir()
    (scene.folder / "sfm" / "source.json").write_text(json.dumps({"photos": ["turntable"], "features": "objects"}))
    after = load_capture(scene.folder, tmp_path / "cache", max_size=max_size)
    assert not load_capture(scene.folder, None, max_size=0).prepared
    for view in range(4):
        is_object = after.mask(view) > 0
        assert 0.02 < is_object.mean() < 0.98
        inner, outer = is_object, ~is_object
        for axis in (0, 1):
            for step in (-1, 1):
                inner, outer = inner & np.roll(inner, step, axis), outer & np.roll(outer, step, axis)
        np.testing.assert_array_equal(after.image(view)[inner], before.image(view)[inner])
        np.testing.assert_array_equal(after.image(view)[outer], 128)
    assert photos == {path: path.read_bytes() for path in (scene.folder / "images").iterdir()}


def test_interrupted_load_leaves_no_partial_files_and_resumes(write_capture, tmp_path, monkeypatch):
    import backend.capture.prepare as module

    scene = write_capture(views=5, model="SIMPLE_RADIAL", params=[90, 48, 36, 0.1])
    made = []
    original = module.write_image

    def dying(path, image):
        if len(made) >= 2:
            raise KeyboardInterrupt
        made.append(path)
        original(path, image)

    monkeypatch.setattr(module, "write_image", dying)
    with pytest.raises(KeyboardInterrupt):
        load_capture(scene.folder, tmp_path / "cache")
    for path in (tmp_path / "cache").rglob("*.png"):
        Image.open(path).load()
    assert not list((tmp_path / "cache").rglob("*.part"))
    monkeypatch.setattr(module, "write_image", original)
    assert len(load_capture(scene.folder, tmp_path / "cache").views) == 5


def test_full_disk_is_reported(write_capture, tmp_path, monkeypatch):
    import backend.capture.prepare as module

    def full(path, image):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(module, "write_image", full)
    scene = write_capture(views=3, model="SIMPLE_RADIAL", params=[90, 48, 36, 0.1])
    with pytest.raises(InputError, match="No space left on device"):
        load_capture(scene.folder, tmp_path / "cache")


def test_images_are_reduced_to_max_size(write_capture, tmp_path):
    scene = write_capture(views=3, size=(96, 72))
    capture = load_capture(scene.folder, tmp_path / "cache", max_size=50)
    view = capture.views[1]
    assert (view.width, view.height) == (50, 38) == capture.image(1).shape[1::-1]
    np.testing.assert_allclose(view.K, np.diag([50 / 96, 38 / 72, 1]) @ [[96, 0, 48], [0, 96, 36], [0, 0, 1]])
    mask = capture.mask(1)
    assert mask is not None and mask.shape == (38, 50) and set(np.unique(mask)) <= {0, 1, 2, 5}
    keypoints = capture.keypoints(1)
    np.testing.assert_allclose(keypoints.xy, scene.pixels[1] * [50 / 96, 38 / 72], atol=1e-9)
    assert load_capture(scene.folder, tmp_path / "cache", max_size=0).views[1].width == 96
    other = load_capture(scene.folder, tmp_path / "cache", max_size=40)
    assert other.image(2).shape == (30, 40, 3) and capture.image(2).shape == (38, 50, 3), "both sizes stay usable"


def test_image_changed_after_loading_is_reported(write_capture, tmp_path):
    scene = write_capture(views=3)
    capture = load_capture(scene.folder, tmp_path / "cache")
    Image.new("RGB", (10, 10)).save(scene.folder / "images" / scene.names[0])
    with pytest.raises(InputError, match=r"view_000\.png was 96x72 pixels and is now 10x10"):
        capture.image(0)


# Masks


def expected_ids(scene, index: int, code) -> np.ndarray:
    return np.vectorize(lambda i: code.get(i, i))(scene.ids[index])


@pytest.mark.parametrize(
    "kind",
    ["8 bit", "16 bit", "palette", "1 bit", "2 bit", "4 bit", "gray rgb", "rgb", "rgba", "npy", "npy float", "npz",
     "npz named", "appended", "npy 3d", "bool", "tif"],
)  # fmt: skip
def test_mask_formats_are_read(write_capture, tmp_path, kind):
    scene = write_capture(views=4, names=[f"robot/{i}.png" for i in range(4)])
    code = {"16 bit": {1: 300, 2: 65_535}, "rgb": {1: 255, 2: 65_793, 5: 16_000_000}, "rgba": {1: 255, 2: 256},
            "npy": {1: 70_000, 2: 4_294_967_295}, "npz": {1: 70_000}, "1 bit": {2: 1, 5: 1}, "bool": {2: 1, 5: 1},
            "2 bit": {5: 3}, "4 bit": {5: 15}}.get(kind, {})  # fmt: skip
    for index, name in enumerate(scene.names):
        ids = expected_ids(scene, index, code)
        path = (scene.folder / "masks" / name).with_suffix(".png")
        path.unlink()
        if kind in ("8 bit", "16 bit"):
            Image.fromarray(ids.astype(np.uint8 if kind == "8 bit" else np.uint16)).save(path)
        elif kind in ("palette", "2 bit", "4 bit"):
            if kind == "palette":
                image = Image.fromarray(ids.astype(np.uint8), "P")
                image.putpalette([200, 10, 10, 0, 255, 0, 9, 9, 9, 1, 1, 1, 2, 2, 2, 70, 80, 90])
                image.save(path)
            else:
                path.write_bytes(low_bit_png(ids, 2 if kind == "2 bit" else 4))
        elif kind == "1 bit":
            Image.fromarray(ids > 0).save(path)
        elif kind == "gray rgb":
            Image.fromarray(np.repeat(ids[..., None], 3, 2).astype(np.uint8)).save(path)
        elif kind in ("rgb", "rgba"):
            planes = [ids & 255, ids >> 8 & 255, ids >> 16, np.full_like(ids, 128)][: len(kind)]
            Image.fromarray(np.stack(planes, -1).astype(np.uint8)).save(path)
        elif kind == "npy":
            np.save(path.with_suffix(".npy"), ids.astype(np.uint32))
        elif kind == "npy float":
            np.save(path.with_suffix(".npy"), ids.astype(np.float32))
        elif kind == "npy 3d":
            np.save(path.with_suffix(".npy"), ids[None].astype(np.int16))
        elif kind == "bool":
            np.save(path.with_suffix(".npy"), ids > 0)
        elif kind == "npz":
            np.savez(path.with_suffix(".npz"), ids)
        elif kind == "npz named":
            np.savez(path.with_suffix(".npz"), scores=np.ones(3), ids=ids)
        elif kind == "tif":
            Image.fromarray(ids.astype(np.uint16)).save(path.with_suffix(".tif"))
        else:
            Image.fromarray(ids.astype(np.uint8)).save(str(scene.folder / "masks" / name) + ".png")
    capture = load_capture(scene.folder, tmp_path / "cache")
    seen = set()
    for index in range(4):
        expected = expected_ids(scene, index, code)
        np.testing.assert_array_equal(capture.mask(index), expected)
        seen |= set(np.unique(expected).tolist()) - {0}
    assert capture.object_ids.tolist() == sorted(seen) and capture.has_masks


def low_bit_png(ids: np.ndarray, bits: int) -> bytes:
    """Encode a gray PNG with fewer than 8 bits, which Pillow does not support."""
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    per = 8 // bits
    groups = ids.reshape(ids.shape[0], -1, per) << (bits * np.arange(per)[::-1])
    rows = np.pad(groups.sum(-1), ((0, 0), (1, 0))).astype(np.uint8)
    head = struct.pack(">IIBBBBB", ids.shape[1], ids.shape[0], bits, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows.tobytes()))
        + chunk(b"IEND", b"")
    )


def test_mask_color_coding_is_detected_per_capture(write_capture, tmp_path):
    """A color-coded ID can be gray, and a view may show no other ID: 65,793 is (1, 1, 1)."""
    scene = write_capture(views=3)
    for index, name in enumerate(scene.names):
        ids = np.full((72, 96), 65_793)
        if index == 2:
            ids[:10] = 255
        Image.fromarray(np.stack([ids & 255, ids >> 8 & 255, ids >> 16], -1).astype(np.uint8)).save(
            scene.folder / "masks" / name
        )
    assert load_capture(scene.folder, tmp_path / "cache").object_ids.tolist() == [255, 65_793]


@pytest.mark.parametrize("size", [(48, 36), (192, 144), (95, 72)])
def test_masks_of_other_size_are_resized_nearest(write_capture, tmp_path, size):
    scene = write_capture(views=3)
    for index, name in enumerate(scene.names):
        ids = Image.fromarray(scene.ids[index].astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
        ids.save(scene.folder / "masks" / name)
    capture = load_capture(scene.folder, tmp_path / "cache")
    for index in range(3):
        mask = capture.mask(index)
        assert mask is not None and mask.shape == (72, 96) and (mask == scene.ids[index]).mean() > 0.95


def resize(scene, size, of=slice(None), masks=True):
    """Resize photos, and masks, of a capture, but not the cameras."""
    for folder, method in (("images", Image.Resampling.BOX), ("masks", Image.Resampling.NEAREST)):
        for name in scene.names[of] if masks or folder == "images" else ():
            path = scene.folder / folder / name
            Image.open(path).resize(size, method).save(path)


@pytest.mark.parametrize("has_masks_of_photos", [True, False])
@pytest.mark.parametrize(("size", "reduced"), [((96, 72), (48, 36)), ((97, 71), (49, 35)), ((48, 36), (97, 73))])
@pytest.mark.parametrize("name", ["PINHOLE", "SIMPLE_RADIAL"])
def test_cameras_are_scaled_to_resized_photos(write_capture, tmp_path, name, size, reduced, has_masks_of_photos):
    params = (size[0], size[0] / 2, size[1] / 2, 0.01) if name == "SIMPLE_RADIAL" else None
    scene = write_capture("resized", views=3, size=size, model=name, params=params)
    resize(scene, reduced, masks=has_masks_of_photos)
    (width, height), (sx, sy) = reduced, np.divide(reduced, size)
    params = (size[0] * sx, size[0] * sy, width / 2, height / 2)
    if name == "SIMPLE_RADIAL":
        params = (size[0] * (sx + sy) / 2, width / 2, height / 2, 0.01)
    own = write_capture("own", views=3, size=reduced, model=name, params=params)
    capture = load_capture(scene.folder, tmp_path / "cache")
    expected = load_capture(own.folder, tmp_path / "own cache")
    assert any("3 of 3 images" in line and f"{width}x{height}" in line for line in capture.warnings)
    for index in range(3):
        view, other = capture.views[index], expected.views[index]
        assert (view.width, view.height) == (other.width, other.height)
        np.testing.assert_allclose(view.K, other.K, rtol=1e-9)
        points = capture.keypoints(index)
        local = scene.xyz[points.point_index] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        pixels = local @ view.K.T
        np.testing.assert_allclose(points.xy, pixels[:, :2] / pixels[:, 2:], atol=0.5)
        assert (capture.mask(index) == expected.mask(index)).mean() > 0.9
        assert np.abs(capture.image(index).astype(int) - expected.image(index)).mean() < 12
        assert capture.photo_mask(index, capture.mask(index)).shape == (height, width)


def test_photos_of_one_camera_may_have_different_sizes(write_capture, tmp_path):
    scene = write_capture(views=3, model="SIMPLE_RADIAL", params=(96, 48, 36, 0.05))
    resize(scene, (48, 36), of=slice(1))
    capture = load_capture(scene.folder, tmp_path / "cache")
    shapes = [capture.photo_mask(index, capture.mask(index)).shape for index in range(3)]
    assert shapes == [(36, 48), (72, 96), (72, 96)]


@pytest.mark.parametrize("size", [(72, 96), (96, 54), (90, 72), (24, 32)])
def test_cropped_and_turned_photos_are_refused(write_capture, tmp_path, size):
    scene = write_capture(views=3)
    resize(scene, size, masks=False)
    assert_load_rejected(scene.folder, tmp_path, f"{size[0]}x{size[1]}", "96x72", "images that the cameras")


def test_few_missing_masks_are_allowed(write_capture, tmp_path):
    scene = write_capture(views=6)
    for name in scene.names[:3]:
        (scene.folder / "masks" / name).unlink()
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert capture.mask(0) is None and capture.mask(4) is not None and capture.counts["masks"] == 3
    assert any("3 of 6 images have no mask" in warning for warning in capture.warnings)
    (scene.folder / "masks" / scene.names[3]).unlink()
    assert_load_rejected(scene.folder, tmp_path, "masks/view_000.png", "missing", "4 of 6")


def test_masks_to_be_converted_are_not_called_missing(write_capture, tmp_path):
    scene = write_capture(views=3)
    for name in scene.names:
        mask = scene.folder / "masks" / name
        mask.rename(mask.with_suffix(".exr"))
    assert_load_rejected(scene.folder, tmp_path, "masks contains 3 .exr files", "use `masks` (Import Masks)")
    (scene.folder / "masks" / "annotations.xml").touch()
    assert_load_rejected(scene.folder, tmp_path, "1 .xml file and 3 .exr files", "Import Masks")


def test_capture_without_masks_loads(write_capture, tmp_path):
    capture = load_capture(write_capture(masks=False).folder, tmp_path / "cache")
    assert not capture.has_masks and capture.mask(0) is None and len(capture.object_ids) == 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [('{"0": "none", "7": "cup"}', {7: "cup"}), ('{"cup": 7, "box": 9}', {7: "cup", 9: "box"}),
     ('[{"id": 7, "name": "cup"}]', {7: "cup"}), ("# names\n7 cup\n9: big box\n", {7: "cup", 9: "big box"}),
     ("{}", {})],
)  # fmt: skip
def test_label_files_are_read(write_capture, tmp_path, text, expected):
    scene = write_capture(masks=False)
    (scene.folder / ("labels.json" if text[0] in "{[" else "labels.txt")).write_text(text)
    assert load_capture(scene.folder, tmp_path / "cache").names == expected


# Finding files


def test_image_names_match_across_unicode_forms_and_separators(write_capture, tmp_path):
    names = ["Cámara.png", "dir/b.png", "plain.PNG"]
    scene = write_capture(names=names, masks=False)
    scene.names = [unicodedata.normalize("NFD", names[0]), "dir\\b.png", "PLAIN.png"]
    write_model = write_capture.write_model

    write_model(scene, scene.folder / "sparse" / "0", ".bin")
    capture = load_capture(scene.folder, tmp_path / "cache")
    found = {view.image_file.relative_to(scene.folder / "images").as_posix() for view in capture.views}
    assert found == set(names)


def test_missing_and_unregistered_images_are_counted(write_capture, tmp_path):
    scene = write_capture(views=6)
    (scene.folder / "images" / scene.names[2]).unlink()
    for name in ("extra.jpg", "more/extra.png"):
        (scene.folder / "images" / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (5, 5)).save(scene.folder / "images" / name)
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert len(capture.views) == 5 == capture.counts["used"]
    assert capture.counts["missing"] == 1 and capture.counts["unregistered"] == 2 and capture.counts["registered"] == 6
    assert any("view_002.png" in warning for warning in capture.warnings)
    assert any("extra.jpg" in warning and "2 of 7" in warning for warning in capture.warnings)


@pytest.mark.parametrize("layout", ["sparse/0", "sparse", "."])
def test_model_is_found_in_supported_folders(write_capture, tmp_path, layout):
    scene = write_capture()
    target = scene.folder / layout
    for path in list((scene.folder / "sparse/0").iterdir()):
        path.rename(target / path.name)
    if layout != "sparse/0":
        (scene.folder / "sparse/0").rmdir()
    assert len(load_capture(scene.folder, tmp_path / "cache").views) == 6


def test_largest_model_is_used(write_capture, tmp_path):
    scene, other = write_capture(name="main", views=3), write_capture(name="other", views=6)
    (other.folder / "sparse/0").rename(scene.folder / "sparse/1")
    for name in other.names:
        (other.folder / "images" / name).replace(scene.folder / "images" / name)
        (other.folder / "masks" / name).replace(scene.folder / "masks" / name)
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert len(capture.views) == 6 and any("1 (6 images) is used, not 0 (3 images)" in w for w in capture.warnings)


# Invalid input


def corrupt(scene, what: str) -> tuple[str, ...]:
    """Break the capture and return the words that the error must contain."""
    model, images, masks = scene.folder / "sparse/0", scene.folder / "images", scene.folder / "masks"
    first = scene.names[0]
    if what.endswith("is missing"):
        name = what.split()[0]
        (model / name).unlink()
        return name, "missing"
    if what.endswith("is truncated"):
        path = model / what.split()[0]
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
        return path.name, "truncated"
    if what.endswith("is empty"):
        (model / what.split()[0]).write_bytes(b"")
        return what.split()[0], "truncated"
    data = bytearray((model / "images.bin").read_bytes())
    if what == "no pose":
        (model / "images.bin").write_bytes(struct.pack("<Q", 0))
        return "images.bin", "no image with a pose"
    if what in ("NaN pose", "zero rotation", "infinite position"):
        value, at, count = {
            "NaN pose": (np.nan, 12, 1),
            "zero rotation": (0.0, 12, 4),
            "infinite position": (np.inf, 44, 1),
        }[what]
        struct.pack_into(f"<{count}d", data, at, *[value] * count)
        (model / "images.bin").write_bytes(data)
        return "images.bin", first, "not a number"
    if what == "absent camera":
        struct.pack_into("<I", data, 8 + 4 + 56, 99)
        (model / "images.bin").write_bytes(data)
        return "images.bin", first, "camera 99"
    if what == "outside name":
        (model / "images.bin").write_bytes(bytes(data).replace(first.encode(), b"../" + first.encode()[3:]))
        return "images.bin", "lies outside"
    if what == "3 points":
        (model / "points3D.bin").write_bytes(
            struct.pack("<Q", 3) + b"".join(struct.pack("<Q3d3BdQ", i, i, 0, 0, 1, 2, 3, 0.1, 0) for i in range(3))
        )
        return "points3D.bin", "only 3 points"
    if what == "unknown model":
        (model / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 77, 96, 72, 1, 1, 1, 1))
        return "cameras.bin", "77"
    if what == "NaN camera":
        (model / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 96, 72, np.nan, 1, 1, 1))
        return "cameras.bin", "NaN"
    if what == "degenerate camera":
        (model / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 2, 96, 72, 90, 48, 36, 5000.0))
        return "cameras.bin", "degenerate"
    if what == "image size":
        Image.new("RGB", (72, 96)).save(images / first)
        return first, "72x96", "96x72"
    if what == "damaged image":
        (images / first).write_bytes((images / first).read_bytes()[:300])
        return first, "cannot be read as an image"
    if what == "not an image":
        (images / first).write_text("hello")
        return first, "cannot be read as an image"
    if what == "no images":
        for name in scene.names:
            (images / name).unlink()
        return "images", "none of the 6 images", first
    if what == "no images folder":
        images.rename(scene.folder / "pictures")
        return "images", "does not exist"
    path = masks / first
    if what == "mask size":
        Image.new("L", (50, 72)).save(path)
        return f"masks/{first}", "50x72", "96x72"
    if what == "JPEG mask":
        path.unlink()
        Image.new("L", (96, 72)).save(path.with_suffix(".jpg"))
        return "masks/view_000.jpg", "JPEG"
    if what == "JPEG mask in disguise":
        Image.new("L", (96, 72)).save(path, "JPEG")
        return f"masks/{first}", "JPEG"
    if what == "photo as mask":
        for name in scene.names:
            noise = np.random.default_rng(0).integers(0, 255, (72, 96, 3)).astype(np.uint8)
            Image.fromarray(noise).save(masks / name)
        return "masks/view_000.png", "not an ID map"
    if what == "damaged mask":
        path.write_bytes(path.read_bytes()[:60])
        return f"masks/{first}", "cannot be read"
    path.unlink()
    arrays = {
        "fractional mask": (np.full((72, 96), 0.5), "not an ID map"),
        "NaN mask": (np.full((72, 96), np.nan), "not an ID map"),
        "negative mask": (np.full((72, 96), -1), "not an ID map"),
        "too large mask": (np.full((72, 96), 2**32), "not an ID map"),
        "vector mask": (np.zeros(5), "not an ID map"),
        "text mask": (np.full((72, 96), "a"), "not an ID map"),
    }
    if what in arrays:
        np.save(path.with_suffix(".npy"), arrays[what][0])
        return "masks/view_000.npy", arrays[what][1]
    if what == "pickled mask":
        np.save(path.with_suffix(".npy"), np.array([{}], object), allow_pickle=True)
        return "masks/view_000.npy", "values are of type object"
    assert what == "empty npz", what
    np.savez(path.with_suffix(".npz"))
    return "masks/view_000.npz", "(none)"


@pytest.mark.parametrize(
    "what",
    ["cameras.bin is missing", "images.bin is missing", "points3D.bin is missing", "cameras.bin is truncated",
     "images.bin is truncated", "points3D.bin is truncated", "images.bin is empty", "no pose", "NaN pose",
     "zero rotation", "infinite position", "absent camera", "outside name", "3 points", "unknown model", "NaN camera",
     "degenerate camera", "image size", "damaged image", "not an image", "no images", "no images folder", "mask size",
     "JPEG mask", "JPEG mask in disguise", "photo as mask", "damaged mask", "fractional mask", "NaN mask",
     "negative mask", "too large mask", "vector mask", "text mask", "pickled mask", "empty npz"],
)  # fmt: skip
def test_invalid_input_is_reported_in_one_sentence(write_capture, tmp_path, what):
    scene = write_capture()
    assert_load_rejected(scene.folder, tmp_path, *corrupt(scene, what))


def test_missing_folder_model_or_cache_is_reported(write_capture, tmp_path):
    assert_load_rejected(tmp_path / "nowhere", tmp_path, "nowhere", "does not exist")
    (tmp_path / "file").write_text("")
    assert_load_rejected(tmp_path / "file", tmp_path, "is a file")
    (tmp_path / "empty").mkdir()
    assert_load_rejected(tmp_path / "empty", tmp_path, "no COLMAP model", "sparse/0")
    with pytest.raises(InputError, match="cannot be written"):
        load_capture(write_capture().folder, tmp_path / "file" / "cache")


@pytest.mark.parametrize("text", ["not json", "[1, 2]", '"x"', '{"a": "b"}', '{"-4": "b"}', '{"99999999999": "b"}'])
def test_invalid_label_files_are_rejected(write_capture, tmp_path, text):
    scene = write_capture()
    (scene.folder / "labels.json").write_text(text)
    assert_load_rejected(scene.folder, tmp_path, "labels.json")


@pytest.mark.parametrize("line", ["1 1 0 0 0 0 0", "1 a 0 0 0 0 0 0 1 x.png", "1 1 0 0 0 0 0 3 1 x.png\n1.0 2.0"])
def test_malformed_text_model_reports_line(write_capture, tmp_path, line):
    scene = write_capture(suffix=".txt")
    path = scene.folder / "sparse/0/images.txt"
    path.write_text("# comment\n" + line)
    assert_load_rejected(scene.folder, tmp_path, "images.txt", f"line {2 + line.count(chr(10))}")


def test_nonfinite_points_are_left_out(write_capture, tmp_path):
    scene = write_capture(suffix=".txt")
    path = scene.folder / "sparse/0/points3D.txt"
    lines = path.read_text().splitlines()
    lines[1] = "3 nan 0 0 1 2 3 0.5"
    path.write_text("\n".join(lines) + "\n")
    capture = load_capture(scene.folder, tmp_path / "cache")
    assert len(capture.points.xyz) == 179 and any("not finite" in warning for warning in capture.warnings)
    for index in range(6):
        keypoints, view = capture.keypoints(index), capture.views[index]
        projected = (
            capture.points.xyz[keypoints.point_index] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        ) @ view.K.T
        np.testing.assert_allclose(keypoints.xy, projected[:, :2] / projected[:, 2:], atol=1e-6)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_damaged_models_raise_only_input_errors(write_capture, suffix):
    scene = write_capture(
        suffix=suffix, views=3, points=4, model="OPENCV", params=[80, 82, 47, 37, 0.05, -0.02, 0.001, 0.002]
    )
    folder = scene.folder / "sparse/0"
    rng = np.random.default_rng(0)
    refusals = 0
    for name in ("cameras", "images", "points3D"):
        path = folder / f"{name}{suffix}"
        whole = path.read_bytes()
        for trial in range(60):
            data = bytearray(whole)
            if trial % 2:
                data = data[: rng.integers(len(data))]
            for _ in range(trial % 4):
                if len(data):
                    data[rng.integers(len(data))] = rng.integers(256)
            path.write_bytes(data)
            message = None
            try:
                model = read_model(folder)
                for camera_id in {image.camera_id for image in model.images}:
                    pinhole_for(model.cameras[camera_id], path, 1600)
            except InputError as error:
                message = str(error)
            if message is not None:
                refusals += 1
                assert message.endswith(".") and "\n" not in message
        path.write_bytes(whole)
    assert refusals > 50
    read_model(folder)


# Checking


def test_check_reports_contents_without_writing(write_capture):
    scene = write_capture(views=9, model="SIMPLE_RADIAL", params=[90, 48, 36, 0.1])
    before = sorted(scene.folder.rglob("*"))
    steps = []

    class Counting(Reporter):
        def progress(self, done, total, **fields):
            steps.append((done, total))

    found = check_capture(scene.folder, reporter=Counting())
    assert sorted(scene.folder.rglob("*")) == before and steps[-1] == (9, 9)
    assert found["problems"] == [] == found["warnings"]
    assert found["counts"]["used"] == 9 and found["points"] == 180 and found["mean_reprojection_error"] == 0.5
    assert found["cameras"] == [
        {"id": 1, "model": "SIMPLE_RADIAL", "width": 96, "height": 72, "images": 9, "undistort": True}
    ]
    assert [(entry["id"], entry["name"]) for entry in found["objects"]] == [(i, f"sphere {i}") for i in (1, 2, 5)]
    assert all(entry["views"] > 5 for entry in found["objects"])
    json.dumps(found, allow_nan=False)


def test_check_collects_all_problems(write_capture):
    scene = write_capture(views=6)
    (scene.folder / "images" / scene.names[0]).write_text("no image")
    Image.new("RGB", (10, 10)).save(scene.folder / "images" / scene.names[1])
    Image.new("L", (10, 10)).save(scene.folder / "masks" / scene.names[2])
    (scene.folder / "labels.json").write_text("{")
    problems = check_capture(scene.folder)["problems"]
    assert len(problems) == 4
    for name in ["labels.json", *scene.names[:3]]:
        assert any(name in problem for problem in problems)


# COLMAP's own files


NAMES = [
    "plain.jpg", "with space.jpg", "日本語/画像 001.png", "sub/dir/Ünïcödé.JPG", "dots.in.name.v2.jpeg", "emoji_🍌.png",
    unicodedata.normalize("NFD", "Cámara") + "_NFD.jpg", "back\\slash.jpg", "quote's.jpg", "#hash%20.jpg", "UPPER.PNG",
]  # fmt: skip


def with_images(model_folder: Path, folder: Path) -> Path:
    """Create a capture from a real COLMAP model, with a uniform image of the right size for each name."""
    model = read_model(model_folder)
    folder.mkdir()
    (folder / "sparse").symlink_to(model_folder)
    for image in model.images:
        camera = model.cameras[image.camera_id]
        path = folder / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (camera.width, camera.height), (90, 120, 30)).save(path)
    return folder


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_all_camera_models_load(tmp_path, suffix):
    folder = fixture(f"all_camera_models_{suffix}")
    capture = load_capture(with_images(folder, tmp_path / "capture"), tmp_path / "cache")
    assert [view.name for view in capture.views] == sorted(NAMES)
    assert {view.camera_id for view in capture.views} == set(range(10, 120, 10)) and len(capture.points.xyz) == 60
    for index, view in enumerate(capture.views):
        assert (capture.image(index) == [90, 120, 30]).mean() > 0.99, "all pixels have the image's color"
        keypoints = capture.keypoints(index)
        assert len(keypoints.xy) == (0 if view.name == "UPPER.PNG" else 50)
        if len(keypoints.xy):
            p = (capture.points.xyz[keypoints.point_index] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]) @ view.K.T
            # The fixture's observations are projections with noise of at most a pixel.
            assert np.median(np.linalg.norm(keypoints.xy - p[:, :2] / p[:, 2:], axis=1)) < 1


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_rigs_and_frames_load(tmp_path, suffix):
    folder = fixture(f"rigs_{suffix}")
    theirs = pycolmap.Reconstruction(str(folder))
    capture = load_capture(with_images(folder, tmp_path / "capture"), tmp_path / "cache", max_size=256)
    assert len(capture.views) == 24 and len(capture.points.xyz) == 200
    poses = {image.name: image.cam_from_world().matrix() for image in theirs.images.values()}
    for index, view in enumerate(capture.views):
        np.testing.assert_allclose(view.viewmat[:3], poses[view.name], atol=1e-9)
        keypoints = capture.keypoints(index)
        p = (capture.points.xyz[keypoints.point_index] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]) @ view.K.T
        np.testing.assert_allclose(keypoints.xy, p[:, :2] / p[:, 2:], atol=1e-3)


def test_extreme_distortion_is_cropped(tmp_path):
    folder = fixture("unicode_names_extreme_distortion")
    capture = load_capture(with_images(folder, tmp_path / "capture"), tmp_path / "cache", max_size=800)
    model = read_model(folder)
    camera = next(iter(model.cameras.values()))
    target = pinhole_for(camera, Path("cameras.bin"), 0)
    edge = np.array([[x, y] for x in (0, target.width) for y in (0, target.height)])
    rays = (edge - target.K[:2, 2]) / [target.K[0, 0], target.K[1, 1]]
    assert np.linalg.norm(rays, axis=1).max() < 0.51, "the distortion folds over at a radius of 0.51"
    assert (distort(to_pycolmap(camera), rays) > -1).all()
    for index, view in enumerate(capture.views):
        assert unicodedata.is_normalized("NFD", view.name) and " " in view.name and view.height == 800
        assert (capture.image(index) == [90, 120, 30]).all()
        assert len(capture.keypoints(index).xy) == 129


def test_three_images_load(tmp_path):
    capture = load_capture(with_images(fixture("three_images"), tmp_path / "capture"), tmp_path / "cache")
    assert len(capture.views) == 3 and len(capture.points.xyz) == 1334
    assert capture.test_indices == (0,) and capture.views[0].width == 699


def test_model_with_subfolders_is_read(tmp_path):
    folder = fixture("missing_cameras_subfolders_txt")
    assert_load_rejected(folder, tmp_path, "images", "does not exist")
    model = read_model(folder)
    assert len(model.images) == 9 and all(image.name[:5] in ("sub1/", "sub2/") for image in model.images)


def test_invalid_fixtures_are_rejected(tmp_path):
    assert_load_rejected(fixture("truncated"), tmp_path, "images.bin is truncated", "82 images")
    assert_load_rejected(fixture("cameras_only"), tmp_path, "images.bin and points3D.bin are missing")
    assert_load_rejected(fixture("degenerate_two_images"), tmp_path, "cameras.bin", "SIMPLE_RADIAL", "degenerate")


def test_tabletop_capture_loads(tmp_path):
    if not (DATA / "tabletop").is_dir():
        pytest.skip("the capture tabletop is absent")
    capture = load_capture(DATA / "tabletop", tmp_path / "cache", max_size=400)
    assert (
        len(capture.views) == 42 and capture.counts["masks"] == 42 and capture.object_ids.tolist() == list(range(1, 9))
    )
    errors = []
    for index, view in enumerate(capture.views):
        keypoints = capture.keypoints(index)
        p = (capture.points.xyz[keypoints.point_index] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]) @ view.K.T
        errors.append(np.linalg.norm(keypoints.xy - p[:, :2] / p[:, 2:], axis=1))
        assert capture.image(index).mean() > 20
    assert np.concatenate(errors).mean() * 640 / 400 < 1.0, "COLMAP's own mean reprojection error is 0.81 pixels"


def test_banana_capture_loads(tmp_path):
    if not (DATA / "banana").is_dir():
        pytest.skip("the capture banana is absent")
    capture = load_capture(DATA / "banana", tmp_path / "cache")
    assert len(capture.views) == 14 and not capture.has_masks and capture.views[0].image_file.parent.name == "images"


def test_single_mask_detects_color_coding(tmp_path):
    Image.fromarray(np.full((4, 4, 3), 7, np.uint8)).save(tmp_path / "gray.png")
    assert read_mask(tmp_path / "gray.png").tolist() == [[7] * 4] * 4
    assert read_mask(tmp_path / "gray.png", color=True)[0, 0] == 7 * 0x10101


def test_edited_capture_maps_left_out_ids_to_0(write_capture, tmp_path):
    scene = write_capture()
    capture = load_capture(scene.folder, tmp_path / "cache")
    edited = capture.edited({5: "cup"}, [2])
    assert capture.object_ids.tolist() == [1, 2, 5] and len(capture.left_out) == 0
    assert edited.object_ids.tolist() == [1, 5]
    assert edited.names == {1: "sphere 1", 5: "cup"}
    for index in range(len(capture)):
        ids = capture.mask(index)
        np.testing.assert_array_equal(edited.mask(index), np.where(ids == 2, 0, ids))
        assert edited.ids_in(index) == tuple(np.unique(edited.mask(index)).tolist())
        assert edited.image(index) is capture.image(index), "decoded once"


@pytest.mark.parametrize("form", ["{}.png", "{}.jpg.png", "{}_mask.png", "mask_{}.png", "{}_seg.npy"])
@pytest.mark.parametrize("folder", ["", "left/"])
def test_masks_have_one_of_the_usual_names(form, folder):
    accepted, lossy = mask_names(f"{folder}photo.1.jpg")
    assert folder + form.format("photo.1") in accepted
    assert folder + "photo.1_mask.jpg" in lossy and not set(accepted) & set(lossy)
    assert accepted[0] == f"{folder}photo.1.jpg.png", "the exact name comes first"


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_linked_folders_are_listed_unless_they_lead_back(tmp_path):
    images, elsewhere = tmp_path / "images", tmp_path / "disk" / "cam0"
    for folder in (images / "a", images / "b", elsewhere):
        folder.mkdir(parents=True)
        (folder / "1.png").touch()
    (images / "cam0").symlink_to(elsewhere)
    (images / "best").symlink_to(images / "a")
    for link, target in (("a/b", "b"), ("b/a", "a"), ("a/up", "."), ("b/top", "..")):
        (images / link).symlink_to(images / target)
    (elsewhere / "back").symlink_to(images)
    files = Files(images)
    assert {"a/1.png", "b/1.png", "best/1.png", "cam0/1.png", "a/b/1.png"} <= set(files.paths)
    assert max(path.count("/") for path in files.paths) <= 3 and files.find("cam0/1.png") == images / "cam0" / "1.png"
