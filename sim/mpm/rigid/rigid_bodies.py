# SPDX-License-Identifier: MIT
"""Rigid bodies and colliders of worlds on the device; metres outside, cells in the arrays (``rigid_layout``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...errors import InputError
from ..bodies import BodyParticles, Vector
from ..colliders import SAME_TIME, Collider, Surface
from ..geometry.signed_distance import DistanceLattice
from ..kernels.kernel_arrays import RigidArrays, RigidContacts, ShapeArrays
from ..kernels.runtime import new_array
from ..world_setup import WorldSetup
from . import rigid_layout as at
from .collision_shapes import lattice_of, tables
from .rigid_motion import rigid_substep
from .rigid_packing import RigidBody, RigidPacking, rigid_bodies_of
from .surface_motion import Footing, footing_of

Array = NDArray[np.float64]

LEAST_RECOVERY = 1.0
"""Least speed at which depth is taken out of contacts, cells/s: that without gravity."""

CHANGING = ("solids", "solid_kinds", "solid_numbers", "world_numbers", "memory")
"""The arrays that a checkpoint holds."""

KINDS = {
    "steps": ti.f64,
    "world_spans": ti.i32,
    "world_numbers": ti.f64,
    "world_report": ti.f64,
    "solid_kinds": ti.i32,
    "solid_numbers": ti.f64,
    "solids": ti.f64,
    "impulses": ti.f64,
    "clusters": ti.f32,
    "cluster_starts": ti.i32,
    "points": ti.f32,
    "pairs": ti.i32,
    "pair_numbers": ti.f64,
    "counts": ti.i32,
    "contacts": ti.f64,
    "memory": ti.f64,
    "reaches": ti.f64,
    "scores": ti.f64,
    "chosen": ti.i32,
    "systems": ti.f64,
    "motions": ti.f32,
    "shape_numbers": ti.f32,
    "shape_dims": ti.i32,
    "distances": ti.f32,
}
"""Type of the elements of each array; ``kernel_arrays`` describes them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidPose:
    """Pose and motion of a rigid body or collider. World metres; a point at rest p is now at rotation p + translation.

    momentum: kg m/s; angular_momentum: about the centre of mass, kg m²/s; kinetic and potential energy: J. All three
    are 0 of colliders, which have no mass.
    """

    rotation: Array
    translation: Array
    center: Array
    velocity: Array
    spin: Array
    momentum: Array
    angular_momentum: Array
    kinetic: float
    potential: float


