# SPDX-License-Identifier: MIT
"""Assets of people: a ring on a finger, a hat on a head, a sock on a foot. They look towards -y."""

from __future__ import annotations

import numpy as np

from .asset import GAP, Asset, bands, dots, grained, inside, noise, over, part, plain
from .sdf import (
    Array,
    Bulge,
    Warp,
    above,
    below,
    cone,
    difference,
    ellipsoid,
    grown,
    intersection,
    layer_on,
    limb,
    revolved,
    sphere,
    union,
)

SKIN = "e8b48f"
HEM = ((0.003, 0.225, 0.251), (-0.002, 0.245, 0.281))
"""Rolled up trousers: (metres beyond 5 cm from the middle, lowest, highest) of the roll and of the leg."""


def ring() -> Asset:
    """A ring with a stone on an index finger, 8 cm."""
    size = 0.08
    joints = [(0, 0, 0.0), (0, 0, 0.026), (0, 0.0004, 0.038), (0, 0.0022, 0.05), (0, 0.004, 0.058), (0, 0.008, 0.0725)]
    flesh = limb(joints, [0.0108, 0.0094, 0.0098, 0.0085, 0.0087, 0.0071], blend=0.004)
    bed = ellipsoid((0, 0.0005, 0.0705), (0.0058, 0.006, 0.0085))
    plate = intersection(grown(flesh, 0.0008), bed, blend=0.001)
    finger = union(intersection(flesh, above(0.0), blend=0.003), plate, blend=0.0004)
    z = 0.0185
    band = revolved([(0.006, z - 0.003), (0.0122, z - 0.003), (0.0122, z + 0.003), (0.006, z + 0.003)], 0.0012)
    stone_at = (0.0, -0.0158, z)
    setting = cone((0, -0.011, z), (0, -0.0145, z), 0.0042, 0.0046)
    stone = ellipsoid(stone_at, (0.0052, 0.0046, 0.0052))
    jewel = difference(union(band, setting, stone, blend=0.0012), grown(finger, GAP * size), blend=0.0006)

    def skin(p: Array) -> Array:
        colours = grained(plain(p, SKIN), p, 0.012, 0.05, 1)
        colours = over(colours, 0.5 * inside(noise(p, 0.018, 2) - 0.1, 0.8), "dd9478")
        colours = over(colours, 0.55 * dots(p, 0.0075, 0.0008, 0.0006, 3), "a8653f")
        wave = 0.0012 * noise(p, 0.006, 4)
        for height, width in ((0.0375, 0.0005), (0.0395, 0.0004), (0.0575, 0.0005), (0.0592, 0.0004)):
            colours = over(colours, 0.6 * inside(np.abs(p[:, 2] - height - wave) - width, 0.0007), "b8714f")
        front = inside(p[:, 1] - 0.0045, 0.001)
        colours = over(colours, 0.5 * front * inside(bed(p) - 0.0006, 0.0008), "b9785a")
        nail = front * inside(bed(p) + 0.0003, 0.0005)
        colours = over(colours, nail, "c22f4c")
        shine = np.abs(p[:, 0] + 0.002 + 0.0002 * np.sin(p[:, 2] * 900)) - 0.0005
        return over(
            colours, 0.7 * nail * inside(shine, 0.0006) * inside(np.abs(p[:, 2] - 0.0712) - 0.0038, 0.001), "f6c9d2"
        )

    def gold(p: Array) -> Array:
        angle = np.arctan2(p[:, 0], -p[:, 1])
        colours = grained(plain(p, "e2b13c"), p, 0.004, 0.08, 5)
        colours = over(colours, 0.7 * bands(angle + (p[:, 2] - z) * 150, np.pi / 9, 0.1, 0.4), "a8741d")
        colours = over(colours, inside(0.0026 - np.abs(p[:, 2] - z), 0.0006), "f4d57a")
        gem = inside(stone(p) - 0.0003, 0.0003) * inside(p[:, 1] + 0.0146, 0.0004)
        colours = over(colours, gem, "2f6fd0")
        facets = bands(np.arctan2(p[:, 0], p[:, 2] - z), np.pi / 4, 0.12)
        colours = over(colours, 0.6 * gem * facets, "17408c")
        return over(colours, gem * inside(np.hypot(p[:, 0] + 0.001, p[:, 2] - z - 0.001) - 0.0013, 0.0006), "e6f3ff")

    return Asset(
        name="ring",
        title="a ring on a finger",
        background=part("finger", finger, skin, box=((-0.013, -0.013, 0.0), (0.013, 0.017, 0.081)), spacing=0.0006),
        foregrounds=(part("ring", jewel, gold, box=((-0.016, -0.022, 0.01), (0.016, 0.016, 0.027)), spacing=0.0004),),
        warp=Warp(
            height=0.08,
            scale=(1.025, 1.025, 1.02),
            bend=(-0.005, 0.002),
            bulges=(Bulge(centre=(0.002, -0.002, 0.019), radius=0.012, shift=(0.0008, -0.0005, 0.0), swell=0.03),),
        ),
    )


