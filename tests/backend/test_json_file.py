"""Reading of valid, invalid and oversized JSON files."""

import pytest

from backend.capture.names import read_names
from backend.shared.errors import InputError
from backend.shared.formats import json_file
from backend.shared.formats.json_file import parse_json, read_json, write_json

DEEP = "[" * 100_000
BAD = [DEEP, '{"a": ' * 100_000, "1" * 5000, "[NaN]", "[Infinity]", "{", "", "\xff"]


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_invalid_json_is_rejected(tmp_path, text):
    path = tmp_path / "objects.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"objects\.json cannot be read as JSON .*; repair it"):
        read_json(path)
    (tmp_path / "labels.json").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"labels\.json is not a list of labels"):
        read_names(tmp_path)


def test_oversized_json_is_rejected(tmp_path, monkeypatch):
    write_json(tmp_path / "plan.json", list(range(1000)))
    assert read_json(tmp_path / "plan.json") == list(range(1000))
    monkeypatch.setattr(json_file, "LARGEST", 1000)
    with pytest.raises(InputError, match=r"plan\.json .*larger than"):
        read_json(tmp_path / "plan.json")


def test_valid_json_is_parsed():
    assert parse_json(b'{"a": [1, 2.5, null, "\\u00e4", "\\ud83d\\ude00"]}') == {
        "a": [1, 2.5, None, "\u00e4", "\U0001f600"]
    }


def test_halves_of_surrogate_pairs_can_be_written_again(tmp_path):
    path = tmp_path / "objects.json"
    path.write_text('{"\\ud800": "a\\uDC00b \\ud83d\\ude00"}')
    assert read_json(path) == {"?": "a?b \U0001f600"}
    write_json(path, read_json(path))
    assert read_json(path) == {"?": "a?b \U0001f600"}
