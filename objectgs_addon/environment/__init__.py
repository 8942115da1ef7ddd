# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python environment of the backend: its location, state and set-up."""
