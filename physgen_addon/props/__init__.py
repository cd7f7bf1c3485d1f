# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender remembers for PhysGen: in the scene, so that it is saved and undone, and in the preferences."""
