# SPDX-License-Identifier: MIT
"""Renders of Gaussian splats, and exact gradients of a loss on them (Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ...errors import InputError
from ...mpm.kernels.runtime import ensure_started
from ...mpm.solver_options import SolverOptions
from ...scene.model import Camera
from ..splats import Splats
from .splat_projection import (
    ELLIPSE,
    FURTHEST,
    LOW_PASS,
    NEAREST,
    SUMS,
    PairSums,
    ProjectionLimits,
    SplatArrays,
    numbers_of,
    project,
    project_back,
)
from .tile_blending import (
    LIGHT,
    MEAN_DEPTH,
    STATE,
    BackwardArrays,
    PairArrays,
    PictureArrays,
    TilePairs,
    blend,
    blend_back,
    pairs_of,
)

MAX_PIXELS = 2**26
"""Bounds memory: a pixel takes about 60 bytes."""

CPU_TILE, DEVICE_TILE = 16, 8
"""Side of a tile in pixels. A thread processes a whole tile: a GPU needs many small ones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatRender:
    """Splats rendered from a camera."""

    colour: NDArray[np.float32]
    """(H, W, 3) over the background colour, in the colour space of the splats (sRGB)."""

    alpha: NDArray[np.float32]
    """(H, W) opacity."""

    depth: NDArray[np.float32]
    """(H, W) metres along the optical axis, weighted mean of the splats' centres; 0 where alpha is 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SplatGradients:
    """Gradients of a scalar loss by each array of the splats, of the same shape, float64."""

    centres: NDArray[np.float64]
    scales: NDArray[np.float64]

    rotations: NDArray[np.float64]
    """By the four entries of the unit quaternion q, through q/|q|: orthogonal to q."""

    opacities: NDArray[np.float64]
    colours: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class _RenderState:
    """State of a render that its gradients need."""

    splats: Splats
    camera: NDArray[np.float64]
    background: NDArray[np.float64]
    ellipses: NDArray[np.float64]
    pairs: TilePairs
    lists: PairArrays
    last: NDArray[np.int32]
    light: NDArray[np.float32]


class Rasteriser:
    """Renders splats, and propagates gradients of the image to them.

    The gradients are exact for the image as drawn: a splat's alpha falls to 0 continuously at its rim, so cutting it
    off loses no gradient. Treated as constant although discontinuous: the depth order; splats crossing the near plane
    NEAREST; termination of a pixel, with at most MIN_TRANSMITTANCE of its colour missing. Where MAX_ALPHA clamps a
    splat, and where J is clamped outside the image, the gradient is that of the constant.

    Deterministic: equal input gives equal bytes, for any number of threads.
    """

    def __init__(self, *, solver: SolverOptions | None = None) -> None:
        """solver: where to compute; None uses Taichi as it runs in this process, or starts it on the CPU. Only its
        arch, threads and cache_folder matter; they should equal those of the engine's worlds in the same process, whose
        state is lost in a restart."""
        self._solver = solver
        self._drawn: _RenderState | None = None
        self._sums = np.empty((0, SUMS), dtype=np.float32)

    def render(
        self, splats: Splats, camera: Camera, *, background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ) -> SplatRender:
        """Return ``splats`` seen by ``camera`` over ``background`` (sRGB). Raises InputError on an image or a number of
        splats above the memory bounds, and on a background that is not three finite numbers."""
        behind = _colour(background)
        height, width = camera.height, camera.width
        if height * width > MAX_PIXELS:
            raise InputError(f"camera size is {width}x{height}: rendering splats takes up to {MAX_PIXELS} pixels")
        tile = self._start()
        self._drawn = None
        numbers = numbers_of(camera)
        ellipses = np.zeros((len(splats), ELLIPSE))
        if len(splats):
            project(numbers, ellipses, _arrays(splats), ProjectionLimits(LOW_PASS, NEAREST, FURTHEST))
        pairs = pairs_of(ellipses, width, height, tile)
        pixels = np.zeros((height, width, STATE), dtype=np.float32)
        pixels[..., LIGHT] = 1.0
        last = np.full((height, width), np.iinfo(np.int32).max, dtype=np.int32)
        tile_ends = np.zeros(len(pairs.tile_starts) - 1, dtype=np.int64)
        lists = PairArrays(tile, pairs.splats, pairs.order, pairs.tile_starts, tile_ends)
        if len(pairs.splats):
            blend(ellipses, lists, PictureArrays(pixels, last))
        light = pixels[..., LIGHT].copy()
        alpha = 1.0 - light
        self._drawn = _RenderState(
            splats=splats,
            camera=numbers,
            background=behind,
            ellipses=ellipses,
            pairs=pairs,
            lists=lists,
            last=last,
            light=light,
        )
        return SplatRender(
            colour=pixels[..., :LIGHT] + light[..., None] * behind.astype(np.float32),
            alpha=alpha,
            depth=np.divide(pixels[..., MEAN_DEPTH], alpha, out=np.zeros_like(alpha), where=alpha > 0),
        )

    def gradients(self, d_colour: NDArray[np.floating], d_alpha: NDArray[np.floating] | None = None) -> SplatGradients:
        """Return gradients by the splats of the last render, given ∂L/∂colour = ``d_colour`` (H, W, 3) and ∂L/∂alpha =
        ``d_alpha`` (H, W; None: 0). Raises InputError before any render, and on wrong shapes or non-finite values."""
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
        blend_back(drawn.ellipses, drawn.last, drawn.lists, BackwardArrays(upstream, behind, self._sums))
        sums = PairSums(pairs.ranked, pairs.splat_starts, self._sums)
        project_back(drawn.camera, drawn.ellipses, _arrays(drawn.splats), sums, _arrays(found))
        return found

    def _start(self) -> int:
        """Start Taichi if needed; return the side of a tile for its backend.

        All state between calls is in NumPy arrays, which survive a restart and are read in place by a CPU.
        """
        if self._solver is not None or ti.lang.impl.get_runtime().prog is None:
            ensure_started(self._solver or SolverOptions())
        on_cpu = ti.lang.impl.current_cfg().arch in (ti.x64, ti.arm64)
        return CPU_TILE if on_cpu else DEVICE_TILE


def _arrays(of: Splats | SplatGradients) -> SplatArrays:
    return SplatArrays(of.centres, of.scales, of.rotations, of.opacities, of.colours)


def _colour(background: Sequence[float]) -> NDArray[np.float64]:
    colour = np.asarray(background, dtype=np.float64)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InputError(f"background is {background!r}: give three finite numbers, red, green and blue")
    return colour


def _checked(name: str, value: NDArray[np.floating], shape: tuple[int, ...]) -> NDArray[np.floating]:
    value = np.asarray(value)
    if value.shape != shape:
        raise InputError(f"gradients of splats: {name} has shape {value.shape}: give {shape}, the image's")
    if not np.isfinite(value).all():
        raise InputError(f"gradients of splats: {name} has values that are not finite: check the loss")
    return value
