# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers as people have typed them into Blender."""

from __future__ import annotations


def decimal(value: float) -> float:
    """The number that was typed: Blender keeps 32 bits, where 0.4 is 0.4000000059604645."""
    return float(f"{value:.7g}")