def hat() -> Asset:
    """A bobble hat on a child's head, 31 cm with the shoulders."""
    size = 0.31
    skull = ellipsoid((0, 0.005, 0.19), (0.078, 0.088, 0.095))
    head = union(skull, ellipsoid((0, -0.02, 0.14), (0.06, 0.064, 0.056)), blend=0.035)
    head = union(head, cone((0, 0.015, 0.03), (0, 0.01, 0.11), 0.046, 0.042), blend=0.02)
    shoulders = ellipsoid((0, 0.012, 0.012), (0.115, 0.072, 0.052))
    head = union(head, shoulders, blend=0.03)
    ears = [ellipsoid((s * 0.08, 0.004, 0.163), (0.013, 0.02, 0.027)) for s in (-1, 1)]
    nose = ellipsoid((0, -0.091, 0.166), (0.015, 0.016, 0.014))
    head = union(head, *ears, nose, blend=0.01)
    cheeks = [sphere((s * 0.036, -0.062, 0.146), 0.024) for s in (-1, 1)]
    head = union(head, *cheeks, blend=0.02)
    hair = layer_on(skull, thickness=0.007, where=above(0.168, (0.0, -1.1)), blend=0.008)
    head = intersection(union(head, hair, blend=0.005), above(0.0), blend=0.006)

    rim = (0.0, -0.22)
    cap = layer_on(skull, thickness=0.016, where=above(0.208, rim), blend=0.006)
    cuff = layer_on(
        skull,
        thickness=lambda p: 0.023 + 0.0012 * np.cos(44 * np.arctan2(p[:, 0], p[:, 1])),
        where=intersection(above(0.203, rim), below(0.238, rim), blend=0.012),
        blend=0.012,
    )
    centre = (0.0, 0.012, 0.318)
    bobble = grown(sphere(centre, 0.026), lambda p: 0.0035 * noise(p, 0.009, 11))
    wool = difference(union(union(cap, cuff, blend=0.006), bobble, blend=0.006), grown(head, GAP * size), blend=0.003)

    def face(p: Array) -> Array:
        x, y, z = p.T
        colours = grained(plain(p, SKIN), p, 0.05, 0.04, 12)
        front = inside(y + 0.02, 0.01)
        for s in (-1, 1):
            cheek = np.linalg.norm((p - (s * 0.042, -0.075, 0.143)) / 0.026, axis=1)
            colours = over(colours, 0.55 * inside(cheek - 0.75, 0.6), "e07a68")
            eye = np.hypot((x - s * 0.029) / 0.011, (z - 0.187) / 0.014)
            colours = over(colours, front * inside(eye - 1.0, 0.15), "ffffff")
            iris = np.hypot(x - s * 0.028, z - 0.186)
            colours = over(colours, front * inside(iris - 0.0082, 0.0016), "4a7a3a")
            colours = over(colours, front * inside(iris - 0.0048, 0.0016), "1b1a18")
            colours = over(
                colours, front * inside(np.hypot(x - s * 0.028 + 0.003, z - 0.190) - 0.002, 0.0015), "ffffff"
            )
        freckles = dots(p, 0.011, 0.0014, 0.0012, 13) * inside(np.abs(z - 0.158) - 0.014, 0.006) * front
        colours = over(colours, 0.6 * freckles, "b06a43")
        smile = np.abs(z - 0.123 - 9.0 * x * x) - 0.0022
        colours = over(colours, front * inside(smile, 0.0016) * inside(np.abs(x) - 0.026, 0.002), "9c3b3b")
        strands = bands(np.arctan2(x, y) * 0.08 + 0.004 * noise(p, 0.03, 14), 0.006, 0.003)
        locks = over(grained(plain(p, "7a4524"), p, 0.012, 0.12, 15), 0.5 * strands, "56301a")
        share = inside(hair(p) - 0.0015, 0.002)[:, None]
        colours = colours + share * (locks - colours)
        shirt = inside(z - 0.052 + 0.3 * np.abs(x), 0.002)
        colours = over(colours, shirt, "3f6fae")
        return over(colours, shirt * bands(z - 0.12 * np.abs(x), 0.014, 0.0016, 0.35), "f3f1e7")

    def knitted(p: Array) -> Array:
        angle, level = np.arctan2(p[:, 0], -p[:, 1]), p[:, 2] - rim[1] * p[:, 1]
        colours = plain(p, "c23b36")
        colours = over(colours, inside(np.abs(level - 0.262) - 0.011, 0.002), "f5efe0")
        zigzag = np.abs(((angle * 7 / np.pi) % 1.0) - 0.5) * 0.028 - 0.007
        colours = over(colours, inside(np.abs(level - 0.262 - zigzag) - 0.0026, 0.0016), "2c5b4f")
        colours = over(colours, bands(angle, np.pi / 22, 0.05) * inside(level - 0.2385, 0.002), "a02c2b")
        colours = over(colours, 0.18 * bands(level + 0.002 * np.cos(60 * angle), 0.0055, 0.002), "401010")
        tuft = inside(np.linalg.norm(p - centre, axis=1) - 0.031, 0.004)
        colours = over(colours, tuft, "f5efe0")
        colours = over(colours, tuft * 0.8 * inside(noise(p, 0.008, 16) + 0.25, 0.4), "d8cdb6")
        return grained(colours, p, 0.008, 0.06, 17)

    return Asset(
        name="hat",
        title="a bobble hat on a head",
        background=part("head", head, face, box=((-0.13, -0.12, 0.0), (0.13, 0.12, 0.3)), spacing=0.0026),
        foregrounds=(part("hat", wool, knitted, box=((-0.12, -0.13, 0.17), (0.12, 0.13, 0.36)), spacing=0.0022),),
        warp=Warp(
            height=0.3,
            scale=(1.008, 1.008, 1.01),
            bend=(0.0085, -0.006),
            bulges=(Bulge(centre=(-0.02, -0.01, 0.24), radius=0.06, swell=0.015),),
        ),
    )


