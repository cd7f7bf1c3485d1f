# SPDX-License-Identifier: MIT
"""Verdicts and cost of the diagnosis, one line per capture.

    python -m physgen.benchmarks.diagnosis FOLDER [NAME …] [--out DIR] [--confirm] [--json]

FOLDER contains capture folders; NAME selects some of them. A line has verdict, probability, alternatives, closed
fraction of the gap, CPU and wall seconds; with --json it is an object. --out keeps the diagnoses, in DIR/NAME.
``--quick`` diagnoses one simulated throw with a short budget.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from physgen.benchmarks.common import benchmark_parser
from physgen.sim.diagnose.capture_folder import CAPTURE_FILE, load_capture
from physgen.sim.diagnose.diagnosis import write_diagnosis
from physgen.sim.diagnose.run_diagnosis import DiagnoseOptions, diagnose
from physgen.sim.errors import PhysGenError

DRAG = 0.6
"""Deceleration per speed, 1/s, of the quick capture's sphere."""


def quick_capture(folder: Path) -> None:
    """Write a capture of a sphere that is thrown twice, slowed by linear drag, into the new ``folder``."""
    folder.mkdir(parents=True)
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    mesh.export(folder / "sphere.obj")
    rest, times = np.asarray(mesh.vertices)[:6], np.arange(20) / 30.0
    rng = np.random.default_rng(0)
    trials = []
    for name, speed in (("throw1", (2.0, 0.0, 3.0)), ("throw2", (-1.0, 2.0, 3.5))):
        decay = (1.0 - np.exp(-DRAG * times)) / DRAG
        fall = np.outer((decay - times) / DRAG, (0.0, 0.0, 9.81))
        centre = np.array([0.0, 0.0, 1.0]) + np.outer(decay, speed) + fall
        points = centre[:, None] + rest[None] + rng.normal(0.0, 1e-3, (len(times), len(rest), 3))
        index = np.zeros(len(rest), np.int64)
        np.savez(folder / f"{name}.npz", times=times, points=points, object_index=index, rest_points=rest)
        trials.append({"name": name, "file": f"{name}.npz", "role": "fit"})
    sphere = {"name": "sphere", "mesh": "sphere.obj", "density_kg_m3": 50.0, "stiffness": "hard"}
    capture = {
        "format": "physgen-capture/1",
        "gravity": [0.0, 0.0, -9.81],
        "ground": {"point": [0.0, 0.0, -5.0], "normal": [0.0, 0.0, 1.0], "friction": 0.5, "restitution": None},
        "objects": [{**sphere, "youngs_modulus_pa": None, "poisson_ratio": 0.3}],
        "noise_sigma": 1e-3,
        "trials": trials,
    }
    (folder / CAPTURE_FILE).write_text(json.dumps(capture))


def measure(folder: Path, options: DiagnoseOptions, out: Path | None) -> dict[str, Any]:
    """Diagnose the capture in ``folder``; return its row. The diagnosis is written to ``out`` if given."""
    cpu, wall = time.process_time(), time.monotonic()
    row: dict[str, Any] = {"name": folder.name}
    try:
        found = diagnose(load_capture(folder), options)
    except PhysGenError as error:
        row["error"] = str(error)
    else:
        row |= {
            "effect": found.verdict.effect,
            "probability": round(found.verdict.probability, 3),
            "alternatives": list(found.verdict.alternatives),
            "closed_fraction": round(found.gap.closed_fraction, 3),
        }
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            write_diagnosis(found, out)
    return row | {"cpu_s": round(time.process_time() - cpu, 1), "wall_s": round(time.monotonic() - wall, 1)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 1 if a capture was refused."""
    parser = benchmark_parser("diagnosis", __doc__, budget=10.0)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of captures (not needed with --quick)")
    parser.add_argument("names", nargs="*", help="captures to diagnose (default: all)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="keep the diagnoses")
    parser.add_argument("--budget", type=float, default=300.0, help="seconds for the fits (default: %(default)s)")
    parser.add_argument("--confirm", action="store_true", help="also do the verification run in the particle engine")
    options = parser.parse_args(arguments)
    if options.folder is None and not options.quick:
        parser.error("give FOLDER")
    failed = False
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
        root, effects = options.folder, None
        if root is None:
            root, effects = Path(scratch), ("air_drag",)
            quick_capture(root / "throw")
        settings = DiagnoseOptions(budget_s=options.budget, effects=effects, confirm=options.confirm)
        for name in options.names or sorted(p.parent.name for p in root.glob(f"*/{CAPTURE_FILE}")):
            row = measure(root / name, settings, None if options.out is None else options.out / name)
            failed = failed or "error" in row
            print(json.dumps(row) if options.json else "  ".join(f"{v}" for v in row.values()), flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
