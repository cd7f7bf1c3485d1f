# SPDX-License-Identifier: MIT
# mypy: disable-error-code="valid-type"
"""Bundles of device arrays that the engine's kernels take; ``layout`` and ``rigid_layout`` name columns of flat rows.

Lengths in grid cells, seconds, kilograms, world axes unless said otherwise. Shapes: W worlds, F fields (deformable
bodies), N particles, P particle blocks, G grid blocks, S rigid bodies and colliders, C contact pairs. Arrays of blocks
are longer than the counts say, so that they need not be made anew at every sort. A row of numbers per world, field,
body or pair is stored flat: shape (W, WORLD_ROW) is an array of W * WORLD_ROW numbers.
"""

from typing import NamedTuple

import taichi as ti

from .layout import Cells, Doubles, Integers, Keys, Matrices, Scalars, Vectors3, Vectors4


class StepLimits(NamedTuple):
    """Courant numbers: cells that the fastest wave and the fastest particle travel in a substep."""

    elastic: ti.f64
    velocity: ti.f64


class WorldArrays(NamedTuple):
    """Worlds and their fields: parameters of a segment of time, and progress through it."""

    count: ti.i32
    """W."""

    mean_fields: ti.i32
    """F, or 0 where no field's means are wanted."""

    integers: Integers
    """(W, WORLD_INTEGERS) spans of a world's bodies, fields and pairs."""

    numbers: Scalars
    """(W, WORLD_ROW) gravity, ground plane, recovery speed."""

    field_integers: Integers
    """(F, FIELD_INTEGERS) world of a field, first contact row, flags."""

    field_numbers: Scalars
    """(F, FIELD_ROW) forces on a field; two of them (PLANE_GAP) are written by the kernels."""

    contacts: Scalars
    """(., TOUCH_ROW) friction and restitution of a field with the plane and with each rigid body or collider."""

    pairs: Scalars
    """(., TOUCH_ROW) the same of two fields."""

    materials: Scalars
    """(., ROW) parameters of a material: model, damping, own parameters, fibres."""

    control: Doubles
    """(W, CONTROL_ROW) progress of a world: phase, step, time left, fastest particle and wave, status."""

    means: Scalars
    """(F, MEAN_ROW) centre of mass (cells), velocity (cells/s), angular velocity (1/s) of a field."""


class ParticleBlocks(NamedTuple):
    """Occupied blocks of 4x4x4 cells in the order of the particles; a block belongs to one field."""

    count: ti.i32
    """P."""

    cells: Cells
    """(P,) block coordinates: lowest cell / 4."""

    field: Integers
    """(P,) field of a block."""

    starts: Integers
    """(P + 1,) first particle of a block."""

    neighbours: Integers
    """(P, 27) grid blocks around a particle block."""

    report: Scalars
    """(P, SCALARS_PER_BLOCK) largest |v|² (cells²/s²), largest wave speed squared (cells²/s²), least distance to the
    window's limits (cells), spare, sum of |v|² (not finite when the simulation is lost), spare."""


class GridBlocks(NamedTuple):
    """Blocks of 4x4x4 nodes that particles can reach, field by field."""

    count: ti.i32
    """G."""

    cells: Cells
    """(G,) block coordinates."""

    field: Integers
    """(G,) field of a block."""

    starts: Integers
    """(F + 1,) first grid block of a field."""

    neighbours: Integers
    """(G, 27) particle blocks around a grid block, -1 for none."""


class BlockTable(NamedTuple):
    """Hash table from block keys to slots in a list of blocks; open addressing, linear probing."""

    mask: ti.i32
    """Size of the table minus 1; a power of two minus 1."""

    keys: Keys
    """(mask + 1,) key at a place, -1 where it is free."""

    slots: Integers
    """(mask + 1,) slot of that key's block."""


class NearBlocks(NamedTuple):
    """Blocks that can touch the ground, a rigid body, a collider, or that hold pins or goals."""

    particle_count: ti.i32
    grid_count: ti.i32

    slot: Integers
    """(P,) slot of a particle block in ``particle_blocks``, or -1."""

    particle_blocks: Integers
    """(particle_count,)"""

    grid_blocks: Integers
    """(grid_count,) grid blocks around these."""

    touched: Integers
    """(P,) 1 where contact impulses were scattered in this substep."""

    slack: Scalars
    """(P,) cells that must be covered before any particle of the block can touch."""


