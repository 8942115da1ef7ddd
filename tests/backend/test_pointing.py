"""Objects from strokes: the strokes' file, the graph, the random walker, and the command that makes masks."""

from __future__ import annotations

import argparse
import base64
import json
import shutil
import subprocess
import sys
import weakref
import zlib
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import sparse
from scipy.spatial import cKDTree

from backend.capture import load_capture
from backend.commands.objects import label
from backend.commands.objects.pointable import open_pointable, segmentation
from backend.export.ply import read_splats
from backend.model.anchors import Anchors
from backend.model.checkpoint import save_checkpoint
from backend.model.draw import draw
from backend.model.object_model import Normalization
from backend.planning import decisions
from backend.pointing.clusters import FEW, Clusters, between_clusters, nested_clusters, no_clusters
from backend.pointing.color_model import SPREAD, ColorModel
from backend.pointing.mask_edges import follow_edges
from backend.pointing.pointer import Pointer
from backend.pointing.proposals import find_objects, try_regions
from backend.pointing.random_walker import best_borders, connected_with, random_walker, rough_walker
from backend.pointing.splat_graph import IN_FRONT, OF_SPLATS, ON_PLANE, Edges, SplatGraph, contributions
from backend.pointing.stroke_masks import points_on, stroke_pixels
from backend.pointing.strokes import Stroke, Strokes, Viewpoint, content_of, read_strokes, strokes_of
from backend.pointing.views import views_around, views_of_photos
from backend.raster import Camera, object_ranks, rasterize
from backend.shared.errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, Cancelled, InputError
from backend.shared.events import Reporter
from backend.shared.formats.points_ply import read_points
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.objects import edit_objects, read_objects
from backend.shared.reconstruction.record import read_record
from backend.training.fine_tuning.relabel import relabeled
from backend.training.scene import Scene
from backend.training.settings import Settings
from backend.training.state import load_model, read_checkpoint
from backend.training.trainer import Trainer

from .command_result import assert_rejected
from .small_segmenters import write_small_model

ONE = {"object": 1, "view": "a.png", "points": [[0.5, 0.5]]}


def strokes_file(tmp_path, content):
    path = tmp_path / "strokes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_strokes_cover_the_pixels_between_their_points() -> None:
    pixels = Stroke(1, "a.png", ((0.25, 0.5), (0.75, 0.5))).pixels(8, 4)
    assert np.argwhere(pixels).tolist() == [[2, x] for x in range(2, 7)]
    assert np.argwhere(Stroke(1, "a.png", ((1.0, 1.0),)).pixels(8, 4)).tolist() == [[3, 7]]


def test_strokes_are_read_with_names(tmp_path) -> None:
    found = read_strokes(strokes_file(tmp_path, {"objects": {"1": "mug"}, "strokes": [ONE]}), ["a.png"])
    assert found.strokes == (Stroke(1, "a.png", ((0.5, 0.5),)),) and found.names == {1: "mug"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "JSON"),
        ({"strokes": []}, "no strokes"),
        ([ONE], "no strokes"),
        ({"strokes": [{**ONE, "object": 0}]}, "marks no object"),
        ({"strokes": [{**ONE, "object": -1}]}, "Stroke 1"),
        ({"strokes": [{**ONE, "object": True}]}, "Stroke 1"),
        ({"strokes": [ONE, {**ONE, "object": 2**32}]}, "Stroke 2"),
        ({"strokes": [{**ONE, "part": -1}]}, "the part -1"),
        ({"strokes": [{**ONE, "exact": 1}]}, "1 as `exact`"),
        ({"strokes": [{**ONE, "view": "b.png"}]}, "b.png"),
        ({"strokes": [{**ONE, "view": ["a.png"]}]}, "Stroke 1"),
        ({"strokes": [{**ONE, "points": []}]}, "points"),
        ({"strokes": [{**ONE, "points": [[0.5, 1.5]]}]}, "fractions"),
        ({"strokes": [{**ONE, "points": [[0.5]]}]}, "fractions"),
        ({"strokes": [7]}, "Stroke 1"),
        ({"strokes": [ONE], "objects": {"mug": "1"}}, "objects"),
        ({"strokes": [ONE], "objects": {"1": 5}}, "names"),
    ],
)
def test_invalid_strokes_are_refused(tmp_path, content, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_strokes(strokes_file(tmp_path, content), ["a.png"])


def chain(weights: list[float]) -> sparse.csr_array:
    """Return the graph of a chain of nodes with these weights between them."""
    n = len(weights) + 1
    upper = sparse.coo_array((weights, (np.arange(n - 1), np.arange(1, n))), shape=(n, n))
    return (upper + upper.T).tocsr()


def clustered_chain(weights: list[float]) -> tuple[sparse.csr_array, Clusters]:
    """Return the graph of a chain, and its clusters, in the order of the chain."""
    graph = chain(weights)
    order, clusters = nested_clusters(graph)
    assert (order == np.arange(len(order))).all()
    return graph, clusters


def test_walker_on_a_chain_has_the_probabilities_of_resistors() -> None:
    found = random_walker(chain([1, 1, 0.1, 1]), np.array([0, -1, -1, -1, 1]), np.zeros((5, 2)), 0.0)
    total = 1 + 1 + 10 + 1
    assert found[:, 1] == pytest.approx(np.array([0, 1, 2, 12, 13]) / total, abs=1e-6)
    assert found.sum(1) == pytest.approx(np.ones(5), abs=1e-6)


def test_nodes_are_connected_through_nodes_of_the_same_label_alone() -> None:
    weights, labels = random_graph(2000), np.random.default_rng(1).integers(0, 2, 2021)
    begin = np.zeros(2021, bool)
    begin[[0, 5, 2005]] = True
    edges = weights.tocoo()
    same = labels[edges.row] == labels[edges.col]
    inside = sparse.coo_array((same[same], (edges.row[same], edges.col[same])), shape=weights.shape)
    part_of = sparse.csgraph.connected_components(inside, directed=False)[1]
    found = connected_with(weights, labels, begin)
    assert (found == np.isin(part_of, part_of[begin])).all() and 3 < found.sum() < 2021


def test_walker_follows_the_prior_where_no_seed_is_near() -> None:
    prior = np.zeros((5, 2))
    prior[4, 1] = 1.0
    found = random_walker(chain([1, 1, 1e-6, 1]), np.array([0, -1, -1, -1, -1]), prior, 1e-3)
    assert found.argmax(1).tolist() == [0, 0, 0, 1, 1]


def random_graph(count: int) -> sparse.csr_array:
    """Return a graph of random points whose weights differ by orders of magnitude, and a chain connected to nothing."""
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(count, 3))
    _, neighbor = cKDTree(points).query(points, k=7)
    first, second = np.repeat(np.arange(count), 6), neighbor[:, 1:].ravel()
    other = first != second
    weights = 10 ** rng.uniform(-4, 0, other.sum())
    one = sparse.coo_array((weights, (first[other], second[other])), shape=(count, count)).tocsr()
    return sparse.block_diag([one.maximum(one.T), chain([1.0] * 20)], format="csr")


