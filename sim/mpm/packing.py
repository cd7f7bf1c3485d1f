# SPDX-License-Identifier: MIT
"""Setups in SI units as the rows of numbers that the kernels read; ``kernels.layout`` names the columns."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..constitutive import FLUID, ROW, SHAPED, DeformableMaterial, ElasticMaterial
from ..scene.units import Similarity
from .bodies import THIN_CELLS, BodyParticles
from .kernels import layout
from .kernels.adhesion import LEAST_REACH, MOST_REACH
from .kernels.particle_transfer import GOAL, PIN
from .rigid.rigid_bodies import LEAST_RECOVERY
from .rigid.rigid_layout import RECOVERY_HEIGHT
from .surface_contact import GROUND_NAME, MODES, SurfaceContact
from .world_setup import WorldSetup

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PackedWorlds:
    """Parameters of worlds and fields as the kernels read them; ``layout`` names the columns.

    touch_adhesion, pair_adhesion: rows of ``layout.ADHESION_ROW`` for those of touches and pairs.
    thin: whether a world needs the kernel for bodies that are thin all over.
    """

    laws: int
    table: NDArray[np.float32]
    world_integers: NDArray[np.int32]
    worlds: NDArray[np.float32]
    field_integers: NDArray[np.int32]
    fields: NDArray[np.float32]
    touches: NDArray[np.float32]
    pairs: NDArray[np.float32]
    touch_adhesion: NDArray[np.float32]
    pair_adhesion: NDArray[np.float32]
    thin: bool

    @property
    def adheres(self) -> bool:
        """Whether a field adheres to another one, to a rigid body or to a collider."""
        return bool((self.touch_adhesion[:, :1] > 0).any() or (self.pair_adhesion[:, :1] > 0).any())


@dataclass(frozen=True, kw_only=True)
class NewParticles:
    """Particles to add to field ``field``, N of them, as ``kernel_arrays.ParticleArrays`` describes them."""

    field: int
    x: Array
    v: Array
    C: Array
    F: Array
    constants: Array
    ids: NDArray[np.int32]
    material: NDArray[np.int32]
    volumes: Array
    anchors: Array


DEEPEST, DEEPEST_ELASTIC = 0.05, 0.25
"""Depth in cells below which no particle sinks if the contact solve fails; an elastic contact is a
spring, which carries a load only as far as it is compressed."""


@dataclass(frozen=True, kw_only=True)
class WorldSlot:
    """World ``world``: its map from metres to cells, and its first rows in the common arrays."""

    world: int
    setup: WorldSetup
    cells: Similarity
    first_field: int
    first_material: int

    @property
    def soft(self) -> tuple[int, ...]:
        """Indices of the setup's bodies that are fields: those that deform."""
        return tuple(i for i, body in enumerate(self.setup.bodies) if not body.rigid)

    def field(self, body: int) -> int:
        """The field of the setup's body ``body``, which must not be rigid."""
        return self.first_field + self.soft.index(body)


def world_slots(setups: Sequence[WorldSetup], cells: Sequence[Similarity]) -> tuple[WorldSlot, ...]:
    """Rows of each world's fields and materials in the common arrays."""
    result: list[WorldSlot] = []
    field = material = 0
    for world, (setup, similarity) in enumerate(zip(setups, cells, strict=True)):
        result.append(WorldSlot(world=world, setup=setup, cells=similarity, first_field=field, first_material=material))
        field += len(result[-1].soft)
        material += sum(1 + len(setup.bodies[i].materials) for i in result[-1].soft)
    return tuple(result)


def materials_of(body: BodyParticles, time: float = 0.0) -> tuple[DeformableMaterial, ...]:
    """All materials of a body that deforms at ``time`` in s, in the order of ``material_index``."""
    return (body.material_at(time), *body.materials)


def material_table(all_places: Sequence[WorldSlot], times: Sequence[float]) -> NDArray[np.float32]:
    """Rows of the kernels' table of materials, each world's at its time of ``times`` in s."""
    bodies = [(place.setup.bodies[i], times[place.world]) for place in all_places for i in place.soft]
    rows = [m.row for body, time in bodies for m in materials_of(body, time)] or [(0.0,) * ROW]
    return np.asarray(rows, dtype=np.float32)


def first_material(place: WorldSlot, body: int) -> int:
    """Row of the body's first material in the table."""
    before = place.soft[: place.soft.index(body)]
    return place.first_material + sum(1 + len(place.setup.bodies[i].materials) for i in before)


