"""Masks of other programs: every format gives the objects that were written, and damaged files are refused."""

import json

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from pycocotools import mask as coco_masks

from backend.capture import load_capture
from backend.capture.files import read_mask
from backend.capture.mask_sources import open_source
from backend.capture.mask_sources.label_studio import unpack
from backend.capture.mask_sources.segments import Shape, draw_shapes, polygon, run_lengths
from backend.film.cryptomatte import header, name_bits
from backend.sfm.sources.photos import take_photos
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError
from backend.shared.events import Reporter

from .command_result import assert_rejected

SIZE = (40, 30)
NAMES = {1: "mug", 2: "box"}


def masks_of(number):
    """The exact IDs in a photo: a mug of the ID 1 and a box of the ID 2, as rectangles."""
    ids = np.zeros(SIZE[::-1], np.uint8)
    ids[4 + number : 14 + number, 5:20] = 1
    ids[18:27, 10 + number : 33] = 2
    return ids


@pytest.fixture
def photos(tmp_path):
    """A capture with two photos and without cameras."""
    folder = tmp_path / "capture" / "images"
    folder.mkdir(parents=True)
    for number in (0, 1):
        Image.new("RGB", SIZE, (90, 90, 90)).save(folder / f"photo {number}.jpg")
    return tmp_path / "capture"


def photo(number):
    return f"photo {number}.jpg"


def corners(inside):
    """The left, top, right and bottom edges of a rectangle, in pixels from the edges of the photo."""
    rows, columns = np.nonzero(inside)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def compressed(inside):
    return coco_masks.encode(np.asfortranarray(inside.astype(np.uint8)))["counts"].decode()


def runs(inside):
    """Run lengths along the rows of a flattened mask, beginning with those outside."""
    values = inside.ravel().astype(int)
    at = np.flatnonzero(np.diff(values, prepend=0, append=1 - values[-1]))
    return np.diff([0, *at]).tolist()


def coco(describe, **more):
    return {
        "images": [{"id": n, "file_name": photo(n), "width": SIZE[0], "height": SIZE[1]} for n in (0, 1)],
        "categories": [{"id": 10 * i, "name": name} for i, name in NAMES.items()],
        "annotations": [
            {"image_id": n, "category_id": 10 * i, "segmentation": describe(masks_of(n) == i), **more}
            for n in (0, 1)
            for i in NAMES
        ],
    }


def as_polygon(inside):
    left, top, right, bottom = map(int, corners(inside))
    return [[left, top, right, top, right, bottom, left, bottom]]


def write_coco(folder, describe):
    path = folder / "annotations.json"
    path.write_text(json.dumps(coco(describe)))
    return path


def write_coco_polygons(folder):
    return write_coco(folder, as_polygon)


def write_coco_runs(folder):
    return write_coco(folder, lambda inside: {"size": list(SIZE[::-1]), "counts": runs(inside.T)})


def write_coco_compressed(folder):
    return write_coco(folder, lambda inside: {"size": list(SIZE[::-1]), "counts": compressed(inside)})


def write_panoptic(folder):
    content = coco(as_polygon)
    (folder / "panoptic").mkdir()
    content["annotations"] = []
    for n in (0, 1):
        ids = np.choose(masks_of(n), (0, 300 + n, 70_000))
        channels = np.stack([ids & 255, ids >> 8 & 255, ids >> 16], -1).astype(np.uint8)
        Image.fromarray(channels).save(folder / "panoptic" / f"photo {n}.png")
        segments = [{"id": 300 + n, "category_id": 10}, {"id": 70_000, "category_id": 20}]
        content["annotations"].append({"image_id": n, "file_name": f"photo {n}.png", "segments_info": segments})
    path = folder / "panoptic.json"
    path.write_text(json.dumps(content))
    return path


def cvat_shapes(n):
    """A polygon for the mug and a mask for the box."""
    left, top, right, bottom = corners(masks_of(n) == 1)
    points = ";".join(f"{x},{y}" for x, y in ((left, top), (right, top), (right, bottom), (left, bottom)))
    x, y, right, bottom = corners(masks_of(n) == 2)
    wide, tall = right - x, bottom - y
    box = f'rle="0, {wide * tall}" left="{x}" top="{y}" width="{wide}" height="{tall}"'
    return f'<polygon label="mug" points="{points}" {{0}}/>', f'<mask label="box" {box} {{1}}/>'


def write_cvat_images(folder):
    entries = [
        f'<image id="{n}" name="{photo(n)}" width="{SIZE[0]}" height="{SIZE[1]}">'
        + "".join(shape.format("", "") for shape in cvat_shapes(n)) + "</image>"
        for n in (0, 1)
    ]  # fmt: skip
    path = folder / "annotations.xml"
    path.write_text(f'<?xml version="1.0"?><annotations>{"".join(entries)}</annotations>')
    return path


def write_cvat_video(folder):
    size = f"<original_size><width>{SIZE[0]}</width><height>{SIZE[1]}</height></original_size>"
    tracks = [
        f'<track id="{i}" label="{name}">'
        + "".join(cvat_shapes(n)[i - 1].format(*[f'frame="{n}" outside="0"'] * 2) for n in (0, 1)) + "</track>"
        for i, name in NAMES.items()
    ]  # fmt: skip
    path = folder / "video.xml"
    path.write_text(f"<annotations><meta><task>{size}</task></meta>{''.join(tracks)}</annotations>")
    return path


