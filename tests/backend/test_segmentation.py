"""Segmentation models: with stand-ins for their networks, and with small ones that are made with transformers."""

import json
import os
import shutil
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image, ImageOps, PngImagePlugin

from backend.capture.files import read_mask
from backend.networks import checkpoint_folder
from backend.networks.checkpoint_folder import PACKAGE, import_transformers
from backend.raster.devices import CPU
from backend.segmentation import Finder, KeptEncodings, PhotoSegments, Segmenter, fingerprint, is_checkpoint
from backend.segmentation.selection import distinct, grid_points, is_segment
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, InputError, MissingPackage

from .command_result import assert_rejected
from .small_segmenters import KINDS, SIDE, write_small_model


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """Checkpoints of small models: kind -> folder."""
    pytest.importorskip("transformers")
    place = tmp_path_factory.mktemp("checkpoints")
    for kind in KINDS:
        write_small_model(place / kind, kind)
    return {kind: place / kind for kind in KINDS}


def picture(width, height):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("kind", KINDS)
def test_masks_are_those_of_transformers(checkpoints, kind):
    """A photo of the input's size needs no scaling, so the network can be asked directly."""
    transformers = pytest.importorskip("transformers")
    segmenter, image = Segmenter(checkpoints[kind]), picture(SIDE, SIDE)
    network = {"sam": "SamModel", "edgetam": "EdgeTamModel", "sam2_video": "Sam2VideoModel"}.get(kind, "Sam2Model")
    reference = getattr(transformers, network).from_pretrained(checkpoints[kind]).eval()
    colors = (image / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    pixels = torch.tensor(colors, dtype=torch.float32).permute(2, 0, 1)[None]
    encoded = segmenter.encode(image)
    with torch.inference_mode():
        features = reference.get_image_embeddings(pixels)
    for ours, theirs in zip(encoded.features, features):
        assert torch.allclose(ours, theirs, atol=1e-4)
    if kind == "sam2_video":
        return  # It has no prompts for single photos.
    points = np.array([[10.5, 20.5], [40.5, 30.5]])
    for given, several in ((points[:1], True), (points, False)):
        mask, score = segmenter.segment(encoded, given, np.array([1, 0])[: len(given)])
        with torch.inference_mode():
            expected = reference(
                pixel_values=pixels, input_points=torch.tensor(given - 0.5, dtype=torch.float32)[None, None],
                input_labels=torch.tensor([[[1, 0][: len(given)]]]), multimask_output=several,
            )  # fmt: skip
        best = expected.iou_scores[0, 0].argmax()
        assert score == pytest.approx(float(expected.iou_scores[0, 0, best]), abs=1e-4)
        scaled = torch.nn.functional.interpolate(
            expected.pred_masks[0, :, best : best + 1], (SIDE, SIDE), mode="bilinear"
        )
        assert (mask == (scaled[0, 0] > 0).numpy()).mean() > 0.99
    boxed, _ = segmenter.segment(encoded, np.zeros((0, 2)), np.zeros(0), np.array([8.0, 8, 40, 40]))
    assert boxed.shape == (SIDE, SIDE)


def test_weights_of_videos_are_those_of_photos(checkpoints):
    """A checkpoint for videos contains the model of single photos, of which all weights are used."""
    transformers = pytest.importorskip("transformers")
    video = transformers.Sam2VideoModel.from_pretrained(checkpoints["sam2_video"]).state_dict()
    own = Segmenter(checkpoints["sam2_video"])._network.state_dict()
    assert own.keys() <= video.keys() and all(torch.equal(own[name], video[name]) for name in own)


class Discs:
    """Stands in for a network: the mask of a prompt is a disc around its first point, or fills its box."""

    def __init__(self, radius):
        self.radius = radius

    def get_image_embeddings(self, pixels):
        return pixels

    def __call__(self, image_embeddings, multimask_output, input_points=None, input_labels=None, input_boxes=None):
        side = image_embeddings.shape[-1]
        along = torch.arange(side // 4) * 4 + 2.0
        y, x = torch.meshgrid(along, along, indexing="ij")
        if input_points is None:
            left, top, right, bottom = (input_boxes[0, :, k, None, None] + 0.5 for k in range(4))
            logits = torch.minimum(torch.minimum(x - left, right - x), torch.minimum(y - top, bottom - y))
        else:
            centers = input_points[0, :, 0] + 0.5
            logits = self.radius - torch.hypot(x - centers[:, 0, None, None], y - centers[:, 1, None, None])
        count = 3 if multimask_output else 1
        scores = torch.tensor([0.5, 0.9, 0.7][:count]).expand(len(logits), count)
        return SimpleNamespace(pred_masks=logits[None, :, None].repeat(1, 1, count, 1, 1), iou_scores=scores[None])


@pytest.mark.parametrize("kind", ["sam", "sam2"])
@pytest.mark.parametrize("size", [(160, 90), (90, 160), (64, 64), (48, 20)])
def test_prompts_and_masks_are_in_pixels_of_the_photo(checkpoints, kind, size, monkeypatch):
    segmenter = Segmenter(checkpoints[kind])
    monkeypatch.setattr(segmenter, "_network", Discs(9.0))
    encoded = segmenter.encode(picture(*size))
    scale = np.divide(encoded.content, size)
    for place in (0.3, 0.6):
        point = np.multiply(size, [place, 1 - place])
        mask, score = segmenter.segment(encoded, point[None], np.ones(1))
        assert mask.shape == size[::-1] and score == pytest.approx(0.9)
        rows, columns = np.nonzero(mask)
        assert columns.mean() + 0.5 == pytest.approx(point[0], abs=0.5 / scale[0])
        assert rows.mean() + 0.5 == pytest.approx(point[1], abs=0.5 / scale[1])
        assert np.ptp(columns) + 1 == pytest.approx(18 / scale[0], abs=3 / scale[0])
    box = np.array([0.25, 0.25, 0.75, 0.75]) * [*size, *size]
    mask, _ = segmenter.segment(encoded, np.zeros((0, 2)), np.zeros(0), box)
    rows, columns = np.nonzero(mask)
    assert (columns.min(), rows.min()) == pytest.approx(box[:2], abs=1.5 / scale.min())
    assert (columns.max() + 1, rows.max() + 1) == pytest.approx(box[2:], abs=1.5 / scale.min())


class SameColor(Discs):
    """Stands in for a network: the mask of a prompt is all that has the color of its point, of three qualities."""

    def __call__(self, image_embeddings, multimask_output, input_points, input_labels):
        at = (input_points[0, :, 0] + 0.5).long()
        assert len(at) <= 4, "each takes much memory"
        colors = image_embeddings[0, :, at[:, 1], at[:, 0]].T
        shown = image_embeddings[:, :, 2::4, 2::4]
        same = (shown - colors[:, :, None, None]).abs().sum(1) < 0.1
        logits = torch.where(same, 9.0, -9.0)
        noise = torch.where(torch.rand(logits.shape) < 0.5, 0.5, -0.5)
        masks = torch.stack([logits, logits, noise], 1)
        return SimpleNamespace(pred_masks=masks[None], iou_scores=torch.tensor([0.9, 0.5, 0.99]).expand(1, len(at), 3))


@pytest.mark.parametrize("kind", ["sam", "sam2"])
def test_everything_is_segmented_once(checkpoints, kind, monkeypatch):
    segmenter = Segmenter(checkpoints[kind])
    monkeypatch.setattr(segmenter, "_network", SameColor(0))
    ids = np.zeros((32, 64), np.uint8)
    ids[4:28, 4:20], ids[8:16, 32:56], ids[20:28, 32:40] = 1, 2, 3
    image = np.array([[10, 10, 10], [250, 0, 0], [0, 250, 0], [0, 0, 250]], np.uint8)[ids]
    steps = []
    masks = segmenter.everything(image, lambda done, total: steps.append(done / total))
    assert [np.bincount(ids[mask]).argmax() for mask in masks] == [0, 1, 2, 3], "large to small"
    assert all((mask == (ids == number)).mean() > 0.97 for number, mask in enumerate(masks))
    assert steps == sorted(steps) and steps[-1] == 1 and len(steps) == 65


def test_segments_are_good_stable_and_neither_tiny_nor_the_photo():
    square = torch.full((6, 50, 50), -5.0)
    square[:, 10:30, 10:30] = 5.0
    square[1] = torch.where(square[1] > 0, 0.5, -0.5)
    square[2] = -5.0
    square[2, 0, 0] = 5.0
    square[3] = 5.0
    square[4] = -5.0
    found = is_segment(square, torch.tensor([0.9, 0.9, 0.9, 0.9, 0.9, 0.7]))
    assert found.tolist() == [True, False, False, False, False, False]


def test_duplicates_leave_the_better_mask():
    masks = np.zeros((4, 10, 10), bool)
    masks[0, :5], masks[1, :5, :9], masks[2, 7:], masks[3, :2] = True, True, True, True
    assert distinct(masks, np.array([0.8, 0.9, 0.7, 0.95])) == [1, 2, 3]
    assert distinct(np.zeros((0, 10, 10), bool), np.zeros(0)) == []


def test_grid_covers_the_photo():
    points = grid_points((320, 160))
    assert points.shape == (256, 2) and points[0].tolist() == [10, 5] and points[-1].tolist() == [310, 155]


def test_pictures_are_encoded_once(checkpoints, monkeypatch):
    segmenter = Segmenter(checkpoints["sam2"])
    monkeypatch.setattr(segmenter, "_network", Discs(9.0))
    kept, asked = KeptEncodings(segmenter), []

    def ask(key):
        def given():
            asked.append(key)
            return picture(96, 72)

        return kept(key, given, np.array([[30.0, 20.0]]), np.ones(1))

    assert ask("a")[20, 30] and ask("a").shape == (72, 96) and asked == ["a"]
    for number in range(16):
        ask(number)
    ask(15)
    ask("a")
    assert asked == ["a", *range(16), "a"]


# --- checkpoints -----------------------------------------------------------------------------------------------------


def write_checkpoint(folder, **config):
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"model_type": "sam2", **config}))
    (folder / "model.safetensors").write_bytes(b"")
    return folder


