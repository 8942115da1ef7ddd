"""Frames of videos: choice by motion and sharpness, turned, interlaced, HDR and damaged videos, and poses of a walk."""

import json
import os
import shutil
import sys
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image, ImageCms, ImageFilter

from backend.capture.files import read_mask
from backend.capture.made_masks import kept_masks, new_masks, write_mask
from backend.sfm.sources import masks, motion, photo_files, photos, video
from backend.shared.color import hdr
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, Cancelled, InputError
from backend.shared.events import Reporter
from backend.shared.stopping import StoppingReporter, StopRequest

from .rendered_photos import HEIGHT, WIDTH, photo, pose, texture

PAN = 4
"""Pixels by which the picture of `pan` moves from frame to frame."""


def reporter() -> StoppingReporter:
    return StoppingReporter(Reporter(), StopRequest())


class Told(Reporter):
    """Keeps warnings."""

    def __init__(self):
        self.warnings = []

    def warning(self, message):
        self.warnings.append(message)


def write_video(path, images, codec="libx264", form="yuv420p", rate=25, times=None, matrix=None, **tags):
    """Write images (h, w, 3) uint8 or uint16 as a video; times: in frames; matrix: of the colors, tagged or not."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options={"crf": "12", "threads": "1"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = form
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, "rgb48le" if image.dtype == np.uint16 else "rgb24")
            if matrix is not None:
                frame = frame.reformat(format=form, dst_colorspace=matrix)
                frame.colorspace = tags.get("colorspace", 2)
            frame.pts = number if times is None else times[number]
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def pan(count: int, step: int = PAN, size=(144, 192)) -> list[np.ndarray]:
    """Return pictures of a texture that moves to the left."""
    wide = texture(3).astype(np.uint8)
    wide = np.concatenate([wide, wide], 1)
    return [wide[: size[0], step * number : step * number + size[1]] for number in range(count)]


def blurred(image: np.ndarray, radius: float = 2.0) -> np.ndarray:
    return np.asarray(Image.fromarray(image).filter(ImageFilter.GaussianBlur(radius)))


@pytest.mark.parametrize("step", [0, 1, 4, 12])
def test_motion_is_that_of_the_picture(step):
    tracker = motion.MotionTracker()
    positions = [tracker.add(image.mean(2)) for image in pan(16, step)]
    assert positions[-1] == pytest.approx(15 * step / 192, rel=0.1, abs=1e-9)
    assert (np.diff(positions) >= -1e-9).all()


def test_motion_beyond_measure_counts_as_far():
    tracker = motion.MotionTracker()
    tracker.add(texture(3)[:144, :192].mean(2))
    assert tracker.add(texture(4)[:144, :192].mean(2)) == pytest.approx(24 / 192)


def test_an_object_that_turns_before_a_still_wall_is_motion():
    tracker = motion.MotionTracker()
    wall = texture(5)[:144, :192].mean(2)
    positions = []
    for image in pan(10):
        wall[:, 48:144] = image[:, 48:144].mean(2)
        positions.append(tracker.add(wall))
    assert positions[-1] > 0.6 * 9 * PAN / 192


def test_choice_is_even_in_motion_and_takes_sharp_frames():
    positions = np.concatenate([np.linspace(0, 0.2, 80), np.linspace(0.21, 1.0, 20)])
    sharp = np.ones(100)
    sharp[::3] = 2.0
    chosen = motion.choose_frames(positions, sharp, 10)
    assert len(chosen) == 10 and np.diff(positions[chosen]).max() < 0.2
    assert (sharp[chosen] == 2.0).mean() >= 0.7
    assert (chosen < 80).sum() <= 3, "of the 80 frames where it hardly moves"


def test_number_of_frames_follows_the_motion():
    sharp = np.ones(1000)
    counts = [len(motion.choose_frames(np.linspace(0, length, 1000), sharp)) for length in (0.5, 8.0, 100.0)]
    assert counts == [motion.FEWEST, 100, motion.MOST]
    assert len(motion.choose_frames(np.linspace(0, 8.0, 12), sharp[:12])) == 12
    assert len(motion.choose_frames(np.zeros(500), sharp[:500])) == motion.FEWEST, "a camera at rest"


def test_frames_are_the_sharp_ones(tmp_path):
    images = [blurred(image) if number % 5 else image for number, image in enumerate(pan(60))]
    write_video(tmp_path / "a.mp4", images)
    names = video.write_frames(tmp_path / "a.mp4", tmp_path / "frames", 11, reporter())
    numbers = [int(name[6:12]) for name in names]
    assert len(names) >= 10 and numbers == sorted(numbers)
    assert np.mean([number % 5 == 0 for number in numbers]) >= 0.8
    for name, number in zip(names, numbers):
        shown = np.asarray(Image.open(tmp_path / "frames" / name), float)
        assert np.abs(shown - images[number]).mean() < 6


def test_variable_rates_and_repeated_frames_do_not_matter(tmp_path):
    images = pan(40)
    held = images[:10] + [images[10]] * 60 + images[10:]
    write_video(tmp_path / "a.mp4", held, times=np.cumsum(np.arange(len(held)) % 7 + 1).tolist())
    found = video.analyze(tmp_path / "a.mp4", reporter())
    assert len(found.positions) == len(held)
    chosen = motion.choose_frames(found.positions, found.sharp, 10)
    assert ((chosen >= 10) & (chosen < 70)).sum() <= 2


def test_video_is_turned_as_it_says(tmp_path):
    path = tmp_path / "a.mp4"
    images = pan(3, size=(96, 192))
    write_video(path, images)
    content = bytearray(path.read_bytes())
    header = content.index(b"tkhd")
    matrix = header + 4 + 4 + 4 + 4 + 4 + 4 + 4 + 8 + 2 + 2 + 2 + 2
    one = 0x10000
    assert int.from_bytes(content[matrix : matrix + 4], "big") == one
    clockwise = (0, one, 0, -one, 0, 0, 0, 0, 0x40000000)
    content[matrix : matrix + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in clockwise)
    path.write_bytes(content)
    (name, *_) = video.write_frames(path, tmp_path / "frames", None, reporter())
    shown = np.asarray(Image.open(tmp_path / "frames" / name), float)
    assert shown.shape[:2] == (192, 96)
    assert np.abs(shown - np.rot90(images[0], -1)).mean() < 6


def test_half_pictures_become_whole(tmp_path):
    """Each frame shows two times, in its even and odd rows; the result has rows of one time only."""
    images = [blurred(image, 1.5) for image in pan(24, 3)]
    woven = []
    for first, second in zip(images[::2], images[1::2]):
        frame = first.copy()
        frame[1::2] = second[1::2]
        woven.append(frame)
    from av.codec.context import Flags

    flags = Flags.interlaced_dct | Flags.interlaced_me
    write_video(tmp_path / "a.mpg", woven, "mpeg2video", flags=flags, bit_rate=20_000_000)
    assert video.analyze(tmp_path / "a.mpg", reporter()).interlaced
    names = video.write_frames(tmp_path / "a.mpg", tmp_path / "frames", None, reporter())
    assert len(names) == len(woven)

    def combing(image):
        rows = image.astype(float)
        return np.abs(2 * rows[1:-1] - rows[:-2] - rows[2:]).mean()

    before = combing(woven[5])
    after = combing(np.asarray(Image.open(tmp_path / "frames" / names[5])))
    assert after < 0.5 * before


@pytest.mark.parametrize(("number", "signal", "white"), [(16, 0.5807, 1.0), (18, 0.75, 1.0)])
def test_hdr_video_has_its_white_near_that_of_photos(tmp_path, number, signal, white):
    curve = {16: hdr.pq_to_linear, 18: hdr.hlg_to_linear}[number]
    assert curve(np.array(signal)) == pytest.approx(white, rel=0.01)
    ramp = np.linspace(0, signal, 192)
    image = np.repeat(np.repeat((65535 * ramp).astype(np.uint16)[None], 144, 0)[..., None], 3, 2)
    write_video(
        tmp_path / "a.mp4", [image] * 3, "libx265", "yuv420p10le", color_trc=number, color_primaries=9, colorspace=9
    )
    (name, *_) = video.write_frames(tmp_path / "a.mp4", tmp_path / "frames", None, reporter())
    shown = np.asarray(Image.open(tmp_path / "frames" / name), float).mean((0, 2))
    expected = 255 * hdr.to_srgb(curve(ramp)[:, None].repeat(3, 1)).mean(1)
    assert np.abs(shown - expected).max() < 8
    assert shown[-1] > 235 and shown[0] < 4


def test_colors_of_high_definition_video_without_a_matrix(tmp_path):
    image = np.zeros((720, 1280, 3), np.uint8)
    image[:] = 200, 40, 60
    write_video(tmp_path / "a.mp4", [image] * 2, matrix=1)
    (name, *_) = video.write_frames(tmp_path / "a.mp4", tmp_path / "frames", None, reporter())
    shown = np.asarray(Image.open(tmp_path / "frames" / name)).reshape(-1, 3)
    assert np.abs(np.median(shown, 0) - (200, 40, 60)).max() <= 4


def test_damaged_video_gives_the_frames_that_are_whole(tmp_path):
    images = pan(80)
    write_video(tmp_path / "a.mkv", images)
    content = bytearray((tmp_path / "a.mkv").read_bytes())
    middle = len(content) // 2
    content[middle : middle + 2000] = np.random.default_rng(0).integers(0, 256, 2000, np.uint8).tobytes()
    (tmp_path / "b.mkv").write_bytes(content)
    names = video.write_frames(tmp_path / "b.mkv", tmp_path / "frames", 20, reporter())
    assert len(names) >= 8
    (tmp_path / "c.mkv").write_bytes(content[: len(content) // 2])
    assert len(video.write_frames(tmp_path / "c.mkv", tmp_path / "more", 20, reporter())) >= 8


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_what_is_no_video_is_refused(tmp_path, content):
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4 cannot be read as a video"):
        video.write_frames(tmp_path / "a.mp4", tmp_path / "frames", None, reporter())
    assert not (tmp_path / "frames").exists()


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A video of the room of `test_sfm`, along an arc; every fourth frame is sharp."""
    path = tmp_path_factory.mktemp("walk") / "my walk.mp4"
    angles = np.linspace(-1.0, 0.1, 48)
    images = []
    for number, angle in enumerate(angles):
        center = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), 1.2 + 0.1 * np.sin(5 * angle)])
        image = photo(pose(center, (0.1, 0.0, 0.3)))
        images.append(image if number % 4 == 2 else blurred(image, 1.5))
    write_video(path, images)
    return path


