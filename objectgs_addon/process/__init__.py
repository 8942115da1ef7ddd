# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes that run backend commands, and the queue of jobs."""
