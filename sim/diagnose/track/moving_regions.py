# SPDX-License-Identifier: MIT
"""Moving regions in every frame of a video of a still scene.

The background is the median over time. Where something covers a pixel for long, the value is taken that fits the
surroundings, so that a slow body leaves no ghost. A camera that drifts is stabilised on the background's corners.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .pose_estimation import Array
from .video_background import (
    Aligner,
    Picture,
    difference,
    evenly_lit,
    largest_channel,
    least_channel,
    reduced,
    sampled_frames,
    still_background,
    warped,
)
from .video_file import Video

LEAST_CONTRAST, NOISE_FACTOR = 13.0, 5.0
"""Difference from the background that counts as moving: grey levels, and standard deviations of the pixel."""
SHADOW = (0.45, 0.97, 0.09)
"""A shadow: least and largest brightness over the background's, and largest difference between the channels."""
STRONG = 0.55
"""Share of a frame's largest difference from which even what looks like a shadow counts as a body."""
LEAST_RIM = 1.1
"""Area of a region with what looks like its shadow, over its own, from which that may be a rim."""
LEAST_FULL, ONE_COLOUR = 0.3, 0.6
"""Contrast of a pixel that is all body, over the body's usual one, at least: where its colour is nearly that of the
background, how far it covers a pixel is noise. Contrast of its mean colour, over the same, from which that tells."""
LEAST_AREA = 7
"""Pixels of the smallest region."""
MOST_REGIONS = 12
"""Largest regions of a frame that are kept."""
DRIFT_PX = 0.4
"""Motion of the background in working pixels from which frames are aligned to it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """A moving region of one frame, in pixels of the working picture (centres at halves).

    middle: (2,) weighted centre. area: px. axes: (2,) standard deviations along its principal axes, larger first.
    angle: rad, of the larger axis, from x towards y. outline: (N, 2) its convex hull. colour: (3,) BGR.
    cut: whether it touches the picture's border. solid: its area over its hull's. shade: share of it that looks like a
    shadow, the background made darker in all colours alike. contrast: of its inner part to the background, grey levels.
    whole: the same with what touches it and looks like a shadow, if that is much: the blurred rim of a fast body does.
    """

    frame: int
    middle: Array
    area: float
    axes: Array
    angle: float
    outline: Array
    colour: Array
    cut: bool
    solid: float
    shade: float = 0.0
    contrast: float = 0.0
    whole: Region | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingRegions:
    """Everything that moves. regions: by frame. faint: by frame, those that are shadows, or bodies so blurred that they
    look like one. stamps: (T,) s of the container. change: (T,) mean difference from the
    frame before, grey levels. background: (H, W, 3) BGR. scale: working pixels per pixel of the video. drift: largest
    motion of the background, video px. to_background: (T, 2, 3) maps of frames onto the background; None: a still
    camera."""

    background: Picture
    regions: list[list[Region]]
    faint: list[list[Region]]
    stamps: list[float]
    change: Array
    scale: float
    drift: float
    to_background: Array | None
    first: int


def find_moving_regions(
    path: Path, start: int = 0, end: int | None = None, on_frame: Callable[[], None] = lambda: None
) -> MovingRegions:
    """Return what moves in the video at ``path``; memory does not grow with its length, but for the regions' outlines.

    on_frame: called for every frame read, twice in all. Raises InputError as ``Video`` does.
    """
    samples, scale = sampled_frames(path, start, end, on_frame)
    if len(samples) < 5:
        return MovingRegions(
            background=samples[0] if samples else np.zeros((1, 1, 3), np.uint8),
            regions=[[] for _ in samples], faint=[[] for _ in samples],
            stamps=[float("nan")] * len(samples), change=np.zeros(len(samples)),
            scale=scale, drift=0.0, to_background=None, first=start,
        )  # fmt: skip
    height, width = samples[0].shape[:2]
    aligner = Aligner(samples[len(samples) // 2])
    maps = [aligner.map(s) for s in samples]
    edges = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64)
    ways = [np.abs(edges @ m.T - edges[:, :2]).max() for m in maps]
    drift = float(np.max(ways))
    moving_camera = float(np.median(ways)) > DRIFT_PX
    if moving_camera:
        samples = [warped(s, m) for s, m in zip(samples, maps, strict=True)]
    levels = [float(np.median(s[::4, ::4, 1])) for s in samples]
    usual = samples[int(np.argsort(levels)[len(levels) // 2])]
    stack = np.stack([evenly_lit(s, usual) for s in samples])
    del samples
    background, noise = still_background(stack)
    del stack
    limit = np.maximum(LEAST_CONTRAST, NOISE_FACTOR * cv2.GaussianBlur(noise, (5, 5), 0))
    regions: list[list[Region]] = []
    faint: list[list[Region]] = []
    stamps: list[float] = []
    change: list[float] = []
    found_maps: list[Array] = []
    before: Picture | None = None
    aligner = Aligner(background)
    with Video(path) as video:
        for index, frame in enumerate(video.frames(start, end)):
            on_frame()
            picture = reduced(frame, scale)
            if moving_camera:
                found_maps.append(aligner.map(picture).copy())
                picture = warped(picture, found_maps[-1])
            change.append(0.0 if before is None else _change(picture, before))
            before = picture
            stamps.append(frame.time)
            clear, dim = _regions(evenly_lit(picture, background), background, limit, index)
            regions.append(clear)
            faint.append(dim)
    return MovingRegions(
        background=background,
        regions=regions,
        faint=faint,
        stamps=stamps,
        change=np.array(change),
        scale=scale,
        drift=drift / scale,
        to_background=np.array(found_maps) if moving_camera else None,
        first=start,
    )


def _change(picture: Picture, before: Picture) -> float:
    """Return the mean difference in grey levels, less what is one factor for all pixels: lamps flicker with the mains,
    and every second frame of slow motion would seem to repeat the one before."""
    gain = float(np.clip(np.mean(picture, dtype=np.float64) / max(np.mean(before, dtype=np.float64), 1.0), 0.5, 2.0))
    return float(cv2.norm(picture, cv2.convertScaleAbs(before, alpha=gain), cv2.NORM_L1)) / picture.size


def _regions(picture: Picture, background: Picture, limit: Array, index: int) -> tuple[list[Region], list[Region]]:
    """Return the regions of frame ``index``, largest first, and those that shadows make, apart from them."""
    away = difference(picture, background)
    mask = (away > limit).astype(np.uint8)
    if not mask.any():
        return [], []
    shade = np.zeros_like(mask)
    faint = np.zeros_like(mask)
    if mask.mean() < 0.5:
        x, y, w, h = cv2.boundingRect(mask)
        near = slice(max(0, y - 2), y + h + 2), slice(max(0, x - 2), x + w + 2)
        shade[near] = _shadows(picture[near], background[near])
        weak = shade & (away <= STRONG * float(away.max()))
        faint = mask & weak
        mask &= ~weak
    square = np.ones((3, 3), np.uint8)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square), np.uint8)
    clear = list(_outlined(mask, picture, background, away, shade, index))
    if not faint.any():
        return clear, []
    # A shadow beside its body is no thing of its own.
    _, labels = cv2.connectedComponents(cv2.dilate(faint, square))
    beside = faint & np.isin(labels, np.unique(labels[mask > 0]))
    if beside.any():
        full = mask | beside
        wholes = list(_outlined(full, picture, background, away, shade, index))
        _, parts = cv2.connectedComponents(full)
        clear = [_with_rim(r, clear, wholes, np.asarray(parts, np.int32)) for r in clear]
    return clear, list(_outlined(faint & ~beside, picture, background, away, shade, index))


def _with_rim(region: Region, clear: list[Region], wholes: list[Region], parts: NDArray[np.int32]) -> Region:
    """Return ``region`` with the one of ``wholes`` that it is the only clear one of. parts: (H, W) their labels."""
    label = _at(parts, region)
    own = [w for w in wholes if _at(parts, w) == label] if label else []
    if len(own) != 1 or own[0].area < LEAST_RIM * region.area or sum(_at(parts, r) == label for r in clear) > 1:
        return region
    return replace(region, whole=own[0])


def _at(parts: NDArray[np.int32], region: Region) -> int:
    return int(parts[int(region.middle[1]), int(region.middle[0])])


def _outlined(
    mask: NDArray[np.uint8],
    picture: Picture,
    background: Picture,
    away: NDArray[np.float32],
    shade: NDArray[np.uint8],
    index: int,
) -> Iterator[Region]:
    """Yield the largest regions of ``mask`` (H, W), largest first. away: (H, W) difference from the background. shade:
    (H, W) what looks like a shadow."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    height, width = mask.shape
    for outline in sorted(outlines, key=cv2.contourArea, reverse=True)[:MOST_REGIONS]:
        x, y, w, h = cv2.boundingRect(outline)
        inside = np.zeros((h, w), np.uint8)
        cv2.drawContours(inside, [outline - (x, y)], -1, 1, cv2.FILLED)
        if inside.sum() < LEAST_AREA:
            continue
        part = away[y : y + h, x : x + w]
        strength = max(float(np.percentile(part[inside > 0], 70)), 1.0)
        box = slice(y, y + h), slice(x, x + w)
        cover = part / _full_contrast(picture[box], background[box], part, inside, strength)
        # Coverage: pixels of the rim count by how far they have left the background, about half of the way, so that
        # blur and the coarse colours of compressed video do not widen the body.
        firm = (cover > 0.5).astype(np.uint8) & inside
        rims, _ = cv2.findContours(firm, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(firm, rims, -1, 1, cv2.FILLED)
        soft = np.clip((cover - 0.2) / 0.6, 0, 1) * inside
        soft = np.maximum(soft, cv2.erode(firm, np.ones((3, 3), np.uint8)))
        if soft.sum() <= 0:
            continue
        rows, columns = np.mgrid[0:h, 0:w] + 0.5
        total = float(soft.sum())
        mx, my = float((soft * columns).sum() / total), float((soft * rows).sum() / total)
        dx, dy = columns - mx, rows - my
        a, b, c = (float((soft * q).sum() / total) for q in (dx * dx, dx * dy, dy * dy))
        spread, turns = np.linalg.eigh(np.array([[a, b], [b, c]]))
        hull = cv2.convexHull(outline)[:, 0].astype(np.float64)
        hull_area = max(float(cv2.contourArea(hull.astype(np.float32))) + 0.5 * len(hull), 1.0)
        yield Region(
            frame=index,
            middle=np.array([x + mx, y + my]),
            area=total,
            axes=np.sqrt(np.maximum(spread[::-1], 1e-3)),
            angle=float(np.arctan2(turns[1, 1], turns[0, 1])),
            outline=hull + 0.5,
            colour=np.asarray(cv2.mean(picture[y : y + h, x : x + w], inside)[:3]),
            cut=bool(x <= 1 or y <= 1 or x + w >= width - 1 or y + h >= height - 1),
            solid=min(1.0, float(inside.sum()) / hull_area),
            shade=float(shade[y : y + h, x : x + w][inside > 0].mean()),
            contrast=strength,
        )


def _full_contrast(
    picture: Picture, background: Picture, away: NDArray[np.float32], inside: NDArray[np.uint8], strength: float
) -> NDArray[np.float32]:
    """Return (H, W) how far a pixel would be from the background if the body of ``inside`` covered all of it. strength:
    the body's usual difference, grey levels.

    It is that, but for what the background's own colours make of it: a body may pass from a light wall to a dark one.
    """
    even = np.full(inside.shape, strength, np.float32)
    weight = inside * np.clip(away / strength, 0, 1) ** 2
    colour = (picture * weight[..., None]).sum(axis=(0, 1)) / max(float(weight.sum()), 1e-6)
    apart = largest_channel(np.abs(colour.astype(np.float32) - background.astype(np.float32)))
    usual = float(np.percentile(apart[inside > 0], 70))
    if usual < ONE_COLOUR * strength:
        return even
    return np.maximum(apart / usual, LEAST_FULL) * even


def _shadows(picture: Picture, background: Picture) -> NDArray[np.uint8]:
    """Return (H, W): where the background is only darker, all colours alike."""
    low, high, apart = SHADOW
    ratio = (picture.astype(np.float32) + 4) / (background.astype(np.float32) + 4)
    ratio = np.asarray(cv2.blur(ratio, (3, 3)), np.float32)
    top, bottom = largest_channel(ratio), least_channel(ratio)
    return ((top < high) & (bottom > low) & (top - bottom < apart)).astype(np.uint8)


def aligned_frames(path: Path, found: MovingRegions, wanted: NDArray[np.int64]) -> Iterator[Picture]:
    """Yield frames ``wanted`` (rising, counted from the first one used) at the working size, on the background."""
    left = [int(k) for k in wanted]
    with Video(path) as video:
        for frame in video.frames(found.first, found.first + left[-1]):
            if frame.index - found.first != left[0]:
                continue
            picture = reduced(frame, found.scale)
            if found.to_background is not None:
                picture = warped(picture, found.to_background[left[0]])
            left.pop(0)
            yield picture
            if not left:
                return
