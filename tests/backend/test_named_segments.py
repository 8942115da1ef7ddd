"""Objects that are named by words: by small models with random weights, and by stand-ins that see the truth."""

import argparse
import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn.functional import max_pool2d

from backend.capture.files import read_mask
from backend.cli import types
from backend.networks.checkpoint_folder import digest_of
from backend.segmentation import detector, finders, sam3
from backend.segmentation.detections import detections, prompt_of
from backend.segmentation.detector import Detector, input_size
from backend.segmentation.sam3 import Sam3
from backend.shared.errors import EXIT_CANCELLED, EXIT_DONE, InputError

from .command_result import assert_rejected
from .small_detectors import SIDE, write_sam3_words, write_small_detector, write_small_sam3, write_words
from .small_segmenters import write_small_model


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """Checkpoints of small models: kind -> folder."""
    pytest.importorskip("transformers")
    place = tmp_path_factory.mktemp("checkpoints")
    write_small_model(place / "sam2", "sam2")
    write_small_detector(place / "dino")
    write_small_sam3(place / "sam3")
    write_small_sam3(place / "sam3_video", video=True)
    return {folder.name: folder for folder in place.iterdir()}


@pytest.fixture
def small_input(monkeypatch):
    """Photos are scaled to 64 pixels rather than 800."""
    monkeypatch.setattr(detector, "_SHORTEST_SIDE", 64)


def picture(width, height):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


# --- from words to boxes ---------------------------------------------------------------------------------------------


def test_prompts_have_a_phrase_for_each_name():
    prompt, places = prompt_of(["Red  cup", "Dr. Who?", "book"])
    assert prompt == "red cup . dr who . book ."
    assert [prompt[first:last] for first, last in places] == ["red cup", "dr who", "book"]


TOKENS = [np.array([1, 2]), np.array([4, 5]), np.array([7])]
"""Of "red cup . blue cup . book .", after the beginning of the text."""
NAMES = ["red cup", "blue cup", "book"]


def found_in(rows, boxes=None):
    """Detections of rows of logits of the five words, each with a box of its own unless boxes are given."""
    logits = np.full((len(rows), 10), -np.inf)
    logits[:, [1, 2, 4, 5, 7]] = rows
    probabilities = torch.tensor(logits).sigmoid().numpy()
    if boxes is None:
        boxes = [(0.1 + 0.2 * number, 0.5, 0.1, 0.4) for number in range(len(rows))]
    return detections(probabilities, np.array(boxes), TOKENS, NAMES, (200, 100))


def test_boxes_get_the_name_of_which_all_words_fit():
    found = found_in([
        [1.0, 0.5, -3.0, 0.6, -4.0],  # The most probable word is certain, and the other is not.
        [-1.5, 1.0, 0.8, 0.9, -4.0],  # "cup" of "red cup" fits best of all words, but it is blue.
        [-5.0, -5.0, -5.0, -5.0, 0.0],
        [-1.0, -1.2, -2.0, -2.0, -2.0],  # Too uncertain.
    ])  # fmt: skip
    assert [each.name for each in found] == ["red cup", "blue cup", "book"]
    assert [each.score for each in found] == pytest.approx(1 / (1 + np.exp([-1.0, -1.0, 0.0])))
    assert found[2].box == pytest.approx([90, 30, 110, 70]), "in pixels of the photo"


def test_thresholds_of_boxes_and_names():
    def logit(probability):
        return np.log(probability / (1 - probability))

    assert not found_in([[-9, -9, -9, -9, logit(0.29)]]) and len(found_in([[-9, -9, -9, -9, logit(0.31)]])) == 1
    # On average, the words of the second name fit better, but none is probable enough.
    assert found_in([[logit(0.31), -9, logit(0.24), logit(0.24), -9]])[0].name == "red cup"