def refused(folder, words):
    with pytest.raises(InputError, match=words) as error:
        Segmenter(folder)
    assert str(folder) in str(error.value) and "\n" not in str(error.value) and str(error.value).endswith(".")


def test_other_folders_are_refused(tmp_path):
    refused(
        tmp_path / "none", "is not a folder; choose one with a checkpoint of SAM, SAM 2.1 or EdgeTAM as --segmenter"
    )
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "has no config.json; choose")
    refused(write_checkpoint(tmp_path / "bert", model_type="bert"), "is of a model of the type bert; choose")
    for number, text in enumerate(("[]", "{", "{}", '{"model_type": 3}')):
        folder = write_checkpoint(tmp_path / f"damaged {number}")
        (folder / "config.json").write_text(text)
        refused(folder, "is not the config of a model; copy")
    folder = write_checkpoint(tmp_path / "no weights")
    (folder / "model.safetensors").unlink()
    refused(folder, r"has no weights \(\*.safetensors or \*.bin\); copy")


def test_missing_packages_are_named_with_their_command(tmp_path, monkeypatch):
    transformers = pytest.importorskip("transformers")
    if not transformers.utils.is_timm_available():
        folder = write_checkpoint(tmp_path / "edgetam", model_type="edgetam")
        refused(folder, "needs the package timm; run .* -m pip install .timm. .*in a terminal")
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingPackage, match="--segmenter needs the package transformers; run ") as error:
        Segmenter(write_checkpoint(tmp_path / "sam2"))
    assert f'pip install "{PACKAGE}"' in str(error.value)
    assert error.value.fields == {"lacks": "transformers", "option": "--segmenter"}
    monkeypatch.setitem(sys.modules, "transformers", SimpleNamespace(__version__="4.46.0", SamModel=None))
    with pytest.raises(MissingPackage):
        import_transformers("SamModel", "--segmenter")


