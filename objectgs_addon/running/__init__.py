# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs in a running Blender: the timer that polls them, their display, and previews."""
