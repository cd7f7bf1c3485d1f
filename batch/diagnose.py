# SPDX-License-Identifier: GPL-3.0-or-later
"""What the simulation of a recorded motion lacks, as ``physgen diagnose`` does, started by Python or by Blender:

    python batch/diagnose.py CAPTURE --out DIR
    blender -b --factory-startup --python-exit-code 1 -P batch/diagnose.py -- CAPTURE --out DIR

Arguments, events and exit codes are the verb's (docs/cli.md). In Blender it runs as another Python (docs/headless.md).
"""

import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
    runpy.run_path(str(launch))["main"](["batch.headless", "diagnose", *sys.argv[1:]])
