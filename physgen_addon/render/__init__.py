# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering into the photo (docs/rendering.md).

render_frames.py       scene folder and bake folder → frames
render_options.py      options, file formats, flags
renderer.py            one frame: small renders over the photo
render_scene.py        the scene as three Blender scenes; render_regions.py what has to be rendered
object_material.py     objects' materials and their highlights
render_engines.py      Cycles and EEVEE
scene_light.py         environment and sun as Blender has them; sky_lamps.py the sky as lamps, for EEVEE
lighting.py            reference lighting, shadows, reflections
motion_blur.py         motion while the shutter is open
clean_plate.py         the photo without its objects
image_finish.py        sharpness, depth of field, film grain
photo_grains.py        grains and torn skins; photo_particles.py liquid surfaces
look_nodes.py          compositor nodes for the layers
"""
