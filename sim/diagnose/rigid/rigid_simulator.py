# SPDX-License-Identifier: MIT
"""Batched simulation of one rigid body: its shape and mass, and worlds that run in one kernel launch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...errors import InputError
from ...mpm.kernels.runtime import ensure_started
from ...mpm.solver_options import SolverOptions
from ..capture import CaptureObject
from ..work import LAUNCH, Work

Array = NDArray[np.float64]

ROUND = 0.97
"""Hull volume over that of the bounding sphere above which a mesh counts as a faceted sphere."""

MOST_CORNERS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidBody:
    """Shape and mass of a body of uniform density.

    center: (3,) m, rest frame, centre of mass. corners: (V, 3) m about it. radius: m around every corner; a sphere has
    one corner, its centre. inertia: (3, 3) m², per mass. area: m², mean cross-section. density: kg/m³. volume: m³.
    """

    center: Array
    corners: Array
    radius: float
    inertia: Array
    area: float
    density: float
    volume: float

    @property
    def round(self) -> bool:
        """Return whether it is a sphere."""
        return len(self.corners) == 1

    @property
    def bound(self) -> float:
        """Return the largest distance in m of its surface from its centre."""
        return float(np.linalg.norm(self.corners, axis=1).max()) + self.radius

    @property
    def mass(self) -> float:
        """Return the mass in kg."""
        return self.density * self.volume

    @cached_property
    def _faces(self) -> Array:
        """Return the hull's outward normals and offsets (F, 4): inside where normal · x + offset < 0."""
        return np.unique(ConvexHull(self.corners).equations, axis=0)

    def reach(self, direction: Array) -> float:
        """Return the distance in m from the centre of mass to the surface along ``direction`` (3,)."""
        length = float(np.linalg.norm(direction))
        if self.round or length < 1e-12:
            return self.bound
        leans = self._faces[:, :3] @ (direction / length)
        ahead = leans > 1e-9
        return float(np.min(-self._faces[ahead, 3] / leans[ahead]))


def rigid_body(item: CaptureObject) -> RigidBody:
    """Return the body of ``item``. Raises InputError for a mesh without volume."""
    vertices = np.unique(item.vertices[np.unique(item.faces)], axis=0) if len(item.faces) else item.vertices
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError) as error:
        raise InputError(
            f"object {item.name!r}: its mesh is flat ({type(error).__name__}): give a closed body"
        ) from None
    middle = 0.5 * (vertices[hull.vertices].min(axis=0) + vertices[hull.vertices].max(axis=0))
    reach = float(np.linalg.norm(vertices - middle, axis=1).max())
    if hull.volume > ROUND * 4 / 3 * np.pi * reach**3 or _spherical(hull, middle, reach):
        return RigidBody(
            center=middle,
            corners=np.zeros((1, 3)),
            radius=reach,
            inertia=0.4 * reach**2 * np.eye(3),
            area=np.pi * reach**2,
            density=item.belief.density_kg_m3,
            volume=4 / 3 * np.pi * reach**3,
        )
    mesh = trimesh.Trimesh(item.vertices, item.faces)
    if not mesh.is_watertight or mesh.volume <= 0:
        mesh = mesh.convex_hull
    mass = mesh.mass_properties
    center = np.asarray(mass.center_mass, dtype=np.float64)
    return RigidBody(
        center=center,
        corners=_few(vertices[hull.vertices]) - center,
        radius=0.0,
        inertia=np.asarray(mass.inertia, dtype=np.float64) / float(mass.mass),
        area=0.25 * float(hull.area),
        density=item.belief.density_kg_m3,
        volume=float(mesh.volume),
    )


ALONG_GROUND = float(np.sin(np.radians(10)))
"""Sine of a cylinder's axis to the ground up to which it lies on its rim."""
ON_RIM = 24
"""Corners of a mesh, on both rims, from which a prism counts as a cylinder."""


def on_its_rim(item: CaptureObject, normal: Array) -> RigidBody | None:
    """Return the body of a cylinder that lies on its rim on a ground of unit ``normal`` (3,), None for other bodies.

    As long as its axis keeps its direction, it touches the ground like a ball of its radius, with its own moments of
    inertia: a rim of corners would fall from one to the next.
    """
    vertices = np.unique(item.vertices[np.unique(item.faces)], axis=0) if len(item.faces) else item.vertices
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError):
        return None
    corners = vertices[hull.vertices] - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    if len(corners) < ON_RIM:
        return None
    for axis in np.linalg.eigh(corners.T @ corners)[1].T:
        along = corners @ axis
        radii = np.linalg.norm(corners - along[:, None] * axis, axis=1)
        ends = np.abs(np.abs(along) - np.abs(along).max())
        if np.ptp(radii) < 0.01 * radii.max() and ends.max() < 0.01 * np.abs(along).max():
            body = rigid_body(item)
            lies = abs(float(axis @ normal)) < ALONG_GROUND
            return replace(body, corners=np.zeros((1, 3)), radius=float(radii.max())) if lies else None
    return None


def _spherical(hull: ConvexHull, middle: Array, reach: float) -> bool:
    """Return whether the corners lie on one sphere and no face cuts off much of it: the faces are only tessellation.

    The corners of a cylinder lie on a sphere, too, but its ends are at most 0.71 of the radius from the middle; faces
    of a sphere of 40 corners are at 0.85 or more.
    """
    corners = hull.points[hull.vertices]
    faces = -(hull.equations[:, :3] @ middle + hull.equations[:, 3])
    on_sphere = float(np.linalg.norm(corners - middle, axis=1).min()) > 0.99 * reach
    return len(corners) >= 40 and on_sphere and float(faces.min()) > 0.8 * reach


