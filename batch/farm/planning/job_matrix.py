# SPDX-License-Identifier: GPL-3.0-or-later
"""The physics of a job's scenes, and every combination of a matrix of parameters as a named variant."""

from __future__ import annotations

import itertools
import json
import math
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ....sim.app.reconstruct import Physics
from ....sim.effects.registry import effect
from ....sim.errors import InputError
from ....sim.scene.material import load_preset
from ....sim.scene.model import Effect, Vector
from ....sim.validation import DEVICES, parse


@dataclass(frozen=True, kw_only=True)
class VariantPhysics:
    """The physics of a variant.

    presets, velocities (m/s), spins (rad/s): per object, as on the command line; empty: unchanged.
    effects: all effects of the scene; None: unchanged. overrides: (``OBJECT.FIELD``, value as JSON).
    seed: of the particle positions; None: that of the bake.
    """

    presets: tuple[str, ...] = ()
    velocities: tuple[Vector, ...] = ()
    spins: tuple[Vector, ...] = ()
    effects: tuple[Effect, ...] | None = None
    overrides: tuple[tuple[str, str], ...] = ()
    seed: int | None = None

    @property
    def as_physics(self) -> Physics:
        """Physics of the variant's scene, without effects."""
        return Physics(
            presets=self.presets, velocities=self.velocities, spins=self.spins, overrides=tuple(self.settings)
        )

    @property
    def settings(self) -> tuple[str, ...]:
        """The overrides in the form of ``--set``."""
        return tuple(f"{place}={value}" for place, value in self.overrides)

    def with_override(self, place: str, value: str) -> VariantPhysics:
        """Return a copy with one override added or replaced."""
        kept = dict(self.overrides) | {place: value}
        return VariantPhysics(**{**vars(self), "overrides": tuple(kept.items())})


def brief(value: object) -> str:
    """Return a shortened ``repr`` for messages."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_presets(value: Any, where: str) -> tuple[str, ...]:
    """Return preset names: one for all objects, or a list with one per object."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"{where}: expected a preset or a list with one per object, found {brief(value)}")
    for name in names:
        try:
            load_preset(name)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
    return tuple(names)


def read_vectors(value: Any, where: str) -> tuple[Vector, ...]:
    """Return vectors: a single one for the first object, or a list with one per object."""
    if isinstance(value, list) and value and not any(isinstance(part, list) for part in value):
        value = [value]
    if not isinstance(value, list) or not value:
        raise InputError(f"{where}: expected [x, y, z] or a list of vectors, found {brief(value)}")
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
    """Return the seed ``value``. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**31:
        raise InputError(f"{where}: expected a whole number from 0 to 2147483647, found {brief(value)}")
    return value


@dataclass(frozen=True, kw_only=True)
class _EffectTable:
    name: str
    parameters: Any = None
    objects: tuple[str, ...] = ()


def read_effects(value: Any, where: str) -> tuple[Effect, ...]:
    """Return effects from a list of tables as in ``scene.json``; omitted parameters get their defaults."""
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
    """Return overrides by ``OBJECT.FIELD``, from quoted keys, ``"cup.density" = 300``, or ``cup.density = 300``."""
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
    """Return the value of an override as JSON, in the form of ``--set``."""
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError):
        raise InputError(f"{where}: expected numbers, strings, true or false, found {brief(value)}") from None


READERS = {"presets": read_presets, "velocities": read_vectors, "spins": read_vectors, "effects": read_effects}
FIELDS = (*READERS, "seed", "set")


def read_physics(data: Mapping[str, Any], where: str, base: VariantPhysics | None = None) -> VariantPhysics:
    """Return the physics in the fields ``FIELDS`` of ``data``, over ``base``. Raises InputError naming the field."""
    physics = base or VariantPhysics()
    found: dict[str, Any] = {
        name: read(data[name], f"{where}.{name}") for name, read in READERS.items() if name in data
    }
    if "seed" in data:
        found["seed"] = read_seed(data["seed"], f"{where}.seed")
    physics = VariantPhysics(**{**vars(physics), **found})
    for place, value in flat_overrides(data.get("set", {}), f"{where}.set").items():
        physics = physics.with_override(place, override_text(value, f"{where}.set.{place}"))
    return physics


def describe(physics: VariantPhysics) -> str:
    """Return a one-line description of the physics."""
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
    return " · ".join(parts) or "unchanged"


def effect_words(item: Effect) -> str:
    """Return an effect's name with its non-default parameters."""
    defaults = effect(item.name).defaults
    changed = [f"{name} {value:g}" for name, value in item.parameters if value != defaults[name]]
    on = [f"on {', '.join(item.objects)}"] if item.objects else []
    return item.name + (f" ({', '.join([*changed, *on])})" if changed or on else "")


