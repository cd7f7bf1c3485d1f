# SPDX-License-Identifier: MIT
"""Segmentation: masks of objects, their occlusion order, and amodal completion.

object_proposals.py    objects without a box: proposal_features.py features of a candidate, round_things.py and
                       alike_blocks.py many of a kind, whole_objects.py which are whole,
                       joined_pieces.py which are pieces of one, outline_sharpness.py what is in focus
object_masks.py        masks from the user, an adapter, or boxes
box_segmentation.py    the object in a loose box: box_crop.py its surroundings, mask_proposals.py proposals by
                       colour_models.py, plain_backdrop.py before a plain backdrop, mirrored_outline.py alike left and
                       right, contour_evidence.py and border_ownership.py what belongs to it
gaps_and_rods.py       gaps and rods; hidden_legs.py, limb_ends.py, outer_rim.py, part_contour.py more parts
ground_shade.py        ground that a mask has taken; reflected_colour.py with the object's colour
strokes.py             the user's strokes
mask_cleanup.py        specks and steps; matting.py alpha, mask_geometry.py parts and extent, mask_notices.py doubts
occlusion_order.py     who is in front
amodal_completion.py   hidden parts; outline_guesses.py guesses of the whole outline,
                       hidden_solids.py boxes and round bodies
"""
