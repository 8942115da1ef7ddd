# SPDX-License-Identifier: GPL-3.0-or-later
"""How points and splats look in the viewport and in renders."""
