# SPDX-License-Identifier: MIT
"""Registry of effects by name, and application of a scene's effects to a world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from ..errors import InputError
from ..mpm.world_setup import WorldSetup
from ..scene.model import Effect as SceneEffect
from ..validation import to_json
from . import (
    adhesion,
    air_drag,
    anisotropy,
    buoyancy,
    camera_pose,
    friction,
    gravity_tilt,
    inertia,
    internal_damping,
    magnus,
    mass_offset,
    plastic_yield,
    restitution,
    rolling_resistance,
    sandy,
    stiffness,
    stiffness_gradient,
    tether,
    time_scale,
    wind,
)
from .schema import KINDS, Effect, Parameter

__all__ = ["KINDS", "Effect", "Parameter", "apply_effects", "effect", "effect_to_json", "effects"]

_MODULES = (
    air_drag,
    wind,
    magnus,
    buoyancy,
    gravity_tilt,
    tether,
    friction,
    restitution,
    rolling_resistance,
    adhesion,
    stiffness,
    internal_damping,
    plastic_yield,
    anisotropy,
    stiffness_gradient,
    sandy,
    mass_offset,
    inertia,
    time_scale,
    camera_pose,
)
"""In the order of menus and listings."""

_EFFECTS: Mapping[str, Effect] = MappingProxyType({module.EFFECT.name: module.EFFECT for module in _MODULES})


def effects() -> Mapping[str, Effect]:
    """Return all effects by name, in a fixed order: by kind, as in ``KINDS``."""
    return _EFFECTS


def effect(name: str) -> Effect:
    """Return the effect called ``name``; InputError when there is none."""
    if name not in _EFFECTS:
        raise InputError(f"effect {name!r} is unknown: choose one of {', '.join(_EFFECTS)}")
    return _EFFECTS[name]


def apply_effects(setup: WorldSetup, scene_effects: Iterable[SceneEffect]) -> WorldSetup:
    """Return ``setup`` with the effects of a scene applied in their order; ``setup`` itself without any.

    Raises InputError as ``Effect.apply`` does, with the number of the effect in the scene.
    """
    for index, item in enumerate(scene_effects):
        try:
            values = dict(item.parameters)
            if len(values) < len(item.parameters):
                raise InputError(f"effect {item.name!r}: a parameter is given twice: give each once")
            setup = effect(item.name).apply(setup, values, bodies=item.objects or None)
        except InputError as error:
            raise InputError(f"effects[{index}]: {error}") from None
    return setup


def effect_to_json(item: Effect) -> dict[str, Any]:
    """Return a JSON description of the effect: names, kind, parameters, equation."""
    return {
        "name": item.name,
        "kind": item.kind,
        "summary": item.summary,
        "parameters": [to_json(parameter) for parameter in item.parameters],
        "neutral": dict(item.neutral),
        "equation": item.section("Equation"),
        "source": item.section("Source"),
        "bodies": item.section("Bodies"),
        "twice": item.section("Twice"),
        "of_world": item.of_world,
    }
