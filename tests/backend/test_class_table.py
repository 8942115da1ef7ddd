"""Conversion between object IDs and class indices."""

import numpy as np
import pytest

from backend.shared.class_table import ClassTable


@pytest.mark.parametrize("ids", [[0, 3, 70_000, 4_000_000_000], [1, 2, 5], []])
def test_ids_map_to_classes_and_back(ids):
    table = ClassTable(ids[::-1] * 2)
    assert table.ids.tolist() == ids and len(table) == len(ids)
    assert table.classes_of(np.array(ids, np.int64)).tolist() == list(range(len(ids)))
    assert table.ids_of(np.arange(len(ids))).tolist() == ids


def test_unknown_ids_map_to_no_class():
    table = ClassTable([1, 2, 5])
    mask = np.array([[0, 1], [4, 6]], np.uint32)
    assert table.classes_of(mask).tolist() == [[-1, 0], [-1, -1]]
    assert table.ids_of(table.classes_of(mask)).tolist() == [[0, 1], [0, 0]]
    assert ClassTable([]).classes_of(mask).tolist() == [[-1, -1], [-1, -1]]
    assert table.classes_among([5, 7, 1]).tolist() == [0, 2] and table.ids_of([]).tolist() == []
