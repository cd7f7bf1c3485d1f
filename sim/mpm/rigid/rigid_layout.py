# SPDX-License-Identifier: MIT
"""Columns of rigid bodies, contact pairs and contacts in the flat arrays of ``kernels.kernel_arrays``.

A body is dynamic (DYNAMIC), or a collider with prescribed motion (KINEMATIC) or at rest (STATIC); arrays and
checkpoints call them solids. Lengths in cells, seconds, kilograms, radians; world axes unless said otherwise.
Imports no Taichi.
"""

WAITING, DYNAMIC, KINEMATIC, STATIC = -1, 0, 1, 2
"""Types of bodies; one that waits for its start time stays in place and touches nothing."""

RECOVERY_HEIGHT = 0.02
"""Cells that a body which starts in another could fly up if the position correction were kept as velocity."""

# ---- per body, changing: ``solids`` f64 --------------------------------------------------------------------------
STATE = 64
"""Stride."""

X = 0  # centre of mass, of colliders the pivot (3)
Q = 3  # orientation: quaternion w, x, y, z (4)
V = 7  # velocity (3)
L = 10  # angular momentum about the centre of mass (3); of colliders unused
W = 13  # angular velocity (3)
ACCELERATION = 16  # rate of change of V in the last substep, 0 after a bounce (3)
SPIN_UP = 19  # the same of W (3)
V_NEXT = 22  # V as ``predict`` expects it after this substep (3)
W_NEXT = 25  # the same of W (3)
R = 28  # rotation matrix of Q, row by row: world = X + R local (9)
J = 37  # inverse inertia, row by row; zero unless dynamic (9)
PUSH_V = 46  # velocity that only takes depth out of contacts, not kept (3)
PUSH_W = 49  # (3)
V_BEFORE = 52  # V when the substep began (3)
W_BEFORE = 55  # (3)
TOUCHED = 58  # 1 when something pushed the body in this substep, 2 when it bounced
BLEND = 59  # share of the second lattice in a collider that deforms

# ---- per body, constant between segments: ``solid_numbers`` f64 ---------------------------------------------------
NUMBERS = 48
INVERSE_MASS = 0
MASS = 1
INERTIA = 2  # about the centre of mass, body axes (9)
INVERSE_INERTIA = 11  # (9)
RADIUS = 20  # of the surface about the centre of mass or pivot
GRAVITY_FACTOR = 21
DRAG = 22  # 1/cells
WIND = 23  # (3)
LIFT = 26
TETHER_STIFFNESS = 27
TETHER_LENGTH = 28
TETHER_ANCHOR = 29  # (3)
TETHER_STRING = 32
UNIFORM = 33  # acceleration (3)
BLEND_RATE = 36  # 1/s
SPACING = 37  # of the surface points
BULGE = 38  # how far the surface stands out between its points where it is round

# ---- per body, whole numbers: ``solid_kinds`` i32 ------------------------------------------------------------------
KINDS = 8
KIND = 0
SHAPE = 1  # first lattice
LAYERS = 2  # 1, or 2 of a collider that deforms
CLUSTERS = 3  # its first cluster of surface points
HULL_END = 4  # clusters up to here hold the corners of the convex hull, which are all that a plane can touch
CLUSTERS_END = 5
MOTION = 6  # where the velocities of the first lattice of a collider that deforms begin in ``motions``

# ---- surface points: ``clusters`` f32 (4 a cluster: centre, radius), ``cluster_starts`` i32, ``points`` f32 ---------
POINT = 12
"""Stride: ``collision_shapes.PATCH`` numbers and 1 where the surface is smooth, 0 at edges and corners."""

# ---- per world: ``world_spans`` i32, ``world_numbers`` f64, ``world_report`` f64 ------------------------------------
SPANS = 6  # first body, end of bodies, first pair, end of pairs, first collider, start in ``systems`` or -1
WORLD = 16
GRAVITY = 0  # (3)
PLANE = 3  # two tangents and the normal of the plane (9)
OFFSET = 12  # normal . x on the plane
RECOVERY = 13  # fastest speed at which depth is taken out
REPORT = 5  # contacts, largest depth, sweeps, steps of Newton's method, largest change of velocity in the last sweep

# ---- pairs: ``pairs`` i32, ``pair_numbers`` f64 ---------------------------------------------------------------------
PAIRS = 4  # body a whose points touch, body b that they touch (-1: the plane), the pair the other way round or -1
CONTACT = 8
KINETIC, STATIC_FRICTION, RESTITUTION, MODE, LEVER, ADHESION, ADHESION_REACH = range(7)
SEPARATE, SLIP, STICKY = range(3)

# ---- contacts: ``counts`` i32 (a pair), ``contacts`` and ``memory`` f64 ---------------------------------------------
SLOTS = 24
"""Contacts of a pair."""

ROW = 40
ARM_A = 0  # from a's centre to the contact (3)
ARM_B = 3  # (3)
NORMAL = 6  # from b to a (3)
KN = 9  # speed along the normal that an impulse of 1 makes
KT = 10  # the same along the surface, in the most compliant direction
KR = 11  # rate of rolling that an angular impulse of 1 makes
TARGET = 12  # least speed of leaving
PUSH = 13  # speed at which depth is taken out
IMPULSE = 14  # along the normal
RUB = 15  # along the surface (3)
ROLL = 18  # angular, against rolling (3)
PUSH_IMPULSE = 21
FRICTION = 22
BOTH_WAYS = 23  # 1: may also pull
DRIFT = 24  # velocity of a deforming surface (3)
GAP = 27
PLACE = 28  # in b's frame (3)
PULL = 31  # impulse of the adhesion
BOUNCE = 32
LIMIT = 33  # of RUB's length and of ROLL's

MEMORY = 12  # place in b's frame (3), impulse, rub (3), roll (3), used

BINS = 6
"""Contacts of a pair are thinned separately for each side (axis and sign) of b's frame that they face."""

CHOSEN = 9
"""In each bin: the farthest in 8 directions, and the deepest."""
