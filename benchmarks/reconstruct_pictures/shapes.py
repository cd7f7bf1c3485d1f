# SPDX-License-Identifier: GPL-3.0-or-later
"""Things that stand on a table: triangle meshes whose size and volume are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh import Trimesh

KINDS = ("box", "cylinder", "sphere", "mug", "bottle", "cone", "toy", "book", "bowl", "chair")
PLAIN_SOLIDS = ("box", "cylinder", "sphere")
"""Kinds whose volume the benchmark judges."""


@dataclass(frozen=True, eq=False)
class Body:
    """A thing that stands on the origin, Z up, metres.

    parts: closed meshes and the paint of each (0 or 1). volume: cubic metres, None for what is hollow or has
    parts that overlap. smooth: whether its surface is shaded round. colours: (V, 3) linear albedo of the vertices of
    ``mesh``, instead of paints.
    """

    parts: tuple[tuple[Trimesh, int], ...]
    volume: float | None
    smooth: bool
    colours: NDArray[np.float64] | None = None

    @property
    def mesh(self) -> Trimesh:
        """All parts as one."""
        return trimesh.util.concatenate([part for part, _ in self.parts])

    @property
    def paints(self) -> NDArray[np.int64]:
        """(T,) the paint of each face of ``mesh``."""
        return np.concatenate([np.full(len(part.faces), paint) for part, paint in self.parts])


def make(kind: str, size: float, rng: np.random.Generator) -> Body:
    """A body of ``kind``, of proportions drawn from ``rng``, whose largest extent along an axis is ``size``."""
    parts = _MAKERS[kind](rng)
    low = np.min([part.bounds[0] for part, _ in parts], axis=0)
    high = np.max([part.bounds[1] for part, _ in parts], axis=0)
    scale = size / float((high - low).max())
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    for part, _ in parts:
        part.apply_translation(-middle)
        part.apply_scale(scale)
        if part.volume < 0:
            part.invert()
    exact = kind not in ("mug", "toy", "chair", "bowl")
    volume = float(sum(part.volume for part, _ in parts)) if exact else None
    return Body(parts=tuple(parts), volume=volume, smooth=kind not in ("box", "book", "chair"))


Parts = list[tuple[Trimesh, int]]


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Trimesh:
    """An upright box between two corners."""
    return trimesh.creation.box(bounds=np.array([low, high]))


def revolved(profile: list[tuple[float, float]], sections: int = 96) -> Trimesh:
    """A profile of radius and height turned around the z axis."""
    return trimesh.creation.revolve(np.array(profile), sections=sections)


def ellipsoid(centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Trimesh:
    """An upright ellipsoid."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    ball.apply_scale(radii)
    ball.apply_translation(centre)
    return ball


def _box(rng: np.random.Generator) -> Parts:
    x, y, z = rng.uniform(0.5, 1.0, 3)
    return [(block((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z)), 0)]


def _book(rng: np.random.Generator) -> Parts:
    x, y, z = rng.uniform(0.64, 0.78), 1.0, rng.uniform(0.1, 0.2)
    return [(block((-x / 2, -y / 2, 0.0), (x / 2, y / 2, z)), 0)]


def _cylinder(rng: np.random.Generator) -> Parts:
    height, radius = 1.0, rng.uniform(0.25, 0.6)
    return [(revolved([(0, 0), (radius, 0), (radius, height), (0, height)]), 0)]


def _sphere(rng: np.random.Generator) -> Parts:
    return [(trimesh.creation.icosphere(subdivisions=5, radius=0.5), 0)]


def _cone(rng: np.random.Generator) -> Parts:
    base, top = rng.uniform(0.35, 0.55), rng.choice([0.0, 0.15])
    profile = [(0.0, 0.0), (base, 0.0), (top, 1.0), (0.0, 1.0)] if top else [(0.0, 0.0), (base, 0.0), (0.0, 1.0)]
    return [(revolved(profile), 0)]


def _mug(rng: np.random.Generator) -> Parts:
    radius, wall, height = rng.uniform(0.36, 0.46), 0.035, 1.0
    foot = rng.uniform(0.8, 1.0) * radius
    profile = [(0, 0), (foot, 0), (radius, height), (radius - wall, height), (foot - wall, wall), (0, wall)]
    handle = half_ring(0.22, 0.3, 0.055)
    # Its ends lie within the wall, which may lean.
    lean = (radius - foot) / height
    handle.vertices[:, 0] += foot - wall / 2 + lean * (handle.vertices[:, 2] + 0.52)
    handle.vertices[:, 2] += 0.52
    return [(revolved(profile), 0), (handle, 1 if rng.random() < 0.3 else 0)]


