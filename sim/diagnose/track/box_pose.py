# SPDX-License-Identifier: MIT
"""Outlines of a box that slides on level ground → the camera above it, and the box's place and turn in every frame.

A box of known size tells the camera: three of its faces are in view, and it comes nearer or goes away. The outline of
each frame is compared with the projected box by their support functions, the distance of the outermost point in each
direction, so that nothing has to be matched. Shadows and other spurs stand out in few directions and count little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...robust_deviation import robust_deviation
from .pose_estimation import Array

DIRECTIONS = 48
"""Directions in which an outline is compared with the box's."""
USUAL_FOCAL, FOCAL_SPREAD = 0.8, 0.35
"""Focal length over the picture's longer side of phones and cameras, and the standard deviation of its logarithm."""
ROLL_SPREAD = math.radians(4.0)
"""Standard deviation of a camera's roll, rad."""
GROWN_PX, GROWN_SPREAD = 1.0, 2.0
"""By how much outlines of regions lie outside of bodies, and its standard deviation, px; blur widens them."""
EDGE_PX = 0.5
"""Standard deviation of an outline in a direction, px."""
PITCHES = tuple(math.radians(a) for a in (20, 35, 50, 65, 80))
"""Pitches of the camera below the horizon that the search starts from."""
STARTS, YAWS = 8, 6
"""Frames that the camera is found in, and turns that each is started from within the box's symmetry."""
POOR, POOR_PX, POOR_AT = 0.008, 0.1, 0.7
"""Residual of an outline that this share of directions stays below, over the box's size in the picture and in px, from
which no box is seen: a disc of 80 px leaves 0.010 of its size, the outlines of a real cube 0.004."""
NEIGHBOURS, STANDS_OUT, LEAST_OUT_PX = 4, 5.0, 0.1
"""Frames on each side that a frame's outline is compared with; robust standard deviations, each at least so many px, by
which its growth or its residual differ from theirs if something else, such as a shadow, has become a part of it."""
FASTEST = 0.4
"""Turn from frame to frame, in shares of the angle after which the outline repeats, up to which it is followed."""


@dataclass(frozen=True, kw_only=True)
class GroundCamera:
    """A pinhole camera above level ground. World axes: x to the right, y away from it, z up; the origin lies on the
    ground below it. focal: px. middle: (2,) px of the axis. pitch: rad below the horizon. roll: rad. height: m.
    """

    focal: float
    middle: tuple[float, float]
    pitch: float
    roll: float
    height: float

    def pixels(self, points: Array) -> Array:
        """Return px (..., 2) of world points (..., 3) m; NaN for what lies behind the camera."""
        c, s = math.cos(self.pitch), math.sin(self.pitch)
        y, z = points[..., 1], points[..., 2] - self.height
        depth = c * y - s * z
        with np.errstate(divide="ignore", invalid="ignore"):
            across = self.focal * points[..., 0] / depth
            down = self.focal * (-s * y - c * z) / depth
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        out = np.stack([cr * across - sr * down, sr * across + cr * down], axis=-1) + self.middle
        return np.where(depth[..., None] > 1e-6, out, np.nan)

    def ground(self, pixels: Array, height: float = 0.0) -> Array:
        """Return world points (..., 3) m at ``height`` above the ground that are seen at ``pixels`` (..., 2)."""
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        off = (pixels - np.asarray(self.middle)) / self.focal
        across, down = cr * off[..., 0] + sr * off[..., 1], cr * off[..., 1] - sr * off[..., 0]
        c, s = math.cos(self.pitch), math.sin(self.pitch)
        fall = np.maximum(s + c * down, 0.02)
        depth = (self.height - height) / fall
        return np.stack([across * depth, (c - s * down) * depth, np.full(depth.shape, height)], axis=-1)

    @property
    def place(self) -> Array:
        """Return where the camera is (3,) m."""
        return np.array([0.0, 0.0, self.height])


