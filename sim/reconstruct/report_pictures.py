# SPDX-License-Identifier: MIT
"""Pictures of the report, (h, w, 3) uint8 sRGB: overlays on the photo; ``turntable.py`` has those of bodies."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene.model import Camera, Ground

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Colour = tuple[int, int, int]

COLOURS: tuple[Colour, ...] = (
    (255, 122, 41),
    (46, 160, 255),
    (66, 200, 110),
    (226, 84, 190),
    (245, 205, 60),
    (130, 110, 245),
)
"""One per object, distinct on most photos; repeated after the last."""
GRID_LINES = 12
"""Grid lines on each side of the centre."""


def colour_of(index: int) -> Colour:
    """Return the colour of the object number ``index``."""
    return COLOURS[index % len(COLOURS)]


def shrunk(pixels: Pixels, width: int) -> Pixels:
    """Return ``pixels`` at most ``width`` wide."""
    scale = width / pixels.shape[1]
    if scale >= 1.0:
        return pixels
    size = (width, max(1, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def outlined(pixels: Pixels, masks: Sequence[Mask], *, fill: float = 0.0, names: Sequence[str] = ()) -> Pixels:
    """Return the picture with the outline of each mask in its colour; ``fill``: opacity of the colour inside, 0 to
    1."""
    picture = pixels.copy()
    thick = max(1, round(max(picture.shape) / 500))
    for index, mask in enumerate(masks):
        colour = colour_of(index)
        if fill:
            picture[mask] = ((1 - fill) * picture[mask] + fill * np.array(colour)).astype(np.uint8)
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, contours, -1, (255, 255, 255), thick + 2, cv2.LINE_AA)
        cv2.drawContours(picture, contours, -1, colour, thick, cv2.LINE_AA)
    for index, (mask, name) in enumerate(zip(masks, names, strict=False)):
        _label(picture, mask, name, colour_of(index))
    return picture


def _label(picture: Pixels, mask: Mask, name: str, colour: Colour) -> None:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return
    scale = max(picture.shape) / 1100
    ascii_name = name.encode("ascii", "replace").decode()
    font, thick = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(2 * scale))
    (width, height), base = cv2.getTextSize(ascii_name, font, scale, thick)
    x = int(np.clip((columns[0] + columns[-1]) / 2 - width / 2, 4, max(4, picture.shape[1] - width - 4)))
    y = int(max(height + 6, rows[0] - 8))
    cv2.rectangle(picture, (x - 4, y - height - 5), (x + width + 4, y + base), colour, cv2.FILLED)
    cv2.putText(picture, ascii_name, (x, y - 1), font, scale, (255, 255, 255), thick, cv2.LINE_AA)


def numbered_boxes(pixels: Pixels, boxes: Sequence[Sequence[float]], chosen: Sequence[int]) -> Pixels:
    """Return the picture with ``boxes``, x0, y0, x1, y1, and their numbers from 1; those not ``chosen`` are thin and
    grey."""
    picture = pixels.copy()
    size = max(picture.shape)
    order = [*(i for i in range(len(boxes)) if i not in chosen), *chosen]
    for index in order:
        colour = colour_of(index) if index in chosen else (150, 150, 150)
        thick = max(1, round(size / (320 if index in chosen else 640)))
        x0, y0, x1, y1 = (round(v) for v in boxes[index])
        corners = (x0, y0), (max(x0, x1 - 1), max(y0, y1 - 1))
        cv2.rectangle(picture, *corners, (255, 255, 255), thick + 2, cv2.LINE_AA)
        cv2.rectangle(picture, *corners, colour, thick, cv2.LINE_AA)
    for index in order:
        x0, y0 = (max(0, round(v)) for v in boxes[index][:2])
        scale, text = size / 900, str(index + 1)
        thick = max(1, round(2 * scale))
        (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
        corner = (x0 + width + 2 * base, y0 + height + 2 * base)
        cv2.rectangle(picture, (x0, y0), corner, colour_of(index) if index in chosen else (150, 150, 150), cv2.FILLED)
        place = (x0 + base, y0 + height + base)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), thick, cv2.LINE_AA)
    return picture


def cut_out(pixels: Pixels, seen: Mask, full: Mask) -> Pixels:
    """Return the object alone on grey, with its completed part hatched."""
    rows, columns = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
    pad = 6 + round(0.06 * max(len(rows), len(columns)))
    window = (
        slice(max(0, rows[0] - pad), min(full.shape[0], rows[-1] + 1 + pad)),
        slice(max(0, columns[0] - pad), min(full.shape[1], columns[-1] + 1 + pad)),
    )
    y, x = np.mgrid[window]
    paper = np.where(((y // 12 + x // 12) % 2 == 0)[..., None], 214, 226).astype(np.uint8)
    picture = np.where(full[window][..., None], pixels[window], np.broadcast_to(paper, (*y.shape, 3)))
    hatched = (full & ~seen)[window] & ((x + y) % 12 < 2)
    picture[hatched] = (255, 255, 255)
    return np.ascontiguousarray(picture, dtype=np.uint8)


def shadowed(pixels: Pixels, shadows: Sequence[Mask], holes: Sequence[Mask]) -> Pixels:
    """Return shadows in their objects' colours, and the outline of all inpainted pixels."""
    grey = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY)
    picture = np.repeat(grey[..., None], 3, axis=2)
    for index, shadow in enumerate(shadows):
        picture[shadow] = (0.35 * picture[shadow] + 0.65 * np.array(colour_of(index))).astype(np.uint8)
    contours, _ = cv2.findContours(
        np.logical_or.reduce(list(holes)).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(picture, contours, -1, (255, 255, 255), max(1, round(max(picture.shape) / 600)), cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def ground_grid(pixels: Pixels, camera: Camera, ground: Ground, spacing: float) -> Pixels:
    """Return the photo with a square grid on the ground, ``spacing`` metres wide, and the horizon in yellow."""
    picture = pixels.copy()
    thick = max(1, round(max(picture.shape) / 900))
    normal = ground.unit_normal
    forward = np.asarray(camera.world_from_camera)[:3, 2]
    away = forward - (forward @ normal) * normal
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    right = np.cross(away, normal)
    middle = np.asarray(ground.point, dtype=np.float64)
    reach = GRID_LINES * spacing
    for k in range(-GRID_LINES, GRID_LINES + 1):
        for along, across in ((away, right), (right, away)):
            steps = np.linspace(-reach, reach, 200)[:, None]
            _line(picture, camera, middle + k * spacing * across + steps * along, (255, 255, 255), thick)
    directions = np.linspace(-1.4, 1.4, 200)[:, None]
    far = camera.position + 1e6 * (np.cos(directions) * away + np.sin(directions) * right)
    _line(picture, camera, far, (255, 214, 0), 2 * thick)
    return picture


def _line(picture: Pixels, camera: Camera, points: NDArray[np.float64], colour: Colour, thick: int) -> None:
    projected = camera.project(points)
    limit = 8.0 * max(picture.shape)
    good = (projected[:, 2] > 1e-6) & (np.abs(projected[:, :2]) < limit).all(axis=1)
    for first, second, a, b in zip(projected[:-1], projected[1:], good[:-1], good[1:], strict=True):
        if a and b:
            start, end = ((round(16 * float(p[0])), round(16 * float(p[1]))) for p in (first, second))
            cv2.line(picture, start, end, colour, thick, cv2.LINE_AA, shift=4)


def tone_mapped(radiance: NDArray[np.floating], width: int) -> Pixels:
    """Return an environment map (h, w, 3) of linear light as a picture; twice its mean is white."""
    mean = max(float(radiance.mean()), 1e-6)
    shown = np.clip(radiance / (2.0 * mean), 0.0, 1.0) ** (1 / 2.2)
    size = (width, max(1, round(width * radiance.shape[0] / radiance.shape[1])))
    enlarged = cv2.resize(np.asarray(shown, dtype=np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(enlarged * 255.0 + 0.5, dtype=np.uint8)


def grid_spacing(size_m: float) -> float:
    """Return a round length, 1, 2 or 5 times a power of ten, near ``size_m`` metres."""
    power = 10.0 ** math.floor(math.log10(size_m))
    return min((1, 2, 5, 10), key=lambda factor: abs(math.log(size_m / (factor * power)))) * power
