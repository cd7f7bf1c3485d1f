# SPDX-License-Identifier: GPL-3.0-or-later
"""Things with holes and thin parts: a chair with slats, wire glasses, a bicycle, a plant, a ball of fur; and things of
their ground's tone: a book with a white spine on a pale table, a dark box on dark cloth."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh import Trimesh

from .shapes import Body, Parts, block, ellipsoid, revolved

KINDS = ("slats", "glasses", "bicycle", "plant", "fur", "pale", "dark")
Place = tuple[float, float, float]


def make_thin(kind: str, size: float, rng: np.random.Generator) -> Body:
    """A body of ``kind`` that stands on the origin; ``size``: its largest extent along an axis, metres."""
    parts = _MAKERS[kind](rng)
    low = np.min([part.bounds[0] for part, _ in parts], axis=0)
    high = np.max([part.bounds[1] for part, _ in parts], axis=0)
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    for part, _ in parts:
        part.apply_translation(-middle)
        part.apply_scale(size / float((high - low).max()))
    return Body(parts=tuple(parts), volume=None, smooth=kind in ("glasses", "bicycle", "plant"))


def rod(start: Place, end: Place, radius: float, sections: int = 10) -> Trimesh:
    """A round rod between two places."""
    return trimesh.creation.cylinder(radius=radius, segment=np.array([start, end]), sections=sections)


def hoop(centre: Place, radius: float, thick: float) -> Trimesh:
    """An upright ring in the plane of x and z."""
    body = trimesh.creation.torus(major_radius=radius, minor_radius=thick, major_sections=64, minor_sections=10)
    body.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    body.apply_translation(centre)
    return body


def _slats(rng: np.random.Generator) -> Parts:
    x, y, seat, leg = 0.22, 0.21, 0.46, 0.035
    parts: Parts = [(block((-x, -y, seat - 0.03), (x, y, seat)), 0)]
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * x, side * (x - leg)))
        parts.append((block((inner, -y, 0.0), (outer, -y + leg, seat - 0.03)), 0))
        parts.append((block((inner, y - leg, 0.0), (outer, y, 1.0)), 0))
    parts.append((block((-x, y - leg, 0.93), (x, y, 1.0)), 0))
    for step in np.linspace(-x + 0.08, x - 0.08, 5):
        parts.append((block((step - 0.012, y - 0.03, seat), (step + 0.012, y - 0.01, 0.94)), 0))
    parts.append((block((-x, -y + 0.005, 0.2), (x, -y + 0.025, 0.23)), 0))
    return parts


def _glasses(rng: np.random.Generator) -> Parts:
    parts: Parts = []
    for side in (-1.0, 1.0):
        parts.append((hoop((side * 0.27, 0.0, 0.2), 0.19, 0.014), 0))
        parts.append((rod((side * 0.46, 0.0, 0.25), (side * 0.5, 0.02, 0.26), 0.014), 0))
        parts.append((rod((side * 0.5, 0.02, 0.26), (side * 0.47, 0.75, 0.2), 0.013), 0))
        parts.append((rod((side * 0.47, 0.75, 0.2), (side * 0.46, 0.95, 0.02), 0.013), 0))
    parts.append((rod((-0.09, 0.0, 0.25), (0.09, 0.0, 0.25), 0.013), 0))
    return parts


def _bicycle(rng: np.random.Generator) -> Parts:
    parts: Parts = []
    for x in (-0.5, 0.5):
        parts.append((hoop((x, 0.0, 0.31), 0.29, 0.018), 1))
        parts.append((hoop((x, 0.0, 0.31), 0.265, 0.008), 0))
        for angle in np.linspace(0.0, 2 * np.pi, 12, endpoint=False):
            end = (x + 0.27 * float(np.cos(angle)), 0.0, 0.31 + 0.27 * float(np.sin(angle)))
            parts.append((rod((x, 0.0, 0.31), end, 0.003, 6), 0))
    crank, seat, head = (-0.06, 0.0, 0.28), (-0.2, 0.0, 0.75), (0.36, 0.0, 0.72)
    for a, b in ((crank, seat), (seat, head), (crank, head), ((-0.5, 0.0, 0.31), crank), ((-0.5, 0.0, 0.31), seat)):
        parts.append((rod(a, b, 0.017), 0))
    parts.append((rod((0.34, 0.0, 0.82), (0.5, 0.0, 0.31), 0.015), 0))
    parts.append((rod((0.34, -0.2, 0.86), (0.34, 0.2, 0.86), 0.013), 1))
    parts.append((rod(seat, (-0.23, 0.0, 0.86), 0.013), 0))
    parts.append((ellipsoid((-0.24, 0.0, 0.88), (0.12, 0.06, 0.025)), 1))
    return parts


def _plant(rng: np.random.Generator) -> Parts:
    parts: Parts = [(revolved([(0, 0), (0.13, 0), (0.17, 0.26), (0, 0.26)]), 1)]
    for _ in range(22):
        turn, lean, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.75), rng.uniform(0.35, 0.7)
        tip = np.array([np.cos(turn) * np.sin(lean), np.sin(turn) * np.sin(lean), np.cos(lean)]) * reach + (0, 0, 0.26)
        parts.append((rod((0.0, 0.0, 0.25), (float(tip[0]), float(tip[1]), float(tip[2])), 0.007, 6), 0))
        leaf = ellipsoid((0, 0, 0), (0.085, 0.035, 0.007))
        leaf.apply_transform(trimesh.transformations.euler_matrix(*rng.uniform(0, np.pi, 3)))
        leaf.apply_translation(tip)
        parts.append((leaf, 0))
    return parts


def _fur(rng: np.random.Generator) -> Parts:
    ball = ellipsoid((0, 0, 0.42), (0.38, 0.34, 0.36))
    parts: Parts = [(ball, 0)]
    hairs = 2600
    direction = rng.normal(size=(hairs, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    roots = direction * (0.37, 0.33, 0.35) + (0, 0, 0.42)
    tips = roots + direction * rng.uniform(0.05, 0.13, (hairs, 1)) + (0, 0, -0.03)
    tips[:, 2] = np.maximum(tips[:, 2], 0.01)
    side = np.cross(direction, (0.3, 0.5, 0.8))
    side *= 0.004 / np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(direction, side)
    corners = np.stack([roots + side, roots - 0.5 * side + up, roots - 0.5 * side - up, tips], axis=1).reshape(-1, 3)
    faces = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]])
    strands = (4 * np.arange(hairs)[:, None, None] + faces).reshape(-1, 3)
    parts.append((Trimesh(corners, strands, process=False), 0))
    return parts


def _pale(rng: np.random.Generator) -> Parts:
    # A standing book: a dark cover, and a spine of the table's tone beside it.
    return [(block((-0.26, -0.06, 0.0), (0.36, 0.06, 1.0)), 0), (block((-0.37, -0.062, 0.0), (-0.26, 0.062, 1.0)), 1)]


def _dark(rng: np.random.Generator) -> Parts:
    return [(block((-0.4, -0.25, 0.0), (0.4, 0.25, 0.55)), 0), (rod((0.1, 0.0, 0.5), (0.1, 0.0, 0.8), 0.1, 40), 1)]


_MAKERS = {
    "slats": _slats,
    "glasses": _glasses,
    "bicycle": _bicycle,
    "plant": _plant,
    "fur": _fur,
    "pale": _pale,
    "dark": _dark,
}