@pytest.mark.long
def test_poses_of_a_video(walk, tmp_path, run_command, no_dense_points):
    result = run_command("sfm", walk, "--out", tmp_path / "capture", "--frames", 12)
    assert result.code == EXIT_DONE
    report = json.loads((tmp_path / "capture" / "sfm" / "sfm.json").read_text())
    assert report["registered"] == report["photos"] >= 11 and report["cameras"] == 1
    names = sorted(path.name for path in (tmp_path / "capture" / "images").iterdir())
    assert np.mean([int(name[6:12]) % 4 == 2 for name in names]) > 0.7


@pytest.mark.long
def test_videos_beside_photos(walk, tmp_path, run_command, no_dense_points):
    """A folder with a video and photos: both are used, and each has a camera of its own."""
    folder = tmp_path / "both"
    folder.mkdir()
    (folder / walk.name).write_bytes(walk.read_bytes())
    for number, angle in enumerate((-0.9, -0.6, -0.3)):
        center = (2.1 * np.cos(angle), 2.1 * np.sin(angle), 1.0)
        Image.fromarray(photo(pose(np.array(center), (0.1, 0.0, 0.3)))).save(folder / f"{number}.png")
    (folder / "broken.mov").write_bytes(b"nothing")
    result = run_command("sfm", folder, "--out", tmp_path / "capture", "--frames", 12)
    assert result.code == EXIT_DONE
    report = json.loads((tmp_path / "capture" / "sfm" / "sfm.json").read_text())
    assert report["registered"] >= 12 and report["cameras"] == 2 and set(report["left_out"]) >= {"broken.mov"}
    assert (tmp_path / "capture" / "images" / "my walk").is_dir() and (
        tmp_path / "capture" / "images" / "0.png"
    ).exists()


