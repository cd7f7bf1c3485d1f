# SPDX-License-Identifier: GPL-3.0-or-later
"""A contact sheet: what was found beside what is true, a case a row.

Columns: the photo with its boxes; masks; shadows; the found background; the true one; outlines of the meshes.
Green is right, red was missed, blue is too much; hidden parts that were found are pale green.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.sim.scene.folder import load_scene
from physgen.sim.srgb import read_rgb

from .scoring import Row, Truth, alias, found_masks, mesh_silhouette

HEIGHT, WIDTH = 240, 320
GREEN, RED, BLUE = (40, 190, 60), (230, 40, 40), (50, 90, 255)

Pixels = NDArray[np.uint8]


def row_of(truth: Truth, scene_root: Path, row: Row) -> Pixels:
    """(HEIGHT + a line of text, 6 WIDTH, 3) the case's row."""
    photo = read_rgb(truth.photo)
    size = (truth.camera.width, truth.camera.height)
    empty = np.zeros(size[::-1], bool)
    boxed = photo.copy()
    for item in truth.objects:
        x0, y0, x1, y1 = (round(v) for v in item.box)
        cv2.rectangle(boxed, (x0, y0), (x1 - 1, y1 - 1), (255, 230, 0), 2)
    true = {sub: [getattr(item, sub) for item in truth.objects] for sub in ("visible", "shadow", "full")}
    found: dict[str, list[NDArray[np.bool_]]] = {sub: [empty for _ in truth.objects] for sub in true}
    meshes, background = list(found["full"]), np.zeros_like(photo)
    if row["error"] is None:
        folder, names = load_scene(scene_root), alias(truth)
        masks = [found_masks(folder, names[item.name], size) for item in truth.objects]
        found = {sub: [each[sub] for each in masks] for sub in true}
        meshes = [mesh_silhouette(folder, names[item.name], size) for item in truth.objects]
        background = read_rgb(folder.root / "background.png")
    columns = [
        boxed,
        _compared(photo, found["visible"], true["visible"], found["full"]),
        _compared(photo, found["shadow"], true["shadow"], None),
        background,
        truth.background,
        _compared(photo, meshes, true["full"], None),
    ]
    line = np.concatenate([_framed(column) for column in columns], axis=1)
    text = np.full((16, line.shape[1], 3), 20, np.uint8)
    cv2.putText(text, _words(truth, row), (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([text, line])


def _words(truth: Truth, row: Row) -> str:
    if row["error"] is not None:
        return f"{truth.name}  FAILED  {str(row['error']).strip().splitlines()[-1][:150]}"
    parts = []
    for name, item in row["objects"].items():
        keys = (("mask", "mask_iou"), ("shadow", "shadow_iou"), ("hidden", "hidden_iou"), ("mesh", "silhouette_iou"))
        parts.append(name + " " + " ".join(f"{short} {item[key]:.2f}" for short, key in keys if key in item))
    return (
        f"{truth.name}  {'   '.join(parts)}   background {row['background_gain_db']:+.1f} dB   "
        f"fov {100 * row['fov_error']:.0f}%   normal {row['normal_deg']:.1f} deg"
    )


def _compared(
    photo: Pixels,
    found: list[NDArray[np.bool_]],
    true: list[NDArray[np.bool_]],
    more: list[NDArray[np.bool_]] | None,
) -> Pixels:
    shown = (photo * 0.45).astype(np.uint8)
    for number, (have, want) in enumerate(zip(found, true, strict=True)):
        for mask, colour in ((have & want, GREEN), (want & ~have, RED), (have & ~want, BLUE)):
            shown[mask] = (0.45 * shown[mask] + 0.55 * np.array(colour)).astype(np.uint8)
        if more is not None:
            hidden = more[number] & ~have
            shown[hidden] = (0.6 * shown[hidden] + 0.4 * np.array((200, 255, 200))).astype(np.uint8)
    return shown


def _framed(picture: Pixels) -> Pixels:
    height, width = picture.shape[:2]
    scale = min((HEIGHT - 4) / height, (WIDTH - 4) / width)
    small = cv2.resize(picture, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    top, left = (HEIGHT - small.shape[0]) // 2, (WIDTH - small.shape[1]) // 2
    frame[top : top + small.shape[0], left : left + small.shape[1]] = small
    return frame