@pytest.mark.parametrize(
    ("version", "more"),
    [
        ("2.13.0", '"torch==2.13.0"'),
        (
            "2.13.0+cpu",
            '"torch==2.13.0+cpu" --extra-index-url https://download.pytorch.org/whl/cpu',
        ),
    ],
)
def test_timm_comes_with_what_fits_the_build_of_torch(monkeypatch, version, more):
    """Another torchvision cannot be loaded, and transformers fails then."""
    monkeypatch.setattr(checkpoint_folder.torch, "__version__", version)
    assert checkpoint_folder.install_timm().endswith(f' -m pip install "timm" {more}')


def test_broken_packages_are_not_taken_for_missing_ones(monkeypatch, tmp_path):
    class Broken:
        __version__ = "5.24.0"

        def __getattr__(self, name):
            raise ModuleNotFoundError(f"Could not import module '{name}'.") from RuntimeError(
                "torchvision::nms is gone"
            )

    monkeypatch.setitem(sys.modules, "transformers", Broken())
    with pytest.raises(InputError, match=r"cannot be loaded \(torchvision::nms is gone\); set up") as error:
        import_transformers("SamModel", "--segmenter")
    assert not isinstance(error.value, MissingPackage)

    def fail(*_, **__):
        raise ImportError("cannot import name 'x' from 'timm'")

    network = SimpleNamespace(from_pretrained=fail)
    monkeypatch.setattr(checkpoint_folder, "import_transformers", lambda *_: SimpleNamespace(A=network, B=network))
    monkeypatch.setattr(checkpoint_folder.importlib.util, "find_spec", lambda name: name)
    with pytest.raises(InputError, match=r"cannot be loaded \(cannot import name 'x' from 'timm'\)"):
        checkpoint_folder.load_network(tmp_path, "A", "B", "--segmenter")


