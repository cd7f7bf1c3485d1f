# SPDX-License-Identifier: MIT
"""Assets of toys: a belt on a bear, a scarf on a penguin, hat and scarf on a snow figure. They look towards -y."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .asset import GAP, Asset, bands, dots, grained, inside, noise, over, part, plain
from .sdf import (
    Array,
    Bulge,
    Warp,
    above,
    below,
    box_sdf,
    cone,
    difference,
    ellipsoid,
    grown,
    intersection,
    layer_on,
    revolved,
    rotated,
    sphere,
    torus,
    union,
)


def belt() -> Asset:
    """A leather belt on the belly of a toy bear, 34 cm. The belt draws the belly in."""
    size, z = 0.34, 0.122
    belly = ellipsoid((0, 0, 0.135), (0.092, 0.084, 0.098))
    drawn_in = grown(belly, lambda p: -0.007 * np.exp(-(((p[:, 2] - z) / 0.02) ** 2)))
    face = ellipsoid((0, -0.012, 0.268), (0.074, 0.066, 0.064))
    muzzle = ellipsoid((0, -0.07, 0.25), (0.033, 0.028, 0.026))
    nose = ellipsoid((0, -0.098, 0.26), (0.013, 0.009, 0.009))
    ears = [sphere((s * 0.056, 0.0, 0.322), 0.025) for s in (-1, 1)]
    legs = [cone((s * 0.05, -0.005, 0.03), (s * 0.045, 0.0, 0.08), 0.036, 0.045) for s in (-1, 1)]
    feet = [ellipsoid((s * 0.052, -0.034, 0.026), (0.036, 0.052, 0.028)) for s in (-1, 1)]
    arms = [cone((s * 0.065, 0.0, 0.2), (s * 0.132, -0.025, 0.182), 0.027, 0.025) for s in (-1, 1)]
    bear = union(drawn_in, face, *arms, *legs, blend=0.02)
    bear = intersection(union(bear, *feet, muzzle, *ears, nose, blend=0.01), above(0.0), blend=0.004)
    strap = layer_on(
        bear, thickness=0.0095, where=intersection(above(z - 0.016), below(z + 0.016), blend=0.004), blend=0.004
    )
    front = -0.088
    frame = difference(
        box_sdf((0, front, z), (0.03, 0.008, 0.025), 0.005),
        box_sdf((0, front, z), (0.019, 0.03, 0.0145), 0.003),
        blend=0.003,
    )
    pin = cone((0.0, front - 0.004, z), (0.027, front - 0.007, z), 0.0035, 0.003)
    leather = difference(union(strap, frame, pin, blend=0.0015), grown(bear, GAP * size), blend=0.002)

    def fur(p: Array) -> Array:
        x, y, height = p.T
        colours = grained(plain(p, "b5793f"), p, 0.02, 0.09, 61)
        colours = over(colours, 0.45 * inside(noise(p, 0.007, 62) + 0.2, 0.5), "9c6431")
        patch = np.hypot(x / 0.062, (height - 0.14) / 0.075) - 1.0
        colours = over(colours, inside(patch + 0.05 * noise(p, 0.012, 63), 0.06) * inside(y + 0.02, 0.01), "ecd3a4")
        colours = over(colours, inside(muzzle(p) - 0.001, 0.003), "ecd3a4")
        colours = over(colours, inside(nose(p) - 0.001, 0.0015), "2a1b14")
        for s in (-1, 1):
            eye = np.hypot(x - s * 0.03, height - 0.283) - 0.0095
            colours = over(colours, inside(eye, 0.002) * inside(y, 0.01), "20140f")
            glint = np.hypot(x - s * 0.03 + 0.003, height - 0.287) - 0.0024
            colours = over(colours, inside(glint, 0.002) * inside(y, 0.01), "ffffff")
            ear = np.linalg.norm(p - (s * 0.057, -0.02, 0.323), axis=1) - 0.0165
            colours = over(colours, inside(ear, 0.003), "e0a184")
            for dx, dz, r in ((0.0, 0.02, 0.015), (-0.016, 0.042, 0.005), (0.0, 0.048, 0.005), (0.016, 0.042, 0.005)):
                pad = np.hypot(x - s * 0.052 - dx, height - dz) - r
                colours = over(colours, inside(pad, 0.002) * inside(y + 0.07, 0.006), "e0a184")
        smile = np.abs(height - 0.238 - 18 * x * x) - 0.0016
        colours = over(
            colours, inside(smile, 0.0018) * inside(np.abs(x) - 0.017, 0.002) * inside(y + 0.08, 0.004), "3a241a"
        )
        seam = inside(np.abs(x) - 0.0009, 0.0012) * bands(height, 0.008, 0.0015, 0.6) * inside(patch, 0.05)
        return over(colours, 0.7 * seam * inside(y + 0.02, 0.01), "8c5a30")

    def hide(p: Array) -> Array:
        x, y, height = p.T
        colours = grained(plain(p, "5a2f22"), p, 0.014, 0.12, 64)
        around = np.arctan2(x, -y) * 0.095
        stitches = inside(np.abs(np.abs(height - z) - 0.0115) - 0.0011, 0.001) * bands(around, 0.008, 0.0015, 0.62)
        colours = over(colours, stitches, "e9d7a8")
        stars = np.hypot((around + 0.0125) % 0.025 - 0.0125, height - z) - 0.0042
        colours = over(colours, inside(stars, 0.001) * inside(0.035 - np.abs(around), 0.002), "d9a441")
        metal = inside(np.minimum(frame(p), pin(p)) - 0.0004, 0.0008)
        return over(colours, metal, "e6b84c") * (1.0 + 0.10 * metal * noise(p, 0.01, 65))[:, None]

    return Asset(
        name="belt",
        title="a belt on a belly",
        background=part("bear", bear, fur, box=((-0.17, -0.12, 0.0), (0.17, 0.11, 0.355)), spacing=0.0027),
        foregrounds=(part("belt", leather, hide, box=((-0.115, -0.115, 0.09), (0.115, 0.11, 0.155)), spacing=0.0019),),
        warp=Warp(
            height=0.34,
            scale=(1.01, 1.01, 1.01),
            bend=(0.014, -0.004),
            bulges=(Bulge(centre=(0.01, -0.02, z), radius=0.06, swell=0.025),),
        ),
    )


def scarf() -> Asset:
    """A scarf on the neck of a penguin, 35 cm."""
    size = 0.36
    body = ellipsoid((0, 0, 0.128), (0.097, 0.09, 0.13))
    head = sphere((0, -0.006, 0.29), 0.068)
    beak = cone((0, -0.062, 0.283), (0, -0.102, 0.276), 0.017, 0.006)
    flippers = [
        rotated(
            ellipsoid((s * 0.104, 0.004, 0.14), (0.016, 0.04, 0.078)),
            (s * 0.104, 0.004, 0.14),
            Rotation.from_euler("y", -s * 18, degrees=True).as_matrix(),
        )
        for s in (-1, 1)
    ]
    feet = [ellipsoid((s * 0.046, -0.06, 0.012), (0.036, 0.052, 0.014)) for s in (-1, 1)]
    tail = cone((0, 0.07, 0.05), (0, 0.118, 0.03), 0.03, 0.008)
    penguin = union(body, head, blend=0.04)
    penguin = union(penguin, *flippers, tail, blend=0.018)
    penguin = intersection(union(penguin, beak, *feet, blend=0.008), above(0.0), blend=0.004)
    lean = (0.08, -0.14, 1.0)
    loop = grown(torus((0, -0.003, 0.231), 0.068, 0.021, lean), lambda p: 0.002 * noise(p, 0.02, 71))
    knot = ellipsoid((0.034, -0.076, 0.219), (0.024, 0.02, 0.022))
    lane = intersection(
        above(0.075), below(0.225), lambda p: np.abs(p[:, 0] - 0.034 - 0.08 * (0.2 - p[:, 2])) - 0.0235, blend=0.006
    )
    hanging = layer_on(
        penguin, thickness=0.012, where=intersection(lane, lambda p: p[:, 1] + 0.01, blend=0.004), blend=0.007
    )
    wool = difference(union(loop, knot, hanging, blend=0.01), grown(penguin, GAP * size), blend=0.003)

    def plumage(p: Array) -> Array:
        x, y, z = p.T
        colours = grained(plain(p, "2b3a55"), p, 0.02, 0.12, 72)
        colours = over(colours, 0.5 * dots(p, 0.015, 0.003, 0.002, 73), "48618c")
        front = inside(y + 0.015, 0.012)
        chest = np.hypot(x / 0.072, (z - 0.115) / 0.11) - 1.0
        cheeks = np.minimum(np.hypot(x - 0.024, z - 0.287), np.hypot(x + 0.024, z - 0.287)) - 0.034
        pale = front * np.maximum(inside(chest, 0.04), inside(cheeks, 0.003))
        colours = over(colours, pale, "f4f1e6")
        colours = over(colours, 0.4 * pale * inside(noise(p, 0.008, 74) + 0.3, 0.4), "d9d3c0")
        for s in (-1, 1):
            eye = np.hypot(x - s * 0.025, z - 0.304) - 0.0085
            colours = over(colours, front * inside(eye, 0.002), "16161c")
            colours = over(
                colours, front * inside(np.hypot(x - s * 0.025 + 0.003, z - 0.3075) - 0.0023, 0.002), "ffffff"
            )
            blush = np.hypot(x - s * 0.042, z - 0.276) - 0.009
            colours = over(colours, 0.7 * front * inside(blush, 0.006), "f0a1a0")
        orange = np.minimum(beak(p), np.minimum(feet[0](p), feet[1](p)))
        colours = over(colours, inside(orange - 0.0012, 0.002), "ee9b2d")
        toes = inside(z - 0.03, 0.004) * bands(x, 0.018, 0.002, 0.16) * inside(y + 0.07, 0.006)
        return over(colours, toes, "b96a14")

    def knitted(p: Array) -> Array:
        x, y, z = p.T
        around = np.arctan2(x, -y)
        drop = (
            inside(z - 0.205 - 0.02 * (x - 0.03) / 0.02, 0.004)
            * inside(y + 0.02, 0.01)
            * inside(np.abs(x - 0.04) - 0.034, 0.002)
        )
        coordinate = np.where(drop > 0.5, z / 0.03, around * 0.07 / 0.03)
        colours = over(plain(p, "c8323c"), bands(coordinate, 1.0, 0.06, 0.42), "f5ecd7")
        colours = over(colours, bands(coordinate + 0.29, 1.0, 0.05, 0.12), "2f6b58")
        stitch = bands(z + 0.35 * np.abs(((around * 14) % 1.0) - 0.5) * 0.02, 0.007, 0.002)
        colours = over(colours, 0.2 * stitch, "3a1010")
        fringe = drop * inside(z - 0.09, 0.002)
        colours = over(colours, fringe, "f5ecd7")
        colours = over(colours, fringe * bands(x, 0.0075, 0.001, 0.35), "a8252f")
        return grained(colours, p, 0.008, 0.06, 75)

    return Asset(
        name="scarf",
        title="a scarf on a neck",
        background=part("penguin", penguin, plumage, box=((-0.16, -0.125, 0.0), (0.16, 0.135, 0.37)), spacing=0.0028),
        foregrounds=(part("scarf", wool, knitted, box=((-0.1, -0.13, 0.06), (0.1, 0.1, 0.27)), spacing=0.0021),),
        warp=Warp(
            height=0.36,
            scale=(1.02, 1.02, 1.01),
            bend=(-0.014, -0.003),
            bulges=(Bulge(centre=(0.0, -0.005, 0.231), radius=0.04, swell=0.06),),
        ),
    )


def snow() -> Asset:
    """A snow figure with a top hat and a scarf, 50 cm: three objects."""
    size = 0.51
    lumps = [sphere((0, 0, 0.105), 0.118), sphere((0, 0, 0.255), 0.084), sphere((0, 0, 0.375), 0.063)]
    packed = grown(union(*lumps, blend=0.014), lambda p: 0.0015 * noise(p, 0.03, 81))
    carrot = cone((0, -0.055, 0.375), (0.012, -0.118, 0.371), 0.0125, 0.0035)
    coals = [sphere((s * 0.024, -0.0565, 0.391), 0.0075) for s in (-1, 1)]
    coals += [
        sphere((x, -0.0555 - 0.2 * x * x, 0.3515 + 9 * x * x), 0.0045) for x in (-0.027, -0.014, 0.0, 0.014, 0.027)
    ]
    coals += [sphere((0.0, -y, z), 0.0095) for y, z in ((0.0835, 0.27), (0.0805, 0.232), (0.1165, 0.125))]
    limbs = [cone((s * 0.07, 0, 0.27), (s * 0.155, -0.02, 0.318), 0.0085, 0.0065) for s in (-1, 1)]
    limbs += [cone((s * 0.128, -0.013, 0.303), (s * 0.14, -0.035, 0.335), 0.006, 0.005) for s in (-1, 1)]
    figure = union(packed, carrot, *coals, *limbs, blend=0.003)
    figure = intersection(figure, above(0.0), blend=0.006)

    felt = revolved([(0, 0.421), (0.074, 0.421), (0.074, 0.4245), (0, 0.4245)], 0.004)
    crown = revolved([(0, 0.415), (0.0475, 0.415), (0.051, 0.499), (0, 0.499)], 0.005)
    band = revolved([(0, 0.429), (0.0485, 0.429), (0.0495, 0.449), (0, 0.449)], 0.0055)
    tilt = Rotation.from_euler("yx", [7, -6], degrees=True).as_matrix()
    topper = rotated(union(union(felt, crown, blend=0.008), band, blend=0.001), (0, 0, 0.375), tilt)
    hat_shape = difference(topper, grown(figure, GAP * size), blend=0.003)

    loop = grown(torus((0, -0.002, 0.318), 0.062, 0.019, (0.05, -0.1, 1.0)), lambda p: 0.002 * noise(p, 0.02, 82))
    knot = ellipsoid((-0.036, -0.066, 0.309), (0.022, 0.018, 0.02))
    lane = intersection(
        above(0.195), below(0.31), lambda p: np.abs(p[:, 0] + 0.038 + 0.1 * (0.3 - p[:, 2])) - 0.0215, blend=0.006
    )
    hanging = layer_on(
        packed, thickness=0.0125, where=intersection(lane, lambda p: p[:, 1] + 0.01, blend=0.004), blend=0.007
    )
    scarf_shape = difference(union(loop, knot, hanging, blend=0.01), grown(figure, GAP * size), blend=0.003)

    def snowy(p: Array) -> Array:
        colours = grained(plain(p, "e9f0f7"), p, 0.04, 0.04, 83)
        colours = over(colours, 0.5 * inside(noise(p, 0.06, 84), 0.7), "cfdcec")
        colours = over(colours, 0.6 * dots(p, 0.014, 0.0026, 0.002, 85), "b4c8e0")
        colours = over(colours, inside(carrot(p) - 0.0012, 0.0015), "e8792b")
        rings = inside(carrot(p) - 0.0012, 0.0015) * bands(p[:, 1], 0.012, 0.002, 0.2)
        colours = over(colours, rings, "b4531a")
        black = np.min([coal(p) for coal in coals], axis=0)
        colours = over(colours, inside(black - 0.001, 0.0015), "26262b")
        wood = np.min([limb(p) for limb in limbs], axis=0)
        bark = over(plain(p, "6b4a2f"), bands(p[:, 0] + 0.003 * noise(p, 0.01, 86), 0.011, 0.002, 0.4), "4d3320")
        share = (inside(wood - 0.001, 0.0015) * inside(0.0015 - packed(p), 0.002))[:, None]
        return colours + share * (bark - colours)

    def felted(p: Array) -> Array:
        upright = (p - (0, 0, 0.375)) @ tilt + (0, 0, 0.375)
        angle, z = np.arctan2(upright[:, 0], -upright[:, 1]), upright[:, 2]
        colours = grained(plain(p, "33333d"), p, 0.012, 0.16, 87)
        colours = over(colours, 0.45 * bands(angle + 4 * z, np.pi / 8, 0.06, 0.3), "55556a")
        ribbon = inside(np.abs(z - 0.439) - 0.0135, 0.0015) * inside(
            np.hypot(upright[:, 0], upright[:, 1]) - 0.058, 0.001
        )
        colours = over(colours, ribbon, "b3263a")
        colours = over(colours, ribbon * bands(angle, np.pi / 10, 0.05, 0.3), "e2c044")
        flower = np.hypot(angle + 0.75, (z - 0.442) / 0.05)
        petals = flower - 0.27 * (0.75 + 0.25 * np.cos(5 * np.arctan2(angle + 0.75, (z - 0.442) / 0.05)))
        bloom = inside(np.hypot(upright[:, 0], upright[:, 1]) - 0.058, 0.001)
        colours = over(colours, bloom * inside(petals, 0.05), "f4efe2")
        return over(colours, bloom * inside(flower - 0.09, 0.04), "e2a72e")

    def knitted(p: Array) -> Array:
        x, y, z = p.T
        around = np.arctan2(x, -y)
        drop = inside(z - 0.298, 0.004) * inside(y + 0.02, 0.01) * inside(np.abs(x + 0.044) - 0.034, 0.002)
        coordinate = np.where(drop > 0.5, z / 0.028, around * 0.065 / 0.028)
        colours = over(plain(p, "2f7d5b"), bands(coordinate, 1.0, 0.06, 0.45), "f0c53d")
        colours = over(colours, bands(coordinate + 0.3, 1.0, 0.05, 0.13), "f7f1e1")
        colours = over(colours, 0.2 * bands(z + 0.007 * np.abs(((around * 14) % 1.0) - 0.5), 0.007, 0.002), "103020")
        fringe = drop * inside(z - 0.208, 0.002)
        colours = over(colours, fringe * bands(x, 0.0075, 0.001, 0.35), "f7f1e1")
        return grained(colours, p, 0.008, 0.06, 88)

    return Asset(
        name="snow",
        title="a hat and a scarf on a snow figure",
        background=part("figure", figure, snowy, box=((-0.18, -0.13, 0.0), (0.18, 0.13, 0.445)), spacing=0.0034),
        foregrounds=(
            part("hat", hat_shape, felted, box=((-0.1, -0.1, 0.39), (0.1, 0.1, 0.525)), spacing=0.0022),
            part("scarf", scarf_shape, knitted, box=((-0.1, -0.12, 0.175), (0.1, 0.1, 0.36)), spacing=0.0022),
        ),
        warp=Warp(
            height=0.5,
            scale=(1.02, 1.02, 1.01),
            bend=(0.02, 0.004),
            bulges=(
                Bulge(centre=(0.0, 0.0, 0.42), radius=0.04, swell=0.06),
                Bulge(centre=(0.0, 0.0, 0.318), radius=0.035, swell=0.045),
            ),
        ),
    )
