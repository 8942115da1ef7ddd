"""Film frames: content of the files against the reference renderer; resuming, stopping and bad shots."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from backend.commands.objects.film import frame_path
from backend.editing.apply import recolored, transformed
from backend.export.ply import read_splats, write_splats
from backend.film import cryptomatte, exr
from backend.film.render import FAR
from backend.film.stage import _names as shown_names
from backend.model.splats import Splats, concatenate
from backend.raster import Camera, object_ranks, rasterize
from backend.raster.ranked_ids import add_ranked
from backend.raster.reference import rasterize_reference
from backend.shared.color.recolor import Recolor
from backend.shared.color.srgb import decode, encode
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, InputError
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import SceneObject, edit_objects, write_objects
from backend.shared.reconstruction.record import TrainingRecord, VotesRecord, update_record
from backend.shared.reconstruction.shot import Frame, Placed, Sample, Shot, chosen_frames, read_shot, write_shot

from .command_result import assert_rejected

HUGE = 3_000_000_001
IDS = (0, 1, 2, 7, HUGE)
NAMES = {1: "mug", 2: "can", 7: "mug", HUGE: "große Kiste"}
SHOWN_NAMES = ["Background", "mug (1)", "can", "mug (7)", "große Kiste"]
WIDTH, HEIGHT = 45, 33
K = np.array([[40.0, 0, 24.3], [0, 44.0, 15.1], [0, 0, 1]])


def some_splats(count=90, seed=0) -> Splats:
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.5, 4.0, count)
    quats = rng.normal(size=(count, 4))
    scales = np.exp(rng.normal(np.log(0.12), 0.5, (count, 3)))
    scales[:, 2] = scales.min(1) / 10
    return Splats(
        means=np.stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.35, 0.35, count) * z, z], 1).astype("f4"),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype("f4"),
        scales=scales.astype("f4"),
        opacities=rng.uniform(0.2, 0.95, count).astype("f4"),
        sh=rng.normal(0, 0.3, (count, 4, 3)).astype("f4"),
        object_ids=rng.choice(np.array(IDS), count),
    )


@pytest.fixture
def folder(tmp_path) -> Reconstruction:
    """A reconstruction folder with splats but no capture."""
    place = Reconstruction(tmp_path / "made").create()
    write_splats(place.splats, some_splats())
    write_objects(
        place.objects, [{"id": i, "name": name, "color": [1, 2, 3], "points": 4} for i, name in NAMES.items()]
    )
    return place


def view(x=0.0) -> np.ndarray:
    """Return the viewmat of a slightly rotated camera near the origin."""
    turn = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, -turn @ [x, 0.05, -0.2]
    return out


def moved(x=0.0, y=0.0, z=0.0) -> np.ndarray:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def sample(x=0.0, objects=None, clip=(0.05, 100.0), time=1.0) -> Sample:
    return Sample(time, view(x), K, clip, objects or {})


def shot_of(*frames, **settings) -> Shot:
    """Return a shot of frames 1, 2, ..., each given as a list of samples."""
    return Shot(WIDTH, HEIGHT, [Frame(i, (i - 0.25, i + 0.25), entry) for i, entry in enumerate(frames, 1)], **settings)


@pytest.fixture
def film(folder, tmp_path, run_command):
    """Function that renders a shot and returns the channels of each frame."""

    def draw(shot, *options):
        write_shot(tmp_path / "shot.json", shot)
        out = tmp_path / "film"
        result = run_command(
            "film", folder.folder, "--shot", tmp_path / "shot.json", "--out", out, "--device", "cpu", *options
        )
        assert result.code == EXIT_DONE, result
        return [channels(frame_path(out, frame.number)) for frame in shot.frames]

    return draw


def channels(path) -> dict[str, np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def reference(splats: Splats, at: Sample, primitive="3d") -> tuple[np.ndarray, ...]:
    """Render linear RGBA, depth and coverages (H, W, IDS) with the float64 reference."""
    slots = np.searchsorted(IDS, splats.object_ids)
    arrays = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    tensors = [torch.tensor(np.asarray(values, np.float64)) for values in arrays]
    camera = Camera(at.viewmat, at.K, WIDTH, HEIGHT, near=at.clip[0], blur=splats.blur)
    drawn = rasterize_reference(*tensors, torch.tensor(slots), camera, len(IDS), primitive)
    color, alpha = drawn.color.numpy(), drawn.alpha.numpy()
    straight = np.moveaxis(color / np.maximum(alpha, 1e-12), 0, -1)
    light = np.where(straight <= 0.04045, straight / 12.92, ((straight + 0.055) / 1.055) ** 2.4) * alpha[..., None]
    depth = np.where(drawn.median > 0, drawn.median.numpy(), drawn.depth.numpy() / np.maximum(alpha, 1e-12))
    return np.concatenate([light, alpha[..., None]], -1), np.where(alpha > 0, depth, FAR), drawn.probabilities.numpy()


def rgba_of(planes) -> np.ndarray:
    return np.stack([planes[name].astype(np.float32) for name in "RGBA"], -1)


def coverage_of(planes) -> np.ndarray:
    """Return coverages (H, W, IDS) from the Cryptomatte channels."""
    hashes = [np.uint32(cryptomatte.name_bits(name)).view(np.float32) for name in SHOWN_NAMES]
    found = np.zeros((*planes["A"].shape, len(IDS)))
    for layer in range(3):
        for of_id, of_coverage in ("RG", "BA"):
            names, coverage = (planes[f"CryptoObject{layer:02d}.{side}"] for side in (of_id, of_coverage))
            for place, value in enumerate(hashes):
                found[..., place] += np.where(names == value, coverage, 0)
    return found


def assert_same(planes, splats, at, primitive="3d") -> None:
    """Check that a frame of one sample equals the reference."""
    rgba, depth, coverage = reference(splats, at, primitive)
    np.testing.assert_allclose(rgba_of(planes), rgba, atol=2e-3, rtol=2e-3)
    np.testing.assert_allclose(coverage_of(planes), coverage, atol=1e-5)
    np.testing.assert_allclose(coverage_of(planes).sum(-1), planes["A"], atol=6e-4)
    # Where rounding decides the median, the two may choose neighboring splats.
    assert (np.abs(planes["Z"] - depth) <= 1e-4 * depth).mean() > 0.995
    winner = np.array(IDS, np.uint32)[coverage.argmax(-1)]
    clear = np.sort(coverage, -1)[..., -1] - np.sort(coverage, -1)[..., -2] > 1e-4
    assert np.array_equal(planes["IndexOB.X"][clear], winner[clear])


@pytest.mark.parametrize(("primitive", "blur"), [("3d", 0.05), ("3d", 0.3), ("2d", 0.05)])
def test_frame_matches_reference(folder, film, primitive, blur):
    write_splats(folder.splats, replace(some_splats(), blur=blur))
    votes = VotesRecord("majority", None, 1600, "0f", None)
    update_record(folder, training=TrainingRecord({"primitive": primitive}, votes))
    planes = film(shot_of([sample()]), "--png")[0]
    splats, _ = read_splats(folder.splats)
    assert splats.blur == blur
    assert_same(planes, splats, sample(), primitive)
    rgba = rgba_of(planes)
    photo = np.asarray(Image.open(frame_path(folder.folder.parent / "film", 1).with_suffix(".png")))
    straight = encode(rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6))
    solid = rgba[..., 3] > 0.1
    assert np.abs(photo[..., :3] - 255 * np.clip(straight, 0, 1))[solid].max() < 1.5
    assert np.abs(photo[..., 3] - 255 * rgba[..., 3]).max() < 0.7


def test_frame_is_drawn_in_parts_where_the_memory_is_full(folder, film, monkeypatch):
    heights = []

    def full(*, camera, **options):
        heights.append(camera.height)
        if camera.height > 20:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return rasterize(camera=camera, **options)

    monkeypatch.setattr("backend.film.render.rasterize", full)
    planes = film(shot_of([sample()]))[0]
    assert heights == [33, 16, 17]
    assert_same(planes, some_splats(), sample())


def test_edits_and_shot_transforms_are_applied(folder, film):
    """Edits in objects.json apply, except that the shot's maps, copies and visibility replace its transforms."""
    recolor = Recolor(hue=0.3, value=0.8)
    place = moved(0.3, -0.1, 0.2)
    edit_objects(folder.objects, {
        1: {"removed": True}, 2: {"recolor": recolor.stored(), "transform": moved(0.2).tolist()},
        7: {"transform": place.tolist(), "copies": [moved(-0.4).tolist()]},
    })  # fmt: skip
    turned = np.array([[0, -1.2, 0, 0.1], [1.2, 0, 0, 0.2], [0, 0, 1.2, 0.3], [0, 0, 0, 1.0]])
    objects = {2: Placed(maps=np.array([turned, moved(0.0, 0.3)])), HUGE: Placed(visible=False)}
    splats, _ = read_splats(folder.splats)
    part = {i: splats.select(splats.object_ids == i) for i in IDS}
    can = recolored(part[2], recolor)
    expected = concatenate([
        part[0], transformed(can, turned), transformed(can, moved(0.0, 0.3)), transformed(part[7], place),
        transformed(part[7], moved(-0.4)),
    ])  # fmt: skip
    named = shot_of([sample(objects=objects)], only_named=True)
    frames = film(shot_of([sample(objects=objects)], [sample()], [sample(0.1, {2: Placed(maps=np.zeros((0, 4, 4)))})]))
    names = ["Background", "can", "mug", "große Kiste"]
    assert list(manifest(folder.folder.parent / "film")) == names, "mug is unique once the other mug is removed"
    np.testing.assert_allclose(rgba_of(frames[0]), reference(expected, sample())[0], atol=2e-3, rtol=2e-3)
    static = concatenate([part[0], transformed(can, moved(0.2)), transformed(part[7], place),
                          transformed(part[7], moved(-0.4)), part[HUGE]])  # fmt: skip
    np.testing.assert_allclose(rgba_of(frames[1]), reference(static, sample())[0], atol=2e-3, rtol=2e-3)
    gone = static.select(static.object_ids != 2)
    np.testing.assert_allclose(rgba_of(frames[2]), reference(gone, sample(0.1))[0], atol=2e-3, rtol=2e-3)
    alone = expected.select(expected.object_ids == 2)
    np.testing.assert_allclose(rgba_of(film(named)[0]), reference(alone, sample())[0], atol=2e-3, rtol=2e-3)


