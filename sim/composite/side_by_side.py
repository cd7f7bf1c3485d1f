# SPDX-License-Identifier: MIT
"""Real motion and two simulations of it side by side, drawn into the video's own background, with the gap below.

Also the faces of a box from the frames of a video, and the box drawn with them in another pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

FACE = 96
"""Pixels along a face's edges."""
LEAST_VIEW = 0.2
"""Cosine between a face's normal and the view from which the face counts as seen."""
BEST_VIEWS = 5
"""Views of a face, the largest ones, whose median is its picture: it hides glare and blur of single frames."""
UNSEEN = 0.6
"""Brightness of a face that was never seen, over the mean of the others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoxPose:
    """Where a box is in a picture. corners: (8, 2) px, z changing fastest, then y. facing: (6,) cosine between the
    outward normals (-x, x, -y, y, -z, z) and the direction to the camera; positive for what is in view."""

    corners: Array
    facing: Array


_CORNERS = (
    (0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5),
)  # fmt: skip
"""Corners of the faces -x, x, -y, y, -z, z, around each of them."""
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * FACE


def box_pose(centre: Array, turn: Array, edges: Array, pixels: Callable[[Array], Array], camera: Array) -> BoxPose:
    """Return where a box appears. centre: (3,) m. turn: (3, 3) box to world. edges: (3,) m. pixels: px (..., 2) of
    world points (..., 3). camera: (3,) m."""
    local = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * edges
    normals = np.concatenate([[-turn[:, i], turn[:, i]] for i in range(3)])
    middles = centre + normals * np.repeat(edges / 2, 2)[:, None]
    towards = camera - middles
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    return BoxPose(corners=pixels(centre + local @ turn.T), facing=(normals * towards).sum(axis=1))


def box_faces(views: Iterable[tuple[Picture, BoxPose]]) -> NDArray[np.uint8]:
    """Return the faces (6, FACE, FACE, 3) BGR of a box seen in ``views``: the median of the largest views of each; one
    that is never seen gets the mean colour of the others, darker."""
    kept: list[list[tuple[float, Picture]]] = [[] for _ in range(6)]
    for picture, pose in views:
        for k in range(6):
            if pose.facing[k] < LEAST_VIEW or not np.isfinite(pose.corners).all():
                continue
            outline = pose.corners[list(_CORNERS[k])].astype(np.float32)
            if (outline < 0).any() or (outline >= (picture.shape[1], picture.shape[0])).any():
                continue
            area = float(cv2.contourArea(outline))
            if len(kept[k]) < BEST_VIEWS or area > min(v[0] for v in kept[k]):
                # Pixel centres lie at halves.
                map_ = cv2.getPerspectiveTransform(outline - 0.5, _SQUARE - 0.5)
                face = cv2.warpPerspective(picture, map_, (FACE, FACE), flags=cv2.INTER_LINEAR)
                kept[k].append((area, np.asarray(face, np.uint8)))
                kept[k] = sorted(kept[k], key=lambda v: -v[0])[:BEST_VIEWS]
    faces = np.zeros((6, FACE, FACE, 3), np.uint8)
    seen = [k for k in range(6) if kept[k]]
    for k in seen:
        faces[k] = np.median([face for _, face in kept[k]], axis=0).astype(np.uint8)
    rest = UNSEEN * faces[seen].reshape(-1, 3).mean(axis=0) if seen else np.full(3, 110.0)
    for k in set(range(6)) - set(seen):
        faces[k] = rest.astype(np.uint8)
    return faces


def with_box(background: Picture, faces: NDArray[np.uint8], pose: BoxPose) -> Picture:
    """Return ``background`` with the box drawn at ``pose``; as it is where the pose is not finite."""
    out = background.copy()
    if not np.isfinite(pose.corners).all():
        return out
    low = np.clip(np.floor(pose.corners.min(axis=0)).astype(int) - 2, 0, (out.shape[1], out.shape[0]))
    high = np.clip(np.ceil(pose.corners.max(axis=0)).astype(int) + 3, 0, (out.shape[1], out.shape[0]))
    if (high <= low).any():
        return out
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    part = out[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    for k in range(6):  # a box is convex: faces in view do not cover each other
        if pose.facing[k] <= 0:
            continue
        outline = (pose.corners[list(_CORNERS[k])] - low).astype(np.float32)
        map_ = cv2.getPerspectiveTransform(_SQUARE - 0.5, outline - 0.5)
        face = cv2.warpPerspective(faces[k], map_, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
        mask = np.zeros((size[1], size[0]), np.uint8)
        cv2.fillConvexPoly(mask, np.round((outline - 0.5) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        cover = (mask / 255.0).astype(np.float32)[..., None]
        part += cover * (face - part)
    out[low[1] : high[1], low[0] : high[0]] = part.round().astype(np.uint8)
    return out


PANEL = (420, 560)
"""Largest width and height of a panel, px."""
LEAST_COLUMN = 200
"""Least width of a panel and the room beside it, px: titles stay readable over a narrow picture, such as a drop's."""
CURVE = 150
"""Height of the curve below, px."""
MARK = (5, 10)
"""Inner and outer ends of the arms that mark the real centre, px."""
INK, FAINT, BEFORE, AFTER = (35, 35, 35), (170, 170, 170), (60, 60, 215), (60, 150, 40)
"""Colours, BGR."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedBody:
    """Look of a simulated body: its own pixels. sprite: (h, w, 3) BGR. cover: (h, w) opacity 0 to 1. anchor: (2,) px
    of its centre in the sprite."""

    sprite: Picture
    cover: NDArray[np.float32]
    anchor: Array


def cut_out(picture: Picture, outline: Array, middle: Array) -> SimulatedBody:
    """Return what lies within ``outline`` (N, 2) px of ``picture``, with its centre at ``middle`` (2,)."""
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 3, (picture.shape[1], picture.shape[0]))
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    cv2.fillConvexPoly(mask, np.round((outline - 0.5 - low) * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
    sprite = picture[low[1] : high[1], low[0] : high[0]].copy()
    return SimulatedBody(sprite=sprite, cover=(mask / 255).astype(np.float32), anchor=middle - low)


def with_body(background: Picture, body: SimulatedBody, place: Array) -> Picture:
    """Return ``background`` with the body's centre at ``place`` (2,) px, to a fraction of a pixel; cut at the rim."""
    out = background.copy()
    if not np.isfinite(place).all():
        return out
    corner = place - body.anchor
    whole = np.floor(corner).astype(int)
    shift = corner - whole
    h, w = body.cover.shape
    if whole[0] >= out.shape[1] or whole[1] >= out.shape[0] or whole[0] + w + 1 <= 0 or whole[1] + h + 1 <= 0:
        return out
    move = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    sprite = cv2.warpAffine(body.sprite, move, (w + 1, h + 1), borderMode=cv2.BORDER_REPLICATE)
    cover = cv2.warpAffine(body.cover, move, (w + 1, h + 1))[..., None]
    x0, y0 = max(0, whole[0]), max(0, whole[1])
    x1, y1 = min(out.shape[1], whole[0] + w + 1), min(out.shape[0], whole[1] + h + 1)
    part = (slice(y0 - whole[1], y1 - whole[1]), slice(x0 - whole[0], x1 - whole[0]))
    under = out[y0:y1, x0:x1].astype(np.float32)
    out[y0:y1, x0:x1] = (under + cover[part] * (sprite[part] - under)).round().astype(np.uint8)
    return out