def packed(values, word=8):
    """Encode a brush as @thi.ng/rle-pack does, with runs of one value and with runs of single values."""
    bits = f"{len(values):032b}{word - 1:05b}" + "".join(f"{size - 1:04b}" for size in (3, 4, 8, 16))
    at = 0
    while at < len(values):
        end = at
        while end < len(values) and values[end] == values[at] and end - at < 1 << 16:
            end += 1
        if end - at > 1:
            bits += f"111{end - at - 1:016b}{values[at]:08b}"
        else:
            bits += f"000{0:03b}{values[at]:08b}"
            end = at + 1
        at = end
    bits += "0" * (-len(bits) % 8)
    return [int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)]


def write_label_studio(folder):
    tasks = []
    for n in (0, 1):
        mug = np.zeros((*SIZE[::-1], 4), np.uint8)
        mug[masks_of(n) == 1] = 255
        left, top, right, bottom = corners(masks_of(n) == 2)
        points = [
            [100 * x / SIZE[0], 100 * y / SIZE[1]]
            for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))
        ]
        values = [
            {"format": "rle", "rle": packed(mug.ravel().tolist()), "brushlabels": ["mug"]},
            {"points": points, "polygonlabels": ["box"]},
        ]
        results = [{"original_width": SIZE[0], "original_height": SIZE[1], "value": value} for value in values]
        image = f"/data/upload/1/0123abcd-{photo(n)}"
        tasks.append({"data": {"image": image}, "annotations": [{"result": results}]})
    path = folder / "export.json"
    path.write_text(json.dumps(tasks))
    return path


def write_label_studio_of_separate_labels(folder):
    """As with the tags Rectangle, Labels and TextArea in place of RectangleLabels."""
    path = write_label_studio(folder)
    tasks = json.loads(path.read_text())
    for task in tasks:
        separate = []
        for number, result in enumerate(task["annotations"][0]["result"]):
            shape = {key: value for key, value in result["value"].items() if not key.endswith("labels")}
            (label,) = (value for key, value in result["value"].items() if key.endswith("labels"))
            values = [shape, {**shape, "labels": label}, {**shape, "text": ["as a note"]}]
            separate += [{**result, "id": f"region {number}", "value": value} for value in values]
        task["annotations"][0]["result"] = separate
    path.write_text(json.dumps(tasks))
    return path


def write_cryptomatte(folder):
    for n in (0, 1):
        ids = np.choose(masks_of(n), (0, *(name_bits(name) for name in NAMES.values()))).astype(np.uint32)
        covered = (ids > 0).astype(np.float32)
        planes = {"R": ids.view(np.float32), "G": covered, "B": 0 * covered, "A": 0 * covered}
        channels = {f"ViewLayer.CryptoObject00.{channel}": plane for channel, plane in planes.items()}
        attributes = header("ViewLayer.CryptoObject", list(NAMES.values()))
        with OpenEXR.File({**attributes, "type": OpenEXR.scanlineimage}, channels) as file:
            file.write(str(folder / f"photo {n}.exr"))
    return folder


def write_index_pass(folder):
    for n in (0, 1):
        channels = {"ViewLayer.IndexOB.X": masks_of(n).astype(np.float32), "R": np.zeros(SIZE[::-1], np.float32)}
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
            file.write(str(folder / f"photo {n}.exr"))
    return folder


def write_parts(path, passes, attributes):
    """Write an EXR file as Blender does: a part for each pass, with all attributes in the first one."""
    passes = {"ViewLayer.Combined": dict.fromkeys("RGBA", np.zeros(SIZE[::-1], np.float32)), **passes}
    parts = [
        OpenEXR.Part(
            {"type": OpenEXR.scanlineimage, **({} if number else attributes)},
            {f"{name}.{channel}": plane for channel, plane in planes.items()},
            name,
        )
        for number, (name, planes) in enumerate(passes.items())
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(path))


def write_cryptomatte_of_cycles(folder):
    for n in (0, 1):
        ids = np.choose(masks_of(n), (0, *(name_bits(name) for name in NAMES.values()))).astype(np.uint32)
        covered = (ids > 0).astype(np.float32)
        planes = {"r": ids.view(np.float32), "g": covered, "b": 0 * covered, "a": 0 * covered}
        attributes = header("ViewLayer.CryptoObject", list(NAMES.values()))
        write_parts(folder / f"photo {n}.exr", {"ViewLayer.CryptoObject00": planes}, attributes)
    return folder


def write_index_pass_of_blender(folder):
    for n in (0, 1):
        planes = {"Material": np.ones(SIZE[::-1], np.float32), "Object": masks_of(n).astype(np.float32)}
        passes = {f"ViewLayer.{kind} Index": {"X": plane} for kind, plane in planes.items()}
        write_parts(folder / f"photo {n}.exr", passes, {})
    return folder


def write_ids(folder):
    for n in (0, 1):
        Image.fromarray(masks_of(n)).save(folder / f"photo {n}_mask.png")
    (folder / "labels.json").write_text(json.dumps(NAMES))
    return folder


