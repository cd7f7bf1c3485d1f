# SPDX-License-Identifier: GPL-3.0-or-later
"""Motion blur: the motion while the shutter is open, from one sample of the bake to the next. Needs no bpy.

The shutter closes at the frame, so that the first frame, before which everything rests, is as sharp as the photo.
Between two samples Mesh Cache and Cycles both move every vertex along a straight line, so its two ends define the
motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...sim.scene.model import Camera

if TYPE_CHECKING:
    from ..playback.point_caches import OpenedBake

STILL_PX = 0.02
"""Motion below this on the image is invisible."""

SAMPLED_PX = 4.0
"""Length of motion blur, in pixels, that the ordinary number of samples renders without visible noise."""

Vertices = Sequence[NDArray[np.float32]]
"""Positions (V, 3) of every object, world metres."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Positions in one sample of a bake, world metres.

    skins: vertices (V, 3) of each object. particles: (N, 3) of each granular or fluid object, vertices of each torn
    skin, else None. flowing: which objects show them.
    """

    skins: Vertices
    particles: Sequence[NDArray[np.float32] | None]
    flowing: tuple[bool, ...]

    @property
    def every(self) -> list[NDArray[np.float32]]:
        """All positions, particles last, shown or not."""
        return [*self.skins, *(p for p in self.particles if p is not None)]

    @property
    def shown(self) -> list[NDArray[np.float32]]:
        """Shown positions of each object, (V, 3) or (V + N, 3): its skin, with its particles if these are shown."""
        return [
            np.concatenate([skin, particles]) if flows and particles is not None else skin
            for skin, particles, flows in zip(self.skins, self.particles, self.flowing, strict=True)
        ]

    def same(self, other: Pose, within: float) -> bool:
        """Return whether no point is farther than ``within`` metres from its position in ``other``."""
        pairs = zip(self.every, other.every, strict=True)
        return self.flowing == other.flowing and all(float(np.abs(a - b).max()) <= within for a, b in pairs)


def pose(bake: OpenedBake, sample: int) -> Pose:
    """Return the positions in ``sample`` of ``bake``."""
    tears = bake.tears or (None,) * len(bake.flows)
    loose = [flow or tear for flow, tear in zip(bake.flows, tears, strict=True)]
    return Pose(
        skins=[cache.sample(sample) for cache in bake.caches],
        particles=[None if each is None else each.cache.sample(sample) for each in loose],
        flowing=tuple(each is not None and each.shown_at(sample) for each in loose),
    )


def still_distance(camera: Camera, rest: Pose, scale: float) -> float:
    """Return the world distance in metres below which motion is invisible: ``STILL_PX`` at the nearest point at
    ``rest``.

    scale: width of the frames over the photo's.
    """
    depth = min(float(camera.project(positions)[:, 2].min()) for positions in rest.every)
    return max(depth, 0.0) / (max(camera.fx, camera.fy) * scale) * STILL_PX


@dataclass(frozen=True, kw_only=True)
class Moment:
    """State of the bake shown by one frame.

    number: of the frame. now: vertices (V, 3) of each object when the shutter closes. swept: of each object all points
    seen at either end of its motion, concatenated: their hull contains all positions between, in perspective too.
    shutter: how long it was open, over the frame interval; 0 without motion. length: longest motion in pixels.
    """

    number: int
    now: Vertices
    swept: Vertices
    shutter: float = 0.0
    length: float = 0.0

    def samples(self, usual: int, *, at_most: int) -> int:
        """Return samples a pixel: more for longer blur, up to ``at_most`` times the ``usual``."""
        return round(usual * float(np.clip(self.length / SAMPLED_PX, 1.0, at_most)))


def moment(
    number: int, before: Pose, now: Pose, *, shutter: float, still: float, camera: Camera, scale: float
) -> Moment:
    """Return the moment of frame ``number``, given the pose one frame earlier; without motion if all is at rest.

    shutter: share of the frame interval, 0 to 1. still: from ``still_distance``. scale: of the frames over the photo.
    """
    if shutter <= 0 or now.same(before, still):
        return Moment(number=number, now=now.skins, swept=now.shown)
    # Particles that appear in this frame have no motion of their own yet; the skin they come from has.
    ends = [(x if x.shape == y.shape else y, y) for x, y in zip(before.shown, now.shown, strict=True)]
    opened = [np.asarray(y + np.float32(shutter) * (x - y), np.float32) for x, y in ends]
    skins = [(x, y) for x, y in zip(before.skins, now.skins, strict=True)]
    return Moment(
        number=number,
        now=now.skins,
        swept=[np.concatenate([start, y]) for start, (_, y) in zip(opened, ends, strict=True)],
        shutter=shutter,
        length=max(_length_px(camera, x, y) for x, y in skins) * shutter * scale,
    )


def _length_px(camera: Camera, start: NDArray[np.float32], end: NDArray[np.float32]) -> float:
    """Return the longest motion of a vertex (V, 3) in pixels of the photo, among those in front of the camera at both
    ends.
    """
    a, b = camera.project(start), camera.project(end)
    ahead = (a[:, 2] > 0) & (b[:, 2] > 0)
    return float(np.linalg.norm((a - b)[ahead, :2], axis=1).max()) if ahead.any() else 0.0
