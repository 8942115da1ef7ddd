"""The paper's datasets: miniatures of their layouts as captures, the scores, and the tables."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from backend.capture import check_capture, load_capture
from backend.capture.capture import HOLDOUT_EVERY
from backend.evaluation import evaluate
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_DONE, InputError
from benchmarks import reproduce
from benchmarks.protocols import lerf_mask, metrics, replica, scannetpp, three_d_ovs
from benchmarks.protocols.metrics import PromptScore, Results

SPHERES = [(1, (-0.7, 0.0, 0.0), 0.5), (2, (0.7, 0.1, 0.0), 0.45), (5, (0.0, -0.2, 0.9), 0.35)]
BACKGROUND = (0, (0.0, 0.9, 0.0), 0.45)
PROMPTS = {"green apple": 1, "old camera": 2, "cup": 5}
FISHEYE = [38.0, 38.0, 32.0, 24.0, 0.02, -0.01, 0.0, 0.0]


def loaded(folder, tmp_path):
    """Load a converted capture, which must have no problem."""
    assert check_capture(folder)["problems"] == []
    return load_capture(folder, tmp_path / "cache")


def names_of(capture, indices):
    return [capture.views[i].name for i in indices]


def save_prompts(folder, ids, shape=None):
    """Write the mask of each prompt that an ID map shows."""
    folder.mkdir(parents=True)
    for prompt, object_id in PROMPTS.items():
        if (ids == object_id).any():
            mask = Image.fromarray((ids == object_id).astype(np.uint8) * 255)
            (mask if shape is None else mask.resize(shape, Image.Resampling.NEAREST)).save(folder / f"{prompt}.png")


def results_of(scene, change=lambda ids: ids, points=None):
    """Results of a renderer that shows the true IDs, changed by a function."""
    ids = dict(zip(scene.names, scene.ids))
    return Results(lambda view: change(ids[view]), {}, points or {"anchors": {}, "splats": {}})


# --- scores ----------------------------------------------------------------------------------------------------------


def test_binary_iou_by_hand():
    truth, found = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert metrics.binary_iou(found, truth) == metrics.binary_boundary_iou(found, truth) == 1
    truth[:, 1:3] = True
    assert metrics.binary_iou(found, truth) == 0
    found[:, :2] = True
    assert metrics.binary_iou(found, truth) == 4 / 12


def test_binary_boundary_iou_by_hand():
    truth, found = np.zeros((100, 100), bool), np.zeros((100, 100), bool)
    truth[40:60, 40:60] = found[40:60, 41:61] = True
    # The band is 3 pixels wide, 2% of a diagonal of 141. The squares share 20 x 19 pixels, and the union of their
    # interiors is 14 x 15.
    band, both = 20 * 20 - 14 * 14, 20 * 19 - 14 * 15
    assert metrics.binary_boundary_iou(found, truth) == both / (2 * band - both)
    assert metrics.binary_boundary_iou(np.ones_like(truth), np.ones_like(truth)) == 1
    whole = np.ones_like(truth)
    assert metrics.binary_boundary_iou(truth, whole) == 0, "the image's border is part of the whole frame's boundary"


def test_prompts_get_the_object_with_the_largest_iou():
    ids, mask = np.zeros((6, 6), int), np.zeros((6, 6), bool)
    mask[0, :4] = True
    ids[:, :3] = 7  # covers 3 pixels of the mask, and 15 others
    ids[0, 3:5] = 9  # covers 1 pixel of the mask, and 1 other
    assert metrics.associated(ids, mask) == 9
    assert metrics.associated(np.zeros((6, 6), int), mask) is None, "0 is no object"


def test_prompts_keep_the_object_of_their_first_view():
    one, two = np.zeros((8, 8), int), np.zeros((8, 8), int)
    one[:4], two[4:] = 3, 3
    two[:4] = 4
    upper = one == 3
    truth = {"a": {"upper": upper}, "b": {"upper": upper, "lower": ~upper}}
    scores = metrics.score_prompts({"a": one, "b": two}.__getitem__, truth)
    assert [(s.prompt, s.view, s.object_id, s.is_first, s.iou) for s in scores] == [
        ("upper", "a", 3, True, 1.0),
        ("upper", "b", 3, False, 0.0),
        ("lower", "b", 3, True, 1.0),
    ]


def test_means_over_prompts_and_over_all():
    scores = [
        PromptScore("a", "0", 1, True, 1.0, 0.5), PromptScore("a", "1", 1, False, 0.5, 0.5),
        PromptScore("b", "0", 2, True, 0.25, 0.25),
    ]  # fmt: skip
    assert metrics.mean_over_prompts(scores, "iou") == (0.75 + 0.25) / 2
    assert metrics.mean_over_prompts(scores, "biou") == (0.5 + 0.25) / 2
    assert metrics.mean_over_prompts([], "iou") is None and metrics.mean([]) is None
    assert metrics.prompt_rows(scores)[0] == {"prompt": "a", "id": 1, "views": 2, "iou": 0.75, "biou": 0.5}


def test_instances_by_hand():
    truth = {1: np.array([[0.0, 0, 0], [1, 0, 0]]), 2: np.array([[9.0, 9, 9]])}
    found = {1: np.array([[0.0, 0, 0.01], [1, 0, 0.05], [5, 0, 0]]), 3: np.zeros((4, 3))}
    scores = metrics.score_instances(found, truth)
    assert scores["chamfer"] == pytest.approx(((0.01 + 0.05 + 4) / 3 + (0.01 + 0.05) / 2) / 2)
    assert scores["precision"] == pytest.approx(1 / 3 / 2) and scores["recall"] == pytest.approx(1 / 2 / 2)
    assert scores["f1"] == pytest.approx(2 * (1 / 3) * (1 / 2) / (1 / 3 + 1 / 2) / 2)
    assert scores["missing"] == 1, "the object without points"
    exact = metrics.score_instances(truth, truth)
    assert exact == {"chamfer": 0, "precision": 1, "recall": 1, "f1": 1, "missing": 0}
    far = metrics.score_instances({2: np.array([[0.0, 0, 0]])}, {2: truth[2]})
    assert far["f1"] == 0 and far["missing"] == 0


# --- LERF-Mask -------------------------------------------------------------------------------------------------------


@pytest.fixture
def lerf(write_capture):
    """A scene in the layout of LERF-Mask, with the test views 2 and 7, whose masks are in the folders 41 and 105."""
    scene = write_capture(name="figurines", views=9, size=(64, 48), spheres=[*SPHERES, BACKGROUND])
    (scene.folder / "masks").rename(scene.folder / "object_mask")
    (scene.folder / "images_train").mkdir()
    (scene.folder / "labels.json").unlink()
    for index, name in enumerate(scene.names):
        if index not in (2, 7):
            shutil.copy(scene.folder / "images" / name, scene.folder / "images_train" / name)
    for number, index in ((41, 2), (105, 7)):
        save_prompts(scene.folder / "test_mask" / str(number), scene.ids[index])
    return scene


def test_lerf_mask_becomes_a_capture(lerf, tmp_path):
    folder = tmp_path / "converted"
    lerf_mask.convert(lerf.folder, folder)
    capture = loaded(folder, tmp_path)
    assert names_of(capture, capture.test_indices) == ["view_002.png", "view_007.png"]
    for i, view in enumerate(capture.views):
        np.testing.assert_allclose(view.viewmat, lerf.viewmats[i], atol=1e-12)
        if i in capture.test_indices:
            assert view.mask_file is None, "masks of test views are not trained on"
        else:
            np.testing.assert_array_equal(capture.mask(i), lerf.ids[i])
    np.testing.assert_array_equal(capture.points.xyz, lerf.xyz)


def test_lerf_mask_masks_belong_to_views_by_number_or_name(lerf):
    by_number = lerf_mask.true_masks(lerf.folder)
    masks = lerf.folder / "test_mask"
    (masks / "41").rename(masks / "view_002")
    (masks / "105").rename(masks / "view_007")
    by_name = lerf_mask.true_masks(lerf.folder)
    for found in (by_number, by_name):
        assert list(found) == ["view_002.png", "view_007.png"]
        for view, index in (("view_002.png", 2), ("view_007.png", 7)):
            for prompt, mask in found[view].items():
                np.testing.assert_array_equal(mask, lerf.ids[index] == PROMPTS[prompt])


def test_lerf_mask_scores(lerf, tmp_path):
    folder = tmp_path / "converted"
    lerf_mask.convert(lerf.folder, folder)
    exact = lerf_mask.measure(lerf.folder, folder, results_of(lerf))
    assert all(exact[key] == 100 for key in lerf_mask.FIGURES)
    assert {row["prompt"]: row["id"] for row in exact["prompts"]} == PROMPTS
    renumbered = lerf_mask.measure(lerf.folder, folder, results_of(lerf, lambda ids: np.where(ids > 0, 9 - ids, 0)))
    assert renumbered["miou"] == 100 and {row["id"] for row in renumbered["prompts"]} == {8, 7, 4}

    def halved(ids):
        return np.where(np.arange(64) % 2, ids, 0)

    half = lerf_mask.measure(lerf.folder, folder, results_of(lerf, halved))
    of_prompts = [
        np.mean([metrics.binary_iou(halved(lerf.ids[i]) == object_id, lerf.ids[i] == object_id) for i in (2, 7)])
        for object_id in PROMPTS.values()
    ]
    assert half["miou"] == pytest.approx(100 * np.mean(of_prompts)) and 40 < half["miou"] < 60
    assert half["mbiou"] < 60


def test_lerf_mask_masks_follow_distorted_photos(write_capture, tmp_path):
    """Masks of distorted photos are compared where the undistorted views show them."""
    scene = write_capture(views=9, size=(64, 48), model="SIMPLE_RADIAL", params=[60, 32, 24, 0.1])
    (scene.folder / "masks").rename(scene.folder / "object_mask")
    (scene.folder / "images_train").mkdir()
    for name in scene.names[1:]:
        shutil.copy(scene.folder / "images" / name, scene.folder / "images_train")
    save_prompts(scene.folder / "test_mask" / "0", scene.ids[0])
    lerf_mask.convert(scene.folder, tmp_path / "converted")
    view = load_capture(tmp_path / "converted", tmp_path / "cache").views[0]
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T
    ids, _ = write_capture.sphere_ids(rays, view.viewmat, SPHERES)
    figures = lerf_mask.measure(scene.folder, tmp_path / "converted", Results(lambda _: ids, {}, {}))
    assert figures["miou"] > 90 and figures["miou_others"] is None, "there is one test view"


def test_lerf_mask_photos_that_are_absent_are_no_test_views(lerf):
    (lerf.folder / "images" / "view_002.png").unlink()
    shutil.rmtree(lerf.folder / "test_mask" / "41")
    assert list(lerf_mask.true_masks(lerf.folder)) == ["view_007.png"]


def test_incomplete_lerf_mask_is_refused(lerf, tmp_path):
    (lerf.folder / "test_mask" / "7").mkdir()
    with pytest.raises(InputError, match="3 folders for 2 test views"):
        lerf_mask.true_masks(lerf.folder)
    shutil.rmtree(lerf.folder / "object_mask")
    with pytest.raises(InputError, match="object_mask does not exist"):
        lerf_mask.convert(lerf.folder, tmp_path / "converted")


# --- 3D-OVS ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def ovs(write_capture):
    """A scene in the layout of 3D-OVS, with the test views 0 and 4, and the COLMAP model beside the photos."""
    scene = write_capture(name="bed", views=9, size=(64, 48))
    (scene.folder / "labels.json").unlink()
    for path in (scene.folder / "sparse" / "0").iterdir():
        path.rename(scene.folder / path.name)
    shutil.rmtree(scene.folder / "sparse")
    for index in (0, 4):
        save_prompts(scene.folder / "segmentations" / f"{index:02d}", scene.ids[index], (128, 96))
    (scene.folder / "segmentations" / "classes.txt").write_text("\n".join([*PROMPTS, "sofa"]) + "\n")
    return scene


def test_3d_ovs_becomes_a_capture(ovs, tmp_path):
    three_d_ovs.convert(ovs.folder, tmp_path / "converted")
    capture = loaded(tmp_path / "converted", tmp_path)
    assert names_of(capture, capture.test_indices) == ["view_000.png", "view_004.png"]
    for i in capture.train_indices:
        np.testing.assert_array_equal(capture.mask(i), ovs.ids[i])
        np.testing.assert_allclose(capture.views[i].viewmat, ovs.viewmats[i], atol=1e-12)


def test_3d_ovs_scores(ovs, tmp_path):
    three_d_ovs.convert(ovs.folder, tmp_path / "converted")
    exact = three_d_ovs.measure(ovs.folder, tmp_path / "converted", results_of(ovs))
    assert exact["miou"] == exact["miou_others"] == 100

    def without_cup(ids):
        return np.where(ids == 5, 0, ids)

    shown = [(i, name) for i in (0, 4) for name in PROMPTS if (ovs.ids[i] == PROMPTS[name]).any()]
    found = three_d_ovs.measure(ovs.folder, tmp_path / "converted", results_of(ovs, without_cup))
    assert found["miou"] == pytest.approx(100 * np.mean([name != "cup" for _, name in shown]))
    assert {row["prompt"]: row["id"] for row in found["prompts"]} == {**PROMPTS, "cup": None}


def test_3d_ovs_without_masks_is_refused(ovs, tmp_path):
    shutil.rmtree(ovs.folder / "masks")
    with pytest.raises(InputError, match=r"object_mask does not exist; .* no object IDs"):
        three_d_ovs.convert(ovs.folder, tmp_path / "converted")


# --- Replica ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def rooms(write_capture, tmp_path):
    """A scene in the layout of Semantic-NeRF's Replica, of 20 frames, and its exact data."""
    scene = write_capture(views=20, size=(64, 48), params=[32, 32, 32, 24])
    sequence = tmp_path / "office_0" / "Sequence_1"
    for name in ("rgb", "depth", "semantic_instance"):
        (sequence / name).mkdir(parents=True)
    for i, name in enumerate(scene.names):
        shutil.copy(scene.folder / "images" / name, sequence / "rgb" / f"rgb_{i}.png")
        depth = np.where(np.isfinite(scene.depths[i]), np.rint(1000 * scene.depths[i]), 0)
        Image.fromarray(depth.astype(np.uint16)).save(sequence / "depth" / f"depth_{i}.png")
        ids = scene.ids[i].astype(np.int16)
        ids[0, 0] = -1
        Image.fromarray(ids.view(np.uint16)).save(sequence / "semantic_instance" / f"semantic_instance_{i}.png")
    np.savetxt(sequence / "traj_w_c.txt", [np.linalg.inv(viewmat).ravel() for viewmat in scene.viewmats])
    return tmp_path / "office_0", scene


