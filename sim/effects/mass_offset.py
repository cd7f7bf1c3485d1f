# SPDX-License-Identifier: MIT
"""The centre of mass is not where uniform density puts it: a pellet sits in the body.

Equation: m_i' = (1 - f) m_i + f M w_i with weights w_i >= 0, sum w_i = 1, sum w_i x_i = c + d: the mass M stays, the
    centre of mass c moves by f d exactly. The weights are m_i exp(-|x_i - c - d|² / 2 h² + b (x_i - c - d)), b
    solved for, and h half the particle spacing, or more where the pellet would be over 30 times as dense as the body:
    that has a pellet's inertia (a tilt of all the body's density would have none) and a size that soft bodies carry.
Source: local maximum-entropy weights, Arroyo and Ortiz, Int. J. Numer. Methods Eng. 65 (2006).
Bodies: all.
Twice: pellets follow each other, each placed from the centre of mass that the body has then.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..mpm.bodies import BodyParticles
from ..mpm.world_setup import WorldSetup
from .schema import Effect, Parameter, Targets, Values, vector, vector_parameters
from .setup_changes import change_bodies

TOLERANCE = 1e-12
"""Largest error of the pellet's centre, in its own widths."""

DENSEST = 30.0
"""Density in the middle of the pellet over the body's, where particles are fine enough to resolve that."""

STEPS = 60


def pellet_width(body: BodyParticles, fraction: float) -> float:
    """Return the standard deviation in metres, along each axis, of a pellet with ``fraction`` of the body's mass."""
    fine = float(np.cbrt(fraction * body.volumes.sum() / DENSEST)) / math.sqrt(2 * math.pi)
    return max(0.5 * float(np.cbrt(body.volumes.mean())), fine)


def pellet_weights(body: BodyParticles, place: NDArray[np.float64], width: float) -> NDArray[np.float64] | None:
    """Return the weights (N,) of a blob of ``width`` m whose centre is ``place`` (3,); None outside the particles.

    Newton's method on the dual: ln sum m exp(-r²/2 + b r) is convex in b, and its gradient is the blob's centre.
    """
    r = (body.positions - place) / width
    base = np.log(body.masses) - 0.5 * np.einsum("ni,ni->n", r, r)
    b = np.zeros(3)

    def potential(b: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        exponent = base + r @ b
        top = float(exponent.max())
        weights = np.exp(exponent - top)
        total = float(weights.sum())
        return top + float(np.log(total)), weights / total

    value, weights = potential(b)
    for _ in range(STEPS):
        center = weights @ r
        if float(np.abs(center).max()) < TOLERANCE:
            return weights
        spread = (r - center).T @ (weights[:, None] * (r - center))
        step = -np.linalg.lstsq(spread + 1e-14 * np.eye(3), center, rcond=None)[0]
        slope, length = float(center @ step), 1.0
        new_value, new_weights = potential(b + step)
        while new_value > value + 1e-4 * length * slope + 1e-13 * abs(value) and length > 1e-6:
            length *= 0.5
            new_value, new_weights = potential(b + length * step)
        b, value, weights = b + length * step, new_value, new_weights
    return weights if float(np.abs(weights @ r).max()) < 1e3 * TOLERANCE else None


def _transform(setup: WorldSetup, values: Values, targets: Targets) -> WorldSetup:
    fraction, offset = values["fraction"], np.asarray(vector(values, "offset"))

    def loaded(body: BodyParticles) -> BodyParticles:
        center, masses = body.center_of_mass, body.masses
        width = pellet_width(body, fraction)
        weights = pellet_weights(body, center + offset, width)
        if weights is None:
            raise InputError(
                f"body {body.name!r}: offset is {vector(values, 'offset')!r}: that lies outside its particles; "
                f"give at most {_reach(body, offset, width):.2g} times that"
            )
        factor = (1.0 - fraction) + fraction * masses.sum() * weights / masses
        scale = factor if body.density_scale is None else factor * body.density_scale
        return dataclasses.replace(body, density_scale=scale)

    return change_bodies(setup, targets, loaded)


def _reach(body: BodyParticles, offset: NDArray[np.float64], width: float) -> float:
    """Return the largest share of ``offset``, to about a percent, at which a pellet still lies among the particles."""
    low, high = 0.0, 1.0
    for _ in range(10):
        middle = 0.5 * (low + high)
        inside = pellet_weights(body, body.center_of_mass + middle * offset, width) is not None
        low, high = (middle, high) if inside else (low, middle)
    return low


EFFECT = Effect(
    name="mass_offset",
    kind="mass",
    parameters=(
        Parameter(
            name="fraction",
            unit="1",
            low=0.0,
            high=0.9,
            default=0.3,
            description="f, the pellet's share of the body's mass",
        ),
        *vector_parameters(
            "offset",
            "m",
            1000.0,
            (0.0, 0.0, -0.01),
            "d, from the centre of mass to the pellet, world axes, at the start",
        ),
    ),
    description=__doc__,
    transform=_transform,
    neutral={"fraction": 0.0},
)
