# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo capture: shapes, materials, scene, rendering, sparse points and files.

`objectgs_addon.demo.capture` combines these parts. All coordinates are in meters with Z up. Cameras follow the OpenCV
convention (x right, y down, z forward) with pixel centers at +0.5.
"""