def test_replica_becomes_a_capture(rooms, tmp_path):
    folder, scene = rooms
    replica.convert(folder, tmp_path / "converted", every=2)
    capture = loaded(tmp_path / "converted", tmp_path)
    assert names_of(capture, range(10)) == [f"rgb_{i:05d}.png" for i in range(0, 20, 2)], "in the order of the frames"
    assert capture.test_indices == (0, HOLDOUT_EVERY)
    for at, view in enumerate(capture.views):
        np.testing.assert_allclose(view.viewmat, scene.viewmats[2 * at], atol=1e-9)
        np.testing.assert_array_equal(view.K, [[32, 0, 32], [0, 32, 24], [0, 0, 1]])
        np.testing.assert_array_equal(capture.mask(at), scene.ids[2 * at])
    off = np.abs([np.linalg.norm(capture.points.xyz - center, axis=1) - radius for _, center, radius in SPHERES])
    assert off.min(0).max() < 0.002, "all points are on a surface"
    assert set(off.argmin(0)) == {0, 1, 2}, "on each one"


def test_replica_has_limited_points_of_the_training_frames(rooms, tmp_path, monkeypatch):
    folder, _ = rooms
    monkeypatch.setattr(replica, "MOST_POINTS", 90)
    replica.convert(folder, tmp_path / "converted")
    capture = loaded(tmp_path / "converted", tmp_path)
    assert len(capture) == 4 and len(capture.points.xyz) == 90
    view, trained = capture.views[1], capture.points.xyz[:30]
    seen = trained @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    column, row = np.floor(seen[:, :2] / seen[:, 2:] * 32 + [32, 24]).astype(int).T
    np.testing.assert_array_equal(capture.image(1)[row, column], capture.points.rgb[:30])


