# SPDX-License-Identifier: GPL-3.0-or-later
"""What was made of the photo: whether it is there, its masks, its camera, its report."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy

from ..sim.errors import InputError
from ..sim.scene.folder import SCENE_FILE
from ..sim.scene.json_fields import read_json
from ..sim.scene.model import Camera
from . import horizon_maths
from .photo_request import object_name, photo_file, scene_folder

STAMP_FILE, REPORT_FILE = "reconstruct.json", "report.html"


def made_folder(state: bpy.types.PropertyGroup) -> Path | None:
    """The scene folder, if it holds a scene of this very photo."""
    try:
        folder = scene_folder(state)
        stamp = folder / STAMP_FILE
        if not (folder / SCENE_FILE).is_file() or not stamp.is_file():
            return None
        return folder if _photo_of(stamp, stamp.stat().st_mtime_ns) == str(photo_file(state)) else None
    except (InputError, OSError):
        return None


@functools.lru_cache(maxsize=8)
def _photo_of(stamp: Path, changed: int) -> str:
    """Which photo ``stamp`` is about. Panels ask this at every drawing; ``changed`` is when the file was."""
    found = read_json(stamp)
    return str(found.get("photo", "")) if isinstance(found, dict) else ""


def found_mask(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup) -> Path | None:
    """The file of what the last reconstruction took for the object in ``box``, if there is one."""
    folder = made_folder(state)
    path = None if folder is None else folder / "masks" / f"{object_name(state, box)}.png"
    return path if path is not None and path.is_file() else None


def report_page(state: bpy.types.PropertyGroup) -> Path | None:
    """The page of the last reconstruction, if it wrote one."""
    folder = made_folder(state)
    page = None if folder is None else folder / REPORT_FILE
    return page if page is not None and page.is_file() else None


def take_camera(state: bpy.types.PropertyGroup, camera: Camera) -> None:
    """Remember where ``camera`` sees the horizon, to be shown and to begin a correction with."""
    state.has_found = True
    state.found_horizon, state.found_roll = horizon_maths.of_camera(camera)
    state.found_pitch, state.found_fov = horizon_maths.pitch_of_camera(camera), horizon_maths.fov_of_camera(camera)
