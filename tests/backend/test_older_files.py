"""Reading, measuring and resuming a reconstruction of an earlier version (colour, centre, teach_unlabelled...).

tests/data/earlier-reconstruction.zip contains the capture (a small demo of three objects), and the folder after
training, `mesh`, `edit` and the headless command `build`.
"""

import zipfile
from pathlib import Path

import pytest

from backend.shared.errors import EXIT_DONE
from backend.shared.formats.json_file import read_json
from backend.shared.formats.mesh_ply import read_mesh
from backend.shared.reconstruction.checkpoint import read_header
from backend.shared.reconstruction.meshes import read_meshes
from backend.shared.reconstruction.objects import edit_objects, read_objects

ARCHIVE = Path(__file__).resolve().parents[1] / "data" / "earlier-reconstruction.zip"


@pytest.fixture
def earlier(tmp_path):
    """The unpacked folder with `rec` and `capture`."""
    zipfile.ZipFile(ARCHIVE).extractall(tmp_path)
    return tmp_path


def test_older_objects_keep_colors_and_edits(earlier):
    path = earlier / "rec" / "objects.json"
    assert "colour" in path.read_text() and "recolour" in path.read_text()
    mug, bottle, ring, *_ = read_objects(path)
    assert (mug.name, mug.color, mug.recolor.hue) == ("mug", (59, 125, 216), 0.3)
    assert bottle.transform is not None and ring.removed and ring.fill
    edit_objects(path, {1: {"color": [1, 2, 3]}})
    assert read_objects(path)[0].color == (1, 2, 3) and read_objects(path)[0].recolor.hue == 0.3
    assert set(read_json(path)["edits"]["1"]) == {"color", "recolor"}


def test_older_meshes_and_checkpoint_are_read(earlier):
    meshes = read_meshes(earlier / "rec" / "meshes")
    assert [entry.object_id for entry in meshes.values()] == [1, 2]
    mesh = read_mesh(earlier / "rec" / "meshes" / meshes["1"].file)
    assert len(mesh.faces) and mesh.unobserved.any()
    header = read_header(earlier / "rec" / "checkpoint")
    assert header.steps == 60 and header.seconds > 0


def test_older_reconstruction_is_evaluated_exported_and_trained(earlier, run_command):
    rec, capture = earlier / "rec", earlier / "capture"
    assert run_command("evaluate", rec, "--capture", capture).code == EXIT_DONE
    assert run_command("export", rec, "--out", earlier / "all.ply").code == EXIT_DONE
    train = ("train", capture, "--out", rec, "--steps", 62, "--offsets", 2, "--voxel", 0.12)
    assert run_command(*train).code == EXIT_DONE
    assert read_header(rec / "checkpoint").steps == 62
