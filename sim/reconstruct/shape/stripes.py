# SPDX-License-Identifier: MIT
"""Stripes: the part of a coloured region at an object's outline that goes on round the body, and marks beside it.

A ribbon reaches the outline at both ends and goes on behind; the bow on it does not. So along the way from one end to
the other a region goes on as wide as it is at the outline. One that touches the outline with a corner, such as a heart
on a narrow board, does not go on at all. Regions are distinguished by colour alone: light and shade divide none.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.graph import MCP_Geometric

Mask = NDArray[np.bool_]

BRIGHT, DARK = 60.0, 10.0
"""Colourfulness is divided by (L* + DARK) / BRIGHT: shade makes a colour less colourful, not another one."""
ALIKE = 20.0
"""Difference of two such colours from which they make two regions."""
COLOURS = 6
"""Colours of an object at most, the most common ones."""
COMMON = 0.004
"""Least share of a colour in the object."""
SMALL = 16
"""Pixels below which a region is left as it is."""
CORNER = 0.85
"""Width at the outline over a region's own, below which it touches the outline with a corner: more of it lies in front
than can lie behind."""
LIKE_ENDS = 0.3
"""Width of an end over the widest one's, from which it is one."""
WIDER = 1.5
"""Width of a region over that at the outline, from which the rest is a mark beside it."""
AWAY = 3.0
"""Cost of a way along a region's border over that along its middle."""
EDGE = 2
"""Pixels by which a mark is grown: its border is mixed with what is around."""
STEP = 9.0
"""Difference in CIELAB, lightness at half weight, within ``EDGE`` pixels on both sides that makes an edge."""
WHOLE = 0.2
"""Share of the object from which what an edge encloses is no mark, but what the object consists of."""


def beside_stripes(lab: NDArray[np.floating], inside: Mask, rim: float) -> list[tuple[Mask, Mask]]:
    """Return pairs of a region (h, w) and of the pixels (h, w) of it, and next to it, that are no part of a stripe.

    lab: (h, w, 3) CIELAB, without grain. inside: (h, w) the object. rim: width of the outline's band in pixels.
    """
    labels, count = _regions(lab, inside)
    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    band = inside & (depth <= rim + 1.0)
    found = []
    for number in range(1, count + 1):
        region = labels == number
        if region.sum() < SMALL:
            continue
        mark = region & ~_going_on(region, band, rim + 1.0)
        if mark.sum() >= SMALL:
            grown = ndimage.binary_dilation(mark, iterations=EDGE) & inside
            found.append((ndimage.binary_dilation(region, iterations=EDGE) & inside, grown & (~region | mark)))
    return found


def enclosed(lab: NDArray[np.floating], inside: Mask, rim: float) -> Mask:
    """Return the pixels (h, w) that an edge separates from the outline on all sides, as a badge that touches a wing.

    Arguments as for ``beside_stripes``. In no channel alone need they be an island: a white badge between a grey wing
    and a yellow belly is as light as the belly and as colourless as the wing.
    """
    weighted = (lab * (0.5, 1.0, 1.0)).astype(np.float32)
    window = np.ones((2 * EDGE + 1, 2 * EDGE + 1), np.uint8)
    step = np.linalg.norm(cv2.dilate(weighted, window) - cv2.erode(weighted, window), axis=-1)
    labels, _ = ndimage.label(inside & (step < STEP))
    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1]
    sizes = np.bincount(labels.ravel())
    kept = (sizes >= SMALL) & (sizes <= WHOLE * inside.sum())
    kept[labels[depth <= rim + 1.0 + EDGE]] = False
    kept[0] = False
    if not kept.any():
        return np.zeros_like(inside)
    # Up to the edge's other side.
    return np.asarray(inside & (ndimage.distance_transform_edt(~kept[labels]) <= 2 * EDGE + 1))


def _regions(lab: NDArray[np.floating], inside: Mask) -> tuple[NDArray[np.int32], int]:
    """Connected regions (h, w) of other colours than the most common one, numbered from 1, and their count."""
    flat = lab[inside][:, 1:] * BRIGHT / (lab[inside][:, :1] + DARK)
    nearest = np.full(len(flat), np.inf)
    own = np.zeros(len(flat), dtype=np.int32)
    for index in range(COLOURS):
        left = np.flatnonzero(nearest > ALIKE)
        if len(left) < max(SMALL, COMMON * len(flat)):
            break
        tried = flat[left[:: max(1, len(left) // 200)]]
        near = np.linalg.norm(tried[:, None] - flat[left][None, :: max(1, len(left) // 2000)], axis=-1) < 0.5 * ALIKE
        colour = tried[int(np.argmax(near.sum(axis=1)))]
        distance = np.linalg.norm(flat - colour, axis=1)
        closer = distance < nearest
        own[closer], nearest[closer] = index, distance[closer]
    grid = np.full(inside.shape, -1, dtype=np.int32)
    grid[inside] = own
    labels, count = np.zeros(inside.shape, dtype=np.int32), 0
    for index in range(1, int(own.max(initial=0)) + 1):
        parts, number = ndimage.label(ndimage.binary_opening(grid == index))
        labels[parts > 0] = parts[parts > 0] + count
        count += number
    return labels, count


def _going_on(region: Mask, band: Mask, rim: float) -> Mask:
    """The part (h, w) of a ``region`` that goes on behind the outline, whose band is ``rim`` pixels wide."""
    contacts, count = ndimage.label(ndimage.binary_dilation(region & band, iterations=EDGE) & region)
    parts = [region & band & (contacts == number) for number in range(1, count + 1)]
    most = max((int(part.sum()) for part in parts), default=0)
    parts = [part for part in parts if part.sum() >= max(LIKE_ENDS * most, rim)]
    if not parts:
        return np.zeros_like(region)
    radius = ndimage.distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1]
    # The narrowest end: what lies on a ribbon may reach one of them.
    width = min(float(part.sum()) for part in parts) / rim
    own = 2.0 * float(radius.max())
    if len(parts) == 1:
        return region if width >= CORNER * own else np.zeros_like(region)
    if own <= WIDER * width:
        return region
    # The way from one end to all others, along the middle.
    cost = np.where(region, 1.0 + AWAY / np.maximum(radius, 0.5), np.inf)
    starts, *ends = (_middle(part, radius) for part in parts)
    search = MCP_Geometric(cost, fully_connected=True)
    search.find_costs([starts])
    way = np.zeros(region.shape, dtype=np.uint8)
    for end in ends:
        line = np.array(search.traceback(end))[:, ::-1].astype(np.int32)
        cv2.polylines(way, [line], False, 1)
    distance = ndimage.distance_transform_edt(way == 0)
    return np.asarray(region & (distance <= 0.5 * width + 1.0))


def _middle(part: Mask, radius: NDArray[np.float64]) -> tuple[int, int]:
    """The pixel of ``part`` that lies farthest from the region's border."""
    row, column = np.unravel_index(int(np.argmax(np.where(part, radius, -1.0))), part.shape)
    return int(row), int(column)