def test_clip_range_and_depth_scale(folder, film):
    near, far = film(shot_of([sample(clip=(2.5, 50.0))], [sample(clip=(0.05, 2.5))], depth_scale=10.0))
    splats, _ = read_splats(folder.splats)
    depths = splats.means @ view()[2, :3] + view()[2, 3]
    for planes, kept in ((near, depths > 2.5), (far, depths <= 2.5)):
        rgba, depth, _ = reference(splats.select(kept), sample())
        np.testing.assert_allclose(rgba_of(planes), rgba, atol=2e-3, rtol=2e-3)
        seen = depth < FAR
        assert (np.abs(planes["Z"] - 10 * depth) <= 1e-3 * depth)[seen].mean() > 0.99
        assert (planes["Z"][~seen] == np.float32(FAR)).all() and (~seen).any()


def test_motion_blur_is_mean_of_samples(folder, film, monkeypatch):
    ranks = []

    def watched(drawn, count):
        ranks.append(count)
        return object_ranks(drawn, count)

    monkeypatch.setattr("backend.film.render.object_ranks", watched)
    moments = [sample(x, {2: Placed(maps=moved(3 * x)[None])}, time=1 + x) for x in (-0.1, -0.03, 0.05)]
    blurred, *single = film(shot_of(moments, *([moment] for moment in moments)))
    mean = np.mean([rgba_of(planes) for planes in single], 0)
    np.testing.assert_allclose(rgba_of(blurred), mean, atol=1e-3, rtol=1e-3)
    coverage = np.mean([coverage_of(planes) for planes in single], 0)
    np.testing.assert_allclose(coverage_of(blurred), coverage, atol=1e-6)
    assert np.array_equal(blurred["Z"], single[1]["Z"])
    ranked = np.stack([blurred[f"CryptoObject{i:02d}.{side}"] for i in range(3) for side in "GA"])
    assert (np.diff(ranked, axis=0) <= 0).all()
    assert set(ranks) == {cryptomatte.RANKS}, "more than the scene has objects take memory for nothing"


