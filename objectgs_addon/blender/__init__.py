# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender helpers: messages, writing from timers and handlers, console output, and .blend files of older versions."""
