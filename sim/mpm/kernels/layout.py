# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Row layouts, constants and array types that all kernels share.

Lengths in kernels are counted in grid cells. Particles are grouped in blocks of 4x4x4 cells by the lowest of the three
nodes that they touch on each axis; a block owns a private window of 8x8x8 nodes that starts one node below the block.
A particle's position is kept relative to the window's first node, as a 32-bit integer in units of 2**-28 cells. That
resolves 4e-9 cells everywhere, where a float32 coordinate in a box of 256 cells would resolve 1.5e-5 and lose the
motion of stiff bodies whose substeps are a microsecond long.

A *field* is one deformable body in one world. Blocks belong to a field, so bodies never share nodes; what one body
does to another is contact. Several worlds lie side by side in the same arrays and never interact.
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

SPREAD = 128
"""Loop iterations spent on one block: Taichi's CPU backend gives a thread at least 512 iterations at a time."""

PAIRS = 64
"""Pairs of particles of two bodies that a block of particles lists at most, see ``particle_pairs``."""

SCALARS_PER_BLOCK = 8
"""Numbers that a block reports each substep, see ``ParticleBlocks.report``."""

FARTHEST_BLOCK = 32_000
"""Blocks count from -FARTHEST_BLOCK to FARTHEST_BLOCK on each axis; particles that fly farther stay in the last."""

# Numbers of a world, constant over a segment of time. Lengths in cells.
GRAVITY, GRAVITY_RATE, PLANE_NORMAL, PLANE_OFFSET, RECOVERY_SPEED, HAS_PLANE = 0, 3, 6, 9, 10, 11
WORLD_ROW = 12

# Whole numbers of a world.
FIRST_RIGID_BODY, RIGID_BODIES, FIRST_FIELD, FIELDS, FIRST_PAIR = range(5)
WORLD_INTEGERS = 8

# Numbers of a field, constant over a segment of time; see ``bodies.BodyForces``.
GRAVITY_FACTOR, DRAG, WIND, LIFT = 0, 1, 2, 5
TETHER_STIFFNESS, TETHER_LENGTH, TETHER_ANCHOR, TETHER_STRING = 6, 7, 8, 11
ACCELERATION, ACCELERATION_RATE, GOAL_STIFFNESS, GOAL_DAMPING, MOTION, MOTION_RATE = 12, 15, 18, 19, 20, 23
# Adhesion to the plane: its acceleration and reach. PLANE_GAP: the body's least distance to the plane, which the
# kernels find where there is adhesion; substep n reads number n % 2 of two.
PLANE_ADHESION, PLANE_REACH, PLANE_GAP = 26, 27, 28
SUNK_LIMIT = 30
# Mass (kg) of a cell that is full of the fluid that the field consists of, 0 where it is no fluid of one density.
# SOUND_SPEED_SQUARED: of that fluid, cells²/s².
FULL_MASS, SOUND_SPEED_SQUARED = 31, 32
# THICKNESS: in the same place, of a field that is no such fluid: cells across a body that is thin all over, else 0;
# see ``deformable_contact``. (Another length of the row makes other machine code, and other last bits, of all kernels.)
THICKNESS = 32
FIELD_ROW = 33

FAR = 1e9
"""Cells; a distance beyond the reach of all forces."""

# Whole numbers of a field. WANTS_MEANS: whether the body's means (below) are kept; HAS_ANCHORS: pins or goals.
WORLD, FIRST_TOUCH, WANTS_MEANS, HAS_ANCHORS = range(4)
FIELD_INTEGERS = 4

# Means of a field: centre of mass where the next substep finds it (cells), velocity (cells/s), angular
# velocity (1/s).
MEAN_PLACE, MEAN_VELOCITY, MEAN_SPIN = 0, 3, 6
MEAN_ROW = 9

# Contact of a field with an obstacle (its world's plane is obstacle 0, solid i is obstacle i + 1), or another field.
STICKING, SLIDING, MODE, RESTITUTION = range(4)
TOUCH_ROW = 4
SEPARATE, SLIP, STICKY = range(3)
"""Numbers of ``contacts.MODES``."""

# Adhesion of the same pairs: acceleration (cells/s²) that the whole pull gives the field's mass (of two fields, their
# reduced mass), reach (cells, below all gaps where nothing adheres), and 1 over that mass (1/kg).
ADHESION_PULL, ADHESION_REACH, ADHESION_UNIT = range(3)
ADHESION_ROW = 3

# Progress of a world through a segment of time, float64. Seconds, cells, cells/s.
REMAINING, ELAPSED, STEP, NEXT_STEP, PHASE, SCATTER, STORE, SPEED, WAVE_SPEED, MARGIN = range(10)
CFL_SCALE, SUBSTEPS, STATUS = range(10, 13)
RIGID_SPEED, RIGID_DRIFT, LOST_FIELD, FASTEST_FIELD, LONGEST_STEP, SHORTEST_STEP = range(13, 19)
CONTROL_ROW = 19

IDLE, PRIME, FULL = range(3)
"""Phases: nothing; particles to grid only (after a sort); a whole substep."""

RUNNING, WANTS_SORT, DONE, DIVERGED = range(4)
"""Statuses."""

vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
ivec3 = ti.types.vector(3, ti.i32)
mat3 = ti.types.matrix(3, 3, ti.f32)

Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
Doubles = ti.types.ndarray(dtype=ti.f64, ndim=1)
Keys = ti.types.ndarray(dtype=ti.i64, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Vectors3 = ti.types.ndarray(dtype=vec3, ndim=1)
Vectors4 = ti.types.ndarray(dtype=vec4, ndim=1)
Cells = ti.types.ndarray(dtype=ivec3, ndim=1)
Matrices = ti.types.ndarray(dtype=mat3, ndim=1)


@ti.func
def triple(numbers: Scalars, first: ti.i32):
    """The three numbers from ``first`` on."""
    return vec3(numbers[first], numbers[first + 1], numbers[first + 2])
