# SPDX-License-Identifier: MIT
"""Changes to a world's setup that several effects share: bodies, forces, materials, contacts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import MappingProxyType

import numpy as np

from ..constitutive import COHERENT, GRANULAR, SHAPED, DeformableMaterial, RigidMaterial, models
from ..errors import InputError
from ..mpm.bodies import BodyForces, BodyParticles
from ..mpm.colliders import Track
from ..mpm.solver_options import Ground
from ..mpm.surface_contact import GROUND_NAME, ContactTable, SurfaceContact
from ..mpm.world_setup import WorldSetup
from .schema import Targets

SHAPED_SOLIDS = frozenset({SHAPED})
"""Cohesion of solids that have a shape to return to."""

COHERENT_SOLIDS = SHAPED_SOLIDS | {COHERENT}
"""Cohesion of solids that hold together."""

SOLIDS = COHERENT_SOLIDS | {GRANULAR}
"""Cohesion of materials with a Young's modulus."""


def change_bodies(setup: WorldSetup, targets: Targets, change: Callable[[BodyParticles], BodyParticles]) -> WorldSetup:
    """Return ``setup`` with ``change`` made to the bodies at ``targets``."""
    chosen = set(targets)
    bodies = tuple(change(body) if i in chosen else body for i, body in enumerate(setup.bodies))
    return dataclasses.replace(setup, bodies=bodies)


def change_forces(setup: WorldSetup, targets: Targets, change: Callable[[BodyForces], BodyForces]) -> WorldSetup:
    """Return ``setup`` with ``change`` made to the forces on the bodies at ``targets``."""

    def changed(body: BodyParticles) -> BodyParticles:
        try:
            return dataclasses.replace(body, forces=change(body.forces))
        except InputError as error:
            raise InputError(f"body {body.name!r}: {error}") from None

    return change_bodies(setup, targets, changed)


def solids(body: BodyParticles, cohesions: frozenset[str]) -> list[DeformableMaterial]:
    """Return the body's materials whose cohesion is one of ``cohesions``."""
    every = (body.material, *body.materials)
    return [m for m in every if isinstance(m, DeformableMaterial) and m.cohesion in cohesions]


def needs(cohesions: frozenset[str], because: str) -> Callable[[BodyParticles], str | None]:
    """Return the obstacle of effects that apply to materials of one of ``cohesions``; ``because`` says why."""

    def obstacle(body: BodyParticles) -> str | None:
        if solids(body, cohesions):
            return None
        law = "rigid" if isinstance(body.material, RigidMaterial) else f"of {body.material.law}"
        wanted = ", ".join(model.law for model in models() if model.cohesion in cohesions)
        return f"is {law}, {because}: give it a material of {wanted}, or leave it out"

    return obstacle


def rigid_only(because: str) -> Callable[[BodyParticles], str | None]:
    """Return the obstacle of effects that apply to rigid bodies; ``because`` says why, with the remedy."""
    return lambda body: None if body.rigid else f"deforms, {because}"


def change_materials(
    setup: WorldSetup,
    targets: Targets,
    cohesions: frozenset[str],
    change: Callable[[DeformableMaterial], DeformableMaterial],
) -> WorldSetup:
    """Return ``setup`` with ``change`` made to the materials of one of ``cohesions`` of the bodies at ``targets``."""

    def changed(body: BodyParticles) -> BodyParticles:
        material, tracks = body.material, dict(body.parameter_tracks)
        if isinstance(material, DeformableMaterial) and material.cohesion in cohesions:
            for name, track in body.parameter_tracks.items():
                values = [getattr(change(body.material_at(float(time))), name) for time in track.times]
                tracks[name] = Track(times=track.times, values=np.array(values))
            material = change(material)
        rest = tuple(change(m) if m.cohesion in cohesions else m for m in body.materials)
        return dataclasses.replace(body, material=material, materials=rest, parameter_tracks=tracks)

    return change_bodies(setup, targets, changed)


def change_contacts(
    setup: WorldSetup, targets: Targets, change: Callable[[SurfaceContact], SurfaceContact]
) -> WorldSetup:
    """Return ``setup`` with ``change`` made to every contact of the bodies at ``targets``.

    Where that is all bodies, the ground's and the table's own numbers change, so that the table stays small.
    """
    table = setup.contacts
    if len(targets) == len(setup.bodies):
        ground, default = setup.ground, change(table.default)
        if ground is not None:
            # The ground keeps friction and restitution itself; the rest of its contact is the table's default.
            after = change(_with_rubbing(table.default, ground))
            ground = dataclasses.replace(
                ground,
                friction=after.friction,
                static_friction=after.static_friction,
                restitution=after.restitution,
            )
            if len(setup.bodies) == 1 and not setup.colliders:
                default = _with_rubbing(default, table.default)
        pairs = {pair: change(contact) for pair, contact in table.pairs.items()}
        return dataclasses.replace(setup, ground=ground, contacts=ContactTable(default=default, pairs=_frozen(pairs)))
    others = [GROUND_NAME] if setup.ground is not None else []
    others += [collider.name for collider in setup.colliders] + [body.name for body in setup.bodies]
    changed: dict[tuple[str, str], SurfaceContact] = {}
    for name in (setup.bodies[i].name for i in targets):
        for other in others:
            if other != name:
                changed[min(name, other), max(name, other)] = change(setup.contact(name, other))
    return dataclasses.replace(
        setup, contacts=ContactTable(default=table.default, pairs=_frozen({**table.pairs, **changed}))
    )


def _with_rubbing(contact: SurfaceContact, other: SurfaceContact | Ground) -> SurfaceContact:
    """Return ``contact`` with friction and restitution of ``other``."""
    return dataclasses.replace(
        contact, friction=other.friction, static_friction=other.static_friction, restitution=other.restitution
    )


def _frozen(pairs: dict[tuple[str, str], SurfaceContact]) -> MappingProxyType[tuple[str, str], SurfaceContact]:
    return MappingProxyType(pairs)


def contact_with_ground(setup: WorldSetup, targets: Targets) -> SurfaceContact:
    """Return the contact of the first body at ``targets`` with the ground, or the table's default without one."""
    return setup.contacts.default if setup.ground is None else setup.contact(setup.bodies[targets[0]].name, GROUND_NAME)
