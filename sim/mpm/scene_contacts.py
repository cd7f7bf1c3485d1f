# SPDX-License-Identifier: MIT
"""How the surfaces of a scene meet, pair by pair, from the numbers of each surface and of named pairs.

Where a pair is not named, friction is the geometric mean of the two coefficients, so that anything slides on ice, and
restitution the larger of the two, so that a ball that bounces well does so on anything: the rules of Box2D
(b2MixFriction and b2MixRestitution, E. Catto, box2d.org). No law of physics gives a pair's numbers from two surfaces.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from types import MappingProxyType

from ..scene.model import Contact, Ground, SceneModel, SceneObject
from .surface_contact import GROUND_NAME, ContactTable, SurfaceContact, friction_from_roughness

HOLDS = ("separate", "slip", "sticky")
"""Modes by how much they hold; of two surfaces the stronger one counts."""


def contact_table(scene: SceneModel) -> ContactTable:
    """Return the contacts of ``scene``; surfaces without numbers of their own count as made of what the ground is.

    Where there is no ground, as made of what a new scene's ground is. Where neither ground nor object says how it
    bounces, a rigid object has its material's restitution against the ground, colliders and, the smaller of the two,
    other rigid objects.
    """
    usual = scene.ground or Ground()
    ground = SurfaceContact(
        friction=usual.friction, static_friction=usual.static_friction, restitution=usual.restitution
    )
    surfaces = {item.name: surface(item, ground) for item in scene.objects}
    if scene.ground is not None:
        surfaces = {GROUND_NAME: ground, **surfaces}
    named = {frozenset(contact.between): contact for contact in scene.contacts}
    bounces = {GROUND_NAME: math.inf} | {item.name: _bounce(item, ground) for item in scene.objects}
    pairs: dict[tuple[str, str], SurfaceContact] = {}
    for a, b in itertools.combinations(surfaces, 2):
        contact = named.get(frozenset((a, b)))
        mixed = mix(surfaces[a], surfaces[b])
        if 0.0 < min(bounces[a], bounces[b]) < math.inf:
            mixed = dataclasses.replace(mixed, restitution=max(mixed.restitution, min(bounces[a], bounces[b])))
        if contact is not None:
            pairs[min(a, b), max(a, b)] = _named(contact, mixed)
        elif mixed != ground:
            pairs[min(a, b), max(a, b)] = mixed
    return ContactTable(default=ground, pairs=MappingProxyType(pairs))


def _bounce(item: SceneObject, ground: SurfaceContact) -> float:
    """Restitution of the object's material where nothing else says one: 0 is none, infinite that the other's counts."""
    if item.role == "collider":
        return math.inf
    given = item.restitution is not None or ground.restitution > 0
    return 0.0 if given or item.material.law != "rigid" else item.material.rigid_restitution


def surface(item: SceneObject, ground: SurfaceContact) -> SurfaceContact:
    """Return the surface of ``item``: its own numbers, its roughness, or what the ground has."""
    friction, static = item.friction, item.static_friction
    if friction is None and item.roughness is not None:
        friction = friction_from_roughness(item.roughness)
    if friction is None:
        friction, static = ground.friction, ground.static_friction
    return SurfaceContact(
        friction=friction,
        static_friction=static,
        restitution=ground.restitution if item.restitution is None else item.restitution,
        mode=item.contact_mode or ground.mode,
    )


def mix(a: SurfaceContact, b: SurfaceContact) -> SurfaceContact:
    """Return the contact of two surfaces that were each judged alone."""
    static = None
    friction = math.sqrt(a.friction * b.friction)
    if a.static_friction is not None or b.static_friction is not None:
        static = max(friction, math.sqrt(a.sticking * b.sticking))
    return SurfaceContact(
        friction=friction,
        static_friction=static,
        restitution=max(a.restitution, b.restitution),
        mode=max(a.mode, b.mode, key=HOLDS.index),
    )


def _named(contact: Contact, mixed: SurfaceContact) -> SurfaceContact:
    friction, static = contact.friction, contact.static_friction
    if friction is None:
        friction, static = mixed.friction, mixed.static_friction
    return SurfaceContact(
        friction=friction,
        static_friction=static,
        restitution=mixed.restitution if contact.restitution is None else contact.restitution,
        mode=contact.mode or mixed.mode,
        rolling_resistance=contact.rolling_resistance,
        adhesion=contact.adhesion,
        adhesion_reach=contact.adhesion_reach,
    )
