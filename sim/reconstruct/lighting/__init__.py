# SPDX-License-Identifier: MIT
"""Cast shadows, the environment and the sun of a photo.

shadow_masks.py        shadows of the objects; shadow_planes.py what they fall on, shadow_levels.py the light that
                       its pixels keep: shadow_lamps.py the lamps that explain it, shadow_model.py its probability
ground_pixels.py       the ground's colours; standing_surface.py which part of it the objects stand on
light_estimate.py      environment and sun; lamps.py from shadows, ground_observation.py the
                       ground that shows these, ground_lighting.py their shares
ground_gloss.py        mirror images of the objects; ground_roughness.py how blurred they are
"""
