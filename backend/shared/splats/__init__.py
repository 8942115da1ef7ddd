"""What drawing splats needs in both processes: blending constants, spherical harmonics, picking, convex hulls."""
