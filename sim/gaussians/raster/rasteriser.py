# SPDX-License-Identifier: MIT
"""Pictures of Gaussian splats and exact gradients of a loss on them (Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ...errors import InputError
from ...mpm.options import SolverOptions
from ...mpm.runtime import ensure_started
from ...scene.model import Camera
from ..splats import Splats
from .blending import LIGHT, MEAN_DEPTH, STATE, blend, blend_back
from .projection import ELLIPSE, FURTHEST, LOW_PASS, NEAREST, SUMS, numbers_of, project, project_back
from .tiles import Pairs, pairs_of

MOST_PIXELS = 2**26
"""Bound of memory: a pixel takes some 60 bytes."""

CPU_TILE, DEVICE_TILE = 16, 8
"""Side of a tile in pixels. A thread does a whole tile: a GPU needs many short ones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """What a camera sees of splats."""

    colour: NDArray[np.float32]
    """(H, W, 3) over the background's colour, in the colours' own terms (sRGB as files keep it)."""

    alpha: NDArray[np.float32]
    """(H, W) share of the background's light that is held back."""

    depth: NDArray[np.float32]
    """(H, W) metres along the optical axis, mean of the splats' centres by their shares; 0 where alpha is 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatGradients:
    """Gradient of a scalar loss by each array of the splats, of the same shape, float64."""

    centres: NDArray[np.float64]
    scales: NDArray[np.float64]

    rotations: NDArray[np.float64]
    """By the four numbers of the unit quaternion q, through q/|q|: at a right angle to q."""

    opacities: NDArray[np.float64]
    colours: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Drawn:
    """What the gradients of a rendering need."""

    splats: Splats
    camera: NDArray[np.float64]
    background: NDArray[np.float64]
    tile: int
    ellipses: NDArray[np.float64]
    pairs: Pairs
    tile_ends: NDArray[np.int64]
    last: NDArray[np.int32]
    light: NDArray[np.float32]


class Rasteriser:
    """Renders splats, and takes gradients of the picture back to them.

    The gradients are those of the picture as it is drawn: a splat's share of light falls to none continuously, so what
    is left out at its rim has no gradient to miss. Treated as constant although it jumps: which splat is in front of
    which; a splat that comes nearer than NEAREST; a pixel that is finished, with at most LEAST_LIGHT of its colour
    still to come. Where MOST_ALPHA holds a splat back, and where J stands still beside the picture, the gradient is
    that of the constant.

    Equal input gives equal bytes, whatever the number of threads.
    """

    def __init__(self, *, solver: SolverOptions | None = None) -> None:
        """``solver`` says where to compute; None takes Taichi as it runs in this process, or starts it on the CPU. Of
        its fields only arch, threads and cache_folder count; they should be those of the engine's worlds in the same
        process, whose state a restart loses."""
        self._solver = solver
        self._drawn: _Drawn | None = None
        self._sums = np.empty((0, SUMS), dtype=np.float32)

    def render(
        self, splats: Splats, camera: Camera, *, background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ) -> Rendering:
        """``splats`` as ``camera`` sees them before ``background`` (sRGB). Raises InputError on a picture or a number
        of splats that memory has no room for."""
        behind = _colour(background)
        height, width = camera.height, camera.width
        if height * width > MOST_PIXELS:
            raise InputError(f"camera size is {width}x{height}: rendering splats takes up to {MOST_PIXELS} pixels")
        tile = self._start()
        self._drawn = None
        numbers = numbers_of(camera)
        ellipses = np.zeros((len(splats), ELLIPSE))
        if len(splats):
            project(
                splats.centres,
                splats.scales,
                splats.rotations,
                splats.opacities,
                splats.colours,
                numbers,
                LOW_PASS,
                NEAREST,
                FURTHEST,
                ellipses,
            )
        pairs = pairs_of(ellipses, width, height, tile)
        pixels = np.zeros((height, width, STATE), dtype=np.float32)
        pixels[..., LIGHT] = 1.0
        last = np.full((height, width), np.iinfo(np.int32).max, dtype=np.int32)
        tile_ends = np.zeros(len(pairs.tile_starts) - 1, dtype=np.int64)
        if len(pairs.splats):
            blend(ellipses, pairs.splats, pairs.order, pairs.tile_starts, tile, tile_ends, pixels, last)
        light = pixels[..., LIGHT].copy()
        alpha = 1.0 - light
        self._drawn = _Drawn(
            splats=splats,
            camera=numbers,
            background=behind,
            tile=tile,
            ellipses=ellipses,
            pairs=pairs,
            tile_ends=tile_ends,
            last=last,
            light=light,
        )
        return Rendering(
            colour=pixels[..., :LIGHT] + light[..., None] * behind.astype(np.float32),
            alpha=alpha,
            depth=np.divide(pixels[..., MEAN_DEPTH], alpha, out=np.zeros_like(alpha), where=alpha > 0),
        )

    def gradients(self, d_colour: NDArray[np.floating], d_alpha: NDArray[np.floating] | None = None) -> SplatGradients:
        """Gradients of a loss with ∂L/∂colour = ``d_colour`` (H, W, 3) and ∂L/∂alpha = ``d_alpha`` (H, W; None: 0) of
        the last rendering. Raises InputError if there is none, and on other shapes or numbers that are not finite."""
        drawn = self._drawn
        if drawn is None:
            raise InputError("gradients of splats: nothing has been rendered yet: call render first")
        height, width = drawn.light.shape
        upstream = np.zeros((height, width, 4), dtype=np.float32)
        upstream[..., :3] = _checked("d_colour", d_colour, (height, width, 3))
        if d_alpha is not None:
            upstream[..., 3] = _checked("d_alpha", d_alpha, (height, width))
        count, pairs = len(drawn.splats), drawn.pairs
        found = SplatGradients(
            centres=np.zeros((count, 3)),
            scales=np.zeros((count, 3)),
            rotations=np.zeros((count, 4)),
            opacities=np.zeros(count),
            colours=np.zeros((count, 3)),
        )
        if not len(pairs.splats):
            return found
        self._start()
        behind = np.stack([drawn.light, upstream[..., :3] @ drawn.background.astype(np.float32)], axis=-1)
        if len(self._sums) < len(pairs.splats):
            self._sums = np.empty((len(pairs.splats) * 5 // 4, SUMS), dtype=np.float32)
        blend_back(
            drawn.ellipses,
            pairs.splats,
            pairs.order,
            pairs.tile_starts,
            drawn.tile,
            drawn.tile_ends,
            drawn.last,
            upstream,
            behind,
            self._sums,
        )
        project_back(
            drawn.splats.centres,
            drawn.splats.scales,
            drawn.splats.rotations,
            drawn.camera,
            drawn.ellipses,
            pairs.ranked,
            pairs.splat_starts,
            self._sums,
            found.centres,
            found.scales,
            found.rotations,
            found.opacities,
            found.colours,
        )
        return found

    def _start(self) -> int:
        """Make sure that Taichi runs; the side of a tile on what it runs on.

        All that lasts between calls is numpy's, which a restart leaves alone and a CPU reads in place.
        """
        if self._solver is not None or ti.lang.impl.get_runtime().prog is None:
            ensure_started(self._solver or SolverOptions())
        on_cpu = ti.lang.impl.current_cfg().arch in (ti.x64, ti.arm64)
        return CPU_TILE if on_cpu else DEVICE_TILE


def _colour(background: Sequence[float]) -> NDArray[np.float64]:
    colour = np.asarray(background, dtype=np.float64)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InputError(f"background is {background!r}: give three finite numbers, red, green and blue")
    return colour


def _checked(name: str, value: NDArray[np.floating], shape: tuple[int, ...]) -> NDArray[np.floating]:
    value = np.asarray(value)
    if value.shape != shape:
        raise InputError(f"gradients of splats: {name} has shape {value.shape}: give {shape}, the picture's")
    if not np.isfinite(value).all():
        raise InputError(f"gradients of splats: {name} has numbers that are not finite: look at the loss before this")
    return value
