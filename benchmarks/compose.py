# SPDX-License-Identifier: MIT
"""Two things in one picture, brought to fit each other: PSE-SDS against its three ablations on assets of known truth.

    python -m physgen.benchmarks.compose --quick --out compose_out
    python -m physgen.benchmarks.compose --only ring hat --methods pse-sds --json

Every method gets the same start (splats fitted to pictures that Cycles rendered, then distorted so that the objects
pass through each other), the same input picture, the same guidance (the ideal denoiser of pictures of O1) and the same
number of steps. Without ``--quick``: 256², 20,000 splats, 500 steps, which takes hours for all. Pictures and fits are
kept under ``--cache``. ``--out`` gets table.md, table.json, a contact sheet, and the composed splats as PLY.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

from physgen.sim.gaussians.compose.options import METHODS, ComposeOptions
from physgen.sim.gaussians.guidance.clip import ClipScores
from physgen.sim.gaussians.ply.write import write_splats

from .assets.catalogue import NAMES, asset
from .assets.pictures import rendered
from .assets.sheet import Line, contact_sheet
from .assets.table import Row, document, markdown, text
from .assets.trial import QUICK, Budget, composed, judged, picture_of, start


def main() -> int:
    """Run what is asked for; the exit code."""
    options = _parser().parse_args()
    budget = QUICK if options.quick else Budget()
    given = {"size": options.size, "splats": options.splats, "steps": options.steps}
    budget = dataclasses.replace(budget, **{name: value for name, value in given.items() if value is not None})
    options.cache.mkdir(parents=True, exist_ok=True)
    options.out.mkdir(parents=True, exist_ok=True)
    clip = ClipScores(options.clip) if options.clip else None
    pictures = rendered(options.only, budget.size, options.cache)
    rows: list[Row] = []
    lines: list[Line] = []
    for name in options.only:
        item, seen = asset(name), pictures[name]
        begin = start(item, seen, budget, options.cache)
        shown, captions = {}, {}
        for method in options.methods:
            result, cpu_s = composed(item, seen, begin, method, budget, ComposeOptions(seed=options.seed))
            row = judged(item, seen, begin, result, method, cpu_s, clip)
            rows.append(row)
            shown[method] = picture_of(result.pieces, seen.held_out[0])
            captions[method] = f"{row.psnr_reference:.1f} / {row.psnr_held_out:.1f} dB"
            print(
                f"{name} {method}: {row.psnr_reference:.2f} dB, held out {row.psnr_held_out:.2f}, "
                f"{row.left:.2%} of the penetration left, {cpu_s:.0f} CPU s",
                file=sys.stderr,
                flush=True,
            )
            for piece in result.pieces:
                write_splats(options.out / f"{name}-{method}-{piece.name}.ply", piece.splats)
        lines.append(
            Line(
                title=name,
                truth=seen.held_out[0].pixels,
                start=picture_of(begin, seen.held_out[0]),
                methods=shown,
                captions=captions,
            )
        )
        # After every asset: a run of hours that is stopped leaves what it had.
        contact_sheet(lines, options.out / "sheet.png")
        (options.out / "table.md").write_text(markdown(rows), encoding="utf-8")
        found = {"budget": dataclasses.asdict(budget), **document(rows)}
        (options.out / "table.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    print(json.dumps(found, indent=1) if options.json else text(rows))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--quick", action="store_true", help=f"{QUICK.size}², {QUICK.splats} splats, {QUICK.steps} steps"
    )
    parser.add_argument("--json", action="store_true", help="the rows and their means as JSON")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=list(NAMES), metavar="ASSET", help=", ".join(NAMES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="METHOD")
    parser.add_argument("--size", type=int, help="pixels")
    parser.add_argument("--splats", type=int, help="of all objects together")
    parser.add_argument("--steps", type=int, help="of the optimiser")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clip", type=Path, metavar="FOLDER", help="a CLIP model of yours: adds its scores")
    parser.add_argument("--cache", type=Path, default=Path("compose_cache"), metavar="DIR")
    parser.add_argument("--out", type=Path, default=Path("compose_out"), metavar="DIR")
    return parser


if __name__ == "__main__":
    sys.exit(main())