@pytest.mark.long
def test_video_that_cannot_work_is_refused(tmp_path, run_command):
    write_video(tmp_path / "still.mp4", [texture(9)[:HEIGHT, :WIDTH].astype(np.uint8)] * 25)
    result = run_command("sfm", tmp_path / "still.mp4", "--out", tmp_path / "capture")
    assert result.code == EXIT_BAD_INPUT and "\n" not in result.err.strip()
    result = run_command("sfm", tmp_path / "gone.mp4", "--out", tmp_path / "other")
    assert result.code == EXIT_BAD_INPUT and "gone.mp4 does not exist" in result.err
    assert not (tmp_path / "other").exists()


def heic(path, orientation=1) -> np.ndarray:
    image = Image.fromarray(texture(2)[:120, :160].astype(np.uint8))
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Maker", orientation
    exif.get_ifd(0x8769)[0x920A] = 4.25
    image.save(path, quality=95, exif=exif)
    return np.asarray(image, float)


def test_heic_becomes_jpeg_with_its_data(tmp_path):
    pixels = heic(tmp_path / "a.heic")
    made = photo_files.copy_photo(tmp_path / "a.heic", tmp_path / "images" / "a.heic", True)
    assert made.name == "a.jpg"
    with Image.open(made) as image:
        assert np.abs(np.asarray(image, float) - pixels).mean() < 4
        assert image.getexif()[0x010F] == "Maker" and image.getexif().get_ifd(0x8769)[0x920A] == pytest.approx(4.25)
    assert "Maker" in photo_files.camera_of(tmp_path / "a.heic", True) and "4.25" in photo_files.camera_of(made, True)


def test_heic_of_phones_has_a_profile(tmp_path):
    """Its EXIF data have parts of their own, and its colors are those of a display."""
    pixels = heic(tmp_path / "a.heic")
    with Image.open(tmp_path / "a.heic") as image:
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
        image.save(tmp_path / "b.heic", quality=95, exif=image.info["exif"], icc_profile=profile)
        image.save(tmp_path / "c.heic", quality=95, exif=image.info["exif"], icc_profile=b"no profile")
    for name in ("b", "c"):
        made = photo_files.copy_photo(tmp_path / f"{name}.heic", tmp_path / f"{name}.heic.part", True)
        with Image.open(made) as image:
            assert np.abs(np.asarray(image, float) - pixels).mean() < 5 and image.format == "JPEG"
            assert image.getexif().get_ifd(0x8769)[0x920A] == pytest.approx(4.25)


def test_heic_with_more_data_than_a_jpeg_can_have(tmp_path):
    exif = Image.Exif()
    exif[0x010F], exif.get_ifd(0x8769)[0x920A] = "Maker", 4.25
    exif.get_ifd(0x8769)[0x927C] = b"\1" * 70_000
    Image.fromarray(texture(2)[:120, :160].astype(np.uint8)).save(tmp_path / "a.heic", exif=exif.tobytes())
    made = photo_files.copy_photo(tmp_path / "a.heic", tmp_path / "images" / "a.heic", True)
    assert "Maker" in photo_files.camera_of(made, True)
    assert photo_files.camera_of(made, True) == photo_files.camera_of(tmp_path / "a.heic", True)


def test_photos_of_another_format_than_their_name_says_are_converted(tmp_path):
    heic(tmp_path / "a.heic")
    (tmp_path / "a.heic").rename(tmp_path / "a.jpg")
    assert not photo_files.is_read_by_colmap(tmp_path / "a.jpg")
    made = photo_files.copy_photo(tmp_path / "a.jpg", tmp_path / "images" / "a.jpg", False)
    with Image.open(made) as image:
        assert made.name == "a.jpg" and image.format == "JPEG"
    Image.fromarray(texture(2)[:60, :80].astype(np.uint8)).save(tmp_path / "b.webp")
    (tmp_path / "b.webp").rename(tmp_path / "b.png")
    made = photo_files.copy_photo(tmp_path / "b.png", tmp_path / "images" / "b.png", False)
    with Image.open(made) as image:
        assert image.format == "PNG"
    (tmp_path / "d.heic").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"d\.heic cannot be read"):
        photo_files.copy_photo(tmp_path / "d.heic", tmp_path / "images" / "d.heic", False)


def test_number_of_photos_is_told(tmp_path):
    """Photos of subfolders are found, too, which the user may not expect."""
    for name in ("a.jpg", "day 2/b.jpg"):
        (tmp_path / "trip" / name).parent.mkdir(parents=True, exist_ok=True)
        heic(tmp_path / "trip" / name)
    told = []
    status = Reporter()
    status.status = lambda message, **_: told.append(message)
    photos.take_photos([tmp_path / "trip"], tmp_path / "capture", None, StoppingReporter(status, StopRequest()))
    assert told == [f"Reading 2 photos of {tmp_path / 'trip'}"]


