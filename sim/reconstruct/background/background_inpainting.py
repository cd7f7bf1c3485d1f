# SPDX-License-Identifier: MIT
"""Inpaint the background, each surface in the view in which its texture is stationary.

The ground is inpainted in a rectified top view (``top_view``), walls and distant surfaces in the photo itself. Borders
between surfaces come from ``surface_edges``; neither side is a source for the other.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...composite.inpaint import FillOptions, hole_parts
from ...errors import InputError
from ...scene.model import Camera
from ..segmentation.plain_backdrop import plain_backdrop
from .inpainting_methods import AS_LATTICE, BY_STRETCHES, METHODS, InpaintingTask, box
from .lattice_pattern import Lattice, find_lattice, goes_on
from .method_choice import MethodChoice, choose_method
from .relit_ground import continued, near_any, relit, smoothed
from .surface_edges import Edge, edges_behind
from .surface_inpainting import DARKEST, logarithms

Mask = NDArray[np.bool_]

FEATHER = 4.0
"""Pixels at 1024 over which the inpainting fades into the photo, inside the hole only."""
CLEAR = 2.0
"""Pixels beside an object that are mixed with it."""
BESIDE = 3.0
"""The same in pixels at 1024, for what is looked at beside an object inside its hole."""
LEVEL, REACH = 3.0, 10.0
"""Pixels at 1024: blur in which levels are compared along the border, and depth over which a local difference is
compensated."""
STRETCH = 0.06
"""Blur over the hole's size in which differences along the border are those of a level, and not of the pattern."""
STEP = 0.4
"""Difference in logarithms along the border above which it is the edge of a thing, and not one of level."""


def blend(
    photo: NDArray[np.uint8],
    filling: NDArray[np.uint8] | NDArray[np.float32],
    hole: Mask,
    objects: Mask,
    shade: Mask | None = None,
) -> NDArray[np.uint8]:
    """Return ``filling`` (H, W, 3), 0 to 255, within ``hole`` (H, W), and ``photo`` outside of it, bit for bit.

    objects: (H, W), must not show through the transition. Where there is room between them and the border of the hole,
    the photo fades out there; a difference of level along the border is compensated. shade: (H, W) shadow outside of
    the hole, or other things, whose level is ignored.
    """
    if not hole.any():
        return photo.copy()
    unit = max(hole.shape) / 1024.0
    filled = filling.astype(np.float32)
    filled = filled + _lead(photo.astype(np.float32), filled, hole, objects if shade is None else objects | shade, unit)
    alpha = feather(hole, objects)[..., None]
    mixed = np.where(alpha >= 1.0, filled, photo + alpha * (filled - photo))
    return np.where(hole[..., None], np.clip(mixed + 0.5, 0, 255).astype(np.uint8), photo)


def feather(hole: Mask, objects: Mask) -> NDArray[np.float32]:
    """Return the weight (H, W) of the inpainting: 0 outside the hole, 1 deep inside and on the objects."""
    width = max(1.0, FEATHER * max(hole.shape) / 1024.0)
    depth = ndimage.distance_transform_edt(np.pad(hole, 1, mode="edge"))[1:-1, 1:-1]
    if objects.any():
        # Where an object comes close to the border of its hole, the feather must end before it.
        away = ndimage.distance_transform_edt(~objects)
        room = np.maximum(depth + away - CLEAR, 1.0)
        weight = depth / np.minimum(width, room)
        weight[away <= CLEAR] = 1.0
    else:
        weight = depth / width
    return np.asarray(np.where(hole, np.clip(weight, 0.0, 1.0), 0.0), dtype=np.float32)


