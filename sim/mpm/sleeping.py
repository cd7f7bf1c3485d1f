# SPDX-License-Identifier: MIT
"""Bodies that stay at rest until something touches them: which may sleep at the start, and when they wake. No Taichi.

A body asleep is not simulated: it keeps its pose and costs nothing. That is the equilibrium in which it was found,
which particles that start without stress would first have to settle into. It wakes, with all sleepers it touches,
before moving matter reaches it.

A body may sleep only where nothing but gravity acts on it and where it would stand: friction holds it on the ground's
slope, and its centre of mass lies over what it rests on (the hull of its contacts, as far as the grid can tell: widened
by a cell). A stack sleeps as far as it stands on the ground or on static colliders. What is held (it hangs, or leans on
something unknown) sleeps without that, unless something that it touches is awake: a thing that leans falls when its
support is thrown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from trimesh.remesh import subdivide_to_size

from .bodies import BodyForces, BodyParticles
from .colliders import Collider
from .surface_contact import GROUND_NAME
from .world_setup import WorldSetup

Array = NDArray[np.float64]

NEAR_GROUND = 0.5
"""Cells between a particle's surface and the ground within which it rests there."""

TOUCH = 0.25
"""Cells between two surfaces, each known to about half a particle spacing, within which bodies touch."""

SLACK = 1.0
"""Cells by which contacts count as wider: particles lie inside the surface, and the grid resolves no less."""

CARRIES = -0.3
"""Least upward part of a contact's normal at which it may carry: not what lies on top, but what stands beside."""

GRACE = 0.1
"""Seconds for which what starts beside a sleeper may leave it; whatever still rubs on it then, or has moved into it,
wakes it."""

CLOSER = 0.15
"""Cells by which a body that starts in touch with a sleeper may come nearer in that time."""

LEAST_WAY = 0.1
"""Cells of travel after which two bodies that nearly touch are looked at again."""

NEAR, LONGEST_WATCH = 4.0, 1 / 200
"""Bodies within so many cells of a sleeper are looked at again after so many seconds, whatever their speed: elastic
matter can speed up at once."""

DIRECTIONS = 64
"""Directions in which a hull is compared with a centre of mass."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Particles of a body: points (N, 3) world metres, radii (N,) metres to the surface; ``tree`` of the points."""

    points: Array
    radii: Array
    tree: cKDTree
    low: Array
    high: Array

    @classmethod
    def of(cls, points: Array, radii: Array) -> Shape:
        """Return the shape of particles at ``points`` (N, 3) with contact ``radii`` (N,)."""
        reach = float(radii.max())
        return cls(points, radii, cKDTree(points), points.min(axis=0) - reach, points.max(axis=0) + reach)


@dataclass(frozen=True, eq=False)
class Touching:
    """Contacts of one body with another: places (K, 3) world metres, normals (K, 3) out of the other one."""

    places: Array
    normals: Array


def gap_between(points: Array, radii: Array, other: Shape, within: float) -> float:
    """Distance in metres of the surface of particles at ``points`` (N, 3) with ``radii`` (N,) to that of ``other``;
    negative where they overlap. A lower bound of it where it is over ``within``."""
    low, high = points.min(axis=0) - radii.max(), points.max(axis=0) + radii.max()
    apart = float(np.linalg.norm(np.maximum(0.0, np.maximum(low - other.high, other.low - high))))
    if apart > within:
        return apart
    reach = within + float(radii.max() + other.radii.max())
    near = ((points >= other.low - reach) & (points <= other.high + reach)).all(axis=1)
    if not near.any():
        return within
    distance, nearest = other.tree.query(points[near], distance_upper_bound=reach)
    found = np.isfinite(distance)
    if not found.any():
        return within
    return float(min(within, (distance[found] - radii[near][found] - other.radii[nearest[found]]).min()))


def _touching(body: Shape, other: Shape, within: float) -> Touching | None:
    """Contacts of ``body`` with ``other``, surfaces within ``within`` metres; None without any."""
    if (body.low > other.high + within).any() or (other.low > body.high + within).any():
        return None
    reach = within + float(body.radii.max() + other.radii.max())
    distance, nearest = other.tree.query(body.points, distance_upper_bound=reach)
    touches = np.isfinite(distance)
    touches[touches] = (distance - body.radii)[touches] - other.radii[nearest[touches]] < within
    if not touches.any():
        return None
    away = body.points[touches] - other.points[nearest[touches]]
    return Touching(body.points[touches], away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12))


