# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks by colour and texture beside those of a model, on rendered photos of known truth and on any photos.

    python -m physgen.benchmarks.cutouts [--pictures DIR] [--photo FILE BOX …] [--segmenter NAME …] [--size PX]
                                         [--report FILE.json] [--sheet FILE.png]

DIR holds pictures as ``reconstruct --pictures`` keeps them: the program gets their boxes, and its masks are compared
with what is seen of each object (intersection over union). ``--photo`` adds a photo with boxes x0,y0,x1,y1, without
truth, for the sheet: each object as photographed, and cut out by each segmenter. Without ``--segmenter``: ``none`` and
the installed model. ``--quick`` draws its own picture. ``--proposals`` looks instead for the objects without
a box: recall is the share of them of which a proposal, or one that would be used, has half of the box' union in common.
"""

from __future__ import annotations

import json
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
from physgen.benchmarks.reconstruct_pictures.scoring import iou
from physgen.sim.app.propose import SEARCHED, best_proposals
from physgen.sim.events import ignore, never
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.adapters.adapter_registry import WITHOUT, chosen_segmenter
from physgen.sim.reconstruct.photo import load_photo
from physgen.sim.reconstruct.segmentation.object_masks import segment_objects
from physgen.sim.reconstruct.segmentation.object_proposals import propose_boxes
from physgen.sim.reconstruct.stage_cache import StageCache, Steps
from PIL import Image

BACKDROP = (40, 60, 200)
TALL = 260
"""Pixels of a row of the sheet."""

Row = dict[str, Any]
Case = tuple[str, Path, dict[str, tuple[float, float, float, float]], Path | None]
"""Name, photo, boxes by object, folder of true masks or None."""


def rendered_cases(root: Path) -> list[Case]:
    """Return the pictures in ``root``."""
    found: list[Case] = []
    for folder in sorted(root.glob("case_*")):
        truth = json.loads((folder / "truth.json").read_text())
        boxes = {item["name"]: tuple(item["box"]) for item in truth["objects"]}
        found.append((folder.name, folder / "photo.jpg", boxes, folder / "visible"))
    return found


def photo_case(words: Sequence[str]) -> Case:
    """Return the photo and boxes in ``words``."""
    boxes = {f"object_{n}": tuple(map(float, word.split(","))) for n, word in enumerate(words[1:], start=1)}
    return Path(words[0]).stem, Path(words[0]), boxes, None  # type: ignore[return-value]


def attempt(case: Case, segmenter: str, size: int) -> tuple[NDArray[np.uint8], dict[str, NDArray[np.bool_]], float]:
    """Return the working photo, the masks by name, and CPU seconds."""
    _, photo, boxes, _ = case
    options = ReconstructOptions(max_size=size, segmenter=chosen_segmenter(segmenter))
    requests = [ObjectRequest(name=name, box=box) for name, box in boxes.items()]
    picture = load_photo(photo, size)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        store = StageCache(Path(folder) / "new", Path(folder) / "old", lambda _: None)
        masks, _ = segment_objects(picture, requests, options, store, Steps(9, ignore, never))
    return picture.pixels, dict(zip(boxes, masks, strict=True)), time.process_time() - began


def shown(pixels: NDArray[np.uint8], mask: NDArray[np.bool_] | None, box: Sequence[int]) -> NDArray[np.uint8]:
    """Return the box with a margin, what is not in ``mask`` painted over."""
    x0, y0, x1, y1 = box
    margin = max(8, (x1 - x0) // 12)
    window = np.s_[max(0, y0 - margin) : y1 + margin, max(0, x0 - margin) : x1 + margin]
    part = pixels[window].copy()
    if mask is not None:
        part[~mask[window]] = BACKDROP
    size = (max(1, part.shape[1] * TALL // part.shape[0]), TALL)
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def sheet(columns: Sequence[Sequence[NDArray[np.uint8]]], across: int = 6) -> NDArray[np.uint8]:
    """Return the objects' pictures: one below the other for each object, ``across`` objects beside each other."""
    widest = max(part.shape[1] for column in columns for part in column)
    blocks = []
    for start in range(0, len(columns), across):
        row = [
            np.vstack([np.pad(p, ((2, 2), (0, widest - p.shape[1]), (0, 0)), constant_values=255) for p in column])
            for column in columns[start : start + across]
        ]
        row += [np.full_like(row[0], 255)] * (min(across, len(columns)) - len(row))
        blocks.append(np.hstack(row))
    return np.vstack(blocks)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table; the exit code."""
    parser = benchmark_parser("cutouts", __doc__)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="rendered pictures with their truth")
    text = "a photo, and the boxes in it"
    parser.add_argument("--photo", nargs="+", action="append", default=[], metavar="FILE", help=text)
    parser.add_argument("--segmenter", nargs="+", metavar="NAME", help="what to compare")
    text = "longest side of the working photo (default: %(default)s)"
    parser.add_argument("--size", type=int, default=960, metavar="PX", help=text)
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the rows as JSON")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="write a contact sheet")
    parser.add_argument("--proposals", action="store_true", help="recall of objects without a box, weight-free")
    options = parser.parse_args(arguments)
    installed = chosen_segmenter(None)
    compared = options.segmenter or [WITHOUT, *([installed] if installed else [])]
    cases = [photo_case(words) for words in options.photo]
    with tempfile.TemporaryDirectory() as folder:
        if options.quick:
            cases += rendered_cases(drawn(Path(folder)))
        cases += rendered_cases(options.pictures) if options.pictures else []
        if options.proposals:
            print(json.dumps({"rows": (found := [recall(case) for case in cases]), **totals(found)}))
            return 0
        rows, columns = compare(cases, compared, options.size)
    means = {
        name: float(np.mean([row[name] for row in rows if name in row]))
        for name in compared
        if rows and name in rows[-1]
    }
    if options.json:
        print(json.dumps({"rows": rows, "mean": means}))
    else:
        for row in rows:
            print("  ".join(f"{key} {value}" for key, value in row.items()))
        print("  ".join(f"{name}: mean IoU {value:.3f}" for name, value in means.items()))
    if options.report:
        options.report.write_text(json.dumps(rows, indent=1))
    if options.sheet and columns:
        Image.fromarray(sheet(columns)).save(options.sheet)
    return 0


def compare(
    cases: Sequence[Case], compared: Sequence[str], size: int
) -> tuple[list[Row], list[list[NDArray[np.uint8]]]]:
    """Return a row for each object of ``cases``, and its pictures: the photo's, and one of each segmenter."""
    rows: list[Row] = []
    columns = []
    for case in cases:
        name, photo, boxes, truth = case
        results = {segmenter: attempt(case, segmenter, size) for segmenter in compared}
        pixels = results[compared[0]][0]
        scale = max(pixels.shape[:2]) / max(Image.open(photo).size)
        for item, box in boxes.items():
            corners = [round(v * scale) for v in box]
            columns.append(
                [shown(pixels, None, corners), *(shown(pixels, r[1][item], corners) for r in results.values())]
            )
            row: Row = {"case": name, "object": item}
            for segmenter, (_, masks, seconds) in results.items():
                row[f"{segmenter} cpu_s"] = round(seconds / len(boxes), 1)
                if truth is not None:
                    seen = Image.open(truth / f"{item}.png").resize(pixels.shape[1::-1], Image.Resampling.BOX)
                    row[segmenter] = round(iou(masks[item], np.asarray(seen) > 127), 3)
            rows.append(row)
    return rows, columns


