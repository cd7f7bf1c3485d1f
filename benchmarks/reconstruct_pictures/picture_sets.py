# SPDX-License-Identifier: GPL-3.0-or-later
"""The sets of pictures: drawn arrangements, and single things whose surface is known all around."""

from __future__ import annotations

import math

import numpy as np

from . import cases, thin_bodies
from .cases import Case, Item
from .painted_bodies import KINDS, make_painted

SETS = {**cases.SETS, "turntable": (len(KINDS), 900), "thin": (len(thin_bodies.KINDS), 950)}
"""Pictures of a set, and the first of their seeds. ``turntable`` has one painted thing each (``painted_bodies.py``),
``thin`` one with holes and thin parts, or of its ground's tone (``thin_bodies.py``)."""

TURNS_DEG = {"plush": 12.0, "mug": -15.0, "chair": 28.0, "dog": 18.0, "carton": 24.0}
"""How far each is turned to the left from facing the camera."""
GROUNDS = ("boards", "plain", "concrete", "cloth", "marble")
LIGHTS = ("window", "overcast", "sun", "two", "window")
SIZES_M = (0.3, 0.1, 0.85, 0.35, 0.4)


def draw(set_name: str, number: int) -> Case:
    """Picture ``number`` (from 0) of the set. Raises ValueError where there is none."""
    if set_name == "turntable":
        return _turntable(number)
    return _thin(number) if set_name == "thin" else cases.draw(set_name, number)


def _turntable(number: int) -> Case:
    count, first = SETS["turntable"]
    if not 0 <= number < count:
        raise ValueError(f"picture {number}: the set turntable has 0 to {count - 1}")
    kind, seed = KINDS[number], first + number
    rng = np.random.default_rng(seed)
    turn = math.radians(-TURNS_DEG[kind])
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    body = make_painted(kind, SIZES_M[number])
    item = Item(f"{kind}_1", kind, body, matrix, np.full((2, 3), 0.3), "painted", 0.35 if kind == "mug" else 0.8)
    camera = None
    pitch = math.radians(22.0 if kind == "carton" else 15.0)
    while camera is None:
        camera = cases.aim([item], (640, 480), math.radians(50.0), pitch, 0.0, rng)
    reach = float(np.abs(item.vertices).max())
    ground = GROUNDS[number]
    lamps, sky = cases.lights(LIGHTS[number], True, reach, rng)
    return Case(
        name=f"case_{number:02}",
        seed=seed,
        camera=camera,
        items=(item,),
        ground=ground,
        ground_paint=cases.paint_of_ground(ground, rng),
        ground_turn=float(rng.uniform(0, math.pi)),
        grain=0.6 * reach,
        wall=float(item.vertices[:, 1].max()) + 1.2 * reach,
        wall_turn=0.0,
        wall_paint=np.array([0.5, 0.52, 0.55]),
        light=LIGHTS[number],
        lamps=lamps,
        sky=sky,
        sky_gradient=0.5,
        exif=True,
        noise=1.2,
        reach=reach,
    )


THIN_TURNS_DEG = (25.0, 20.0, 18.0, 0.0, 0.0, -20.0, 30.0)
THIN_GROUNDS = ("boards", "plain", "concrete", "boards", "cloth", "plain", "cloth")
THIN_LIGHTS = ("window", "window", "overcast", "sun", "window", "window", "overcast")
THIN_PITCH_DEG = (18.0, 35.0, 12.0, 20.0, 25.0, 15.0, 28.0)
THIN_PAINT = (
    ((0.35, 0.2, 0.1), (0.3, 0.17, 0.08)),
    ((0.03, 0.03, 0.035), (0.03, 0.03, 0.035)),
    ((0.5, 0.04, 0.03), (0.02, 0.02, 0.02)),
    ((0.06, 0.2, 0.04), (0.4, 0.13, 0.06)),
    ((0.55, 0.5, 0.42), (0.55, 0.5, 0.42)),
    ((0.03, 0.03, 0.05), (0.6, 0.57, 0.5)),
    ((0.035, 0.035, 0.04), (0.05, 0.05, 0.055)),
)
"""Of the parts with paint 0 and 1, linear light."""


def _thin(number: int) -> Case:
    count, first = SETS["thin"]
    if not 0 <= number < count:
        raise ValueError(f"picture {number}: the set thin has 0 to {count - 1}")
    kind, seed = thin_bodies.KINDS[number], first + number
    rng = np.random.default_rng(seed)
    turn = math.radians(-THIN_TURNS_DEG[number])
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    body = thin_bodies.make_thin(kind, 0.3, rng)
    item = Item(f"{kind}_1", kind, body, matrix, np.array(THIN_PAINT[number]), "plain", 0.6)
    camera = None
    while camera is None:
        pitch = math.radians(THIN_PITCH_DEG[number])
        camera = cases.aim([item], (640, 480), math.radians(50.0), pitch, 0.0, rng)
    reach = float(np.abs(item.vertices).max())
    ground = cases.paint_of_ground(THIN_GROUNDS[number], rng)
    if kind == "pale":
        ground = np.array([[0.62, 0.58, 0.5], [0.55, 0.51, 0.44], [0.5, 0.47, 0.4]])
    if kind == "dark":
        ground = np.array([[0.05, 0.05, 0.055], [0.035, 0.035, 0.04], [0.06, 0.06, 0.06]])
    lamps, sky = cases.lights(THIN_LIGHTS[number], True, reach, rng)
    return Case(
        name=f"case_{number:02}",
        seed=seed,
        camera=camera,
        items=(item,),
        ground=THIN_GROUNDS[number],
        ground_paint=ground,
        ground_turn=float(rng.uniform(0, math.pi)),
        grain=0.6 * reach,
        wall=float(item.vertices[:, 1].max()) + 1.5 * reach,
        wall_turn=0.0,
        wall_paint=np.array([0.5, 0.52, 0.55]),
        light=THIN_LIGHTS[number],
        lamps=lamps,
        sky=sky,
        sky_gradient=0.5,
        exif=True,
        noise=1.2,
        reach=reach,
    )
