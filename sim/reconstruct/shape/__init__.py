# SPDX-License-Identifier: MIT
"""From a mask to a closed body that stands on the ground, textured by the photo.

object_bodies.py       a body for each object, in order; built_body.py makes one from its outline
primitives.py          boxes, spheres, surfaces of revolution; primitive_fit.py fits one to an outline,
                       primitive_choice.py decides which, shape_kinds.py usual shapes of things,
                       primitive_mesh.py makes its mesh, flat_disc.py finds coins
inflate.py             thickness of a silhouette; inflated_mesh.py its mesh
reference_surfaces.py  middle surfaces of inflated bodies, from a wall, legs or a depth map; legs.py finds legs,
                       lying.py lays rings and sticks on the ground, floor_limbs.py what lies in front of a body
furniture.py           chairs, tables and shelves as boards; boards.py their mesh
surface_mesh.py        marching cubes at a wanted number of vertices
stability.py           how safely a body stands, and a broader base
object_placement.py    supports, what hangs, and bodies apart
body_texture.py        pixels of the photo on a body; even_light.py without their light
texture_atlas.py       texture for all sides; surface_charts.py its layout, surface_values.py what it depends on,
                       plain_matter.py what no pixel shows, stripes.py what goes round, hidden_seams.py no seams in it,
                       texture_shading.py the photo's light in it
"""