def test_weights_that_do_not_fit_are_refused(checkpoints, tmp_path):
    folder = shutil.copytree(checkpoints["sam2"], tmp_path / "sam2")
    before = json.loads((folder / "config.json").read_text())
    for part, change in (
        ("mask_decoder_config", {"iou_head_depth": 4}),
        ("mask_decoder_config", {"mlp_dim": 16}),
        ("prompt_encoder_config", {"image_size": "x"}),
    ):
        (folder / "config.json").write_text(json.dumps(before | {part: before[part] | change}))
        refused(folder, r"^The weights in .* do not fit its config.json \(.*\); copy")
    (folder / "config.json").write_text(json.dumps(before))
    (folder / "model.safetensors").write_bytes(b"damaged")
    refused(folder, "do not fit its config.json")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError("Cannot allocate memory (os error 12)"),
        OSError("Die Auslagerungsdatei ist zu klein. (os error 1455)"),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 18874368 bytes."),
        RuntimeError("Couldn't open file mapping: <model.bin>, error code: <1455>"),
    ],
)
def test_weights_that_memory_is_too_small_for_are_not_taken_for_damaged_ones(tmp_path, monkeypatch, error):
    def fail(*_, **__):
        raise error

    network = SimpleNamespace(from_pretrained=fail)
    monkeypatch.setattr(checkpoint_folder, "import_transformers", lambda *_: SimpleNamespace(A=network, B=network))
    with pytest.raises(InputError, match=r"There is not enough memory for the model in .*; close") as told:
        checkpoint_folder.load_network(tmp_path, "A", "B", "--segmenter")
    assert str(tmp_path) in str(told.value) and "copy" not in str(told.value)


def test_colors_are_those_of_the_checkpoint(checkpoints, tmp_path, monkeypatch):
    folder = shutil.copytree(checkpoints["sam"], tmp_path / "sam")
    path = folder / "preprocessor_config.json"
    path.write_text(json.dumps({"image_mean": [0.5, 0.5, 0.5], "image_std": [0.25, 0.5, 1.0]}))
    segmenter = Segmenter(folder)
    monkeypatch.setattr(segmenter, "_network", Discs(9.0))
    pixels = segmenter.encode(np.full((32, SIDE, 3), 255, np.uint8)).features[0]
    assert pixels[:, 0, 0].tolist() == [2.0, 1.0, 0.5] and (pixels[:, 32:] == 0).all() and (pixels[:, 31] > 0).all()
    for text in ("{", "[]", '{"image_mean": [1, 2]}', '{"image_std": "x"}', '{"image_std": [0, 1, 1]}'):
        path.write_text(text)
        with pytest.raises(InputError, match="has no valid image_mean and image_std; copy"):
            Segmenter(folder)


