"""Edits that are stored apart from objects.json."""
