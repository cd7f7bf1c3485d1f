# SPDX-License-Identifier: MIT
"""``python -m physgen.sim.diagnose.blind.launch FOLDER MODULE ARGS…``: run MODULE with FOLDER as its working folder.

The diagnosis starts where its captures lie and nowhere near the labels.
"""

from __future__ import annotations

import os
import runpy
import sys

if __name__ == "__main__":
    folder, module = sys.argv[1:3]
    os.chdir(folder)
    sys.argv = [module, *sys.argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