@pytest.mark.parametrize("count", [100, 5000, 30_000])
def test_clusters_are_nested_connected_and_few(count) -> None:
    weights = random_graph(count)
    order, clusters = nested_clusters(weights)
    weights = weights[order][:, order]
    assert sorted(order.tolist()) == list(range(count + 21))
    assert clusters.levels[:2].tolist() == [0, count + 21]
    sizes = np.diff(clusters.levels)
    assert len(sizes) >= 3 and 0 < sizes[-1] <= FEW and (sizes[1:-2] > FEW).all()
    assert (np.diff(clusters.parent) >= 0).all() and clusters.starts[-1] == clusters.levels[-2]
    for cluster, (first, last) in enumerate(pairwise(clusters.starts.tolist()), count + 21):
        assert (clusters.parent[first:last] == cluster).all() and 1 <= last - first <= 8
        if last <= count + 21:
            assert sparse.csgraph.connected_components(weights[first:last][:, first:last])[0] == 1


@pytest.mark.parametrize("strength", [0.0, 1e-4])
def test_walker_with_clusters_solves_the_same_equations_in_fewer_steps(strength, monkeypatch) -> None:
    count, rng = 5000, np.random.default_rng(1)
    order, nested = nested_clusters(random_graph(count))
    weights = random_graph(count)[order][:, order]
    seeds = np.full(count + 21, -1)
    seeds[rng.choice(np.flatnonzero(order < count), 6, replace=False)] = np.arange(6) % 3
    prior = rng.uniform(size=(count + 21, 3)) * (order < count)[:, None]
    free = seeds < 0
    laplacian = sparse.diags_array(weights.sum(axis=1) + strength * prior.sum(1) + 1e-12) - weights
    right = strength * prior[free] + weights[free][:, ~free] @ np.eye(3)[seeds[~free]]
    exact = sparse.linalg.spsolve(laplacian.tocsc()[free][:, free], right)
    monkeypatch.setattr("backend.pointing.random_walker.ITERATIONS", 30)
    monkeypatch.setattr("backend.pointing.random_walker.TOLERANCE", 1e-5)
    errors = []
    for clusters in (nested, None):
        found = random_walker(weights, seeds, prior, strength, None, clusters)
        errors.append(np.abs(found[free] - exact).max())
        assert not found[order >= count].any(), "nothing reaches what is not connected"
    assert errors[0] < 2e-3 and errors[0] < 0.1 * errors[1], errors


def test_rough_walker_solves_the_equations_of_clusters(monkeypatch) -> None:
    """Those in which all nodes of a cluster have the same probabilities."""
    rng = np.random.default_rng(1)
    order, nested = nested_clusters(random_graph(30_000))
    weights, count = random_graph(30_000)[order][:, order], len(order)
    seeds = np.full(count, -1)
    seeds[rng.choice(count, 60, replace=False)] = np.arange(60) % 3
    prior = 1e-3 * rng.uniform(size=(count, 3))
    free = seeds < 0
    laplacian = sparse.diags_array(weights.sum(axis=1) + prior.sum(1)) - weights
    right = prior[free] + weights[free][:, ~free] @ np.eye(3)[seeds[~free]]
    member = sparse.coo_array((np.ones(count), (np.arange(count), nested.parent[:count] - count))).tocsr()[free]
    small = (member.T @ laplacian.tocsr()[free][:, free] @ member).tocsc()
    exact = member @ sparse.linalg.spsolve(small, member.T @ right)
    monkeypatch.setattr("backend.pointing.random_walker.TOLERANCE", 1e-5)
    coarse = between_clusters(weights, nested)
    assert coarse is not None and between_clusters(weights, no_clusters(count)) is None
    found = rough_walker(weights, seeds, prior, nested, coarse)
    assert np.abs(found[free] - exact).max() < 1e-3
    assert (found[~free] == np.eye(3)[seeds[~free]]).all()


@pytest.fixture
def unlabeled(write_capture, tmp_path, run_command):
    """A capture of three spheres that was trained without masks, and the scene."""
    scene = write_capture(views=12, size=(96, 72), points=80)
    shutil.move(scene.folder / "masks", tmp_path / "truth")
    (scene.folder / "labels.json").unlink()
    out = tmp_path / "out"
    assert run_command("train", scene.folder, "--out", out, "--steps", 150, "--offsets", 4).code == EXIT_DONE
    return scene, out


def strokes_on(scene, views: tuple[int, ...]) -> dict:
    """Return a click on the middle of each sphere in some views."""
    strokes = []
    for view in views:
        ids = scene.ids[view]
        for object_id in np.unique(ids[ids > 0]).tolist():
            rows, columns = np.nonzero(ids == object_id)
            middle = np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2)
            point = [(columns[middle] + 0.5) / ids.shape[1], (rows[middle] + 0.5) / ids.shape[0]]
            strokes.append({"object": object_id, "view": scene.names[view], "points": [point]})
    return {"objects": {"1": "ball"}, "strokes": strokes}


def test_contributions_are_blending_weights(unlabeled) -> None:
    scene, out = unlabeled
    capture = load_capture(scene.folder, out / "cache")
    model, _, _ = load_model(out / "checkpoint")
    camera, splats = Scene(capture, model.classes, model.normalization).camera(0), model.generate()
    planes = np.random.default_rng(0).uniform(0, 1, (3, camera.height, camera.width)).astype(np.float32)
    found = contributions(splats, camera, planes, "3d")
    with torch.no_grad():
        alpha = rasterize(*splats[:6], camera).alpha.numpy()
    assert found.sum(0) == pytest.approx((planes * alpha).sum((1, 2)), rel=1e-3)
    assert (found >= 0).all()


