"""Meshes of single objects from splats: renders in each view -> signed distance field -> surface -> UVs -> texture."""
