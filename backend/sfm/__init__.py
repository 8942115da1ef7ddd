"""Camera poses and points from photos alone: structure from motion by COLMAP, in processes that can be stopped."""
