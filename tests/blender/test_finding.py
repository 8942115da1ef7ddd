# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding objects by what the user writes, and the order in which splats are drawn."""

import numpy as np
import pytest

pytest.importorskip("bpy")

from objectgs.objectgs_addon import finding
from objectgs.objectgs_addon.drawing.order import back_to_front

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


@pytest.mark.parametrize("orthographic", [False, True])
def test_splats_come_from_far_to_near(orthographic):
    depths = np.random.default_rng(0).uniform(-1.0, 50.0, 20_000).astype(np.float32)
    order = back_to_front(depths, -100.0 if orthographic else 0.01, orthographic)
    ahead = depths > (-100.0 if orthographic else 0.01)
    assert sorted(order.tolist()) == np.flatnonzero(ahead).tolist()
    steps = np.diff(depths[order])
    assert (steps <= (0.001 if orthographic else 3e-4 * depths[order][1:])).all()


def test_splats_at_one_depth_keep_their_order():
    assert back_to_front(np.full(5, 2.0, np.float32), 0.1, False).tolist() == [0, 1, 2, 3, 4]
    assert back_to_front(np.full(5, 2.0, np.float32), 0.1, True).tolist() == [0, 1, 2, 3, 4]
    assert len(back_to_front(np.full(5, -2.0, np.float32), 0.1, False)) == 0
