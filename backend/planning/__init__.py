"""Decisions about what training needs for a capture, made before any work: `decisions` from the facts of `coverage`."""
