# SPDX-License-Identifier: GPL-3.0-or-later
"""Things whose surface is known all around: a plush toy, a mug, a chair, a dog, a carton.

Each has marks on its front that its back has not (eyes, logo, sticker, spot, label), and what goes on around it
(ribbon, rings, grain, saddle, tape). Meshes are fine enough that a colour per vertex shows its fur. The front looks
along -y.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh import Trimesh

from .shapes import Body, block, ellipsoid, half_ring, revolved

Points = NDArray[np.float64]
Colour = tuple[float, float, float]
Painter = Callable[[Points], Points]
"""Places (V, 3) of a part's vertices to their linear albedo (V, 3)."""
Painted = tuple[Trimesh, Painter]

KINDS = ("plush", "mug", "chair", "dog", "carton")
EDGE = 0.015
"""Longest edge of a painted mesh, in sizes of the thing."""
WAVES = 28


def make_painted(kind: str, size: float) -> Body:
    """A body of ``kind`` that stands on the origin; ``size``: its largest extent along an axis, metres."""
    return painted_body(_MAKERS[kind](), size, smooth=kind not in ("chair", "carton"))


def painted_body(painted: Sequence[Painted], size: float, *, smooth: bool) -> Body:
    """The body of ``painted`` parts that stands on the origin; ``size``: its largest extent along an axis, metres.

    smooth: whether its surface is shaded round.
    """
    parts = [(fine(part), painter) for part, painter in painted]
    colours = np.concatenate([np.clip(painter(np.asarray(part.vertices)), 0.01, 0.9) for part, painter in parts])
    low = np.min([part.bounds[0] for part, _ in parts], axis=0)
    high = np.max([part.bounds[1] for part, _ in parts], axis=0)
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    for part, _ in parts:
        part.apply_translation(-middle)
        part.apply_scale(size / float((high - low).max()))
        if part.volume < 0:
            part.invert()
    return Body(
        parts=tuple((part, 0) for part, _ in parts),
        volume=None,
        smooth=smooth,
        colours=colours,
    )


def fine(part: Trimesh) -> Trimesh:
    """``part`` with no edge longer than ``EDGE``."""
    vertices, faces = trimesh.remesh.subdivide_to_size(part.vertices, part.faces, EDGE, max_iter=12)
    merged = Trimesh(vertices, faces, process=False)
    merged.merge_vertices()
    return merged


