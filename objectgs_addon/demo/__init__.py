# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of the demo capture: shapes, materials, scene, rendering, sparse points, files.

`objectgs_addon.demo_capture` puts them together.  Only `bpy`, `numpy` and the standard library are used.
Everything is in metres with Z up; cameras follow OpenCV (x right, y down, z forward), pixel centres at +0.5.
"""
