# SPDX-License-Identifier: GPL-3.0-or-later
"""Helpers around Blender itself: messages, writing from timers, its console output, .blend files of older versions."""
