# SPDX-License-Identifier: GPL-3.0-or-later
"""Five more things whose surface is known all around: a teapot, a toy bird, a stool, a striped sock, a radio.

They are kept aside: nothing was tuned on them. As in ``painted_bodies.py``, each has marks on its front that its back
has not, and what goes on around it; the front looks along -y.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from .painted_bodies import Painted, Points, fur, noise, painted_body, plain, where, within
from .shapes import Body, block, ellipsoid, revolved

KINDS = ("teapot", "bird", "stool", "sock", "radio")
Mask = NDArray[np.bool_]


def make_held_out(kind: str, size: float) -> Body:
    """A body of ``kind`` that stands on the origin; ``size``: its largest extent along an axis, metres."""
    return painted_body(_MAKERS[kind](), size, smooth=kind not in ("stool", "radio"))


def tube(course: list[tuple[float, float, float]], radii: list[float], sections: int = 32) -> trimesh.Trimesh:
    """A round tube through the places of ``course`` in the plane of x and z, with a radius at each; its ends closed."""
    middle, radius = np.array(course), np.array(radii)
    ahead = np.gradient(middle, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    across = np.cross(ahead, (0.0, 1.0, 0.0))
    turn = np.linspace(0.0, 2 * np.pi, sections, endpoint=False)
    ring = np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * np.array([0.0, 1.0, 0.0])
    wall = (middle[:, None] + radius[:, None, None] * ring).reshape(-1, 3)
    faces = []
    for i in range(len(middle) - 1):
        for j in range(sections):
            a, b = i * sections + j, i * sections + (j + 1) % sections
            faces += [(a, b, a + sections), (b, b + sections, a + sections)]
    first, last = len(wall), len(wall) + 1
    for j in range(sections):
        k, end = (j + 1) % sections, (len(middle) - 1) * sections
        faces += [(first, k, j), (last, end + j, end + k)]
    made = trimesh.Trimesh(np.concatenate([wall, middle[[0, -1]]]), np.array(faces), process=False)
    if made.volume < 0:
        made.invert()
    return made


def _teapot() -> list[Painted]:
    green, cream = fur((0.1, 0.25, 0.16), seed=61, strength=0.1), plain((0.7, 0.64, 0.5))
    rose, leaf = plain((0.6, 0.08, 0.12)), plain((0.05, 0.16, 0.03))
    turn = np.linspace(-1.25, 1.35, 60)
    belly = [(0.36 * float(np.cos(a)) ** 0.8, 0.27 + 0.27 * float(np.sin(a))) for a in turn]
    wall = [(0.0, belly[0][1]), *belly, (0.0, belly[-1][1])]

    def band(places: Points) -> Mask:
        z = places[:, 2]
        return (np.abs(z - 0.4) < 0.025) | (z < 0.055)

    def petals(places: Points) -> Mask:
        x, z = places[:, 0], places[:, 2] - 0.24
        return (np.hypot(x, z) < 0.075 * (1 + 0.3 * np.cos(6 * np.arctan2(x, z)))) & (places[:, 1] < -0.1)

    def leaves(places: Points) -> Mask:
        x, z = np.abs(places[:, 0]) - 0.14, places[:, 2] - 0.2
        return ((x / 0.06) ** 2 + (z / 0.025) ** 2 < 1) & (places[:, 1] < -0.1)

    spout = tube([(0.28, 0, 0.2), (0.42, 0, 0.26), (0.5, 0, 0.38), (0.58, 0, 0.5)], [0.085, 0.06, 0.045, 0.035])
    bend = np.linspace(-1.3, 1.3, 24)
    grip = [(-0.3 - 0.24 * float(np.cos(a)), 0.0, 0.29 + 0.17 * float(np.sin(a))) for a in bend]
    return [
        (revolved(wall, sections=160), where(petals, rose, where(leaves, leaf, where(band, cream, green)))),
        (spout, green),
        (tube(grip, [0.032] * len(grip)), green),
        (ellipsoid((0, 0, 0.53), (0.17, 0.17, 0.045)), cream),
        (ellipsoid((0, 0, 0.6), (0.045, 0.045, 0.045)), cream),
    ]


def _bird() -> list[Painted]:
    yellow, grey = fur((0.65, 0.45, 0.05), seed=71, strength=0.12), fur((0.2, 0.22, 0.26), seed=72)
    orange, ink, white = plain((0.6, 0.18, 0.02)), plain((0.015, 0.015, 0.02)), plain((0.7, 0.68, 0.62))
    # It looks to the right; a band goes around its neck, a badge is on the side that the camera sees.
    badge = within((0.15, -0.2, 0.38), 0.07)
    coat = where(badge, white, where(lambda p: p[:, 0] + 0.4 * p[:, 2] < -0.12, grey, yellow))
    banded = where(lambda p: np.abs(p[:, 2] - 0.6 - 0.2 * (p[:, 0] - 0.2)) < 0.02, ink, yellow)
    beak = trimesh.creation.cone(radius=0.06, height=0.17, sections=48)
    beak.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    beak.apply_translation((0.38, 0.0, 0.74))
    tail = ellipsoid((0, 0, 0), (0.2, 0.09, 0.035))
    tail.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 1, 0)))
    tail.apply_translation((-0.4, 0, 0.46))
    parts: list[Painted] = [
        (ellipsoid((0, 0, 0.36), (0.33, 0.24, 0.26)), coat),
        (ellipsoid((0.2, 0, 0.66), (0.11, 0.11, 0.13)), banded),
        (ellipsoid((0.24, 0, 0.74), (0.17, 0.155, 0.155)), yellow),
        (beak, orange),
        (tail, grey),
    ]
    for side in (-1.0, 1.0):
        parts += [
            (ellipsoid((-0.1, side * 0.22, 0.38), (0.19, 0.05, 0.12)), grey),
            (ellipsoid((0.32, side * 0.12, 0.79), (0.028, 0.022, 0.03)), ink),
            (ellipsoid((0.06, side * 0.11, 0.03), (0.13, 0.07, 0.03)), orange),
            (ellipsoid((0.02, side * 0.11, 0.1), (0.03, 0.03, 0.1)), orange),
        ]
    return parts


def _stool() -> list[Painted]:
    def wood(places: Points) -> Points:
        grain = noise(places * (0.8, 6.0, 6.0), 0.12, 81)
        return np.array((0.42, 0.27, 0.13)) * np.exp(0.22 * grain)[:, None]

    cushion, tag = plain((0.05, 0.1, 0.22)), plain((0.7, 0.6, 0.1))
    turn = np.linspace(-np.pi / 2, np.pi / 2, 16)
    edge = [(0.3 + 0.045 * float(np.cos(a)), 0.93 + 0.06 * float(np.sin(a))) for a in turn]
    seat = revolved([(0.0, edge[0][1]), *edge, (0.0, edge[-1][1])], sections=128)
    label = where(lambda p: (np.abs(p[:, 0]) < 0.06) & (p[:, 1] < -0.25), tag, cushion)
    parts: list[Painted] = [(seat, label), (revolved([(0, 0.83), (0.29, 0.83), (0.29, 0.88), (0, 0.88)], 96), wood)]
    feet = [np.array([0.34 * np.cos(a), 0.34 * np.sin(a), 0.0]) for a in np.radians([45, 135, 225, 315])]
    tops = [foot * 0.62 + np.array([0.0, 0.0, 0.86]) for foot in feet]
    for foot, top in zip(feet, tops, strict=True):
        leg = trimesh.creation.cylinder(
            radius=0.032, segment=np.array([foot + np.array([0, 0, 0.006]), top]), sections=32
        )
        parts.append((leg, wood))
    for i in range(4):
        ends = [feet[k] * 0.72 + tops[k] * 0.28 for k in (i, (i + 1) % 4)]
        parts.append((trimesh.creation.cylinder(radius=0.02, segment=np.array(ends), sections=24), wood))
    return parts


def _sock() -> list[Painted]:
    """Filled and standing on its foot; the toe points to the right."""
    red, wool = fur((0.5, 0.06, 0.05), seed=91, strength=0.1), fur((0.62, 0.58, 0.5), seed=92, strength=0.1)
    navy = plain((0.03, 0.05, 0.15))

    def striped(places: Points) -> Mask:
        along = np.where(places[:, 2] > 0.3, places[:, 2] - 0.3, -(places[:, 0] + 0.1))
        return (along / 0.14) % 1.0 < 0.5

    def heart(places: Points) -> Mask:
        x, z = (places[:, 0] + 0.1) / 0.07, (places[:, 2] - 0.66) / 0.065
        return ((x**2 + z**2 - 1) ** 3 - x**2 * z**3 < 0) & (places[:, 1] < 0)

    knit = where(heart, navy, where(striped, red, wool))
    up = np.linspace(0.14, 1.0, 44)
    leg = tube([(-0.1, 0.0, float(z)) for z in up], [0.165 + 0.01 * float(np.cos(9 * z)) for z in up], 96)
    return [
        (leg, knit),
        (ellipsoid((-0.1, 0, 0.16), (0.18, 0.165, 0.16)), navy),
        (ellipsoid((0.12, 0, 0.15), (0.3, 0.16, 0.15)), where(lambda p: p[:, 0] > 0.28, navy, knit)),
        (ellipsoid((-0.1, 0, 1.0), (0.18, 0.18, 0.05)), wool),
    ]


def _radio() -> list[Painted]:
    teal, cream, ink = plain((0.06, 0.26, 0.27)), plain((0.68, 0.62, 0.48)), plain((0.02, 0.02, 0.02))
    steel, scale = plain((0.45, 0.45, 0.46)), plain((0.75, 0.7, 0.55))

    def face(places: Points) -> Mask:
        return places[:, 1] < -0.169

    def grille(places: Points) -> Mask:
        x, z = places[:, 0] + 0.24, places[:, 2] - 0.27
        near = np.hypot(x, z) < 0.17
        return face(places) & near & (np.hypot((x / 0.05) % 1.0 - 0.5, (z / 0.05) % 1.0 - 0.5) < 0.33)

    def dial(places: Points) -> Mask:
        return face(places) & (np.abs(places[:, 0] - 0.22) < 0.2) & (np.abs(places[:, 2] - 0.38) < 0.06)

    def needle(places: Points) -> Mask:
        return dial(places) & (np.abs(places[:, 0] - 0.15) < 0.01)

    def trim(places: Points) -> Mask:
        return np.abs(places[:, 2] - 0.5) < 0.02

    case = where(needle, ink, where(dial, scale, where(grille, ink, where(trim, cream, teal))))
    knob = revolved([(0, 0), (0.07, 0), (0.06, 0.05), (0, 0.05)], 64)
    knob.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    knob.apply_translation((0.22, -0.17, 0.17))
    aerial = trimesh.creation.cylinder(radius=0.014, segment=np.array([[0.4, 0.1, 0.55], [0.47, 0.1, 0.85]]))
    bend = np.linspace(0.0, np.pi, 24)
    grip = [(-0.28 * float(np.cos(a)), 0.0, 0.55 + 0.12 * float(np.sin(a))) for a in bend]
    return [
        (block((-0.46, -0.17, 0.0), (0.46, 0.17, 0.57)), case),
        (knob, steel),
        (aerial, steel),
        (tube(grip, [0.025] * len(grip)), cream),
    ]


_MAKERS = {"teapot": _teapot, "bird": _bird, "stool": _stool, "sock": _sock, "radio": _radio}