@dataclass(frozen=True, kw_only=True, eq=False)
class BoxMotion:
    """A box that slides on level ground. centres: (T, 3) m in the camera's world. turns: (T,) rad about z, continuous.
    residual: px that 0.7 of an outline's directions stay within of the box's, the median over frames. edges: (3,) m of
    the box. sound: (T,) whether the outline is one of the box alone, as in the frames next to it."""

    camera: GroundCamera
    centres: Array
    turns: Array
    residual: float
    edges: Array
    sound: NDArray[np.bool_]

    def at(self, samples: NDArray[np.int64]) -> BoxMotion:
        """Return the motion at ``samples`` (N,) alone."""
        return replace(self, centres=self.centres[samples], turns=self.turns[samples], sound=self.sound[samples])


def follow_box(outlines: Sequence[Array], edges: Array, picture: tuple[int, int]) -> BoxMotion | None:
    """Return the motion of a box with ``edges`` (3,) m, as it stands, seen as ``outlines`` in the order of frames.

    outlines: (N, 2) px each. picture: its width and height. None where they do not look like that box, or where it
    turns too fast to be followed.
    """
    support = supports(outlines)
    size = float(np.median(np.ptp(np.stack([[o.min(axis=0), o.max(axis=0)] for o in outlines]), axis=1).mean(axis=1)))
    cycle = repeats_after(edges)
    camera = _first_camera(support, edges, picture)
    places = _camera(camera, picture).ground(_middles(support), float(edges[2] / 2))[:, :2]
    states = _best_turn(support, camera, places, edges, picture, np.arange(YAWS) * cycle / YAWS)
    camera, states, misses = _refine(support, camera, states, edges, picture)
    residual = float(np.median(misses))
    if residual > POOR * size + POOR_PX:
        return None
    turns = unwrapped(states[:, 2], cycle)
    if np.abs(np.diff(turns)).max(initial=0.0) > FASTEST * cycle:
        return None
    centres = np.column_stack([states[:, :2], np.full(len(states), edges[2] / 2)])
    # A smaller residual is no fault.
    sound = ~((np.abs(standing_out(states[:, 3])) > STANDS_OUT) | (standing_out(misses) > STANDS_OUT))
    return BoxMotion(
        camera=_camera(camera, picture), centres=centres, turns=turns, residual=residual, edges=edges, sound=sound
    )


def standing_out(values: Array) -> Array:
    """Return by how many robust standard deviations, at least ``LEAST_OUT_PX`` each, ``values`` (T,) px differ from the
    median of their neighbours."""
    near = [np.median(values[max(0, k - NEIGHBOURS) : k + NEIGHBOURS + 1]) for k in range(len(values))]
    off = values - np.array(near)
    return off / max(float(robust_deviation(off)), LEAST_OUT_PX)


def repeats_after(edges: Array) -> float:
    """Return the angle in rad about z after which the outline of a box with ``edges`` (3,) repeats."""
    return math.pi / 2 if abs(math.log(edges[0] / edges[1])) < 0.02 else math.pi


def unwrapped(turns: Array, cycle: float) -> Array:
    """Return ``turns`` (T,) rad, known but for multiples of ``cycle``, as a continuous motion: each near the one that
    the rate so far leads to."""
    out = np.array(turns, dtype=np.float64)
    for k in range(1, len(out)):
        near = slice(max(0, k - 4), k)
        rate = float(np.diff(out[near]).mean()) if k > 1 else 0.0
        ahead = out[k - 1] + rate
        out[k] = ahead + (out[k] - ahead + cycle / 2) % cycle - cycle / 2
    return out


def supports(outlines: Sequence[Array]) -> Array:
    """Return (T, DIRECTIONS) px: how far each outline reaches in each direction."""
    ways = _directions()
    return np.stack([(outline @ ways.T).max(axis=0) for outline in outlines])


def corners(edges: Array) -> Array:
    """Return the corners (8, 3) of a box about its centre."""
    return np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * edges


def _directions() -> Array:
    angles = np.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _camera(numbers: Array, picture: tuple[int, int]) -> GroundCamera:
    """Return the camera of (log of the focal length in px, pitch, roll, log of the height in m)."""
    return GroundCamera(
        focal=float(np.exp(numbers[0])), middle=(picture[0] / 2, picture[1] / 2), pitch=float(numbers[1]),
        roll=float(numbers[2]), height=float(np.exp(numbers[3])),
    )  # fmt: skip


