# SPDX-License-Identifier: GPL-3.0-or-later
"""The verb ``check``: whether the files of a bake, scene or frames folder are what was written."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...physgen_addon.frames.frame_index import INDEX_FILE, FrameIndex
from ...sim.cache.bake_check import check_bake
from ...sim.cache.bake_folder import MANIFEST_FILE, load_bake
from ...sim.cache.checksums import UNKNOWN, FileState
from ...sim.errors import InputError
from ...sim.events import IsCancelled
from ...sim.files import is_file
from ...sim.scene.folder import SCENE_FILE, load_scene
from ...sim.scene.scene_sums import check_scene
from ..terminal import Terminal


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
