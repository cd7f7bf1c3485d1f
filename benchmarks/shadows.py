# SPDX-License-Identifier: GPL-3.0-or-later
"""Shadow masks on drawn pictures of known shadows. Needs no Blender.

    python -m physgen.benchmarks.shadows [--first 0] [--count 60] [--sheet FILE.png]

The pictures (``shadow_pictures/``) have the arrangements, cameras and lamps of the rendered ones from seeds of their
own, on grounds and walls of fourteen patterns, with stains, second surfaces, uneven light, mirror images, and shadows
of what is outside of the picture. Masks and camera are given a little wrong, as the program finds them; the shadow
stage runs alone. IoU of all shadows together with the pixels off the masks that keep less than 0.9 of their light, over
pictures with at least 60 such pixels. About 7 CPU seconds a picture: for tuning, where ``reconstruct`` measures.

``--quick`` is two pictures.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser
from physgen.benchmarks.cutouts import sheet
from physgen.benchmarks.reconstruct_pictures.scoring import iou
from physgen.benchmarks.shadow_pictures.drawn_picture import DrawnPicture, draw_picture
from physgen.sim.reconstruct.lighting.shadow_masks import cast_shadows
from physgen.sim.reconstruct.lighting.shadow_model import SHADOW_RATIO
from PIL import Image

Mask = NDArray[np.bool_]

LEAST_SHADOW = 60
"""Fewest pixels of true shadow."""
TALL, ACROSS = 200, 3
"""Height of a picture on the sheet in pixels, and pictures in a row."""


def judged(number: int) -> tuple[dict[str, Any], NDArray[np.uint8]] | None:
    """Return the row of picture ``number`` and its panel for the sheet; None if it has no shadow to speak of."""
    try:
        picture = draw_picture(number)
    except ValueError as error:
        sys.stderr.write(f"{error}\n")
        return None
    covered = np.logical_or.reduce(picture.masks)
    true = (picture.kept < SHADOW_RATIO) & ~covered
    if int(true.sum()) < LEAST_SHADOW:
        return None
    shadows = cast_shadows(picture.pixels, picture.masks, picture.camera)
    found = np.logical_or.reduce([cast.shadow for cast in shadows])
    row = {
        "number": number,
        "light": picture.light,
        "iou": iou(found, true),
        "area": float(found.sum() / true.sum()),
    }
    return row, _panel(picture, found, true)


def _panel(picture: DrawnPicture, found: Mask, true: Mask) -> NDArray[np.uint8]:
    """The picture with what is found rightly in green, falsely in red, and missed in blue."""
    panel = picture.pixels.copy()
    for region, colour in ((found & true, (0, 160, 0)), (found & ~true, (220, 0, 0)), (true & ~found, (0, 60, 255))):
        panel[region] = (0.4 * panel[region] + 0.6 * np.array(colour)).astype(np.uint8)
    both = np.concatenate([picture.pixels, panel], axis=1)
    width = round(TALL * both.shape[1] / both.shape[0])
    return np.asarray(cv2.resize(both, (width, TALL), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return count, mean and median IoU, and median area over the true one, by light and of all."""
    groups = {"all": list(rows)} | {
        light: [row for row in rows if row["light"] == light] for light in sorted({row["light"] for row in rows})
    }
    return {
        name: {
            "pictures": len(group),
            "mean_iou": float(np.mean([row["iou"] for row in group])),
            "median_iou": float(np.median([row["iou"] for row in group])),
            "median_area": float(np.median([row["area"] for row in group])),
        }
        for name, group in groups.items()
        if group
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0."""
    parser = benchmark_parser("shadows", __doc__, count=2)
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first picture")
    parser.add_argument("--count", type=int, default=60, metavar="N", help="pictures to draw (default: %(default)s)")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="write what was found, falsely found and missed")
    options = parser.parse_args(arguments)
    rows, panels = [], []
    for number in range(options.first, options.first + options.count):
        answer = judged(number)
        if answer is not None:
            sys.stderr.write(json.dumps(answer[0]) + "\n")
            rows.append(answer[0])
            panels.append(answer[1])
    if options.sheet and panels:
        Image.fromarray(sheet([[panel] for panel in panels], ACROSS)).save(options.sheet)
    found = summary(rows)
    if options.json:
        print(json.dumps({"pictures": rows, "summary": found}))
        return 0
    print(f"{'light':10} pictures  mean IoU  median IoU  area over the true one")
    for name, group in found.items():
        numbers = f"{group['mean_iou']:8.3f}  {group['median_iou']:10.3f}  {group['median_area']:22.2f}"
        print(f"{name:10} {group['pictures']:8}  {numbers}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
