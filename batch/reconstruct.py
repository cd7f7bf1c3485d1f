# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo → scene folder, as ``physgen reconstruct`` does, started by Python or by Blender:

    python batch/reconstruct.py PHOTO --box 21,96,47,119 --out SCENE
    blender -b --factory-startup --python-exit-code 1 -P batch/reconstruct.py -- PHOTO --box 21,96,47,119 --out SCENE

Arguments, events and exit codes are the verb's (docs/cli.md). In Blender it continues in
another Python (docs/farm.md).
"""

import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
    runpy.run_path(str(launch))["main"](["batch.headless", "reconstruct", *sys.argv[1:]])
