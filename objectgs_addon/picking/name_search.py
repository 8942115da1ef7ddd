# SPDX-License-Identifier: GPL-3.0-or-later
"""Search for objects by words of their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def find_by_name(query: str, names: Mapping[int, str]) -> list[int]:
    """Find the objects whose names contain the words of a query, in any case and order.

    Args:
        query: words or parts of words; commas separate alternatives.
        names: object ID -> name.

    Returns:
        IDs of the objects found. Names that equal the query come first, then those that contain it as whole words, then
        those that contain it as parts of words.
    """
    alternatives = [words for words in (part.casefold().split() for part in query.split(",")) if words]
    scores = {
        object_id: max((_score(words, name.casefold()) for words in alternatives), default=0)
        for object_id, name in names.items()
    }
    return sorted((object_id for object_id in scores if scores[object_id]), key=lambda object_id: -scores[object_id])


def _score(words: Sequence[str], name: str) -> int:
    """Return 3 if the name equals the words, 2 if it contains them as words, 1 as parts of words, 0 not at all."""
    if not all(word in name for word in words):
        return 0
    own = name.replace("_", " ").replace("-", " ").replace(".", " ").split()
    if own == list(words):
        return 3
    return 2 if set(words) <= set(own) else 1
