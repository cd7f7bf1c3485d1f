# SPDX-License-Identifier: MIT
"""What a setup asks for at given times, and what that, or a caller, changes in the particles of a body."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ..constitutive import DeformableMaterial
from ..errors import InputError
from . import packing
from .active_bodies import ActiveBodies
from .bodies import BodyParticles
from .colliders import SAME_TIME, Track
from .engine import Engine
from .particle_store import State, places_in_blocks
from .world_tables import upload_new

Array = NDArray[np.float64]

PARAMETER_STEP, PARAMETER_PIECES = 1.0 / 240.0, 32
"""A parameter on its way between two keyframes is constant for this many seconds at most, and for this part of the way;
it has the value of the middle."""


class BodyRows(NamedTuple):
    """A body's particles in a state. mine: (n,) whether each is. numbers: (N,) in the body, of those that are."""

    mine: NDArray[np.bool_]
    numbers: NDArray[np.int64]


class BodyChanges:
    """Changes of bodies that have started, in the particles of ``engine``; places: of all worlds, in their order."""

    def __init__(self, engine: Engine, places: Sequence[packing.WorldSlot], bodies: ActiveBodies) -> None:
        self._engine = engine
        self._places = tuple(places)
        self._bodies = bodies
        # By the body's number among all: what it has on its parameters' tracks, and how stiff its particles are
        # relative to that.
        self._followed: dict[int, DeformableMaterial] = {}
        self._shares: dict[int, ti.Ndarray] = {}

    def follow_parameters(self, times: Array, stops: Array) -> None:
        """Give bodies with tracks of parameters what those have midway between ``times`` (W,) and ``stops`` (W,)."""
        middle = 0.5 * (times + stops)
        changed = False
        for place in self._places:
            for i in place.soft:
                body, number = place.setup.bodies[i], self._number(place, i)
                if not body.parameter_tracks or not self._bodies.started[number]:
                    continue
                material = body.material_at(float(middle[place.world]))
                if self._followed.get(number) == material:
                    continue
                if number not in self._shares:
                    choice = material_choice(body, float(times[place.world]) + SAME_TIME)
                    self._shares[number] = upload_new(packing.modulus_shares(body, choice, place.cells))
                offset, shares = int(self._bodies.offsets[number]), self._shares[number]
                self._engine.particles.set_moduli(offset, shares, material.shear_number, material.bulk_number)
                self._engine.worlds.expect(place.world, wave_speed=body.bounding_speed(material, place.cells.scale))
                self._followed[number] = material
                changed = True
        if changed:
            self._engine.worlds.set_materials(packing.material_table(self._places, list(middle)))

    def change_material(self, place: packing.WorldSlot, index: int, now: float) -> None:
        """Switch the body's particles to their material at ``now``; their history variables are reset."""
        number = self._number(place, index)
        self._shares.pop(number, None)
        self._followed.pop(number, None)
        state = self._engine.state()
        choice = material_choice(place.setup.bodies[index], now)
        wave_speed = _switch_material(state, self.rows(state, number), place, index, choice)
        self._engine.replace(state)
        self._engine.worlds.expect(place.world, wave_speed=wave_speed)

    def set_velocity(self, place: packing.WorldSlot, index: int, velocity: Array) -> None:
        """Set the body's mean velocity (3,), m/s."""
        state = self._engine.state()
        rows = self.rows(state, self._number(place, index))
        fastest = _shift_velocity(state, rows, velocity * place.cells.scale)
        self._engine.replace(state)
        self._engine.worlds.expect(place.world, speed=fastest)

    def set_motion(self, place: packing.WorldSlot, index: int, given: dict[str, Array]) -> None:
        """Set the motion of every particle of the body to what is ``given``, see ``checked_motion``."""
        state = self._engine.state()
        _put_motion(state, self.rows(state, self._number(place, index)), place, index, given)
        self._engine.replace(state)
        fastest = float(np.linalg.norm(given["velocities"], axis=1).max())
        self._engine.worlds.expect(place.world, speed=fastest * place.cells.scale)

    def rows(self, state: State, number: int) -> BodyRows:
        """Return which particles of ``state`` are those of body ``number`` of all."""
        ids = np.asarray(state["ids"], dtype=np.int64)
        first, end = int(self._bodies.offsets[number]), int(self._bodies.offsets[number + 1])
        mine = (ids >= first) & (ids < end)
        return BodyRows(mine, ids[mine] - first)

    def _number(self, place: packing.WorldSlot, index: int) -> int:
        return self._bodies.of(place.world).start + index


def next_stop(place: packing.WorldSlot, now: float, end: float) -> float:
    """Return the next time after ``now``, at most ``end``, at which something in the world starts or a track bends."""
    setup = place.setup
    tracks = [setup.gravity_track]
    single = []
    for body in setup.bodies:
        tracks += [body.acceleration, body.pin_motion, body.velocity_keys]
        tracks += list(body.parameter_tracks.values())
        single += [body.start_time, *(time for time, _ in body.material_track)]
        single += [constant_until(track, now) for track in body.parameter_tracks.values()]
    for collider in setup.colliders:
        tracks += [collider.translations, collider.rotations, collider.vertices]
    knots = [t for t in single if now + SAME_TIME < t < end - SAME_TIME]
    knots += [t for track in tracks if track is not None for t in track.knots(now + SAME_TIME, end - SAME_TIME)]
    return min([end, *knots])


