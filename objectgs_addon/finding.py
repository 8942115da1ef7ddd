# SPDX-License-Identifier: GPL-3.0-or-later
"""Finding objects by what the user writes. A finder ranks objects for a query; the one by names is always there, and
others, such as one that asks a model what a photo shows, may be added."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Candidate:
    """An object that may be meant: its ID and its name."""

    object_id: int
    name: str


@dataclass(frozen=True)
class Found:
    """An object that a finder takes for what is meant; score: 0 .. 1, higher is likelier."""

    object_id: int
    score: float


Finder = Callable[[str, Sequence[Candidate]], list[Found]]
"""Takes the query and the objects; returns those that match, in any order."""


def by_name(query: str, candidates: Sequence[Candidate]) -> list[Found]:
    """Objects whose names have the query's words in them, whatever their case and order; commas part alternatives.

    A name that is the query scores 1, one that has its words as whole words 0.8, as parts 0.5.
    """
    found = []
    wanted = [words for words in (part.casefold().split() for part in query.split(",")) if words]
    for candidate in candidates:
        score = max((_score(words, candidate.name.casefold()) for words in wanted), default=0.0)
        if score > 0.0:
            found.append(Found(candidate.object_id, score))
    return found


FINDERS: list[Finder] = [by_name]


def find(query: str, candidates: Sequence[Candidate]) -> list[int]:
    """IDs of the objects that any finder takes for what is meant, the likeliest first."""
    best: dict[int, float] = {}
    for finder in FINDERS:
        for found in finder(query, candidates):
            best[found.object_id] = max(best.get(found.object_id, 0.0), found.score)
    return sorted(best, key=lambda object_id: -best[object_id])


def _score(words: Sequence[str], name: str) -> float:
    if not all(word in name for word in words):
        return 0.0
    own = name.replace("_", " ").replace("-", " ").replace(".", " ").split()
    if own == list(words):
        return 1.0
    return 0.8 if set(words) <= set(own) else 0.5
