"""Splat code shared by backend and add-on: blending constants, spherical harmonics, picking, convex hulls."""
