# SPDX-License-Identifier: GPL-3.0-or-later
"""State saved in the .blend and the preferences, and its sync with the reconstruction folder."""
