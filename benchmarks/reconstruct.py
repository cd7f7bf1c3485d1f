# SPDX-License-Identifier: GPL-3.0-or-later
"""Accuracy of the reconstruction on rendered photos of known truth. Needs bpy.

    python -m physgen.benchmarks.reconstruct [--set test|dev|turntable|held_out|fresh] [--sample] [--only CASE …]
                                             [--pictures DIR] [--scenes DIR] [--report FILE]
                                             [--sheet FILE.png] [--turntables DIR]

Each picture and its boxes follow from a seed (``reconstruct_pictures/cases.py``; what is known of it:
``reconstruct_pictures/FORMAT.md``). ``test`` is for measuring; tune on ``dev`` only. The reconstruction runs in its own
process, in a folder that contains the photo, the boxes, and the true largest extent of the first object (no field of
view, no object names); then its scene is compared with the truth. A failed case counts as 0, its errors as 100 %
and 90°.

Rendering takes about 20 CPU seconds per image, and a case has two to eight; ``--pictures`` keeps them. Required:
medians of mask IoU 0.93, shadow IoU 0.75, background 4 dB over cv2.inpaint, IoU of hidden parts 0.7, IoU of the mesh's
silhouette with its mask 0.97, volume of boxes, cylinders and spheres within 25 %, field of view within 10 % and ground
within 3° where there are vanishing points.

``--set turntable`` is about what the photo does not show: a plush toy, a mug, a chair, a dog and a carton whose surface
is known all around. Views of the reconstruction at ±90° and 180° are compared with the true ones
(``reconstruct_pictures/view_distance.py``), and marks seen from behind that are not there are counted
(``salient_marks.py``; required: none). A failed case counts as a distance of 100. ``--turntables`` writes the true body
beside the found one. ``held_out`` and ``fresh`` are the same for five and two other bodies.

``--quick`` is one case of ``turntable`` with one sample per pixel.
"""

from __future__ import annotations

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
from physgen.benchmarks.common import benchmark_parser
from physgen.benchmarks.reconstruct_pictures import attempt, contact_sheet, scoring, turntable_scoring
from physgen.benchmarks.reconstruct_pictures.cases import Case
from physgen.benchmarks.reconstruct_pictures.picture_sets import SETS, SHOTS, draw
from physgen.benchmarks.reconstruct_pictures.scoring import Truth, load_truth
from physgen.sim.scene.folder import load_scene
from PIL import Image

SAMPLE = 6
"""Cases of ``--sample``."""
ATTEMPT_LIMIT_S = 1800.0


def rendered(set_name: str, number: int, root: Path, samples: int | None) -> Path:
    """Return the folder of the picture, rendered first if it is missing. Blender prints to standard error."""
    folder = root / f"case_{number:02}"
    if not (folder / "truth.json").is_file():
        command = [
            sys.executable,
            "-m",
            "physgen.benchmarks.reconstruct_pictures.blender_photo",
            set_name,
            str(number),
            str(folder),
        ]
        if samples is not None:
            command += ["--samples", str(samples)]
        root.mkdir(parents=True, exist_ok=True)
        subprocess.run(command, check=True, stdout=sys.stderr)
    return folder


def attempted(truth: Truth, folder: Path) -> dict[str, Any]:
    """Reconstruct the photo in ``folder``, which is emptied first, in another process; return its answer."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copyfile(truth.photo, folder / attempt.PHOTO)
    names = scoring.alias(truth)
    objects = [
        {"name": names[item.name], "box": item.box, "size_m": item.size_m if i == 0 else None}
        for i, item in enumerate(truth.objects)
    ]
    (folder / attempt.REQUEST).write_text(json.dumps({"objects": objects}))
    command = [sys.executable, "-m", "physgen.benchmarks.reconstruct_pictures.attempt", str(folder)]
    nothing: dict[str, Any] = {"cpu_s": 0.0, "stages": {}, "notices": []}
    try:
        done = subprocess.run(command, stdout=sys.stderr, timeout=ATTEMPT_LIMIT_S)
    except subprocess.TimeoutExpired:
        return {**nothing, "error": f"timed out after {ATTEMPT_LIMIT_S:g} s", "cpu_s": ATTEMPT_LIMIT_S}
    attempt_result = folder / attempt.ANSWER
    if not attempt_result.is_file():
        return {**nothing, "error": f"exit code {done.returncode} without an answer"}
    return json.loads(attempt_result.read_text())


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table with a line per object, with its case's numbers on the first."""
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


