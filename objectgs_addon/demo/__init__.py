# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of the demo capture: shapes, materials, scene, rendering, sparse points, files.

`objectgs_addon.demo.capture` puts them together.  Only `bpy`, `numpy` and the standard library are used.
Everything is in meters with Z up; cameras follow OpenCV (x right, y down, z forward), pixel centers at +0.5.
"""
