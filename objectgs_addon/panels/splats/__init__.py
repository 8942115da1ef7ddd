# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel of single splats, and the menu of objects that they can be assigned to."""

from .assign_menu import AssignMenu
from .panel import SplatsPanel

__all__ = ["AssignMenu", "SplatsPanel"]