def test_ranked_ids_are_summed():
    rng = np.random.default_rng(0)
    totals = np.full((3, 4, 8), -1, np.int32), np.zeros((3, 4, 8), np.float32)
    dense = np.zeros((3, 4, 8))
    for _ in range(5):
        ids = np.argsort(rng.random((8, 3, 4)), 0).astype(np.int32)[:4]
        ids[3, 0] = -1
        weights = -np.sort(-rng.random((4, 3, 4)), 0).astype(np.float32)
        add_ranked(*totals, ids, weights)
        for rank in range(4):
            for y, x in np.ndindex(3, 4):
                dense[y, x, ids[rank, y, x]] += weights[rank, y, x] * (ids[rank, y, x] >= 0)
    ids, weights = totals
    np.testing.assert_allclose(weights, -np.sort(-dense, -1), rtol=1e-6)
    np.testing.assert_allclose(np.take_along_axis(dense, np.maximum(ids, 0), -1) * (ids >= 0), weights, rtol=1e-6)


def manifest(out) -> dict[str, str]:
    (entry,) = [value for key, value in header(out).items() if key.endswith("/manifest")]
    return json.loads(entry)


def header(out, number=1) -> dict:
    with OpenEXR.File(str(frame_path(out, number)), separate_channels=True) as file:
        return dict(file.header())


