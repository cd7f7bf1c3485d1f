# SPDX-License-Identifier: MIT
"""Everything of PhysGen that needs no Blender: it never imports bpy and never looks upward."""