def noise(places: Points, wavelength: float, seed: int) -> Points:
    """(V,) smooth noise of mean 0 and variance 1: a sum of waves of random directions."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(WAVES, 3))
    directions *= (2 * np.pi / wavelength * rng.uniform(0.7, 1.4, WAVES) / np.linalg.norm(directions, axis=1))[:, None]
    phases = rng.uniform(0, 2 * np.pi, WAVES)
    return np.asarray(np.cos(places @ directions.T + phases).sum(axis=1) * np.sqrt(2.0 / WAVES))


def fur(base: Colour, seed: int = 1, strength: float = 0.2) -> Painter:
    """Tufts of two sizes in brighter and darker tones of ``base``."""

    def paint(places: Points) -> Points:
        tone = strength * noise(places, 0.035, seed) + 0.5 * strength * noise(places, 0.13, seed + 50)
        return np.array(base) * np.exp(tone)[:, None]

    return paint


def plain(base: Colour) -> Painter:
    """One colour, a little uneven."""
    return fur(base, seed=7, strength=0.03)


def where(chosen: Callable[[Points], NDArray[np.bool_]], painter: Painter, other: Painter) -> Painter:
    """``painter`` where ``chosen``, else ``other``."""

    def paint(places: Points) -> Points:
        return np.where(chosen(places)[:, None], painter(places), other(places))

    return paint


def within(centre: Colour, radius: float) -> Callable[[Points], NDArray[np.bool_]]:
    """Places at most ``radius`` from ``centre``."""
    return lambda places: np.linalg.norm(places - centre, axis=1) < radius


def ring(centre: Colour, radius: float, thick: float, flat: float = 1.0) -> Trimesh:
    """A level torus; ``flat``: its width along y over that along x."""
    body = trimesh.creation.torus(major_radius=radius, minor_radius=thick, major_sections=96, minor_sections=20)
    body.apply_scale((1.0, flat, 1.0))
    body.apply_translation(centre)
    return body


def _plush() -> list[Painted]:
    brown, cream, black, red = (0.34, 0.19, 0.09), (0.55, 0.42, 0.28), (0.015, 0.013, 0.012), (0.5, 0.03, 0.04)
    coat, pale, dark, silk = fur(brown), fur(cream, seed=3), plain(black), plain(red)
    mouth = where(lambda p: (np.abs(p[:, 0]) < 0.008) & (p[:, 2] < 0.63) & (p[:, 1] < -0.2), dark, pale)
    parts: list[Painted] = [
        (ellipsoid((0, 0, 0.3), (0.25, 0.21, 0.3)), where(within((0, -0.21, 0.27), 0.15), pale, coat)),
        (ellipsoid((0, -0.02, 0.7), (0.225, 0.2, 0.2)), coat),
        (ellipsoid((0, -0.2, 0.65), (0.095, 0.075, 0.068)), mouth),
        (ellipsoid((0, -0.268, 0.675), (0.034, 0.02, 0.024)), dark),
        (ring((0, -0.01, 0.535), 0.15, 0.032, 0.9), silk),
        (ellipsoid((0, -0.2, 0.53), (0.03, 0.03, 0.03)), silk),
    ]
    for side in (-1.0, 1.0):
        inner = where(within((side * 0.17, -0.05, 0.885), 0.05), pale, coat)
        pad = where(within((side * 0.17, -0.42, 0.1), 0.07), pale, coat)
        parts += [
            (ellipsoid((side * 0.17, 0.0, 0.875), (0.085, 0.05, 0.085)), inner),
            (ellipsoid((side * 0.29, -0.08, 0.36), (0.085, 0.09, 0.17)), coat),
            (ellipsoid((side * 0.17, -0.24, 0.085), (0.095, 0.18, 0.085)), pad),
            (ellipsoid((side * 0.085, -0.187, 0.75), (0.03, 0.02, 0.032)), dark),
            (ellipsoid((side * 0.09, -0.21, 0.53), (0.075, 0.03, 0.05)), silk),
        ]
    return parts


def _mug() -> list[Painted]:
    radius, wall, height = 0.4, 0.035, 1.0
    # As fine as it has to be, since splitting long slivers makes many more.
    up, inner = np.linspace(0.0, height, 101), radius - wall
    outer, out = [(radius, float(z)) for z in up], [float(r) for r in np.linspace(0.0, inner, 37)]
    within_wall = [(inner, z) for _, z in outer[:3:-1]]
    profile = [*((r, 0.0) for r in out), *outer, *within_wall, *((r, wall) for r in out[::-1])]
    glaze, blue, orange = plain((0.72, 0.69, 0.6)), plain((0.04, 0.12, 0.33)), plain((0.75, 0.22, 0.03))

    def logo(places: Points) -> NDArray[np.bool_]:
        x, z = places[:, 0], places[:, 2] - 0.5
        return (np.hypot(x, z) < 0.2) & (places[:, 1] < -0.2)

    def star(places: Points) -> NDArray[np.bool_]:
        x, z = places[:, 0], places[:, 2] - 0.5
        reach = 0.1 * (1.0 + 0.45 * np.cos(5 * np.arctan2(x, z)))
        return (np.hypot(x, z) < reach) & (places[:, 1] < -0.2)

    def rings(places: Points) -> NDArray[np.bool_]:
        z = places[:, 2]
        return (np.hypot(places[:, 0], places[:, 1]) > radius - 0.01) & ((np.abs(z - 0.1) < 0.04) | (z > 0.93))

    handle = half_ring(0.22, 0.3, 0.055)
    handle.apply_translation((radius - wall / 2, 0.0, 0.5))
    return [
        (revolved(profile, sections=256), where(star, glaze, where(logo, orange, where(rings, blue, glaze)))),
        (handle, glaze),
    ]


def _chair() -> list[Painted]:
    def wood(places: Points) -> Points:
        grain = noise(places * (6.0, 6.0, 0.8), 0.12, 11)
        return np.array((0.3, 0.16, 0.07)) * np.exp(0.25 * grain + 0.08 * noise(places, 0.03, 12))[:, None]

    def heart(places: Points) -> NDArray[np.bool_]:
        x, z = places[:, 0] / 0.085, (places[:, 2] - 0.86) / 0.075
        return ((x**2 + z**2 - 1) ** 3 - x**2 * z**3 < 0) & (places[:, 1] < 0.195)

    board = where(heart, plain((0.55, 0.02, 0.03)), wood)
    x, y, seat, leg = 0.24, 0.23, 0.46, 0.05
    parts: list[Painted] = [(block((-x, -y, seat - 0.045), (x, y, seat)), wood)]
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * x, side * (x - leg)))
        parts.append((block((inner, -y, 0.0), (outer, -y + leg, seat - 0.045)), wood))
        parts.append((block((inner, y - leg, 0.0), (outer, y, 1.0)), wood))
    for low, high in ((0.6, 0.68), (0.76, 0.96)):
        parts.append((block((-x + leg, y - 0.04, low), (x - leg, y - 0.01, high)), board))
    return parts


def _dog() -> list[Painted]:
    white, dark, black, red = (
        fur((0.6, 0.53, 0.43), seed=21),
        fur((0.16, 0.08, 0.04), seed=22),
        (0.015,) * 3,
        (0.5, 0.03, 0.03),
    )
    ink, leather = plain(black), plain(red)

    def saddle(places: Points) -> NDArray[np.bool_]:
        return places[:, 2] > 0.5 + 0.05 * np.sin(14 * places[:, 0]) + 0.35 * np.maximum(0, np.abs(places[:, 0]) - 0.2)

    spot = where(within((0.07, -0.17, 0.43), 0.06), dark, where(saddle, dark, white))
    collar = ring((0, 0, 0), 0.105, 0.022)
    collar.apply_transform(trimesh.transformations.rotation_matrix(0.6, (0, 1, 0)))
    collar.apply_translation((0.36, 0.0, 0.63))
    neck = ellipsoid((0, 0, 0), (0.1, 0.1, 0.2))
    neck.apply_transform(trimesh.transformations.rotation_matrix(0.6, (0, 1, 0)))
    neck.apply_translation((0.35, 0.0, 0.62))
    tail = ellipsoid((0, 0, 0), (0.035, 0.035, 0.17))
    tail.apply_transform(trimesh.transformations.rotation_matrix(-0.7, (0, 1, 0)))
    tail.apply_translation((-0.44, 0.0, 0.6))
    parts: list[Painted] = [
        (ellipsoid((0, 0, 0.45), (0.38, 0.16, 0.17)), spot),
        (neck, white),
        (collar, leather),
        (tail, dark),
        (ellipsoid((0.44, 0, 0.79), (0.14, 0.115, 0.12)), white),
        (ellipsoid((0.57, 0, 0.755), (0.1, 0.065, 0.06)), white),
        (ellipsoid((0.66, 0, 0.775), (0.026, 0.032, 0.026)), ink),
    ]
    for side in (-1.0, 1.0):
        parts += [
            (ellipsoid((0.39, side * 0.1, 0.83), (0.065, 0.03, 0.1)), dark),
            (ellipsoid((0.505, side * 0.088, 0.82), (0.022, 0.02, 0.022)), ink),
            (ellipsoid((0.25, side * 0.09, 0.2), (0.058, 0.055, 0.2)), white),
            (ellipsoid((-0.26, side * 0.09, 0.2), (0.065, 0.055, 0.2)), white),
        ]
    return parts


def _carton() -> list[Painted]:
    board, tape = fur((0.33, 0.2, 0.1), seed=31, strength=0.06), plain((0.5, 0.4, 0.24))
    paper, ink, red = plain((0.75, 0.75, 0.72)), plain((0.02, 0.02, 0.025)), plain((0.55, 0.03, 0.03))

    def front(places: Points, x0: float, x1: float, z0: float, z1: float) -> NDArray[np.bool_]:
        x, z = places[:, 0], places[:, 2]
        return (places[:, 1] < -0.299) & (x > x0) & (x < x1) & (z > z0) & (z < z1)

    def letters(places: Points) -> NDArray[np.bool_]:
        rows = (places[:, 2] * 18) % 1.0 < 0.5
        at = np.stack([places[:, 0], np.zeros(len(places)), np.floor(places[:, 2] * 18)], axis=1)
        gaps = noise(at, 0.08, 33) > -0.3
        return front(places, -0.38, -0.1, 0.32, 0.56) & rows & gaps

    def arrow(places: Points) -> NDArray[np.bool_]:
        x, z = np.abs(places[:, 0] - 0.28), places[:, 2]
        head = (z > 0.4) & (x < 0.5 - z)
        return front(places, 0.1, 0.45, 0.12, 0.52) & (((x < 0.03) & (z < 0.42)) | head)

    def taped(places: Points) -> NDArray[np.bool_]:
        return (np.abs(places[:, 0]) < 0.05) & ((places[:, 2] > 0.46) | (places[:, 2] < 0.001))

    painted = where(letters, ink, where(lambda p: front(p, -0.42, -0.07, 0.28, 0.58), paper, where(arrow, red, board)))
    return [(block((-0.5, -0.3, 0.0), (0.5, 0.3, 0.64)), where(taped, tape, painted))]


_MAKERS: dict[str, Callable[[], list[Painted]]] = {
    "plush": _plush,
    "mug": _mug,
    "chair": _chair,
    "dog": _dog,
    "carton": _carton,
}
