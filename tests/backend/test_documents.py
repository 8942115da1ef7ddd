"""The figures in docs/ and README are those that benchmarks measured."""

import json
import re
import shutil

import numpy as np
import pytest

from backend.shared import expectation
from benchmarks import documents, length, quoted, suite

KNOWN = {path.stem for path in documents.FIGURES.glob("*.json")}


def test_documents_are_as_their_figures_make_them():
    assert documents.differing() == []


def test_every_document_of_a_benchmark_has_figures():
    names = {*documents.MADE_FROM_FIGURES, *documents.WRITTEN_WHOLE}
    assert {*quoted.SOURCES, *documents.WRITTEN_WHOLE} <= KNOWN <= names
    assert not any((documents.DOCS / f"{name}.md").exists() for name in names - KNOWN)


@pytest.mark.parametrize("name", [*(f"docs/{name}.md" for name in sorted(KNOWN)), "docs/results.md", "README.md"])
def test_figure_changed_by_hand_is_found(name, tmp_path, monkeypatch):
    shutil.copytree(documents.DOCS, tmp_path / "docs")
    shutil.copy(documents.README, tmp_path / "README.md")
    monkeypatch.setattr(documents, "ROOT", tmp_path)
    monkeypatch.setattr(documents, "DOCS", tmp_path / "docs")
    monkeypatch.setattr(documents, "FIGURES", tmp_path / "docs" / "figures")
    monkeypatch.setattr(documents, "README", tmp_path / "README.md")
    assert documents.differing() == []
    path = tmp_path / name
    text = path.read_text(encoding="utf-8")
    start = text.index("<!-- figures -->") if name == "README.md" else 0
    digit = re.compile(r"(?<=[ .\d])\d(?= )").search(text, start)
    changed = str((int(digit.group()) + 1) % 10)
    path.write_text(text[: digit.start()] + changed + text[digit.end() :], encoding="utf-8")
    assert documents.differing() == [name]


def test_expectations_are_those_measured():
    """The PSNR that a training is said to lack is that of the lengths in docs/figures/length.json."""
    found = documents.load("length")
    best = length.mean_psnr(found[length.CONVERGED])
    measured = {
        round(length.mean_steps(rows)): round(max(best - length.mean_psnr(rows), 0.0), 1)
        for name, rows in found.items()
        if name != length.CONVERGED
    }
    for steps, (least, most) in expectation.SHORT_OF_FINAL.items():
        assert least == most == measured[steps], steps


def test_expected_quality_is_that_of_the_suite():
    fit, errors = suite.fit_of_psnr(documents.load("suite"))
    assert np.allclose(expectation.PSNR_FIT, fit, rtol=0.005)
    inside = [abs(error) <= fit.margin for error in errors.values()]
    assert np.mean(inside) >= 0.8 and len(inside) >= 10


def test_text_without_a_value_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "page.md").write_text("{known} and {unknown}")
    monkeypatch.setattr(documents, "TEMPLATES", tmp_path)
    with pytest.raises(KeyError):
        documents.filled("page.md", {"known": "1"})


def test_figures_are_rounded_and_read_again(tmp_path, monkeypatch):
    monkeypatch.setattr(documents, "FIGURES", tmp_path)
    monkeypatch.setattr(documents, "documents", dict)
    documents.save("some", {"a": 1.23456789, "b": [1, {"c": 2.0}], 0.3: None})
    assert documents.load("some") == {"a": 1.23457, "b": [1, {"c": 2.0}], "0.3": None}
    assert json.loads((tmp_path / "some.json").read_text())["a"] == 1.23457