def _few(points: Array) -> Array:
    """Return at most ``MOST_CORNERS`` of ``points``, far from each other."""
    if len(points) <= MOST_CORNERS:
        return points
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < MOST_CORNERS:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


CONTACT_TIME = 0.002
"""Default half period of a contact in s: hard, hand-sized bodies."""

STEPS = 20
"""Steps per half period of a contact."""

SOFTER = 0.98
"""Factor on the damping ratio of a restitution: simulators differ by a few percent."""

MOST_DAMPING = 2.5
"""Largest damping ratio: steps of a twentieth of the half period are not stable much beyond; 2.5 rebounds at 4 %."""

LONGEST = 0.005
"""Longest step in flight, s."""

SLOTS: Mapping[str, Any] = {
    "gravity": slice(0, 3),
    "drag": 3,
    "wind": slice(4, 7),
    "lift": 7,
    "tether": 8,
    "length": 9,
    "anchor": slice(10, 13),
    "string": 13,
    "friction": 14,
    "rolling": 15,
    "pull": 16,
    "reach": 17,
    "center": slice(18, 21),
    "inertia": slice(21, 27),
    "mobility": slice(27, 33),
    "spring": 33,
    "dashpot": 34,
    "rub": 35,
    "step": 36,
    "normal": slice(37, 40),
    "point": slice(40, 43),
    "inset": 43,
}
NUMBERS, STATE, RECORD = 44, 13, 17


@cache
def _bounces() -> tuple[Array, Array]:
    """Return rising restitutions and their damping ratios, for a spring and dashpot that cannot pull.

    Schwager and Pöschel, Granular Matter 9 (2007), equations 15 and 20.
    """
    low, high = np.linspace(0.0, 0.999, 400), np.geomspace(1.001, 30.0, 200)
    root, far = np.sqrt(1 - low**2), np.sqrt(high**2 - 1)
    swing = np.exp(-low / root * np.arccos(np.clip(2 * low**2 - 1, -1, 1)))
    creep = np.exp(-high / far * np.log((high + far) / (high - far)))
    found, ratios = np.concatenate([swing, creep]), np.concatenate([low, high])
    return found[::-1].copy(), ratios[::-1].copy()


def damping_ratio(restitution: Array) -> Array:
    """Return the damping ratio of a contact for restitutions from 0 to 1."""
    known, ratios = _bounces()
    return np.asarray(SOFTER * np.minimum(np.interp(restitution, known, ratios), MOST_DAMPING))


def set_contact(numbers: Array, restitution: Array, contact_time: Array, tangential: Array) -> None:
    """Write springs and dashpots into ``numbers`` (W, NUMBERS); restitution, contact_time (half period in s): (W,).

    rub: (W,) tangential damping rate relative to the normal one.
    """
    rate = np.pi / contact_time
    numbers[:, SLOTS["spring"]] = rate**2
    numbers[:, SLOTS["dashpot"]] = 2 * damping_ratio(restitution) * rate
    numbers[:, SLOTS["rub"]] = tangential * rate
    numbers[:, SLOTS["step"]] = contact_time / STEPS


def six_components(matrix: Array) -> Array:
    """Return symmetric (..., 3, 3) as (..., 6): xx, yy, zz, xy, xz, yz."""
    return np.stack([matrix[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidWorlds:
    """Runs many worlds of one body. longest: step in flight in s. threads: 0 for all. work: counts the steps."""

    body: RigidBody
    longest: float = LONGEST
    threads: int = 0
    work: Work = field(default_factory=Work)

    def run(
        self,
        starts: Array,
        numbers: Array,
        times: list[Array] | Array,
        counts: NDArray[np.int64] | None = None,
    ) -> Array:
        """Return states (W, M, RECORD) of the centre of volume at ``times`` of every world, in s since its start.

        starts: (W, STATE). numbers: (W, NUMBERS). times: (W, M), or W arrays of up to M, padded with zeros. counts:
        (W,) how many of (W, M) times count, all without it.
        """
        from . import rigid_kernel  # Taichi is imported late

        ensure_started(SolverOptions(threads=self.threads))
        if counts is None:
            count = np.array([len(t) for t in times], dtype=np.int32)
            padded = np.zeros((len(count), max(1, int(count.max(initial=0)))))
            for row, t in zip(padded, times, strict=True):
                row[: len(t)] = t
        else:
            count, padded = counts.astype(np.int32), np.ascontiguousarray(times)
        out = np.zeros((len(count), padded.shape[1], RECORD))
        if len(count) and count.max() > 0:
            steps = np.zeros(len(count), dtype=np.int32)
            body, corners = self.body, np.ascontiguousarray(self.body.corners)
            rigid_kernel.advance(
                len(count),
                self.longest,
                rigid_kernel.BodyPoints(len(corners), body.radius, body.bound, corners),
                rigid_kernel.RunArrays(
                    np.ascontiguousarray(starts), np.ascontiguousarray(numbers), count, padded, out, steps
                ),
            )
            self.work.add(LAUNCH + int(steps.sum(dtype=np.int64)))
        return out
