# SPDX-License-Identifier: MIT
"""Which cases a check is made of: shares that are kept for any number of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...effects.registry import effect
from ...errors import InputError
from ..diagnosis import UNKNOWN
from . import rigid_causes, soft_causes

LEAST_CASES = 4
MOST_CASES = 1000
NONE_SHARE, UNKNOWN_SHARE, TWO_SHARE, SOFT_SHARE = 1 / 5, 1 / 7, 1 / 10, 1 / 4

_SAME_TRACE = ({"air_drag", "wind"}, {"buoyancy", "time_scale"}, {"restitution", "adhesion"})
"""Pairs that no recording of one body tells apart: as two causes at once they would be one."""


@dataclass(frozen=True, kw_only=True)
class PlannedCase:
    """matter: ``rigid`` or ``soft``. effects: () for none; ``unknown`` for one outside the vocabulary."""

    matter: str
    effects: tuple[str, ...]


def plan_cases(count: int, rng: np.random.Generator) -> tuple[PlannedCase, ...]:
    """``count`` cases in an order drawn at random.

    At least a fifth ``none``, a seventh ``unknown`` and a tenth, but one, of two causes; about a quarter soft; what is
    left goes round all effects. Raises InputError for fewer than ``LEAST_CASES`` or more than ``MOST_CASES``.
    """
    if not LEAST_CASES <= count <= MOST_CASES:
        raise InputError(f"cases is {count}: give {LEAST_CASES} to {MOST_CASES}, so that every kind of case is there")
    none, unknown = math.ceil(count * NONE_SHARE), math.ceil(count * UNKNOWN_SHARE)
    two = max(1, math.floor(count * TWO_SHARE))
    single = count - none - unknown - two
    soft = round(count * SOFT_SHARE)
    # Soft bodies take their share of each kind; two causes at once are rigid.
    soft_none, soft_unknown = round(none * SOFT_SHARE), round(unknown * SOFT_SHARE)
    soft_single = min(max(soft - soft_none - soft_unknown, 0), single)
    cases = [_case("soft" if i < soft_none else "rigid") for i in range(none)]
    cases += [_case("soft" if i < soft_unknown else "rigid", UNKNOWN) for i in range(unknown)]
    cases += [_case("rigid", *_pair(rng)) for _ in range(two)]
    cases += [_case("soft", e) for e in _round(list(soft_causes.KNOWN), soft_single, rng)]
    cases += [_case("rigid", e) for e in _round(list(rigid_causes.KNOWN), single - soft_single, rng)]
    return tuple(cases[i] for i in rng.permutation(count))


def _case(matter: str, *effects: str) -> PlannedCase:
    return PlannedCase(matter=matter, effects=effects)


def _round(names: list[str], count: int, rng: np.random.Generator) -> list[str]:
    """``count`` of ``names``, each as often as the others but one, which ones at random."""
    out: list[str] = []
    while len(out) < count:
        out += [names[i] for i in rng.permutation(len(names))]
    return out[:count]


def _pair(rng: np.random.Generator) -> tuple[str, str]:
    names = [n for n in rigid_causes.KNOWN if n != "camera_pose"]
    while True:
        first, second = (names[i] for i in rng.permutation(len(names))[:2])
        if effect(first).kind != effect(second).kind and {first, second} not in _SAME_TRACE:
            return first, second