def _lead(
    photo: NDArray[np.float32], filled: NDArray[np.float32], hole: Mask, objects: Mask, unit: float
) -> NDArray[np.float32]:
    """Correction (H, W, 3) that matches the level of ``filled`` to the photo's at the border of the hole.

    What differs over long stretches of the border, by more than the surroundings' pattern does, is a level: it is
    continued inside as a membrane, so that no patch of another brightness stays in sight. The rest fades within
    ``REACH``.
    """
    rows, columns = np.flatnonzero(hole.any(axis=1)), np.flatnonzero(hole.any(axis=0))
    side = float(np.sqrt(hole.sum()))
    band, stretch = max(2.0, LEVEL * unit), max(2.0, LEVEL * unit, STRETCH * side)
    room = round(max(4 * REACH * unit, 0.5 * side)) + 4
    window = (
        slice(max(0, rows[0] - room), rows[-1] + 1 + room),
        slice(max(0, columns[0] - room), columns[-1] + 1 + room),
    )
    inside, stood, around = hole[window], objects[window], photo[window]
    depth = ndimage.distance_transform_edt(np.pad(inside, 1, mode="edge"))[1:-1, 1:-1]
    outer = ndimage.distance_transform_edt(~inside) if not inside.all() else np.full(inside.shape, np.inf)
    clear = ndimage.distance_transform_edt(~stood) > CLEAR + 1.0 if stood.any() else np.ones_like(inside)
    shown = ~inside & (outer <= band) & clear
    new = inside & (depth <= band)
    result = np.zeros_like(filled)
    if not shown.any() or not new.any():
        return result
    seen, mine = smoothed(around, shown, band), smoothed(filled[window], new, band)
    gap = seen - mine
    # A larger step is the edge of a thing.
    step = np.abs(np.log(np.maximum(seen, DARKEST)) - np.log(np.maximum(mine, DARKEST))).max(axis=-1)
    rim = new & (depth <= 1.5) & (step < STEP) & near_any(shown, band) & near_any(new, band)
    if not rim.any():
        return result
    known = ~inside & clear
    usual = smoothed(around, known, stretch) - smoothed(around, known, 3.0 * stretch)
    chance = np.square(usual[known & (outer < room)]).mean(axis=0)
    wide = smoothed(gap, rim, stretch)
    level = wide * np.maximum(1.0 - chance / np.maximum(np.square(wide), 1e-6), 0.0)
    deep = continued(level, rim, inside)
    spread = REACH * unit
    fade = np.exp(-np.square(depth / (2.0 * spread)))[..., None]
    rest = smoothed(gap - level, rim, spread) * fade * near_any(rim, spread)[..., None]
    result[window] = np.where(inside[..., None], deep + rest, 0.0)
    return result


Picture = NDArray[np.float32]

NEAR = 0.15
"""Range of leftover shadow around the hole, over the hole's size."""
DARKER = 0.15
"""Log difference by which it is darker than nearly all of the surroundings farther away."""
NEARLY_ALL = 8.0
"""Percentile of the surroundings used as their darkest: below it, darkness is common there."""
LEAST, MOST = 0.1, 0.8
"""Share of a hole's lower rim in leftover shadow: less is a joint between tiles, more the surface itself."""