class Sleepers:
    """The bodies of a world that may sleep, and when moving ones come to touch them.

    cell: side of a grid cell in metres. wanting: (B,) whether a body of ``setup`` would sleep where it stands; asleep:
    (B,) whether it does at the start.
    """

    def __init__(self, setup: WorldSetup, cell: float) -> None:
        self.setup, self.cell = setup, cell
        count = len(setup.bodies)
        self.wanting = np.array([_wants_sleep(body) for body in setup.bodies])
        self.asleep = np.zeros(count, dtype=bool)
        self._shapes: dict[int, Shape] = {}
        self._first_gaps: dict[tuple[int, int], float] = {}
        wanted = np.flatnonzero(self.wanting).tolist()
        down = np.asarray(setup.gravity, dtype=np.float64)
        if not wanted or setup.gravity_track is not None or not down.any():
            return
        self._up = -down / np.linalg.norm(down)
        swept = [_swept_box(collider) for collider in setup.colliders if collider.moves]
        wanted = [i for i in wanted if not any(self._meets(i, *box) for box in swept)]
        self.asleep[self._standing(wanted)] = True

    def _shape(self, index: int) -> Shape:
        if index not in self._shapes:
            body = self.setup.bodies[index]
            assert body.contact_radii is not None
            self._shapes[index] = Shape.of(body.positions, body.contact_radii)
        return self._shapes[index]

    def _meets(self, index: int, low: Array, high: Array) -> bool:
        shape = self._shape(index)
        return bool((shape.low <= high + self.cell).all() and (shape.high >= low - self.cell).all())

    # ---- at the start -------------------------------------------------------------------------------------------

    def _standing(self, wanted: Sequence[int]) -> list[int]:
        """Those of ``wanted`` that stand on the ground, on static colliders, or on one another, or are held."""
        firm = {i: self._firm_contacts(i) for i in wanted}
        mutual: dict[tuple[int, int], Touching] = {}
        for i in wanted:
            for j in wanted:
                found = None if i == j else _touching(self._shape(i), self._shape(j), TOUCH * self.cell)
                if found is not None:
                    mutual[i, j] = found
        awake = [j for j, body in enumerate(self.setup.bodies) if j not in wanted and body.start_time == 0.0]
        held = {i for i in wanted if self.setup.bodies[i].held and not self._touches(i, awake)}
        left = set(wanted)
        while True:
            held = {i for i in held & left if all(j in left for k, j in mutual if k == i)}
            grounded = {i for i in left if len(firm[i])} | held
            while True:
                more = {i for i, j in mutual if i in left and j in grounded} - grounded
                if not more:
                    break
                grounded |= more
            contacts = {i: [mutual[i, j] for j in grounded if (i, j) in mutual] for i in grounded - held}
            standing = held | {i for i, found in contacts.items() if self._balanced(i, firm[i], found)}
            if standing == left:
                return sorted(left)
            left = standing

    def _firm_contacts(self, index: int) -> Array:
        """Places (K, 3) at which the ground or static colliders carry the body."""
        body, shape = self.setup.bodies[index], self._shape(index)
        places = [np.zeros((0, 3))]
        ground = self.setup.ground
        if ground is not None:
            steep = math.acos(float(np.clip(ground.unit_normal @ self._up, -1.0, 1.0)))
            heights = ground.heights(shape.points) - shape.radii
            if steep < math.pi / 2 and math.tan(steep) <= self.setup.contact(body.name, GROUND_NAME).sticking:
                places.append(shape.points[heights < NEAR_GROUND * self.cell])
        for collider in self.setup.colliders:
            if not collider.moves:
                found = self._on_collider(shape, collider)
                if found is not None:
                    places.append(found.places[found.normals @ self._up > CARRIES])
        return np.concatenate(places)

    def _on_collider(self, shape: Shape, collider: Collider) -> Touching | None:
        corners = collider.surface.vertices[collider.surface.faces]
        near = (corners.min(axis=1) <= shape.high + self.cell).all(axis=1)
        near &= (corners.max(axis=1) >= shape.low - self.cell).all(axis=1)
        if not near.any():
            return None
        points, _ = subdivide_to_size(
            collider.surface.vertices, collider.surface.faces[near], max_edge=0.5 * self.cell, max_iter=40
        )
        points = points[((points >= shape.low - self.cell) & (points <= shape.high + self.cell)).all(axis=1)]
        if not len(points):
            return None
        return _touching(shape, Shape.of(points, np.zeros(len(points))), NEAR_GROUND * self.cell)

    def _touches(self, index: int, others: Sequence[int]) -> bool:
        """Whether the body touches any of ``others``."""
        shape, within = self._shape(index), TOUCH * self.cell
        return any(_touching(shape, self._shape(j), within) is not None for j in others)

    def _balanced(self, index: int, firm: Array, contacts: Sequence[Touching]) -> bool:
        """Whether the centre of mass of the body lies over its contacts."""
        places = [firm, *(found.places[found.normals @ self._up > CARRIES] for found in contacts)]
        points = np.concatenate(places)
        if not len(points):
            return False
        across = np.linalg.svd(self._up[None, :])[2][1:]
        angles = 2.0 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
        directions = np.stack([np.cos(angles), np.sin(angles)])
        offsets = (points - self.setup.bodies[index].center_of_mass) @ across.T
        return bool(((offsets @ directions).max(axis=0) >= -SLACK * self.cell).all())

    # ---- later --------------------------------------------------------------------------------------------------

    def with_neighbours(self, woken: Sequence[int], asleep: NDArray[np.bool_]) -> list[int]:
        """``woken`` and all bodies in ``asleep`` (B,) that touch them, directly or through one another."""
        found, open_ends = set(woken), list(woken)
        while open_ends:
            shape = self._shape(open_ends.pop())
            for j in map(int, np.flatnonzero(asleep)):
                if j not in found and _touching(shape, self._shape(j), TOUCH * self.cell) is not None:
                    found.add(j)
                    open_ends.append(j)
        return sorted(found)

    def touched(
        self, moving: dict[int, Array], asleep: NDArray[np.bool_], time: float, speed: float
    ) -> tuple[list[int], float]:
        """Return the sleepers that wake now, and the seconds for which none of the others can be reached.

        moving: particles (N, 3) in world metres of the bodies that move, by index. asleep: (B,). time: now, in s.
        speed: m/s, of the fastest of all matter.
        """
        woken, rest = [], math.inf
        fall = float(np.linalg.norm(self.setup.gravity))
        for j in map(int, np.flatnonzero(asleep)):
            ways = []
            for i, points in moving.items():
                radii = self.setup.bodies[i].contact_radii
                assert radii is not None
                gap = gap_between(points, radii, self._shape(j), NEAR * self.cell)
                ways.append(gap - self._least_gap(i, j, time))
            if ways and min(ways) < 0.0:
                woken.append(j)
            elif ways:
                way = max(min(ways), LEAST_WAY * self.cell)
                pace = speed + math.sqrt(2.0 * fall * way)
                # Half of it where there is time, since what was squashed may speed up.
                rest = min(rest, 0.5 * way / max(pace, 1e-12), LONGEST_WATCH if way < NEAR * self.cell else math.inf)
        return woken, rest

    def _least_gap(self, moving: int, sleeper: int, time: float) -> float:
        """Gap in metres below which body ``moving`` touches ``sleeper``."""
        touch = TOUCH * self.cell
        if time < GRACE and self.setup.bodies[moving].start_time == 0.0:
            pair = (moving, sleeper)
            if pair not in self._first_gaps:
                shape = self._shape(moving)
                self._first_gaps[pair] = gap_between(shape.points, shape.radii, self._shape(sleeper), 2.0 * touch)
            return min(touch, self._first_gaps[pair] - CLOSER * self.cell)
        return touch