class RigidBodies:
    """The rigid bodies (in the order of the setup), then the colliders of each world, and their contact pairs.

    scales: cells per metre of each world; origins: the world point of each that is cell (0, 0, 0).
    asleep: world and name of bodies that stay in place and touch nothing, from the next segment on.
    Call ``set_segments`` before the first substep and wherever a track bends, gravity changes or a body starts.
    """

    def __init__(self, setups: Sequence[WorldSetup], scales: Sequence[float], origins: Sequence[Vector]) -> None:
        if not setups or not len(setups) == len(scales) == len(origins):
            raise InputError(
                f"setups, scales and origins are {len(setups)}, {len(scales)}, {len(origins)}: give one of each a world"
            )
        for scale in scales:
            if not (math.isfinite(scale) and scale > 0):
                raise InputError(f"scale is {scale!r}: give cells per metre above 0")
        self.setups = tuple(setups)
        self.scales = tuple(float(scale) for scale in scales)
        self.origins = np.asarray(origins, dtype=np.float64)
        self._baked: dict[tuple[int, float], tuple[DistanceLattice, Footing]] = {}
        self._segments: dict[int, tuple[float, float]] = {}
        self._keys_done = np.full(len(setups), -np.inf)
        self.asleep: set[tuple[int, str]] = set()
        self.arrays: dict[str, ti.Ndarray] = {}
        self._rigid_bodies, spans = rigid_bodies_of(self.setups)
        packing = RigidPacking(
            setups=self.setups, scales=self.scales, origins=self.origins, bodies=self._rigid_bodies, spans=spans
        )
        self.solved_together = packing.solved_together()
        for name, values in packing.rows().items():
            self._put(name, values)
        self._put_shapes({i: [rigid.lattices[0]] for i, rigid in enumerate(self._rigid_bodies) if rigid.lattices})
        self.set_segments(dict.fromkeys(range(len(self.setups)), (0.0, 1.0)))

    # ---- arrays -------------------------------------------------------------------------------------------------

    def _put(self, name: str, values: NDArray[np.generic]) -> None:
        kind = KINDS[name]
        flat = np.ascontiguousarray(values).ravel().astype(ti.lang.util.to_numpy_type(kind))
        if name not in self.arrays or self.arrays[name].shape != flat.shape:
            self.arrays[name] = new_array(kind, flat.size)
        self.arrays[name].from_numpy(flat)

    def _put_shapes(self, changed: Mapping[int, list[DistanceLattice]]) -> None:
        for i, lattices in changed.items():
            self._rigid_bodies[i].lattices = lattices
        parts = []
        for rigid in self._rigid_bodies:
            lattices = rigid.lattices or [lattice_of(rigid.source.surface)] * 2  # type: ignore[arg-type, union-attr]
            rigid.lattices = lattices
            parts += [(lattice, rigid.center, self.scales[rigid.world]) for lattice in lattices]
        table = tables(parts)
        self._put("shape_numbers", np.append(table.numbers, np.float32(1)))
        self._put("shape_dims", np.append(table.dims, np.int32(2)))
        self._put("distances", table.distances)

    def _put_motions(self, kinds: NDArray[np.generic]) -> None:
        """Velocities of the surfaces that deform, and where those of each begin, in its row of ``kinds``."""
        parts, offset = [np.zeros(1, dtype=np.float32)], 1
        for i, rigid in enumerate(self._rigid_bodies):
            kinds[i, at.MOTION] = offset
            parts += [np.ravel(motion) * np.float32(self.scales[rigid.world]) for motion in rigid.motions]
            offset += sum(motion.size for motion in rigid.motions)
        self._put("motions", np.concatenate(parts))

    # ---- finding ------------------------------------------------------------------------------------------------

    def index(self, w: int, name: str) -> int:
        """Row in the arrays of the body or collider ``name`` of world ``w``."""
        for i, rigid in enumerate(self._rigid_bodies):
            if rigid.world == w and rigid.name == name:
                return i
        raise InputError(f"world {w} has no rigid body or collider {name!r}")

    def name(self, i: int) -> str:
        """Name of the body or collider in row ``i`` of the arrays."""
        return self._rigid_bodies[i].name

    @property
    def count(self) -> int:
        """Rigid bodies and colliders of all worlds."""
        return len(self._rigid_bodies)

    @property
    def bodies(self) -> RigidArrays:
        """State of all bodies as the kernels take it."""
        names = ("steps", "world_spans", "world_numbers", "world_report", "solid_kinds", "solid_numbers", "solids")
        return RigidArrays(len(self.setups), *(self.arrays[name] for name in (*names, "impulses")))

    @property
    def shapes(self) -> ShapeArrays:
        """Surfaces of all bodies as the kernels take them."""
        names = ("clusters", "cluster_starts", "points", "shape_numbers", "shape_dims", "distances", "motions")
        return ShapeArrays(*(self.arrays[name] for name in names))

    @property
    def contacts(self) -> RigidContacts:
        """Pairs and their contacts as the kernels take them."""
        names = ("pairs", "pair_numbers", "counts", "contacts", "memory", "reaches", "scores", "chosen", "systems")
        return RigidContacts(*(self.arrays[name] for name in names))

    # ---- time ---------------------------------------------------------------------------------------------------

    def set_segments(self, segments: Mapping[int, tuple[float, float]]) -> None:
        """Prepare the worlds named, each for its time from start to end in s over which all tracks are linear: gravity,
        poses and speeds of colliders, uniform accelerations, bodies that start and velocities set at the start."""
        world = self._get("world_numbers", at.WORLD)
        for w, (start, end) in segments.items():
            if not (math.isfinite(start) and math.isfinite(end) and end > start):
                raise InputError(f"segment is {start!r} to {end!r}: give finite seconds in rising order")
            if not 0 <= w < len(self.setups):
                raise InputError(f"world is {w}: give 0 to {len(self.setups) - 1}")
            gravity = np.asarray(self.setups[w].gravity_at(0.5 * (start + end))) * self.scales[w]
            world[w, at.GRAVITY : at.GRAVITY + 3] = gravity
            flight = math.sqrt(2 * at.RECOVERY_HEIGHT * float(np.linalg.norm(gravity)))
            world[w, at.RECOVERY] = max(flight, LEAST_RECOVERY)
        kinds, numbers = self._get("solid_kinds", at.KINDS), self._get("solid_numbers", at.NUMBERS)
        state = self._get("solids", at.STATE)
        changed: dict[int, list[DistanceLattice]] = {}
        for i, rigid in enumerate(self._rigid_bodies):
            if rigid.world not in segments:
                continue
            start, end = segments[rigid.world]
            if isinstance(rigid.source, BodyParticles):
                self._set_body(rigid, start, end, kinds[i], numbers[i], state[i])
            elif rigid.source.vertices is not None:
                changed |= self._set_deforming(i, start, end, state[i], numbers[i])
            elif kinds[i, at.KIND] == at.KINEMATIC:
                self._set_pose(rigid, start, end, state[i])
        for w, (start, end) in segments.items():
            self._keys_done[w] = start + SAME_TIME
            self._segments[w] = (start, end)
        self._put("world_numbers", world)
        if changed:
            self._put_shapes(changed)
            self._put_motions(kinds)
        self._put("solid_kinds", kinds)
        self._put("solid_numbers", numbers)
        self._put("solids", state)

    def _set_body(
        self, rigid: RigidBody, start: float, end: float, kinds: NDArray[np.generic], numbers: Array, state: Array
    ) -> None:
        body, scale = rigid.source, self.scales[rigid.world]
        assert isinstance(body, BodyParticles)
        starts = body.start_time <= start + SAME_TIME and (rigid.world, rigid.name) not in self.asleep
        kinds[at.KIND] = at.DYNAMIC if starts else at.WAITING
        if body.acceleration is not None:
            numbers[at.UNIFORM : at.UNIFORM + 3] = body.acceleration.at(0.5 * (start + end)) * scale
        if body.velocity_keys is not None and starts:
            done = self._keys_done[rigid.world]
            due = [k for k, t in enumerate(body.velocity_keys.times) if done < t <= start + SAME_TIME]
            if due:
                state[at.V : at.V + 3] = body.velocity_keys.values[due[-1]] * scale

    def _set_pose(self, rigid: RigidBody, start: float, end: float, state: Array) -> None:
        collider = rigid.source
        assert isinstance(collider, Collider)
        scale, origin = self.scales[rigid.world], self.origins[rigid.world]
        here, there = np.zeros(3), np.zeros(3)
        if collider.translations is not None:
            here, there = collider.translations.at(start), collider.translations.at(end)
        turn, spin = Rotation.identity(), np.zeros(3)
        if collider.rotations is not None:
            turn, spin = _turn(collider.rotations.times, collider.rotations.values, start, end)
        x, y, z, s = turn.as_quat()
        state[at.X : at.X + 3] = (rigid.center + here - origin) * scale
        state[at.Q : at.Q + 4] = s, x, y, z
        state[at.V : at.V + 3] = (there - here) * scale / (end - start)
        state[at.W : at.W + 3] = spin
        state[at.R : at.R + 9] = turn.as_matrix().ravel()

    def _set_deforming(
        self, i: int, start: float, end: float, state: Array, numbers: Array
    ) -> dict[int, list[DistanceLattice]]:
        """Lattices of the keyframes around the segment; returns those that are new."""
        collider = self._rigid_bodies[i].source
        assert isinstance(collider, Collider)
        assert collider.vertices is not None
        track = collider.vertices
        middle = 0.5 * (start + end)
        k = int(np.clip(np.searchsorted(track.times, middle, side="right") - 1, 0, len(track.times) - 1))
        n = min(k + 1, len(track.times) - 1)
        if middle < track.times[0]:
            n = k
        state[at.BLEND], numbers[at.BLEND_RATE] = 0.0, 0.0
        if n > k:
            span = track.times[n] - track.times[k]
            state[at.BLEND] = np.clip((start - track.times[k]) / span, 0, 1)
            numbers[at.BLEND_RATE] = 1 / span
        baked = []
        for key, other in ((k, n), (n, k)):
            if (i, float(key)) not in self._baked:
                way = float(np.abs(track.values[key] - track.values[other]).max())
                surface = Surface(vertices=track.values[key], faces=collider.surface.faces)
                lattice = lattice_of(surface, margin=way)
                self._baked[(i, float(key))] = lattice, footing_of(lattice, surface)
            baked.append(self._baked[(i, float(key))])
        self._baked = {key: value for key, value in self._baked.items() if key[0] != i or key[1] in (k, n)}
        old = self._rigid_bodies[i].lattices
        if len(old) == 2 and all(a is b for a, (b, _) in zip(old, baked, strict=True)):
            return {}
        velocities = numbers[at.BLEND_RATE] * (track.values[n] - track.values[k])
        self._rigid_bodies[i].motions = tuple(footing.velocities(velocities) for _, footing in baked)
        return {i: [lattice for lattice, _ in baked]}

    def advance(self, dt: float | Sequence[float], substeps: int = 1) -> None:
        """``substeps`` substeps of ``dt`` seconds (one number, or one a world) of worlds without particles."""
        steps = np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(self.setups),))
        if not (np.isfinite(steps).all() and (steps > 0).all()):
            raise InputError(f"dt is {dt!r}: give seconds above 0")
        self._put("steps", steps)
        for _ in range(substeps):
            for each in rigid_substep(together=self.solved_together):
                each(self.bodies, *([self.shapes] if "shapes_points" in each.arguments else []), self.contacts)

    # ---- state --------------------------------------------------------------------------------------------------

    def awake(self) -> bool:
        """Whether a rigid body of any world moves or may be moved."""
        return bool((self._get("solid_kinds", at.KINDS)[: self.count, at.KIND] == at.DYNAMIC).any())

    def collider_speed(self) -> float:
        """Speed in cells/s that no point of a collider of any world exceeds."""
        moves = self._get("solid_kinds", at.KINDS)[: self.count, at.KIND] == at.KINEMATIC
        state = self._get("solids", at.STATE)[: self.count][moves]
        radius = self._get("solid_numbers", at.NUMBERS)[: self.count][moves, at.RADIUS]
        speed = np.linalg.norm(state[:, at.V : at.V + 3], axis=1)
        return float((speed + radius * np.linalg.norm(state[:, at.W : at.W + 3], axis=1)).max(initial=0.0))

    def _get(self, name: str, stride: int) -> NDArray[np.generic]:
        return self.arrays[name].to_numpy().reshape(-1, stride)

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything needed to continue, as arrays for ``numpy.savez``."""
        state = {name: self.arrays[name].to_numpy() for name in CHANGING}
        state["keys_done"] = self._keys_done.copy()
        state["segments"] = np.array([self._segments[w] for w in range(len(self.setups))])
        return state

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Restore what ``state`` returned for bodies of the same setups, scales and origins."""
        for name in (*CHANGING, "keys_done", "segments"):
            if name not in state:
                raise InputError(f"checkpoint has no {name}: it was not written by this engine")
            if name in CHANGING and state[name].shape != self.arrays[name].shape:
                raise InputError(f"checkpoint is of another scene: {name} has shape {state[name].shape}")
        times = np.asarray(state["segments"], dtype=np.float64)
        self.set_segments({w: (float(start), float(end)) for w, (start, end) in enumerate(times)})
        self.put_back(state)
        self._keys_done = np.array(state["keys_done"], dtype=np.float64)

    def put_back(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Restore what ``state`` returned in the same segments of time."""
        for name in CHANGING:
            self.arrays[name].from_numpy(np.ascontiguousarray(state[name]))

    def pose(self, w: int, name: str) -> RigidPose:
        """Pose and motion of the rigid body or collider ``name`` of world ``w``."""
        i = self.index(w, name)
        rigid, scale = self._rigid_bodies[i], self.scales[w]
        row = np.asarray(self._get("solids", at.STATE)[i], dtype=np.float64)
        numbers = self._get("solid_numbers", at.NUMBERS)[i]
        rotation = row[at.R : at.R + 9].reshape(3, 3)
        center = row[at.X : at.X + 3] / scale + self.origins[w]
        velocity, spin = row[at.V : at.V + 3] / scale, row[at.W : at.W + 3].copy()
        mass = float(numbers[at.MASS])
        momentum = row[at.L : at.L + 3] / scale**2
        world = np.asarray(self._get("world_numbers", at.WORLD)[w], dtype=np.float64)
        gravity = world[at.GRAVITY : at.GRAVITY + 3] / scale
        return RigidPose(
            rotation=rotation,
            translation=center - rotation @ rigid.center,
            center=center,
            velocity=velocity,
            spin=spin,
            momentum=mass * velocity,
            angular_momentum=momentum,
            kinetic=0.5 * mass * float(velocity @ velocity) + 0.5 * float(spin @ momentum),
            potential=-mass * float(numbers[at.GRAVITY_FACTOR]) * float(gravity @ center),
        )


def _turn(times: Array, values: Array, start: float, end: float) -> tuple[Rotation, Array]:
    """Orientation at ``start`` and angular velocity (3,) up to ``end`` of keyframes of rotation vectors."""

    def between(t: float) -> tuple[Rotation, Array]:
        if t <= times[0] or len(times) == 1:
            return Rotation.from_rotvec(values[0]), np.zeros(3)
        if t >= times[-1]:
            return Rotation.from_rotvec(values[-1]), np.zeros(3)
        k = int(np.searchsorted(times, t, side="right")) - 1
        a, b = values[k], values[k + 1]
        way = b - a
        if np.linalg.norm(np.cross(a, b)) > 1e-9 * max(1.0, float(np.linalg.norm(a) * np.linalg.norm(b))):
            way = (Rotation.from_rotvec(b) * Rotation.from_rotvec(a).inv()).as_rotvec()
        share = (t - times[k]) / (times[k + 1] - times[k])
        return Rotation.from_rotvec(share * way) * Rotation.from_rotvec(a), way / (times[k + 1] - times[k])

    return between(start)[0], between(0.5 * (start + end))[1]