def write_object_folders(folder):
    for i, name in NAMES.items():
        (folder / name).mkdir()
        for n in (0, 1):
            Image.fromarray(255 * (masks_of(n) == i).astype(np.uint8)).save(
                folder / name / f"photo {n}.jpg", quality=95
            )
    return folder


GIVEN = [
    write_coco_polygons, write_coco_runs, write_coco_compressed, write_panoptic, write_cvat_images, write_cvat_video,
    write_label_studio, write_label_studio_of_separate_labels, write_cryptomatte, write_cryptomatte_of_cycles,
    write_index_pass, write_index_pass_of_blender, write_ids, write_object_folders,
]  # fmt: skip


@pytest.mark.parametrize("write", GIVEN)
def test_objects_of_every_format_are_those_that_were_written(write, photos, tmp_path, run_command):
    given = tmp_path / "given"
    given.mkdir()
    path = write(given)
    done = run_command("masks", photos, path, "--json")
    assert done.code == EXIT_DONE, done.err
    labels = json.loads((photos / "labels.json").read_text())
    number = {name: int(i) for i, name in labels.items()}
    if write in (write_index_pass, write_index_pass_of_blender):
        number = {name: i for i, name in NAMES.items()}
    assert set(number) == set(NAMES.values())
    for n in (0, 1):
        found, true = read_mask(photos / "masks" / f"{photo(n)}.png"), masks_of(n)
        for i, name in NAMES.items():
            assert ((found == number[name]) == (true == i)).all(), (n, name)
    assert {"masks.json", "masks.jpg"} <= {each.name for each in (photos / "masks").iterdir()} and not list(
        photos.glob(".objectgs*")
    )


@pytest.mark.parametrize(("left", "top", "right", "bottom"), [(-4, -3, 43, 32), (3, 2, 36, 28)])
def test_photo_is_the_display_window_of_exr_files(left, top, right, bottom, photos, tmp_path):
    """Also of those with overscan, or cropped to what they show."""
    given = tmp_path / "given"
    given.mkdir()
    around = np.pad(masks_of(0), 10)[top + 10 : bottom + 11, left + 10 : right + 11].astype(np.float32)
    windows = {
        "dataWindow": (np.array([left, top], np.int32), np.array([right, bottom], np.int32)),
        "displayWindow": (np.zeros(2, np.int32), np.array(SIZE, np.int32) - 1),
    }
    with OpenEXR.File({"type": OpenEXR.scanlineimage, **windows}, {"IndexOB.X": around}) as file:
        file.write(str(given / "photo 0.exr"))
    assert np.array_equal(open_source(given, photos, [photo(0)]).read(photo(0)).numbers, masks_of(0))


@pytest.mark.parametrize("write", [write_coco_polygons, write_cvat_images, write_label_studio])
def test_photos_that_nobody_has_annotated_get_no_mask(write, photos, tmp_path, run_command):
    """Their objects would be lost otherwise."""
    path = write(tmp_path)
    for number in (2, 3, 4):
        Image.new("RGB", SIZE).save(photos / "images" / photo(number))
    content = path.read_text()
    if write is write_cvat_images:
        more = f'<image id="2" name="{photo(2)}" width="{SIZE[0]}" height="{SIZE[1]}"></image></annotations>'
        path.write_text(content.replace("</annotations>", more))
    else:
        listed = json.loads(content)
        entries = listed["images"] if write is write_coco_polygons else listed
        as_text = json.dumps(entries[1]).replace(photo(1), photo(2))
        more = {**json.loads(as_text), "id": 7, **({} if write is write_coco_polygons else {"annotations": []})}
        entries.append(more)
        path.write_text(json.dumps(listed))
    done = run_command("masks", photos, path)
    assert done.code == EXIT_DONE, done.err
    assert {each.name for each in (photos / "masks").glob("*.png")} == {f"{photo(n)}.png" for n in (0, 1)}


@pytest.mark.parametrize("write", [write_coco_polygons, write_cvat_images, write_label_studio])
def test_annotations_of_two_photos_that_fit_one_are_refused(write, photos, tmp_path):
    """As of the cameras of a rig, of which the capture has one."""
    path = write(tmp_path)
    both = path.read_text().replace(photo(0), f"cam1/{photo(0)}").replace(photo(1), f"cam2/{photo(0)}")
    path.write_text(both.replace("0123abcd-", ""))
    with pytest.raises(InputError, match=f"names both .*cam1/{photo(0)} and .*cam2/{photo(0)}, which fit the same"):
        open_source(path, photos, [photo(0), photo(1)])


@pytest.mark.parametrize("spelling", ["./train\\{}", "TRAIN/{}", "{}", "a/train/{}"])
def test_annotations_of_two_spellings_of_a_photo_are_merged(spelling, photos, tmp_path):
    path = write_coco_polygons(tmp_path)
    content = json.loads(path.read_text())
    for image, name in zip(content["images"], ("train/{}", spelling), strict=True):
        image["file_name"] = name.format(photo(0))
    content["annotations"] = [content["annotations"][0], {**content["annotations"][-1], "image_id": 1}]
    content["annotations"][0]["image_id"] = 0
    path.write_text(json.dumps(content))
    assert len(open_source(path, photos, [photo(0), photo(1)]).read(photo(0)).objects) == 2
    content["images"].append({**content["images"][0], "id": 2, "file_name": f"test/{photo(0)}"})
    content["annotations"].append({**content["annotations"][0], "image_id": 2})
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="which fit the same photo"):
        open_source(path, photos, [photo(0), photo(1)])


