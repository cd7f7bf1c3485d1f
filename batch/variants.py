# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``variant``: the same scene with other physics, in a folder of its own."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..sim.app.variant import make_variant
from ..sim.events import IsCancelled
from .arguments import add_physics, physics
from .terminal import Terminal


def add_variant(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen variant``."""
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE2", help="the new scene folder")
    add_physics(parser)
    effects = "all effects of the new scene, as the list in scene.json (default: those of the scene)"
    parser.add_argument("--effects-json", metavar="JSON", help=effects)


def run_variant(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen variant``; the exit code."""
    make_variant(options.scene, options.out, effects=options.effects_json, **physics(options))
    terminal({"event": "done", "scene": str(options.out)})
    terminal.line(f"scene: {options.out}")
    return 0
