# SPDX-License-Identifier: GPL-3.0-or-later
"""What ObjectGS holds and shows inside Blender, and the demo capture that Blender renders itself."""