def test_an_object_under_two_names_keeps_the_better():
    boxes = [(0.5, 0.5, 0.4, 0.4), (0.51, 0.5, 0.4, 0.4), (0.3, 0.5, 0.4, 0.4), (0.95, 0.5, 0.2, 1.2), (0.5, 0.5, 0, 1)]
    book, cup = [-9, -9, -9, -9, 1.0], [2.0, 2.0, -9, -9, -9]
    found = found_in([book, cup, book, book, book], boxes)
    assert [each.name for each in found] == ["red cup", "book", "book"]
    assert found[2].box == pytest.approx([170, 0, 200, 100]), "cut off at the border of the photo"
    assert found_in([[-9] * 5]) == []


@pytest.mark.long
def test_small_detector_finds_what_transformers_finds(checkpoints, small_input):
    transformers = pytest.importorskip("transformers")
    processor = pytest.importorskip("transformers.models.grounding_dino.image_processing_pil_grounding_dino")
    names, image = ["red cup", "blue cups", "book"], picture(150, 100)
    size = {"shortest_edge": 64, "longest_edge": 1333}
    prepared = processor.GroundingDinoImageProcessorPil(size=size)(images=image, return_tensors="pt")
    tokenizer = transformers.AutoTokenizer.from_pretrained(checkpoints["dino"])
    words = tokenizer("red cup. blue cups. book.", return_tensors="pt")
    network = transformers.GroundingDinoForObjectDetection.from_pretrained(checkpoints["dino"]).eval()
    with torch.inference_mode():
        expected = network(**prepared, **words)
    probabilities = expected.logits[0].sigmoid().numpy()
    assert tuple(prepared.pixel_values.shape[2:]) == input_size((150, 100))[::-1]
    corners = expected.pred_boxes[0].numpy() @ np.array(
        [[1, 0, 1, 0], [0, 1, 0, 1], [-0.5, 0, 0.5, 0], [0, -0.5, 0, 0.5]]
    )
    corners = np.clip(corners * [150, 100, 150, 100], 0, [150, 100, 150, 100])
    found = Detector(checkpoints["dino"], names).find(image)
    assert found
    for each in found:
        query = int(np.abs(corners - each.box).sum(1).argmin())
        assert each.box == pytest.approx(corners[query], abs=0.05)
        assert each.score == pytest.approx(probabilities[query, [1, 2, 4, 5, 6, 8]].max(), abs=1e-3)
        means = [probabilities[query, own].mean() for own in ([1, 2], [4, 5, 6], [8])]
        assert each.name == names[int(np.argmax(means))]


def test_photos_are_scaled_as_the_detector_was_trained():
    assert input_size((640, 480)) == (1067, 800) and input_size((480, 640)) == (800, 1067)
    assert input_size((4000, 1000)) == (1333, 333) and input_size((5000, 1)) == (1333, 1)


def test_names_are_separated_by_semicolons():
    assert types.names(" red  cup ;book;; Red Cup;chair ") == ["red cup", "book", "chair"]
    for text, words in (("", "names no object"), (" ; ;", "names no object"), ("cup; ...", "'...' is not a name")):
        with pytest.raises(argparse.ArgumentTypeError, match=words):
            types.names(text)


# --- checkpoints -----------------------------------------------------------------------------------------------------


def refused(make, folder, words):
    with pytest.raises(InputError, match=words) as error:
        make()
    assert str(folder) in str(error.value) and "\n" not in str(error.value) and str(error.value).endswith(".")


def test_other_detectors_are_refused(checkpoints, tmp_path):
    def make():
        return Detector(folder, ["cup"])

    folder = tmp_path / "none"
    refused(make, folder, "is not a folder; choose one with a checkpoint of Grounding DINO as --detector")
    folder = checkpoints["sam2"]
    refused(make, folder, "is of a model of the type sam2; choose a checkpoint of Grounding DINO as --detector")
    folder = shutil.copytree(checkpoints["dino"], tmp_path / "dino")
    (folder / "tokenizer.json").write_text("{")
    refused(make, folder, "The tokenizer in .* cannot be read .*; copy")
    (folder / "tokenizer.json").unlink()
    (folder / "vocab.txt").unlink()
    refused(make, folder, "has no tokenizer.json or vocab.txt; copy all files of the checkpoint of Grounding DINO")
    write_words(folder)
    (folder / "model.safetensors").write_bytes(b"damaged")
    refused(make, folder, "do not fit its config.json")


