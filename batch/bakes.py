# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``bake``, ``estimate``, ``free`` and ``preview`` (docs/simulation.md, docs/blender-preview.md)."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..sim.app import preview
from ..sim.app.bake_estimate import bake_cost
from ..sim.app.reconstruct import set_physics, with_physics
from ..sim.app.setup_world import cost_text
from ..sim.cache.folder import free_bake
from ..sim.events import IsCancelled
from ..sim.scene.folder import SceneFolder, load_scene
from . import pipeline
from .arguments import add_bake_options, add_physics, add_sample_options, bake_options, physics
from .terminal import Terminal


def add_bake(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen bake``."""
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("--out", type=Path, metavar="BAKE", help="the bake folder")
    parser.add_argument("--estimate", action="store_true", help="the same as physgen estimate")
    parser.set_defaults(wrong_usage=parser.error)
    add_physics(parser)
    add_bake_options(parser)
    add_sample_options(parser)


def add_estimate(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen estimate``."""
    parser.add_argument("scene", type=Path, metavar="SCENE")
    add_physics(parser)
    add_bake_options(parser)
    add_sample_options(parser)


def add_free(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen free``."""
    parser.add_argument("bake", type=Path, metavar="BAKE")


def add_preview(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen preview``."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the runs")


def run_bake(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen bake``; the exit code."""
    if options.estimate:
        return run_estimate(options, terminal, cancelled)
    if options.out is None:
        options.wrong_usage("the following arguments are required: --out (or --estimate)")
    folder = set_physics(options.scene, **physics(options))
    done = pipeline.bake_stage(folder, options.out, bake_options(options), terminal, cancelled)
    terminal(done)
    terminal.line(f"bake: {options.out}")
    return 0


def run_estimate(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen estimate``; the exit code."""
    folder = load_scene(options.scene)
    scene = with_physics(folder.scene, **physics(options))
    cost = bake_cost(SceneFolder(root=folder.root, scene=scene), bake_options(options))
    for warning in cost.prepared.warnings:
        terminal({"event": "notice", "stage": "estimate", "message": warning})
    terminal({"event": "done", "stage": "estimate", **cost.to_json()})
    terminal.line(f"{cost_text(cost.prepared)}; {cost.disk_bytes / 2**20:.0f} MiB on the disk")
    cost.prepared.require_affordable()
    return 0


def run_free(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen free``; the exit code."""
    freed = free_bake(options.bake)
    terminal({"event": "done", "stage": "free", "bytes": freed})
    terminal.line(f"{freed / 2**20:.1f} MiB are free again: {options.bake}")
    return 0


def run_preview(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen preview``; the exit code."""
    return preview.serve(options.out, cancelled)