def test_regions_of_label_studio_may_share_an_id(photos, tmp_path):
    path = write_label_studio_of_separate_labels(tmp_path)
    tasks = json.loads(path.read_text())
    for result in (each for task in tasks for each in task["annotations"][0]["result"]):
        result["id"] = "1"
    path.write_text(json.dumps(tasks))
    assert set(open_source(path, photos, [photo(0), photo(1)]).read(photo(0)).objects) == set(NAMES.values())


def test_last_upload_of_a_photo_is_taken(photos, tmp_path):
    path = write_label_studio(tmp_path)
    tasks = json.loads(path.read_text())
    for task, image in zip(tasks, ("/data/upload/1/0123abcd-", "/data/upload/2/ef012345-"), strict=True):
        task["data"]["image"] = image + photo(0)
    path.write_text(json.dumps(tasks))
    found = open_source(path, photos, [photo(0)]).read(photo(0)).numbers
    assert ((found > 0) == (masks_of(1) > 0)).mean() > 0.95


def test_photo_without_segments_does_not_refuse_the_others(photos, tmp_path):
    given = tmp_path / "given"
    given.mkdir()
    described = [{"size": list(SIZE[::-1]), "counts": compressed(masks_of(0) == i)} for i in NAMES]
    masks = {"annotations": [{"segmentation": each} for each in described]}
    (given / "photo 0.json").write_text(json.dumps(masks))
    for content in ({"annotations": []}, []):
        (given / "photo 1.json").write_text(json.dumps(content))
        source = open_source(given, photos, [photo(0), photo(1)])
        assert len(source.read(photo(0)).objects) == 2
        empty = source.read(photo(1))
        assert not empty.objects and empty.numbers.shape == SIZE[::-1] and not empty.numbers.any()


@pytest.mark.parametrize(
    ("name", "reference"),
    [
        ("photo 1.jpg", "/data/upload/1/0123abcd-photo_1.jpg"),
        ("photo (1).jpg", "/data/upload/1/0123abcd-photo_1.jpg"),
        ("Übung 1.jpg", "/data/upload/1/0123abcd-%C3%9Cbung_1.jpg"),
        ("photo 1.jpg", "/data/local-files/?d=table/photo%201.jpg"),
        ("photo 1.jpg", "/data/local-files/?d=photo%201.jpg"),
        ("photo 1.jpg", "s3://bucket/photo%201.jpg"),
    ],
)
def test_photos_of_label_studio_have_other_names(tmp_path, name, reference):
    (tmp_path / "images").mkdir()
    Image.new("RGB", SIZE).save(tmp_path / "images" / name)
    path = write_label_studio(tmp_path)
    tasks = json.loads(path.read_text())[:1]
    tasks[0]["data"]["image"] = reference
    path.write_text(json.dumps(tasks))
    source = open_source(path, tmp_path, [name])
    assert source.photos == [name] and len(source.read(name).objects) == 2


def noise():
    """A picture."""
    return Image.fromarray(np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8))


def in_colors(mask):
    """A mask whose IDs are encoded as colors."""
    colors = np.array([[0, 0, 0], *([n, 0, 0] for n in range(1, 256))], np.uint8)
    return Image.fromarray(colors[mask])


@pytest.mark.parametrize("with_word", [True, False])
@pytest.mark.parametrize("encoded", [Image.fromarray, in_colors])
def test_pictures_in_the_folder_of_the_masks_are_no_masks(with_word, encoded, tmp_path):
    """The masks have a word that copies of the photos lack, or pictures of the masks have one."""
    mask, picture = ("photo {}_mask.png", "photo {}.png") if with_word else ("photo {}.png", "photo {}_seg.png")
    for folder in ("images", "given"):
        (tmp_path / folder).mkdir()
    for n in (0, 1):
        noise().save(tmp_path / "images" / f"photo {n}.png")
        noise().save(tmp_path / "given" / picture.format(n))
        encoded(masks_of(n)).save(tmp_path / "given" / mask.format(n))
    source = open_source(tmp_path / "given", tmp_path, [f"photo {n}.png" for n in (0, 1)])
    for n in (0, 1):
        assert (source.read(f"photo {n}.png").numbers == masks_of(n)).all()


def test_frames_of_a_video_are_the_photos_in_the_folder(photos, tmp_path, run_command):
    path = write_cvat_video(tmp_path)
    frames = path.read_text().replace("<task>", "<task><size>{}</size>")
    path.write_text(frames.format(3))
    assert_rejected(run_command("masks", photos, path), "3 frames", "2 photos")
    path.write_text(frames.format(2))
    assert run_command("masks", photos, path).code == EXIT_DONE