def window_around(places: Array, margin: float, picture: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the part (left, top, right, bottom) of a picture of width and height ``picture`` to show: all finite
    ``places`` (N, 2) px with ``margin`` px around, at least half of the picture along each side."""
    known = places[np.isfinite(places).all(axis=1)]
    size = np.array(picture)
    if len(known) == 0:
        return 0, 0, picture[0], picture[1]
    low, high = known.min(axis=0) - margin, known.max(axis=0) + margin
    short = np.maximum(np.minimum(size, size / 2) - (high - low), 0)
    low, high = low - short / 2, high + short / 2
    low, high = low + np.maximum(-low, 0), high + np.maximum(-low, 0)
    past = np.maximum(high - size, 0)
    low, high = np.floor(np.maximum(low - past, 0)), np.ceil(np.minimum(high - past, size))
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def write_comparison(
    path: Path,
    real: Iterator[Picture],
    *,
    draw: Callable[[int, Picture], tuple[Picture, Picture]],
    window: tuple[int, int, int, int],
    seen: Array,
    believed: Array,
    found: Array,
    times: Array,
    gaps: tuple[Array, Array],
    withheld: float,
    titles: Sequence[str],
    fps: float = 20.0,
) -> int:
    """Write *real · simulated as believed · with the cause found* as a video at ``path``; return its frames.

    real: T pictures (H, W, 3). draw: the two simulations of frame k, given its real picture. window: part (left, top,
    right, bottom) of them to show. seen, believed, found: (T, 2) px. times: (T,) s. gaps: two (T,) distances to the
    real centre in m. withheld: s from which nothing was fitted to. titles: of the three panels. fps: of playback.
    Raises InputError when no video can be written there.
    """
    left, top, right, bottom = window
    corner = np.array([left, top], dtype=np.float64)
    height, width = bottom - top, right - left
    scale = min(PANEL[0] / width, PANEL[1] / height, 2.0)
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    column = max(size[0], LEAST_COLUMN)
    total = (3 * column + 16, size[1] + 34 + CURVE)
    total = (total[0] + total[0] % 2, total[1] + total[1] % 2)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, total)  # type: ignore[attr-defined]
    if not writer.isOpened():
        raise InputError(f"{path}: no video can be written there; choose another folder")
    count = 0
    try:
        for k, picture in enumerate(real):
            panels = [picture, *draw(k, picture)]
            sheet = np.full((total[1], total[0], 3), 250, np.uint8)
            for i, panel in enumerate(panels):
                how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
                shown = np.asarray(cv2.resize(panel[top:bottom, left:right], size, interpolation=how), np.uint8)
                path_px = (believed, believed, found)[i] if i else seen
                _trail(shown, (path_px[: k + 1] - corner) * (size[0] / width), (INK, BEFORE, AFTER)[i])
                if i:
                    _ring(shown, (seen[k] - corner) * (size[0] / width))
                x = i * (column + 8)
                start = x + (column - size[0]) // 2
                sheet[30 : 30 + size[1], start : start + size[0]] = shown
                _text(sheet, titles[i], (x + 2, 20), column - 4, (INK, BEFORE, AFTER)[i])
            _curve(sheet, (34 + size[1], CURVE), times, gaps, k, withheld)
            writer.write(sheet)
            count += 1
    finally:
        writer.release()
    return count


def _text(sheet: Picture, text: str, at: tuple[int, int], width: int, colour: tuple[int, int, int]) -> None:
    scale = 0.5
    while scale > 0.3 and cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width:
        scale -= 0.03
    while len(text) > 8 and cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width:
        text = text[:-5] + "..."
    cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


def _trail(picture: Picture, places: Array, colour: tuple[int, int, int]) -> None:
    places = places[np.isfinite(places).all(axis=1)]
    if len(places) > 1:
        dots = [np.round(np.clip(places, -2000, 6000) * 8).astype(np.int32).reshape(-1, 1, 2)]
        cv2.polylines(picture, dots, False, colour, 1, cv2.LINE_AA, 3)


def _ring(picture: Picture, place: Array) -> None:
    """Mark where the real body is."""
    if np.isfinite(place).all():
        x, y = (int(v) for v in np.round(place))
        # Open in the middle, where a small body would be hidden.
        for colour, thick in (((255, 255, 255), 3), (INK, 1)):
            for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                inner, outer = MARK
                ends = (x + inner * i, y + inner * j), (x + outer * i, y + outer * j)
                cv2.line(picture, *ends, colour, thick, cv2.LINE_AA)


def _curve(
    sheet: Picture, band: tuple[int, int], times: Array, gaps: tuple[Array, Array], now: int, withheld: float
) -> None:
    top, height = band
    left, right = 62, sheet.shape[1] - 12
    low, high = top + height - 22, top + 22
    most = max(float(np.nanmax(gaps[0])), float(np.nanmax(gaps[1])), 1e-6)
    span = max(float(times[-1] - times[0]), 1e-9)

    def at(t: float, g: float) -> tuple[int, int]:
        return round(left + (t - times[0]) / span * (right - left)), round(low - min(g, most) / most * (low - high))

    x = at(withheld, 0)[0]
    cv2.rectangle(sheet, (x, high), (right, low), (232, 232, 232), -1)
    for at_x, room, words in (
        (left, x - left - 8, ("first half: starts fitted to the recording", "first half: fitted")),
        (x, right - x - 6, ("second half: predicted, nothing is fitted here", "second half: predicted")),
    ):
        # Smaller letters are hard to read in a video.
        short = cv2.getTextSize(words[0], cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] > room
        _text(sheet, words[short], (at_x + 4, high + 12), max(room, 40), (110,) * 3)
    cv2.line(sheet, (left, low), (right, low), FAINT, 1)
    unit, factor = ("mm", 1e3) if most < 0.5 else ("m", 1.0)
    _text(sheet, f"{most * factor:.3g} {unit}", (4, high + 6), left - 6, INK)
    _text(sheet, "0", (left - 14, low + 4), 12, INK)
    _text(sheet, f"{span:.2f} s", (right - 46, low + 16), 46, INK)
    _text(sheet, "distance to the real centre (the cross above)", (left, high - 6), right - left, INK)
    for gap, colour in zip(gaps, (BEFORE, AFTER), strict=True):
        good = np.isfinite(gap)
        line = np.array([at(t, g) for t, g in zip(times[good], gap[good], strict=True)], np.int32)
        if len(line) > 1:
            cv2.polylines(sheet, [line.reshape(-1, 1, 2)], False, colour, 2, cv2.LINE_AA)
        if np.isfinite(gap[now]):
            cv2.circle(sheet, at(float(times[now]), float(gap[now])), 4, colour, -1, cv2.LINE_AA)
