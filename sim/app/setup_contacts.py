# SPDX-License-Identifier: MIT
"""How the surfaces of a scene meet, pair by pair, from the numbers of each surface and of named pairs.

Where a pair is not named, friction is the geometric mean of the two coefficients, so that anything slides on ice, and
restitution the larger of the two, so that a ball that bounces well does so on anything: the rules of Box2D
(b2MixFriction and b2MixRestitution, E. Catto, box2d.org). No law of physics gives a pair's numbers from two surfaces.
"""

from __future__ import annotations

import itertools
import math

from ..mpm.contacts import GROUND_NAME, ContactTable, SurfaceContact, friction_from_roughness
from ..scene.model import Contact, Ground, Scene, SceneObject

HOLDS = ("separate", "slip", "sticky")
"""Modes by how much they hold; of two surfaces the stronger one counts."""


def contact_table(scene: Scene) -> ContactTable:
    """The contacts of ``scene``; surfaces without numbers of their own count as made of what the ground is.

    Where there is no ground, as made of what a new scene's ground is.
    """
    usual = scene.ground or Ground()
    ground = SurfaceContact(
        friction=usual.friction, static_friction=usual.static_friction, restitution=usual.restitution
    )
    surfaces = {item.name: surface(item, ground) for item in scene.objects}
    if scene.ground is not None:
        surfaces = {GROUND_NAME: ground, **surfaces}
    named = {frozenset(contact.between): contact for contact in scene.contacts}
    table = ContactTable(default=ground)
    for a, b in itertools.combinations(surfaces, 2):
        contact = named.get(frozenset((a, b)))
        mixed = mix(surfaces[a], surfaces[b])
        if contact is not None:
            table = table.with_pair(a, b, _named(contact, mixed))
        elif surfaces[a] != ground or surfaces[b] != ground:
            table = table.with_pair(a, b, mixed)
    return table


def surface(item: SceneObject, ground: SurfaceContact) -> SurfaceContact:
    """The surface of ``item``: its own numbers, its roughness, or what the ground has."""
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
    """How two surfaces meet that were each judged alone."""
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