def test_names_that_a_detector_cannot_read_are_refused(checkpoints):
    folder = checkpoints["dino"]
    refused(lambda: Detector(folder, ["cup"] * 20), folder, "are 42 words and parts of words, .* reads 32; name fewer")
    refused(lambda: Detector(folder, ["cup", "..."]), folder, "reads no word in '...' of --text; choose another")


def test_tokenizers_of_sam3_are_needed(checkpoints, tmp_path):
    folder = shutil.copytree(checkpoints["sam3"], tmp_path / "sam3")
    (folder / "tokenizer.json").unlink()
    refused(lambda: Sam3(folder, ["cup"], "MASKS"), folder, "has no tokenizer.json or vocab.json; copy .* of SAM 3")


# --- SAM 3 -----------------------------------------------------------------------------------------------------------


def test_segments_are_those_of_sam3(checkpoints, monkeypatch):
    """A photo of the input's size needs no scaling, so the network can be asked directly."""
    transformers = pytest.importorskip("transformers")
    monkeypatch.setattr(sam3, "_LEAST", 0.02)  # Random networks are certain of nothing.
    network = transformers.Sam3Model.from_pretrained(checkpoints["sam3"]).eval()
    image, expected, steps = picture(SIDE, SIDE), [], []
    pixels = torch.tensor(image / 127.5 - 1, dtype=torch.float32).permute(2, 0, 1)[None]
    for name, words in (("Red cup", [0, 3, 5, 1]), ("book", [0, 6, 1])):
        with torch.inference_mode():
            found = network(pixel_values=pixels, input_ids=torch.tensor([words]))
        scores = (found.pred_logits.sigmoid() * found.presence_logits.sigmoid())[0]
        shown = torch.nn.functional.interpolate(found.pred_masks, (SIDE, SIDE), mode="bilinear")[0] > 0
        expected += [(float(score), mask.numpy(), name) for score, mask in zip(scores, shown) if score >= 0.02]
    own = Sam3(checkpoints["sam3"], ["Red cup", "book"], "MASKS")
    segments = own.find(image, lambda done, total: steps.append((done, total)))
    assert segments and len({name for _, name in segments}) == 2 and steps == [(1, 3), (2, 3), (3, 3)]
    for mask, name in segments:
        assert any(other == name and (mask == truth).mean() > 0.98 for _, truth, other in expected)
    best = max(expected, key=lambda each: each[0])
    assert any(name == best[2] and (mask == best[1]).mean() > 0.98 for mask, name in segments)


def test_weights_of_videos_are_those_of_photos(checkpoints):
    transformers = pytest.importorskip("transformers")
    video = transformers.Sam3VideoModel.from_pretrained(checkpoints["sam3_video"]).detector_model.state_dict()
    own = Sam3(checkpoints["sam3_video"], ["cup"], "MASKS")._network.state_dict()
    assert own.keys() == video.keys() and all(torch.equal(own[name], video[name]) for name in own)
    assert sam3.is_sam3(checkpoints["sam3_video"], "MASKS") and not sam3.is_sam3(checkpoints["sam2"], "MASKS")


# --- the command -----------------------------------------------------------------------------------------------------

GREEN = {"cup": 40, "book": 80, "table": 200}
"""Words, and the value of green of their object in the synthetic captures, whose ID it is 40 times."""
TEXT = "cup; book; table; red sphere"


class Network:
    """Stands in for a network with weights; `fails_at` is the number of the photo at which it is interrupted."""

    def __init__(self):
        self.calls, self.fails_at, self.misnames = 0, None, ()
        self.config = SimpleNamespace(
            max_text_len=64,
            prompt_encoder_config=SimpleNamespace(image_size=128),
            vision_config=SimpleNamespace(image_size=128),
            text_config=SimpleNamespace(max_position_embeddings=8),
        )

    def to(self, _):
        return self

    def count(self):
        if self.calls == self.fails_at:
            raise KeyboardInterrupt
        self.calls += 1


