"""Loaded before any test: importing the backend first settles how the libraries' threads wait for one another."""

import os

# Several processes test at the same time. Threads that wait should leave the cores to the others.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import backend  # noqa: F401
