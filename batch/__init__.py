# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry points without a user interface: the ``physgen`` command, and scripts for Blender in background mode."""
