# SPDX-License-Identifier: GPL-3.0-or-later
"""Turntables of the objects of scene folders as JPEG files below 150 kB.

    python -m physgen.benchmarks.reconstruct_pictures.turntable_sheets SCENE … --out DIR

``DIR/turntable_SCENE.jpg`` has the sheet of each object, from the top to the bottom, as in ``--report``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from physgen.sim.reconstruct import report_pictures, turntable
from physgen.sim.scene.folder import load_scene

from .turntable_scoring import found_body, save_jpeg

WIDTH = 1200


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for root in options.scenes:
        folder = load_scene(root)
        sheets = [turntable.sheet(found_body(folder, item.name)) for item in folder.model.objects]
        path = options.out / f"turntable_{root.resolve().name}.jpg"
        save_jpeg(report_pictures.shrunk(np.concatenate(sheets), WIDTH), path)
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
