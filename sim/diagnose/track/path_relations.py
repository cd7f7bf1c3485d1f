# SPDX-License-Identifier: MIT
"""What paths of regions have to do with each other: pieces of a body, its shadow, and frames in which blur hides it."""

from __future__ import annotations

import cv2
import numpy as np

from .moving_regions import Region
from .pose_estimation import Array
from .region_track import RegionPath

LEAST_COMMON = 8
"""Frames in which two paths are seen together, from which they can be compared."""
SHADE = 0.5
"""Share of a region from which it looks like a shadow."""
FAINTER = 0.9
"""Contrast of a shadow over its body's, at most."""
FOLLOWS, FOLLOWS_SIZE, LEAST_PX = 0.1, 0.3, 1.0
"""Largest RMS distance of a shadow from the affine image of its body's path: over the path's spread, and over the
shadow's size or in working px, whichever is larger."""
PIECE_SIZE, PIECE_OFF, PIECE_NEAR = 0.5, 0.25, 0.6
"""A piece of a body: its size, the scatter of its place relative to the body, and the gap between their outlines, over
the body's size, at most."""
MOVED = 0.5
"""Way that a body has to go while a piece is seen with it, in its own sizes."""
FAST, FASTS, ROOMY, ALIGNED = 0.4, 3, 1.2, 0.9
"""Way of a body in a frame, over its width, from which blur may take its rim; frames in which that has to be seen; and
largest size of body and rim over its width, and along the motion its way in a frame; least cosine of both."""
BLURRED, AREA_RATIO = 4, 2.5
"""Frames of a gap up to which a path is followed into faint regions, and their largest ratio of areas."""


def bodies(paths: list[RegionPath], faint: list[list[Region]]) -> list[RegionPath]:
    """Return the paths of bodies, freest first: without shadows and pieces, and followed through frames in which blur
    makes a body as faint as a shadow. faint: regions by frame."""
    whole = _without_shadows(_without_pieces(paths))
    for path in whole:
        _continue_faintly(path, faint)
        _take_blurred_rims(path)
    return sorted(whole, key=lambda p: -p.freedom())


def _common(a: RegionPath, b: RegionPath) -> tuple[list[Region], list[Region]]:
    """Return the regions of both in the frames in which both are seen."""
    of_a = {r.frame: r for r in a.regions}
    pairs = [(of_a[r.frame], r) for r in b.regions if r.frame in of_a]
    return [p[0] for p in pairs], [p[1] for p in pairs]


def _without_shadows(paths: list[RegionPath]) -> list[RegionPath]:
    return [q for q in paths if not any(_is_shadow(q, p) for p in paths if p is not q)]


def _is_shadow(path: RegionPath, body: RegionPath) -> bool:
    """Return whether ``path`` is that of the shadow of ``body``: a lamp far away casts it on a wall or a floor by one
    affine map of the plane in which the body moves."""
    if np.median([r.shade for r in path.regions]) < SHADE or body.freedom() <= 0 or body.size < 0.5 * path.size:
        return False
    ours, theirs = _common(path, body)
    if len(ours) < max(LEAST_COMMON, 0.5 * len(path.regions)):
        return False
    if np.median([r.contrast for r in ours]) > FAINTER * np.median([r.contrast for r in theirs]):
        return False
    places, of_body = np.array([r.middle for r in ours]), np.array([r.middle for r in theirs])
    known = np.column_stack([of_body - of_body.mean(axis=0), np.ones(len(of_body))])
    left = places - known @ np.linalg.lstsq(known, places, rcond=None)[0]
    off = float(np.sqrt((left**2).sum(axis=1).mean()))
    spread = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return off < min(FOLLOWS * spread, max(FOLLOWS_SIZE * path.size, LEAST_PX))


def shown_share(body: RegionPath, paths: list[RegionPath]) -> float:
    """Return the share of a body's outline that its largest region fills: 1 where no piece of it lies beside that
    region, less where the rest of the body looks like what is behind it. paths: all that were found."""
    pieces = [q for q in paths if q is not body and _is_piece(q, body)]
    shares = []
    for region in body.regions:
        beside = [r.outline for q in pieces for r in q.regions if r.frame == region.frame]
        if beside:
            whole = np.concatenate([region.outline, *beside]).astype(np.float32)
            own = cv2.contourArea(region.outline.astype(np.float32))
            shares.append(own / max(cv2.contourArea(cv2.convexHull(whole)), 1e-9))
    return float(np.median(shares)) if len(shares) >= LEAST_COMMON else 1.0


