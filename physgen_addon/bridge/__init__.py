# SPDX-License-Identifier: GPL-3.0-or-later
"""bpy without any user interface: scenes, caches, passes, frames and video (docs/rendering.md)."""