def extent_of(green, word, thickness):
    """Return left, top, right and bottom of a word's object in a photo (h, w), or None; lines between others that have
    its color are thinner than `thickness`."""
    thinned = -max_pool2d(-((green - GREEN[word]).abs() < 8)[None].float(), thickness, 1, thickness // 2)[0]
    rows, columns = torch.nonzero(thinned > 0, as_tuple=True)
    if not len(rows):
        return None
    more = thickness // 2
    return torch.stack([columns.min() - more, rows.min() - more, columns.max() + more + 1, rows.max() + more + 1])


class TrueBoxes(Network):
    """Stands in for a Grounding DINO: it sees the true boxes, and names as the vocabulary numbers them."""

    def __call__(self, pixel_values, pixel_mask, input_ids):
        self.count()
        assert pixel_mask.shape == (1, *pixel_values.shape[2:]) and pixel_mask.all()
        green = (pixel_values[0, 1] * 0.224 + 0.456) * 255
        height, width = green.shape
        numbers = {"cup": 1042, "book": 1043, "table": 1044}
        boxes, logits = [], torch.full((1, 6, 64), -torch.inf)
        logits[:, :, : input_ids.shape[1]] = -6.0
        for query, word in enumerate(GREEN):
            borders = extent_of(green, word, 5)
            if borders is None:
                boxes.append((0.5, 0.5, 0.1, 0.1))
                continue
            left, top, right, bottom = (borders / torch.tensor([width, height, width, height])).tolist()
            boxes.append(((left + right) / 2, (top + bottom) / 2, right - left, bottom - top))
            shown = "book" if word == "cup" and self.calls in self.misnames else word
            logits[0, query, : input_ids.shape[1]][input_ids[0] == numbers[shown]] = 2.0
        boxes += [(0.5, 0.5, 0.1, 0.1)] * 3
        return SimpleNamespace(logits=logits, pred_boxes=torch.tensor([boxes]))


class TrueMasks(Network):
    """Stands in for a segmenter: the mask of a box is the object that extends from border to border of it."""

    def get_image_embeddings(self, pixels):
        return (pixels[0, 1] * 0.224 + 0.456) * 255

    def __call__(self, image_embeddings, multimask_output, input_boxes):
        box = input_boxes[0, 0] + 0.5
        extents = {word: extent_of(image_embeddings, word, 3) for word in GREEN}
        seen = {word: borders for word, borders in extents.items() if borders is not None}
        shown = min(seen, key=lambda word: float((seen[word] - box).abs().sum()))
        best = (image_embeddings - GREEN[shown]).abs() < 8
        return SimpleNamespace(
            pred_masks=torch.where(best, 9.0, -9.0)[None, None, None], iou_scores=torch.ones(1, 1, 1)
        )


class TrueWords(Network):
    """Stands in for a SAM 3."""

    def get_vision_features(self, pixels):
        self.count()
        return (pixels[0, 1] * 0.5 + 0.5) * 255

    def __call__(self, vision_embeds, input_ids, attention_mask):
        assert attention_mask.sum() == (input_ids != 1).sum() + 1
        # What fits best words of nothing in the photo is the background.
        shown, presence = 0, -9.0
        for number, word in ((5, "cup"), (6, "book"), (7, "table")):
            if number in input_ids:
                shown, presence = GREEN[word], 9.0
        masks = torch.where((vision_embeds - shown).abs() < 8, 9.0, -9.0).expand(1, 2, -1, -1)
        return SimpleNamespace(
            pred_masks=masks, pred_logits=torch.tensor([[-9.0, 9.0]]), presence_logits=torch.tensor([[presence]])
        )


@pytest.fixture
def stand_ins(monkeypatch, tmp_path):
    """Folders with what is no checkpoint but the networks, which are stand-ins."""
    pytest.importorskip("transformers")
    monkeypatch.setattr(detector, "_SHORTEST_SIDE", 288)  # It is faster.
    networks = SimpleNamespace(dino=TrueBoxes(), sam2=TrueMasks(), sam3=TrueWords())
    for name, kind, module in (
        ("dino", "grounding-dino", "detector"), ("sam2", "sam2", "segmenter"), ("sam3", "sam3", "sam3"),
    ):  # fmt: skip
        folder = tmp_path / name
        folder.mkdir()
        (folder / "config.json").write_text(json.dumps({"model_type": kind}))
        (folder / "model.safetensors").write_bytes(b"")
        network = getattr(networks, name)
        monkeypatch.setattr(f"backend.segmentation.{module}.load_network", lambda *_, network=network: network)
    write_words(tmp_path / "dino")
    write_sam3_words(tmp_path / "sam3")
    return networks


@pytest.fixture
def scene(write_capture):
    """A capture without masks."""
    return write_capture(views=6, masks=False)


def labels_of(scene):
    """The names in labels.json, each with the true ID of what it is the name of."""
    names = json.loads((scene.folder / "labels.json").read_text())
    found = np.stack([read_mask(scene.folder / "masks" / f"{name}.png") for name in scene.names])
    truth = np.stack(scene.ids)
    shown = {}
    for number, name in names.items():
        inside = truth[found == int(number)]
        shown[name] = int(np.bincount(inside).argmax())
        assert (inside == shown[name]).mean() > 0.9
        assert (found[truth == shown[name]] == int(number)).mean() > 0.8
    return shown


def test_words_become_named_objects(scene, stand_ins, tmp_path, run_command):
    stand_ins.dino.misnames = (2, 4)
    result = run_command(
        "masks", scene.folder, tmp_path / "sam2", "--detector", tmp_path / "dino", "--text", TEXT, "--json"
    )
    assert result.code == EXIT_DONE, result
    assert labels_of(scene) == {"cup": 1, "book": 2, "table": 5}, "two photos call the cup a book"
    record = result.events[-1]["result"]
    assert record["kind"] == "segments of cup, book, table, red sphere by models of the types grounding-dino and sam2"
    assert {each["name"] for each in record["objects"]} == {"cup", "book", "table"}
    assert result.messages("warning") == ["No photo shows red sphere as far as the model finds; other words may help."]


def test_words_of_sam3_become_named_objects(scene, stand_ins, tmp_path, run_command):
    result = run_command("masks", scene.folder, tmp_path / "sam3", "--text", TEXT, "--json")
    assert result.code == EXIT_DONE, result
    assert labels_of(scene) == {"cup": 1, "book": 2, "table": 5} and stand_ins.sam3.calls == 6
    assert result.events[-1]["result"]["kind"] == (
        "segments of cup, book, table, red sphere by a model of the type sam3"
    )
    assert len(result.messages("warning")) == 1
    assert_rejected(
        run_command("masks", scene.folder, tmp_path / "sam3"), "finds objects by their names; add --text", "sam3"
    )
    # It needs no detector, and its config.json may stand for its folder.
    arguments = ("--text", "cup", "--detector", tmp_path / "dino")
    assert run_command("masks", scene.folder, tmp_path / "sam3" / "config.json", *arguments).code == EXIT_DONE
    assert labels_of(scene) == {"cup": 1}


def test_found_words_are_kept(scene, stand_ins, tmp_path, run_command, monkeypatch):
    def run(text):
        return run_command(
            "masks", scene.folder, tmp_path / "sam2", "--detector", tmp_path / "dino", "--text", text
        ).code

    stand_ins.dino.fails_at = 4
    assert run(TEXT) == EXIT_CANCELLED and stand_ins.dino.calls == 4 and not (scene.folder / "masks").exists()
    stand_ins.dino.fails_at = None
    assert run(TEXT) == EXIT_DONE and stand_ins.dino.calls == 6
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "transformers", None)
        assert run(TEXT) == EXIT_DONE and stand_ins.dino.calls == 6, "everything is kept"
    assert run("book; cup") == EXIT_DONE and stand_ins.dino.calls == 12 and labels_of(scene) == {"cup": 1, "book": 2}
    assert run(TEXT) == EXIT_DONE and stand_ins.dino.calls == 12 and len(labels_of(scene)) == 3
    (tmp_path / "dino" / "model.safetensors").write_bytes(b"others")
    assert run(TEXT) == EXIT_DONE and stand_ins.dino.calls == 18, "by another detector"
    (tmp_path / "sam2" / "model.safetensors").write_bytes(b"others")
    assert run(TEXT) == EXIT_DONE and stand_ins.dino.calls == 24, "by another segmenter"


