# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstructed body beside the true one from sides that the photo does not show.

Both are viewed by one rasteriser, without light, from the same angles to the viewing direction of the photo. Scale and
place of the estimated scene have no part in it: the heights of the views at 0 degrees are made equal, and views are
centred. A texture's exposure is as unknown as the light: each channel of the reconstruction is multiplied by one
number, which makes the medians of the views at 0 degrees equal, in linear light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from physgen.sim.reconstruct import turntable
from physgen.sim.reconstruct.turntable import Turned
from physgen.sim.scene.folder import Scene
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes
from PIL import Image

from .cases import Case
from .salient_marks import marks_of, unmatched
from .view_distance import Look, distance

UNSEEN_DEG = (90.0, 270.0, 180.0)
CANVAS = 256
"""Pixels along a side of a compared view."""
EXTENT = 168
"""Pixels of the true body's larger extent at 0 degrees."""
MATCH = 8
"""Pixels within which a mark counts as one that is truly there."""
BRIGHTEST = 4.0
"""Most that a channel is multiplied or divided by."""
NUMBERS = ("front_view", "side_views", "back_view", "unseen_views", "marks_behind", "true_marks_behind")
FAILED: dict[str, Any] = {**dict.fromkeys(NUMBERS[:4], 100.0), "marks_behind": 0, "true_marks_behind": 0}
"""Of a case without a scene."""


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means of the distances and the sum of marks behind, over all bodies."""
    bodies = [item for row in rows for item in row["objects"].values()]
    means = {key: {"mean": float(np.mean([item[key] for item in bodies])), "of": len(bodies)} for key in NUMBERS[:4]}
    return {**means, "marks_behind": {"sum": sum(item["marks_behind"] for item in bodies), "of": len(bodies)}}


def true_body(case: Case) -> Turned:
    """The first thing of a case of the set ``turntable``. Raises ValueError if it has no colours of its own."""
    item = case.items[0]
    if item.body.colours is None:
        raise ValueError(f"{case.name}: {item.kind} has no colours of its own; use the set turntable")
    shown = linear_to_bytes(item.body.colours[None])[0]
    mesh = trimesh.Trimesh(item.vertices, item.body.mesh.faces, vertex_colors=shown, process=False)
    return turntable.turned(mesh, case.camera.position)


def found_body(folder: Scene, name: str) -> Turned:
    """The object ``name`` of a reconstructed scene."""
    return turntable.turned_object(folder, next(item for item in folder.model.objects if item.name == name))


def looks(body: Turned, azimuths: tuple[float, ...], extent: float | None, height: float | None) -> list[Look]:
    """Views on the canvas at 0 degrees and at ``azimuths``; the extent or the height at 0 is given, in pixels."""
    views = [turntable.view(body, azimuth, ground=False) for azimuth in (0.0, *azimuths)]
    rows, columns = (np.flatnonzero((views[0].cover > 0.5).any(axis=axis)) for axis in (1, 0))
    tall, wide = rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    scale = extent / max(tall, wide) if extent is not None else (height or tall) / tall
    middle = (rows[0] + rows[-1] + 1) / 2
    return [_placed(view, scale, middle) for view in views]


def _placed(view: turntable.View, scale: float, middle: float) -> Look:
    columns = np.flatnonzero((view.cover > 0.5).any(axis=0))
    centre = (columns[0] + columns[-1] + 1) / 2 if len(columns) else view.cover.shape[1] / 2
    half = CANVAS / 2
    matrix = np.array([[scale, 0.0, half - scale * centre], [0.0, scale, half - scale * middle]])
    # OpenCV counts from the middle of the top left pixel.
    matrix[:, 2] += 0.5 * scale - 0.5
    cover = view.cover[..., None]
    both = np.concatenate([view.body * cover, cover], axis=-1).astype(np.float32)
    if scale < 1:
        both = cv2.GaussianBlur(both, (0, 0), 0.4 * np.sqrt(1 / scale**2 - 1) + 1e-3)
    moved = cv2.warpAffine(both, matrix, (CANVAS, CANVAS), flags=cv2.INTER_LINEAR)
    share = np.clip(moved[..., 3], 0.0, 1.0)
    pixels = moved[..., :3] / np.maximum(moved[..., 3:], 1e-6)
    return Look(np.clip(np.rint(pixels), 0, 255).astype(np.uint8), np.asarray(share, dtype=np.float32))


def height_of(look: Look) -> float:
    """Pixels from the top to the bottom of what is shown."""
    rows = np.flatnonzero((look.cover > 0.5).any(axis=1))
    return float(rows[-1] - rows[0] + 1)


def exposure(found: Look, true: Look) -> NDArray[np.float64]:
    """(3,) what the channels of ``found`` are multiplied by, in linear light."""
    medians = [np.median(bytes_to_linear(look.pixels[look.cover > 0.99]), axis=0) for look in (found, true)]
    ratio = np.maximum(medians[1], 1e-3) / np.maximum(medians[0], 1e-3)
    return np.asarray(np.clip(ratio, 1 / BRIGHTEST, BRIGHTEST), dtype=np.float64)


def exposed(look: Look, factors: NDArray[np.float64]) -> Look:
    """``look`` with its channels multiplied in linear light."""
    bright = np.clip(bytes_to_linear(look.pixels) * factors, 0.0, 1.0)
    return Look(linear_to_bytes(bright), look.cover)


@dataclass(frozen=True, eq=False)
class Compared:
    """Views of the true and of the found body at 0 degrees and at ``UNSEEN_DEG``."""

    true: list[Look]
    found: list[Look]

    @property
    def numbers(self) -> dict[str, Any]:
        """front, sides (mean of both), back, unseen (mean of ±90 and 180): Delta E; marks behind: found, true."""
        each = [distance(a, b) for a, b in zip(self.found, self.true, strict=True)]
        behind, truly = marks_of(self.found[-1]), marks_of(self.true[-1])
        return {
            "front_view": each[0],
            "side_views": (each[1] + each[2]) / 2,
            "back_view": each[3],
            "unseen_views": (each[1] + each[2] + each[3]) / 3,
            "marks_behind": unmatched(behind, truly, MATCH),
            "true_marks_behind": truly.count,
        }


def compared(true: Turned, found: Turned) -> Compared:
    """The views that are compared."""
    right = looks(true, UNSEEN_DEG, EXTENT, None)
    own = looks(found, UNSEEN_DEG, None, height_of(right[0]))
    factors = exposure(own[0], right[0])
    return Compared(true=right, found=[exposed(look, factors) for look in own])


SHEET_DEG = (0, 45, 90, 135, 180, 225, 270, 315)
SHEET_SIDE = 180


def beside(true: Turned, found: Turned) -> NDArray[np.uint8]:
    """(2 SHEET_SIDE, 8 SHEET_SIDE, 3) the true body's turntable above the found one's, both as they are."""
    return np.concatenate([turntable.row(body, SHEET_DEG, side=SHEET_SIDE) for body in (true, found)])


def save_jpeg(pixels: NDArray[np.uint8], path: Path, most_bytes: int = 150_000) -> None:
    """Write ``path`` with the best quality that stays below ``most_bytes``."""
    for quality in (92, 88, 84, 80, 75, 70, 60, 50):
        Image.fromarray(pixels).save(path, quality=quality, subsampling=0)
        if path.stat().st_size < most_bytes:
            return
