# SPDX-License-Identifier: MIT
"""A whole world before it runs, and the checks of its start. SI units, immutable. No Taichi."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from ..errors import InputError
from ..scene.units import Similarity
from .bodies import BodyParticles, Vector
from .colliders import Collider, Track
from .solver_options import Ground
from .surface_contact import GROUND_NAME, ContactTable, SurfaceContact

STANDARD_GRAVITY: Vector = (0.0, 0.0, -9.81)


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldSetup:
    """Bodies, ground, colliders, contacts and gravity of a world. Raises InputError on names that occur twice.

    bodies: in the order in which results count them.
    ground: ground plane, or None for free flight.
    gravity: m/s².
    gravity_track: gravity over time, (K, 3) m/s², in place of ``gravity``; None for a steady one.
    colliders: surfaces that bodies hit.
    contacts: contact parameters. The ground's own friction and restitution hold where the table lacks the pair.
    """

    bodies: tuple[BodyParticles, ...]
    ground: Ground | None = None
    gravity: Vector = STANDARD_GRAVITY
    gravity_track: Track | None = None
    colliders: tuple[Collider, ...] = ()
    contacts: ContactTable = field(default_factory=ContactTable)

    def __post_init__(self) -> None:
        if not self.bodies:
            raise InputError("bodies is empty: give at least one body")
        if len(self.gravity) != 3 or not all(math.isfinite(c) for c in self.gravity):
            raise InputError(f"gravity is {self.gravity!r}: give three finite numbers in m/s²")
        if self.gravity_track is not None and self.gravity_track.values.shape[1:] != (3,):
            raise InputError(f"gravity_track has values {self.gravity_track.values.shape}: give (K, 3) in m/s²")
        names = [body.name for body in self.bodies] + [collider.name for collider in self.colliders]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice and (self.colliders or self.contacts.pairs):
            raise InputError(f"name {twice[0]!r} occurs twice: give every body and collider a name of its own")
        unknown = {name for pair in self.contacts.pairs for name in pair} - {*names, GROUND_NAME}
        if unknown:
            raise InputError(f"contacts name {sorted(unknown)[0]!r}: there is no body or collider of that name")

    def contact(self, a: str, b: str) -> SurfaceContact:
        """Contact parameters of the surfaces named ``a`` and ``b``."""
        if GROUND_NAME in (a, b) and (min(a, b), max(a, b)) not in self.contacts.pairs and self.ground is not None:
            return dataclasses.replace(
                self.contacts.default,
                friction=self.ground.friction,
                static_friction=self.ground.static_friction,
                restitution=self.ground.restitution,
            )
        return self.contacts.between(a, b)

    def gravity_at(self, time: float) -> Vector:
        """Gravity in m/s² at ``time`` in s."""
        if self.gravity_track is None:
            return self.gravity
        x, y, z = self.gravity_track.at(time)
        return float(x), float(y), float(z)


DEEPEST_START = 1.0
"""Depth in cells that a body may have in the ground at the start; it is pushed out gently. Deeper is an error."""

FARTHEST_START = 100_000.0
"""Cells from the origin of the box that a body may start at; ``layout.FARTHEST_BLOCK`` sets the limit."""


def check_start(setup: WorldSetup, cells: Similarity) -> None:
    """Raise InputError for a body that starts too far away or too deep in the ground.

    cells: the map from world metres to cells.
    """
    for body in setup.bodies:
        places = cells.points_to_engine(body.positions)
        if float(np.abs(places).max()) > FARTHEST_START:
            raise InputError(
                f"body {body.name!r}: positions reach {float(np.abs(places).max()):.3g} cells from the origin of the "
                f"box, {FARTHEST_START:.3g} are possible: use fit_similarity, or bring the bodies together"
            )
        if setup.ground is not None:
            assert body.contact_radii is not None
            gap = float((setup.ground.heights(body.positions) - body.contact_radii).min())
            if gap < -DEEPEST_START / cells.scale:
                raise InputError(
                    f"body {body.name!r}: positions reach {-gap:g} m below the ground: lift the body by that much"
                )
