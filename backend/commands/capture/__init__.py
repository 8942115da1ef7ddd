"""Commands on a capture (check, import, plan, vote) and the import of splats from other programs."""