def test_label_separates_the_objects_that_are_clicked(unlabeled, tmp_path, run_command) -> None:
    """A stroke that shows nothing is left out, since others mark its object; masks of another folder are replaced."""
    scene, out = unlabeled
    beside = scene.folder / "masks" / "strokes.json"
    beside.parent.mkdir()
    beside.write_text(json.dumps({"reconstruction": str(tmp_path)}))
    content = strokes_on(scene, (1, 5, 9))
    view = load_capture(scene.folder, tmp_path / "cache").views[0]
    away = {"viewmat": (np.diag([-1.0, 1, -1, 1]) @ view.viewmat).tolist(), "intrinsics": [90, 90, 48, 36]}
    content["strokes"].insert(0, {"object": 1, "camera": {**away, "width": 96, "height": 72}, "points": [[0.5, 0.5]]})
    strokes = strokes_file(tmp_path, content)
    result = run_command("label", out, "--strokes", strokes, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["objects"] == 3
    warnings = " ".join(result.messages("warning"))
    assert "Stroke 1 shows no splats" in warnings and f"that in {tmp_path}, and is replaced" in warnings
    assert json.loads(beside.read_text()) == {**content, "reconstruction": str(out.resolve())}
    assert json.loads((scene.folder / "labels.json").read_text())["1"] == "ball"
    said = result.messages("status")
    assert any(text.startswith("Masks show 3 objects in ") and "masks.jpg" in text for text in said)
    assert any(text.startswith("ball: in ") for text in said)
    assert Image.open(scene.folder / "masks" / "masks.jpg").format == "JPEG"
    assert result.events[-1]["steps"] == 180, "a fifth more than before"
    capture = load_capture(scene.folder, tmp_path / "again")
    assert capture.has_masks and all(capture.views[i].mask_file is None for i in capture.test_indices)
    right = total = 0
    for index in capture.train_indices:
        found, truth = capture.mask(index), scene.ids[index]
        right += int((found == truth)[truth > 0].sum())
        total += int((truth > 0).sum())
    assert right / total > 0.9
    assert {1, 2, 5} <= set(read_splats(out / "splats.ply")[0].object_ids.tolist()) <= {0, 1, 2, 5}
    model, _, _ = load_model(out / "checkpoint")
    assert model.classes.ids.tolist() == [0, 1, 2, 5]
    cameras = Scene(capture, model.classes, model.normalization)
    found = [(draw(model, cameras.camera(i)).ids == ids)[ids > 0].mean() for i, ids in enumerate(scene.ids)]
    assert np.median(found) > 0.9
    # More strokes correct the result, also of an object that was unchecked, and the training can go on.
    edit_objects(out / "objects.json", {5: {"left_out": True}})
    assert run_command("label", out, "--strokes", strokes).code == EXIT_DONE
    assert read_record(Reconstruction(out)).training.left_out == []
    model, _, _ = load_model(out / "checkpoint")
    found = [
        (draw(model, cameras.camera(i)).ids == ids)[ids == 5].mean() for i, ids in enumerate(scene.ids) if 5 in ids
    ]
    assert np.median(found) > 0.8
    edit_objects(out / "objects.json", {5: {"left_out": False}})
    assert run_command("train", scene.folder, "--out", out, "--steps", 230, "--offsets", 4).code == EXIT_DONE
    entries = json.loads((out / "objects.json").read_text())["objects"]
    assert [entry["name"] for entry in entries] == ["ball", "object 2", "object 5"]


def through_cameras(scene, capture, content: dict) -> dict:
    """Return strokes that name the cameras of photos instead of the photos."""
    by_name = dict(zip(scene.names, capture.views, strict=True))
    strokes = []
    for stroke in content["strokes"]:
        view = by_name[stroke["view"]]
        intrinsics = [float(view.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
        size = {"width": view.width, "height": view.height}
        camera = {"viewmat": view.viewmat.tolist(), "intrinsics": intrinsics, **size}
        strokes.append({"object": stroke["object"], "camera": camera, "points": stroke["points"]})
    return {**content, "strokes": strokes}


def shown_of_file(path, capture) -> list[np.ndarray]:
    """Return the objects (H, W) that each view of a capture shows of the splats in a file."""
    splats = read_splats(path)[0]
    objects, classes = np.unique(np.append(splats.object_ids, 0), return_inverse=True)
    tensors = [
        torch.tensor(part, dtype=torch.float32)
        for part in (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    ]
    found = []
    for view in capture.views:
        with torch.no_grad():
            drawn = rasterize(
                *tensors, torch.tensor(classes[:-1], dtype=torch.int32),
                Camera(view.viewmat, view.K, view.width, view.height),
            )  # fmt: skip
        ranks, _ = object_ranks(drawn, 1)
        found.append(np.where(ranks[0] >= 0, objects[np.maximum(ranks[0], 0)], 0))
    return found


@pytest.mark.parametrize("photos", [False, True])
@pytest.mark.long
def test_imported_splats_are_separated_by_strokes(unlabeled, tmp_path, run_command, photos: bool) -> None:
    """Without photos, the splats are compared by cameras around them, and strokes are drawn through cameras."""
    scene, out = unlabeled
    capture = load_capture(scene.folder, out / "cache")
    content = strokes_on(scene, (1, 5, 9))
    if not photos:
        content = through_cameras(scene, capture, content)
    before, imported = read_splats(out / "splats.ply")[0], tmp_path / "imported"
    options = ("--capture", scene.folder) if photos else ()
    assert run_command("import-splats", out / "splats.ply", "--out", imported, *options).code == EXIT_DONE
    result = run_command("label", imported, "--strokes", strokes_file(tmp_path, content), "--json")
    assert result.code == EXIT_DONE and result.events[-1]["objects"] == 3
    after = read_splats(imported / "splats.ply")[0]
    assert np.array_equal(after.means, before.means) and np.array_equal(after.sh, before.sh)
    assert {1, 2, 5} <= set(after.object_ids.tolist()) <= {0, 1, 2, 5}
    shown = shown_of_file(imported / "splats.ply", capture)
    right = [(found == truth)[truth > 0].mean() for found, truth in zip(shown, scene.ids, strict=True)]
    assert np.median(right) > 0.85, right
    entries = json.loads((imported / "objects.json").read_text())["objects"]
    assert [entry["name"] for entry in entries] == ["ball", "object 2", "object 5"]
    assert not (scene.folder / "masks").exists() and not (imported / "checkpoint").exists()


@pytest.mark.long
def test_objects_of_imported_splats_are_proposed(unlabeled, tmp_path, run_command) -> None:
    """Proposals on splats without photos are strokes through cameras, which `label` takes."""
    _, out = unlabeled
    imported = tmp_path / "imported"
    assert run_command("import-splats", out / "splats.ply", "--out", imported).code == EXIT_DONE
    result = run_command("propose", imported, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["objects"] >= 2
    strokes = imported / "strokes.json"
    assert all("camera" in stroke for stroke in json.loads(strokes.read_text())["strokes"])
    assert run_command("label", imported, "--strokes", strokes).code == EXIT_DONE
    assert len(set(read_splats(imported / "splats.ply")[0].object_ids.tolist())) >= 3


def test_points_are_marked_before_the_training(write_capture, tmp_path, run_command) -> None:
    """`point` answers with the object of each point; `label` asks for the training."""
    scene = write_capture(views=12, size=(96, 72), masks=False)
    out = tmp_path / "out"
    assert run_command("import", scene.folder, "--out", out).code == EXIT_DONE
    options = argparse.Namespace(folder=out, capture=None, device="cpu", memory_mb=2000)
    opened = open_pointable(options, Reporter())
    pointer = opened.pointer(lambda done, total: None)
    ids = pointer.solve(strokes_of(strokes_on(scene, (1, 5, 9)), "the test", opened.views.names))
    points = read_points(out / "points.ply")
    assert len(ids) == len(points.xyz) == opened.in_file.sum()
    truth = scene.point_objects[cKDTree(scene.xyz).query(points.xyz)[1]]
    assert (ids == truth)[truth > 0].mean() > 0.85
    strokes = strokes_file(tmp_path, strokes_on(scene, (1,)))
    assert_rejected(run_command("label", out, "--strokes", strokes), "no splats yet", "train first")


def test_cameras_around_splats_show_them_from_above_and_from_free_places() -> None:
    rng = np.random.default_rng(0)
    walls = rng.uniform(-1, 1, (6000, 3))
    side = rng.integers(0, 3, 6000)
    walls[np.arange(6000), side] = np.sign(rng.normal(size=6000))
    up, normalization = np.array([0.0, -1.0, 0.0]), Normalization((1.0, 2.0, 3.0), 0.5)
    views = views_around(walls, up, normalization)
    centers = np.array([views.camera(index).center for index in views.used])
    outside = np.abs(centers).max(1) > 1
    assert outside.sum() == 24 and (centers[outside] @ up > 0).all()
    assert (~outside).sum() == 36 and np.abs(centers[~outside]).max() < 0.9
    for index in np.flatnonzero(outside).tolist():
        in_camera = walls @ views.camera(index).viewmat[:3, :3].T + views.camera(index).viewmat[:3, 3]
        assert (in_camera[:, 2] > 0).all()
    solid = rng.uniform(-1, 1, (60_000, 3))
    assert len(views_around(solid, up, normalization).used) == 24, "there is no free place within"
    # A stroke in such a view refers to the camera in the splats' own coordinates.
    camera, reference = views.camera(3), views.reference(3)
    np.testing.assert_allclose(normalization.viewmat(np.array(reference.viewmat)), camera.viewmat, atol=1e-9)


def test_label_that_is_stopped_keeps_the_objects(unlabeled, tmp_path, run_command, monkeypatch) -> None:
    """The splats have their objects before the training of borders, so that it may also end in other ways."""
    scene, out = unlabeled

    def stopped(trainer, budget, folder, *_, **__):
        assert {1, 2, 5} <= set(read_splats(out / "splats.ply")[0].object_ids.tolist())
        trainer.save(folder)
        raise Cancelled("Stopped")

    with monkeypatch.context() as context:
        context.setattr(Trainer, "run", stopped)
        result = run_command("label", out, "--strokes", strokes_file(tmp_path, strokes_on(scene, (1, 5))))
    assert result.code == EXIT_CANCELLED
    assert {1, 2, 5} <= set(read_splats(out / "splats.ply")[0].object_ids.tolist())
    assert run_command("train", scene.folder, "--out", out, "--steps", 160, "--offsets", 4).code == EXIT_DONE


def test_label_is_not_stopped_while_the_folder_follows_its_masks(unlabeled, tmp_path, run_command, monkeypatch) -> None:
    """The training goes on afterward, with the choices that it was begun with."""
    scene, out = unlabeled
    train = ("train", scene.folder, "--out", out, "--offsets", 4, "--leave-out", "exposure", "--steps")
    assert run_command(*train, 10, "--restart").code == EXIT_DONE

    def write_and_stop(*arguments):
        write_masks(*arguments)
        arguments[-1].stop._stopped = True

    write_masks = label._write_masks
    with monkeypatch.context() as context:
        context.setattr(label, "_write_masks", write_and_stop)
        result = run_command("label", out, "--strokes", strokes_file(tmp_path, strokes_on(scene, (1, 5))))
    assert result.code == EXIT_CANCELLED
    assert {1, 2, 5} <= set(read_splats(out / "splats.ply")[0].object_ids.tolist())
    assert [entry.id for entry in read_objects(out / "objects.json")] == [1, 2, 5]
    assert run_command(*train, 12).code == EXIT_DONE


def test_training_goes_on_after_a_label_whose_masks_teach_nothing(
    unlabeled, tmp_path, run_command, monkeypatch
) -> None:
    """More objects later are learned again."""
    scene, out = unlabeled
    content = strokes_on(scene, (1, 5))
    one = {**content, "strokes": [stroke for stroke in content["strokes"] if stroke["object"] == 1]}
    train = ("train", scene.folder, "--out", out, "--offsets", 4, "--steps")
    with monkeypatch.context() as context:
        context.setattr(decisions, "background_is_masked", lambda _: False)
        assert run_command("label", out, "--strokes", strokes_file(tmp_path, one)).code == EXIT_DONE
        assert read_record(Reconstruction(out)).training.settings["semantic_weight"] == 0
        assert run_command(*train, 190).code == EXIT_DONE
    assert run_command("label", out, "--strokes", strokes_file(tmp_path, content)).code == EXIT_DONE
    assert read_record(Reconstruction(out)).training.settings["semantic_weight"] == Settings().semantic_weight
    assert run_command(*train, 240).code == EXIT_DONE


def test_another_training_of_a_capture_goes_on_without_masks_of_strokes(unlabeled, tmp_path, run_command) -> None:
    """Its list of objects stays as it is."""
    scene, out = unlabeled
    other = tmp_path / "other"
    train = ("train", scene.folder, "--out", other, "--offsets", 4, "--steps")
    assert run_command(*train, 4).code == EXIT_DONE
    listed = (other / "objects.json").read_bytes()
    assert run_command("label", out, "--strokes", strokes_file(tmp_path, strokes_on(scene, (1, 5)))).code == EXIT_DONE
    result = run_command(*train, 6, "--json")
    assert result.code == EXIT_DONE and (other / "objects.json").read_bytes() == listed
    assert "are not used, since the training was begun without masks" in " ".join(result.messages("warning"))
    assert read_splats(other / "splats.ply")[0].object_ids.max() == 0
    assert_rejected(run_command(*train, 8, "--keep", "votes"), "--keep votes is not possible", "without masks")


def test_relabeled_splats_are_the_same_splats(unlabeled) -> None:
    _, out = unlabeled
    model, state, _ = load_model(out / "checkpoint")
    tensors, _, _ = read_checkpoint(out / "checkpoint")
    before, source = model.splats()
    ids = np.arange(len(before)) % 3
    folder = out / "relabeled"
    save_checkpoint(folder, relabeled(tensors, state, source, ids), state)
    after, _ = load_model(folder)[0].splats()
    first, second = (np.lexsort(splats.means.T) for splats in (before, after))
    assert len(after) == len(before) and np.array_equal(after.object_ids[second], ids[first])
    for name in ("means", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(after, name)[second], getattr(before, name)[first])


def test_borders_of_masks_follow_the_photo() -> None:
    """A blurred border beside an edge of the photo is placed at the edge, and one without an edge stays."""
    photo = np.full((40, 60, 3), 40, np.uint8)
    photo[:20, 30:] = 200
    second = np.clip((np.arange(60) + 0.5 - 26) / 6, 0, 1)
    shown = np.broadcast_to(np.stack([1 - second, second], 1), (40, 60, 2)).astype(np.float32)
    found = follow_edges(photo, shown)
    assert (found[:18] == (np.arange(60) >= 30)).all() and (found[23:] == (np.arange(60) >= 29)).all()
    assert (follow_edges(photo, np.ones((40, 60, 1), np.float32)) == 0).all()


def test_a_label_ends_at_a_weak_edge_near_the_walkers_border() -> None:
    """The walker's border lies between nodes 4 and 5; a weak edge is a little before it, behind it, or far from it."""
    towards = np.array([0.99, 0.9, 0.8, 0.7, 0.6, 0.45, 0.4, 0.2, 0.1, 0.05])
    probabilities = np.column_stack([1 - towards, towards])
    for weak, last in ((3, 3), (4, 4), (6, 6), (0, 4), (8, 4)):
        weights = np.ones(9)
        weights[weak] = 0.4
        assert best_borders(chain(weights.tolist()), probabilities).tolist() == [1] * (last + 1) + [0] * (9 - last)


def test_a_weak_border_is_found_where_a_label_could_have_all_nodes() -> None:
    towards = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.42])
    probabilities = np.column_stack([1 - towards, towards])
    assert best_borders(chain([1, 1, 0.1, 1, 1]), probabilities).tolist() == [1, 1, 1, 0, 0, 0]
    towards[-1] = 0.55
    probabilities = np.column_stack([1 - towards, towards])
    assert best_borders(chain([1] * 5), probabilities).tolist() == [1] * 6, "nothing is below one half"


def test_borders_between_labels_stay_where_the_walker_has_them() -> None:
    probabilities = np.array(
        [[0.0, 1, 0], [0.1, 0.8, 0.1], [0.2, 0.5, 0.3], [0.2, 0.3, 0.5], [0.1, 0.1, 0.8], [0, 0, 1]]
    )
    assert best_borders(chain([1] * 5), probabilities).tolist() == [1, 1, 1, 2, 2, 2]
    assert best_borders(chain([1] * 5), probabilities[:, :1]).tolist() == [0] * 6


def test_far_splats_belong_to_nothing_unless_everything_is_an_object() -> None:
    """Two plates far apart; the stroke is on one of them. A part with a similar color elsewhere is not the object's."""
    none, flat = np.zeros(0), np.zeros((9, 3))
    graph = SplatGraph(
        np.arange(9), np.arange(9), np.zeros(9, bool), np.repeat([[50.0, 0, 0], [80.0, 0, 0], [50.0, 0, 0]], 3, axis=0),
        *clustered_chain([1, 1, 1e-4, 1, 1, 1e-4, 1, 1]), Edges(none, none, none, none, none),
        flat, np.ones(9), flat, np.ones(9),
    )  # fmt: skip
    seeds = {7: np.eye(9)[0]}
    assert graph.solve(seeds).ids.tolist() == [7, 7, 7, 0, 0, 0, 0, 0, 0]
    assert graph.solve(seeds, everything=True).ids.tolist() == [7] * 9
    both = graph.solve({**seeds, 8: np.eye(9)[4]}, everything=True)
    assert both.ids.tolist() == [7, 7, 7, 8, 8, 8, 8, 8, 8], "the last three only have the color of the first"
    again = graph.solve({**seeds, 8: np.eye(9)[4], 9: np.eye(9)[8]}, True, both)
    assert again.ids.tolist() == [7, 7, 7, 8, 8, 8, 9, 9, 9]


def test_colors_of_what_was_found_decide_where_strokes_do_not(monkeypatch) -> None:
    """A chain whose third part has weaker edges to the first, but its color, which the stroke on the first lacks."""
    none, flat = np.zeros(0), np.zeros((12, 3))
    colors = np.repeat([[20.0, 0, 0], [60.0, 0, 0], [90.0, 0, 0]], [1, 8, 3], axis=0)
    graph = SplatGraph(
        np.arange(12), np.arange(12), np.zeros(12, bool), colors,
        *clustered_chain([1, 1, 1, 1, 1, 3e-4, 1, 1, 1e-3, 1, 1]),
        Edges(none, none, none, none, none), flat, np.ones(12), flat, np.ones(12),
    )  # fmt: skip
    seeds = {7: np.eye(12)[0], 8: np.eye(12)[11]}
    assert graph.solve(seeds, everything=True).ids.tolist() == [7] * 9 + [8] * 3
    monkeypatch.setattr("backend.pointing.splat_graph.FOUND", 0.0)
    assert graph.solve(seeds, everything=True).ids.tolist() == [7] * 6 + [8] * 6


def test_likeness_is_the_part_of_a_label_that_has_a_color() -> None:
    rng = np.random.default_rng(0)
    lab = np.concatenate([rng.normal(center, 6, (4000, 3)) for center in (0.0, 15.0)])
    labels = np.repeat([0, 2], 4000)
    labels[::3] = -1
    found = ColorModel(lab).likeness(labels, 3)
    density = [np.exp(-((lab - center) ** 2).sum(1) / 2 / (6**2 + SPREAD**2)) for center in (0.0, 15.0)]
    common = np.maximum(*density) > 0.1
    expected = density[0] / np.sum(density, axis=0)
    assert np.abs(found[common, 0] - expected[common]).mean() < 0.03
    assert (found[:, 1] == 0).all() and (found.sum(1) <= 1 + 1e-9).all()
    far = ColorModel(np.concatenate([lab, [[90.0, 90, 90]]])).likeness(np.append(labels, -1), 3)
    assert (far[-1] == 0).all()


CAMERA = {"viewmat": np.eye(4).tolist(), "intrinsics": [90, 90, 48, 36], "width": 96, "height": 72}


@pytest.mark.parametrize(
    "change",
    [
        {"viewmat": np.eye(3).tolist()}, {"viewmat": (2 * np.eye(4)).tolist()}, {"intrinsics": [0, 90, 48, 36]},
        {"intrinsics": [1, 2, 3]}, {"width": 0}, {"height": 1.5}, {"width": 10**9}, {"viewmat": None},
    ],
)  # fmt: skip
def test_invalid_cameras_of_strokes_are_refused(tmp_path, change) -> None:
    stroke = {"object": 1, "points": [[0.5, 0.5]], "camera": {**CAMERA, **change}}
    with pytest.raises(InputError, match="needs a `camera`"):
        read_strokes(strokes_file(tmp_path, {"strokes": [stroke]}), [])


def test_areas_cover_what_is_inside() -> None:
    square = Stroke(1, "a.png", ((0.25, 0.25), (0.7, 0.25), (0.7, 0.7), (0.25, 0.7)), area=True)
    assert square.pixels(8, 8).sum() == 16


def test_point_answers_strokes(unlabeled) -> None:
    """Each request is answered with the objects of all splats; an invalid one with a sentence."""
    scene, out = unlabeled
    process = subprocess.Popen(
        [sys.executable, "-m", "backend", "point", str(out), "--json"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None

    def answer() -> dict:
        assert process.stdout is not None
        return next(event for line in process.stdout if (event := json.loads(line))["type"] == "answer")

    process.stdin.write("attached\n")
    splats = answer()["splats"]
    assert splats == len(read_splats(out / "splats.ply")[0])
    process.stdin.write(json.dumps({"request": 1, **strokes_on(scene, (1, 5))}) + "\n")
    process.stdin.flush()
    found = answer()
    classes = np.frombuffer(zlib.decompress(base64.b64decode(found["classes"])), found["kind"])
    assert found["request"] == 1 and len(classes) == splats == found["splats"]
    assert set(found["objects"]) - {0} == {1, 2, 5} and classes.max() < len(found["objects"])
    process.stdin.write(json.dumps({"request": 2, "strokes": [{**ONE, "view": "gone.png"}]}) + "\n")
    process.stdin.flush()
    assert "gone.png" in answer()["problem"]
    counts = []
    for request, detail in enumerate((0.6, 0.0), 3):
        process.stdin.write(json.dumps({"request": request, "propose": True, "detail": detail}) + "\n")
        process.stdin.flush()
        counts.append(len({stroke["object"] for stroke in answer()["proposed"]["strokes"]}))
    assert counts[0] >= 3 > counts[1]
    process.stdin.write(json.dumps({"request": 5, "propose": True, "detail": "fine"}) + "\n")
    process.stdin.flush()
    assert "0 to 1" in answer()["problem"]
    process.stdin.close()
    assert process.wait(timeout=20) == EXIT_DONE


def table_with_balls(balls: int) -> tuple[SplatGraph, np.ndarray]:
    """A graph of splats on a square table with balls on it, and the true object of each splat: 0 the table."""
    rng = np.random.default_rng(0)
    centers = np.array([(0.9 * np.cos(turn), 0.9 * np.sin(turn)) for turn in 2 * np.pi * np.arange(balls) / balls])
    table = rng.uniform(-2, 2, (12_000, 2))
    table = table[(np.linalg.norm(table[:, None] - centers, axis=2) > 0.1).all(1)]
    points, normals, true = (
        [np.column_stack([table, np.zeros(len(table))])],
        [np.tile([0, 0, 1.0], (len(table), 1))],
        [0],
    )
    counts = [len(table)]
    for number, center in enumerate(centers, 1):
        normal = rng.normal(size=(1500, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        points.append([*center, 0.28] + 0.3 * normal)
        normals.append(normal)
        true.append(number)
        counts.append(1500)
    xyz, truth = np.concatenate(points), np.repeat(true, counts)
    above = xyz[:, 2] > -1e-9
    xyz, truth, normal = xyz[above], truth[above], np.concatenate(normals)[above]
    xyz = xyz + rng.normal(0, 0.004, xyz.shape)
    distance, neighbor = cKDTree(xyz).query(xyz, k=11)
    first, second = np.repeat(np.arange(len(xyz)), 10), neighbor[:, 1:].ravel()
    spacing = distance[:, 1:6].mean(1)
    gap = distance[:, 1:].ravel() / np.minimum(spacing[first], spacing[second])
    color = rng.uniform(0, 3, len(first))  # Everything has a texture.
    nodes, ones = np.arange(len(xyz)), np.ones(len(xyz))
    weights = sparse.csr_array((len(xyz), len(xyz)))
    edges = Edges(first, second, gap, color, color)
    graph = SplatGraph(
        nodes, nodes, ones < 0, np.zeros((len(xyz), 3)), weights, no_clusters(len(xyz)), edges, xyz, ones, normal, ones
    )
    return graph, truth


@pytest.mark.parametrize("balls", [1, 5])
@pytest.mark.long
def test_things_on_a_table_are_found_without_strokes(balls) -> None:
    graph, truth = table_with_balls(balls)
    calls = []
    tree = try_regions(graph, lambda done, total: calls.append((done, total)))
    found = find_objects(graph, tree)
    assert calls[-1][0] == calls[-1][1] > 1
    for number in range(balls + 1):
        ids, counts = np.unique(found[(truth == number) & (found > 0)], return_counts=True)
        best = ids[counts.argmax()]
        both = ((found == best) & (truth == number)).sum()
        assert both / ((found == best) | (truth == number)).sum() > 0.85, number
    assert found.max() <= balls + 3 and (np.diff(np.bincount(found)[1:]) <= 0).all(), "the largest is the first"
    pairs = [find_objects(graph, tree, detail) for detail in (0.3, 0.9)]
    assert pairs[0].max() <= found.max() <= pairs[1].max()
    coarse, fine = ((each[graph.edges.first], each[graph.edges.second]) for each in pairs)
    both = (fine[0] == fine[1]) & (fine[0] > 0)
    assert both.any() and (coarse[0] == coarse[1])[both].all(), "finer objects divide the coarser ones"


@pytest.mark.parametrize("detail", [0.2, 0.9])
def test_planes_need_no_vote(monkeypatch, detail) -> None:
    """A table on which all trials agree is two objects where one half of it is in front of the other, a plane."""
    graph, truth = table_with_balls(1)
    table, right = truth == 0, graph.xyz[:, 0] > 1
    first, second = right[graph.edges.first], right[graph.edges.second]
    counts = []
    for sides in (np.zeros(len(first)), np.where(first == second, 0, -1)):
        monkeypatch.setattr("backend.pointing.proposals.sides_of_planes", lambda *_, sides=sides, **_options: sides)
        found = find_objects(graph, try_regions(graph, lambda done, total: None), detail)
        largest = [np.bincount(found[table & half]).argmax() for half in (right, ~right)]
        counts.append(len(set(largest)))
    assert counts == [1, 2]


def test_planes_change_the_weights_of_edges(unlabeled, monkeypatch) -> None:
    scene, out = unlabeled
    capture, model = load_capture(scene.folder, out / "cache"), load_model(out / "checkpoint")[0]
    totals = []
    for side in (-1, 0, 1):
        monkeypatch.setattr(
            "backend.pointing.splat_graph.sides_of_planes", lambda *args, side=side: np.full(len(args[-1][0]), side)
        )
        totals.append(pointer_of(capture, model, None)._graph.weights.sum())
    assert totals[0] / totals[1] == pytest.approx(IN_FRONT) and totals[2] / totals[1] == pytest.approx(ON_PLANE)


def test_surfaces_that_turn_weaken_edges(unlabeled, monkeypatch) -> None:
    scene, out = unlabeled
    capture, model = load_capture(scene.folder, out / "cache"), load_model(out / "checkpoint")[0]
    turned = pointer_of(capture, model, None)._graph.weights.sum()
    flat = np.array([0, 0, 1.0])[:, None, None]
    name = "backend.pointing.splat_graph.normals_of_depth"
    monkeypatch.setattr(name, lambda depth, *_: flat * np.ones((1, *depth.shape)))
    unturned = pointer_of(capture, model, None)._graph.weights.sum()
    monkeypatch.setattr(name, lambda depth, *_: np.zeros((3, *depth.shape)))
    monkeypatch.setattr("backend.pointing.splat_graph.bending", lambda *args: np.ones(len(args[-1])))
    convex = pointer_of(capture, model, None)._graph.weights.sum()
    assert turned < 0.99 * unturned and convex == pytest.approx(unturned)


def test_proposed_objects_are_separated_by_label(unlabeled, tmp_path, run_command) -> None:
    scene, out = unlabeled
    result = run_command("propose", out, "--json")
    assert result.code == EXIT_DONE and result.events[-1]["objects"] >= 3
    assert any(
        text.startswith(f"Found {result.events[-1]['objects']} objects in ") for text in result.messages("status")
    )
    assert Image.open(result.events[-1]["picture"]).format == "JPEG" and (out / "strokes.jpg").exists()
    content = json.loads((out / "strokes.json").read_text())
    assert {stroke["view"] for stroke in content["strokes"]} <= set(scene.names)
    assert all(stroke["exact"] for stroke in content["strokes"])
    assert run_command("label", out, "--strokes", out / "strokes.json").code == EXIT_DONE
    capture = load_capture(scene.folder, tmp_path / "again")
    shown = np.zeros((100, 6))
    for index in capture.train_indices:
        np.add.at(shown, (capture.mask(index), scene.ids[index]), 1)
    balls = shown[1:, [1, 2, 5]]
    iou = balls / (shown[:, [1, 2, 5]].sum(0) + shown[1:].sum(1, keepdims=True) - balls)
    assert (iou.max(0) > 0.7).sum() >= 2, iou.round(2)
    assert balls.max(1).sum() > 0.9 * balls.sum(), "hardly any proposal is on two balls"


def test_label_refuses_foreign_masks_and_strokes_on_nothing(unlabeled, tmp_path, run_command, monkeypatch) -> None:
    scene, out = unlabeled
    strokes = strokes_file(tmp_path, strokes_on(scene, (1,)))
    before = sorted(path.name for path in scene.folder.iterdir())
    with monkeypatch.context() as context:
        context.setattr("backend.pointing.pointer.contributions", lambda splats, *_: np.zeros((len(splats.means), 3)))
        result = run_command("label", out, "--strokes", strokes)
    assert result.code == EXIT_BAD_INPUT and "Stroke 1 shows no splats" in result.err
    assert sorted(path.name for path in scene.folder.iterdir()) == before
    shutil.copytree(tmp_path / "truth", scene.folder / "masks")
    result = run_command("label", out, "--strokes", strokes)
    assert result.code == EXIT_BAD_INPUT and "not made of strokes" in result.err
    assert not (scene.folder / "masks" / "strokes.json").exists()
    (scene.folder / "masks" / "strokes.json").write_text(json.dumps({"reconstruction": str(tmp_path)}))
    result = run_command("label", out, "--strokes", tmp_path / "none.json")
    assert result.code == EXIT_BAD_INPUT and "none.json" in result.err and "replaced" not in result.err


def test_masks_of_views_become_masks_of_distorted_photos(write_capture, tmp_path, monkeypatch) -> None:
    """Resampling a mask to the photo and back, through a strong distortion, changes few pixels at outlines only."""
    scene = write_capture(views=4, size=(96, 72), model="OPENCV", params=[90, 90, 48, 36, -0.2, 0.05, 0, 0])
    capture = load_capture(scene.folder, tmp_path / "cache")
    before = capture.mask(0)
    photo = capture.photo_mask(0, before)
    assert photo.shape == (72, 96) and photo.dtype == before.dtype
    assert np.array_equal(capture.photo_mask(1, before), photo), "of the same camera"
    monkeypatch.setattr("backend.capture.capture._PIXELS_AT_ONCE", 500)
    assert np.array_equal(load_capture(scene.folder, tmp_path / "cache").photo_mask(0, before), photo), "in strips"
    Image.fromarray(photo.astype(np.uint8)).save(scene.folder / "masks" / "view_000.png")
    after = load_capture(scene.folder, tmp_path / "other").mask(0)
    assert (before > 0).sum() > 200 and np.mean(before != after) < 0.03


class TrueMasks:
    """Stands in for a segmentation model: the mask of a prompt is the object under its first point."""

    def __init__(self, ids):
        self.ids, self.pictures, self.prompts = ids, {}, []

    def __call__(self, key, picture, points, labels):
        if key not in self.pictures:
            self.pictures[key] = picture()
        self.prompts.append((key, points, labels))
        column, row = points[0].astype(int)
        ids = self.ids(key)
        return ids == ids[row, column]


def pointer_of(capture, model, segment) -> Pointer:
    scene = Scene(capture, model.classes, model.normalization)
    views = views_of_photos(capture, scene.camera, model.normalization)
    return Pointer(model.generate(), model.primitive, views, OF_SPLATS, lambda done, total: None, segment)


def test_masks_of_strokes_separate_better_than_strokes(unlabeled) -> None:
    """One click on each object, in one view."""
    scene, out = unlabeled
    capture = load_capture(scene.folder, out / "cache")
    model, _, _ = load_model(out / "checkpoint")
    strokes = strokes_of(strokes_on(scene, (1,)), "the test", scene.names)
    stand_in = TrueMasks(lambda key: scene.ids[scene.names.index(key)])
    right = []
    for segment in (None, stand_in):
        pointer = pointer_of(capture, model, segment)
        found = dict(pointer.masks(pointer.solve(strokes)))
        agrees = [(mask == scene.ids[index])[scene.ids[index] > 0] for index, mask in found.items()]
        right.append(np.concatenate(agrees).mean())
    assert 1 - right[1] < 0.5 * (1 - right[0]) and right[1] > 0.9, right
    photo = np.asarray(Image.open(scene.folder / "images" / scene.names[1]))
    assert np.array_equal(stand_in.pictures[scene.names[1]], photo)
    _, points, labels = stand_in.prompts[0]
    assert labels.tolist() == [1, 0, 0] and len(points) == 3, "strokes on others in the view are not on it"


def test_masks_have_no_object_where_no_splats_are(unlabeled) -> None:
    """Even if all splats are of objects."""
    scene, out = unlabeled
    capture = load_capture(scene.folder, out / "cache")
    model, _, _ = load_model(out / "checkpoint")
    keep = torch.from_numpy(model.anchors.positions.numpy()[:, 0] > 0.1)
    anchors = model.anchors
    model.anchors = Anchors(
        anchors.layout, anchors.voxel, anchors.positions[keep], anchors.rows[keep], anchors.ids[keep]
    )
    pointer = pointer_of(capture, model, None)
    ids = np.full(len(pointer.splats.means), 70_000)
    for (index, mask), (_, shown) in zip(
        pointer.masks(ids), pointer.shown_ids(ids, capture.train_indices), strict=True
    ):
        assert set(np.unique(mask)) <= {0, 70_000}
        assert 0.1 < (mask == 0).mean() < 0.98 and (mask == shown).mean() > 0.9, index


def test_merged_objects_are_what_they_were(unlabeled) -> None:
    """Three clicks on one ball: merging two of these objects, which have its color, leaves the third as it is."""
    scene, out = unlabeled
    model, _, _ = load_model(out / "checkpoint")
    capture = load_capture(scene.folder, out / "cache")
    places = np.argwhere(scene.ids[0] == 1)[:, ::-1] + 0.5
    near = [places[(places * way).sum(1).argmax()] for way in ((-1, 0), (1, -1), (1, 1))]
    points = [((0.6 * place + 0.4 * places.mean(0)) / (96, 72)).tolist() for place in near]
    separate = [{"object": number, "view": scene.names[0], "points": [point]} for number, point in enumerate(points, 1)]
    merged = [{**stroke, "object": 1, "part": 1} if stroke["object"] == 2 else stroke for stroke in separate]
    found = [
        pointer_of(capture, model, None).solve(strokes_of({"strokes": strokes}, "the test", scene.names))
        for strokes in (separate, merged)
    ]
    assert set(found[0].tolist()) >= {1, 2, 3}
    assert np.array_equal(found[1], np.where(found[0] == 2, 1, found[0]))


def middle_of(mask):
    """The pixel (x, y) of a mask next to its mean, as fractions of the size."""
    places = np.argwhere(mask)
    row, column = places[np.linalg.norm(places - places.mean(0), axis=1).argmin()] + 0.5
    return float(column / mask.shape[1]), float(row / mask.shape[0])


def test_strokes_on_splats_are_prompts_in_their_picture(unlabeled) -> None:
    """From a viewpoint that is no photo's, the model sees the splats, scaled like the stroke's pixels."""
    scene, out = unlabeled
    capture = load_capture(scene.folder, out / "cache")
    model, _, _ = load_model(out / "checkpoint")
    viewmat = tuple(map(tuple, scene.viewmats[1].tolist()))
    view = Viewpoint(viewmat, (960.0, 960.0, 480.0, 360.0), 960, 720)
    large = np.kron(scene.ids[1], np.ones((10, 10), int))[:720, :960]
    point = middle_of(scene.ids[1] == 2)
    scaled = np.asarray(Image.fromarray(large.astype(np.uint8)).resize((640, 480), Image.Resampling.NEAREST))
    stand_in = TrueMasks(lambda key: scaled if key == view else scene.ids[1])
    pointer = pointer_of(capture, model, stand_in)
    strokes = Strokes((Stroke(2, view, (point,)), Stroke(1, scene.names[1], (middle_of(scene.ids[1] == 1),))), {})
    first = pointer.solve(strokes)
    seen, photo = stand_in.pictures[view], np.asarray(Image.open(scene.folder / "images" / scene.names[1]))
    assert seen.shape == (480, 640, 3)
    small = np.asarray(Image.fromarray(seen).resize((96, 72), Image.Resampling.BOX))
    assert np.abs(small.astype(float) - photo)[scene.ids[1] == 2].mean() < 40
    assert np.array_equal(pointer.solve(strokes), first) and len(stand_in.prompts) == 2, (
        "known strokes are not asked again"
    )


def pixels_of(mask, others=()):
    """The pixels that a stroke stands for in a picture of 200 x 100, with a model that answers with a mask."""
    stroke = Stroke(1, "a.png", ((0.25, 0.5), (0.45, 0.5)))
    pixels, is_mask = stroke_pixels(
        stroke, others, (200, 100), lambda *_: mask, lambda: pytest.fail("the picture was not needed")
    )
    assert is_mask != np.array_equal(pixels, stroke.pixels(200, 100))
    return stroke, pixels


def test_bad_masks_leave_the_strokes() -> None:
    half = np.zeros((100, 200), bool)
    half[20:80, 30:110] = True
    stroke, found = pixels_of(half)
    assert found.sum() == 58 * 78 and found[21:79, 31:109].all(), "without its border"
    own = stroke.pixels(200, 100)
    beside = half & (np.arange(200) < 60)
    most = np.arange(200) < 130
    for mask in (~half, beside, np.broadcast_to(most, half.shape), np.zeros_like(half)):
        assert np.array_equal(pixels_of(mask)[1], own)
    assert np.array_equal(pixels_of(half, [Stroke(0, "a.png", ((0.2, 0.3), (0.3, 0.3)))])[1], own)
    beyond = Stroke(2, "a.png", ((0.5, 0.3), (0.9, 0.3)))
    assert np.array_equal(pixels_of(half, [beyond])[1], found & ~beyond.pixels(200, 100))
    thin = np.zeros_like(half)
    thin[49:52, 40:100] = True
    assert np.array_equal(pixels_of(thin)[1], thin), "it has hardly anything but a border"


def test_a_model_is_not_asked_for_exact_strokes() -> None:
    (stroke,) = strokes_of({"strokes": [{**ONE, "exact": True}]}, "the request", ["a.png"]).strokes
    assert strokes_of(content_of(Strokes((stroke,), {})), "a file", ["a.png"]).strokes == (stroke,)
    pixels, is_mask = stroke_pixels(
        stroke, (), (200, 100), lambda *_: pytest.fail("the model was asked"), lambda: pytest.fail("the picture, too")
    )
    assert not is_mask and np.array_equal(pixels, stroke.pixels(200, 100))


def test_prompts_are_on_strokes_and_inside_areas() -> None:
    line = Stroke(1, "a.png", ((0.1, 0.5), (0.5, 0.5), (0.5, 0.9)))
    points = points_on(line, (200, 100), 6)
    assert len(points) == 6 and points[0] == pytest.approx([30, 50]) and points[1] == pytest.approx([50, 50])
    assert points_on(Stroke(1, "a.png", ((0.3, 0.2),)), (200, 100), 6).tolist() == [[60, 20]]
    area = Stroke(1, "a.png", ((0.1, 0.1), (0.5, 0.1), (0.5, 0.8), (0.1, 0.8)), area=True)
    points = points_on(area, (200, 100), 6)
    inside = area.pixels(200, 100)
    assert len(points) == 6 and len(np.unique(points, axis=0)) == 6
    assert all(inside[int(y) - 9 : int(y) + 10, int(x) - 9 : int(x) + 10].all() for x, y in points)


def test_label_takes_a_model_until_the_training(unlabeled, tmp_path, run_command, monkeypatch) -> None:
    scene, out = unlabeled
    strokes = strokes_file(tmp_path, strokes_on(scene, (1,)))
    result = run_command("label", out, "--strokes", strokes, "--segmenter", tmp_path / "none")
    assert_rejected(result, "none is not a folder; choose one with a checkpoint of SAM", "--segmenter")
    assert not (scene.folder / "masks").exists()
    pytest.importorskip("transformers")
    model = tmp_path / "model"
    write_small_model(model, "sam2")
    in_use = []

    def opened(*arguments):
        found = segmentation(*arguments)
        in_use.append(weakref.ref(found))
        return found

    monkeypatch.setattr(label, "segmentation", opened)
    monkeypatch.setattr(label, "train_borders", lambda *_: in_use.append(in_use[0]()))
    result = run_command("label", out, "--strokes", strokes, "--segmenter", model)
    assert result.code == EXIT_DONE and (scene.folder / "masks").is_dir(), result.err
    assert in_use[1:] == [None]
