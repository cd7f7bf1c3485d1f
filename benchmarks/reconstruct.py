# SPDX-License-Identifier: GPL-3.0-or-later
"""How well photos are taken apart: Cycles renders pictures with known truth, the product reads them from loose boxes.

    python benchmarks/reconstruct.py [--set test|dev] [--quick] [--only CASE …] [--pictures DIR] [--scenes DIR]
                                     [--json FILE] [--sheet FILE.png]

Every picture and its box come from a seed (``pictures/cases.py``); ``pictures/FORMAT.md`` says what is known of each.
``test`` is for measuring; tune on ``dev`` alone. The product runs as a process of its own, in a folder that holds the
photo, the boxes, and the true largest extent of the first object (no angle of view, no names of things); then its scene
is compared with the truth. A case that fails counts as 0, its errors as 100 % and 90°.

Rendering takes about 20 CPU seconds a picture, and every case has two to eight; ``--pictures`` keeps them. Wanted
(issue 7): medians of mask IoU 0.93, shadow IoU 0.75, background 4 dB over cv2.inpaint, hidden parts' IoU 0.7, IoU of
the mesh's outline with the mask it was made from 0.97, volume of boxes, cylinders and spheres within 25 %, angle of
view within 10 % and ground within 3° where vanishing points exist.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.pictures import attempt, judge, sheet
from physgen.benchmarks.pictures.cases import SETS
from physgen.benchmarks.pictures.truth import Truth, load_truth
from PIL import Image

QUICK = 6
ATTEMPT_LIMIT_S = 1800.0


def rendered(set_name: str, number: int, root: Path, samples: int | None) -> Path:
    """The folder of the picture, rendered first unless it is there. Blender's messages go to standard error."""
    folder = root / f"case_{number:02}"
    if not (folder / "truth.json").is_file():
        command = [sys.executable, "-m", "physgen.benchmarks.pictures.shoot", set_name, str(number), str(folder)]
        if samples is not None:
            command += ["--samples", str(samples)]
        root.mkdir(parents=True, exist_ok=True)
        subprocess.run(command, check=True, stdout=sys.stderr)
    return folder


def attempted(truth: Truth, folder: Path) -> dict[str, Any]:
    """Let the product work on the photo in ``folder``, which is emptied first; what it said."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copyfile(truth.photo, folder / attempt.PHOTO)
    names = judge.alias(truth)
    objects = [
        {"name": names[item.name], "box": item.box, "size_m": item.size_m if i == 0 else None}
        for i, item in enumerate(truth.objects)
    ]
    (folder / attempt.REQUEST).write_text(json.dumps({"objects": objects}))
    command = [sys.executable, "-m", "physgen.benchmarks.pictures.attempt", str(folder)]
    nothing: dict[str, Any] = {"cpu_s": 0.0, "stages": {}, "notices": []}
    try:
        done = subprocess.run(command, stdout=sys.stderr, timeout=ATTEMPT_LIMIT_S)
    except subprocess.TimeoutExpired:
        return {**nothing, "error": f"not done after {ATTEMPT_LIMIT_S:g} s", "cpu_s": ATTEMPT_LIMIT_S}
    said = folder / attempt.SAID
    if not said.is_file():
        return {**nothing, "error": f"ended with {done.returncode} and said nothing"}
    return json.loads(said.read_text())


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A line for each object, with its case's numbers on the first."""
    head = f"{'case':8} {'object':12} {'mask':>5} {'shad.':>5} {'hidd.':>5} {'mesh':>5} {'true':>5} {'vol.':>5}"
    lines = [head + f" | {'back':>5} {'cv2':>5} {'gain':>5} {'fov':>5} {'norm.':>5} {'order':>5} {'cpu s':>6}"]
    for row in rows:
        pairs = row["pairs_in_order"]
        order = f"{sum(pairs)}/{len(pairs)}" if pairs else "-"
        tail = (
            f" | {row['background_db']:5.1f} {row['opencv_db']:5.1f} {row['background_gain_db']:+5.1f} "
            f"{100 * row['fov_error']:4.0f}% {row['normal_deg']:5.1f} {order:>5} {row['cpu_s']:6.1f}"
        )
        for name, item in row["objects"].items():
            keys = ("mask_iou", "shadow_iou", "hidden_iou", "silhouette_iou", "silhouette_true_iou", "volume_error")
            numbers = " ".join(f"{item[key]:5.2f}" if key in item else f"{'-':>5}" for key in keys)
            lines.append(f"{row['case']:8} {name:12} {numbers}{tail}")
            tail = ""
        if row["error"] is not None:
            lines.append(f"         FAILED: {str(row['error']).strip().splitlines()[-1]}")
    return "\n".join(lines)


