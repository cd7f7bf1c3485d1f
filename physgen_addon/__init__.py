# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blender side of PhysGen. ``bridge`` is bpy without any user interface."""