def test_folders_with_models_are_told_from_those_with_masks(tmp_path):
    folder = write_checkpoint(tmp_path / "model")
    assert is_checkpoint(folder) and not is_checkpoint(tmp_path) and not is_checkpoint(folder / "config.json")
    (folder / "config.json").unlink()
    assert is_checkpoint(folder), "of which the config is missing"
    (tmp_path / "config.json").write_text("[1]")
    assert not is_checkpoint(tmp_path) and not is_checkpoint(tmp_path / "none")


# --- the command -----------------------------------------------------------------------------------------------------


class Shades:
    """Stands in for a segmenter: each object of the synthetic captures has a value of green of its own."""

    def __init__(self):
        self.calls, self.fails_at, self.failure, self.loads = 0, None, KeyboardInterrupt(), []

    def __call__(self, folder, option, device):
        self.loads.append(device.type)
        return self

    def everything(self, image, progress):
        progress(1, 2)
        if self.calls == self.fails_at:
            raise self.failure
        self.calls += 1
        masks = [image[..., 1] == green for green in np.unique(image[..., 1]) if green]
        progress(2, 2)
        return sorted(masks, key=lambda mask: -mask.sum())


@pytest.fixture
def shades(monkeypatch):
    stand_in = Shades()
    monkeypatch.setattr("backend.segmentation.finders.Segmenter", stand_in)
    return stand_in


@pytest.fixture
def scene(write_capture):
    """A capture without masks."""
    return write_capture(views=6, masks=False)


@pytest.mark.parametrize("name", ["tokenizer.json", "model.safetensors", "vocab.txt", "sam2.1_hiera_tiny.pt"])
def test_files_of_a_checkpoint_stand_for_its_folder(scene, shades, tmp_path, run_command, name):
    model = write_checkpoint(tmp_path / "model")
    (model / name).touch()
    assert run_command("masks", scene.folder, model / name).code == EXIT_DONE and shades.calls == 6


def test_segments_of_a_model_become_objects(scene, shades, tmp_path, run_command):
    model = write_checkpoint(tmp_path / "model")
    result = run_command("masks", scene.folder, model, "--json")
    assert result.code == EXIT_DONE, result
    record = result.events[-1]["result"]
    assert record["kind"] == "segments by a model of the type sam2" and record["source"] == str(model.resolve())
    assert len(record["objects"]) == 3 and shades.calls == 6
    found = [read_mask(scene.folder / "masks" / f"{name}.png") for name in scene.names]
    assert all(mask.shape == truth.shape for mask, truth in zip(found, scene.ids))
    numbers = {}
    for truth in (1, 2, 5):
        given = np.concatenate([mask[ids == truth] for mask, ids in zip(found, scene.ids)])
        numbers[truth] = np.bincount(given).argmax()
        assert (given == numbers[truth]).mean() > 0.95
    assert len({0, *numbers.values()}) == 4
    assert next(event["stage"] for event in result.events if event["type"] == "status") == "Segmenting"


def test_masks_go_on_after_a_stop(scene, shades, tmp_path, run_command):
    model = write_checkpoint(tmp_path / "model")
    shades.fails_at = 4
    assert run_command("masks", scene.folder, model).code == EXIT_CANCELLED
    assert shades.calls == 4 and not (scene.folder / "masks").exists()
    shades.fails_at = None
    assert run_command("masks", scene.folder, model).code == EXIT_DONE
    assert shades.calls == 6
    assert run_command("masks", scene.folder, model).code == EXIT_DONE
    assert shades.calls == 6 and len(shades.loads) == 2, "everything is kept, so that the model is not needed"
    os.utime(scene.folder / "images" / scene.names[0], (1, 1))
    assert run_command("masks", scene.folder, model).code == EXIT_DONE
    assert shades.calls == 7, "another photo of the same name is segmented again"
    (model / "model.safetensors").write_bytes(b"other weights")
    assert run_command("masks", scene.folder, model).code == EXIT_DONE
    assert shades.calls == 13, "by another model, all are"


