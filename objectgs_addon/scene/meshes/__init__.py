# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes: shown in the scene, and exported by Blender's own exporters."""
