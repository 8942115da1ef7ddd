# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators share: when they can run, how they report errors, the export dialog."""