def summary_text(summary: dict[str, Any]) -> str:
    """The medians, with what is wanted of them."""
    wanted = {key: (sign, value) for key, sign, value in judge.WANTED}
    lines = []
    for key, entry in summary.items():
        if not isinstance(entry, dict):
            lines.append(f"{key:28} {entry}")
            continue
        value = entry["median"] if "median" in entry else entry["share"]
        text = f"{key:28} {'-' if value is None else format(value, '.3f'):>8}  of {entry['of']}"
        if key in wanted and value is not None:
            sign, limit = wanted[key]
            good = value >= limit if sign == ">=" else value <= limit
            text += f"   wanted {sign} {limit:g}: {'yes' if good else 'NO'}"
        lines.append(text)
    return "\n".join(lines)


def measure(folders: Sequence[Path], scenes: Path, lines: list[NDArray[np.uint8]] | None) -> list[dict[str, Any]]:
    """The rows of all cases; appends to ``lines`` what the contact sheet shows."""
    rows = []
    for folder in folders:
        truth = load_truth(folder)
        place = scenes / truth.name
        row = judge.judge(truth, place / attempt.SCENE, attempted(truth, place))
        sys.stderr.write(table([row]).split("\n", 1)[1] + "\n")
        rows.append(row)
        if lines is not None:
            lines.append(sheet.row_of(truth, place / attempt.SCENE, row))
    return rows


def main() -> int:
    """Entry; 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", choices=sorted(SETS), default="test")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} cases, spread over the set")
    parser.add_argument("--only", type=int, nargs="+", metavar="CASE", help="numbers, from 0")
    parser.add_argument("--pictures", type=Path, help="folder that keeps the rendered set")
    parser.add_argument("--ready", action="store_true", help="only what --pictures holds already; renders nothing")
    parser.add_argument("--scenes", type=Path, help="folder that keeps what the product makes")
    parser.add_argument("--samples", type=int, help="light paths a pixel of new pictures")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all cases and the medians")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="contact sheet")
    options = parser.parse_args()
    count = SETS[options.set][0]
    numbers = options.only or (range(0, count, count // QUICK)[:QUICK] if options.quick else range(count))
    with tempfile.TemporaryDirectory(prefix="physgen-reconstruct-") as scratch:
        pictures = options.pictures or Path(scratch) / "pictures"
        if options.ready:
            numbers = [n for n in numbers if (pictures / f"case_{n:02}" / "truth.json").is_file()]
        folders = [rendered(options.set, number, pictures, options.samples) for number in numbers]
        lines: list[NDArray[np.uint8]] | None = [] if options.sheet else None
        rows = measure(folders, options.scenes or Path(scratch) / "scenes", lines)
    summary = judge.medians(rows)
    if options.json:
        options.json.write_text(json.dumps({"set": options.set, "medians": summary, "cases": rows}, indent=1))
    if options.sheet and lines:
        Image.fromarray(np.concatenate(lines)).save(options.sheet)
    print(table(rows) + "\n\n" + summary_text(summary))
    return 0


if __name__ == "__main__":
    sys.exit(main())