def test_photos_that_changed_are_copied_again(tmp_path):
    """Their features are forgotten with those of all others."""
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    folder.mkdir()
    (capture / "sfm").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        heic(folder / name)
    photos.take_photos([folder], capture, None, reporter())
    (capture / "sfm" / "database.db").write_bytes(b"features")
    photos.take_photos([folder], capture, None, reporter())
    assert (capture / "sfm" / "database.db").exists()
    Image.fromarray(texture(5)[:120, :160].astype(np.uint8)).save(folder / "a.jpg")
    photos.take_photos([folder], capture, None, reporter())
    assert not (capture / "sfm" / "database.db").exists()
    for name in ("a.jpg", "b.jpg"):
        assert (capture / "images" / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize("error", [Cancelled, KeyboardInterrupt])
def test_photos_that_changed_after_a_stop_among_them_are_copied_again(tmp_path, error):
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        heic(folder / name)

    class Stops(Reporter):
        def progress(self, done, *_, **_fields):
            if done == 2:
                raise error

    with pytest.raises(error):
        photos.take_photos([folder], capture, None, StoppingReporter(Stops(), StopRequest()))
    kept = (capture / "images" / "b.jpg").stat().st_mtime_ns
    Image.fromarray(texture(5)[:120, :160].astype(np.uint8)).save(folder / "a.jpg")
    photos.take_photos([folder], capture, None, reporter())
    assert (capture / "images" / "a.jpg").read_bytes() == (folder / "a.jpg").read_bytes()
    is_kept = (capture / "images" / "b.jpg").stat().st_mtime_ns == kept
    assert is_kept == (error is Cancelled), "after a kill, it may be of any state"


def test_masks_that_changed_after_a_damaged_one_are_copied_again(tmp_path):
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    (folder / "masks").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        heic(folder / name)
    Image.new("L", (160, 120), 1).save(folder / "masks" / "a.png")
    (folder / "masks" / "b.jpg").write_bytes(b"damaged")
    with pytest.raises(InputError):
        photos.take_photos([folder], capture, None, reporter())
    Image.new("L", (160, 120), 2).save(folder / "masks" / "a.png")
    Image.new("L", (160, 120), 255).save(folder / "masks" / "b.jpg")
    photos.take_photos([folder], capture, None, reporter())
    assert read_mask(capture / "masks" / "a.png").max() == 2


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_masks_that_changed_after_a_kill_are_copied_again(tmp_path, monkeypatch, error, suffix):
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    (folder / "masks").mkdir(parents=True)

    def draw(color):
        for name in "ab":
            Image.new("RGB", (160, 120), (color,) * 3).save(folder / "masks" / f"{name}.{suffix}")

    def killed(self, *_):
        raise error

    for name in ("a.jpg", "b.jpg"):
        heic(folder / name)
    draw(0)
    with monkeypatch.context() as patched:
        patched.setattr(photos, "warn_of_gone", killed)
        with pytest.raises(error):
            photos.take_photos([folder], capture, None, reporter())
    draw(255)
    photos.take_photos([folder], capture, None, reporter())
    found = [read_mask(path).max() for path in (capture / "masks").iterdir()]
    assert len(found) == 2 and min(found) > 0
    (made,) = (path for path in (capture / "masks").iterdir() if path.name.startswith("a"))
    Image.new("L", (160, 120), 7).save(made)
    photos.take_photos([folder], capture, None, reporter())
    assert read_mask(made).max() == 7, "corrected in the capture"
    assert None not in json.loads((capture / "sfm" / "photos.json").read_text()).values()


def test_copies_are_used_when_the_photos_are_gone(tmp_path):
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    (folder / "day").mkdir(parents=True)
    for name in ("a.jpg", "day/b.jpg"):
        heic(folder / name)
    before = photos.take_photos([folder], capture, None, reporter())
    (capture / "sfm" / "database.db").write_bytes(b"features")
    shutil.rmtree(folder)
    assert photos.take_photos([folder], capture, None, reporter()) == before
    assert (capture / "sfm" / "database.db").exists()
    assert not photos.are_copied([folder], tmp_path / "other"), "there are no copies"


def test_masks_that_changed_are_copied_again_unless_others_were_made_of_them(tmp_path):
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    (folder / "masks").mkdir(parents=True)
    (folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        heic(folder / "images" / name)

    def copied(ids, labels):
        Image.fromarray(np.full((120, 160), ids, np.uint8)).save(folder / "masks" / "a.png")
        Image.fromarray(np.full((120, 160), 255 * (ids > 1), np.uint8)).save(folder / "masks" / "b.jpg")
        (folder / "labels.json").write_text(labels)
        photos.take_photos([folder], capture, None, reporter())
        there = read_mask(capture / "masks" / "a.png"), read_mask(capture / "masks" / "b.jpg.png")
        return *(int(mask.max()) for mask in there), (capture / "labels.json").read_text()

    assert copied(1, "{}") == (1, 0, "{}")
    assert copied(3, '{"3": "cup"}') == (3, 1, '{"3": "cup"}')
    (capture / "masks" / "masks.json").write_text('{"source": "", "objects": []}')
    assert copied(1, '{"1": "mug"}') == (3, 1, '{"3": "cup"}')


def test_given_masks_do_not_come_beside_those_that_were_made_of_them(tmp_path):
    """They are kept for a photo that had no pose, so that its features are those on objects, too."""
    folder, capture = tmp_path / "trip", tmp_path / "capture"
    for part in ("images", "masks"):
        (folder / part).mkdir(parents=True)

    def add(*names):
        for name in names:
            heic(folder / "images" / f"{name}.jpg")
            Image.fromarray(np.arange(160, dtype=np.uint8)[None].repeat(120, 0) // 80).save(
                folder / "masks" / f"{name}.png"
            )
        photos.take_photos([folder], capture, None, reporter())

    def listed(part):
        return sorted(path.name for path in (capture / part).iterdir())

    add("a", "b")
    with new_masks(capture, kept_masks(capture)) as made:
        write_mask(made, "a.jpg", np.full((120, 160), 7))
        (made / "masks.json").write_text('{"source": "", "objects": []}')
    add("c")
    assert listed("masks") == ["a.jpg.png", "masks.json"] and listed("masks-given") == ["a.png", "b.png", "c.png"]
    masks.write_object_masks(capture, ["a.jpg", "b.jpg", "c.jpg"], tmp_path / "shown", reporter())
    shown = [np.asarray(Image.open(tmp_path / "shown" / f"{name}.jpg.png")).mean() for name in "abc"]
    assert shown == [255, 127.5, 127.5]


@pytest.mark.parametrize(
    ("record", "content", "beside", "used"),
    [
        ("repair.json", {"changed": {}, "same_ids": True}, False, True),
        ("repair.json", {"changed": {}, "same_ids": False}, False, False),
        ("masks.json", {"source": "", "objects": []}, False, False),
        ("masks.json", {"source": "", "objects": []}, True, True),
    ],
)
def test_given_masks_of_later_photos_are_used_where_their_ids_are_the_same(record, content, beside, used, tmp_path):
    folder, capture, said = tmp_path / "trip", tmp_path / "capture", []
    for part in ("images", "masks"):
        (folder / part).mkdir(parents=True)
    listener = reporter()
    listener.status = lambda message, **_: said.append(message)

    def add(*names):
        for name in names:
            heic(folder / "images" / f"{name}.jpg")
            Image.new("L", (160, 120), 3).save(folder / "masks" / f"{name}.png")
        photos.take_photos([folder], capture, None, listener)

    if beside:
        (folder / "masks" / record).write_text(json.dumps(content))
    add("a", "b")
    if not beside:
        with new_masks(capture, kept_masks(capture)) as made:
            for name in ("a.jpg", "b.jpg"):
                write_mask(made, name, np.full((120, 160), 7))
            (made / record).write_text(json.dumps(content))
    add("c")
    made = sorted(path.name for path in (capture / "masks").iterdir())
    own = ["a.png", "b.png"] if beside else ["a.jpg.png", "b.jpg.png"]
    assert made == sorted([*own, record, *(["c.png"] if used else [])])
    assert used != any("such as c.jpg" in message for message in said)
    assert used != (capture / "masks-given" / "c.png").exists()


def test_features_on_objects_are_those_of_the_present_masks(tmp_path):
    """Also if masks were changed in the capture itself; other IDs of the same objects do not matter."""
    for part in ("images", "masks", "sfm"):
        (tmp_path / part).mkdir()
    databases = [tmp_path / "sfm" / name for name in ("database.db", "objects.db", "objects.db-wal")]
    names = ["a.jpg", "b.jpg"]
    for name in names:
        heic(tmp_path / "images" / name)

    def kept(ids, wanted=names):
        Image.fromarray(np.arange(160, dtype=np.uint8)[None].repeat(120, 0) // 80 * ids).save(
            tmp_path / "masks" / "a.png"
        )
        for path in databases:
            path.write_bytes(b"features")
        masks.write_object_masks(tmp_path, wanted, tmp_path / "sfm" / "masks", reporter())
        return [path.exists() for path in databases]

    assert kept(1) == [True, True, True] == kept(1) == kept(7)
    assert kept(0) == [True, False, False]
    assert kept(0, ["b.jpg", "a.jpg"]) == [True, True, True]


def test_masks_in_a_folder_beside_photos_are_no_photos(tmp_path):
    """Masks of converted photos get the new name, and those that were removed are named, unless others were made."""
    folder, capture = tmp_path / "toy", tmp_path / "capture"
    (folder / "masks").mkdir(parents=True)
    for name in ("1.heic", "2.jpg", "3.jpg"):
        heic(folder / name)
        Image.new("L", (160, 120), int(name[0])).save(folder / "masks" / f"{name}.png")
    (folder / "labels.json").write_text('{"1": "cup"}')
    taken = photos.take_photos([folder], capture, None, reporter())
    assert [photo.name for photo in taken.photos] == ["1.jpg", "2.jpg", "3.jpg"]
    assert [read_mask(capture / "masks" / f"{number}.jpg.png").max() for number in (1, 2, 3)] == [1, 2, 3]
    assert (capture / "labels.json").exists() and len(list((capture / "masks").iterdir())) == 3
    for number, made in ((2, False), (3, True)):
        (folder / "masks" / f"{number}.jpg.png").unlink()
        if made:
            (capture / "masks" / "masks.json").write_text('{"source": "", "objects": []}')
        photos.take_photos([capture], capture, None, reporter())
        told = Told()
        photos.take_photos([folder], capture, None, StoppingReporter(told, StopRequest()))
        assert (capture / "masks" / f"{number}.jpg.png").exists(), "the user may have changed it"
        assert any("is gone" in text and "2.jpg.png" in text for text in told.warnings) != made


def test_mask_that_replaces_one_of_another_name_is_used(tmp_path):
    folder, capture = tmp_path / "toy", tmp_path / "capture"
    (folder / "masks").mkdir(parents=True)
    for name in ("1.jpg", "2.jpg"):
        heic(folder / name)
    Image.new("L", (160, 120), 1).save(folder / "masks" / "1.jpg.png")
    photos.take_photos([folder], capture, None, reporter())
    (folder / "masks" / "1.jpg.png").unlink()
    Image.new("L", (160, 120), 2).save(folder / "masks" / "1.png")
    told = Told()
    photos.take_photos([folder], capture, None, StoppingReporter(told, StopRequest()))
    assert sorted(path.name for path in (capture / "masks").iterdir()) == ["1.jpg.png.old", "1.png"]
    assert not told.warnings


def test_results_in_the_folder_of_photos_are_no_photos(tmp_path):
    folder = tmp_path / "trip"
    for name in ("a.jpg", "day/b.jpg", "room/images/c.jpg", "room-splats/cache/d.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        heic(folder / name)
    (folder / "room" / "sfm").mkdir()
    (folder / "room" / "sfm" / "source.json").write_text("{}")
    (folder / "room-splats" / "objectgs.json").write_text("{}")
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.jpg", "day/b.jpg"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_text_are_named(tmp_path):
    folder = tmp_path / "trip"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        heic(folder / name)
    shutil.copy(folder / "a.jpg", folder / os.fsdecode(b"caf\xe9.jpg"))
    shutil.copy(folder / "a.jpg", folder / os.fsdecode(b"caf\xe9.mp4"))
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.jpg", "b.jpg"]
    assert "caf?.jpg is a name that is not text" in taken.unreadable["caf?.jpg"]


def test_data_of_the_second_page_of_a_tiff_do_not_matter(tmp_path):
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8769)[0x920A] = 4.25
    pages = [Image.new("RGB", (64, 48)) for _ in range(2)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:], exif=exif.tobytes())
    camera = photo_files.camera_of(tmp_path / "a.tif", True)
    assert "Maker" in camera and "4.25" in camera


def test_jpeg_named_as_heic_stays_a_jpeg(tmp_path):
    pixels = heic(tmp_path / "a.jpg", orientation=6)
    (tmp_path / "a.jpg").rename(tmp_path / "a.heic")
    assert photo_files.is_turned_by_right_angle(tmp_path / "a.heic")
    kept = photo_files.copy_photo(tmp_path / "a.heic", tmp_path / "kept.heic", False)
    assert kept.name == "kept.jpg" and kept.read_bytes() == (tmp_path / "a.heic").read_bytes()
    made = photo_files.copy_photo(tmp_path / "a.heic", tmp_path / "made.heic", True)
    with Image.open(made) as image:
        assert np.abs(np.asarray(image, float) - np.rot90(pixels, -1)).mean() < 4
    assert photo_files.camera_of(tmp_path / "a.heic", True) == photo_files.camera_of(made, True)


def test_videos_of_one_name_have_folders_of_their_own(tmp_path):
    folder = tmp_path / "trip"
    folder.mkdir()
    (tmp_path / "capture" / "sfm").mkdir(parents=True)
    write_video(folder / "a.mp4", pan(20))
    write_video(folder / "A.mov", pan(30, 8))
    (folder / ".thumbnails").mkdir()
    heic(folder / ".thumbnails" / "1.jpg")
    taken = photos.take_photos([folder], tmp_path / "capture", 5, reporter())
    assert {photo.name.split("/")[0] for photo in taken.photos} == {"a.mp4", "A.mov"} and len(taken.photos) == 10
    assert all((tmp_path / "capture" / "images" / photo.name).is_file() for photo in taken.photos)
    assert {photo.size for photo in taken.photos} == {"192x144"}, "they can share a camera"
    assert len({photo.camera for photo in taken.photos}) == 2, "but do not unless it is asked for"


def test_photos_are_turned_as_exif_says(tmp_path):
    pixels = heic(tmp_path / "a.jpg", orientation=6)
    kept = photo_files.copy_photo(tmp_path / "a.jpg", tmp_path / "kept.jpg", False)
    assert kept.read_bytes() == (tmp_path / "a.jpg").read_bytes()
    made = photo_files.copy_photo(tmp_path / "a.jpg", tmp_path / "made.jpg", True)
    with Image.open(made) as image:
        assert np.abs(np.asarray(image, float) - np.rot90(pixels, -1)).mean() < 5
        assert image.getexif().get(0x0112, 1) == 1 and image.getexif()[0x010F] == "Maker"
    assert photo_files.camera_of(tmp_path / "a.jpg", True) == photo_files.camera_of(made, True) != ""
    assert photo_files.camera_of(tmp_path / "a.jpg", False).startswith("160x120")


def test_avif_is_turned_and_other_formats_are_not(tmp_path):
    exif, pixels = Image.Exif(), texture(2)[:120, :160].astype(np.uint8)
    exif[0x0112] = 6
    for suffix, size in ((".avif", (120, 160)), (".png", (160, 120)), (".webp", (160, 120))):
        path = tmp_path / f"a{suffix}"
        Image.fromarray(pixels).save(path, exif=exif)
        for turn in (True, False):
            made = photo_files.copy_photo(path, tmp_path / "images" / path.name, turn, True)
            with Image.open(made) as image:
                assert image.size == size
                assert size == (160, 120) or image.getexif().get(0x0112, 1) == 1
            assert photo_files.camera_of(path, turn).startswith("{}x{}".format(*size))


def test_doubles_and_live_photos_are_taken_once(tmp_path):
    folder = tmp_path / "phone"
    folder.mkdir()
    for name in ("a.jpg", "a.heic", "b.heic", "c.jpg"):
        heic(folder / name)
    for name in ("a.cr2", "b.cr3"):
        (folder / name).write_bytes(b"II*\0")
    write_video(folder / "b.mov", pan(3))
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.jpg", "b.jpg", "c.jpg"] and not taken.unreadable
    assert sorted(path.name for path in (tmp_path / "capture" / "images").iterdir()) == ["a.jpg", "b.jpg", "c.jpg"]
    chosen = photos.take_photos(list(folder.iterdir()), tmp_path / "chosen", None, reporter())
    assert chosen.photos == taken.photos and not chosen.unreadable


def test_of_raw_photos_of_one_name_the_dng_is_taken(tmp_path, monkeypatch):
    folder = tmp_path / "raw"
    folder.mkdir()
    for name in ("a.cr2", "a.dng", "b.dng"):
        (folder / name).write_bytes(name.encode())
    monkeypatch.setattr(photo_files, "_developed", lambda path: Image.new("L", (8, 8), path.read_bytes()[2]))
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.png", "b.png"] and not taken.unreadable
    with Image.open(tmp_path / "capture" / "images" / "a.png") as image:
        assert image.getpixel((0, 0)) == ord("d")


def test_photos_that_get_the_name_of_another_are_named(tmp_path):
    folder = tmp_path / "trip"
    folder.mkdir()
    for name in ("a.webp", "a.ppm", "b.jpg"):
        Image.new("RGB", (160, 120)).save(folder / name)
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.png", "b.jpg"]
    assert "a.webp has the name of another photo" in taken.unreadable["a.webp"]


@pytest.mark.parametrize("upright", [True, False])
def test_photos_are_turned_if_their_masks_are_upright(tmp_path, upright):
    folder = tmp_path / "turntable"
    for part in ("images", "masks"):
        (folder / part).mkdir(parents=True)
    for name, orientation in (("a", 1), ("b", 6)):
        heic(folder / "images" / f"{name}.jpg", orientation=orientation)
        size = (160, 120) if name == "a" or not upright else (120, 160)
        Image.new("L", size, 1).save(folder / "masks" / f"{name}.png")
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.size for photo in taken.photos] == ["160x120", "120x160" if upright else "160x120"]
    for name in "ab":
        with Image.open(tmp_path / "capture" / "images" / f"{name}.jpg") as image:
            assert read_mask(tmp_path / "capture" / "masks" / f"{name}.png").shape == image.size[::-1]