def test_replica_scores_are_those_of_evaluate(rooms, tmp_path):
    folder, _ = rooms
    replica.convert(folder, tmp_path / "converted")
    capture = load_capture(tmp_path / "converted", tmp_path / "cache")
    quality = evaluate(capture, lambda i: (capture.image(i) / 255 + 0.01, capture.mask(i)), capture.test_indices)[
        "quality"
    ]
    figures = replica.measure(folder, tmp_path / "converted", Results(lambda _: np.zeros(0), quality, {}))
    assert figures["miou"] == figures["dice"] == figures["accuracy"] == 100
    assert 35 < figures["psnr"] < 45 and figures["ssim"] > 0.8


# --- ScanNet++ -------------------------------------------------------------------------------------------------------


def write_scans(folder):
    """Write the spheres as a labeled mesh: two segments each, objectIds 8, 6 and 7, and a fourth one without object."""
    spheres = [*SPHERES, (0, (0.0, 1.0, 0.0), 0.2)]
    parts = []
    for _, center, radius in spheres:
        part = trimesh.creation.icosphere(subdivisions=4, radius=radius)
        part.apply_translation(center)
        parts.append(part)
    segments = np.concatenate([
        10 * at + (part.vertices[:, 0] > center[0]).astype(int)
        for at, (part, (_, center, _)) in enumerate(zip(parts, spheres))
    ])  # fmt: skip
    folder.mkdir(parents=True)
    trimesh.util.concatenate(parts).export(folder / "mesh_aligned_0.05.ply")
    (folder / "segments.json").write_text(json.dumps({"segIndices": segments.tolist()}))
    groups = [
        {"objectId": object_id, "label": label, "segments": [10 * at, 10 * at + 1]}
        for at, (object_id, label) in enumerate([(8, "chair"), (6, "table"), (7, "chair")])
    ]
    (folder / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))


