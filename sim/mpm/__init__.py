# SPDX-License-Identifier: MIT
"""MLS-MPM engine; ``world.World`` is the way in.

What describes a world imports no Taichi: ``setup`` and all that it is made of, ``sampling``, ``placement``,
``distance``, ``estimate``, ``checks``, ``diagnostics``, ``fitting``.
"""

import os

# Taichi greets on standard output when it is imported; that stream belongs to the caller's own results.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
