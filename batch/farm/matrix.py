# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists of parameters → variants: every combination once, with a short name that says what it is."""

from __future__ import annotations

import itertools
import math
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ...sim.errors import InputError
from ...sim.scene.names import DEVICES
from .physics import (
    FIELDS,
    READERS,
    Physics,
    brief,
    flat_overrides,
    override_text,
    read_effects,
    read_physics,
    read_presets,
    read_seed,
    read_vectors,
)

MOST_VARIANTS = 10_000
"""Of a scene."""

LONGEST_NAME = 64
PLAIN = "base"
"""The only variant of a scene that names none."""

RESERVED = frozenset({"scene", "summary"})
"""Names beside the variants in a scene's folder of results."""

_LETTERS = {"velocities": "v", "spins": "w"}


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One simulation of a scene. name: unique in the scene, fit for a folder."""

    name: str
    physics: Physics


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """One value of an axis. token: its part of the name."""

    token: str
    change: Mapping[str, Any]
    override: tuple[str, str] | None = None

    def applied(self, physics: Physics) -> Physics:
        changed = Physics(**{**vars(physics), **self.change})
        return changed if self.override is None else changed.with_override(*self.override)


def read_variants(base: Physics, matrices: Sequence[tuple[Any, str]], picked: Any, where: str) -> tuple[Variant, ...]:
    """All variants of a scene: every combination of the axes, then those ``picked`` by hand.

    matrices: tables with where they stand; an axis of a later one replaces that of an earlier one. Raises InputError
    for unknown fields, wrong types, empty lists, values and names that occur twice, and too many variants.
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
    """``name`` if it can be a folder's on every system and in every id; InputError otherwise."""
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
            raise InputError(f"{where}[{index}]: {brief(values[index])} is there twice; give every value once")
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
    """``text`` as a part of a name: ``density300``, ``friction0_1``, ``x_m5``; a hyphen parts one from the next."""
    return "".join(c if c.isascii() and (c.isalnum() or c == "_") else "m" if c == "-" else "_" for c in text)


_ORDER = ("presets", "velocities", "spins", "effects")


def _combinations(base: Physics, axes: Mapping[str, list[_Choice]], where: str) -> list[Variant]:
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


def _picked(base: Physics, tables: Any, where: str) -> list[Variant]:
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