def _wants_sleep(body: BodyParticles) -> bool:
    """Whether ``body`` is marked as asleep, starts at rest, and is moved by nothing but gravity and contact."""
    still = not any(body.velocity) and not any(body.spin) and body.start_time == 0.0
    driven = body.acceleration is not None or body.velocity_keys is not None or bool(body.material_track)
    driven = driven or bool(body.parameter_tracks)
    driven = driven or body.pins is not None or body.goal_stiffness > 0
    return body.asleep and still and not driven and _quiet(body.forces)


def _quiet(forces: BodyForces) -> bool:
    """Whether ``forces`` do nothing to a body at rest but change its weight."""
    blown = any(forces.wind) and (forces.drag != 0 or forces.lift != 0)
    return forces.gravity_factor > 0 and not blown and forces.tether_stiffness == 0


def _swept_box(collider: Collider) -> tuple[Array, Array]:
    """Corners (3,), (3,) of a box that holds the collider at all times."""
    if collider.vertices is not None:
        every = collider.vertices.values.reshape(-1, 3)
        return every.min(axis=0), every.max(axis=0)
    vertices = collider.surface.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if collider.rotations is not None:
        reach = float(np.linalg.norm(vertices - collider.middle, axis=1).max())
        low, high = collider.middle - reach, collider.middle + reach
    if collider.translations is not None:
        way = collider.translations.values
        low, high = low + np.minimum(0.0, way.min(axis=0)), high + np.maximum(0.0, way.max(axis=0))
    return low, high