def test_names_of_single_photos_are_told(scene, stand_ins, tmp_path, run_command):
    stand_ins.dino.misnames = (1, 2, 3, 4, 5)
    arguments = ("--detector", tmp_path / "dino", "--text", "cup; book", "--json")
    result = run_command("masks", scene.folder, tmp_path / "sam2", *arguments)
    assert result.code == EXIT_DONE, result
    assert result.messages("warning") == [
        "No object is named cup, since only single photos show it, or most show it by another name."
    ]


def test_options_for_words_fit_each_other(scene, stand_ins, tmp_path, run_command):
    def rejected(model, *arguments, words):
        assert_rejected(run_command("masks", scene.folder, model, *arguments), *words)

    model, dino = tmp_path / "sam2", tmp_path / "dino"
    rejected(model, "--text", "cup", words=("add --detector, a folder with a checkpoint of Grounding DINO", str(model)))
    rejected(model, "--detector", dino, words=("add --text, such as", str(dino)))
    rejected(scene.folder, "--text", "cup", words=("has no model, which --text and --detector are for",))
    rejected(scene.folder, "--detector", dino, words=("has no model, which --text and --detector are for",))
    rejected(model, "--detector", dino, "--text", " ; ", words=("names no object",))
    rejected(model, "--detector", model, "--text", "cup", words=("type sam2; choose", "as --detector"))
    assert stand_ins.dino.calls == 0 and not (scene.folder / "masks-segments").exists()
    words = ("No photo shows sphere or red sphere as far as the model finds; use other words",)
    rejected(model, "--detector", dino, "--text", "sphere; red sphere", words=words)


