# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender scenes to scene folders and back.

export_scene.py        a scene as a folder that the worker simulates: export_objects.py physics of objects,
                       export_meshes.py their meshes, export_world.py all around them,
                       export_animation.py units, clock and keyframes, stand_ins.py what is simulated in their place
export_compose.py      objects to be composed
motion_fingerprint.py  a hash of what moves things
import_scene.py        a folder or splats into Blender; import_physics.py physics and keyframes
photo_view.py          the photo's camera, background, ground and light
sample_scene.py        a scene to begin with
"""
