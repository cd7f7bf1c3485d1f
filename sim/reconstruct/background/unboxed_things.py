# SPDX-License-Identifier: MIT
"""Things on the ground without a box: they stay in the photo, and inpainting does not copy from them.

A thing is a compact region with a sharp outline and another colour than the ground around it, about as large as the
boxed objects. A pattern of the ground is none: it covers much of the ground, or the rest of the ground predicts it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.morphology import h_maxima
from skimage.segmentation import watershed

from ...scene.equirectangular import LUMINANCE
from ...scene.model import Camera
from ...srgb import bytes_to_linear
from ..camera.ground_camera import on_ground
from ..segmentation.alike_blocks import blocks_of_a_kind
from ..segmentation.mask_geometry import grown
from ..segmentation.round_things import circles_of_a_kind
from .lattice_pattern import repeated
from .surface_inpainting import logarithms
from .texture_prediction import predict_texture

Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

OBJECT_SIDE, MOST_PIXELS = 48.0, 250_000
"""Size in pixels of the object in the copy in which things are looked for; largest size of that copy."""
AROUND, FARTHER = 1.8, 3.2
"""Range in which they are looked for, over the object's longer side; and where something reaches its border."""
LONGEST_FAR = 2.5
"""Length over width of a thing that reaches beyond ``AROUND``."""
NECK = 0.5
"""Width of a neck between two things that touch, over that of the narrower, below which they are two."""
APART = 3.5
"""Difference from the ground's smooth colour, over the spread of the ground."""
LEAST_LUMINANCE, LEAST_CHROMA = 0.07, 0.05
"""Least spread of the ground, natural logarithms: below it is noise."""
MODE = 0.25
"""Width of a mode of the ground's brightness, natural logarithms."""
SMALLEST, LARGEST = 0.06, 5.0
"""Area of a thing over the object's."""
SOLID = 0.75
"""Least share of a thing in its convex hull."""
SHARP = 0.6
"""Least share of a thing's outline across which the colour jumps."""
LONGEST_CUT = 1.0
"""Length over the object's size, along the horizon or the border of the photo or of the range, above which it is
another surface that goes on."""
PATTERN = 0.55
"""Share of the ground above which they are its pattern, and predictable share of variance above which they are too."""
SHADE_TINT = 0.2
"""Log chroma that a shadow changes at most, over its depth: shadows under a sky are bluish, black is never quite
black."""
ON_GROUND = 0.25
"""Share of a row of the range that is ground, from which what stands in that row may stand before more of it."""
RIM, BOXED = 1.05, 0.3
"""Radius of a round thing of many over that of the circle that was found, which may be its rim's inner edge; and share
of it that is an object's from which it is that object.
"""
FEWEST = 3
"""Things from which they may be a pattern that repeats."""
HIDDEN = 0.1
"""Share of a thing's outline along an object above which the thing continues behind it."""
MIRROR_OFF = (-0.1, -0.05, 0.0, 0.05, 0.1, 0.15)
"""Heights of an object by which the line at which it is mirrored may lie below the end of its mask."""
MIRROR_INSIDE, MIRROR_LIKE = 0.7, 0.6
"""Share of a mirror image that the object, turned over, covers; and its correlation with that, beside the ground."""


@dataclass(frozen=True)
class UnboxedThings:
    """stay: (H, W) pixels of things that must stay in the photo. whole: (H, W) those of them that no object hides
    partly; they say nothing about what is behind an object. count: of separate things, as they appear."""

    stay: Mask
    whole: Mask

    @property
    def count(self) -> int:
        """Separate regions of ``stay``."""
        return int(cv2.connectedComponents(self.stay.astype(np.uint8), connectivity=8)[0]) - 1


def unboxed_things(pixels: NDArray[np.uint8], masks: Sequence[Mask], camera: Camera) -> UnboxedThings:
    """Return things without a box on the ground near the objects.

    pixels: (H, W, 3) sRGB. masks: (H, W) visible pixels of the objects. camera: above the ground z = 0; nothing is
    looked for above the horizon.
    """
    stay, whole = np.zeros((2, *pixels.shape[:2]), dtype=bool)
    objects = np.logical_or.reduce(list(masks))
    for mask in masks:
        if mask.any():
            _look_around(pixels, mask, objects, camera, stay, whole)
    pattern = _pattern(pixels, objects, stay & ~objects, camera)
    stay, whole = stay & ~pattern, whole & ~pattern
    if objects.any():
        alike = _alike(pixels, masks)
        stay |= alike
        whole |= alike
    return UnboxedThings(stay=stay & ~objects, whole=whole & ~objects)