# Objects are numbered by objectId.
NUMBER_OF = {1: 3, 2: 1, 5: 2}


@pytest.fixture
def scan(write_capture, tmp_path):
    """Function that writes a scene in the layout of ScanNet++ with a folder of photos, and returns it with the data."""

    def make(photos="resized_images", **lens):
        scene = write_capture(views=9, size=(64, 48), suffix=".txt", **lens)
        dslr = tmp_path / "0a1b2c" / "dslr"
        shutil.copytree(scene.folder / "images", dslr / photos)
        shutil.copytree(scene.folder / "sparse" / "0", dslr / "colmap")
        lists = {"train": [scene.names[i] for i in (0, 1, 3, 4, 5, 7)], "test": [scene.names[i] for i in (2, 6)]}
        (dslr / "train_test_lists.json").write_text(json.dumps({**lists, "has_masks": False}))
        write_scans(tmp_path / "0a1b2c" / "scans")
        return tmp_path / "0a1b2c", scene

    return make


def assert_ids_are_true(capture, write_capture):
    """Check that the masks show the spheres, also where the photos were undistorted."""
    spheres = [*((NUMBER_OF[i], center, radius) for i, center, radius in SPHERES), (0, (0.0, 1.0, 0.0), 0.2)]
    for i, view in enumerate(capture.views):
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T
        expected, _ = write_capture.sphere_ids(rays, view.viewmat, spheres)
        assert set(np.unique(expected)) >= {1, 2} and (capture.mask(i) == expected).mean() > 0.985


