# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job file says of the physics of a scene: read, checked, and put into words."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ...sim.effects.registry import effect
from ...sim.errors import InputError
from ...sim.scene.json_fields import parse
from ...sim.scene.materials import load_preset
from ...sim.scene.model import Effect, Vector


@dataclass(frozen=True, kw_only=True)
class Physics:
    """What happens in a scene.

    presets, velocities (m/s), spins (rad/s): by object, as on the command line; what is not given stays.
    effects: all that the scene has; None: those it has already. overrides: (``OBJECT.FIELD``, value as JSON).
    seed: of the particles' places; None takes that of the bake.
    """

    presets: tuple[str, ...] = ()
    velocities: tuple[Vector, ...] = ()
    spins: tuple[Vector, ...] = ()
    effects: tuple[Effect, ...] | None = None
    overrides: tuple[tuple[str, str], ...] = ()
    seed: int | None = None

    @property
    def settings(self) -> tuple[str, ...]:
        """The overrides as ``--set`` takes them."""
        return tuple(f"{place}={value}" for place, value in self.overrides)

    def with_override(self, place: str, value: str) -> Physics:
        """The same with one override more, or another value of one."""
        kept = dict(self.overrides) | {place: value}
        return Physics(**{**vars(self), "overrides": tuple(kept.items())})


def brief(value: object) -> str:
    """A value in a message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_presets(value: Any, where: str) -> tuple[str, ...]:
    """Names of presets: one for all objects, or a list of one an object."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{where}: expected a preset or a list of one an object, found {brief(value)}")
    for name in names:
        try:
            load_preset(name)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
    return tuple(names)


def read_vectors(value: Any, where: str) -> tuple[Vector, ...]:
    """Vectors: one, of the first object, or a list of one an object."""
    if isinstance(value, list) and value and not any(isinstance(part, list) for part in value):
        value = [value]
    if not isinstance(value, list) or not value:
        raise InputError(f"{where}: expected [x, y, z] or a list of such, found {brief(value)}")
    return tuple(_vector(part, where) for part in value)


def _vector(value: Any, where: str) -> Vector:
    if not isinstance(value, list) or len(value) != 3 or not all(_is_number(number) for number in value):
        raise InputError(f"{where}: expected three finite numbers [x, y, z], found {brief(value)}")
    x, y, z = (float(number) for number in value)
    return x, y, z


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def read_seed(value: Any, where: str) -> int:
    """A seed."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**31:
        raise InputError(f"{where}: expected a whole number from 0 to 2147483647, found {brief(value)}")
    return value


@dataclass(frozen=True, kw_only=True)
class _EffectTable:
    name: str
    parameters: Any = None
    objects: tuple[str, ...] = ()


def read_effects(value: Any, where: str) -> tuple[Effect, ...]:
    """A set of effects: a list of tables as in ``scene.json``; parameters that are left out have their defaults."""
    if not isinstance(value, list):
        raise InputError(f'{where}: expected a list of effects such as {{ name = "wind" }}, found {brief(value)}')
    found = []
    for index, item in enumerate(value):
        here = f"{where}[{index}]"
        table = parse(_EffectTable, item, here)
        given = {} if table.parameters is None else table.parameters
        if not isinstance(given, dict):
            raise InputError(f"{here}.parameters: expected a table of numbers by name, found {brief(given)}")
        try:
            kind = effect(table.name)
            numbers = kind.checked({**kind.defaults, **given})
        except InputError as error:
            raise InputError(f"{here}: {error}") from None
        found.append(Effect(name=table.name, parameters=tuple(sorted(numbers.items())), objects=table.objects))
    return tuple(found)


def flat_overrides(value: Any, where: str) -> dict[str, Any]:
    """Overrides by ``OBJECT.FIELD``, from quoted keys, ``"cup.density" = 300``, or tables, ``cup.density = 300``."""
    if not isinstance(value, dict):
        raise InputError(f'{where}: expected a table such as {{ "cup.density" = 300 }}, found {brief(value)}')
    found: dict[str, Any] = {}
    for key, entry in value.items():
        places = {f"{key}.{field}": part for field, part in entry.items()} if isinstance(entry, dict) else {key: entry}
        for place, part in places.items():
            if "." not in place.strip(".") or "=" in place or isinstance(part, dict):
                raise InputError(f'{where}.{key}: unknown; write OBJECT.FIELD, such as "cup.density", as --set does')
            if place in found:
                raise InputError(f"{where}.{place}: given twice; give it once")
            found[place] = part
    return found


def override_text(value: Any, where: str) -> str:
    """The value of an override as JSON, as ``--set`` takes it."""
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError):
        raise InputError(f"{where}: expected numbers, texts, true or false, found {brief(value)}") from None


READERS = {"presets": read_presets, "velocities": read_vectors, "spins": read_vectors, "effects": read_effects}
FIELDS = (*READERS, "seed", "set")


def read_physics(data: Mapping[str, Any], where: str, base: Physics | None = None) -> Physics:
    """The physics that the fields ``FIELDS`` of ``data`` tell, over ``base``.

    Raises InputError that names the field.
    """
    physics = base or Physics()
    found: dict[str, Any] = {
        name: read(data[name], f"{where}.{name}") for name, read in READERS.items() if name in data
    }
    if "seed" in data:
        found["seed"] = read_seed(data["seed"], f"{where}.seed")
    physics = Physics(**{**vars(physics), **found})
    for place, value in flat_overrides(data.get("set", {}), f"{where}.set").items():
        physics = physics.with_override(place, override_text(value, f"{where}.set.{place}"))
    return physics


def describe(physics: Physics) -> str:
    """The physics in words, on one line."""
    parts = []
    if physics.presets:
        parts.append(", ".join(physics.presets))
    for name, vectors, unit in (("velocity", physics.velocities, "m/s"), ("spin", physics.spins, "rad/s")):
        if vectors:
            parts.append(f"{name} {', '.join(f'({x:g} {y:g} {z:g})' for x, y, z in vectors)} {unit}")
    if physics.effects is not None:
        parts.append(", ".join(effect_words(item) for item in physics.effects) or "no effects")
    parts += [f"{place} = {value}" for place, value in physics.overrides]
    if physics.seed is not None:
        parts.append(f"seed {physics.seed}")
    return " · ".join(parts) or "the scene as it is"


def effect_words(item: Effect) -> str:
    """An effect with what is not at its default."""
    defaults = effect(item.name).defaults
    changed = [f"{name} {value:g}" for name, value in item.parameters if value != defaults[name]]
    on = [f"on {', '.join(item.objects)}"] if item.objects else []
    return item.name + (f" ({', '.join([*changed, *on])})" if changed or on else "")
