"""Depth of surfaces without features, from photos with known poses."""