def test_boxes_of_one_segment_are_one(monkeypatch):
    """Boxes that overlap less than their masks."""
    found = [SimpleNamespace(box=np.arange(4.0), name=name, score=score) for name, score in (("a", 0.4), ("b", 0.9))]
    masks = np.zeros((2, 8, 8), bool)
    masks[:, 2:6, 2:6], masks[0, 2, 2] = True, False
    asked = iter(masks)
    model = SimpleNamespace(encode=lambda image: image, segment=lambda *_: (next(asked), 1.0))
    monkeypatch.setattr(finders, "Detector", lambda *_: SimpleNamespace(find=lambda image: found))
    monkeypatch.setattr(finders, "Segmenter", lambda *_: model)
    for module, name in ((finders, "kind_of"), (finders, "fingerprint"), (detector, "fingerprint")):
        monkeypatch.setattr(module, name, lambda *_: "1")
    find, steps = finders.boxed(None, "MASKS", None, ["a", "b"]).load(torch.device("cpu")), []
    segments = find(np.zeros((8, 8, 3), np.uint8), lambda done, total: steps.append((done, total)))
    assert [name for _, name in segments] == ["b"] and (segments[0][0] == masks[1]).all() and steps == [(1, 2), (2, 2)]
    found.clear()
    assert find(np.zeros((8, 8, 3), np.uint8), lambda *_: None) == []


def test_small_models_find_words_in_a_capture(checkpoints, scene, small_input, run_command):
    """The whole command with networks of random weights, whatever they find."""
    model, dino = checkpoints["sam2"], checkpoints["dino"]
    result = run_command("masks", scene.folder, model, "--detector", dino, "--text", "red cup; book")
    if result.code != EXIT_DONE:
        assert_rejected(result)
    (kept,) = (scene.folder / "masks-segments").iterdir()
    assert digest_of(model) in kept.name and digest_of(dino) in kept.name
    assert sorted(path.name for path in kept.iterdir()) == [f"{name}.npz" for name in scene.names]