def constant_until(track: Track, now: float) -> float:
    """Return the time until which a parameter on ``track`` may be taken as constant from ``now`` on; inf if it is."""
    i = int(np.searchsorted(track.times, now + SAME_TIME, side="right"))
    if i == 0 or i == len(track.times) or track.values[i] == track.values[i - 1]:
        return math.inf
    return now + max(min(PARAMETER_STEP, float(track.times[i] - track.times[i - 1]) / PARAMETER_PIECES), 2 * SAME_TIME)


def material_choice(body: BodyParticles, now: float) -> NDArray[np.int32]:
    """Return the material of each particle at time ``now``, counted as in ``material_index``."""
    past = [index for time, index in body.material_track if time <= now]
    if past:
        return np.full(body.count, past[-1], dtype=np.int32)
    return np.zeros(body.count, dtype=np.int32) if body.material_index is None else body.material_index


def velocity_due(body: BodyParticles, then: float, now: float) -> Array | None:
    """Return the last velocity (3,) in m/s that ``body`` is set to after ``then``, up to ``now``; None if it is not."""
    keys = body.velocity_keys
    due = [] if keys is None else [k for k, time in enumerate(keys.times) if then < time <= now]
    return None if keys is None or not due else keys.values[due[-1]]


def _switch_material(
    state: State, rows: BodyRows, place: packing.WorldSlot, index: int, choice: NDArray[np.int32]
) -> float:
    """Switch the particles of body ``index`` in ``state`` to other materials (N,), and reset their history variables.

    Returns the speed in cells/s of the fastest wave in them.
    """
    constants, wave_speed = packing.stiffness(place.setup.bodies[index], choice, place.cells)
    state["constants"][rows.mine, 1:3] = constants[rows.numbers]
    state["material"][rows.mine] = packing.first_material(place, index) + choice[rows.numbers]
    state["memory"][rows.mine] = 0.0
    return wave_speed


def _shift_velocity(state: State, rows: BodyRows, velocity: Array) -> float:
    """Set the mean ``velocity`` (3,) of a body, cells/s, and return the speed of its fastest particle."""
    given = np.asarray(state["v"][rows.mine], dtype=np.float64)
    masses = np.asarray(state["constants"][rows.mine, 0], dtype=np.float64)
    given += velocity - np.average(given, axis=0, weights=masses)
    state["v"][rows.mine] = given.astype(np.float32)
    return float(np.linalg.norm(given, axis=1).max())


def _put_motion(state: State, rows: BodyRows, place: packing.WorldSlot, index: int, given: dict[str, Array]) -> None:
    """Set the motion of every particle of body ``index`` to what is ``given``, see ``checked_motion``."""
    count, scale = place.setup.bodies[index].count, place.cells.scale
    new: dict[str, NDArray[np.generic]] = {
        "v": given["velocities"] * scale,
        "C": given.get("velocity_gradients", np.zeros((count, 3, 3))),
    }
    if "gradients" in given:
        new["F"] = given["gradients"]
        if "conformation" in state:
            # What relaxed in the old deformation does not belong to the new one.
            new["conformation"] = np.broadcast_to(np.eye(3), (count, 3, 3))
    if "positions" in given:
        x, keys = places_in_blocks(place.field(index), place.cells.points_to_engine(given["positions"]))
        new |= {"x": x, "keys": keys}
        # Contact impulses at another place do not apply here.
        new["reaction"] = np.zeros((count, 4))
    for name, values in new.items():
        changed = np.array(state[name])
        changed[rows.mine] = values[rows.numbers].astype(changed.dtype)
        state[name] = changed


def checked_motion(
    name: str,
    count: int,
    velocities: Array,
    velocity_gradients: Array | None,
    positions: Array | None,
    gradients: Array | None,
) -> dict[str, Array]:
    """Return the arguments of ``World.set_motion`` that are given, as float64.

    Raises InputError on a wrong shape or a number that is not finite.
    """
    shapes = {
        "velocities": (velocities, (count, 3)),
        "velocity_gradients": (velocity_gradients, (count, 3, 3)),
        "positions": (positions, (count, 3)),
        "gradients": (gradients, (count, 3, 3)),
    }
    given = {}
    for field, (values, shape) in shapes.items():
        if values is not None:
            array = np.asarray(values, dtype=np.float64)
            if array.shape != shape:
                raise InputError(f"body {name!r}: {field} have shape {array.shape}: give {shape}, one a particle")
            if not np.isfinite(array).all():
                bad = int(np.argmin(np.isfinite(array.reshape(count, -1)).all(axis=1)))
                raise InputError(f"body {name!r}: {field} of particle {bad} are {array[bad].tolist()}: give numbers")
            given[field] = array
    return given
