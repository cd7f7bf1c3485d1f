# SPDX-License-Identifier: MIT
"""MLS-MPM engine; ``world.World`` is the way in.

``sampling``, ``bodies``, ``options``, ``placement`` and ``diagnostics`` import no Taichi.
"""