def test_scannetpp_becomes_a_capture(scan, write_capture, tmp_path):
    folder, scene = scan()
    scannetpp.convert(folder, tmp_path / "converted")
    capture = loaded(tmp_path / "converted", tmp_path)
    assert names_of(capture, range(len(capture))) == [f"view_{i:03d}.png" for i in range(8)], "view 8 is in no list"
    assert names_of(capture, capture.test_indices) == ["view_002.png", "view_006.png"]
    for i, view in enumerate(capture.views):
        np.testing.assert_allclose(view.viewmat, scene.viewmats[i], atol=1e-9)
    assert capture.names == {1: "table 1", 2: "chair 2", 3: "chair 3"}
    np.testing.assert_allclose(capture.points.xyz, scene.xyz, atol=1e-9)
    assert_ids_are_true(capture, write_capture)


def test_scannetpp_fisheye_photos_are_undistorted(scan, write_capture, tmp_path):
    folder, _ = scan(model="OPENCV_FISHEYE", params=FISHEYE)
    scannetpp.convert(folder, tmp_path / "converted")
    capture = loaded(tmp_path / "converted", tmp_path)
    assert set(capture.counts["cameras"]) == {"PINHOLE"}
    assert_ids_are_true(capture, write_capture)
    # The photos' green is 40 times the ID.
    own = {0: 0, **{number: 40 * i for i, number in NUMBER_OF.items()}}
    for i in range(len(capture)):
        expected = np.vectorize(own.get)(capture.mask(i))
        assert (np.abs(capture.image(i)[..., 1] - expected) < 25).mean() > 0.9


