# SPDX-License-Identifier: MIT
"""MLS-MPM engine; ``world.World`` is the way in.

The description of a world imports no Taichi: ``world_setup``, ``bodies``, ``colliders``, ``surface_contact``,
``solver_options``, ``cost_estimate``, ``diagnostics``, ``geometry``.
"""

import inspect
import os

# Taichi greets on standard output when it is imported; that stream belongs to the caller's own results.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

# Each decorator of Taichi asks ``inspect`` for the line that called it. At the top of a module it is one of importlib,
# which has no file, and each time all loaded modules are searched for it: a tenth of what a start of the engine takes.
inspect.modulesbyfile.setdefault("<frozen importlib._bootstrap>", "importlib._bootstrap")