def laws_of(setup: WorldSetup) -> int:
    """Bits of the constitutive models in a world; those of the simplest kernel where all bodies are rigid."""
    soft = [body for body in setup.bodies if not body.rigid]
    return (
        functools.reduce(operator.or_, (m.laws for body in soft for m in body.materials_over_time), 0)
        or 1 << ElasticMaterial.number
    )


def pack(all_places: Sequence[WorldSlot]) -> PackedWorlds:
    """Pack all that is constant over the run; rows of worlds and fields are those at time 0."""
    bodies = [place.setup.bodies[i] for place in all_places for i in place.soft]
    laws = functools.reduce(operator.or_, (laws_of(place.setup) for place in all_places))
    touches: list[tuple[float, ...]] = []
    pairs: list[tuple[float, ...]] = []
    touch_adhesion: list[tuple[float, ...]] = []
    pair_adhesion: list[tuple[float, ...]] = []
    world_integers = np.zeros((len(all_places), layout.WORLD_INTEGERS), dtype=np.int32)
    field_integers = np.zeros((len(bodies), layout.FIELD_INTEGERS), dtype=np.int32)
    first_body = 0
    for place in all_places:
        setup, soft = place.setup, place.soft
        obstacles = collider_names(setup)
        rigid = [body for body in setup.bodies if body.rigid]
        solids = list(zip(obstacles, [*rigid, *[None] * len(setup.colliders)], strict=True))
        row = world_integers[place.world]
        row[layout.FIRST_RIGID_BODY], row[layout.RIGID_BODIES] = first_body, len(obstacles)
        row[layout.FIRST_FIELD], row[layout.FIELDS] = place.first_field, len(soft)
        row[layout.FIRST_PAIR] = len(pairs)
        first_body += len(obstacles)
        for i in soft:
            body = setup.bodies[i]
            integers = field_integers[place.field(i)]
            integers[layout.WORLD] = place.world
            integers[layout.FIRST_TOUCH] = len(touches)
            integers[layout.WANTS_MEANS] = int(body.forces.lift != 0 or body.forces.tether_stiffness > 0)
            integers[layout.HAS_ANCHORS] = int(body.pins is not None or body.goal_stiffness > 0)
            touch_adhesion.append(NO_ADHESION)
            for name in (GROUND_NAME, *obstacles):
                touches.append(contact_row(setup.contact(body.name, name), place.cells))
            for name, partner in solids:
                touch_adhesion.append(adhesion_row(place, body, setup.contact(body.name, name), partner))
            for j in soft:
                pairs.append(contact_row(setup.contact(body.name, setup.bodies[j].name), place.cells))
                other = setup.bodies[j]
                row = adhesion_row(place, body, setup.contact(body.name, other.name), other)
                pair_adhesion.append(NO_ADHESION if i == j else row)
    return PackedWorlds(
        laws=laws,
        table=material_table(all_places, [0.0] * len(all_places)),
        world_integers=world_integers,
        worlds=np.stack([world_row(place, 0.0, 0.0) for place in all_places]),
        field_integers=field_integers,
        fields=field_rows(all_places, [0.0] * len(all_places), [0.0] * len(all_places)),
        touches=np.asarray(touches, dtype=np.float32).reshape(-1, layout.TOUCH_ROW),
        pairs=np.asarray(pairs, dtype=np.float32).reshape(-1, layout.TOUCH_ROW),
        touch_adhesion=np.asarray(touch_adhesion, dtype=np.float32).reshape(-1, layout.ADHESION_ROW),
        pair_adhesion=np.asarray(pair_adhesion, dtype=np.float32).reshape(-1, layout.ADHESION_ROW),
        thin=any(has_thin(place.setup, place.cells.scale) for place in all_places),
    )


def collider_names(setup: WorldSetup) -> tuple[str, ...]:
    """Names of a world's rigid bodies, then colliders: the order in which the kernels count them."""
    return (*(body.name for body in setup.bodies if body.rigid), *(collider.name for collider in setup.colliders))


def contact_row(contact: SurfaceContact, cells: Similarity) -> tuple[float, ...]:
    """One row of the tables ``touches`` and ``pairs``."""
    return (
        contact.sticking,
        contact.friction,
        float(MODES.index(contact.mode)),
        contact.restitution,
    )


NO_ADHESION = (0.0, -layout.FAR, 0.0)
"""Row of ``layout.ADHESION_ROW``: the ground pulls whole bodies instead, by their rows of forces."""