def test_models_do_not_run_on_a_gpu_that_has_failed_its_test(scene, shades, tmp_path, run_command, monkeypatch):
    monkeypatch.setattr("backend.raster.devices.pick", lambda requested: torch.device("cuda", 0))
    monkeypatch.setattr("backend.raster.devices.name_of", lambda device: "cuda (Small)")
    monkeypatch.setattr("backend.commands.setup.device._known_problem", lambda device: "splats differ")
    result = run_command("masks", scene.folder, write_checkpoint(tmp_path / "model"), "--json")
    assert result.code == EXIT_DONE and shades.loads == ["cpu"]
    assert "cuda (Small) fails a test (splats differ), so the CPU is used" in result.messages("warning")[0]


@pytest.mark.parametrize(("loads", "fails_at"), [(False, None), (True, 0), (True, 4)])
def test_models_that_do_not_fit_into_the_gpu_run_on_the_cpu(
    scene, shades, tmp_path, run_command, monkeypatch, loads, fails_at
):
    full = torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 MiB")

    def load(folder, option, device):
        shades.loads.append(device.type)
        shades.fails_at = fails_at if device.type == "cuda" else None
        if device.type == "cuda" and not loads:
            raise full
        return shades

    shades.failure = full
    monkeypatch.setattr("backend.segmentation.finders.Segmenter", load)
    monkeypatch.setattr("backend.commands.capture.segmented.choose_device", lambda *_: torch.device("cuda", 0))
    result = run_command("masks", scene.folder, write_checkpoint(tmp_path / "model"), "--json")
    assert result.code == EXIT_DONE and shades.loads == ["cuda", "cpu"] and shades.calls == 6
    (warning,) = result.messages("warning")
    assert warning.startswith("There is not enough GPU memory for the model, so the CPU is used, which is slower; ")


def test_a_lack_of_memory_is_told_of_the_model(scene, shades, tmp_path, run_command):
    shades.fails_at, shades.failure = 3, RuntimeError("DefaultCPUAllocator: can't allocate memory")
    result = run_command("masks", scene.folder, write_checkpoint(tmp_path / "model"))
    assert_rejected(result, "There is not enough memory for the model in", "use a smaller model")
    assert "--max-size" not in result.err


def test_models_are_refused_before_photos_are_segmented(scene, shades, tmp_path, run_command):
    model = write_checkpoint(tmp_path / "model")
    assert_rejected(run_command("masks", scene.folder, model, "--objects", "given"), "use --objects find")
    shutil.rmtree(scene.folder / "sparse")
    assert_rejected(run_command("masks", scene.folder, model), "by the points of the photos")
    assert shades.calls == 0 and not (scene.folder / "masks-segments").exists()


def test_masks_tell_what_is_wrong_with_a_model(scene, tmp_path, run_command):
    folder = write_checkpoint(tmp_path / "model", model_type="lightglue")
    assert_rejected(run_command("masks", scene.folder, folder), "of the type lightglue; choose", "as MASKS")
    (folder / "config.json").unlink()
    assert_rejected(run_command("masks", scene.folder, folder), "has no config.json")


def finder_of(find):
    return Finder("segments", "00", 1024, lambda device: find)


