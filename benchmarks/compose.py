# SPDX-License-Identifier: MIT
"""Composition quality: PSE-SDS against its three ablations on assets of known truth. Needs bpy.

    python -m physgen.benchmarks.compose --small --out compose_out
    python -m physgen.benchmarks.compose --only ring hat --methods pse-sds --json

Every method gets the same start (splats fitted to Cycles renderings, then distorted so that the objects intersect), the
same input picture, guidance (the ideal denoiser of pictures of O1) and number of steps. Default: 256², 20,000 splats,
500 steps, which takes hours for all assets; ``--small``: minutes; ``--quick``: one asset, a few steps. Pictures and
fits are kept in ``--cache``. ``--stand`` instead drops the compositions by PSE-SDS, seated as ``--seat`` says, and
scenes of two to five things in MuJoCo; with ``--truth`` the assets' true shapes as well. ``--out`` gets table.md,
table.json, a contact sheet, and the composed splats as PLY; or standing.json.
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
from physgen.benchmarks.compose_assets.standing import (
    SECONDS,
    Standing,
    drop,
    seats_text,
    standing_json,
    standing_text,
)
from physgen.benchmarks.compose_assets.tables import TABLES, composed_table
from physgen.benchmarks.compose_assets.trial import (
    SMALL,
    TINY,
    Budget,
    composed,
    judged,
    kept_composition,
    likeness,
    picture_of,
    start,
)
from physgen.sim.gaussians.compose.compose_options import METHODS, ComposeOptions
from physgen.sim.gaussians.compose.composition_parts import seated_parts
from physgen.sim.gaussians.guidance.pretrained_models import ClipScores
from physgen.sim.gaussians.splat_ply import write_splats
from physgen.sim.mpm.colliders import Surface
from physgen.sim.scene.model import Ground


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = _parser().parse_args(arguments)
    if not options.quick:
        return run(options, options.cache or Path("compose_cache"), options.out or Path("compose_out"))
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
        return run(options, options.cache or Path(scratch) / "cache", options.out or Path(scratch) / "out")


def run(options: argparse.Namespace, cache: Path, out: Path) -> int:
    """Compose all assets with all methods, and print and write the table; return the exit code."""
    if options.only is None:
        options.only = [*NAMES, *TABLES] if options.stand else list(NAMES)
    budget = TINY if options.quick else SMALL if options.small else Budget()
    given = {"size": options.size, "splats": options.splats, "steps": options.steps}
    budget = dataclasses.replace(budget, **{name: value for name, value in given.items() if value is not None})
    cache.mkdir(parents=True, exist_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    if options.stand:
        return _stand(options, budget, cache, out)
    clip = ClipScores(options.clip) if options.clip else None
    strange = [name for name in options.only if name not in NAMES]
    if strange:
        raise SystemExit(f"{strange[0]} has no pictures, so that methods cannot be compared: give --stand")
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
    """Drop every composition, and print what becomes of them; return the exit code."""
    rows: list[tuple[str, str, Standing]] = []
    pictures: list[tuple[str, tuple[float, float], tuple[float, float]]] = []
    seconds = 0.1 if options.quick else SECONDS

    def dropped(name: str, what: str, surfaces: Sequence[Surface], *, held: bool) -> None:
        rows.append((name, what, drop(surfaces[0], surfaces[1:], held=held, seconds=seconds)))
        print(standing_text(rows[-1:]).splitlines()[0], file=sys.stderr, flush=True)

    for name in (item for item in options.only if item in TABLES):
        chosen = ComposeOptions(method="ppps", steps=budget.table_steps, seat=options.seat, seed=options.seed)
        dropped(name, "composed, free", composed_table(name, chosen), held=False)
    for name in (item for item in options.only if item in NAMES):
        item = asset(name)
        begin = kept_composition(item, budget, options.seed, cache)
        parts = seated_parts(begin, options.seat, Ground()) if options.seat else begin
        seen = rendered([name], budget.size, cache)[name]
        pictures.append((name, likeness(begin, seen), likeness(parts, seen)))
        print(seats_text(pictures[-1:]), file=sys.stderr, flush=True)
        surfaces = [part.surface for part in (parts[-1], *parts[:-1])]
        true = [Surface(vertices=part.vertices, faces=part.faces) for part in item.parts]
        for kind, pieces in (("composed", surfaces), ("truth", true))[: 1 + options.truth]:
            for held in (True, False):
                dropped(name, f"{kind}, {'held' if held else 'free'}", pieces, held=held)
    result = {"budget": dataclasses.asdict(budget), "seat": options.seat, **standing_json(rows, pictures)}
    (out / "standing.json").write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(json.dumps(result) if options.json else "\n".join((seats_text(pictures), standing_text(rows))).strip())
    return 0


def _parser() -> QuickParser:
    parser = benchmark_parser("compose", __doc__, only=["ring"], methods=["pse-sds"])
    parser.add_argument(
        "--small", action="store_true", help=f"{SMALL.size}², {SMALL.splats} splats, {SMALL.steps} steps"
    )
    parser.add_argument("--stand", action="store_true", help="drop the compositions for 5 s in another engine, MuJoCo")
    thickness = "thickness of the seats of what is dropped, over its size; 0: none (default: %(default)s)"
    parser.add_argument("--seat", type=float, default=0.006, help=thickness)
    parser.add_argument("--truth", action="store_true", help="drop the assets' true shapes, too")
    every = (*NAMES, *TABLES)
    some = f"assets {', '.join(NAMES)}; with --stand also scenes {', '.join(TABLES)} (default: all)"
    parser.add_argument("--only", nargs="+", choices=every, metavar="NAME", help=some)
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
