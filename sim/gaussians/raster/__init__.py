# SPDX-License-Identifier: MIT
"""Differentiable rasterisation of splats (Taichi).

rasteriser.py        render and gradients, the interface
splat_projection.py  splats ↔ ellipses in the image
tile_blending.py     which splats each tile blends, in which order; ellipses ↔ pixels
"""

# Importing it keeps Taichi from greeting on standard output, which belongs to the caller's own results.
from ... import mpm  # noqa: F401
