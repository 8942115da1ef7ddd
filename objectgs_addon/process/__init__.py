# SPDX-License-Identifier: GPL-3.0-or-later
"""Backend commands as child processes, and the queue of jobs. No bpy."""
