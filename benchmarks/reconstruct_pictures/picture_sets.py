# SPDX-License-Identifier: GPL-3.0-or-later
"""The sets of pictures: drawn arrangements, and single things whose surface is known all around."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from physgen.sim.scene.model import Camera

from . import cases, thin_bodies
from .cases import Case, Item
from .fresh_bodies import KINDS as FRESH
from .fresh_bodies import make_fresh
from .held_out_bodies import KINDS as HELD_OUT
from .held_out_bodies import make_held_out
from .painted_bodies import KINDS, make_painted


class Shot(NamedTuple):
    """Setting in which a painted thing is photographed.

    turn: how far it is turned to the left from facing the camera; pitch, view: of the camera, all degrees.
    """

    kind: str
    turn: float
    ground: str
    light: str
    size_m: float
    pitch: float = 15.0
    view: float = 50.0
    roughness: float = 0.8
    size_px: tuple[int, int] = (640, 480)


SHOTS = {
    "turntable": (
        Shot("plush", 12.0, "boards", "window", 0.3),
        Shot("mug", -15.0, "plain", "overcast", 0.1, roughness=0.35),
        Shot("chair", 28.0, "concrete", "sun", 0.85),
        Shot("dog", 18.0, "cloth", "two", 0.35),
        Shot("carton", 24.0, "marble", "window", 0.4, pitch=22.0),
    ),
    "held_out": (
        Shot("teapot", 8.0, "boards", "window", 0.25, pitch=20.0, view=40.0, roughness=0.5),
        Shot("bird", -14.0, "concrete", "two", 0.2, pitch=12.0, view=55.0),
        Shot("stool", 10.0, "boards", "overcast", 0.7, pitch=18.0, view=45.0, size_px=(480, 640)),
        Shot("sock", -20.0, "plain", "window", 0.3, pitch=26.0, view=60.0, size_px=(480, 640)),
        Shot("radio", 22.0, "cloth", "sun", 0.3, pitch=16.0, view=38.0, roughness=0.45),
    ),
    "fresh": (
        Shot("boot", -10.0, "boards", "window", 0.3, pitch=14.0, view=45.0, roughness=0.6, size_px=(480, 360)),
        Shot("kettle", 12.0, "plain", "two", 0.28, pitch=19.0, view=42.0, roughness=0.5, size_px=(480, 360)),
    ),
}
"""Pictures of single painted things, one set for changes to be guided by, two kept aside."""
MAKERS = {"turntable": make_painted, "held_out": make_held_out, "fresh": make_fresh}
SETS = {
    **cases.SETS,
    "turntable": (len(KINDS), 900),
    "held_out": (len(HELD_OUT), 930),
    "fresh": (len(FRESH), 970),
    "thin": (len(thin_bodies.KINDS), 950),
}
"""Pictures of a set, and the first of their seeds. ``turntable``, ``held_out`` and ``fresh`` have one painted thing
each (``painted_bodies.py``, ``held_out_bodies.py``, ``fresh_bodies.py``), ``thin`` one with holes and thin parts, or of
its ground's tone (``thin_bodies.py``)."""


def draw(set_name: str, number: int) -> Case:
    """Picture ``number`` (from 0) of the set. Raises ValueError where there is none."""
    if set_name in SHOTS:
        return _painted(set_name, number)
    return _thin(number) if set_name == "thin" else cases.draw(set_name, number)


def _painted(set_name: str, number: int) -> Case:
    count, first = SETS[set_name]
    if not 0 <= number < count:
        raise ValueError(f"picture {number}: the set {set_name} has 0 to {count - 1}")
    shot, seed = SHOTS[set_name][number], first + number
    rng = np.random.default_rng(seed)
    body = MAKERS[set_name](shot.kind, shot.size_m)
    paint = np.full((2, 3), 0.3)
    item = Item(f"{shot.kind}_1", shot.kind, body, _turned(shot.turn), paint, "painted", shot.roughness)
    camera = _aimed(item, shot.size_px, shot.view, shot.pitch, rng)
    lamps = cases.lights(shot.light, True, _reach(item), rng)
    ground = cases.paint_of_ground(shot.ground, rng)
    return _alone(number, seed, item, camera, (shot.ground, ground), (shot.light, lamps), 1.2, rng)


def _turned(to_the_left_deg: float) -> NDArray[np.float64]:
    """Pose (4, 4) of a thing turned about the vertical."""
    turn = math.radians(-to_the_left_deg)
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    return matrix


def _aimed(item: Item, size: tuple[int, int], view_deg: float, pitch_deg: float, rng: np.random.Generator) -> Camera:
    camera = None
    while camera is None:
        camera = cases.aim([item], size, math.radians(view_deg), math.radians(pitch_deg), 0.0, rng)
    return camera


def _reach(item: Item) -> float:
    return float(np.abs(item.vertices).max())


def _alone(
    number: int,
    seed: int,
    item: Item,
    camera: Camera,
    ground: tuple[str, NDArray[np.float64]],
    light: tuple[str, tuple[tuple[cases.Lamp, ...], tuple[float, float, float]]],
    wall_behind: float,
    rng: np.random.Generator,
) -> Case:
    """One thing on its ground before a wall, ``wall_behind`` times its reach behind it.

    ground: name and paint. light: name, and lamps and sky.
    """
    reach = _reach(item)
    return Case(
        name=f"case_{number:02}",
        seed=seed,
        camera=camera,
        items=(item,),
        ground=ground[0],
        ground_paint=ground[1],
        ground_turn=float(rng.uniform(0, math.pi)),
        grain=0.6 * reach,
        wall=float(item.vertices[:, 1].max()) + wall_behind * reach,
        wall_turn=0.0,
        wall_paint=np.array([0.5, 0.52, 0.55]),
        light=light[0],
        lamps=light[1][0],
        sky=light[1][1],
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
    body = thin_bodies.make_thin(kind, 0.3, rng)
    pose, paint = _turned(THIN_TURNS_DEG[number]), np.array(THIN_PAINT[number])
    item = Item(f"{kind}_1", kind, body, pose, paint, "plain", 0.6)
    camera = _aimed(item, (640, 480), 50.0, THIN_PITCH_DEG[number], rng)
    ground = cases.paint_of_ground(THIN_GROUNDS[number], rng)
    if kind == "pale":
        ground = np.array([[0.62, 0.58, 0.5], [0.55, 0.51, 0.44], [0.5, 0.47, 0.4]])
    if kind == "dark":
        ground = np.array([[0.05, 0.05, 0.055], [0.035, 0.035, 0.04], [0.06, 0.06, 0.06]])
    lamps = cases.lights(THIN_LIGHTS[number], True, _reach(item), rng)
    return _alone(number, seed, item, camera, (THIN_GROUNDS[number], ground), (THIN_LIGHTS[number], lamps), 1.5, rng)