def _pattern(pixels: NDArray[np.uint8], objects: Mask, things: Mask, camera: Camera) -> Mask:
    """Those of the ``things`` (H, W) on the ground that are a pattern, which repeats in two directions: dots, tiles."""
    if int(cv2.connectedComponents(things.astype(np.uint8), connectivity=8)[0]) - 1 < FEWEST:
        return np.zeros_like(things)
    hole = grown(objects, max(2, round(0.01 * max(objects.shape))))
    # Above them a wall may begin.
    above = np.zeros_like(hole)
    above[: np.flatnonzero(things.any(axis=1))[0]] = True
    return repeated(logarithms(pixels.astype(np.float32)), hole, above & ~hole, camera, things)


def _alike(pixels: NDArray[np.uint8], masks: Sequence[Mask]) -> Mask:
    """Pixels (H, W) of the round things or blocks of a photo of many that are none of the objects ``masks`` (H, W).
    They touch, stand before a wall, and silver on white hardly differs from the ground."""
    objects = np.logical_or.reduce(list(masks))
    rows, columns = np.mgrid[: objects.shape[0], : objects.shape[1]] + 0.5
    result = np.zeros_like(objects)
    for item in circles_of_a_kind(pixels):
        away = np.hypot(columns - item.x, rows - item.y)
        inner = away < item.radius
        if float((inner & objects).sum()) < BOXED * float(inner.sum()):
            result |= away < RIM * item.radius
    if result.any():
        return result
    blocks, scale = blocks_of_a_kind(pixels)
    inner = [np.zeros(objects.shape, dtype=np.uint8) for _ in blocks]
    for drawn, block in zip(inner, blocks, strict=True):
        cv2.drawContours(drawn, [np.rint(block.contour * scale).astype(np.int32)], -1, 1, cv2.FILLED)
    held = [[float((drawn & mask).sum()) > BOXED * float(drawn.sum()) for drawn in inner] for mask in masks]
    if any(sum(own) > 1 for own in held):
        # Parts of an object, as its print, which polished ground may show once more.
        return result
    for k, (drawn, block) in enumerate(zip(inner, blocks, strict=True)):
        if not any(own[k] for own in held):
            result |= grown(drawn > 0, max(1, round((RIM - 1.0) * block.length * scale)))
    return result


def _look_around(pixels: NDArray[np.uint8], mask: Mask, objects: Mask, camera: Camera, stay: Mask, whole: Mask) -> None:
    """Add the things around the object ``mask`` to ``stay`` and ``whole``, in place."""
    found = _look(pixels, mask, objects, camera, AROUND)
    if found.cut:
        # Whether what reaches the border of the range is a thing shows only where it ends.
        farther = _look(pixels, mask, objects, camera, FARTHER)
        near = np.zeros_like(mask)
        near[found.window] = True
        found.things += [item for item in farther.things if (item[0] & near).any() and _is_compact(item[0])]
    for thing, behind in found.things:
        stay |= thing
        if not behind:
            whole |= thing


def _is_compact(thing: Mask) -> bool:
    """Whether ``thing`` (H, W) is no strip, such as a streak of light on a table, which goes on behind an object."""
    _, sides, _ = cv2.minAreaRect(np.argwhere(thing)[:, ::-1].astype(np.int32))
    return max(sides) <= LONGEST_FAR * max(min(sides), 1.0)


@dataclass
class _Found:
    """window: the range, rows and columns. things: (H, W) each, and whether it continues behind an object. cut: whether
    something that differs from the ground reaches a border of the range that is none of the photo."""

    window: tuple[slice, slice]
    things: list[tuple[Mask, bool]]
    cut: bool


