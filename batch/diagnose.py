# SPDX-License-Identifier: GPL-3.0-or-later
"""Diagnose a recorded motion: capture → missing effects, as ``physgen diagnose`` does, in Python or in Blender:

    python batch/diagnose.py CAPTURE --out DIR
    blender -b --factory-startup --python-exit-code 1 -P batch/diagnose.py -- CAPTURE --out DIR

Arguments, events and exit codes are the verb's (docs/cli.md). In Blender it continues in
another Python (docs/farm.md).
"""

import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
    runpy.run_path(str(launch))["main"](["batch.headless", "diagnose", *sys.argv[1:]])
