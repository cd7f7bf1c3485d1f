# SPDX-License-Identifier: MIT
"""Composition quality: PSE-SDS against its three ablations on assets of known truth. Needs bpy.

    python -m physgen.benchmarks.compose --small --out compose_out
    python -m physgen.benchmarks.compose --only ring hat --methods pse-sds --json

Every method gets the same start (splats fitted to Cycles renderings, then distorted so that the objects intersect), the
same input picture, guidance (the ideal denoiser of pictures of O1) and number of steps. Default: 256², 20,000 splats,
500 steps, which takes hours for all assets; ``--small``: minutes; ``--quick``: one asset, a few steps. Pictures and
fits are kept in ``--cache``. ``--out`` gets table.md, table.json, a contact sheet, and the composed splats as PLY.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from physgen.benchmarks.common import QuickParser, benchmark_parser
from physgen.benchmarks.compose_assets.catalogue import NAMES, asset
from physgen.benchmarks.compose_assets.pictures import rendered
from physgen.benchmarks.compose_assets.results import Line, Row, contact_sheet, document, markdown, text
from physgen.benchmarks.compose_assets.trial import SMALL, TINY, Budget, composed, judged, picture_of, start
from physgen.sim.gaussians.compose.compose_options import METHODS, ComposeOptions
from physgen.sim.gaussians.guidance.clip_scores import ClipScores
from physgen.sim.gaussians.splat_ply import write_splats


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = _parser().parse_args(arguments)
    if not options.quick:
        return run(options, options.cache or Path("compose_cache"), options.out or Path("compose_out"))
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
        return run(options, options.cache or Path(scratch) / "cache", options.out or Path(scratch) / "out")


def run(options: argparse.Namespace, cache: Path, out: Path) -> int:
    """Compose all assets with all methods, and print and write the table; return the exit code."""
    budget = TINY if options.quick else SMALL if options.small else Budget()
    given = {"size": options.size, "splats": options.splats, "steps": options.steps}
    budget = dataclasses.replace(budget, **{name: value for name, value in given.items() if value is not None})
    cache.mkdir(parents=True, exist_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    clip = ClipScores(options.clip) if options.clip else None
    pictures = rendered(options.only, budget.size, cache)
    rows: list[Row] = []
    lines: list[Line] = []
    for name in options.only:
        item, seen = asset(name), pictures[name]
        begin = start(item, seen, budget, cache)
        shown, captions = {}, {}
        for method in options.methods:
            result, cpu_s = composed(item, seen, begin, method, budget, ComposeOptions(seed=options.seed))
            row = judged(item, seen, begin, result, method, cpu_s, clip)
            rows.append(row)
            shown[method] = picture_of(result.parts, seen.held_out[0])
            captions[method] = f"{row.psnr_reference:.1f} / {row.psnr_held_out:.1f} dB"
            print(
                f"{name} {method}: {row.psnr_reference:.2f} dB, held out {row.psnr_held_out:.2f}, "
                f"{row.left:.2%} of the penetration left, {cpu_s:.0f} CPU s",
                file=sys.stderr,
                flush=True,
            )
            for piece in result.parts:
                write_splats(out / f"{name}-{method}-{piece.name}.ply", piece.splats)
        lines.append(
            Line(
                title=name,
                truth=seen.held_out[0].pixels,
                start=picture_of(begin, seen.held_out[0]),
                methods=shown,
                captions=captions,
            )
        )
        # After every asset, so that an interrupted run of hours keeps its results.
        contact_sheet(lines, out / "sheet.png")
        (out / "table.md").write_text(markdown(rows), encoding="utf-8")
        found = {"budget": dataclasses.asdict(budget), **document(rows)}
        (out / "table.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    print(json.dumps(found) if options.json else text(rows))
    return 0


def _parser() -> QuickParser:
    parser = benchmark_parser("compose", __doc__, only=["ring"], methods=["pse-sds"])
    parser.add_argument(
        "--small", action="store_true", help=f"{SMALL.size}², {SMALL.splats} splats, {SMALL.steps} steps"
    )
    parser.add_argument("--only", nargs="+", choices=NAMES, default=list(NAMES), metavar="ASSET", help=", ".join(NAMES))
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="METHOD", help=", ".join(METHODS)
    )
    parser.add_argument("--size", type=int, help="image size in pixels")
    parser.add_argument("--splats", type=int, help="total for all objects")
    parser.add_argument("--steps", type=int, help="optimiser steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clip", type=Path, metavar="FOLDER", help="a local CLIP model: adds its scores")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="pictures and fits (default: compose_cache)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="results (default: compose_out)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
