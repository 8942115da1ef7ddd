"""Trainings that continue from a trained model: other object IDs, and flat splats for meshes."""
