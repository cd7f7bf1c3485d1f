# SPDX-License-Identifier: MIT
"""Definition of an effect: its parameters, the bodies it applies to, and its change to a world's setup."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ..errors import InputError
from ..mpm.bodies import BodyParticles
from ..mpm.world_setup import WorldSetup

KINDS = ("force", "contact", "material", "mass", "observation")
SECTIONS = ("Equation", "Source", "Bodies", "Twice")
"""Sections of the docstring of every effect's module after its first line; see ``Effect.section``."""

Values = Mapping[str, float]
Targets = tuple[int, ...]
"""Indices in ``WorldSetup.bodies``, rising."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number of an effect.

    unit: SI; "1" for a number without unit.
    low, high: what is accepted, both included.
    default: start value, clearly visible on an object that fits in a hand.
    whole: only whole numbers count.
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    description: str
    whole: bool = False

    def check(self, value: object) -> float:
        """``value`` as a float; InputError when it is no number, not finite or out of range."""
        number = isinstance(value, int | float) and not isinstance(value, bool)
        good = number and math.isfinite(value) and self.low <= value <= self.high  # type: ignore[arg-type,operator]
        if not good or (self.whole and value != round(value)):  # type: ignore[arg-type,call-overload]
            unit = "" if self.unit == "1" else f" {self.unit}"
            what = "a whole number from " if self.whole else ""
            raise InputError(f"{self.name} is {value!r}: give {what}{self.low:g} to {self.high:g}{unit}")
        return float(value)  # type: ignore[arg-type]


def vector_parameters(
    prefix: str, unit: str, reach: float, default: tuple[float, float, float], description: str
) -> tuple[Parameter, ...]:
    """Three parameters ``prefix_x``, ``prefix_y``, ``prefix_z`` from -reach to reach."""
    return tuple(
        Parameter(name=f"{prefix}_{axis}", unit=unit, low=-reach, high=reach, default=number, description=description)
        for axis, number in zip("xyz", default, strict=True)
    )


def vector(values: Values, prefix: str) -> tuple[float, float, float]:
    """Return the three numbers that ``vector_parameters`` declared."""
    return values[f"{prefix}_x"], values[f"{prefix}_y"], values[f"{prefix}_z"]


def unit_vector(values: Values, prefix: str) -> tuple[float, float, float]:
    """Return them scaled to length 1; InputError when they are all zero."""
    x, y, z = vector(values, prefix)
    length = math.hypot(x, y, z)
    if length < 1e-9:
        raise InputError(f"{prefix} is {(x, y, z)!r}: give a direction, not three zeros")
    return x / length, y / length, z / length


def nothing_against(body: BodyParticles) -> str | None:
    """Return None: the obstacle of effects that apply to every body."""
    return None


@dataclass(frozen=True, kw_only=True)
class Effect:
    """A physical effect: added to a scene by a user, applied to a world by ``apply``, proposed by the diagnosis.

    kind: one of ``KINDS``. Kind "observation" concerns camera and clock only: the world is unchanged.
    description: the docstring of the effect's module, with the ``SECTIONS``.
    transform: the change itself, a pure function of the setup, all parameters and the bodies concerned.
    neutral: parameters that alone make the effect do nothing; empty where none do.
    current: for effects that put a value in place of another: the value that the setup has now.
    obstacle: why the effect does not apply to a body, with the remedy; None where it applies.
    of_world: the effect concerns the whole world, so that no bodies can be named.
    """

    name: str
    kind: str
    parameters: tuple[Parameter, ...]
    description: str
    transform: Callable[[WorldSetup, Values, Targets], WorldSetup]
    neutral: Values = field(default_factory=lambda: MappingProxyType({}))
    current: Callable[[WorldSetup, Targets], Values] | None = None
    obstacle: Callable[[BodyParticles], str | None] = nothing_against
    of_world: bool = False

    def apply(self, setup: WorldSetup, values: Values, *, bodies: Collection[str] | None = None) -> WorldSetup:
        """Return ``setup`` with the effect applied; ``setup`` itself is not changed, and returned if nothing changes.

        values: every parameter; ``defaults`` has start values.
        bodies: names of the bodies concerned; None for all that the effect applies to.

        Raises InputError, with the effect's name, for parameters that are missing, unknown or out of range, for bodies
        that do not exist or that the effect does not apply to, and where it applies to no body.
        """
        try:
            complete = self.checked(values)
            targets = self.targets(setup, bodies)
            if self.neutral and all(complete[name] == value for name, value in self.neutral.items()):
                return setup
            return self.transform(setup, complete, targets)
        except InputError as error:
            raise InputError(f"effect {self.name!r}: {error}") from None

    def checked(self, values: Values) -> dict[str, float]:
        """Return all parameters as floats, in the order of the schema; InputError as ``apply`` says."""
        known = {parameter.name for parameter in self.parameters}
        for name in values:
            if name not in known:
                raise InputError(f"parameter {name!r} is unknown: its parameters are {', '.join(self.defaults)}")
        for parameter in self.parameters:
            if parameter.name not in values:
                raise InputError(f"parameter {parameter.name!r} is missing: give it, {parameter.default:g} is usual")
        return {parameter.name: parameter.check(values[parameter.name]) for parameter in self.parameters}

    def targets(self, setup: WorldSetup, bodies: Collection[str] | None) -> Targets:
        """Return the indices of the bodies concerned; InputError as ``apply`` says."""
        if self.of_world:
            if bodies is not None:
                raise InputError(f"bodies is {sorted(bodies)!r}: it concerns the whole world, name no bodies")
            return tuple(range(len(setup.bodies)))
        if bodies is not None:
            unknown = sorted(set(bodies) - {body.name for body in setup.bodies})
            if unknown or not bodies:
                names = ", ".join(repr(body.name) for body in setup.bodies)
                found = f"body {unknown[0]!r} is not a moving body" if unknown else "bodies is empty"
                raise InputError(f"{found}: name some of {names}, or none for all")
        found_for: list[int] = []
        obstacles: list[str] = []
        for index, body in enumerate(setup.bodies):
            if bodies is not None and body.name not in bodies:
                continue
            obstacle = self.obstacle(body)
            if obstacle is None:
                found_for.append(index)
                continue
            obstacles.append(f"body {body.name!r} {obstacle}")
            if bodies is not None:
                raise InputError(obstacles[-1])
        if not found_for:
            raise InputError(f"there is no body that it applies to: {obstacles[0]}")
        return tuple(found_for)

    @property
    def defaults(self) -> dict[str, float]:
        """Default values by parameter."""
        return {parameter.name: parameter.default for parameter in self.parameters}

    def neutral_values(self, setup: WorldSetup, *, bodies: Collection[str] | None = None) -> dict[str, float] | None:
        """Return all parameters with values that change nothing in ``setup``, the rest at defaults; None if none do.

        Where an effect sets a value that several bodies have differently, the first body's counts.
        """
        if self.current is not None:
            return {**self.defaults, **self.current(setup, self.targets(setup, bodies))}
        return {**self.defaults, **self.neutral} if self.neutral else None

    @property
    def summary(self) -> str:
        """One sentence: what it is."""
        return self.description.strip().split("\n\n")[0].replace("\n", " ")

    def section(self, title: str) -> str:
        """Text of the docstring's section ``title``, one of ``SECTIONS``, on one line; empty if there is none."""
        found = re.search(rf"^{title}: (.*?)(?=\n\n|\n(?:{'|'.join(SECTIONS)}): |\Z)", self.description, re.S | re.M)
        return " ".join(found[1].split()) if found else ""


def leave(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    """Return ``setup`` unchanged: the transformation of effects of kind "observation"."""
    return setup
