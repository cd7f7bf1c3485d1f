# SPDX-License-Identifier: GPL-3.0-or-later
"""A motion-capture table becomes a verdict: which effect does the simulation lack?

    python examples/csv_to_verdict.py toss.csv --radius 0.1 --density 20 --out work

The table has a row per sample: trial, time, and x, y, z of the centre of a ball (docs/own-recordings.md). The last
trial is held out: the diagnosis sees only its first third and is scored on the rest.
"""

import argparse
from pathlib import Path

import physgen


def main(table: Path, out: Path, *, radius: float, density: float, noise: float | None = None) -> physgen.Diagnosis:
    """Return the diagnosis; ``out`` gets the capture and a report page. noise: of one coordinate, m; None: measured."""
    ball = physgen.ImportRequest(name="ball", diameter=2 * radius, density=density, noise=noise, hold_out=1 / 3)
    capture = physgen.import_capture([table], ball, out=out / "capture")
    options = physgen.DiagnoseOptions(confirm=False)
    diagnosis = physgen.diagnose(capture, out=out / "diagnosis", options=options)
    print(diagnosis.summary)
    return diagnosis


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("--radius", type=float, required=True, help="m")
    parser.add_argument("--density", type=float, required=True, help="kg/m³")
    parser.add_argument("--out", type=Path, default=Path("work"))
    given = parser.parse_args()
    main(given.table, given.out, radius=given.radius, density=given.density)