def test_segments_are_drawn_small_over_large(tmp_path):
    """Segments that others cover completely are left out, and their numbers are without gaps."""
    (tmp_path / "images").mkdir()
    Image.new("RGB", (40, 30)).save(tmp_path / "images" / "a.png")
    masks = np.zeros((4, 30, 40), bool)
    masks[0], masks[1, :15], masks[2, :15, :20], masks[3, :15, 20:] = True, True, True, True
    names = ["wall", "shelf", "book", "cup"]
    source = PhotoSegments(
        finder_of(lambda image, progress: list(zip(masks, names))), tmp_path / "images", ["a.png"], tmp_path / "kept"
    )
    calls = []
    source.find(CPU, lambda done, total: calls.append((done, total)))
    found = source.read("a.png")
    assert found.numbers[20, 5] == 1 and found.numbers[5, 5] == 2 and found.numbers[5, 30] == 3
    assert list(found.objects) == [None] * 3 and calls == [(1, 1)] and not source.missing()
    assert list(found.names) == ["wall", "book", "cup"]
    (tmp_path / "kept" / "00-3" / "a.png.npz").write_bytes(b"damaged")
    with pytest.raises(InputError, match=r"a.png.npz"):
        source.read("a.png")
    for damaged in (b"damaged", b""):
        (tmp_path / "kept" / "00-3" / "a.png.npz").write_bytes(damaged)
        assert source.missing() == ["a.png"]


def test_kept_segments_are_those_of_the_photo(tmp_path):
    """Copies keep the times of files, and cameras may have clocks that are ahead."""
    photo, now = tmp_path / "a.png", time.time()

    def put(columns, when):
        pixels = np.zeros((30, 40, 3), np.uint8)
        pixels[:, columns] = 255
        Image.fromarray(pixels).save(photo)
        os.utime(photo, (when, when))

    def found():
        finder = finder_of(lambda image, progress: [(image[..., 0] > 0, "")])
        source = PhotoSegments(finder, tmp_path, ["a.png"], tmp_path / "kept")
        source.find(CPU, lambda done, total: None)
        assert not source.missing()
        return source.read("a.png").numbers[0, [10, 30]].tolist()

    put(slice(20), now)
    assert found() == [1, 0]
    put(slice(20, 40), now - 7 * 86400)
    assert found() == [0, 1], "by another photo that was taken before"
    put(slice(20), now + 8 * 3600)
    assert found() == [1, 0]


def test_photos_are_decoded_once(tmp_path, monkeypatch):
    """Pillow decodes a PNG without EXIF data completely to look for some behind its pixels."""
    decoded, load = [], PngImagePlugin.PngImageFile.load_end
    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load_end", lambda image: decoded.append(load(image)))
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    finder = finder_of(lambda image, progress: [(image[..., 0] == 0, "")])
    source = PhotoSegments(finder, tmp_path, ["a.png"], tmp_path / "kept")
    assert source.missing() == ["a.png"] and not decoded
    source.find(CPU, lambda done, total: None)
    assert not source.missing() and source.read("a.png").numbers.all() and len(decoded) == 1


@pytest.mark.parametrize(("name", "mode"), [("a.png", "RGB"), ("b.png", "RGBA"), ("a.tif", "RGB")])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_models_see_photos_upright(tmp_path, orientation, name, mode):
    pixels = np.zeros((30, 40, 3), np.uint8)
    pixels[3:9, 5:25] = 255
    stored = Image.fromarray(pixels).convert(mode)
    exif = stored.getexif()
    exif[ExifTags.Base.Orientation] = orientation
    stored.save(tmp_path / name, exif=exif)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / name)).convert("RGB"))
    seen = []

    def find(image, progress):
        seen.append(image)
        return [(image[..., 0] > 0, "")]

    source = PhotoSegments(finder_of(find), tmp_path, [name], tmp_path / "kept")
    source.find(CPU, lambda done, total: None)
    assert np.array_equal(seen[0], upright)
    assert np.array_equal(source.read(name).numbers, pixels[..., 0] > 0), "segments are those of the stored pixels"


def test_small_models_segment_a_capture(checkpoints, scene, run_command):
    """The whole command with a network of random weights, which finds nothing."""
    result = run_command("masks", scene.folder, checkpoints["sam2"])
    assert_rejected(result, f"The model in {checkpoints['sam2']} finds no segments in the 6 photos; use another")
    kept = scene.folder / "masks-segments" / f"{fingerprint(checkpoints['sam2'])}-3"
    assert sorted(path.name for path in kept.iterdir()) == [f"{name}.npz" for name in scene.names]
