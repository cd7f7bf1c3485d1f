# SPDX-License-Identifier: MIT
"""Mass, centre and inertia of particles and of filled surfaces. No Taichi. World metres, kilograms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..colliders import Surface
from .triangles import Array, bounding_box, bounding_faces, checked_places, validated


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


def solid_mass_properties(surface: Surface, *, density: float) -> MassProperties:
    """Return the mass properties of a closed surface filled with a material of ``density`` kg/m³, by the divergence
    theorem, exact for the mesh.

    Hollows count as hollows, and parts inside others not again; where parts overlap in part, the overlap counts twice.

    Raises InputError on a density that is not above 0 and a surface that is not closed or has no volume.
    """
    if not (math.isfinite(density) and density > 0):
        raise InputError(f"density is {density!r}: give kg/m³ above 0")
    points, triangles = validated(surface.vertices, surface.faces)
    bounding_box(points[triangles])
    volume, center, second = _moments(points[bounding_faces(points, triangles).triangles])
    if volume < 0:
        raise InputError(
            f"mesh has a volume of {volume:g} m³, its parts lie in each other and are inside out: clean it up (in "
            "Blender: Boolean modifier, Union, Self Intersection)"
        )
    return MassProperties(
        mass=density * volume,
        center=center,
        inertia=density * (np.trace(second) * np.eye(3) - second),
    )


def _moments(corners: Array) -> tuple[float, Array, Array]:
    """Return volume, centre (3,) and second moments (3, 3) about it of the solid inside outward faces (T, 3, 3)."""
    middle = corners.reshape(-1, 3).mean(axis=0)
    local = corners - middle
    six = np.einsum("ti,ti->t", local[:, 0], np.cross(local[:, 1], local[:, 2]))
    volume = float(six.sum() / 6)
    total = local.sum(axis=1)
    first = six @ total / 24
    second = (np.einsum("t,tni,tnj->ij", six, local, local) + np.einsum("t,ti,tj->ij", six, total, total)) / 120
    center = first / volume
    return volume, middle + center, second - volume * np.outer(center, center)
