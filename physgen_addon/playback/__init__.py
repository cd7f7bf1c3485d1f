# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes and captures played in Blender.

show_bake.py           show and hide a bake; bake_record.py by which a scene finds it again
point_caches.py        caches as modifiers; particles.py particles and torn skins, splat_clouds.py splats
capture_scene.py       a capture as a collection; capture_motion.py its motion, capture_materials.py its looks
capture_view.py        what of it is visible, and two bakes overlaid; geometry_nodes.py the nodes that play it
movie_clips.py         tracks of the Movie Clip editor as a capture
"""
