"""Files and folders that take the place of others as a whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from backend.capture import made_masks
from backend.shared.formats import atomic


def test_replacing_waits_for_programs_that_read_the_file(tmp_path, monkeypatch):
    """On Windows, a file that another process has open cannot be replaced."""
    refused, replace = [], Path.replace

    def busy(self, target):
        if len(refused) < 3:
            refused.append(target)
            raise PermissionError(13, "in use")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", busy)
    monkeypatch.setattr(atomic, "_PATIENCE", 0.4)
    atomic.write_atomic(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new" and len(refused) == 3
    refused.clear()
    monkeypatch.setattr(atomic, "_PATIENCE", 0.0)
    with pytest.raises(PermissionError):
        atomic.write_atomic(tmp_path / "a", b"newer")
    assert [path.name for path in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_bytes() == b"new"


def test_masks_are_put_back_while_programs_read_them(tmp_path, monkeypatch):
    """On Windows, a folder cannot be renamed while another process has one of its files open."""
    refused, replace = set(), Path.replace

    def busy(self, target):
        if target.name == "masks" and self not in refused:
            refused.add(self)
            raise PermissionError(13, "in use")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", busy)
    monkeypatch.setattr(Path, "rename", busy)
    monkeypatch.setattr(atomic, "_PATIENCE", 0.4)
    (tmp_path / ".objectgs-masks-old.part").mkdir()
    (tmp_path / ".objectgs-masks-old.part" / "a.png").write_bytes(b"old")
    with pytest.raises(KeyError), made_masks.new_masks(tmp_path):
        raise KeyError
    assert len(refused) == 1 and (tmp_path / "masks" / "a.png").read_bytes() == b"old"


def test_masks_are_kept_if_others_cannot_take_their_place(tmp_path, monkeypatch):
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "a.png").write_bytes(b"old")

    def refuse(part, path):
        if path.name == "masks" and (part.name == ".objectgs-masks.part" or refuses_all):
            raise PermissionError(13, "in use")
        part.replace(path)

    refuses_all = False
    monkeypatch.setattr(made_masks, "replace_file", refuse)
    for kept in (None, tmp_path / "kept"):
        with pytest.raises(PermissionError), made_masks.new_masks(tmp_path, kept) as folder:
            (folder / "a.png").write_bytes(b"new")
        assert [path.name for path in tmp_path.iterdir()] == ["masks"]
        assert (tmp_path / "masks" / "a.png").read_bytes() == b"old"
    refuses_all = True
    with pytest.raises(PermissionError), made_masks.new_masks(tmp_path):
        pass
    assert len(list(tmp_path.rglob("a.png"))) == 1
    monkeypatch.undo()
    with pytest.raises(KeyError), made_masks.new_masks(tmp_path):
        raise KeyError
    assert (tmp_path / "masks" / "a.png").read_bytes() == b"old"
    with made_masks.new_masks(tmp_path) as folder:
        (folder / "a.png").write_bytes(b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["masks"]
    assert (tmp_path / "masks" / "a.png").read_bytes() == b"new"
