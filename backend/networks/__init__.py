"""Checkpoints of networks, which the user has in a folder."""