def test_cryptomatte_matches_specification(folder, film):
    """Hashes match the specification's examples and known test vectors; the header has the names and keys."""
    for name, expected in (
        ("bunny", 0x13851A76), ("default", 0x42C9679F), ("test", 0xBA6BD213), ("Hello, world!", 0xC0363E43),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723), ("", 0),
    ):  # fmt: skip
        assert cryptomatte.murmur3(name.encode()) == expected, name
    # No hash may have the bits of a float32 that is not normal; for some of these names, the plain hash would.
    for bits in (cryptomatte.name_bits(f"object {i}") for i in range(3000)):
        assert 1 <= bits >> 23 & 255 <= 254
    film(shot_of([sample()], pixel_aspect=1.5))
    found = header(folder.folder.parent / "film")
    key = "cryptomatte/" + f"{cryptomatte.murmur3(b'CryptoObject'):08x}"[:7]
    assert found[f"{key}/name"] == "CryptoObject" and found[f"{key}/hash"] == "MurmurHash3_32"
    assert found[f"{key}/conversion"] == "uint32_to_float32"
    wanted = {name: f"{cryptomatte.name_bits(name):08x}" for name in SHOWN_NAMES}
    assert json.loads(found[f"{key}/manifest"]) == wanted
    assert found["pixelAspectRatio"] == 1.5 and found["objectgs/frame"] == "1"


def test_each_object_has_a_matte_of_its_own():
    names = {1: "mug", 2: "mug", 3: "mug (1)", 4: "can"}
    entries = {i: SceneObject(i, name, (0, 0, 0), 0) for i, name in names.items()}
    found = shown_names([1, 2, 3, 4], entries)
    assert found[1:] == ["mug (2)", "mug (1)", "can"] and len(set(found)) == 4