def recall(case: Case) -> Row:
    """Return how many objects of ``case``, which has true masks, are among the proposals, and among those used."""
    name, photo, _, truth = case
    assert truth is not None
    found = propose_boxes(load_photo(photo, SEARCHED).pixels)
    scale = max(load_photo(photo, SEARCHED).pixels.shape[:2]) / max(Image.open(photo).size)
    used = [found[index] for index in best_proposals(found)]
    row: Row = {"case": name, "objects": 0, "found": 0, "used": 0, "proposals": len(found)}
    for file in sorted(truth.glob("*.png")):
        seen = np.argwhere(np.asarray(Image.open(file).convert("L")) > 127) * scale
        if not len(seen):
            continue
        box = (*seen.min(axis=0)[::-1], *(seen.max(axis=0)[::-1] + scale))
        row["objects"] += 1
        for key, items in (("found", found), ("used", used)):
            row[key] += int(any(box_iou(item.box, box) > 0.5 for item in items))
    return row


def box_iou(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the share of two boxes' union, x0, y0, x1, y1 each, that both have in common."""
    width, height = (min(first[i + 2], second[i + 2]) - max(first[i], second[i]) for i in (0, 1))
    common = max(0.0, width) * max(0.0, height)
    return float(common / (sum((b[2] - b[0]) * (b[3] - b[1]) for b in (first, second)) - common))


def totals(rows: Sequence[Row]) -> dict[str, float]:
    """Return the recall of proposals, and of those that would be used."""
    objects = max(1, sum(row["objects"] for row in rows))
    return {f"recall_{key}": round(sum(row[key] for row in rows) / objects, 3) for key in ("found", "used")}


def drawn(root: Path) -> Path:
    """Draw a case into ``root``: a red ring on grey noise; return ``root``."""
    folder = root / "case_00"
    (folder / "visible").mkdir(parents=True)
    rows, columns = np.mgrid[:120, :160]
    away = np.hypot(rows - 60, columns - 80)
    mask = (away < 35) & (away > 14)
    pixels = np.random.default_rng(0).normal(128, 4, (120, 160, 3)).clip(0, 255).astype(np.uint8)
    pixels[mask] = (200, 40, 40)
    Image.fromarray(pixels).save(folder / "photo.jpg", quality=95)
    Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "visible" / "ring.png")
    (folder / "truth.json").write_text(json.dumps({"objects": [{"name": "ring", "box": [35, 15, 125, 105]}]}))
    return root


if __name__ == "__main__":
    sys.exit(main())