MOST_VARIANTS = 10_000
"""Per scene."""

LONGEST_NAME = 64
PLAIN = "base"
"""Name of the only variant of a scene without variants."""

RESERVED = frozenset({"scene", "summary"})
"""Names of other entries in a scene's results folder."""

_LETTERS = {"velocities": "v", "spins": "w"}


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One simulation of a scene. name: unique in the scene, valid as a folder name."""

    name: str
    physics: VariantPhysics


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """One value of an axis. token: its part of the variant's name."""

    token: str
    change: Mapping[str, Any]
    override: tuple[str, str] | None = None

    def applied(self, physics: VariantPhysics) -> VariantPhysics:
        changed = VariantPhysics(**{**vars(physics), **self.change})
        return changed if self.override is None else changed.with_override(*self.override)


def read_variants(
    base: VariantPhysics, matrices: Sequence[tuple[Any, str]], picked: Any, where: str
) -> tuple[Variant, ...]:
    """Return all variants of a scene: every combination of the axes, then the hand-picked ones.

    matrices: tables with their location for messages; an axis of a later one replaces that of an earlier one. Raises
    InputError for unknown fields, wrong types, empty lists, duplicate values or names, and too many variants.
    """
    axes: dict[str, list[_Choice]] = {}
    for table, place in matrices:
        axes |= _axes(table, place)
    found = [] if picked is not None and not axes else _combinations(base, axes, where)
    found += _picked(base, picked, f"{where}.variants")
    if len(found) > MOST_VARIANTS:
        raise InputError(f"{where}: has {len(found)} variants: give lists that make at most {MOST_VARIANTS}")
    names: set[str] = set()
    for variant in found:
        if variant.name.casefold() in names:
            raise InputError(
                f"{where}: two variants are called {variant.name!r}; give the one in variants another name"
            )
        names.add(variant.name.casefold())
    return tuple(found)


def require_name(name: Any, where: str) -> str:
    """Return ``name`` if it is valid as a folder name on every system and in ids. Raises InputError otherwise."""
    good = (
        isinstance(name, str)
        and 0 < len(name) <= LONGEST_NAME
        and name == unicodedata.normalize("NFC", name)
        and all(c.isalnum() or c in "_-" for c in name)
        and name[0] != "-"
        and len(name.encode("utf-8", "surrogatepass")) <= 2 * LONGEST_NAME
        and name.casefold() not in DEVICES | RESERVED
    )
    if not good:
        raise InputError(
            f"{where}: is {brief(name)}: give a name of letters, digits, - and _, at most {LONGEST_NAME} of them"
        )
    return str(name)


def _axes(table: Any, where: str) -> dict[str, list[_Choice]]:
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table of lists, found {brief(table)}")
    known = {name: values for name, values in table.items() if name in (*READERS, "seeds")}
    overrides = flat_overrides({k: v for k, v in table.items() if k not in known}, where)
    return {name: _choices(name, values, f"{where}.{name}") for name, values in (known | overrides).items()}


