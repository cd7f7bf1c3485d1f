# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene and bake folders: `variant`, `bake`, `estimate`, `preview`, `pack`, `export`, `free` and `check`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...physgen_addon.frames.frame_index import INDEX_FILE, FrameIndex
from ...sim.app.reconstruct import set_physics, with_physics
from ...sim.cache.bake_check import check_bake
from ...sim.cache.bake_folder import MANIFEST_FILE, disk_usage, free_bake, load_bake
from ...sim.checksums import UNKNOWN, FileState
from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ...sim.files import is_file
from ...sim.scene.folder import SCENE_FILE, Scene, load_scene
from ...sim.scene.scene_output import check_scene
from .. import stages
from ..terminal import Terminal
from .flags import add_anyway_flag
from .simulation_flags import add_bake_flags, add_physics_flags, add_sample_flags, bake_options, physics_options


def add_bake(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen bake``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--out", type=Path, metavar="BAKE", help="bake folder to write; an unfinished one is resumed")
    parser.add_argument("--estimate", action="store_true", help="only estimate the cost, as physgen estimate does")
    add_anyway_flag(parser)
    parser.set_defaults(wrong_usage=parser.error)
    add_physics_flags(parser)
    add_bake_flags(parser)
    add_sample_flags(parser)


def add_estimate(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen estimate``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    add_physics_flags(parser)
    add_bake_flags(parser)
    add_sample_flags(parser)


def add_free(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen free``."""
    parser.add_argument("bake", type=Path, metavar="BAKE", help="bake folder to delete")


def add_pack(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen pack``."""
    parser.add_argument("bake", type=Path, metavar="BAKE", help="complete bake folder, or packed one with --unpack")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the new folder")
    parser.add_argument("--unpack", action="store_true", help="turn a packed bake into one that plays and renders")


def run_pack(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen pack``; the exit code."""
    from ...sim.app.pack_bake import pack_bake, unpack_bake

    if options.unpack:
        size = disk_usage(unpack_bake(options.bake, out=options.out, cancelled=cancelled).root)
    else:
        size = pack_bake(load_bake(options.bake), out=options.out, cancelled=cancelled)
    terminal({"event": "done", "stage": "pack", "bytes": size, "out": str(options.out)})
    terminal.line(f"{size / 2**20:.1f} MiB: {options.out}")
    return 0


def add_export(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen export``."""
    parser.set_defaults(wrong_usage=parser.error)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, metavar="BAKE", help="bake folder, whose motion is written too")
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument(
        "--usd", type=Path, metavar="FILE", help="new file, .usda (text) or .usdc, with UsdPhysics bodies"
    )
    target.add_argument("--alembic", type=Path, metavar="FILE", help="new file, .abc, of the bake's motion; needs bpy")


def run_export(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen export``; the exit code."""
    from ...sim.app.export_usd import export_usd, require_scene

    if options.alembic is not None and options.bake is None:
        options.wrong_usage("--alembic needs --bake")
    require_scene(options.scene)
    bake = None if options.bake is None else load_bake(options.bake)
    if options.alembic is not None and bake is not None:
        terminal(stages.run_export(load_scene(options.scene), bake, options.alembic, terminal, cancelled))
        terminal.line(f"Alembic: {options.alembic}")
        return 0
    for note in export_usd(load_scene(options.scene), options.usd, bake=bake, cancelled=cancelled):
        terminal({"event": "notice", "stage": "export", "message": note})
    terminal({"event": "done", "stage": "export", "out": str(options.usd)})
    terminal.line(f"USD: {options.usd}")
    return 0


def add_preview(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen preview``."""
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the runs; each gets a subfolder"
    )


def run_bake(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen bake``; the exit code."""
    if options.estimate:
        return run_estimate(options, terminal, cancelled)
    if options.out is None:
        options.wrong_usage("the following arguments are required: --out (or --estimate)")
    folder = set_physics(load_scene(options.scene), physics_options(options))
    done = stages.run_bake(folder, options.out, bake_options(options), terminal, cancelled)
    terminal(done)
    terminal.line(f"bake: {options.out}")
    return 0


def run_estimate(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen estimate``; the exit code."""
    # What prepares worlds, and below what bakes, takes a second to import, which the other commands need not pay.
    from ...sim.app.bake_estimate import bake_cost
    from ...sim.app.scene_to_world import cost_text, steps_text

    folder = load_scene(options.scene)
    scene = with_physics(folder.model, physics_options(options))
    cost = bake_cost(Scene(root=folder.root, model=scene), bake_options(options))
    for warning in cost.prepared.warnings:
        terminal({"event": "notice", "stage": "estimate", "message": warning})
    terminal({"event": "done", "stage": "estimate", **cost.to_json()})
    terminal.line(f"{cost_text(cost.prepared)}; {cost.disk_bytes / 2**20:.0f} MiB on disk")
    if steps := steps_text(cost.prepared):
        terminal.line(steps)
    cost.prepared.require_affordable()
    return 0


def run_free(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen free``; the exit code."""
    freed = free_bake(options.bake)
    terminal({"event": "done", "stage": "free", "bytes": freed})
    terminal.line(f"{freed / 2**20:.1f} MiB freed: {options.bake}")
    return 0


def run_preview(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen preview``; the exit code."""
    from ...sim.app import preview_server

    return preview_server.serve(options.out, cancelled)


def add_variant(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen variant``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE2", help="the new scene folder")
    add_physics_flags(parser)
    effects = "all effects of the new scene, as JSON in the form of scene.json (default: those of the scene)"
    parser.add_argument("--effects-json", metavar="JSON", help=effects)


def run_variant(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen variant``; the exit code."""
    from ...sim.app.scene_variant import make_variant

    make_variant(
        load_scene(options.scene), out=options.out, physics=physics_options(options), effects=options.effects_json
    )
    terminal({"event": "done", "scene": str(options.out)})
    terminal.line(f"scene: {options.out}")
    return 0


def add_check(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen check``."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="a bake, scene or frames folder")


def run_check(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen check``; the exit code: 3 where anything is damaged or missing."""
    kind, states = check_folder(options.folder)
    bad = [state for state in states if not state.good]
    files = [{"file": state.file, "state": state.state, "text": state.text} for state in states]
    terminal({"event": "done", "stage": "check", "kind": kind, "files": files, "damaged": len(bad)})
    without = sum(state.state == UNKNOWN for state in states)
    told = f"; {without} without a checksum" if without else ""
    words = f"{kind}: {len(states)} files, {len(bad)} damaged or missing{told}: {options.folder}"
    terminal.line("\n".join([*(state.line() for state in states), words]))
    return InputError.exit_code if bad else 0


def check_folder(folder: Path) -> tuple[str, list[FileState]]:
    """Return what ``folder`` is, and the state of each of its files. Raises InputError where it is nothing known."""
    if is_file(folder / MANIFEST_FILE):
        return "bake", check_bake(load_bake(folder))
    if is_file(folder / SCENE_FILE):
        return "scene", check_scene(load_scene(folder))
    if is_file(folder / INDEX_FILE):
        return "frames", FrameIndex.of(folder).check()
    raise InputError(f"{folder}: is no bake, scene or frames folder ({MANIFEST_FILE}, {SCENE_FILE}, {INDEX_FILE})")