def adhesion_row(
    place: WorldSlot, body: BodyParticles, contact: SurfaceContact, partner: BodyParticles | None
) -> tuple[float, ...]:
    """Adhesion of ``body``, which deforms, to its ``partner``, None for a collider: ``layout.ADHESION_ROW`` numbers.

    The pull of the pair is the adhesion times the reduced mass; ``kernels.adhesion`` says over which mass it is spread.
    """
    if not (contact.adhesion > 0 and contact.adhesion_reach > 0):
        return NO_ADHESION
    scale = place.cells.scale
    mass = reduced = float(body.masses.sum())
    if partner is not None:
        reduced *= float(partner.masses.sum()) / (mass + float(partner.masses.sum()))
        if not partner.rigid:
            mass = reduced
    reach = min(max(contact.adhesion_reach * scale, LEAST_REACH), MOST_REACH)
    return contact.adhesion * scale * reduced / mass, reach, 1.0 / mass


def world_row(place: WorldSlot, start: float, end: float) -> NDArray[np.float32]:
    """Numbers of a world for the segment of time from ``start`` to ``end`` in s."""
    row = np.zeros(layout.WORLD_ROW)
    scale = place.cells.scale
    gravity = np.asarray(place.setup.gravity_at(start)) * scale
    row[layout.GRAVITY : layout.GRAVITY + 3] = gravity
    if end > start:
        later = np.asarray(place.setup.gravity_at(end)) * scale
        row[layout.GRAVITY_RATE : layout.GRAVITY_RATE + 3] = (later - gravity) / (end - start)
    ground = place.setup.ground
    row[layout.PLANE_NORMAL : layout.PLANE_NORMAL + 3] = (0.0, 0.0, 1.0)
    if ground is not None:
        row[layout.PLANE_NORMAL : layout.PLANE_NORMAL + 3] = ground.unit_normal
        row[layout.PLANE_OFFSET] = ground.unit_normal @ place.cells.points_to_engine(np.asarray(ground.point))
        row[layout.HAS_PLANE] = 1.0
    fall = math.sqrt(2.0 * RECOVERY_HEIGHT * scale * strongest_pull(place.setup))
    row[layout.RECOVERY_SPEED] = max(fall, LEAST_RECOVERY)
    return row.astype(np.float32)


def strongest_pull(setup: WorldSetup) -> float:
    """The largest acceleration in m/s² that gravity or a track gives a body at any time.

    At any time, because a moment without gravity must not stop the position correction of surfaces and pins.
    """
    gravity = setup.gravity_track.values if setup.gravity_track is not None else np.asarray([setup.gravity])
    tracks = [gravity] + [body.acceleration.values for body in setup.bodies if body.acceleration is not None]
    return max(float(np.linalg.norm(values, axis=1).max()) for values in tracks)


def field_rows(all_places: Sequence[WorldSlot], starts: Sequence[float], ends: Sequence[float]) -> NDArray[np.float32]:
    """Numbers of all fields, each for its world's segment of time."""
    rows = [field_row(place, i, starts[place.world], ends[place.world]) for place in all_places for i in place.soft]
    return np.stack(rows) if rows else np.zeros((0, layout.FIELD_ROW), dtype=np.float32)


def field_row(place: WorldSlot, body_index: int, start: float, end: float) -> NDArray[np.float32]:
    """Numbers of one field for the segment of time from ``start`` to ``end`` in s."""
    body, scale = place.setup.bodies[body_index], place.cells.scale
    row = np.zeros(layout.FIELD_ROW)
    row[layout.GRAVITY_FACTOR : layout.TETHER_STRING + 1] = body.forces.in_cells(scale, np.asarray(place.cells.origin))
    for track, column, rate in (
        (body.acceleration, layout.ACCELERATION, layout.ACCELERATION_RATE),
        (body.pin_motion, layout.MOTION, layout.MOTION_RATE),
    ):
        if track is not None:
            now, later = track.at(start) * scale, track.at(end) * scale
            row[column : column + 3] = now
            if end > start:
                row[rate : rate + 3] = (later - now) / (end - start)
    contact = place.setup.contact(body.name, GROUND_NAME)
    if contact.adhesion_reach > 0 and place.setup.ground is not None:
        row[layout.PLANE_ADHESION] = contact.adhesion * scale
        row[layout.PLANE_REACH] = contact.adhesion_reach * scale
    row[layout.PLANE_GAP : layout.PLANE_GAP + 2] = layout.FAR
    row[layout.SUNK_LIMIT] = DEEPEST_ELASTIC if contact.restitution > 0 else DEEPEST
    row[layout.FULL_MASS] = full_mass(body) / scale**3
    if row[layout.FULL_MASS] > 0:
        row[layout.SOUND_SPEED_SQUARED] = (scale * body.material_at(start).wave_speed) ** 2
    else:
        row[layout.THICKNESS] = thin_cells(body, scale)
    row[layout.GOAL_STIFFNESS] = body.goal_stiffness
    row[layout.GOAL_DAMPING] = 2.0 * body.goal_damping * math.sqrt(body.goal_stiffness)
    return row.astype(np.float32)


