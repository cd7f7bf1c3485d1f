# SPDX-License-Identifier: MIT
"""Composition quality: PSE-SDS against its three ablations on assets of known truth. Needs bpy.

    python -m physgen.benchmarks.compose --small --out compose_out
    python -m physgen.benchmarks.compose --only ring hat --methods pse-sds --json

Every method gets the same start (splats fitted to Cycles renderings, then distorted so that the objects intersect), the
same input picture, guidance (the ideal denoiser of pictures of O1) and number of steps. Default: 256², 20,000 splats,
500 steps, which takes hours for all assets; ``--small``: minutes; ``--quick``: one asset, a few steps. Pictures and
fits are kept in ``--cache``. ``--stand`` instead drops the compositions by PSE-SDS, and the truth beside them, in
MuJoCo. ``--out`` gets table.md, table.json, a contact sheet, and the composed splats as PLY; or standing.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from physgen.benchmarks.common import QuickParser, benchmark_parser
from physgen.benchmarks.compose_assets.catalogue import NAMES, asset
from physgen.benchmarks.compose_assets.pictures import cache_name, rendered
from physgen.benchmarks.compose_assets.results import Line, Row, contact_sheet, document, markdown, text
from physgen.benchmarks.compose_assets.standing import SECONDS, Standing, drop, standing_json, standing_text
from physgen.benchmarks.compose_assets.trial import SMALL, TINY, Budget, composed, judged, picture_of, start
from physgen.sim.gaussians.compose.compose_options import METHODS, ComposeOptions
from physgen.sim.gaussians.guidance.pretrained_models import ClipScores
from physgen.sim.gaussians.splat_ply import write_splats
from physgen.sim.mpm.colliders import Surface


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
    if options.stand:
        return _stand(options, budget, cache, out)
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


def _stand(options: argparse.Namespace, budget: Budget, cache: Path, out: Path) -> int:
    """Drop every composition and its truth, and print what becomes of them; return the exit code."""
    rows: list[tuple[str, str, Standing]] = []
    seconds = 0.1 if options.quick else SECONDS
    for name in options.only:
        item = asset(name)
        surfaces = _surfaces(name, budget, options.seed, cache)
        true = [Surface(vertices=part.vertices, faces=part.faces) for part in item.parts]
        for kind, pieces in (("composed", surfaces), ("truth", true)):
            for held in (True, False):
                found = drop(pieces[0], pieces[1:], held=held, seconds=seconds)
                rows.append((name, f"{kind}, {'held' if held else 'free'}", found))
                print(standing_text(rows[-1:]).splitlines()[0], file=sys.stderr, flush=True)
    result = {"budget": dataclasses.asdict(budget), **standing_json(rows)}
    (out / "standing.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(json.dumps(result) if options.json else standing_text(rows))
    return 0


def _surfaces(name: str, budget: Budget, seed: int, cache: Path) -> list[Surface]:
    """The surfaces of the composition of an asset by PSE-SDS, O1 first, from ``cache`` if it was composed before."""
    item = asset(name)
    parts = f"{budget.splats}-{budget.fit_steps}-{budget.steps}-{seed}"
    file = cache / f"{cache_name(item, budget.size)}-composed-{parts}.npz"
    if not file.is_file():
        seen = rendered([name], budget.size, cache)[name]
        begin = start(item, seen, budget, cache)
        result, _ = composed(item, seen, begin, METHODS[0], budget, ComposeOptions(seed=seed))
        pieces = [piece.surface for piece in (result.parts[-1], *result.parts[:-1])]
        arrays = {f"vertices_{i}": piece.vertices for i, piece in enumerate(pieces)}
        np.savez_compressed(file, **arrays, **{f"faces_{i}": piece.faces for i, piece in enumerate(pieces)})
    with np.load(file, allow_pickle=False) as kept:
        return [
            Surface(vertices=kept[f"vertices_{i}"], faces=kept[f"faces_{i}"]) for i in range(1 + len(item.foregrounds))
        ]


def _parser() -> QuickParser:
    parser = benchmark_parser("compose", __doc__, only=["ring"], methods=["pse-sds"])
    parser.add_argument(
        "--small", action="store_true", help=f"{SMALL.size}², {SMALL.splats} splats, {SMALL.steps} steps"
    )
    parser.add_argument("--stand", action="store_true", help="drop the compositions for 5 s in another engine, MuJoCo")
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
