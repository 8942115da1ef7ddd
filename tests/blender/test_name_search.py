# SPDX-License-Identifier: GPL-3.0-or-later
"""Search for objects by words of their names."""

import pytest

pytest.importorskip("bpy")

from objectgs.objectgs_addon.picking.name_search import find_by_name

NAMES = ["Mug", "red mug", "red_bowl.001", "Bottle", "bottleneck"]
OBJECTS = {10 + i: name for i, name in enumerate(NAMES)}


@pytest.mark.parametrize(
    ("query", "ids"),
    [
        ("mug", [10, 11]),
        ("MUG red", [11]),
        ("bott", [13, 14]),
        ("bottle", [13, 14]),
        ("bowl, mug", [10, 11, 12]),
        ("red", [11, 12]),
        ("cup", []),
        ("", []),
        (" , ", []),
    ],
)
def test_search_finds_words_and_word_parts(query, ids):
    assert find_by_name(query, OBJECTS) == ids
