# SPDX-License-Identifier: MIT
"""The light that each pixel of the ground, and of a wall behind the objects, keeps past them.

Per plane: rough bodies, the lamps that explain its colours (``shadow_lamps``), and the levels of each pixel
(``shadow_model``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from .ground_pixels import GroundPixels, ProxyBody, ground_pixels, proxy_body
from .shadow_lamps import ShadowLamp, ShadowLight, direction_of, fit_light, fit_wall_light, light_shares
from .shadow_model import light_level_posterior
from .shadow_planes import ShadowPlane, ground_plane, wall_behind

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

FEWEST = 50
"""Fewest ground pixels for an estimate."""
GRAZING = 0.05
"""Cosine on a wall of a lamp that hardly shines on it: what is foreseen there is an error of the wall's direction."""


@dataclass(frozen=True, eq=False)
class PlaneLevels:
    """A plane of the photo with its N pixels of ``ground``, for objects that stand on the ground.

    upright: whether it is a wall. elsewhere: (H, W) pixels that do not show it. light: the lamps. kept: (N,) share of
    light past all bodies; alone: (objects, N) ratio of the light with to without each; hidden: (objects, N) share of
    the sky that each occludes. distances: (objects, N) from each, over the objects' size. levels: (N, levels)
    probability of each level of ``shadow_model.LEVELS``.
    """

    ground: GroundPixels
    upright: bool
    elsewhere: Mask
    light: ShadowLight
    kept: Values
    alone: Values
    hidden: Values
    distances: Values
    levels: Values


def standing_bodies(masks: Sequence[Mask], camera: Camera) -> dict[int, ProxyBody]:
    """Return rough bodies of those of ``masks`` (H, W), by their index, that can stand on the ground z = 0."""
    bodies = {index: proxy_body(mask, camera) for index, mask in enumerate(masks)}
    return {index: body for index, body in bodies.items() if body is not None}


def plane_levels(
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    bodies: Mapping[int, ProxyBody],
    camera: Camera,
    stay: Mask | None = None,
) -> Iterator[PlaneLevels]:
    """Yield the ground, then a wall behind the objects, where enough of them is seen.

    pixels: (H, W, 3) sRGB. masks: (H, W) of all objects. bodies: of ``standing_bodies``; the others cast no shadow.
    camera: above the ground z = 0. stay: (H, W) things that are no objects, or None. Nothing without a body.
    """
    if not bodies:
        return
    closed = np.logical_or.reduce(masks if stay is None else [*masks, stay])
    outlines = [masks[index] for index in bodies]
    wall = wall_behind(pixels, masks, camera, stay)
    lamps: tuple[ShadowLamp, ...] = ()
    for plane in (ground_plane(closed.shape, wall), wall):
        if plane is None:
            continue
        turned = [replace(body, points=plane.in_frame(body.points)) for body in bodies.values()]
        ground = ground_pixels(pixels, masks, camera, turned, stay, plane)
        if ground is None or len(ground.rows) < FEWEST:
            continue
        upright = plane is wall
        if upright:
            light = fit_wall_light(ground, turned, _turned(lamps, plane) if lamps else None)
        else:
            light = fit_light(ground, turned)
            lamps = light.lamps
        yield _levels(ground, turned, light, outlines, closed | ~plane.region, upright=upright)


def _levels(
    ground: GroundPixels,
    bodies: Sequence[ProxyBody],
    light: ShadowLight,
    outlines: Sequence[Mask],
    elsewhere: Mask,
    *,
    upright: bool,
) -> PlaneLevels:
    kept, alone, hidden = light_shares(ground, bodies, light)
    distances = np.stack([_distance(ground, mask) for mask in outlines])
    # Around its contact an object darkens the ground under any light, but not a wall.
    around = np.zeros_like(kept) if upright else np.minimum(hidden.sum(axis=0), 1.0)
    return PlaneLevels(
        ground=ground,
        upright=upright,
        elsewhere=elsewhere,
        light=light,
        kept=kept,
        alone=alone,
        hidden=hidden,
        distances=distances,
        levels=light_level_posterior(ground, kept, around, distances.min(axis=0)),
    )


def _turned(lamps: Sequence[ShadowLamp], plane: ShadowPlane) -> list[ShadowLamp]:
    """``lamps`` over the ground in the frame of ``plane``, as far as they shine on its front."""
    toward = [plane.axes @ direction_of(lamp.slide) for lamp in lamps]
    return [
        replace(lamp, slide=axis[:2] / axis[2]) for lamp, axis in zip(lamps, toward, strict=True) if axis[2] > GRAZING
    ]


def _distance(ground: GroundPixels, mask: Mask) -> Values:
    """Distance (N,) from the object in ``mask`` (H, W), over the objects' size."""
    small = cv2.resize(mask.astype(np.uint8), ground.known.shape[::-1], interpolation=cv2.INTER_AREA)
    pixels = cv2.distanceTransform((small == 0).astype(np.uint8), cv2.DIST_L2, 5)[ground.rows, ground.columns]
    return np.asarray(pixels / ground.object_side)
