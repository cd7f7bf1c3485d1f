# SPDX-License-Identifier: MIT
"""Physical effects, one file each; ``registry`` is the way in, docs/simulation.md the overview. No Taichi."""