class OverlapBlocks(NamedTuple):
    """Grid blocks in places where several fields have one, for contact between deformable bodies."""

    grid_count: ti.i32
    lead_count: ti.i32
    particle_count: ti.i32

    mate: Integers
    """(G,) block of the next field in the same place, or -1."""

    slot: Integers
    """(G,) slot of a block in ``grid_blocks``, or -1."""

    grid_blocks: Integers
    """(grid_count,)"""

    leads: Integers
    """(lead_count,) blocks of the first field in each such place."""

    particle_blocks: Integers
    """(particle_count,) particle blocks around these."""

    chosen: Integers
    """(P,) 1 where a particle block is listed in ``particle_blocks``."""

    around: Integers
    """(grid_count, 27) grid blocks of the same field around those in ``grid_blocks``, -1 for none."""

    lead_fields: Integers
    """(grid_count,) first field in the place of those in ``grid_blocks``."""

    faces: Vectors4
    """(grid_count, BLOCK_NODES) where that field meets the block's: the normal from it, and the gap (cells), both times
    how well the node tells them, see ``body_faces``."""

    others: Scalars
    """(grid_count, BLOCK_NODES) share of all other fields at the nodes of ``grid_blocks``."""

    pair_counts: Integers
    """(particle_count,) pairs of particles that a block has found, see ``particle_pairs``."""

    pairs: Integers
    """(particle_count, PAIRS, 3) a particle of the block, the block of its partner, and the partner."""


class ParticleState(NamedTuple):
    """State of every particle that substeps change, sorted by block."""

    x: Cells
    """(N,) position in the block's window, fixed point, 2**-28 cells."""

    v: Vectors3
    """(N,) velocity, cells/s."""

    C: Matrices
    """(N,) APIC velocity gradient, 1/s."""

    F: Matrices
    """(N,) elastic deformation gradient."""

    reaction: Vectors4
    """(N,) contact acceleration of the last substep (cells/s²) and the share of contacting mass at the particle."""


class ParticleArrays(NamedTuple):
    """Particle arrays of the substep's kernels: the state as in ``ParticleState``, and more. Of the last six, those
    that no material or field needs are replaced by others."""

    x: Cells
    v: Vectors3
    C: Matrices
    F: Matrices

    constants: Vectors4
    """(N,) mass (kg), 2 mu V0 and lambda V0 (kg cells²/s²; of fluids 2 eta V0 and K V0), contact radius (cells)."""

    reaction: Vectors4

    memory: Scalars
    """(N,) history variable of the constitutive model, 0 at rest."""

    material: Integers
    """(N,) row in ``WorldArrays.materials``."""

    volumes: Scalars
    """(N,) volume at rest, cells³; where several fields share a world."""

    anchors: Vectors4
    """(N,) place that a pin or goal holds the particle at (cells), and 1 (pin), 2 (goal) or 0."""

    slopes: Vectors3
    """(N,) slope of ln J around fluid particles, 1/cell."""

    conformation: Matrices
    """(N,) strain of the branch that relaxes, as a left Cauchy–Green tensor; the identity at rest."""


class AdhesionArrays(NamedTuple):
    """Adhesion of fields to rigid bodies and colliders, and to one another; of length 1 where nothing adheres."""

    touch_count: ti.i32
    pair_count: ti.i32

    touches: Scalars
    """(touch_count, ADHESION_ROW) in the order of ``WorldArrays.contacts``."""

    pairs: Scalars
    """(pair_count, ADHESION_ROW) in the order of ``WorldArrays.pairs``."""

    touch_sums: Keys
    """(touch_count,) share of the field's mass in reach, see ``adhesion.WHOLE``."""

    pair_sums: Keys
    """(pair_count,) reduced masses of the nodes in reach over that of both fields."""


class NodeArrays(NamedTuple):
    """Grid nodes, and the private windows between particles and nodes."""

    window: Vectors4
    """(., WINDOW_NODES) copy of the nodes around the particle block at hand: velocity (cells/s), share of contacting
    mass. Blocks take turns at a window, see ``windows.turns``."""

    scattered: Vectors4
    """(P, WINDOW_NODES) momentum (kg cells/s) and mass (kg) that a block's particles scatter."""

    velocity: Vectors4
    """(G, BLOCK_NODES) velocity (cells/s), share of contacting mass."""

    sums: Vectors4
    """(listed G, BLOCK_NODES) sums of windows over listed grid blocks."""

    mass: Scalars
    """(G, BLOCK_NODES) kg."""

    block_sums: Scalars
    """(G, SUMS) contribution of a grid block to its field's means, see ``grid.SUMS``."""


