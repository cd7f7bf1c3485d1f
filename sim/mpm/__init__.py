# SPDX-License-Identifier: MIT
"""MLS-MPM engine; ``world.World`` is the way in.

The description of a world imports no Taichi: ``world_setup``, ``bodies``, ``colliders``, ``surface_contact``,
``solver_options``, ``cost_estimate``, ``diagnostics``, ``geometry``.
"""

import os

# Taichi greets on standard output when it is imported; that stream belongs to the caller's own results.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
