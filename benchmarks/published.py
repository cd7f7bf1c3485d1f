# SPDX-License-Identifier: GPL-3.0-or-later
"""Our figures of a folder of photos beside those that the papers publish; what cannot be computed is left empty.

    python -m physgen.benchmarks.published PHOTOS [--work DIR] [--frames N] [--scale S] [--json]

Each photo goes through the plain ``physgen run``, without boxes or settings, then through ``physgen.evaluate`` with the
photo and the bake. With ``--work`` a second run goes on from what the first has made. The papers' figures are those in
their text (PhyCAGE, table 1) or measured on the videos that they publish (PhysGen3D's first frames); their
figures of people, of a model as judge and of VBench's networks need people, an endpoint and weights, and are empty in
our rows: `physgen evaluate` says how to get them (docs/evaluation.md).
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from physgen.batch.cli import main as physgen_command
from physgen.benchmarks.common import benchmark_parser
from physgen.benchmarks.first_frame import small_photo
from physgen.sim.app.evaluate import evaluate
from physgen.sim.errors import PhysGenError
from physgen.sim.scene.folder import load_scene

SUFFIXES = (".jpg", ".jpeg", ".png")

COLUMNS = (
    "first_frame_psnr",
    "first_frame_ssim",
    "temporal_flickering",
    "motion_smoothness",
    "dynamic_degree",
    "background_psnr",
    "ground_penetration",
    "object_penetration",
    "energy_gain",
    "psnr_reference_view",
    "clip_novel_views",
    "people_physical_realism",
    "model_physical_realism",
)
"""Figures in the order of the table: first those of ``physgen evaluate``, then what only papers have here."""

Row = dict[str, Any]

PUBLISHED: tuple[Row, ...] = (
    {"system": "PhysGen3D", "of": "orange_and_book, its video", "first_frame_psnr": 19.5},
    {"system": "PhysGen3D", "of": "clay_and_camera, its video", "first_frame_psnr": 22.4},
    {"system": "PhysGen3D", "of": "plush_and_book, its better video", "first_frame_psnr": 16.1},
    {"system": "PhyCAGE", "of": "table 1", "psnr_reference_view": 30.70, "clip_novel_views": 87.29},
    {"system": "Part123", "of": "PhyCAGE, table 1", "psnr_reference_view": 17.52, "clip_novel_views": 79.60},
    {"system": "ComboVerse", "of": "PhyCAGE, table 1", "psnr_reference_view": 16.22, "clip_novel_views": 85.23},
)
"""Figures of the papers at hand: dB, and CLIP scores in percent. No figure of theirs is here that is not in their text
or was not measured on their own files."""


def measure(photo: Path, work: Path, flags: Sequence[str]) -> Row:
    """Return our row of ``photo``, run in the folder ``work``. Raises PhysGenError where a stage fails."""
    video = work / f"{photo.stem}.mp4"
    command = ["run", str(photo), "--out", str(video), "--work", str(work / photo.stem), *flags]
    # The command's own lines are no part of the table.
    with contextlib.redirect_stdout(sys.stderr):
        code = physgen_command(command)
    if code != 0:
        raise PhysGenError(f"{photo.name}: physgen run ended with {code}")
    scene = load_scene(work / photo.stem / "scene")
    found = evaluate(
        video,
        photo=scene.file(scene.model.photo),
        bake=work / photo.stem / "bake",
        scene=scene,
        out=work / f"{photo.stem}_evaluation",
    )
    values = {item.name: item.value for item in found.measures}
    return {"system": "ours", "of": photo.name, **{name: values.get(name) for name in COLUMNS if name in values}}


def table_text(rows: Sequence[Row]) -> str:
    """Return ``rows`` as a Markdown table; what is unknown is empty."""
    lines = [f"| system | of | {' | '.join(COLUMNS)} |", f"| --- | --- |{' --- |' * len(COLUMNS)}"]
    for row in rows:
        cells = ["" if (value := row.get(name)) is None else f"{value:.4g}" for name in COLUMNS]
        lines.append(f"| {row['system']} | {row['of']} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0, or the exit code of the first error."""
    parser = benchmark_parser("published", __doc__, frames=4, scale=1.0, samples=1, quality="preview")
    parser.add_argument("photos", type=Path, nargs="?", help="folder of photos (not needed with --quick)")
    parser.add_argument("--work", type=Path, help="folder that keeps the runs (default: a temporary one)")
    parser.add_argument("--frames", type=int, help="of each clip (default: as the default motion needs)")
    parser.add_argument("--scale", type=float, default=1.0, help="of the rendered frames (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=32, help="per pixel (default: %(default)s)")
    parser.add_argument("--quality", default="standard", help="of the bake (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.photos is None and not options.quick:
        parser.error("give the folder of PHOTOS")
    flags = ["--scale", str(options.scale), "--samples", str(options.samples), "--quality", options.quality]
    if options.frames is not None:
        flags += ["--frames", str(options.frames)]
    rows: list[Row] = []
    with contextlib.ExitStack() as stack:
        work = options.work or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="physgen-benchmark-")))
        work.mkdir(parents=True, exist_ok=True)
        if options.photos is None:
            photo, box = small_photo(work)
            photos, flags = [photo], [*flags, "--box", ",".join(f"{value:g}" for value in box)]
        else:
            photos = sorted(path for path in options.photos.iterdir() if path.suffix.lower() in SUFFIXES)
        if not photos:
            parser.error(f"{options.photos}: holds no photos ({', '.join(SUFFIXES)})")
        code = 0
        for photo in photos:
            try:
                rows.append(measure(photo, work, flags))
            except PhysGenError as error:
                sys.stderr.write(f"error: {error}\n")
                rows.append({"system": "ours", "of": f"{photo.name}: failed"})
                code = code or error.exit_code
    rows += PUBLISHED
    # JSON has no infinity: equal pictures have no bound.
    plain = [{k: None if v in (float("inf"), float("-inf")) else v for k, v in row.items()} for row in rows]
    print(json.dumps({"rows": plain, "columns": COLUMNS}) if options.json else table_text(rows))
    return code


if __name__ == "__main__":
    sys.exit(main())
