# SPDX-License-Identifier: MIT
"""MLS-MPM engine; ``world.World`` is the way in.

``sampling``, ``bodies``, ``options``, ``placement`` and ``diagnostics`` import no Taichi.
"""

import os

# Taichi greets on standard output when it is imported; that stream belongs to the caller's own results.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
