# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs in Blender: the timer that polls them, their display, results and previews."""
