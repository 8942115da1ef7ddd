"""File names from the names of objects."""

import pytest

from backend.shared.formats.file_names import LONGEST, distinct_stems, file_stem, hashed_stem


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("mug", "mug"),
        ("große Kiste", "große_Kiste"),
        ("a/b\\c:d*e", "a_b_c_d_e"),
        ("../../etc/passwd", "etc_passwd"),
        ("  .hidden. ", "hidden"),
        ("CON", "CON-file"),
        ("aux.txt", "aux.txt-file"),
        ("com1", "com1-file"),
        ("common", "common"),
        ("\ud800", "object"),
        ("///", "object"),
        ("", "object"),
    ],
)
def test_stems_are_valid_on_all_platforms(name, stem):
    assert file_stem(name) == stem


@pytest.mark.parametrize("name", ["x" * 300, "ä" * 300, "\U0001f600" * 300 + "x", "e\u0301" * 200])
def test_stems_have_limited_length(name):
    assert 0 < len(file_stem(name).encode()) <= LONGEST


def test_duplicate_names_get_key_suffix():
    assert distinct_stems({1: "mug", 2: "can", 3: "mug"}) == {1: "mug", 2: "can", 3: "mug_3"}


def test_stems_are_unique_ignoring_case():
    names = {
        1: "mug",
        2: "mug_3",
        3: "mug",
        4: "MUG",
        5: "mug_3_2",
        6: "Mug_4",
        7: "café",
        8: "cafe\u0301",
        9: "///",
        10: "",
    }
    stems = distinct_stems(names)
    assert list(stems) == list(names) and stems[1] == "mug" and stems[2] == "mug_3"
    assert len({stem.casefold() for stem in stems.values()}) == len(names)


def test_hashed_stems_are_unique():
    names = ["1", "1.", "_1", "scene", "Scene", "pair", "Pair", "pair ", "///", "...", "con", "con-file"]
    assert len({hashed_stem(name).casefold() for name in names}) == len(names)
    assert hashed_stem("pair") == "pair" and hashed_stem("Pair") == hashed_stem("Pair") != "Pair"
