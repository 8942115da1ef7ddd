# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of objects, and the objects that are marked by strokes."""

from .marking import MarkedList, MarkingPanel
from .panel import ObjectList, ObjectsPanel

__all__ = ["MarkedList", "MarkingPanel", "ObjectList", "ObjectsPanel"]
