# SPDX-License-Identifier: MIT
"""Pictures of splats, and gradients back to them (Taichi).

rasteriser.py    the way in: render, gradients
projection.py    splats ↔ ellipses in the picture
tiles.py         which splats each tile blends, in which order
blending.py      ellipses ↔ pixels
"""

# Importing it keeps Taichi from greeting on standard output, which belongs to the caller's own results.
from ... import mpm  # noqa: F401
