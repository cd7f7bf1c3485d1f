# SPDX-License-Identifier: MIT
"""Numbers and array types that every kernel of the engine agrees on.

Lengths in kernels are counted in grid cells. Particles are grouped in blocks of 4x4x4 cells by the lowest of the three
nodes that they touch on each axis; a block owns a private window of 8x8x8 nodes that starts one node below the block.
A particle's position is kept relative to the window's first node, as a 32-bit integer in units of 2**-28 cells. That
resolves 4e-9 cells everywhere, where a float32 coordinate in a box of 256 cells would resolve 1.5e-5 and lose the
motion of stiff bodies whose substeps are a microsecond long.
"""

import taichi as ti

BLOCK = 4
"""Cells along a block."""

WINDOW = 8
"""Nodes along a block's window; leaves one cell of drift on either side."""

WINDOW_NODES = WINDOW**3
BLOCK_NODES = BLOCK**3

FIXED_BITS = 28
FIXED_ONE = 1 << FIXED_BITS
"""One cell in fixed-point positions."""

FIXED_LOW = FIXED_ONE // 2
FIXED_HIGH = 13 * (FIXED_ONE // 2) - 1
"""Window coordinates 0.5 up to 6.5 cells: where all three nodes of a particle lie in the window."""

WALL_NODES = 6
"""Nodes 0..6 and grid-7..grid-1 never move outward, which keeps particles out of the outermost blocks."""

SPREAD = 128
"""Loop iterations spent on one block: Taichi's CPU backend gives a thread at least 512 iterations at a time."""

SCALARS_PER_BLOCK = 8
"""Numbers that a block reports each substep, see ``transfer.advance_particles``."""

vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
ivec3 = ti.types.vector(3, ti.i32)
mat3 = ti.types.matrix(3, 3, ti.f32)

Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Vectors3 = ti.types.ndarray(dtype=vec3, ndim=1)
Vectors4 = ti.types.ndarray(dtype=vec4, ndim=1)
Cells = ti.types.ndarray(dtype=ivec3, ndim=1)
Matrices = ti.types.ndarray(dtype=mat3, ndim=1)