def leftover_shadow(logs: Picture, part: Mask, closed: Mask) -> Mask:
    """Return pixels (H, W) beside ``part`` of the hole that are still in shadow, and so not a source for inpainting.

    logs: (H, W, 3) logarithms of the photo's values, valid where not ``closed``.
    """
    result = np.zeros_like(part)
    rows, columns = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    side = float(np.sqrt(part.sum()))
    room = round(0.8 * side) + 8
    window = (
        slice(max(0, int(rows[0]) - room), int(rows[-1]) + 1 + room),
        slice(max(0, int(columns[0]) - room), int(columns[-1]) + 1 + room),
    )
    inside, known = part[window], ~closed[window]
    light = cv2.blur(np.ascontiguousarray(logs[window].mean(axis=-1)), (3, 3))
    away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    # The foot of the object, and its shadow, are in the lower half of the hole.
    lower = np.arange(inside.shape[0])[:, None] > float(np.nonzero(inside)[0].mean())
    reach = max(NEAR * side, 3.0)
    near, far = known & (away <= reach) & lower, known & (away > 1.5 * reach) & lower
    if near.sum() < 16 or far.sum() < 100:
        return result
    dark = near & (light < np.percentile(light[far], NEARLY_ALL) - DARKER)
    if not LEAST * near.sum() < dark.sum() < MOST * near.sum():
        return result
    # Only parts connected to the hole.
    count, labels = cv2.connectedComponents((dark | inside).astype(np.uint8), connectivity=8)
    joined = np.isin(labels, np.unique(labels[inside])) if count > 2 else np.ones_like(inside)
    dark = cv2.dilate((dark & joined).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    result[window] = dark & near
    return result


Notice = Callable[[str], None]

BACKDROP, BACKDROP_RIM = 0.9, (8.0, 28.0)
"""Share of the photo around a hole that is plain backdrop, above which the hole shows nothing else; and from how far to
how far beside it, in pixels at 1024: nearer lie the blurred outlines of what stands there."""
SMALL = 2e-4
"""Share of the photo below which a part uses the default method without a trial."""
REPEATED = 5e-3
"""Share of the photo from which a lattice is looked for: that takes about three seconds of CPU time."""
SPECK = 0.02
"""Share of a surface's part of the hole below which pieces of it are inpainted together."""
GUESSED = 1.0
"""Gain in decibels over a plain colour below which the inpainting is a guess."""
GOOD = 32.0
"""Score in decibels above which the inpainting is right, as on a plain wall, where a plain colour does no worse."""
NOTICED = 0.01
"""Share of the photo above which a guess gives a notice."""
PHOTO_WAYS = ("by rows", "by rows without light", "as a surface", BY_STRETCHES)
GROUND_WAYS = ("as ground",)


def fill_background(
    pixels: NDArray[np.uint8],
    hole: Mask,
    objects: Mask,
    camera: Camera,
    options: FillOptions | None = None,
    notice: Notice = lambda _: None,
    barred: Mask | None = None,
    changed: Mask | None = None,
) -> NDArray[np.uint8]:
    """Return ``pixels`` (H, W, 3) sRGB with ``hole`` (H, W) inpainted; outside the hole it equals the photo bit for
    bit.

    objects: (H, W) pixels that must show neither in the result nor through the transition at its border, inside
    ``hole``. camera: above the ground z = 0. barred: pixels outside of the hole that are not a source, such as
    remaining objects. Raises InputError when hardly any background is left as a source, for sizes that differ, or when
    the native library is missing.
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
            f"objects and shadows cover {100 * hole.mean():.0f} % of the photo: no background is left to inpaint from; "
            "use a photo with more room around the objects, or a smaller hole_dilation"
        )
    # Pixels beside a remaining object are mixed with it.
    barred = _widened(barred, max(2, round(3 * max(hole.shape) / 1024))) & ~hole
    filling = pixels.astype(np.float32)
    open_hole = hole.copy()
    shade = np.zeros_like(hole)
    backdrop = _plain(pixels)
    for part in hole_parts(hole):
        # Leftover shadow outside of the hole is neither a source nor a reference level.
        dark = leftover_shadow(logarithms(filling), part, open_hole | barred)
        shade |= dark
        closed = open_hole | barred | dark
        if _amid(part, backdrop, closed):
            # It has no pattern and no edge that would have to go on.
            known = (backdrop > 0) & ~closed
            filling = np.where(part[..., None], continued(filling, known, ~known), filling)
            open_hole &= ~part
            continue
        _fill_part(filling, part, open_hole, barred, dark, objects, changed, camera, options, notice)
        open_hole &= ~part
    return blend(pixels, filling, hole, objects, shade | barred)


def _plain(pixels: NDArray[np.uint8]) -> NDArray[np.int32]:
    """The plain backdrop of ``pixels`` (H, W, 3): numbers (H, W) of its connected parts, 0 elsewhere."""
    found = plain_backdrop(pixels)
    if found is None:
        return np.zeros(pixels.shape[:2], dtype=np.int32)
    # Its border is mixed with what stands before it.
    inner = cv2.erode(found.astype(np.float32), np.ones((3, 3), np.uint8))
    large = cv2.resize(inner, pixels.shape[1::-1], interpolation=cv2.INTER_LINEAR) > 0.99
    return np.asarray(cv2.connectedComponents(large.astype(np.uint8), connectivity=4)[1], dtype=np.int32)


def _amid(part: Mask, backdrop: NDArray[np.int32], closed: Mask) -> bool:
    """Whether around the hole ``part`` (H, W) there is nothing but one part of the ``backdrop``, see ``_plain``: a wall
    and a floor with an edge between them are two. ``closed``: (H, W) what tells nothing."""
    near, far = (max(1, round(reach * max(part.shape) / 1024)) for reach in BACKDROP_RIM)
    beside = backdrop[_widened(part, far) & ~_widened(part, near) & ~closed]
    return bool(len(beside) and np.bincount(beside)[1:].max(initial=0) > BACKDROP * len(beside))


def _widened(mask: Mask, radius: int) -> Mask:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _fill_part(
    filling: Picture,
    part: Mask,
    open_hole: Mask,
    barred: Mask,
    dark: Mask,
    objects: Mask,
    changed: Mask | None,
    camera: Camera,
    options: FillOptions,
    notice: Notice,
) -> None:
    """Inpaint the connected ``part`` of ``open_hole`` in ``filling``, in place, surface by surface.

    dark: shadow outside of the hole, which is no source.
    """
    covered = _widened(objects & open_hole, max(1, round(BESIDE * max(part.shape) / 1024))) | barred
    logs, lattice = logarithms(filling), None
    edges = edges_behind(logs, part, covered, open_hole | dark)
    barred = barred | dark
    rest = barred | (open_hole & ~part)
    if part.sum() > REPEATED * part.size:
        lattice = find_lattice(logs, part, rest, camera)
    if lattice is not None:
        # Joints are straight edges, too.
        above = [~edge.below(part.shape) for edge in edges]
        same = goes_on(lattice, logs, part, rest, camera, above)
        edges = [edge for edge, joint in zip(edges, same, strict=True) if not joint]
    for side, ground in _sides(edges, part.shape):
        target, others = part & side, rest | ~side
        if ground and lattice is None and edges and target.sum() > REPEATED * target.size:
            lattice = find_lattice(logs, target, others, camera)
        choice = None
        if ground and lattice is not None and target.any():
            task = InpaintingTask(filling, target, others, camera, options, lattice)
            choice = choose_method(task, (*PHOTO_WAYS, *GROUND_WAYS, AS_LATTICE))
        if ground and (choice is None or choice.way != AS_LATTICE):
            # A pattern that repeats is known better than what is left of it in shadow.
            filling[...], target = relit(filling, target, others, objects, changed)
            lattice = choice = None
        _fill_surface(filling, target, others, objects, ground, camera, options, notice, lattice, choice)
    _soften(filling, part, edges)


def _fill_surface(
    filling: Picture,
    target: Mask,
    closed: Mask,
    objects: Mask,
    ground: bool,
    camera: Camera,
    options: FillOptions,
    notice: Notice,
    lattice: Lattice | None,
    choice: MethodChoice | None,
) -> None:
    """Inpaint ``target`` of one surface in ``filling``, in place, piece by piece, each at the level of its border.

    choice: of the method, where it has been made; ``lattice`` is for that one alone.
    """
    pieces = _pieces(target)
    if not pieces:
        return
    largest = pieces[-1]
    if choice is None and largest.sum() > SMALL * largest.size:
        # Surfaces beyond the ground's far border never use the top view.
        ways = PHOTO_WAYS + GROUND_WAYS if ground else PHOTO_WAYS
        choice = choose_method(InpaintingTask(filling, largest, closed | (target & ~largest), camera, options), ways)
    choice = choice or MethodChoice(PHOTO_WAYS[0], {}, np.inf)
    reliable = choice.certain >= GUESSED or choice.scores.get(choice.way, 0.0) >= GOOD
    if not reliable and largest.sum() > NOTICED * largest.size:
        rows, columns = box(largest, 0)
        notice(
            f"the background behind columns {columns.start} to {columns.stop}, rows {rows.start} to {rows.stop} "
            "is a guess: its surroundings do not determine it; give a photo without the objects (--inpainter"
            " picture:FILE) if it matters"
        )
    left = target
    for piece in pieces:
        left = left & ~piece
        task = InpaintingTask(filling, piece, closed | left, camera, options, lattice)
        filled = METHODS[choice.way](task)
        filled += _lead(filling, filled, piece, objects | closed | left, max(piece.shape) / 1024.0)
        filling[piece] = np.clip(filled, 0.0, 255.0)[piece]


def _pieces(target: Mask) -> list[Mask]:
    """The connected parts of ``target``, smallest first; specks come together."""
    parts = hole_parts(target)
    specks = [part for part in parts if part.sum() <= max(SMALL * part.size, SPECK * target.sum())]
    return parts if len(specks) < 2 else [np.logical_or.reduce(specks), *parts[len(specks) :]]


def _sides(edges: list[Edge], shape: tuple[int, int]) -> list[tuple[Mask, bool]]:
    """The surfaces into which ``edges`` divide the photo, and whether each may be the ground, from the lowest up."""
    sides: list[tuple[Mask, bool]] = [(np.ones(shape, dtype=bool), True)]
    for edge in edges:
        below = edge.below(shape)
        following: list[tuple[Mask, bool]] = []
        for side, ground in sides:
            following += [(side & below, ground), (side & ~below, False)]
        sides = following
    return [(side, ground) for side, ground in sides if side.any()]


def _soften(filling: Picture, part: Mask, edges: list[Edge]) -> None:
    """Blur ``filling`` along ``edges`` as a lens would; in place, within ``part``."""
    if not edges:
        return
    smooth = cv2.GaussianBlur(filling, (0, 0), 0.7)
    for edge in edges:
        near = part & (np.abs(edge.height(part.shape)) < 1.5)
        filling[near] = smooth[near]