class FlowArrays(NamedTuple):
    """Velocity or momentum without forces, and ln J, of granular and fluid materials; of length 1 where there is none.
    Indexed as the arrays of the same name in ``NodeArrays``."""

    window: Vectors4
    scattered: Vectors4
    velocity: Vectors4

    crowding: Scalars
    """(G, BLOCK_NODES) ln of what fluids fill over what their ln J says, see ``crowding``; length 1 without fluids."""

    crowding_window: Scalars
    """(., WINDOW_NODES) copy of the crowding around the particle block at hand; on a card (P, WINDOW_NODES)."""

    fill: Scalars
    """(G, BLOCK_NODES) ln of the share of a node's room that is full; length 1 without fluids."""

    around: Integers
    """(G, 27) grid blocks of the same field around a grid block, -1 for none; length 1 without fluids."""

    pushes: Scalars
    """(G, most_bodies, PUSH) what crowding in a block does to a body, as in ``CouplingArrays``; last but one: whether
    it does anything."""


class RigidArrays(NamedTuple):
    """Rigid bodies and colliders; ``rigid_layout`` names the columns."""

    world_count: ti.i32
    """W."""

    steps: Doubles
    """(W,) substep in s, 0 for idle worlds."""

    spans: Integers
    """(W, SPANS) first body, end of bodies, first pair, end of pairs, first collider, start in ``systems`` or -1."""

    world_numbers: Doubles
    """(W, WORLD) gravity (cells/s²), plane, recovery speed (cells/s)."""

    report: Doubles
    """(W, REPORT) contacts, largest depth (cells), sweeps, steps of Newton's method, largest change of velocity
    (cells/s) in the last sweep."""

    kinds: Integers
    """(S, KINDS) kind, lattices, clusters of surface points."""

    numbers: Doubles
    """(S, NUMBERS) mass (kg), inertia (kg cells²), forces."""

    state: Doubles
    """(S, STATE) pose, velocity, momenta, and intermediate results of the substep."""

    impulses: Doubles
    """(S, 6) momentum (kg cells/s) and angular momentum about the centre of mass (kg cells²/s) given by particles."""


class ShapeArrays(NamedTuple):
    """Surfaces of rigid bodies and colliders, each in its own frame, cells."""

    clusters: Scalars
    """(., 4) centre and radius of a cluster of surface points."""

    cluster_starts: Integers
    """(. + 1,) first surface point of a cluster."""

    points: Scalars
    """(., POINT) surface points: place, outer normal, first principal direction, two radii of curvature, smoothness."""

    lattices: Scalars
    """(., 4) first node and spacing of a distance lattice."""

    dims: Integers
    """(., 4) nodes along x, y, z, and where the lattice begins in ``distances``."""

    distances: Scalars
    """Signed distances of all lattices, cells; C order, z fastest."""

    motions: Scalars
    """(., 3) velocities (cells/s) of the surface at the points of the two lattices of colliders that deform."""


class RigidContacts(NamedTuple):
    """Contacts between rigid bodies, colliders and the ground plane."""

    pairs: Integers
    """(C, PAIRS) body whose points touch, body that they touch (-1: plane), the reverse pair or -1, row of numbers."""

    pair_numbers: Doubles
    """(., CONTACT) friction, restitution, mode, lever of rolling resistance (cells), adhesion."""

    counts: Integers
    """(C,) contacts of a pair."""

    rows: Doubles
    """(C, SLOTS, ROW) the contacts."""

    memory: Doubles
    """(C, SLOTS, MEMORY) place and impulses of the last substep's contacts, to start from."""

    reaches: Doubles
    """(C,) distance (cells) within which points may touch, -1 where nothing is near."""

    scores: Doubles
    """(C, BINS, CHOSEN) scores of the points chosen so far."""

    chosen: Integers
    """(C, BINS, CHOSEN) surface points that may touch, -1 for none."""

    systems: Doubles
    """Worlds' systems of equations one after the other (``rigid_direct``): matrix (n, n), right side (n), first column
    of each row (n), velocities without contact (n), and an equation (12)."""


class CouplingArrays(NamedTuple):
    """Exchange between particles and rigid bodies."""

    body_count: ti.i32
    """S."""

    most_bodies: ti.i32
    """Rigid bodies and colliders of the world that has most."""

    touching: Scalars
    """(S,) mass of particles at a body in the last substep, kg."""

    pushes: Scalars
    """(near P, most_bodies, PUSH) effect of a block's particles on a body: impulse (kg cells/s), angular impulse about
    its centre (kg cells²/s), mass at the body (kg), spare."""
