"""Decisions about which steps a capture needs, made before training: `decisions`, based on facts from `coverage`."""