def sock() -> Asset:
    """A striped sock on a foot, 26 cm from heel to toe."""
    size, lift = 0.28, 0.0085
    leg = limb([(0, 0.05, 0.285), (0, 0.048, 0.17), (0, 0.05, 0.08)], [0.046, 0.042, 0.033], blend=0.02)
    heel = sphere((0, 0.066, 0.034), 0.033)
    arch = cone((0, 0.045, 0.05), (0.004, -0.085, 0.022), 0.034, 0.026)
    fore = ellipsoid((0.004, -0.09, 0.02), (0.044, 0.045, 0.024))
    ankles = [sphere((s * 0.026, 0.05, 0.082), 0.014) for s in (-1, 1)]
    smooth = union(leg, heel, arch, fore, *ankles, blend=0.03)
    row = [(-0.03, -0.132, 0.014), (-0.008, -0.137, 0.0115), (0.01, -0.133, 0.011), (0.026, -0.126, 0.0105)]
    row.append((0.039, -0.116, 0.0098))
    toes = [cone((x * 0.9, y + 0.03, r + 0.004), (x, y, r), r, r * 0.95) for x, y, r in row]
    bare = union(smooth, union(*toes, blend=0.002), blend=0.008)
    lower = above(0.0)
    hem = union(
        *(revolved([(0, low), (0.05 + out, low), (0.05 + out, high), (0, high)], 0.004) for out, low, high in HEM),
        blend=0.003,
    )
    raised = union(
        intersection(bare, lower, below(0.28), blend=0.008), lambda p: hem(p - (0.0, 0.049, 0.0)), blend=0.002
    )
    last = intersection(union(smooth, *toes, blend=0.025), lower, blend=0.012)

    def foot(p: Array) -> Array:
        return raised(p - (0.0, 0.0, lift))

    def form(p: Array) -> Array:
        return last(p - (0.0, 0.0, lift))

    top = 0.185

    def thickness(p: Array) -> Array:
        ribs = 0.0098 + 0.0008 * np.cos(26 * np.arctan2(p[:, 0], p[:, 1] - 0.05))
        return 0.0075 + inside(top - 0.033 - p[:, 2], 0.006) * (ribs - 0.0075)

    knit = layer_on(form, thickness=thickness, where=below(top), blend=0.006)
    sock_shape = difference(knit, grown(foot, GAP * size), blend=0.002)

    def skin(p: Array) -> Array:
        x, y, z = p.T
        colours = grained(plain(p, SKIN), p, 0.03, 0.05, 21)
        colours = over(colours, 0.5 * inside(noise(p, 0.045, 22) - 0.1, 0.8), "d9977a")
        colours = over(colours, 0.5 * dots(p, 0.02, 0.002, 0.0016, 23), "a3683f")
        for cx, cy, r in row:
            nail = np.linalg.norm((p - (cx, cy - 0.004, 2 * r + lift)) / (0.62 * r, 0.8 * r, 0.7 * r), axis=1)
            colours = over(colours, inside(nail - 1.0, 0.2), "f3c3bb")
        angle = np.arctan2(x, y - 0.049)
        denim = grained(plain(p, "3d5f8f"), p, 0.006, 0.12, 24)
        denim = over(denim, 0.35 * bands(angle + 30 * z, np.pi / 30, 0.04), "2b456e")
        denim = over(denim, inside(HEM[0][2] + lift + 0.003 - z, 0.001), "33507d")
        seams = np.minimum(np.abs(z - lift - 0.229), np.abs(z - lift - 0.247)) - 0.0008
        denim = over(denim, inside(seams, 0.001) * bands(angle, np.pi / 24, 0.03, 0.65), "e0a84a")
        share = inside(HEM[0][1] + lift - 0.0045 - z, 0.001)[:, None]
        return colours + share * (denim - colours)

    def wool(p: Array) -> Array:
        _, y, z = p.T
        colours = over(plain(p, "f2c14e"), bands(z, 0.03, 0.002), "3a6ea5")
        colours = over(colours, bands(z + 0.0008, 0.03, 0.0015, 0.14), "f7f3e6")
        along = bands(y + 0.012, 0.03, 0.002)
        sole = inside(z - 0.058 - 0.35 * (y - 0.03), 0.003) * inside(y - 0.035, 0.004)
        colours = colours + sole[:, None] * (over(plain(p, "f2c14e"), along, "3a6ea5") - colours)
        colours = over(colours, inside(np.linalg.norm(p - (0, 0.1, 0.025), axis=1) - 0.056, 0.003), "d1495b")
        colours = over(colours, inside(y + 0.1, 0.003), "d1495b")
        cuff = inside(top - 0.036 - z, 0.002)
        colours = over(colours, cuff, "d1495b")
        angle = np.arctan2(p[:, 0], y - 0.05)
        colours = over(colours, cuff * bands(angle, np.pi / 13, 0.06), "a8323f")
        colours = over(colours, 0.14 * bands(z + y * 0.5, 0.005, 0.002), "202040")
        return grained(colours, p, 0.007, 0.06, 25)

    return Asset(
        name="sock",
        title="a sock on a foot",
        background=part("foot", foot, skin, box=((-0.065, -0.16, 0.0), (0.065, 0.115, 0.3)), spacing=0.0022),
        foregrounds=(part("sock", sock_shape, wool, box=((-0.07, -0.17, -0.004), (0.07, 0.12, 0.2)), spacing=0.002),),
        warp=Warp(
            base=(0.0, 0.05, 0.0),
            height=0.29,
            scale=(1.03, 1.01, 1.0),
            bend=(0.012, 0.008),
            bulges=(Bulge(centre=(0.0, 0.05, 0.1), radius=0.04, swell=0.06),),
        ),
    )
