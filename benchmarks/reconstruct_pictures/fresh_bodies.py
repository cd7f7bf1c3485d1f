# SPDX-License-Identifier: GPL-3.0-or-later
"""Two things more whose surface is known all around, drawn after the changes that they judge: a boot and a kettle.

As in ``held_out_bodies.py``; each has a mark that touches what goes on around it, on which no mark of the others lies.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from .held_out_bodies import tube
from .painted_bodies import Painted, Points, fur, painted_body, plain, where, within
from .shapes import Body, block, ellipsoid, revolved

KINDS = ("boot", "kettle")
Mask = NDArray[np.bool_]


def make_fresh(kind: str, size: float) -> Body:
    """A body of ``kind`` that stands on the origin; ``size``: its largest extent along an axis, metres."""
    return painted_body({"boot": _boot, "kettle": _kettle}[kind](), size, smooth=True)


def _boot() -> list[Painted]:
    """A rubber boot whose toe points to the right: two bands around its shaft, a star over both, a pale sole."""
    green, cream, navy = (
        fur((0.08, 0.2, 0.07), seed=101, strength=0.08),
        plain((0.6, 0.56, 0.42)),
        plain((0.03, 0.04, 0.1)),
    )
    star, sole = plain((0.7, 0.3, 0.02)), plain((0.5, 0.42, 0.3))

    def bands(places: Points) -> Mask:
        return (np.abs(places[:, 2] - 0.62) < 0.035) | (np.abs(places[:, 2] - 0.78) < 0.035)

    def star_of(places: Points) -> Mask:
        x, z = places[:, 0] + 0.17, places[:, 2] - 0.7
        return (np.hypot(x, z) < 0.075 * (1 + 0.35 * np.cos(5 * np.arctan2(x, z)))) & (places[:, 1] < -0.05)

    coat = where(star_of, star, where(bands, cream, where(lambda p: p[:, 2] > 0.93, navy, green)))
    up = np.linspace(0.15, 1.0, 40)
    shaft = tube([(-0.15, 0.0, float(z)) for z in up], [0.16 + 0.02 * float(z) for z in up], 96)
    return [
        (shaft, coat),
        (ellipsoid((-0.15, 0, 0.17), (0.175, 0.16, 0.15)), green),
        (ellipsoid((0.1, 0, 0.16), (0.29, 0.15, 0.13)), green),
        (block((-0.32, -0.13, 0.0), (0.3, 0.13, 0.06)), sole),
    ]


def _kettle() -> list[Painted]:
    """A kettle with its spout to the left: a dark foot and a light band, a round badge whose edge lies on the band."""
    blue, grey, white = (
        fur((0.09, 0.17, 0.36), seed=111, strength=0.06),
        plain((0.3, 0.3, 0.31)),
        plain((0.72, 0.7, 0.66)),
    )
    black, red = plain((0.02, 0.02, 0.022)), plain((0.55, 0.05, 0.04))
    turn = np.linspace(-1.3, 1.3, 50)
    belly = [(0.34 * float(np.cos(a)) ** 0.6, 0.29 + 0.29 * float(np.sin(a))) for a in turn]
    wall = [(0.0, belly[0][1]), *belly, (0.0, belly[-1][1])]
    badge = within((0.08, -0.33, 0.24), 0.085)
    dot = within((-0.13, -0.31, 0.23), 0.03)
    coat = where(badge, white, where(dot, red, where(lambda p: np.abs(p[:, 2] - 0.36) < 0.05, grey, blue)))
    bend = np.linspace(0.0, np.pi, 24)
    grip = [(0.25 * float(np.cos(a)), 0.0, 0.52 + 0.3 * float(np.sin(a))) for a in bend]
    lid: trimesh.Trimesh = ellipsoid((0, 0, 0.57), (0.16, 0.16, 0.04))
    return [
        (revolved(wall, sections=160), where(lambda p: p[:, 2] < 0.06, black, coat)),
        (tube([(-0.27, 0, 0.2), (-0.42, 0, 0.3), (-0.5, 0, 0.44)], [0.08, 0.055, 0.04]), blue),
        (tube(grip, [0.03] * len(grip)), black),
        (lid, grey),
        (ellipsoid((0, 0, 0.63), (0.04, 0.04, 0.04)), black),
    ]
