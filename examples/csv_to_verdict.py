# SPDX-License-Identifier: GPL-3.0-or-later
"""A motion-capture table becomes a verdict: which effect does the simulation lack?

    python examples/csv_to_verdict.py toss.csv --radius 0.1 --density 20 --out work

The table has a row per sample: trial, time in s, and x, y, z in m (Z up) of the centre of a ball. The last trial is
held out: the diagnosis sees only its first third and is scored on the rest.
"""

import argparse
import csv
import json
from pathlib import Path

import numpy as np
import physgen
import trimesh


def main(table: Path, out: Path, *, radius: float, density: float, noise: float = 0.001) -> physgen.Diagnosis:
    """Return the diagnosis; ``out`` gets the capture and a report page. noise: of one coordinate, m."""
    rows: dict[str, list[list[float]]] = {}
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            rows.setdefault(row["trial"], []).append([float(row[k]) for k in ("time", "x", "y", "z")])
    capture = out / "capture"
    capture.mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=2, radius=radius).export(capture / "ball.obj")
    trials = []
    for index, (name, samples) in enumerate(rows.items()):
        data = np.array(samples)
        held_out = index == len(rows) - 1
        shown = data[: len(data) // 3] if held_out else data
        arrays = {
            "times": shown[:, 0],
            "points": shown[:, None, 1:],
            "object_index": np.zeros(1, np.int64),
            "rest_points": np.zeros((1, 3)),
        }
        if held_out:
            arrays["predict_times"] = data[len(data) // 3 :, 0]
        np.savez(capture / f"{name}.npz", **arrays)
        trials.append({"name": name, "file": f"{name}.npz", "role": "predict" if held_out else "fit"})
    ball = {"name": "ball", "mesh": "ball.obj", "density_kg_m3": density, "stiffness": "hard"}
    content = {
        "format": "physgen-capture/1",
        "gravity": [0.0, 0.0, -9.81],
        "ground": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.5, "restitution": None},
        "objects": [{**ball, "youngs_modulus_pa": None, "poisson_ratio": 0.3}],
        "noise_sigma": noise,
        "trials": trials,
    }
    (capture / "capture.json").write_text(json.dumps(content, indent=1))
    options = physgen.DiagnoseOptions(confirm=False)
    diagnosis = physgen.diagnose(physgen.load_capture(capture), out=out / "diagnosis", options=options)
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