def test_photos_with_known_lenses_are_turned_as_those(tmp_path):
    folder = tmp_path / "trip"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        heic(folder / name, orientation=6)
    for number, (lenses, turned) in enumerate([((), True), ({(160, 120)}, False), ({(120, 160)}, True)]):
        capture = tmp_path / str(number)
        taken = photos.take_photos([folder], capture, None, reporter(), lenses)
        assert taken.photos[0].size == ("120x160" if turned else "160x120")
        assert ((capture / "images" / "a.jpg").read_bytes() == (folder / "a.jpg").read_bytes()) != turned


@pytest.mark.parametrize(("masks", "lenses"), [(False, ()), (False, {(160, 120)}), (True, ())])
def test_names_that_colmap_cannot_read(tmp_path, monkeypatch, masks, lenses):
    """On Windows: copies get others, unless masks are found by them."""
    monkeypatch.setattr(photos, "_READS_ALL_NAMES", False)
    folder = tmp_path / "trip"
    for part in ("images", *(["masks"] if masks else [])):
        (folder / part).mkdir(parents=True)
    for name in ("Straße", "b", "c"):
        heic(folder / "images" / f"{name}.jpg", orientation=6)
        if masks:
            Image.new("L", (120, 160), 1).save(folder / "masks" / f"{name}.png")
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter(), lenses)
    assert len(taken.photos) == (2 if masks else 3) and all(photo.name.isascii() for photo in taken.photos)
    assert list(taken.unreadable) == (["Straße.jpg"] if masks else [])


