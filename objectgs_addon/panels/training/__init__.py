# SPDX-License-Identifier: GPL-3.0-or-later
"""The Train panel with its sub-panels: the plan, the settings and the measured quality."""
