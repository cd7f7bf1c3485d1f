# SPDX-License-Identifier: GPL-3.0-or-later
"""Entries without a user interface: the ``physgen`` command and the scripts that Blender runs in the background."""
