# SPDX-License-Identifier: MIT
"""Calibration of the diagnosis on fresh generated captures: fits recorded in DIR, then verdicts judged in seconds.

    python -m physgen.benchmarks.calibration DIR --cases 300 --seed 1 [--shard 0/4] [--matter rigid] [--two 0.3]
    python -m physgen.benchmarks.calibration DIR [--tune] [--numbers 0:200]

The first form fits captures that have no record in DIR yet, so it can be stopped and run again; shards run on several
machines or one after the other, and their files are put into one folder. The second prints the reliability table;
``--tune`` with constants chosen by cross-validation over effects left out. A rigid capture takes 5 to 50 CPU seconds,
a soft one minutes. ``--numbers`` judges these cases only, so that others stay unseen. ``--quick`` fits one.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from physgen.benchmarks.common import benchmark_parser
from physgen.blind_check.calibration import cross_validated, judge, reliability
from physgen.blind_check.check import plan_cases
from physgen.blind_check.fit_records import load_records, missing_cases, record_case, save_record
from physgen.sim.diagnose.comparison_settings import ComparisonSettings
from physgen.sim.errors import PhysGenError, SimulationError


def parse_shard(text: str) -> tuple[int, int]:
    """Return (number, of) in ``0/4``."""
    number, _, of = text.partition("/")
    try:
        return int(number), int(of)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no shard: write 0/4") from None


def parse_numbers(text: str) -> range:
    """Return the case numbers of ``0:200``, the second one not included."""
    first, _, end = text.partition(":")
    try:
        return range(int(first), int(end))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} are no case numbers: write 0:200") from None


def collect(folder: Path, options: argparse.Namespace) -> None:
    """Write the records of ``options.cases`` captures that ``folder`` lacks."""
    folder.mkdir(parents=True, exist_ok=True)
    planned = plan_cases(options.cases, np.random.default_rng([options.seed, 0]), two_share=options.two)
    for index in missing_cases(folder, options.cases, options.shard):
        item = planned[index]
        if options.matter not in ("all", item.matter):
            continue
        try:
            record = record_case(item, [options.seed, 1, index])
        except SimulationError as error:
            print(f"case-{index:04d}: {error}", file=sys.stderr, flush=True)
            continue
        save_record(record, folder / f"case-{index:04d}.json")
        names = " + ".join(record["truth"]["effects"]) or record["truth"]["effect"]
        print(f"case-{index:04d}: {names}, {record.get('cpu_s', 0.0):.0f} CPU s", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 1 where a folder cannot be used."""
    parser = benchmark_parser("calibration", __doc__, cases=4, shard=(0, 4), matter="rigid")
    parser.add_argument("folder", type=Path, nargs="?", metavar="DIR", help="records (not needed with --quick)")
    parser.add_argument("--cases", type=int, metavar="N", help="captures to make, 4 to 1000")
    parser.add_argument("--seed", type=int, default=1, help="of all captures (default: %(default)s)")
    parser.add_argument("--shard", type=parse_shard, default=(0, 1), metavar="I/N", help="every Nth capture, from I")
    parser.add_argument("--matter", choices=("all", "rigid", "soft"), default="all", help="which bodies to fit")
    parser.add_argument(
        "--two", type=float, default=0.1, metavar="SHARE", help="of two causes, 0 to 0.5 (default: 0.1)"
    )
    parser.add_argument("--tune", action="store_true", help="choose constants by cross-validation over effects")
    parser.add_argument("--numbers", type=parse_numbers, metavar="A:B", help="judge cases A to B - 1 only")
    options = parser.parse_args(arguments)
    if options.folder is None and not options.quick:
        parser.error("give DIR")
    try:
        with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
            folder = options.folder or Path(scratch)
            if options.cases is not None:
                collect(folder, options)
            records = load_records(folder, numbers=options.numbers)
    except PhysGenError as error:
        print(error, file=sys.stderr)
        return 1
    settings = ComparisonSettings()
    cases = [judge(r, settings) for r in records]
    if options.tune:
        cases, settings = cross_validated(records, settings, lambda line: print(line, file=sys.stderr))
        print(f"constants from all: {settings}", file=sys.stderr)
    found = reliability(cases)
    if options.json:
        # JSON has no NaN: what no case could show is null.
        plain = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in dataclasses.asdict(found).items()}
        print(json.dumps(plain, allow_nan=False))
    else:
        print(found.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
