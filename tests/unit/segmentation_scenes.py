# SPDX-License-Identifier: MIT
"""Drawn solids that stand in front of each other, for the tests of outlines and order."""

import cv2
import numpy as np

WIDTH, HEIGHT = 320, 240


def polygon(*points):
    drawn = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillPoly(drawn, [np.array(points, np.int32)], 1)
    return drawn > 0


def disc(x, y, radius, stretch=1.0):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (columns - x) ** 2 + ((rows - y) / stretch) ** 2 < radius**2


def cylinder(x, top, base, radius, sag=0.3):
    """Seen from above: a rectangle between two ellipses."""
    body = polygon((x - radius, top), (x + radius, top), (x + radius, base), (x - radius, base))
    return body | disc(x, top, radius, sag) | disc(x, base, radius, sag)


def bottle(x, top, base, radius):
    neck, shoulder = 0.4 * radius, top + 0.45 * (base - top)
    outline = polygon(
        (x - neck, top), (x + neck, top), (x + neck, top + 0.25 * (base - top)), (x + radius, shoulder),
        (x + radius, base), (x - radius, base), (x - radius, shoulder), (x - neck, top + 0.25 * (base - top)),
    )  # fmt: skip
    return outline | disc(x, base, radius, 0.25)


def overlap(first, second):
    return (first & second).sum() / max(1, (first | second).sum())
