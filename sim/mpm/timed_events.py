# SPDX-License-Identifier: MIT
"""What a setup asks for at given times, and what that, or a caller, changes in the particles of a body.

A change is made in ``state``, arrays of all particles as ``Engine.state`` returns them; rows: which of them are the
body's, and the number in the body of each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import packing
from .bodies import BodyParticles
from .colliders import SAME_TIME, Track
from .particle_store import State, places_in_blocks

Array = NDArray[np.float64]

PARAMETER_STEP, PARAMETER_PIECES = 1.0 / 240.0, 32
"""A parameter on its way between two keyframes is constant for this many seconds at most, and for this part of the way;
it has the value of the middle."""


class BodyRows(NamedTuple):
    """A body's particles in a state. mine: (n,) whether each is. numbers: (N,) in the body, of those that are."""

    mine: NDArray[np.bool_]
    numbers: NDArray[np.int64]


def rows_of_body(state: State, first: int, end: int) -> BodyRows:
    """Return the rows of the particles that the caller numbers ``first`` to ``end``, exclusive."""
    ids = np.asarray(state["ids"], dtype=np.int64)
    mine = (ids >= first) & (ids < end)
    return BodyRows(mine, ids[mine] - first)


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


def change_material(
    state: State, rows: BodyRows, place: packing.WorldSlot, index: int, choice: NDArray[np.int32]
) -> float:
    """Switch the particles of body ``index`` to other materials (N,) from now on, and reset their history variables.

    Returns the speed in cells/s of the fastest wave in them.
    """
    constants, wave_speed = packing.stiffness(place.setup.bodies[index], choice, place.cells)
    state["constants"][rows.mine, 1:3] = constants[rows.numbers]
    state["material"][rows.mine] = packing.first_material(place, index) + choice[rows.numbers]
    state["memory"][rows.mine] = 0.0
    return wave_speed


def set_mean_velocity(state: State, rows: BodyRows, velocity: Array) -> float:
    """Set the mean ``velocity`` (3,) of a body, cells/s, and return the speed of its fastest particle."""
    given = np.asarray(state["v"][rows.mine], dtype=np.float64)
    masses = np.asarray(state["constants"][rows.mine, 0], dtype=np.float64)
    given += velocity - np.average(given, axis=0, weights=masses)
    state["v"][rows.mine] = given.astype(np.float32)
    return float(np.linalg.norm(given, axis=1).max())


def set_motion(state: State, rows: BodyRows, place: packing.WorldSlot, index: int, given: dict[str, Array]) -> None:
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