def test_frames_of_a_part_of_a_video_are_counted_from_its_first_one(photos, tmp_path, run_command):
    path = write_cvat_video(tmp_path)
    meta = "<task><size>2</size><start_frame>30</start_frame><stop_frame>40</stop_frame>{}"
    content = path.read_text().replace('frame="0"', 'frame="30"').replace('frame="1"', 'frame="40"')
    path.write_text(content.replace("<task>", meta.format("<frame_filter>step=10</frame_filter>")))
    assert run_command("masks", photos, path).code == EXIT_DONE
    for n in (0, 1):
        assert (read_mask(photos / "masks" / f"{photo(n)}.png") == masks_of(n)).all()
    for other in ("<frame_filter/>", "<frame_filter>step=3</frame_filter>", "<frame_filter>step=4</frame_filter>"):
        path.write_text(content.replace("<task>", meta.format(other)))
        assert_rejected(run_command("masks", photos, path), "frame 40", "2 photos")


def test_folders_of_objects_have_those_of_the_photos(photos, tmp_path):
    given = tmp_path / "given"
    for camera in ("left", "right"):
        (photos / "images" / camera).mkdir()
        (given / "mug" / camera).mkdir(parents=True)
        Image.new("RGB", SIZE).save(photos / "images" / camera / "0001.jpg")
        Image.fromarray(255 * masks_of(0)).save(given / "mug" / camera / "0001.png")
    assert open_source(given, photos, ["left/0001.jpg"]).photos == ["left/0001.jpg", "right/0001.jpg"]


@pytest.mark.parametrize(
    ("folders", "files", "are_objects"),
    [(range(1, 4), range(1, 6), True), (range(1, 6), range(4), False), (range(1, 6), range(8), False),
     (range(1, 8), range(1, 6), True), (range(1, 6), range(1, 6), None)],
)  # fmt: skip
def test_folders_of_objects_may_be_numbered_as_photos(folders, files, are_objects, tmp_path):
    (tmp_path / "images").mkdir()
    for n in range(1, 6):
        Image.new("RGB", SIZE).save(tmp_path / "images" / f"{n}.jpg")
    for folder in folders:
        (tmp_path / "given" / str(folder)).mkdir(parents=True)
        for file in files:
            Image.fromarray(masks_of(0) == 1).save(tmp_path / "given" / str(folder) / f"{file}.png")
    source = open_source(tmp_path / "given", tmp_path, [f"{n}.jpg" for n in range(1, 6)])
    if are_objects is None:
        with pytest.raises(InputError, match="may be those of photos or of objects"):
            source.read("1.jpg")
    else:
        assert len(source.photos) == 5 and source.what.endswith("object" if are_objects else "photo")
        assert len(source.read("1.jpg").names) == len(folders if are_objects else files)


def test_255_is_white_only_where_all_masks_are_black_and_white(photos, tmp_path):
    for values, expected in (((0, 255), {1}), ((0, 85, 255), {85, 255})):
        given = tmp_path / str(len(values))
        given.mkdir()
        Image.fromarray(np.array(values, np.uint8)[masks_of(0) % len(values)]).save(given / "photo 0.png")
        Image.fromarray(np.resize(np.array([0, 255], np.uint8), SIZE[::-1])).save(given / "photo 1.png")
        source = open_source(given, photos, [photo(0), photo(1)])
        assert {key for n in (0, 1) for key in source.read(photo(n)).objects} == expected


@pytest.mark.parametrize("white", [255, 65535])
def test_soft_edges_of_black_and_white_masks_are_no_ids(white, photos, tmp_path):
    distance = np.hypot(*np.mgrid[-15:15, -20:20])
    for n, radius in enumerate((12, 8.6)):
        soft = np.clip(radius - distance + 0.5, 0, 1) * white
        Image.fromarray(soft.astype(np.min_scalar_type(white))).save(tmp_path / f"photo {n}.png")
    source = open_source(tmp_path, photos, [photo(0), photo(1)])
    for n, radius in enumerate((12, 8.6)):
        found = source.read(photo(n))
        assert found.objects == [1] and ((found.numbers == 1) == (distance < radius)).mean() > 0.98
    shades = np.linspace(0, white, SIZE[0] * SIZE[1]).astype(np.min_scalar_type(white))
    Image.fromarray(shades.reshape(SIZE[::-1])).save(tmp_path / "photo 0.png")
    with pytest.raises(InputError, match="not black and white"):
        open_source(tmp_path, photos, [photo(0), photo(1)]).read(photo(0))


def test_thin_objects_beside_255_are_no_soft_edges(photos, tmp_path):
    wires = np.zeros(SIZE[::-1], np.uint8)
    wires[20:22], wires[26:28], wires[5:15, 5:30] = 1, 2, 255
    parts = np.zeros_like(wires)
    parts[:8], parts[10:28] = 255, np.arange(1, 61).reshape(6, 10).repeat(3, 0).repeat(4, 1)
    parts[10::3] = parts[:, ::4] = 0
    outlined = np.zeros_like(wires)
    outlined[5:15, 5:30], outlined[6:14, 6:29] = 100, 255
    for n, ids in enumerate((wires, parts, outlined)):
        given = tmp_path / str(n)
        given.mkdir()
        for name in (photo(0), photo(1)):
            Image.fromarray(ids).save(given / f"{name}.png")
        assert set(open_source(given, photos, [photo(0), photo(1)]).read(photo(0)).objects) == {*ids.flat} - {0}