def turntable_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table with a line per body: distances of views in Delta E, and marks from behind."""
    keys = turntable_scoring.NUMBERS
    lines = [f"{'body':12} " + " ".join(f"{key.replace('_', ' '):>17}" for key in keys)]
    for row in rows:
        for name, item in row["objects"].items():
            numbers = (format(item[key], "d" if "marks" in key else ".2f") for key in keys)
            lines.append(f"{name:12} " + " ".join(f"{number:>17}" for number in numbers))
    return "\n".join(lines)


def summary_text(summary: dict[str, Any]) -> str:
    """Return the medians with their requirements as text."""
    wanted = {key: (sign, value) for key, sign, value in scoring.WANTED}
    lines = []
    for key, entry in summary.items():
        if not isinstance(entry, dict):
            lines.append(f"{key:28} {entry}")
            continue
        value = next(entry[kind] for kind in ("median", "share", "mean", "sum") if kind in entry)
        text = f"{key:28} {'-' if value is None else format(value, '.3f'):>8}  of {entry['of']}"
        if key in wanted and value is not None:
            sign, limit = wanted[key]
            good = value >= limit if sign == ">=" else value <= limit
            text += f"   required {sign} {limit:g}: {'yes' if good else 'NO'}"
        lines.append(text)
    return "\n".join(lines)


def viewed(case: Case, truth: Truth, scene: Path, row: dict[str, Any], sheets: Path | None) -> None:
    """Add to ``row`` what the turntable of ``case`` shows; write the true body beside the found one."""
    item = truth.objects[0]
    if row["error"] is not None:
        row["objects"][item.name] |= turntable_scoring.FAILED
        return
    true = turntable_scoring.true_body(case)
    found = turntable_scoring.found_body(load_scene(scene), scoring.alias(truth)[item.name])
    row["objects"][item.name] |= turntable_scoring.compared(true, found).numbers
    if sheets is not None:
        sheets.mkdir(parents=True, exist_ok=True)
        turntable_scoring.save_jpeg(turntable_scoring.beside(true, found), sheets / f"turntable_{item.kind}.jpg")


def measure(
    cases: Sequence[tuple[int, Path]],
    scenes: Path,
    lines: list[NDArray[np.uint8]] | None,
    *,
    turntables: str | None = None,
    sheets: Path | None = None,
    judge: bool = False,
) -> list[dict[str, Any]]:
    """Return the rows of all cases, given by number and folder; append the contact sheet's rows to ``lines``.

    turntables: their set if it is one of bodies known all around. sheets: folder of their sheets. judge: scenes that
    are there are judged as they are.
    """
    rows = []
    for number, folder in cases:
        truth = load_truth(folder)
        place = scenes / truth.name
        answer = place / attempt.ANSWER
        attempt_result = json.loads(answer.read_text()) if judge and answer.is_file() else attempted(truth, place)
        row = scoring.judge(truth, place / attempt.SCENE, attempt_result)
        if turntables is not None:
            viewed(draw(turntables, number), truth, place / attempt.SCENE, row, sheets)
        sys.stderr.write(table([row]).split("\n", 1)[1] + "\n")
        rows.append(row)
        if lines is not None:
            lines.append(contact_sheet.row_of(truth, place / attempt.SCENE, row))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 1 if a case failed with ``--quick``, else 0."""
    parser = benchmark_parser("reconstruct", __doc__, set="turntable", only=[1], samples=1)
    parser.add_argument("--set", choices=sorted(SETS), default="test", help="set of pictures (default: %(default)s)")
    parser.add_argument("--sample", action="store_true", help=f"{SAMPLE} cases, spread over the set")
    parser.add_argument("--only", type=int, nargs="+", metavar="CASE", help="numbers, from 0")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="folder that keeps the rendered set")
    parser.add_argument("--ready", action="store_true", help="only cases in --pictures; render nothing")
    parser.add_argument("--judge", action="store_true", help="judge scenes that are in --scenes; do not repeat them")
    parser.add_argument("--scenes", type=Path, metavar="DIR", help="folder that keeps the reconstructed scenes")
    parser.add_argument("--samples", type=int, help="samples per pixel of new pictures")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write all cases and the medians as JSON")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="write a contact sheet")
    parser.add_argument("--turntables", type=Path, metavar="DIR", help="write true and found bodies from eight sides")
    options = parser.parse_args(arguments)
    count = SETS[options.set][0]
    numbers = options.only or (range(0, count, max(1, count // SAMPLE))[:SAMPLE] if options.sample else range(count))
    with tempfile.TemporaryDirectory(prefix="physgen-reconstruct-") as scratch:
        pictures = options.pictures or Path(scratch) / "pictures"
        if options.ready:
            numbers = [n for n in numbers if (pictures / f"case_{n:02}" / "truth.json").is_file()]
        cases = [(number, rendered(options.set, number, pictures, options.samples)) for number in numbers]
        lines: list[NDArray[np.uint8]] | None = [] if options.sheet else None
        turntables = options.set if options.set in SHOTS else None
        rows = measure(
            cases,
            options.scenes or Path(scratch) / "scenes",
            lines,
            turntables=turntables,
            sheets=options.turntables,
            judge=options.judge,
        )
    summary = scoring.medians(rows)
    if turntables:
        summary |= turntable_scoring.summary(rows)
    result = {"set": options.set, "medians": summary, "cases": rows}
    if options.report:
        options.report.write_text(json.dumps(result, indent=1))
    if options.sheet and lines:
        Image.fromarray(np.concatenate(lines)).save(options.sheet)
    text = [table(rows), *([turntable_table(rows)] if turntables else []), summary_text(summary)]
    print(json.dumps(result) if options.json else "\n\n".join(text))
    return 1 if options.quick and any(row["error"] is not None for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
