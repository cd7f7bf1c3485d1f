# SPDX-License-Identifier: GPL-3.0-or-later
"""Cut-outs of things with holes and thin parts, and objects found without a box. Needs bpy.

    python -m physgen.benchmarks.thin_parts [--set thin|dev|test|turntable] [--only CASE …] [--pictures DIR]
                                         [--sheet FILE.png]

``thin`` (``reconstruct_pictures/thin_bodies.py``): a chair with slats, wire glasses, a bicycle, a plant, a ball of fur,
a book whose spine has the table's tone, a dark box on dark cloth. Only the photo and the true coverage are rendered,
about 20 CPU seconds a picture; ``--pictures`` keeps them. From the true, loose box: IoU of the mask; the share of holes
(background between parts that are up to a quarter of the size apart) that stays open, and of thin parts (under 3 % of
the size) that is kept; mean error of the mask and of its soft alpha where the true alpha is between 0.02 and 0.98.
Without a box: for how many objects a proposal has an IoU of 0.5 with the tight box, and how many proposals are of none.

``--quick`` is one picture with one sample per pixel.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser
from physgen.benchmarks.reconstruct_pictures.picture_sets import SETS
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.report_pictures import numbered_boxes
from physgen.sim.reconstruct.segmentation.box_segmentation import pixel_box, segment
from physgen.sim.reconstruct.segmentation.matting import soft_alpha
from physgen.sim.reconstruct.segmentation.object_proposals import propose_boxes
from PIL import Image

Mask = NDArray[np.bool_]
ALPHA, PHOTO, BOXES = "alpha", "photo.jpg", "boxes.json"


def rendered(set_name: str, number: int, root: Path, samples: int) -> Path:
    """Return the folder of the picture, rendered first if it is missing. Blender prints to standard error."""
    folder = root / f"{set_name}_{number:02}"
    if not (folder / BOXES).is_file():
        root.mkdir(parents=True, exist_ok=True)
        module = "physgen.benchmarks.reconstruct_pictures.blender_photo"
        command = [sys.executable, "-m", module, set_name, str(number), str(folder), "--samples", str(samples)]
        subprocess.run([*command, "--coverage-only"], check=True, stdout=sys.stderr)
    return folder


def holes_of(truth: Mask) -> Mask:
    """The background (H, W) near the object or between its parts: what a coarse mask fills."""
    size = float(np.sqrt(truth.sum()))
    reach = max(3, round(0.12 * size))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray((cv2.morphologyEx(truth.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0) & ~truth)


def thin_parts_of(truth: Mask) -> Mask:
    """The parts (H, W) of the object that are thinner than 3 % of its box' size."""
    rows, columns = np.flatnonzero(truth.any(axis=1)), np.flatnonzero(truth.any(axis=0))
    side = max(3, round(0.03 * max(np.ptp(rows), np.ptp(columns))))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(truth & ~(cv2.morphologyEx(truth.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0))


def box_iou(first: Sequence[float], second: Sequence[float]) -> float:
    """Intersection over union of two boxes x0, y0, x1, y1."""
    width, height = (min(first[i + 2], second[i + 2]) - max(first[i], second[i]) for i in (0, 1))
    common = max(0.0, width) * max(0.0, height)
    return common / (sum((b[2] - b[0]) * (b[3] - b[1]) for b in (first, second)) - common)


def judged(folder: Path, *, boxes: bool) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    """Return the numbers of a picture, and a row of the sheet: photo with proposals, truth, mask, alpha."""
    pixels = np.asarray(Image.open(folder / PHOTO).convert("RGB"))
    true = json.loads((folder / BOXES).read_text())
    height, width = pixels.shape[:2]
    row: dict[str, Any] = {"case": folder.name, "objects": {}}
    began = time.process_time()
    found = propose_boxes(pixels)
    row["proposal_cpu_s"] = round(time.process_time() - began, 1)
    hits = [max((box_iou(item.box, entry["tight"]) for item in found), default=0.0) for entry in true]
    row["found"], row["objects_in_it"] = sum(value >= 0.5 for value in hits), len(true)
    row["false"] = sum(all(box_iou(item.box, entry["tight"]) < 0.5 for entry in true) for item in found)
    shown = [numbered_boxes(pixels, [item.box for item in found], range(len(found)))]
    if not boxes:
        return row, shown[0]
    masks, mattes, truths = (np.zeros((height, width), np.float32) for _ in range(3))
    for entry in true:
        alpha = np.asarray(Image.open(folder / ALPHA / f"{entry['name']}.png"), dtype=np.float32) / 255.0
        truth = alpha > 0.5
        began = time.process_time()
        notices: list[str] = []
        try:
            mask = segment(pixels, pixel_box(entry["box"], 1.0, width, height, ""), entry["name"], warn=notices.append)
        except InputError as problem:
            notices.append(str(problem))
            mask = np.zeros((height, width), dtype=bool)
        spent = time.process_time() - began
        matte = soft_alpha(pixels, mask)
        soft = (alpha > 0.02) & (alpha < 0.98)
        holes, thin = holes_of(truth), thin_parts_of(truth)
        row["objects"][entry["name"]] = {
            "mask_iou": float((mask & truth).sum() / max(1, (mask | truth).sum())),
            "holes_open": float((holes & ~mask).sum() / max(1, holes.sum())),
            "thin_kept": float((thin & mask).sum() / max(1, thin.sum())),
            "hard_error": float(np.abs(mask - alpha)[soft].mean()),
            "alpha_error": float(np.abs(matte - alpha)[soft].mean()),
            "cpu_s": round(spent, 1),
            "notices": notices,
        }
        masks, mattes, truths = np.maximum(masks, mask), np.maximum(mattes, matte), np.maximum(truths, alpha)
    for value in (truths, masks, mattes):
        grey = 0.75 * value[..., None] * pixels + (1.0 - value[..., None]) * np.array([255.0, 60.0, 200.0])
        shown.append(grey.astype(np.uint8))
    return row, np.concatenate(shown, axis=1)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a line per object."""
    keys = ("mask_iou", "holes_open", "thin_kept", "hard_error", "alpha_error", "cpu_s")
    lines = [f"{'case':10} {'object':12} " + " ".join(f"{key:>11}" for key in keys) + "  found false"]
    for row in rows:
        tail = f"  {row['found']}/{row['objects_in_it']} {row['false']:5}"
        for name, item in row["objects"].items() or [("-", dict.fromkeys(keys, float("nan")))]:
            lines.append(f"{row['case']:10} {name:12} " + " ".join(f"{item[key]:11.3f}" for key in keys) + tail)
            tail = ""
    found, all_ = (sum(row[key] for row in rows) for key in ("found", "objects_in_it"))
    lines.append(f"found without a box: {found} of {all_}; false: {sum(row['false'] for row in rows)}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0."""
    parser = benchmark_parser("thin_parts", __doc__, only=[0], samples=1)
    parser.add_argument("--set", choices=sorted(SETS), default="thin", help="set of pictures (default: %(default)s)")
    parser.add_argument("--only", type=int, nargs="+", metavar="CASE", help="numbers, from 0")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="folder that keeps the rendered pictures")
    parser.add_argument("--samples", type=int, default=8, help="samples per pixel of new pictures")
    parser.add_argument("--no-masks", action="store_true", help="only the objects found without a box")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="write a contact sheet")
    options = parser.parse_args(arguments)
    rows, lines = [], []
    with tempfile.TemporaryDirectory(prefix="physgen-thin-") as scratch:
        for number in options.only or range(SETS[options.set][0]):
            folder = rendered(options.set, number, options.pictures or Path(scratch), options.samples)
            row, line = judged(folder, boxes=not options.no_masks)
            sys.stderr.write(json.dumps(row) + "\n")
            rows.append(row)
            lines.append(line)
    if options.sheet:
        height, width = (max(line.shape[axis] for line in lines) for axis in (0, 1))
        padded = [np.pad(a, ((0, height - a.shape[0]), (0, width - a.shape[1]), (0, 0))) for a in lines]
        Image.fromarray(np.concatenate(padded)).save(options.sheet)
    print(json.dumps({"set": options.set, "cases": rows}) if options.json else table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
