"""Loaded before any test: importing the backend first settles how the libraries' threads wait for one another."""

import backend  # noqa: F401
