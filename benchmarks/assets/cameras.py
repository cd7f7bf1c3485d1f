# SPDX-License-Identifier: MIT
"""Where an asset is looked at from: the input picture, views all around for fitting, others for judging."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from physgen.sim.gaussians.views.orbit import orbit_camera
from physgen.sim.scene.model import Camera

from .asset import Asset
from .fields import Array

FIELD_OF_VIEW = 49.1
"""Degrees across and down, SyncDreamer's."""

FILLED = 0.86
"""Of half the frame, how far out anything of the asset gets in any view: room for what starts larger."""

FRONT = -62.0
"""Degrees from +x at which azimuth 0 is: assets look towards -y, and are pictured a little from their left."""

RING = 16
"""Fitting views on SyncDreamer's ring, the first of them."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """A view by its name; azimuth (counterclockwise from above, from the reference) and elevation in degrees."""

    name: str
    azimuth: float
    elevation: float

    def camera(self, centre: Array, distance: float, size: int) -> Camera:
        """A square camera of ``size`` pixels that looks at ``centre`` (3,) from ``distance`` metres away."""
        focal = 0.5 / math.tan(math.radians(FIELD_OF_VIEW / 2))
        turn = FRONT + self.azimuth
        return orbit_camera(turn, self.elevation, distance, side=size, focal=focal, target=tuple(centre.tolist()))


def _numbered(kind: str, angles: list[tuple[float, float]]) -> tuple[Place, ...]:
    return tuple(Place(name=f"{kind}_{i:02}", azimuth=a, elevation=e) for i, (a, e) in enumerate(angles))


REFERENCE = Place(name="reference", azimuth=0.0, elevation=20.0)
"""The input picture."""

FITTING = _numbered(
    "fit",
    [(360.0 / RING * i, 30.0) for i in range(RING)]
    + [(45.0 + 90.0 * i, -10.0) for i in range(4)]
    + [(90.0 * i, 65.0) for i in range(4)],
)
"""As SyncDreamer places its 16 (elevation 30°), then four from below and four from above."""

HELD_OUT = _numbered(
    "held", [(11.25, 10.0), (78.75, 45.0), (146.25, 20.0), (213.75, 5.0), (281.25, 50.0), (326.25, 35.0)]
)
"""Views that nothing is fitted to."""

PLACES = (REFERENCE, *FITTING, *HELD_OUT)


def cameras(asset: Asset, size: int) -> dict[str, Camera]:
    """Of all ``PLACES``, by name: as near as keeps the asset within ``FILLED``, all from the same distance."""
    points = np.concatenate([part.vertices for part in asset.parts])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    near, far = asset.size / 2, 20.0 * asset.size
    while far - near > 1e-3 * asset.size:
        middle = (near + far) / 2
        fits = all(_reach(place.camera(centre, middle, 2), points) <= FILLED for place in PLACES)
        near, far = (near, middle) if fits else (middle, far)
    return {place.name: place.camera(centre, far, size) for place in PLACES}


def _reach(seen: Camera, points: Array) -> float:
    """How far out ``points`` (N, 3) get, 1 at the edge of the frame."""
    pixels = seen.project(points)
    if pixels[:, 2].min() <= 0:
        return math.inf
    return float(np.abs(pixels[:, :2] - seen.cx).max() / seen.cx)
