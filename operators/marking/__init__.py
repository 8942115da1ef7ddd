# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects by strokes on them, for reconstructions without masks."""