@pytest.mark.parametrize("are_together", [True, False])
@pytest.mark.parametrize("colors", [((255, 0, 0), (255, 255, 0)), (255, 65535)])
def test_two_values_of_white_are_ids(colors, are_together, photos, tmp_path):
    for n in range(2):
        shape, kind = ((*SIZE[::-1], 3), np.uint8) if isinstance(colors[0], tuple) else (SIZE[::-1], np.uint16)
        ids = np.zeros(shape, kind)
        for m, color in enumerate(colors):
            if are_together or m == n:
                ids[5:15, 20 * m : 20 * m + 10] = color
        Image.fromarray(ids).save(tmp_path / f"photo {n}.png")
    source = open_source(tmp_path, photos, [photo(0), photo(1)])
    expected = [[255, 65535]] * 2 if are_together else [[255], [65535]]
    assert [source.read(photo(n)).objects for n in range(2)] == expected


def test_masks_of_a_missing_photo_are_left_out(write_capture, tmp_path, run_command):
    scene = write_capture(views=6)
    given = (scene.folder / "masks").rename(tmp_path / "given")
    (scene.folder / "images" / scene.names[2]).unlink()
    assert run_command("masks", scene.folder, given, "--objects", "given").code == EXIT_DONE
    assert len(list((scene.folder / "masks").glob("*.png"))) == 5


def test_photos_may_be_spelled_differently_in_the_model(write_capture, tmp_path, run_command):
    scene = write_capture(views=6)
    given = (scene.folder / "masks").rename(tmp_path / "given")
    for path in (scene.folder / "images").iterdir():
        path.rename(path.with_name(path.name.upper()))
    done = run_command("masks", scene.folder, given)
    assert done.code == EXIT_DONE, done.err
    assert len(list((scene.folder / "masks").glob("*.png"))) == 6
    assert load_capture(scene.folder, tmp_path / "cache").has_masks


def test_imported_masks_of_few_photos_can_be_used(write_capture, tmp_path, run_command):
    scene = write_capture(views=6)
    given = (scene.folder / "masks").rename(tmp_path / "given")
    for path in sorted(given.glob("*.png"))[2:]:
        path.unlink()
    assert run_command("masks", scene.folder, given, "--objects", "given").code == EXIT_DONE
    result = run_command("vote", scene.folder, "--out", tmp_path / "out")
    assert result.code == EXIT_DONE and "have no mask" in result.err + result.out


@pytest.mark.parametrize("masks", ["images/photo {}_mask.jpg", "masks/photo {}.jpg"])
def test_black_and_white_jpegs_become_masks_of_the_capture(photos, tmp_path, masks):
    (photos / "masks").mkdir()
    for n in (0, 1):
        Image.fromarray(255 * (masks_of(n) > 0).astype(np.uint8)).save(photos / masks.format(n), quality=90)
    taken = take_photos([photos], tmp_path / "new", None, Reporter())
    assert [each.name for each in taken.photos] == [photo(0), photo(1)]
    assert not list((tmp_path / "new" / "masks").glob("*.jpg"))
    for n in (0, 1):
        assert (read_mask(tmp_path / "new" / "masks" / f"{photo(n)}.png") == (masks_of(n) > 0)).all()


def test_masks_without_identities_need_points(photos, tmp_path, run_command):
    for n in (0, 1):
        folder = tmp_path / "given" / f"photo {n}"
        folder.mkdir(parents=True)
        for i in NAMES:
            Image.fromarray(255 * (masks_of(n) == i).astype(np.uint8)).save(folder / f"{i}.png")
    found = open_source(tmp_path / "given", photos, [photo(0), photo(1)])
    assert found.read(photo(0)).objects == [None, None] and found.photos == [photo(0), photo(1)]
    assert_rejected(run_command("masks", photos, tmp_path / "given"), "do not say which segments", "run `sfm`")
    assert not (photos / "masks").exists()


def damaged(content, change):
    copy = json.loads(json.dumps(content))
    change(copy)
    return copy


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c["annotations"][0].update(segmentation={"size": [30, 40], "counts": [5, 6]}),
        lambda c: c["annotations"][0].update(segmentation={"size": [30, 40], "counts": "00"}),
        lambda c: c["annotations"][0].update(segmentation={"size": [30, 40], "counts": "\u00ff~~"}),
        lambda c: c["annotations"][0].update(segmentation={"size": [3, 4], "counts": [12]}),
        lambda c: c["annotations"][0].update(segmentation=[[1, 2, 3]]),
        lambda c: c["images"][0].update(width=-1),
        lambda c: c["images"][0].pop("file_name"),
        lambda c: c.update(categories=[3]),
        lambda c: c["images"][0].update(width=20),
        lambda c: c.update(annotations=[]),
    ],
)
def test_damaged_files_are_refused_and_leave_nothing(change, photos, tmp_path, run_command):
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(damaged(coco(as_polygon), change)))
    done = run_command("masks", photos, path)
    assert done.code == EXIT_BAD_INPUT and str(path) in done.err, done.err
    assert sorted(each.name for each in photos.iterdir()) == ["images"]


