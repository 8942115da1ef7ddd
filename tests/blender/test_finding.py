# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding objects by what the user writes."""

import pytest

pytest.importorskip("bpy")

from objectgs.objectgs_addon import finding

NAMES = ["Mug", "red mug", "red_bowl.001", "Bottle", "bottleneck"]
OBJECTS = [finding.Candidate(10 + i, name) for i, name in enumerate(NAMES)]


@pytest.mark.parametrize("query, ids", [
    ("mug", [10, 11]), ("MUG red", [11]), ("bott", [13, 14]), ("bottle", [13, 14]), ("bowl, mug", [10, 11, 12]),
    ("red", [11, 12]), ("cup", []), ("", []), (" , ", [])])
def test_words_and_parts_of_words(query, ids):
    assert finding.find(query, OBJECTS) == ids


def test_another_finder_has_its_say(monkeypatch):
    """A model's answers are ranked among those by name."""
    def by_sight(query, candidates):
        return [finding.Found(candidate.object_id, 0.9) for candidate in candidates if candidate.name == "Bottle"]

    monkeypatch.setattr(finding, "FINDERS", [finding.by_name, by_sight])
    assert finding.find("red", OBJECTS) == [13, 11, 12]
