# SPDX-License-Identifier: MIT
"""Physical effects, one file each; ``registry`` is the way in, docs/effects.md the overview. No Taichi."""