def test_masks_of_other_photos_and_of_no_known_kind_are_refused(photos, tmp_path, run_command):
    content = coco(as_polygon)
    for number, image in enumerate(content["images"]):
        image["file_name"] = f"other{number}.jpg"
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(content))
    assert_rejected(run_command("masks", photos, path), "has masks of none of the 2 photos")
    path.write_text("{}")
    assert_rejected(run_command("masks", photos, path), "is not a file of masks")
    path.write_text("{")
    assert_rejected(run_command("masks", photos, path), "is not valid JSON")
    (tmp_path / "bomb.xml").write_text('<!DOCTYPE a [<!ENTITY b "b">]><annotations/>')
    assert_rejected(run_command("masks", photos, tmp_path / "bomb.xml"), "DTD")
    assert_rejected(run_command("masks", photos, tmp_path / "none"), "does not exist")
    (tmp_path / "meta").mkdir()
    model = tmp_path / "meta" / "sam_vit_h_4b8939.pth"
    model.touch()
    (tmp_path / "with config").mkdir()
    for name, content in (("model.pth", ""), ("config.json", "{}")):
        (tmp_path / "with config" / name).write_text(content)
    for path in (model, model.parent, tmp_path / "with config"):
        assert_rejected(run_command("masks", photos, path), str(path), "which cannot be read; download all files of")


def test_masks_of_somebody_else_are_not_replaced(photos, tmp_path, run_command):
    given = tmp_path / "given"
    given.mkdir()
    write_ids(given)
    assert run_command("masks", photos, given).code == run_command("masks", photos, given).code == EXIT_DONE
    for name, content in (("masks.json", '{"tool": "another", "objects": []}'), ("repair.json", "[]")):
        (photos / "masks" / "masks.json").unlink()
        (photos / "masks" / name).write_text(content)
        before = sorted((photos / "masks").iterdir())
        assert_rejected(run_command("masks", photos, given), "exists; move it elsewhere")
        assert sorted((photos / "masks").iterdir()) == before
    (photos / "masks" / "masks.json").write_text("{}")
    assert run_command("masks", photos, photos / "masks").code == EXIT_DONE
    assert {"masks.json", "repair.json"} < {path.name for path in (photos / "masks-given").iterdir()}


def listed(capture):
    """What masks.json has as the names of the objects, by ID."""
    record = json.loads((capture / "masks" / "masks.json").read_text())
    return {entry["id"]: entry["name"] for entry in record["objects"]}


@pytest.mark.parametrize("tracks", ["0 1", "3 4"])
def test_tracked_objects_keep_their_ids(tracks, photos, tmp_path, run_command):
    """A track that is removed changes no ID of the others, which would meet the edits of other objects."""
    first, second = map(int, tracks.split())
    content = coco(compressed)
    content["annotations"] = [
        {**each, "segmentation": {"size": list(SIZE[::-1]), "counts": each["segmentation"]}}
        for each in content["annotations"]
    ]
    for each in content["annotations"]:
        each["track_id"] = first if each["category_id"] == 10 else second
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(content))
    assert run_command("masks", photos, path).code == EXIT_DONE
    before = listed(photos)
    content["annotations"] = [each for each in content["annotations"] if each["category_id"] == 20]
    path.write_text(json.dumps(content))
    done = run_command("masks", photos, path, "--json")
    assert done.code == EXIT_DONE and listed(photos) == {i: name for i, name in before.items() if name == "box"}
    assert not done.messages("warning")


def test_tracks_of_cvat_keep_their_ids(photos, tmp_path, run_command):
    path = write_cvat_video(tmp_path)
    assert run_command("masks", photos, path).code == EXIT_DONE
    before = listed(photos)
    assert run_command("masks", photos, path).code == EXIT_DONE
    assert listed(photos) == before == {1: "mug", 2: "box"}


def test_objects_keep_the_names_that_the_masks_do_not_say(photos, tmp_path, run_command):
    """Also those of a labels.json that somebody has changed."""
    given = tmp_path / "given"
    given.mkdir()
    (write_ids(given) / "labels.json").unlink()
    labels = photos / "labels.json"
    labels.write_text('{"1": "mug", "9": "spoon"}')
    assert run_command("masks", photos, given).code == EXIT_DONE
    assert listed(photos) == {1: "mug", 2: "object 2"}
    assert json.loads((photos / "labels-given.json").read_text()) == {"1": "mug", "9": "spoon"}
    labels.write_text('{"1": "mug", "2": "box"}')
    assert run_command("masks", photos, given).code == EXIT_DONE
    assert listed(photos) == NAMES and json.loads(labels.read_text()) == {"1": "mug", "2": "box"}
    assert json.loads((photos / "labels-given.json").read_text()) == {"1": "mug", "9": "spoon"}


@pytest.mark.parametrize("objects", ["given", "find"])
def test_names_beside_given_masks_are_those_of_their_ids(objects, write_capture, run_command):
    """Later names of labels.json are those of the same IDs only where these were kept."""
    folder = write_capture(views=6, points=200).folder
    labels = folder / "labels.json"
    labels.write_text('{"1": "spoon", "9": "fork"}')
    assert run_command("masks", folder, folder / "masks", "--objects", objects).code == EXIT_DONE
    assert (folder / "masks-given" / "labels.json").exists() == (objects == "find")
    assert (folder / "labels-given.json").exists() == (objects == "given")
    labels.write_text('{"1": "mug"}')
    assert run_command("masks", folder, folder / "masks-given", "--objects", "given").code == EXIT_DONE
    assert listed(folder)[1] == ("mug" if objects == "given" else "spoon")


