# SPDX-License-Identifier: MIT
"""Mass, centre and inertia of particles and meshes. No Taichi. World metres, kilograms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .triangles import Array, checked_places


@dataclass(frozen=True, kw_only=True, eq=False)
class MassProperties:
    """Mass, centre and inertia of a body. Raises InputError on bad shapes or numbers."""

    mass: float
    """Kilograms, above 0."""

    center: Array
    """Centre of mass (3,), metres."""

    inertia: Array
    """Tensor of inertia (3, 3) about the centre, kg m², symmetric."""

    def __post_init__(self) -> None:
        center, inertia = np.asarray(self.center, dtype=np.float64), np.asarray(self.inertia, dtype=np.float64)
        if not (math.isfinite(self.mass) and self.mass > 0):
            raise InputError(f"mass is {self.mass!r}: give kilograms above 0")
        if center.shape != (3,) or not np.isfinite(center).all():
            raise InputError(f"center is {self.center!r}: give three finite metres")
        if inertia.shape != (3, 3) or not np.isfinite(inertia).all():
            raise InputError(f"inertia has shape {inertia.shape}: give finite (3, 3)")
        object.__setattr__(self, "mass", float(self.mass))
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "inertia", 0.5 * (inertia + inertia.T))


def mass_properties(
    positions: NDArray[np.floating], masses: NDArray[np.floating], *, volumes: NDArray[np.floating] | None = None
) -> MassProperties:
    """Return the mass properties of particles at positions (N, 3), metres, with masses (N,), kg.

    volumes: (N,) m³ gives every particle the inertia of a cube of that volume; None makes them points.

    Raises InputError on bad shapes, and where a mass or volume is not above 0.
    """
    places = checked_places(positions)
    mass = np.asarray(masses, dtype=np.float64)
    if len(places) == 0 or mass.shape != (len(places),) or not (np.isfinite(mass) & (mass > 0)).all():
        raise InputError(f"masses have shape {mass.shape}: give ({len(places)},) kilograms above 0, N above 0")
    total = float(mass.sum())
    center = mass @ places / total
    offset = places - center
    second = np.einsum("n,ni,nj->ij", mass, offset, offset)
    if volumes is not None:
        size = np.asarray(volumes, dtype=np.float64)
        if size.shape != mass.shape or not (np.isfinite(size) & (size > 0)).all():
            raise InputError(f"volumes have shape {size.shape}: give ({len(places)},) cubic metres above 0")
        second += np.eye(3) * (mass @ size ** (2 / 3) / 12)
    return MassProperties(mass=total, center=center, inertia=np.trace(second) * np.eye(3) - second)


def mesh_properties(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], *, density: float = 1.0, thickness: float | None = None
) -> MassProperties:
    """Return the mass properties of the solid that the mesh (V, 3), (T, 3) encloses, metres, density kg/m³.

    thickness: m, of the thin shell along the mesh instead. Sums over tetrahedra from the origin (Tonon 2004, J. Math.
    Stat. 1, 8-11), or over triangles, are exact. Raises InputError where the mesh encloses nothing.
    """
    points = np.asarray(vertices, dtype=np.float64)
    a, b, c = (points[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    part = np.einsum("ij,ij->i", a, normal) / 6 if thickness is None else np.linalg.norm(normal, axis=1) / 2 * thickness
    # The fourth corner of a tetrahedron is the origin: it counts in means, and adds nothing to sums.
    corners, whole = (4, 20) if thickness is None else (3, 12)
    volume, total = float(part.sum()), a + b + c
    if not (math.isfinite(volume) and volume > 0):
        raise InputError("the mesh encloses no volume, so it has no mass: close it, faces outwards")
    center = part @ total / (volume * corners)
    second = np.einsum("n,ni,nj->ij", part, total, total)
    for corner in (a, b, c):
        second = second + np.einsum("n,ni,nj->ij", part, corner, corner)
    second = density * (second / whole - volume * np.outer(center, center))
    return MassProperties(mass=density * volume, center=center, inertia=np.trace(second) * np.eye(3) - second)
