# SPDX-License-Identifier: MIT
"""What a diagnosis costs and concludes: python benchmarks/diagnosis.py FOLDER [NAME …] [--out DIR] [--confirm] [--json]

FOLDER holds capture folders; NAME picks some of them. One line a capture: verdict, probability, alternatives, closed
fraction, CPU and wall seconds. With --out the diagnoses are kept, DIR/NAME each. Run on an idle machine for the
seconds to mean something.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from physgen.sim.diagnose.capture import CAPTURE_FILE, load_capture
from physgen.sim.diagnose.conclude import DiagnoseOptions, diagnose
from physgen.sim.diagnose.diagnosis import write_diagnosis
from physgen.sim.errors import PhysGenError


def main() -> None:
    """Diagnose every capture named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--budget", type=float, default=300.0, help="seconds for the fits")
    parser.add_argument("--confirm", action="store_true", help="let the particle engine run the verdict again")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    names = options.names or sorted(p.parent.name for p in options.folder.glob(f"*/{CAPTURE_FILE}"))
    for name in names:
        cpu, wall = time.process_time(), time.monotonic()
        row: dict[str, object] = {"name": name}
        try:
            capture = load_capture(options.folder / name)
            found = diagnose(capture, DiagnoseOptions(budget_s=options.budget, confirm=options.confirm))
        except PhysGenError as error:
            row["error"] = str(error)
        else:
            row |= {
                "effect": found.verdict.effect,
                "probability": round(found.verdict.probability, 3),
                "alternatives": list(found.verdict.alternatives),
                "closed_fraction": round(found.gap.closed_fraction, 3),
            }
            if options.out is not None:
                (options.out / name).mkdir(parents=True, exist_ok=True)
                write_diagnosis(found, options.out / name)
        row |= {"cpu_s": round(time.process_time() - cpu, 1), "wall_s": round(time.monotonic() - wall, 1)}
        print(json.dumps(row) if options.json else "  ".join(f"{v}" for v in row.values()), flush=True)


if __name__ == "__main__":
    main()