def _look(pixels: NDArray[np.uint8], mask: Mask, objects: Mask, camera: Camera, around: float) -> _Found:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    room = round(around * max(len(rows), len(columns))) + 8
    top, left = max(0, int(rows[0]) - room), max(0, int(columns[0]) - room)
    window = slice(top, int(rows[-1]) + 1 + room), slice(left, int(columns[-1]) + 1 + room)
    crop, own, taken = pixels[window], mask[window], objects[window]
    height, width = own.shape
    scale = min(1.0, OBJECT_SIDE / float(np.sqrt(own.sum())), float(np.sqrt(MOST_PIXELS / own.size)))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    y, x = np.meshgrid(
        top + (np.arange(size[1]) + 0.5) * height / size[1], left + (np.arange(size[0]) + 0.5) * width / size[0],
        indexing="ij",
    )  # fmt: skip
    ground = np.isfinite(on_ground(camera, np.stack([x, y], axis=-1))).all(axis=-1)
    share = cv2.resize(taken.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    covered = cv2.dilate((share > 0.0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    light = cv2.resize(bytes_to_linear(np.ascontiguousarray(crop)), size, interpolation=cv2.INTER_AREA)
    logs = np.log(cv2.GaussianBlur(light, (0, 0), 0.7).astype(np.float64) + 0.01)
    area = float(own.sum()) * size[0] * size[1] / own.size
    found, different = _things(logs, ground & ~covered, covered, area)
    alone = cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    things = []
    for thing, behind in found:
        if _is_mirror_image(thing, alone, logs, ground & ~covered):
            continue
        full = np.zeros_like(mask)
        full[window] = cv2.resize(thing.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.25
        things.append((full, behind))
    sides = (
        (different[0], top > 0),
        (different[-1], window[0].stop < len(pixels)),
        (different[:, 0], left > 0),
        (different[:, -1], window[1].stop < pixels.shape[1]),
    )
    return _Found(window, things, any(inside and bool(side.any()) for side, inside in sides))


def _things(logs: Values, open_ground: Mask, covered: Mask, area: float) -> tuple[list[tuple[Mask, bool]], Mask]:
    """Things (h, w) on the open ground, each with whether it continues behind an object; and all that differs from it.

    logs: (h, w, 3) logarithms of linear light. covered: objects. area: of the object.
    """
    if open_ground.sum() < 200:
        return [], np.zeros_like(open_ground)
    off, within = _relative(logs, open_ground)
    luminance = off @ LUMINANCE
    chroma = np.linalg.norm(off - luminance[..., None], axis=-1)
    spread, tint = (
        max(least, 1.48 * float(np.median(values[within])))
        for values, least in ((np.abs(luminance), LEAST_LUMINANCE), (chroma, LEAST_CHROMA))
    )
    apart = np.maximum(np.abs(luminance) / spread, chroma / tint) / APART
    shade = (luminance < 0.0) & (chroma < np.maximum(APART * tint, SHADE_TINT * (0.5 - luminance)))
    different = (apart > 1.0) & open_ground
    different &= ~_joined(different & shade, covered, max(2, round(0.1 * np.sqrt(area))))
    parts = _parts(different, open_ground, area)
    found = []
    for part in parts:
        if _is_thing(part, apart, open_ground, covered, area):
            found.append(part)
            continue
        pieces = _pieces(part)
        found += [
            piece
            for piece in pieces
            if len(pieces) > 1 and _is_thing(piece, apart, open_ground, covered, area, beside=part & ~piece)
        ]
    rest = different & ~shade & ~np.logical_or.reduce([np.zeros_like(different), *found])
    found += _furniture(parts, rest, different, apart, open_ground, covered, area)
    if not found or sum(int(part.sum()) for part in found) > PATTERN * open_ground.sum():
        return [], different
    if len(found) >= 3 and _is_pattern(off, open_ground, found):
        return [], different
    return [(part, _contact(part, covered) > HIDDEN) for part in found], different


def _relative(logs: Values, known: Mask) -> tuple[Values, Mask]:
    """``logs`` (h, w, 3) relative to the smooth colour of the ground, and the ground (h, w) among the ``known``.

    The ground is the largest mode of colours, not the median: things may cover nearly half of what is seen.
    """
    rows, columns = np.meshgrid(*(np.linspace(-0.5, 0.5, count) for count in known.shape), indexing="ij")
    terms = np.stack([np.ones_like(rows), columns, rows, columns**2, columns * rows, rows**2], axis=-1)
    colours, basis = logs[known], terms[known]
    light = colours @ LUMINANCE
    counts, bounds = np.histogram(light, 96)
    # Of one tint, the ground is one mode, and a filter wider than the histogram would only take memory.
    width = min(MODE / max(bounds[1] - bounds[0], 1e-9), len(counts))
    smooth = ndimage.gaussian_filter1d(counts.astype(np.float64), width)
    peak = float(bounds[int(np.argmax(smooth))] + 0.5 * (bounds[1] - bounds[0]))
    middle = np.median(colours[np.abs(light - peak) < MODE], axis=0)
    off = colours - middle
    scale = 2.0 * MODE
    prior = np.diag([1e-9, 0.002, 0.002, 0.01, 0.01, 0.01])
    for _ in range(12):
        weight = np.exp(-0.5 * np.square(np.abs(off).max(axis=1) / scale))
        weighted = basis * weight[:, None]
        found = np.linalg.solve(weighted.T @ basis + prior * weight.sum(), weighted.T @ (colours - middle))
        off = colours - middle - basis @ found
        near = np.abs(off).max(axis=1) < 2.5 * scale
        scale = max(LEAST_LUMINANCE, 0.5 * scale, 1.48 * float(np.median(np.abs(off[near]).max(axis=1))))
    within = np.zeros_like(known)
    within[known] = np.abs(off).max(axis=1) < 2.5 * scale
    return np.asarray(logs - middle - terms @ found), within


def _joined(mask: Mask, to: Mask, reach: int) -> Mask:
    """The connected parts of ``mask`` (h, w) within ``reach`` pixels of ``to``: shadows of the objects."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    near = cv2.dilate(to.astype(np.uint8), _disc(reach)) > 0
    return np.asarray(np.isin(labels, np.unique(labels[near & mask])) & mask)


def _parts(mask: Mask, open_ground: Mask, area: float) -> list[Mask]:
    """Compact parts of ``mask`` (h, w), with their holes filled; narrow bridges between them are cut."""
    side = float(np.sqrt(area))
    filled = ndimage.binary_fill_holes(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, _disc(1)) > 0)
    filled = filled & open_ground
    least = np.sqrt(SMALLEST) * side
    core = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_OPEN, _disc(max(1, round(0.15 * least)))) > 0
    depth = cv2.distanceTransform(core.astype(np.uint8), cv2.DIST_L2, 5)
    count, seeds = cv2.connectedComponents((depth > max(1.0, 0.3 * least)).astype(np.uint8), connectivity=8)
    if count < 2:
        return []
    nearest = ndimage.distance_transform_edt(seeds == 0, return_distances=False, return_indices=True)
    owner = np.where(core, seeds[nearest[0], nearest[1]], 0)
    parts = []
    for index in range(1, count):
        own = owner == index
        # Only what hangs together with its own core.
        _, labels = cv2.connectedComponents(own.astype(np.uint8), connectivity=8)
        parts.append(np.asarray(np.isin(labels, np.unique(labels[seeds == index])) & own))
    return parts


def _pieces(part: Mask) -> list[Mask]:
    """The pieces of ``part`` (h, w) between which it is a neck: things that touch."""
    depth = cv2.distanceTransform(np.pad(part, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1].astype(np.float64)
    logs = np.where(part, np.log(np.maximum(depth, 0.5)), -2.0)
    count, seeds = cv2.connectedComponents(h_maxima(logs, -np.log(NECK)).astype(np.uint8), connectivity=8)
    labels = watershed(-depth, seeds, mask=part)
    return [np.asarray(labels == index) for index in range(1, count)]


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)


def _is_thing(
    part: Mask, apart: Values, open_ground: Mask, covered: Mask, area: float, *, beside: Mask | None = None
) -> bool:
    """Whether ``part`` (h, w) is a thing. beside: others that touch it."""
    size = int(part.sum())
    if not SMALLEST * area <= size <= LARGEST * area:
        return False
    # What goes on beyond the range that was looked at is another surface.
    sides = (part[0], part[-1], part[:, 0], part[:, -1])
    beyond = cv2.dilate((~open_ground & ~covered).astype(np.uint8), _disc(2)) > 0
    cut = [*(int(side.sum()) for side in sides), int((_outline(part) & beyond).sum())]
    if max(cut) > LONGEST_CUT * np.sqrt(area):
        return False
    points = np.argwhere(part)[:, ::-1].astype(np.int32)
    hull = np.zeros(part.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(points), 1)
    if size < SOLID * int((hull > 0).sum() - ((hull > 0) & covered).sum()):
        return False
    # A jump of the colour on the way out, not a slope.
    outside = (cv2.dilate(part.astype(np.uint8), _disc(3)) > 0) & ~(cv2.dilate(part.astype(np.uint8), _disc(2)) > 0)
    outside &= open_ground
    if beside is not None:
        outside &= ~beside
    if outside.sum() < 8:
        return False
    return float((apart[outside] < 0.7).mean()) > SHARP and float(np.median(apart[part])) > 1.0


def _furniture(
    parts: Sequence[Mask],
    rest: Mask,
    different: Mask,
    apart: Values,
    open_ground: Mask,
    covered: Mask,
    area: float,
) -> list[Mask]:
    """What of ``parts`` (h, w) stands on the ground with legs, or goes on beyond the range, as a chair beside another.

    It is no thing by its form, so only its own pixels count, ``rest``, and only in rows in which much is ground: a wall
    or another surface begins where there is none. different: all that differs from the ground.
    """
    ground = (open_ground & ~different).sum(axis=1) >= ON_GROUND * np.maximum(open_ground.sum(axis=1), 1)
    result = []
    for part in parts:
        own = part & rest & ground[:, None]
        if own.sum() < SMALLEST * area or _contact(own, covered) > HIDDEN:
            continue
        outside = (cv2.dilate(own.astype(np.uint8), _disc(3)) > 0) & ~(cv2.dilate(own.astype(np.uint8), _disc(2)) > 0)
        outside &= open_ground & ground[:, None] & ~rest
        if outside.sum() >= 8 and float((apart[outside] < 0.7).mean()) > SHARP:
            result.append(own)
    return result


def _is_mirror_image(part: Mask, own: Mask, logs: Values, open_ground: Mask) -> bool:
    """Whether ``part`` (h, w) is what polished ground shows of the object ``own`` (h, w), upside down below it.

    logs: (h, w, 3) logarithms of light. Faint or blurred as it is, its colours are the object's, at the same places.
    """
    rows = np.flatnonzero(own.any(axis=1))
    if not len(rows) or np.argwhere(part)[:, 0].mean() <= rows[-1]:
        return False
    reach = max(2, round(0.25 * float(np.sqrt(part.sum()))))
    around = (cv2.dilate(part.astype(np.uint8), _disc(reach)) > 0) & open_ground
    ground = around & ~part
    if ground.sum() < 8:
        return False
    y, x = np.nonzero(around)
    seen = logs[y, x] - np.median(logs[ground], axis=0)
    height = int(rows[-1]) - int(rows[0]) + 1
    for off in MIRROR_OFF:
        source = 2.0 * (rows[-1] + 0.5 + off * height) - y
        at = np.clip(np.round(source).astype(int), 0, len(own) - 1)
        covers = (source >= 0) & own[at, x]
        if covers[part[y, x]].mean() < MIRROR_INSIDE:
            continue
        expected = np.where(covers[:, None], logs[at, x] - np.median(logs[ground], axis=0), 0.0)
        a, b = (values - values.mean(axis=0) for values in (expected, seen))
        if float((a * b).sum()) > MIRROR_LIKE * float(np.sqrt((a * a).sum() * (b * b).sum())) > 0.0:
            return True
    return False


def _outline(part: Mask) -> Mask:
    return np.asarray(part & ~(cv2.erode(part.astype(np.uint8), _disc(1), borderValue=1) > 0))


def _contact(part: Mask, covered: Mask) -> float:
    """Share of the outline of ``part`` that lies along ``covered``."""
    outline = _outline(part)
    near = cv2.dilate(covered.astype(np.uint8), _disc(2)) > 0
    return float((outline & near).sum() / max(1, int(outline.sum())))


def _is_pattern(off: Values, open_ground: Mask, parts: Sequence[Mask]) -> bool:
    """Whether the rest of the ground predicts the largest of ``parts``."""
    largest = max(parts, key=lambda part: int(part.sum()))
    hole = cv2.dilate(largest.astype(np.uint8), _disc(2)) > 0
    values = np.where(open_ground[..., None], off, 0.0).astype(np.float32)
    known = open_ground & ~hole
    values -= values[known].mean(axis=0)
    found, _ = predict_texture(np.where(known[..., None], values, 0.0).astype(np.float32), known, hole)
    truth, guess = values[hole & open_ground], found[hole & open_ground]
    return 1.0 - float(np.square(truth - guess).sum()) / max(float(np.square(truth).sum()), 1e-9) > PATTERN
