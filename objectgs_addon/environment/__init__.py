# SPDX-License-Identifier: GPL-3.0-or-later
"""Python environment of the backend: location, state and setup."""