def test_a_photo_beside_a_video_of_its_name_is_no_live_photo(tmp_path):
    heic(tmp_path / "room.jpg")
    write_video(tmp_path / "room.mp4", pan(12))
    (tmp_path / "capture" / "sfm").mkdir(parents=True)
    chosen = [tmp_path / "room.jpg", tmp_path / "room.mp4"]
    taken = photos.take_photos(chosen, tmp_path / "capture", 3, reporter())
    assert len(taken.photos) == 4
    assert taken.videos == [[photo.name for photo in taken.photos if photo.name != "room.jpg"]]


def test_panoramas_are_left_out(tmp_path):
    folder = tmp_path / "trip"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        heic(folder / name)
    sphere, exif = b'<rdf:Description GPano:ProjectionType="equirectangular"/>', Image.Exif()
    Image.new("RGB", (160, 80)).save(folder / "sphere.jpg", xmp=sphere)
    exif.get_ifd(0x8769)[0xA401] = 6
    Image.new("RGB", (300, 80)).save(folder / "sweep.jpg", exif=exif)
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.jpg", "b.jpg"]
    assert "a 360-degree panorama" in taken.unreadable["sphere.jpg"]
    assert "a stitched panorama" in taken.unreadable["sweep.jpg"]


def test_masks_of_any_case_and_thumbnails_are_no_photos(tmp_path):
    folder = tmp_path / "trip"
    (folder / "@eaDir" / "a.jpg").mkdir(parents=True)
    for name in ("a.jpg", "b.JPG", "@eaDir/a.jpg/SYNOPHOTO_THUMB_XL.jpg"):
        heic(folder / name)
    for name in ("a_Mask.PNG", "b_MASK.png"):
        Image.new("L", (160, 120), 1).save(folder / name)
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["a.jpg", "b.JPG"]
    assert len(list((tmp_path / "capture" / "masks").iterdir())) == 2