def test_scannetpp_undistorted_photos_have_the_cameras_of_the_toolbox(scan, write_capture, tmp_path):
    folder, _ = scan("resized_undistorted_images", model="OPENCV_FISHEYE", params=FISHEYE)
    with pytest.raises(InputError, match=r"transforms_undistorted.json does not exist; expected the camera"):
        scannetpp.convert(folder, tmp_path / "refused")
    (folder / "dslr" / "nerfstudio").mkdir()
    lens = {"fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "camera_model": "PINHOLE"}
    (folder / "dslr" / "nerfstudio" / "transforms_undistorted.json").write_text(json.dumps(lens))
    scannetpp.convert(folder, tmp_path / "converted")
    capture = loaded(tmp_path / "converted", tmp_path)
    np.testing.assert_array_equal(capture.views[0].K, [[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    assert_ids_are_true(capture, write_capture)


def test_scannetpp_scores_points_of_objects(scan, tmp_path):
    folder, _ = scan()
    truth = scannetpp.true_points(scannetpp.read_mesh(folder))
    assert sorted(truth) == [1, 2, 3]
    for object_id, center, radius in SPHERES:
        off = np.linalg.norm(truth[NUMBER_OF[object_id]] - center, axis=1) - radius
        assert len(off) == 2562 and np.abs(off).max() < 1e-6
    moved = {i: points + np.array([0, 0.5, 0]) for i, points in truth.items() if i != 2}
    quality = {"psnr": 30.0, "ssim": 0.9, "lpips": None, "miou": 0.9, "dice": 0.95, "accuracy": 0.99}
    results = Results(lambda _: np.zeros(0), quality, {"anchors": truth, "splats": moved})
    figures = scannetpp.measure(folder, tmp_path, results)
    assert figures["psnr"] == 30 and figures["lpips"] is None and figures["accuracy"] == 99
    assert figures["anchors_chamfer"] == 0 and figures["anchors_f1"] == 100 and figures["anchors_missing"] == 0
    assert figures["splats_missing"] == 1 and figures["splats_f1"] < 30 and figures["splats_chamfer"] > 0.05
    text = "\n".join(reproduce.table("scannetpp", scannetpp.paper("0a1b2c"), figures))
    assert "| LPIPS | 0.1488 |  |" in text and "| anchors: Chamfer distance (m) | 0.1132 | 0.0000 |" in text
    assert "| splats: objects without points |  | 1 |" in text


def test_scannetpp_with_segments_of_another_mesh_is_refused(scan):
    folder, _ = scan()
    (folder / "scans" / "segments.json").write_text('{"segIndices": [1, 2]}')
    with pytest.raises(InputError, match="2 vertices"):
        scannetpp.read_mesh(folder)


# --- the command -----------------------------------------------------------------------------------------------------


def test_table_has_the_papers_figures_beside_ours():
    figures = {
        "miou": 50.0, "mbiou": 40.0, "miou_others": None, "mbiou_others": None,
        "prompts": [{"prompt": "cup", "id": None, "views": 2, "iou": 0.0, "biou": 0.0}],
    }  # fmt: skip
    found = {
        "dataset": "lerf-mask", "scene": "figurines", "training": {"steps": 12_000, "seconds": 600},
        "figures": figures, "paper": lerf_mask.paper("figurines"),
    }  # fmt: skip
    text = reproduce.text(found)
    assert text.startswith("lerf-mask, figurines: 12,000 steps in 10.0 minutes; the paper trains 30,000.\n")
    assert "|  | paper | ours |" in text and "| mIoU (%) | 88.2 | 50.0 |" in text
    assert "| mBIoU (%), without the views of the association |  |  |" in text
    assert "| cup | none | 2 | 0.0 | 0.0 |" in text
    assert "| mIoU (%) |  | 50.0 |" in reproduce.text({**found, "paper": lerf_mask.paper("garden")}), "not in the paper"


def test_means_are_over_the_scenes_that_have_a_figure():
    figures = [{"miou": 50.0, "miou_others": None}, {"miou": 60.0, "miou_others": 30.0}]
    mean = reproduce.means("3d-ovs", [{"figures": row} for row in figures])
    assert mean == {"miou": 55.0, "miou_others": 30.0}
    assert "| mIoU (%) | 96.4 | 55.0 |" in reproduce.table("3d-ovs", three_d_ovs.paper("mean"), mean)


def test_every_module_has_what_the_command_needs():
    for module in reproduce.DATASETS.values():
        assert set(module.paper("figurines")) | set(module.paper("bed")) <= set(module.FIGURES)
        assert module.AFTER_TRAINING[0] in ("render", "evaluate") and module.NOTES


def test_scene_is_converted_once(ovs, lerf, tmp_path):
    out = tmp_path / "out"
    capture = reproduce.converted("3d-ovs", ovs.folder, out)
    kept = capture / "kept"
    kept.touch()
    assert reproduce.converted("3d-ovs", ovs.folder, out) == capture and kept.exists()
    with pytest.raises(InputError, match="choose another --out"):
        reproduce.converted("lerf-mask", lerf.folder, out)


def test_unusable_scene_is_reported_in_a_sentence(tmp_path, capsys):
    assert reproduce.main(["replica", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == EXIT_BAD_INPUT
    message = capsys.readouterr().err.strip()
    assert message.endswith(".") and "none is not a folder" in message and "\n" not in message
    (tmp_path / "empty").mkdir()
    assert reproduce.main(["replica", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == EXIT_BAD_INPUT
    assert "Sequence_1 does not exist" in capsys.readouterr().err


@pytest.mark.slow
def test_scene_is_trained_and_measured(lerf, tmp_path, capfd):
    words = ["lerf-mask", str(lerf.folder), "--out", str(tmp_path / "all"), "--steps", "60"]
    assert reproduce.main(words) == EXIT_DONE
    out = tmp_path / "all" / "figurines"
    printed = capfd.readouterr().out
    assert printed.startswith("lerf-mask, figurines: 60 steps in ") and "| mIoU (%) | 88.2 | " in printed
    assert "first test view" in printed and "Mean of" not in printed
    written = json.loads((out / "figures.json").read_text())
    assert written["training"]["steps"] == 60 and written["paper"] == {"miou": 88.2, "mbiou": 85.2}
    assert 0 < written["figures"]["miou"] <= 100 and len(written["figures"]["prompts"]) == 3
    settings = json.loads((out / "reconstruction" / "objectgs.json").read_text())["training"]["settings"]
    assert settings["semantic_weight"] == 0.01, "as in the paper"
    results = reproduce.read_results(out / "reconstruction")
    assert set(results.points["anchors"]) == set(results.points["splats"]) == {1, 2, 5}
    again = lerf_mask.measure(lerf.folder, out / "capture", results)
    assert json.loads(json.dumps(again)) == written["figures"]
    assert reproduce.main([*words, "--json"]) == EXIT_DONE
    assert json.loads(capfd.readouterr().out)["scenes"] == [written]


def test_failed_command_ends_the_run_with_its_code(ovs, tmp_path, monkeypatch, capsys):
    def fail(*words):
        raise reproduce.CommandFailed(130)

    monkeypatch.setattr(reproduce, "run", fail)
    assert reproduce.main(["3d-ovs", str(ovs.folder), "--out", str(tmp_path / "out")]) == 130
    assert (tmp_path / "out" / "bed" / "capture" / "test.txt").exists() and capsys.readouterr().out == ""
