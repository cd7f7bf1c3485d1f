# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulate a scene: scene folder → bake folder, as ``physgen bake`` does, started by Python or by Blender:

    python batch/bake.py SCENE --out BAKE --frames 48
    blender -b --factory-startup --python-exit-code 1 -P batch/bake.py -- SCENE --out BAKE --frames 48

Arguments, events and exit codes are the verb's (docs/cli.md). In Blender it continues in
another Python (docs/farm.md).
"""

import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
    runpy.run_path(str(launch))["main"](["batch.headless", "bake", *sys.argv[1:]])
