# SPDX-License-Identifier: MIT
"""Which kernels a substep consists of, as one launch of several substeps."""

from __future__ import annotations

import functools

from .launch import Launcher, Step
from .materials import FLOWING
from .rigid import move_worlds, search_worlds
from .substep import advance_grid_of, advance_matter_of, part_bodies_of, plan_solids, resolve_contact

REPEATS = 4
"""Substeps in a launch; worlds that need fewer stay idle for the rest."""

SOLID_NAMES = {"worlds": "world_count", "pairs": "solid_pairs", "memory": "solid_memory"}
"""What parameters of the solids' kernels are called besides the others."""


@functools.lru_cache(maxsize=32)
def substep_launcher(generation: int, laws: int, meeting: bool, solids: bool, near: bool) -> Launcher:
    """The launcher for worlds with these ``laws`` in which bodies meet, solids are, obstacles are near.

    generation: of the compute runtime, whose end is the launcher's.
    """
    steps: list[Step] = [(advance_grid_of(laws & FLOWING), {})]
    if meeting:
        steps.append((part_bodies_of(laws), {"pairs": "body_pairs"}))
    if solids:
        steps.append((plan_solids, {}))
    if near:
        steps.append((resolve_contact, {}))
    if solids:
        steps += [(search_worlds, SOLID_NAMES), (move_worlds, SOLID_NAMES)]
    steps.append((advance_matter_of(laws), {}))
    return Launcher(steps, repeats=REPEATS)