def _without_pieces(paths: list[RegionPath]) -> list[RegionPath]:
    return [q for q in paths if not any(_is_piece(q, p) for p in paths if p is not q)]


def _is_piece(path: RegionPath, body: RegionPath) -> bool:
    """Return whether ``path`` is a small piece of ``body``: it stays at one place of it, or beside it. A body of many
    colours, some of them like the background, shows in pieces; a highlight or a reflection moves along, too."""
    if path.size > PIECE_SIZE * body.size or body.freedom() <= 0:
        return False
    ours, theirs = _common(path, body)
    if len(ours) < max(LEAST_COMMON, 0.5 * len(path.regions)) or RegionPath(theirs).travel < MOVED * body.size:
        return False
    apart = np.array([a.middle - b.middle for a, b in zip(ours, theirs, strict=True)])
    if float(np.linalg.norm(apart - np.median(apart, axis=0), axis=1).mean()) > PIECE_OFF * body.size:
        return False
    gaps = [_gap(a.outline, b.outline) for a, b in zip(ours, theirs, strict=True)]
    return float(np.median(gaps)) < PIECE_NEAR * body.size


def _gap(outline: Array, other: Array) -> float:
    """Return the distance in px between two hulls, 0 where one's corner or edge lies within the other."""
    hulls = [h.astype(np.float32)[:, None] for h in (outline, other)]
    gaps = [-cv2.pointPolygonTest(hulls[1], (float(x), float(y)), measureDist=True) for x, y in outline]
    gaps += [-cv2.pointPolygonTest(hulls[0], (float(x), float(y)), measureDist=True) for x, y in other]
    return max(0.0, float(np.min(gaps)))


def _continue_faintly(path: RegionPath, faint: list[list[Region]]) -> None:
    """Add faint regions where ``path`` goes on before its first region and after its last one."""
    if path.freedom() <= 0:
        return
    area = float(np.median([r.area for r in path.regions]))

    def alike(frame: int, place: Array, reach: float) -> list[Region]:
        near = [(float(np.linalg.norm(r.middle - place)), i) for i, r in enumerate(faint[frame])]
        fits = sorted(n for n in near if n[0] < reach)
        return [faint[frame][i] for _, i in fits if 1 / AREA_RATIO < faint[frame][i].area / area < AREA_RATIO]

    for forward in (True, False):
        while True:
            end = path.regions[-1 if forward else 0]
            near = path.regions[-4:] if forward else path.regions[:4]
            times = np.array([r.frame for r in near], dtype=np.float64) - end.frame
            speed = np.polyfit(times, np.array([r.middle for r in near]), min(2, len(near) - 2))
            found = None
            if any(r is not end for r in alike(end.frame, end.middle, 3 * path.size)):
                break  # seen beside the body: its shadow
            for wait in range(1, BLURRED + 1):
                frame = end.frame + (wait if forward else -wait)
                if not 0 <= frame < len(faint):
                    break
                ahead = (np.vander([frame - end.frame], len(speed)) @ speed)[0]
                close = alike(frame, ahead, 0.6 * path.size + 0.4 * float(np.linalg.norm(ahead - end.middle)))
                if close:
                    found = close[0]
                    break
            if found is None:
                break
            path.regions.insert(len(path.regions) if forward else 0, found)


def _take_blurred_rims(path: RegionPath) -> None:
    """Replace the regions of a fast body by those with the rim that blur makes look like a shadow.

    A rim is as wide as the body across its way, and longer along it by no more than its way in a frame. A shadow that
    touches the body has no such size; a body that is never fast has no such rim.
    """
    if path.freedom() <= 0 or sum(r.whole is not None for r in path.regions) < FASTS:
        return
    frames = np.array([r.frame for r in path.regions], dtype=np.float64)
    speeds = np.gradient(path.middles, frames, axis=0)
    width = float(np.percentile([4 * r.axes[1] for r in path.regions], 75))
    fits = np.zeros(len(frames), dtype=np.bool_)
    for k, rim in enumerate(r.whole for r in path.regions):
        if rim is not None:
            pace = float(np.linalg.norm(speeds[k]))
            long, wide = 4 * rim.axes
            way = abs(float(speeds[k] @ (np.cos(rim.angle), np.sin(rim.angle)))) / max(pace, 1e-9)
            fits[k] = wide <= ROOMY * width and (
                long <= ROOMY * width or (way > ALIGNED and long <= ROOMY * (width + pace))
            )
    fast = np.linalg.norm(speeds, axis=1) > FAST * width
    if (fits & fast).sum() < FASTS:
        return
    path.regions[:] = [r.whole or r if fit else r for r, fit in zip(path.regions, fits, strict=True)]