def test_srgb_encoding_round_trip():
    values = np.linspace(0, 1.5, 200, dtype=np.float32)
    np.testing.assert_allclose(encode(decode(values)), values, atol=1e-6)
    np.testing.assert_allclose(decode(np.float32([0.0, 0.5, 1.0])), [0.0, 0.2140411, 1.0], atol=1e-6)


# --- resuming and stopping -------------------------------------------------------------------------------------------


@pytest.fixture
def shoot(folder, tmp_path, run_command):
    """Function that runs the command on a shot of three frames, or on another shot."""

    def run(*options, shot=None):
        write_shot(tmp_path / "shot.json", shot or shot_of([sample()], [sample(0.1)], [sample(0.2), sample(0.21)]))
        return run_command(
            "film", folder.folder, "--shot", tmp_path / "shot.json", "--out", tmp_path / "film", "--device", "cpu",
            "--json", *options,
        )  # fmt: skip

    return run


def drawn(result) -> int:
    assert result.code == EXIT_DONE, result
    return result.events[-1]["drawn"]


def test_finished_frames_are_skipped(folder, shoot, tmp_path):
    out = tmp_path / "film"
    assert drawn(shoot("--frames", "2-3")) == 2 and not frame_path(out, 1).exists()
    assert drawn(shoot()) == 1, "only the missing frame is rendered"
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert drawn(shoot()) == 0 and before == {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert sorted(before) == ["splats.0001.exr", "splats.0002.exr", "splats.0003.exr"]
    whole = frame_path(out, 2).read_bytes()
    for broken in (whole[:-1], whole[: len(whole) // 2], whole[:100], b"", b"text", whole + b"0"):
        frame_path(out, 2).write_bytes(broken)
        assert exr.digest_of(frame_path(out, 2)) is None
    assert drawn(shoot()) == 1 and frame_path(out, 2).read_bytes() == whole
    assert drawn(shoot(shot=shot_of([sample()], [sample(0.15)], [sample(0.2), sample(0.21)]))) == 1
    edit_objects(folder.objects, {1: {"color": [9, 9, 9]}})
    assert drawn(shoot("--frames", "1")) == 0, "the display color of an object does not affect frames"
    edit_objects(folder.objects, {1: {"removed": True}})
    assert drawn(shoot()) == 3
    assert drawn(shoot("--png")) == 3 and len(list(out.glob("*.png"))) == 3
    assert drawn(shoot("--png", "--frames", "1,3")) == 0
    write_splats(folder.splats, some_splats(seed=1))
    assert drawn(shoot("--frames", "1")) == 1 and len(list(out.glob("*.png"))) == 2, "the outdated PNG was removed"


def test_stopping_keeps_complete_frames(shoot, tmp_path, monkeypatch):
    stops = iter([False, False, True])
    monkeypatch.setattr("backend.shared.stopping.StopRequest.__call__", lambda self: next(stops))
    result = shoot()
    assert result.code == EXIT_CANCELLED and result.events[-1]["stopped"] is True
    begun, *shares = [event["done"] for event in result.events if event["type"] == "progress"][-4:]
    frames = [3 * (share - begun) / (0.99 - begun) for share in shares]
    assert frames == pytest.approx([1, 2, 2.5], abs=1e-3), "stopping is also possible between samples"
    assert sorted(path.name for path in (tmp_path / "film").iterdir()) == ["splats.0001.exr", "splats.0002.exr"]
    monkeypatch.undo()
    assert drawn(shoot()) == 1


# --- invalid input ---------------------------------------------------------------------------------------------------


def test_shot_round_trip(tmp_path):
    objects = {1: Placed(maps=np.array([moved(1), moved(2)])), 2: Placed(visible=False), HUGE: Placed()}
    moving = {**objects, 1: Placed(maps=moved(3)[None])}
    shot = shot_of([sample(objects=objects), sample(objects=moving)], [sample()], only_named=True, pixel_aspect=2.0)
    write_shot(tmp_path / "shot.json", shot)
    again = read_shot(tmp_path / "shot.json")
    assert (again.width, again.height, again.only_named, again.pixel_aspect) == (WIDTH, HEIGHT, True, 2.0)
    for a, b in zip(shot.frames, again.frames, strict=True):
        assert (a.number, a.shutter) == (b.number, b.shutter)
        for first, second in zip(a.samples, b.samples, strict=True):
            assert np.array_equal(first.viewmat, second.viewmat) and np.array_equal(first.K, second.K)
            stored = [{key: placed.stored() for key, placed in s.objects.items()} for s in (first, second)]
            assert stored[0] == stored[1] and first.clip == second.clip and first.time == second.time


def corrupt(path, keys, value):
    content = json.loads(path.read_text())
    at = content
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    path.write_text(json.dumps(content))


FIRST = ("frames", 0, "samples", 0)


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("frames",), [], "frames"), (("version",), 9, "version"), (("width",), 0, "width"),
        (("height",), 2.5, "height"),
        (("frames", 0, "samples"), [], "samples"), (("frames", 1, "frame"), 1, "ascending"),
        (("frames", 0, "frame"), -1, "frame"), ((*FIRST, "viewmat"), (2 * np.eye(4)).tolist(), "viewmat"),
        ((*FIRST, "viewmat"), "no", "viewmat"), ((*FIRST, "K"), np.eye(4).tolist(), "K"),
        ((*FIRST, "K"), [[1, 0.5, 1], [0, 1, 1], [0, 0, 1]], "skew"), ((*FIRST, "K"), [[0] * 3] * 3, "focal length"),
        ((*FIRST, "clip"), [2, 1], "clip"), ((*FIRST, "objects"), {"a": {}}, "ID"),
        ((*FIRST, "objects"), {"1": {"maps": [[1]]}}, "map of object 1"),
        ((*FIRST, "objects"), {"1": {"maps": 1}}, "list"),
        (("objects",), {"1": {"visible": 3}}, "visible"), (("depth_scale",), 0, "depth_scale"),
        (("only_named",), "yes", "only_named"),
    ],
)  # fmt: skip
def test_invalid_shots_are_rejected(tmp_path, keys, value, words):
    path = tmp_path / "shot.json"
    write_shot(path, shot_of([sample()], [sample()]))
    corrupt(path, keys, value)
    with pytest.raises(InputError) as caught:
        read_shot(path)
    assert str(path) in str(caught.value) and words in str(caught.value) and str(caught.value).endswith(".")