def test_masks_for_features_have_the_size_of_the_photos(tmp_path):
    for part in ("images", "masks"):
        (tmp_path / part).mkdir()
    for name in ("a", "b"):
        heic(tmp_path / "images" / f"{name}.jpg")
    ids = np.zeros((60, 80), np.uint8)
    ids[:, 40:] = 7
    Image.fromarray(ids).save(tmp_path / "masks" / "a.png")
    masks.write_object_masks(tmp_path, ["a.jpg", "b.jpg"], tmp_path / "features", reporter())
    half, whole = (np.asarray(Image.open(tmp_path / "features" / f"{name}.jpg.png")) for name in "ab")
    assert half.shape == whole.shape == (120, 160) and (whole == 255).all()
    assert (half[:, :80] == 0).all() and (half[:, 80:] == 255).all()
    Image.fromarray(ids.T).save(tmp_path / "masks" / "a.png")
    with pytest.raises(InputError, match=r"60x80 pixels, but the photo a\.jpg is 160x120"):
        masks.write_object_masks(tmp_path, ["a.jpg", "b.jpg"], tmp_path / "features", reporter())


def test_what_would_be_refused_at_the_end_is_refused_before_the_search_on_objects(tmp_path):
    for part in ("images", "masks"):
        (tmp_path / part).mkdir()
    names = ["a.jpg", "b.jpg", "c.jpg"]
    for name in names:
        heic(tmp_path / "images" / name)
    Image.new("L", (160, 120), 1).save(tmp_path / "masks" / "a.png")
    told = Told()
    masks.write_object_masks(tmp_path, names, tmp_path / "features", told)
    assert told.warnings[0].startswith("2 of 3 photos have no mask, for instance b.jpg")
    shutil.copy(tmp_path / "masks" / "a.png", tmp_path / "masks" / "b.png")
    masks.write_object_masks(tmp_path, names, tmp_path / "features", told)
    assert len(told.warnings) == 1
    (tmp_path / "test.txt").write_text("a.jpg\nb.heic\n")
    with pytest.raises(InputError, match=r"test\.txt names b\.heic, which is no photo"):
        masks.write_object_masks(tmp_path, names, tmp_path / "features", told)
    (tmp_path / "test.txt").unlink()
    (tmp_path / "labels.json").write_text("one name a line")
    with pytest.raises(InputError, match=r"labels\.json is not a list of labels"):
        masks.write_object_masks(tmp_path, names, tmp_path / "features", told)