def _reach(camera: Array, states: Array, edges: Array, picture: tuple[int, int]) -> Array:
    """Return (T, DIRECTIONS) px: how far boxes with ``states`` (T, 4: x, y, turn, growth in px) reach."""
    c, s = np.cos(states[:, 2])[:, None], np.sin(states[:, 2])[:, None]
    local = corners(edges)
    x = states[:, :1] + c * local[:, 0] - s * local[:, 1]
    y = states[:, 1:2] + s * local[:, 0] + c * local[:, 1]
    z = np.broadcast_to(local[:, 2] + edges[2] / 2, x.shape)
    seen = _camera(camera, picture).pixels(np.stack([x, y, z], axis=-1))
    return np.asarray(np.nan_to_num((seen @ _directions().T).max(axis=1), nan=1e5) + states[:, 3:])


def _prior(picture: tuple[int, int]) -> tuple[Array, Array]:
    """Return the camera's expected numbers and their precisions."""
    expected = np.array([math.log(USUAL_FOCAL * max(picture)), 0.0, 0.0, 0.0])
    return expected, np.array([1 / FOCAL_SPREAD, 0.0, 1 / ROLL_SPREAD, 0.0])


def _damped_step(
    a: Array, b: Array, d: Array, g: Array, h: Array, damping: float, *, fixed: bool
) -> tuple[Array, Array]:
    """Steps of camera (4,), 0 if ``fixed``, and states (T, 4) from the normal equations: a (4, 4) of the camera, b
    (T, 4, 4) that couples it to the states, d (T, 4, 4) of those; right sides g (4,) and h (T, 4)."""
    lifted = d + damping * np.einsum("tii->ti", d)[:, :, None] * np.eye(4) + 1e-9 * np.eye(4)
    inverse = np.linalg.inv(lifted)
    if fixed:
        step = np.zeros(4)
    else:
        left = a + damping * np.diag(np.diag(a)) - np.einsum("tik,tkl,tjl->ij", b, inverse, b)
        step = np.linalg.lstsq(left, g - np.einsum("tik,tkl,tl->i", b, inverse, h), rcond=None)[0]
        step = np.clip(step, -0.3, 0.3)
    return step, np.einsum("tkl,tl->tk", inverse, h - np.einsum("tik,i->tk", b, step))