def test_invalid_film_requests_are_rejected(folder, tmp_path, run_command):
    path = tmp_path / "shot.json"
    command = ("film", folder.folder, "--shot", path, "--out", tmp_path / "film")
    assert_rejected(run_command(*command), str(path), "does not exist")
    write_shot(path, shot_of([sample()], [sample()]))
    for text in ("x", "3-1", "1;2", "", "-4"):
        assert_rejected(run_command(*command, f"--frames={text}"), "--frames")
    assert_rejected(run_command(*command, "--frames", "7-9"), "none of the frames", "1 to 2")
    assert_rejected(run_command("film", tmp_path, "--shot", path, "--out", tmp_path / "film"), "splats.ply")
    (tmp_path / "file").write_text("not a folder")
    assert_rejected(run_command(*command[:-1], tmp_path / "file"), "cannot be created")
    path.write_text("{")
    assert_rejected(run_command(*command), str(path), "JSON")


def test_frame_ranges_are_parsed():
    shot = shot_of(*([sample()] for _ in range(9)))
    for text, wanted in (("1-3", [1, 2, 3]), ("2, 5-6,9", [2, 5, 6, 9]), ("8-100", [8, 9]), (None, list(range(1, 10)))):
        assert [frame.number for frame in chosen_frames(text, shot)] == wanted