def _choices(name: str, values: Any, where: str) -> list[_Choice]:
    if not isinstance(values, list) or not values:
        raise InputError(f"{where}: expected a list with at least one value, found {brief(values)}")
    if len(values) > MOST_VARIANTS:
        raise InputError(f"{where}: has {len(values)} values: give at most {MOST_VARIANTS}")
    choices = [_choice(name, value, f"{where}[{index}]", index) for index, value in enumerate(values)]
    for index, choice in enumerate(choices):
        if choice in choices[:index] or any(_same(choice, other) for other in choices[:index]):
            raise InputError(f"{where}[{index}]: {brief(values[index])} is given twice; give every value once")
    tokens = {choice.token.casefold() for choice in choices}
    if len(tokens) < len(choices) or any(len(token) > 24 for token in tokens):
        letter = _token(name.rpartition(".")[2])[:8]
        choices = [
            _Choice(token=f"{letter}{index}", change=choice.change, override=choice.override)
            for index, choice in enumerate(choices, start=1)
        ]
    return choices


def _same(a: _Choice, b: _Choice) -> bool:
    return (a.change, a.override) == (b.change, b.override)


def _choice(name: str, value: Any, where: str, index: int) -> _Choice:
    if name == "seeds":
        seed = read_seed(value, where)
        return _Choice(token=f"s{seed}", change={"seed": seed})
    if name not in READERS:
        text = override_text(value, where)
        short = text.strip('"') if isinstance(value, str | int | float) else str(index + 1)
        return _Choice(token=_token(name.rpartition(".")[2] + short), change={}, override=(name, text))
    if name == "presets":
        presets = read_presets(value, where)
        return _Choice(token=_token("_".join(presets)), change={name: presets})
    if name == "effects":
        found = read_effects(value, where)
        return _Choice(token=_token("_".join(item.name for item in found)) or "plain", change={name: found})
    return _Choice(token=f"{_LETTERS[name]}{index + 1}", change={name: read_vectors(value, where)})


def _token(text: str) -> str:
    """Return ``text`` as a part of a name: ``density300``, ``friction0_1``, ``x_m5``; parts are joined by hyphens."""
    return "".join(c if c.isascii() and (c.isalnum() or c == "_") else "m" if c == "-" else "_" for c in text)


_ORDER = ("presets", "velocities", "spins", "effects")


def _combinations(base: VariantPhysics, axes: Mapping[str, list[_Choice]], where: str) -> list[Variant]:
    count = math.prod(len(choices) for choices in axes.values())
    if count > MOST_VARIANTS:
        sizes = " x ".join(f"{len(choices)} {name}" for name, choices in axes.items())
        raise InputError(f"{where}: {sizes} are {count} variants: give lists that make at most {MOST_VARIANTS}")
    names = [*(n for n in _ORDER if n in axes), *(n for n in axes if n not in (*_ORDER, "seeds"))]
    names += ["seeds"] if "seeds" in axes else []
    found = []
    for number, choices in enumerate(itertools.product(*(axes[name] for name in names)), start=1):
        physics = base
        for choice in choices:
            physics = choice.applied(physics)
        tokens = [choice.token for name, choice in zip(names, choices, strict=True) if len(axes[name]) > 1]
        name = "-".join(tokens) or PLAIN
        found.append(Variant(name=name if _fits(name) else f"variant{number}", physics=physics))
    return found


def _fits(name: str) -> bool:
    return len(name) <= LONGEST_NAME and name.casefold() not in DEVICES | RESERVED


def _picked(base: VariantPhysics, tables: Any, where: str) -> list[Variant]:
    if tables is None:
        return []
    if not isinstance(tables, list) or not tables:
        raise InputError(f"{where}: expected at least one table, found {brief(tables)}")
    found = []
    for index, table in enumerate(tables):
        here = f"{where}[{index}]"
        if not isinstance(table, dict):
            raise InputError(f"{here}: expected a table with a name, found {brief(table)}")
        unknown = sorted(set(table) - {"name", *FIELDS})
        if unknown:
            raise InputError(f"{here}.{unknown[0]}: unknown field; known are name, {', '.join(FIELDS)}")
        name = require_name(table.get("name"), f"{here}.name")
        found.append(Variant(name=name, physics=read_physics(table, here, base)))
    return found