@pytest.mark.parametrize("labels", [None, "1 mug\n2 box\n5 can\n"])
def test_objects_that_are_found_again_in_kept_masks_keep_their_names(labels, write_capture, run_command):
    """The names in labels.json are those of IDs that these masks do not have."""
    folder = write_capture(views=6, points=200).folder
    (folder / "labels.json").unlink()
    if labels is not None:
        (folder / "labels.txt").write_text(labels)
    for number, path in enumerate(sorted((folder / "masks").iterdir())):
        order = [5, 1, 2] if number else [2, 5, 1]
        Image.fromarray(np.array([0, *order[:2], 0, 0, order[2]], np.uint8)[read_mask(path)]).save(path)
    assert run_command("masks", folder, folder / "masks", "--objects", "find").code == EXIT_DONE
    before = listed(folder)
    assert len(set(before.values())) == 3
    assert run_command("masks", folder, folder / "masks-given", "--objects", "find").code == EXIT_DONE
    assert listed(folder) == before


def test_names_of_other_ids_are_not_taken(photos, tmp_path, run_command):
    (photos / "labels.json").write_text('{"1": "spoon", "2": "fork"}')
    path = write_cvat_video(tmp_path)
    path.write_text(path.read_text().replace(' label="mug"', "").replace(' label="box"', ""))
    assert run_command("masks", photos, path).code == EXIT_DONE
    assert listed(photos) == {1: "object 1", 2: "object 2"}
    assert json.loads((photos / "labels-given.json").read_text()) == {"1": "spoon", "2": "fork"}


def test_ids_that_were_those_of_other_objects_are_told(photos, tmp_path, run_command):
    for name in ("given", "other"):
        (tmp_path / name).mkdir()
        write_ids(tmp_path / name)
    assert run_command("masks", photos, tmp_path / "given").code == EXIT_DONE
    (tmp_path / "other" / "labels.json").unlink()
    for n in (0, 1):
        exchanged = np.array([0, 2, 1, 3], np.uint8)[masks_of(n)]
        exchanged[:2, :2] = 3
        Image.fromarray(exchanged).save(tmp_path / "other" / f"photo {n}_mask.png")
    done = run_command("masks", photos, tmp_path / "other", "--json")
    (warning,) = done.messages("warning")
    assert "other objects with the IDs 1, 2, whose edits" in warning
    assert listed(photos) == {1: "object 1", 2: "object 2", 3: "object 3"}, "names are not those of other objects"
    again = run_command("masks", photos, tmp_path / "other", "--json")
    assert again.code == EXIT_DONE and not again.messages("warning")


def test_shapes_measure_from_the_edges_of_pixels():
    box = polygon([(10, 5), (20, 5), (20, 15), (10, 15)], SIZE)
    assert box[5:15, 10:20].all() and box.sum() == 100
    assert (box == polygon([(9.6, 4.6), (20.4, 4.6), (20.4, 15.4), (9.6, 15.4)], SIZE)).all()
    assert not polygon([(1, 1), (30, 25)], SIZE).any() and not polygon([], SIZE).any()
    outside = [(-1e300, -1e300), (1e300, -1e300), (1e300, 1e300), (-1e300, 1e300)]
    assert polygon(outside, SIZE).all() and not polygon([(50, 5), (60, 5), (60, 15)], SIZE).any()


def test_shapes_that_touch_share_no_pixel():
    rng = np.random.default_rng(0)
    border = [(0, 0), (20, 0), (40, 0), (40, 15), (40, 30), (20, 30), (0, 30), (0, 15)]
    for center in [(20, 15), (20.5, 15.5), *rng.uniform((1, 1), (39, 29), (20, 2)).tolist()]:
        parts = [polygon([a, b, center], SIZE) for a, b in zip(border, border[1:] + border[:1])]
        assert (np.sum(parts, 0) == 1).all()


def test_segments_take_no_more_memory_than_their_boxes():
    large, small, none = (np.zeros((300, 400), bool) for _ in range(3))
    large[10:90, 20:60], small[50:70, 30:50] = True, True
    shapes = [Shape.of(small, "b", "box"), Shape.of(none, "c", ""), Shape.of(large, "a", "mug")]
    assert sum(shape.inside.size for shape in shapes) == 80 * 40 + 20 * 20
    drawn = draw_shapes(shapes, (400, 300))
    assert drawn.objects == ["a", "b"] and drawn.names == ["mug", "box"]
    assert np.array_equal(drawn.numbers, large + small.astype(np.int32))


def test_decoders_refuse_what_does_not_fit():
    with pytest.raises(ValueError, match="whole numbers"):
        run_lengths([-1, 13], (4, 3))
    with pytest.raises(ValueError, match="ends too early"):
        unpack(packed([7] * 40)[:-4], 40)
    assert unpack(packed([7] * 40 + [1, 2, 3]), 43).tolist() == [7] * 40 + [1, 2, 3]
    with pytest.raises(ValueError, match="expected 12"):
        unpack(packed([7] * 40), 12)


def test_gray_jpeg_is_no_mask(photos, tmp_path):
    given = tmp_path / "given"
    given.mkdir()
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, SIZE[::-1], np.uint8)).save(given / "photo 0.jpg")
    with pytest.raises(InputError, match="not black and white"):
        open_source(given, photos, [photo(0)]).read(photo(0))