def _refine(
    support: Array,
    camera: Array,
    states: Array,
    edges: Array,
    picture: tuple[int, int],
    *,
    steps: int = 30,
    fixed: bool = False,
) -> tuple[Array, Array, Array]:
    """Return camera (4,), states (T, 4) and the residual of each frame in px, by Levenberg and Marquardt's method with
    Cauchy's weights; ``fixed`` keeps the camera. Frames depend on each other through the camera alone, so that their
    own numbers are eliminated frame by frame (Schur's complement)."""
    expected, precise = _prior(picture)
    count = len(support)
    damping = 1e-3
    scale = np.r_[0.02, 0.02, 0.02, 0.02, 1e-3 * edges.max(), 1e-3 * edges.max(), 0.01, 0.1]

    def residuals(cam: Array, sta: Array) -> Array:
        return support - _reach(cam, sta, edges, picture)

    def cost(cam: Array, sta: Array, off: Array, width: float) -> float:
        robust = width**2 * np.log1p((off / width) ** 2).sum() / EDGE_PX**2
        return float(
            robust + (((cam - expected) * precise) ** 2).sum() + (((sta[:, 3] - GROWN_PX) / GROWN_SPREAD) ** 2).sum()
        )

    off = residuals(camera, states)
    width = 3 * EDGE_PX
    for _ in range(steps):
        width = max(3 * EDGE_PX, 2 * float(np.median(np.abs(off))))
        weights = 1 / (1 + (off / width) ** 2) / EDGE_PX**2
        by_camera = np.stack(
            [(off - residuals(camera + scale[i] * np.eye(4)[i] * 0.01, states)) / (scale[i] * 0.01) for i in range(4)],
            axis=-1,
        )
        by_state = np.stack(
            [(off - residuals(camera, states + scale[4 + i] * np.eye(4)[i])) / scale[4 + i] for i in range(4)], axis=-1
        )
        a = np.einsum("tji,tj,tjk->ik", by_camera, weights, by_camera) + np.diag(precise**2)
        b = np.einsum("tji,tj,tjk->tik", by_camera, weights, by_state)
        d = np.einsum("tji,tj,tjk->tik", by_state, weights, by_state)
        d[:, 3, 3] += 1 / GROWN_SPREAD**2
        g = np.einsum("tji,tj,tj->i", by_camera, weights, off) - precise**2 * (camera - expected)
        h = np.einsum("tji,tj,tj->ti", by_state, weights, off)
        h[:, 3] -= (states[:, 3] - GROWN_PX) / GROWN_SPREAD**2
        now = cost(camera, states, off, width)
        better = False
        while damping < 1e8:
            step, own = _damped_step(a, b, d, g, h, damping, fixed=fixed)
            tried = camera + step, states + own
            new = residuals(*tried)
            if 0.05 < tried[0][1] < 1.6 and cost(*tried, new, width) < now:
                better = True
                break
            damping *= 4
        if not better:
            break
        gained = now - cost(*tried, new, width)
        (camera, states), off, damping = tried, new, max(damping / 6, 1e-9)
        if gained < 1e-5 * count:
            break
    return camera, states, np.quantile(np.abs(off), POOR_AT, axis=1)


def _first_camera(support: Array, edges: Array, picture: tuple[int, int]) -> Array:
    """Return the camera's numbers (4,) that fit a few frames; the best of several starts."""
    few = np.unique(np.linspace(0, len(support) - 1, STARTS).round().astype(int))
    part = support[few]
    middles = _middles(part)
    wide = float(np.median(part[:, 0] + part[:, DIRECTIONS // 2]))
    focal = USUAL_FOCAL * max(picture)
    far = focal * float(np.hypot(edges[0], edges[1])) / max(wide, 1.0)
    cycle = repeats_after(edges)
    best: tuple[float, Array] | None = None
    for pitch in PITCHES:
        camera = np.array([math.log(focal), pitch, 0.0, math.log(far * math.sin(pitch) + edges[2] / 2)])
        places = _camera(camera, picture).ground(middles, float(edges[2] / 2))[:, :2]
        chosen = _best_turn(part, camera, places, edges, picture, np.arange(YAWS) * cycle / YAWS)
        found, states, misses = _refine(part, camera, chosen, edges, picture)
        # A frame that has settled in a wrong turn is started again with the camera that the others have found.
        again = _best_turn(part, found, states[:, :2], edges, picture, np.arange(YAWS) * cycle / YAWS)
        found, states, misses = _refine(part, found, again, edges, picture)
        if best is None or float(misses.mean()) < best[0]:
            best = float(misses.mean()), found
    assert best is not None
    return best[1]


def _best_turn(
    support: Array, camera: Array, places: Array, edges: Array, picture: tuple[int, int], turns: Array
) -> Array:
    """Return each frame's state (T, 4) that fits best, of those started at ``turns`` (N,) with the camera kept."""
    best = np.zeros((len(support), 4))
    least = np.full(len(support), np.inf)
    for turn in turns:
        states = np.column_stack([places, np.full(len(places), turn), np.full(len(places), GROWN_PX)])
        _, states, misses = _refine(support, camera, states, edges, picture, steps=12, fixed=True)
        better = misses < least
        best[better], least[better] = states[better], misses[better]
    return best


def _middles(support: Array) -> Array:
    """Return (T, 2) px: the middles of the outlines' bounding boxes."""
    half = DIRECTIONS // 2
    across, down = support[:, 0] - support[:, half], support[:, half // 2] - support[:, half // 2 + half]
    return np.stack([across, down], axis=1) / 2
