# SPDX-License-Identifier: MIT
"""Assets of vessels (cup, bowl, bottle), and all assets by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from . import people, toys
from .asset import GAP, Asset, bands, dots, grained, inside, noise, over, part, plain
from .sdf import (
    Array,
    Bulge,
    Warp,
    above,
    below,
    difference,
    ellipsoid,
    grown,
    intersection,
    layer_on,
    revolved,
    sphere,
    torus,
    union,
)


def sleeve() -> Asset:
    """A cardboard sleeve on a cup of coffee with its lid, 12 cm."""
    size = 0.12
    cup = revolved([(0, 0.002), (0.0275, 0.002), (0.0400, 0.098), (0, 0.098)], 0.002)
    rim = revolved([(0, 0.0985), (0.0435, 0.0985), (0.0435, 0.1045), (0, 0.1045)], 0.0015)
    dome = revolved([(0, 0.10), (0.0395, 0.10), (0.0380, 0.117), (0, 0.117)], 0.002)
    lid = union(rim, difference(dome, ellipsoid((0, 0.004, 0.125), (0.032, 0.028, 0.011)), blend=0.002), blend=0.002)
    beaker = union(cup, lid, blend=0.001)
    card = layer_on(
        cup,
        thickness=lambda p: 0.0052 + 0.0005 * np.cos(40 * np.arctan2(p[:, 0], p[:, 1])),
        where=intersection(above(0.030, (0.0, 0.06)), below(0.078, (0.0, -0.06)), blend=0.002),
        blend=0.0018,
    )
    carton = difference(card, grown(beaker, GAP * size), blend=0.001)

    def paper(p: Array) -> Array:
        angle, z = np.arctan2(p[:, 0], -p[:, 1]), p[:, 2]
        colours = plain(p, "f6f1e4")
        wave = 0.006 * np.sin(5 * angle) + 0.002 * np.sin(13 * angle + 1)
        colours = over(colours, inside(z - 0.021 - wave, 0.0008), "1f7a73")
        colours = over(colours, inside(z - 0.012 - wave, 0.0008), "12504f")
        colours = over(colours, inside(0.086 - z - wave / 2, 0.0008), "e08e45")
        colours = over(colours, 0.9 * dots(p, 0.0085, 0.0016, 0.0008, 31), "d1603d")
        colours = over(colours, 0.8 * bands(angle + 12 * z, np.pi / 6, 0.04, 0.1), "1f7a73")
        top = inside(0.0975 - z, 0.0008)
        colours = over(colours, top, "3b2f2f")
        ripple = bands(np.hypot(p[:, 0], p[:, 1]), 0.006, 0.001, 0.3)
        colours = over(colours, 0.35 * top * ripple, "6e5a52")
        hole = np.hypot(p[:, 0] / 0.006, (p[:, 1] + 0.029) / 0.003)
        colours = over(colours, top * inside(hole - 1.0, 0.3) * inside(0.11 - z, 0.002), "120c0b")
        return grained(colours, p, 0.012, 0.035, 32)

    def cardboard(p: Array) -> Array:
        angle, z = np.arctan2(p[:, 0], -p[:, 1]), p[:, 2] - 0.054
        colours = over(plain(p, "b98552"), bands(angle, np.pi / 20, 0.05), "a87443")
        colours = over(colours, 0.5 * dots(p, 0.004, 0.0006, 0.0005, 33), "6b4424")
        x = angle * 0.042
        disc = inside(np.hypot(x, z) - 0.0165, 0.0007)
        colours = over(colours, disc, "f3e6cf")
        # A heart: (x² + y² - 1)³ = x² y³.
        u, v = x / 0.0095, (z - 0.001) / 0.0095
        heart = (u * u + v * v - 1) ** 3 - u * u * v**3
        colours = over(colours, disc * inside(heart, 0.12), "b5342f")
        stripe = inside(np.abs(np.abs(z) - 0.0155) - 0.0009, 0.0006) * (1.0 - disc)
        colours = over(colours, stripe, "4d2f1a")
        seam = inside(np.abs(np.abs(angle) - 2.4) - 0.02, 0.02)
        return grained(over(colours, seam, "8a5c33"), p, 0.009, 0.07, 34)

    return Asset(
        name="sleeve",
        title="a sleeve on a cup",
        background=part("cup", beaker, paper, box=((-0.047, -0.047, 0.0), (0.047, 0.047, 0.122)), spacing=0.0011),
        foregrounds=(
            part("sleeve", carton, cardboard, box=((-0.047, -0.047, 0.024), (0.047, 0.047, 0.086)), spacing=0.0009),
        ),
        warp=Warp(
            height=0.12,
            scale=(1.01, 1.01, 1.0),
            bend=(0.005, 0.0),
            bulges=(Bulge(centre=(0.012, -0.02, 0.055), radius=0.03, swell=0.03),),
        ),
    )


def bowl() -> Asset:
    """A beach ball in a bowl, 21 cm wide.

    The ball yields: it is the soft one, and the one that is hidden in part, so that its picture has to be completed.
    """
    size, radius = 0.22, 0.075
    middle = (0.0, 0.0, 0.0965)
    toy = sphere(middle, radius)
    outer = ellipsoid((0, 0, 0.105), (0.112, 0.112, 0.095))
    inner = ellipsoid((0, 0, 0.105), (0.101, 0.101, 0.083))
    wall = intersection(difference(outer, inner, blend=0.003), below(0.083), blend=0.009)
    foot = revolved([(0.034, 0.003), (0.043, 0.003), (0.041, 0.016), (0.03, 0.016)], 0.003)
    dish = difference(union(wall, foot, blend=0.006), grown(toy, GAP * size), blend=0.003)

    def beach(p: Array) -> Array:
        # Turned, so that a pole is seen.
        tilt = np.radians(38.0)
        away = p - middle
        up = away @ np.array([0.35 * np.sin(tilt), -np.sin(tilt), np.cos(tilt)]) / radius
        side, ahead = away[:, 0], away[:, 1] * np.cos(tilt) + away[:, 2] * np.sin(tilt)
        turn = (np.arctan2(side, ahead) / (2 * np.pi)) % 1.0
        colours = plain(p, "f7f4ec")
        for index, code in enumerate(("d7263d", "f7f4ec", "1b7fbd", "f6c330", "2e9e5b", "f58a2b")):
            colours = over(colours, inside(np.abs(turn - (index + 0.5) / 6) - 1 / 12, 0.004), code)
        seam = np.abs(turn * 6 - np.rint(turn * 6)) * radius * np.sqrt(np.maximum(1 - up * up, 0.0)) - 0.0012
        colours = over(colours, 0.75 * inside(seam, 0.0012), "f0ead8")
        stars = dots(away, 0.021, 0.0042, 0.0012, 41) * inside(np.abs(up) - 0.8, 0.02)
        colours = over(colours, 0.85 * stars, "fdfbf5")
        poles = inside(0.91 - np.abs(up), 0.02)
        colours = over(colours, poles, "f7f4ec")
        colours = over(colours, inside(np.abs(np.abs(up) - 0.91) - 0.012, 0.015), "24425f")
        return grained(colours, p, 0.03, 0.04, 42)

    def glazed(p: Array) -> Array:
        angle, z = np.arctan2(p[:, 0], -p[:, 1]), p[:, 2]
        within = inside(inner(p) - 0.0015, 0.002)
        colours = plain(p, "eef1ee")
        leaf = np.abs(((angle * 9 / np.pi) % 1.0) - 0.5) * 2
        colours = over(colours, inside(np.abs(z - 0.046) - 0.017 * np.sqrt(np.maximum(1 - leaf, 0)), 0.002), "2d5d9f")
        colours = over(
            colours, inside(np.abs(z - 0.046) - 0.009 * np.sqrt(np.maximum(1 - 1.4 * leaf, 0)), 0.002), "8fb7e0"
        )
        for height in (0.021, 0.071):
            colours = over(colours, inside(np.abs(z - height) - 0.0018, 0.0012), "2d5d9f")
        lining = over(grained(plain(p, "9cc4c9"), p, 0.02, 0.06, 43), dots(p, 0.014, 0.002, 0.0012, 44), "5b929c")
        colours = colours + within[:, None] * (lining - colours)
        colours = over(colours, inside(0.0795 - z + 0.0008 * noise(p, 0.01, 45), 0.0015), "2d5d9f")
        return grained(colours, p, 0.025, 0.03, 46)

    return Asset(
        name="bowl",
        title="a ball in a bowl",
        background=part("ball", toy, beach, box=((-0.08, -0.08, 0.018), (0.08, 0.08, 0.175)), spacing=0.0017),
        foregrounds=(part("bowl", dish, glazed, box=((-0.117, -0.117, 0.0), (0.117, 0.117, 0.095)), spacing=0.002),),
        warp=Warp(
            base=middle,
            height=0.08,
            scale=(1.09, 1.06, 1.03),
            bulges=(Bulge(centre=(0.01, -0.02, 0.03), radius=0.04, shift=(0.002, -0.002, -0.008)),),
        ),
    )


def cap() -> Asset:
    """A screw cap on a bottle of sauce, 17 cm."""
    size, flat = 0.17, 0.8
    body = revolved(
        [(0, 0.004), (0.033, 0.004), (0.036, 0.05), (0.033, 0.092), (0.024, 0.110), (0.0165, 0.118), (0, 0.118)], 0.004
    )
    neck = revolved([(0, 0.10), (0.0175, 0.10), (0.0175, 0.147), (0, 0.147)], 0.002)
    threads = [torus((0, 0, z), 0.0195, 0.0016) for z in (0.131, 0.1375, 0.144)]

    def oval(p: Array) -> Array:
        return flat * body(p * np.array([1.0, 1.0 / flat, 1.0]))

    bottle = union(union(oval, neck, blend=0.008), *threads, blend=0.002)
    shell = revolved([(0, 0.125), (0.0255, 0.125), (0.0235, 0.160), (0.014, 0.165), (0, 0.165)], 0.002)
    nubs = lambda p: np.where(p[:, 2] < 0.159, 0.0007 * np.cos(22 * np.arctan2(p[:, 0], p[:, 1])), 0.0)  # noqa: E731
    lid = difference(grown(shell, nubs), grown(bottle, GAP * size), blend=0.001)

    def sauce(p: Array) -> Array:
        x, z = p[:, 0], p[:, 2]
        colours = grained(plain(p, "c8352b"), p, 0.02, 0.06, 51)
        front = inside(np.abs(z - 0.052) - 0.030 - 0.003 * np.cos(x * 90), 0.001)
        colours = over(colours, front, "fbf3dc")
        edge = np.abs(np.abs(z - 0.052) - 0.027 - 0.003 * np.cos(x * 90))
        colours = over(colours, inside(edge - 0.0009, 0.0006), "2f7d4f")
        for face in (-1, 1):
            side = front * inside(face * p[:, 1], 0.003)
            fruit = np.hypot(x / 1.1, z - 0.049) - 0.0125
            colours = over(colours, side * inside(fruit, 0.0008), "d7402b")
            shine = np.hypot(x + 0.0045, z - 0.0535) - 0.0026
            colours = over(colours, side * inside(shine, 0.0012), "f6a08c")
            angle = np.arctan2(x, z - 0.0615)
            leaf = np.hypot(x, z - 0.0615) - 0.0055 * (0.55 + 0.45 * np.cos(5 * angle))
            colours = over(colours, side * inside(leaf, 0.0008), "2f7d4f")
            letters = bands(x + 0.0005 * noise(p, 0.003, 52), 0.0056, 0.0008, 0.6) * inside(np.abs(x) - 0.0195, 0.0008)
            colours = over(colours, side * letters * inside(np.abs(z - 0.0305) - 0.0028, 0.0008), "3a2a20")
        colours = over(colours, 0.8 * dots(p, 0.010, 0.0016, 0.0008, 53) * (1.0 - front), "8e1f1a")
        colours = over(colours, 0.8 * inside(np.abs(z - 0.098) - 0.0014, 0.0008), "f6c330")
        return grained(colours, p, 0.01, 0.03, 54)

    def plastic(p: Array) -> Array:
        angle, z = np.arctan2(p[:, 0], p[:, 1]), p[:, 2]
        colours = over(plain(p, "f4f1ea"), 0.55 * bands(angle, np.pi / 11, 0.06), "c9c2b4")
        colours = over(colours, inside(z - 0.1285, 0.0008), "2f7d4f")
        colours = over(colours, inside(0.161 - z, 0.0008), "2f7d4f")
        ring = np.hypot(p[:, 0], p[:, 1])
        arrow = bands(np.arctan2(p[:, 0], p[:, 1]) + 60 * ring, np.pi / 4, 0.08, 0.4) * inside(
            np.abs(ring - 0.012) - 0.003, 0.0008
        )
        colours = over(colours, arrow * inside(0.164 - z, 0.001), "f4f1ea")
        return grained(over(colours, 0.5 * dots(p, 0.007, 0.0009, 0.0006, 55), "8d9a8f"), p, 0.006, 0.05, 56)

    return Asset(
        name="cap",
        title="a cap on a bottle",
        background=part("bottle", bottle, sauce, box=((-0.042, -0.036, 0.0), (0.042, 0.036, 0.15)), spacing=0.0012),
        foregrounds=(part("cap", lid, plastic, box=((-0.03, -0.03, 0.121), (0.03, 0.03, 0.169)), spacing=0.0008),),
        warp=Warp(
            height=0.15,
            scale=(1.02, 1.03, 1.015),
            bend=(0.0016, 0.001),
            bulges=(
                Bulge(centre=(0.0, 0.0, 0.138), radius=0.016, swell=0.05),
                Bulge(centre=(0.01, -0.02, 0.05), radius=0.03, shift=(0.002, -0.005, 0.0)),
            ),
        ),
    )


MAKERS: dict[str, Callable[[], Asset]] = {
    "ring": people.ring,
    "hat": people.hat,
    "sleeve": sleeve,
    "bowl": bowl,
    "belt": toys.belt,
    "sock": people.sock,
    "cap": cap,
    "scarf": toys.scarf,
    "snow": toys.snow,
}
NAMES = tuple(MAKERS)


@cache
def asset(name: str) -> Asset:
    """The asset of one of ``NAMES``."""
    return MAKERS[name]()
