# SPDX-License-Identifier: MIT
"""Image formation without Blender: rendered layers and the photo become one frame (docs/rendering.md).

compositing.py         a frame from its layers
reference_light.py     light on objects that stand where the photo shows them; pull_push.py what it hides
disocclusion.py        pixels of the photo that stay valid as an object moves
floor_reflection.py    reflections in the floor; highlights.py on things
blur.py                depth of field, outlines; film_grain.py the photo's noise
backdrop.py            the background for a moving camera; outpaint.py around the photo
inpaint.py             PatchMatch
image_metrics.py       PSNR, SSIM
side_by_side.py        real motion beside simulations
"""
