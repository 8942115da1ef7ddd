"""Fusion of the views of an object into a signed distance field, and extraction of its surface."""
