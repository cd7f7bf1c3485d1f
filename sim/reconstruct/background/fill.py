# SPDX-License-Identifier: MIT
"""The photo without what stood in it: each surface in the hole filled in the view in which it looks alike everywhere.

The ground is filled as seen from above (``top_view``), walls and all that is far away in the photo itself. Where one
surface ends and another begins is told by ``borders``; neither is a source for the other.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.inpaint import FillOptions
from ...errors import InputError
from ...scene.model import Camera
from .border import blend
from .leftover import left_over
from .shading import logarithms
from .surface_edges import Edge, edges_through
from .trial import Choice, choose
from .ways import WAYS, Task, box

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]
Notice = Callable[[str], None]

SMALL = 2e-4
"""Share of the photo; parts that are smaller are not worth a trial."""
GUESSED = 1.0
"""Decibels over a plain colour; a way that gains less where it is tried can only guess."""
GOOD = 32.0
"""Decibels; a way that does as well as this guesses right, as on a plain wall, where a plain colour does no worse."""
TOLD = 0.01
"""Share of the photo; guesses that are smaller are not told."""
PHOTO_WAYS = ("by rows", "by rows without light", "as a surface")
GROUND_WAYS = ("as ground",)


def fill_background(
    pixels: NDArray[np.uint8],
    hole: Mask,
    objects: Mask,
    camera: Camera,
    options: FillOptions | None = None,
    notice: Notice = lambda _: None,
    barred: Mask | None = None,
) -> NDArray[np.uint8]:
    """``pixels`` (H, W, 3) sRGB with ``hole`` (H, W) filled; outside the hole equal to the photo bit for bit.

    objects: what may be seen neither in the filling nor through the transition at its border, inside ``hole``.
    camera: above the ground z = 0. barred: pixels outside of the hole that are no source, as objects that stay.
    Raises InputError when hardly any background is left to fill from, for sizes that differ, or when the native library
    is missing.
    """
    options = options or FillOptions()
    barred = np.zeros_like(hole) if barred is None else barred & ~hole
    for name, mask in (("hole", hole), ("objects", objects), ("barred", barred)):
        if mask.shape != pixels.shape[:2]:
            raise InputError(f"{name} is {mask.shape}, the photo {pixels.shape[:2]}: give masks of the photo's size")
    if not hole.any():
        return pixels.copy()
    if (~(hole | barred)).mean() < 0.02:
        raise InputError(
            f"objects and shadows cover {100 * hole.mean():.0f} % of the photo: no background is left to fill from; "
            "use a photo with more room around the objects, or a smaller hole_dilation"
        )
    # A pixel beside an object that stays shows a mixture with it.
    barred = _widened(barred, max(2, round(3 * max(hole.shape) / 1024))) & ~hole
    filling = pixels.astype(np.float32)
    open_hole = hole.copy()
    shade = np.zeros_like(hole)
    for part in _parts(hole):
        # Shadow that is left outside of the hole is no source, and nothing is led up to it.
        dark = left_over(logarithms(filling), part, open_hole | barred)
        shade |= dark
        _fill_part(filling, part, open_hole, barred | dark, camera, options, notice)
        open_hole &= ~part
    return blend(pixels, filling, hole, objects, shade)


def _widened(mask: Mask, radius: int) -> Mask:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _parts(hole: Mask) -> list[Mask]:
    """The connected parts of ``hole``, smallest first: small ones are filled best and then serve as surroundings."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    order = np.argsort(stats[1:count, cv2.CC_STAT_AREA], kind="stable") + 1
    return [np.asarray(labels == index) for index in order]


def _fill_part(
    filling: Picture,
    part: Mask,
    open_hole: Mask,
    barred: Mask,
    camera: Camera,
    options: FillOptions,
    notice: Notice,
) -> None:
    """Fill the connected ``part`` of ``open_hole`` in ``filling``, in place, surface by surface."""
    edges = edges_through(logarithms(filling), part, open_hole | barred)
    for side, ground in _sides(edges, part.shape):
        target = part & side
        if not target.any():
            continue
        task = Task(filling, target, barred | (open_hole & ~part) | ~side, camera, options)
        # What lies beyond the ground's far border is never looked at from above.
        ways = PHOTO_WAYS + GROUND_WAYS if ground else PHOTO_WAYS
        choice = choose(task, ways) if target.sum() > SMALL * target.size else Choice(PHOTO_WAYS[0], {}, np.inf)
        told = choice.certain >= GUESSED or choice.scores.get(choice.way, 0.0) >= GOOD
        if not told and target.sum() > TOLD * target.size:
            rows, columns = box(target, 0)
            notice(
                f"the background behind columns {columns.start} to {columns.stop}, rows {rows.start} to {rows.stop} "
                "is a guess: its surroundings do not tell how it goes on; give a photo without the objects (--inpainter"
                " picture:FILE) where it matters"
            )
        filling[target] = WAYS[choice.way](task)[target]
    _soften(filling, part, edges)


def _sides(edges: list[Edge], shape: tuple[int, int]) -> list[tuple[Mask, bool]]:
    """The surfaces that ``edges`` part the photo into, and whether each may be the ground, from the lowest on."""
    sides: list[tuple[Mask, bool]] = [(np.ones(shape, dtype=bool), True)]
    for edge in edges:
        below = edge.below(shape)
        following: list[tuple[Mask, bool]] = []
        for side, ground in sides:
            following += [(side & below, ground), (side & ~below, False)]
        sides = following
    return [(side, ground) for side, ground in sides if side.any()]


def _soften(filling: Picture, part: Mask, edges: list[Edge]) -> None:
    """Along ``edges`` pixels show both surfaces, as a lens would have it; in place, within ``part``."""
    if not edges:
        return
    smooth = cv2.GaussianBlur(filling, (0, 0), 0.7)
    for edge in edges:
        near = part & (np.abs(edge.height(part.shape)) < 1.5)
        filling[near] = smooth[near]