def half_ring(reach: float, rise: float, thick: float) -> Trimesh:
    """Half an elliptic ring in the plane y = 0, x from 0 to ``reach``, its ends closed."""
    rings, around = 32, 16
    turn = np.linspace(-np.pi / 2, np.pi / 2, rings)[:, None]
    circle = np.linspace(0.0, 2 * np.pi, around, endpoint=False)[None, :]
    out = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    centre = out * (reach, rise)
    normal = out * (1 / reach, 1 / rise)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    radial = thick * np.cos(circle)
    x = centre[..., 0] + normal[..., 0] * radial
    z = centre[..., 1] + normal[..., 1] * radial
    y = np.broadcast_to(thick * 1.3 * np.sin(circle), x.shape)
    vertices = np.concatenate([np.stack([x, y, z], axis=-1).reshape(-1, 3), [[0, 0, -rise], [0, 0, rise]]])
    faces = []
    for i in range(rings - 1):
        for j in range(around):
            a, b = i * around + j, i * around + (j + 1) % around
            faces += [(a, a + around, b), (b, a + around, b + around)]
    last = (rings - 1) * around
    for j in range(around):
        k = (j + 1) % around
        faces += [(rings * around, j, k), (rings * around + 1, last + k, last + j)]
    return Trimesh(vertices, np.array(faces), process=False)


def _bottle(rng: np.random.Generator) -> Parts:
    body, neck = rng.uniform(0.14, 0.2), rng.uniform(0.045, 0.06)
    shoulder = rng.uniform(0.5, 0.65)
    bend = np.linspace(0.0, np.pi / 2, 9)
    curve = [(neck + (body - neck) * float(np.cos(a)), shoulder + 0.16 * float(np.sin(a))) for a in bend]
    profile = [(0.0, 0.0), (body * 0.92, 0.0), (body, 0.02), *curve, (neck, 0.9), (0.0, 0.9)]
    cap = revolved([(0, 0.9), (neck * 1.15, 0.9), (neck * 1.15, 1.0), (0, 1.0)])
    return [(revolved([(float(r), float(z)) for r, z in profile]), 0), (cap, 1)]


def _bowl(rng: np.random.Generator) -> Parts:
    depth, wall = rng.uniform(0.32, 0.48), 0.03
    turn = np.linspace(0.25, np.pi / 2, 30)
    outer = [(0.5 * float(np.sin(a)), depth * (1.0 - float(np.cos(a)) ** 1.3)) for a in turn]
    inner = [(r - wall, z + wall * 0.6) for r, z in outer[::-1]]
    rim = outer[-1][1]
    inner = [(r, min(z, rim)) for r, z in inner]
    return [(revolved([(0.0, outer[0][1]), *outer, *inner, (0.0, inner[-1][1])]), 0)]


def _toy(rng: np.random.Generator) -> Parts:
    head = rng.uniform(0.2, 0.25)
    top = 0.52 + head * 0.75
    parts: Parts = [
        (ellipsoid((0, 0, 0.3), (0.25, 0.21, 0.3)), 0),
        (ellipsoid((0, -0.06, 0.28), (0.18, 0.17, 0.2)), 1),
        (ellipsoid((0, -0.02, top), (head, head * 0.92, head * 0.92)), 0),
        (ellipsoid((0, -0.02 - head * 0.75, top - 0.06), (0.09, 0.09, 0.07)), 1),
    ]
    for side in (-1.0, 1.0):
        parts.append((ellipsoid((side * head * 0.8, 0.0, top + head * 0.72), (0.085, 0.05, 0.085)), 0))
        parts.append((ellipsoid((side * 0.29, -0.08, 0.36), (0.085, 0.09, 0.17)), 0))
        parts.append((ellipsoid((side * 0.17, -0.24, 0.085), (0.095, 0.17, 0.085)), 0))
        parts.append((ellipsoid((side * 0.17, -0.4, 0.1), (0.07, 0.03, 0.07)), 1))
    return parts


def _chair(rng: np.random.Generator) -> Parts:
    width, depth, seat, leg = 0.48, 0.46, rng.uniform(0.44, 0.5), 0.05
    slats = int(rng.integers(2, 5))
    x, y = width / 2, depth / 2
    parts: Parts = [(block((-x, -y, seat - 0.045), (x, y, seat)), 0)]
    for side in (-1.0, 1.0):
        inner, outer = sorted((side * x, side * (x - leg)))
        parts.append((block((inner, -y, 0.0), (outer, -y + leg, seat - 0.045)), 0))
        parts.append((block((inner, y - leg, 0.0), (outer, y, 1.0)), 0))
    for row in range(slats):
        z = seat + 0.14 + (0.9 - seat - 0.14) * row / max(1, slats - 1)
        parts.append((block((-x + leg, y - leg * 0.8, z), (x - leg, y - leg * 0.2, z + 0.09)), 1))
    return parts


_MAKERS = {
    "box": _box,
    "book": _book,
    "cylinder": _cylinder,
    "sphere": _sphere,
    "cone": _cone,
    "mug": _mug,
    "bottle": _bottle,
    "bowl": _bowl,
    "toy": _toy,
    "chair": _chair,
}
