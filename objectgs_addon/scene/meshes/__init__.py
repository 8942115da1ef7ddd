# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes: display in the scene, and export with Blender's own exporters."""
