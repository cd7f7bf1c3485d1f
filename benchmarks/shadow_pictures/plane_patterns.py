# SPDX-License-Identifier: GPL-3.0-or-later
"""Patterns of grounds and walls, drawn by chance: from plain paint to tiles, prints, carpets and stones.

Brightness, cells, grain and stains vary more than in the benchmark's pictures, whose patterns are Blender's.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

TONES = 997
"""Different tones of tiles and boards."""


def albedo(shape: tuple[int, int], unit: float, rng: np.random.Generator, kind: str | None = None) -> Picture:
    """Return the linear albedo (H, W, 3) of a plane.

    unit: pixels of a thing's size. kind: of ``KINDS``; by chance if None.
    """
    kind = kind or str(rng.choice(KINDS))
    bright, dark = _two_colours(rng)
    turn = rng.uniform(0, math.pi)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    u, v = math.cos(turn) * x + math.sin(turn) * y, -math.sin(turn) * x + math.cos(turn) * y
    cell = unit * float(np.exp(rng.uniform(math.log(0.12), math.log(1.2))))
    grain = rng.uniform(0.005, 0.06) * clouds(shape, max(2.0, unit * rng.uniform(0.02, 0.2)), rng, 3)
    mix, more = _DRAWN[kind](u, v, cell, unit, rng)
    mix = np.clip(mix, 0, 1)[..., None]
    logs = grain + more + _stains(x, y, unit, rng)
    return np.clip((bright * (1 - mix) + dark * mix) * np.exp(logs)[..., None], 0.01, 0.95).astype(np.float32)


def clouds(
    shape: tuple[int, int], cell: float, rng: np.random.Generator, octaves: int = 5, gain: float = 0.55
) -> Picture:
    """Return noise (H, W) of deviation about 1: octaves from ``cell`` pixels down, each ``gain`` times the last."""
    total, amplitude, result = 0.0, 1.0, np.zeros(shape, np.float32)
    for _ in range(octaves):
        if cell < 1.0:
            break
        rows, columns = (max(2, math.ceil(side / cell)) + 3 for side in shape)
        coarse = rng.normal(size=(rows, columns)).astype(np.float32)
        size = (int(columns * cell) + 1, int(rows * cell) + 1)
        result += amplitude * cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)[: shape[0], : shape[1]]
        total, amplitude, cell = total + amplitude * amplitude, amplitude * gain, cell / 2
    return result / max(math.sqrt(total), 1e-6)


def _two_colours(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    def tint(hue: float) -> NDArray[np.float64]:
        return np.array([math.cos(hue), math.cos(hue - 2.1), math.cos(hue + 2.1)])

    hue, chroma = rng.uniform(0, 6.28), rng.uniform(0, 0.3)
    bright = np.exp(rng.uniform(math.log(0.12), math.log(0.75))) * (1 + chroma * tint(hue))
    hue, chroma = rng.uniform(0, 6.28), rng.uniform(0, 0.5)
    return bright, bright * rng.uniform(0.1, 0.85) * (1 + chroma * rng.choice([0.1, 0.4, 1.0]) * tint(hue))


def _stains(x: Picture, y: Picture, unit: float, rng: np.random.Generator) -> Picture:
    """Log brightness (H, W) of a few soft or sharp stains, mostly dark: they are no shadows."""
    height, width = x.shape
    stains = np.zeros(x.shape, np.float32)
    for _ in range(int(rng.integers(0, 5)) if rng.random() < 0.4 else 0):
        middle, size = rng.uniform(0, 1, 2) * (width, height), unit * rng.uniform(0.1, 0.8)
        tall = size * rng.uniform(0.5, 1.5)
        spot = np.exp(-0.5 * (((x - middle[0]) / size) ** 2 + ((y - middle[1]) / tall) ** 2))
        if rng.random() < 0.3:
            spot = (spot > 0.6).astype(np.float32)
        stains += rng.uniform(-0.7, 0.25) * spot
    return stains


Drawn = Callable[[Picture, Picture, float, float, np.random.Generator], tuple[Picture, Picture]]
"""Of the pattern's own axes u and v (H, W), pixels of a cell and of a thing, and chance: the share (H, W) of the second
colour, and a change of log brightness (H, W)."""


def _plain(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    return np.zeros_like(u), np.zeros_like(u)


def _cloudy(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    return 0.5 + rng.uniform(0.15, 0.6) * clouds(u.shape, cell, rng), np.zeros_like(u)


def _marble(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    bent = clouds(u.shape, cell * 2, rng)
    return (0.5 + 0.5 * np.sin(u / cell * 2 + 3.0 * bent)) ** rng.uniform(1, 5), np.zeros_like(u)


def _tiles(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    joint = rng.uniform(0.02, 0.06)
    joints = ((u / cell) % 1 < joint) | ((v / cell) % 1 < joint)
    tile = (np.floor(u / cell) * 7919 + np.floor(v / cell) * 104729).astype(np.int64) % TONES
    return joints.astype(np.float32), rng.uniform(0, 0.12) * rng.normal(size=TONES).astype(np.float32)[tile]


def _boards(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    joint = rng.uniform(0.01, 0.04)
    row = np.floor(u / cell).astype(np.int64)
    along = v / (cell * 7) + rng.uniform(0, 1, TONES)[row % TONES]
    joints = ((u / cell) % 1 < joint) | (along % 1 < joint / 7)
    board = (row * 7919 + np.floor(along).astype(np.int64) * 104729) % TONES
    height, width = u.shape
    if rng.random() < 0.5:
        # Grain along the boards.
        fine = clouds(u.shape, max(2.0, cell * 0.25), rng)
        grain = cv2.remap(
            fine, (u * 0.06 % width).astype(np.float32), (v % height).astype(np.float32), cv2.INTER_LINEAR
        )
    else:
        grain = clouds(u.shape, cell * 0.5, rng)
    tones = rng.uniform(0.02, 0.12) * rng.normal(size=TONES).astype(np.float32)[board]
    return joints.astype(np.float32), tones + rng.uniform(0.02, 0.1) * grain


def _checks(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    return ((np.floor(u / cell) + np.floor(v / cell)) % 2).astype(np.float32), np.zeros_like(u)


def _stripes(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    return ((u / cell) % 1 < rng.uniform(0.2, 0.8)).astype(np.float32), np.zeros_like(u)


def _dots(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    radius = rng.uniform(0.15, 0.4)
    x, y = (u / cell) % 1 - 0.5, (v / cell) % 1 - 0.5
    return (x * x + y * y < radius * radius).astype(np.float32), np.zeros_like(u)


def _prints(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    height, width = u.shape
    mix = np.zeros(u.shape, np.float32)
    for _ in range(int(rng.integers(6, 90))):
        middle = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        size = unit * rng.uniform(0.05, 0.5)
        if rng.random() < 0.5:
            axes = (max(1, int(size)), max(1, int(size * rng.uniform(0.2, 1))))
            turn = rng.uniform(0, 180)
            cv2.ellipse(mix, middle, axes, turn, 0, 360, float(rng.uniform(0.3, 1)), -1, cv2.LINE_AA)
        else:
            corners = np.array(middle) + rng.normal(size=(int(rng.integers(3, 7)), 2)) * size
            cv2.fillPoly(mix, [corners.astype(np.int32)], float(rng.uniform(0.3, 1)))
    return mix, np.zeros_like(u)


def _carpet(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    return np.zeros_like(u), rng.uniform(0.1, 0.4) * clouds(u.shape, max(2.0, unit * 0.05), rng, 3)


def _concrete(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    return np.zeros_like(u), rng.uniform(0.04, 0.15) * clouds(u.shape, unit * rng.uniform(0.5, 2), rng, 7, 0.65)


def _patches(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    some = (clouds(u.shape, cell, rng, 4) > rng.uniform(-0.5, 0.8)).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(some, (0, 0), rng.uniform(0.3, 0.1 * cell + 0.5))), np.zeros_like(u)


def _weave(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    thread = max(3.0, unit * rng.uniform(0.02, 0.06))
    return 0.5 + 0.25 * np.sin(u * 6.28 / thread) + 0.25 * np.sin(v * 6.28 / thread), np.zeros_like(u)


def _stones(u: Picture, v: Picture, cell: float, unit: float, rng: np.random.Generator) -> tuple[Picture, Picture]:
    height, width = u.shape
    middles = rng.uniform(0, 1, (int(max(20, min(3000, height * width / cell**2))), 2)) * (height, width)
    free = np.ones(u.shape, np.uint8)
    free[middles[:, 0].astype(int).clip(0, height - 1), middles[:, 1].astype(int).clip(0, width - 1)] = 0
    far, stone = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    tones = rng.uniform(0.05, 0.35) * rng.normal(size=stone.max() + 1).astype(np.float32)[stone]
    return np.zeros_like(u), tones - rng.uniform(0, 0.5) * (far / max(far.max(), 1)) ** 2


_DRAWN: dict[str, Drawn] = {
    "plain": _plain,
    "fbm": _cloudy,
    "marble": _marble,
    "tiles": _tiles,
    "boards": _boards,
    "checks": _checks,
    "stripes": _stripes,
    "dots": _dots,
    "prints": _prints,
    "carpet": _carpet,
    "concrete": _concrete,
    "patches": _patches,
    "weave": _weave,
    "stones": _stones,
}
KINDS = tuple(_DRAWN)