def test_pixels_of_videos_are_made_square(tmp_path):
    write_video(tmp_path / "a.mp4", pan(12), sample_aspect_ratio=Fraction(4, 3))
    names = video.write_frames(tmp_path / "a.mp4", tmp_path / "frames", 3, reporter())
    with Image.open(tmp_path / "frames" / names[0]) as image:
        assert image.size == (256, 144)


def test_chosen_files_are_those_chosen(tmp_path):
    (tmp_path / "trip" / "images").mkdir(parents=True)
    for name in ("1.jpg", "2.jpg", "3.jpg", "images/4.jpg"):
        heic(tmp_path / "trip" / name)
    chosen = [tmp_path / "trip" / name for name in ("3.jpg", "1.jpg")]
    taken = photos.take_photos(chosen, tmp_path / "capture", None, reporter())
    assert [photo.name for photo in taken.photos] == ["1.jpg", "3.jpg"]


def test_other_number_of_frames_replaces_them(tmp_path):
    write_video(tmp_path / "a.mp4", pan(40))
    (tmp_path / "capture" / "sfm").mkdir(parents=True)
    for count in (12, 12, 5):
        taken = photos.take_photos([tmp_path / "a.mp4"], tmp_path / "capture", count, reporter())
        assert len(taken.photos) == count and taken.videos == [[photo.name for photo in taken.photos]]
        kept = sorted(path.name for path in (tmp_path / "capture" / "images").iterdir())
        assert kept == [photo.name for photo in taken.photos]


def test_frames_of_another_video_have_no_features_of_the_former_one(tmp_path, monkeypatch):
    removed = []
    monkeypatch.setattr(photos.database, "remove_all", removed.append)
    film, work = tmp_path / "a.mp4", tmp_path / "capture" / "sfm"
    work.mkdir(parents=True)
    write_video(film, pan(40))
    for count in (12, 12, 5):
        photos.take_photos([film], tmp_path / "capture", count, reporter())
    assert not removed
    write_video(film, pan(20))
    monkeypatch.setattr(video, "write_frames", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        photos.take_photos([film], tmp_path / "capture", 5, reporter())
    assert removed == [work] and json.loads((work / photos.FRAMES).read_text()) == {}, "it was ended in between"


def test_a_digital_zoom_is_another_camera(tmp_path):
    found = []
    for number, length in enumerate((28, 56, 28)):
        image, exif = Image.fromarray(texture(2)[:120, :160].astype(np.uint8)), Image.Exif()
        details = exif.get_ifd(0x8769)
        details[0x920A], details[0xA405] = 4.25, length
        image.save(tmp_path / f"{number}.jpg", exif=exif)
        found.append(photo_files.camera_of(tmp_path / f"{number}.jpg", True))
    assert found[0] == found[2] != found[1]


def test_raw_photos_of_another_size_or_lens_have_another_camera(tmp_path, monkeypatch):
    folder = tmp_path / "raw"
    folder.mkdir()
    sizes = {"a.nef": (60, 40), "b.nef": (60, 40), "c.nef": (40, 60), "d.nef": (60, 40), "e.cr3": (60, 40)}
    for name in sizes:
        image, exif = Image.new("RGB", (16, 12)), Image.Exif()
        exif[0x010F], exif.get_ifd(0x8769)[0x920A] = "Maker", 35.0 if name == "d.nef" else 50.0
        image.save(folder / name, "JPEG", exif=exif)
    (folder / "e.cr3").write_bytes(b"unknown to Pillow")
    monkeypatch.setattr(photo_files, "_developed", lambda path: Image.new("RGB", sizes[path.name]))
    taken = photos.take_photos([folder], tmp_path / "capture", None, reporter())
    cameras = {photo.name[0]: photo.camera for photo in taken.photos}
    assert not taken.unreadable and [photo.size for photo in taken.photos[1:3]] == ["60x40", "40x60"]
    assert cameras["a"] == cameras["b"] and len(set(cameras.values())) == 4
    # The copies alone still tell the lenses apart.
    shutil.rmtree(folder)
    again = photos.take_photos([tmp_path / "capture" / "images"], tmp_path / "capture", None, reporter())
    assert len({photo.camera for photo in again.photos}) == 4


def test_raw_photos_need_their_package(tmp_path, monkeypatch):
    (tmp_path / "a.cr2").write_bytes(b"II*\0")
    monkeypatch.setitem(__import__("sys").modules, "rawpy", None)
    with pytest.raises(InputError, match="needs the package rawpy"):
        photo_files.copy_photo(tmp_path / "a.cr2", tmp_path / "b.cr2", True)
