"""File formats: JSON, PLY vertices and PLY meshes, with atomic writes."""