def thin_cells(body: BodyParticles, scale: float) -> float:
    """``layout.THICKNESS`` of a body, with ``scale`` cells a metre; 0 of matter that loses its shape."""
    if body.thickness is None or any(material.cohesion != SHAPED for material in body.materials_over_time):
        return 0.0
    cells = body.thickness * scale
    return cells if cells < THIN_CELLS else 0.0


def has_thin(setup: WorldSetup, scale: float) -> bool:
    """Whether the world has a kernel for thin bodies: one is, and there are others that deform."""
    soft = [body for body in setup.bodies if not body.rigid]
    return len(soft) > 1 and any(thin_cells(body, scale) > 0 for body in soft)


def full_mass(body: BodyParticles) -> float:
    """Density in kg/m³ of a body that is a fluid, and equally dense, all over and at all times; 0 of others."""
    if any(material.cohesion != FLUID for material in body.materials_over_time):
        return 0.0
    densities = body.masses / body.volumes
    return float(densities.mean()) if np.ptp(densities) < 1e-3 * densities.mean() else 0.0


def particles(
    place: WorldSlot, body_index: int, first_id: int, choice: NDArray[np.int32]
) -> tuple[NewParticles, float]:
    """The particles of a body as the engine takes them, and the speed in cells/s of the fastest wave in them.

    choice: material of each particle (N,), as in ``BodyParticles.material_index``.
    """
    body, cells = place.setup.bodies[body_index], place.cells
    scale = cells.scale
    volumes = body.volumes * scale**3
    assert body.contact_radii is not None
    anchors = np.zeros((body.count, 4))
    anchors[:, :3] = cells.points_to_engine(body.positions)
    if body.goal_stiffness > 0:
        anchors[:, 3] = GOAL
    if body.pins is not None:
        anchors[body.pins, 3] = PIN
    constants, wave_speed = stiffness(body, choice, cells)
    added = NewParticles(
        field=place.field(body_index),
        x=cells.points_to_engine(body.positions),
        v=body.initial_velocities * scale,
        C=np.broadcast_to(body.initial_velocity_gradient, (body.count, 3, 3)),
        F=np.broadcast_to(np.eye(3), (body.count, 3, 3)),
        constants=np.column_stack([body.masses, constants, body.contact_radii * scale]),
        ids=np.arange(first_id, first_id + body.count, dtype=np.int32),
        material=first_material(place, body_index) + choice,
        volumes=volumes,
        anchors=anchors,
    )
    return added, wave_speed


def modulus_shares(body: BodyParticles, choice: NDArray[np.int32], cells: Similarity) -> NDArray[np.float32]:
    """Return 2 mu V0 and lambda V0 of each particle (N,) over its material's numbers in Pa; -1 for those that are not
    of the body's own ``material``, whose tracks they do not follow."""
    factor = np.ones(body.count) if body.stiffness_scale is None else body.stiffness_scale
    shares = cells.modulus(1.0) * body.volumes * cells.scale**3 * factor
    return np.where(choice == 0, shares, -1.0).astype(np.float32)


def stiffness(body: BodyParticles, choice: NDArray[np.int32], cells: Similarity) -> tuple[Array, float]:
    """2 mu V0 and lambda V0 (N, 2) of particles of the materials ``choice``; their fastest wave's speed in cells/s."""
    every = materials_of(body)
    scale = cells.scale
    factor = np.ones(body.count) if body.stiffness_scale is None else body.stiffness_scale
    shear = np.array([m.shear_number for m in every])[choice] * factor
    bulk = np.array([m.bulk_number for m in every])[choice] * factor
    volumes = body.volumes * scale**3
    constants = np.column_stack([cells.modulus(1.0) * shear * volumes, cells.modulus(1.0) * bulk * volumes])
    fastest = max(body.bounding_speed(every[i], scale) for i in np.unique(choice))
    return constants, fastest
