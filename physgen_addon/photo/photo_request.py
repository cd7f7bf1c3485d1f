# SPDX-License-Identifier: GPL-3.0-or-later
"""The request to ``physgen reconstruct`` (photo, boxes, masks, camera), and the scene folder that results."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import bpy

from ...sim.errors import InputError
from ...sim.scene.folder import SCENE_FILE
from ...sim.scene.model import Camera
from ...sim.scene.scene_output import STAMP_FILE
from ...sim.validation import read_json, valid_names
from .. import blend_trust
from ..paths import folder_beside, require_folder
from . import photo_maths
from .photo_consent import OFFLINE, is_allowed

LEAST_PX = 8
"""A smaller rectangle is an accidental click, not an object."""

OF_OBJECTS = ("kind", "shape", "back", "thickness", "mesh", "mesh-up")
"""Flags of single objects, passed as NAME=VALUE."""


def scene_folder(state: bpy.types.PropertyGroup) -> Path:
    """Return the scene folder of the photo: as set by the user, else beside the .blend, else beside the photo.

    Not a temporary folder, which would be deleted when Blender exits. Raises InputError if the place is not writable.
    """
    if state.output.strip():
        return require_folder(state.output, "Scene Folder")
    photo = photo_file(state)
    beside = Path(bpy.data.filepath).resolve().parent if bpy.data.filepath else photo.parent
    return folder_beside(beside / photo.stem, "scene")


def photo_file(state: bpy.types.PropertyGroup) -> Path:
    """Return the photo's absolute path."""
    return Path(bpy.path.abspath(state.path)).resolve()


def named_boxes(state: bpy.types.PropertyGroup) -> list[tuple[str, bpy.types.PropertyGroup]]:
    """Return the boxes in the command's order, each with the name of its object's files."""
    # The command assigns sizes from the first box on, so boxes with one go first.
    boxes = sorted(state.boxes, key=lambda box: box.size_m <= 0)
    # A name that begins with a dash would be parsed as an option.
    return list(zip(valid_names([box.name.strip(" -") for box in boxes]), boxes, strict=True))


def object_name(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup) -> str:
    """Return the file name of the object in ``box``."""
    return next(name for name, other in named_boxes(state) if other == box)


def mask_files(state: bpy.types.PropertyGroup, scene: Path) -> dict[str, tuple[Path, bpy.types.Image]]:
    """Return by object name: the file of its mask, beside the scene folder ``scene``, and the image to write there.

    Not in that folder, which every reconstruction replaces; not temporary, because a later correction reads it again.
    """
    folder = scene.with_name(f"{scene.name}_masks")
    return {name: (folder / f"{name}.png", box.mask) for name, box in named_boxes(state) if box.mask is not None}


def arguments(state: bpy.types.PropertyGroup, *, online: bool | None = None) -> list[str]:
    """Return the command's arguments, for settings that were made.

    online: whether Blender may use the network; None reads its preferences. Raises InputError for what is missing or
    not allowed.
    """
    path = photo_file(state)
    if state.image is None or not state.path or not path.is_file():
        raise InputError("there is no photo; open one first")
    if not state.boxes:
        raise InputError("there is no box; draw one around each object that is to move")
    known = named_boxes(state)
    for _, box in known:
        if box.x1 - box.x0 < LEAST_PX or box.y1 - box.y0 < LEAST_PX:
            raise InputError(f"box {box.name}: is {box.x1 - box.x0} x {box.y1 - box.y0} pixels; draw it larger")
    sizes = [f"{box.size_m:.7g}" for _, box in known if box.size_m > 0]
    found = [str(path), "--box", *(f"{box.x0},{box.y0},{box.x1},{box.y1}" for _, box in known)]
    found += ["--name", *(name for name, _ in known)]
    if sizes:
        found += ["--size", *sizes]
    found += _of_objects(state, known)
    found += _of_camera(state)
    if state.segmenter != "auto":
        found += ["--segmenter", state.segmenter]
    for flag, name in (("--depth-estimator", state.depth_estimator), ("--inpainter", state.inpainter)):
        if name != "none":
            found += [flag, name]
    if state.depth.strip():
        found += ["--depth", str(_file(state.depth, "Depth Map"))]
    if state.report:
        found.append("--report")
    if state.default_motion:
        found.append("--default-motion")
    return found + _asking(state, bpy.app.online_access if online is None else online)


def _of_objects(state: bpy.types.PropertyGroup, known: list[tuple[str, bpy.types.PropertyGroup]]) -> list[str]:
    masks = mask_files(state, scene_folder(state)) if any(box.mask for _, box in known) else {}
    given = {"mask": [f"{name}={path}" for name, (path, _) in masks.items()]}
    for flag in OF_OBJECTS:
        given[flag] = [f"{name}={value}" for name, box in known if (value := _flag_value(box, flag))]
    for flag in ("keep", "drop"):
        # A mask replaces the segmentation that strokes would refine.
        strokes = [(name, text) for name, box in known if box.mask is None for text in getattr(box, flag).split()]
        given[flag] = [f"{name}={text}" for name, text in strokes]
    return [word for flag, values in given.items() if values for word in (f"--{flag}", *values)]


def _flag_value(box: bpy.types.PropertyGroup, flag: str) -> str:
    """Return the setting of ``box`` for ``flag``; empty if automatic."""
    if flag == "thickness":
        return f"{box.thickness:.7g}" if box.thickness > 0 else ""
    value = getattr(box, flag.replace("-", "_")).strip()
    if flag == "mesh":
        return str(_file(value, f"box {box.name}: Mesh")) if value else ""
    # The up axis applies to a user mesh only.
    return "" if value == "auto" or (flag == "mesh-up" and not box.mesh.strip()) else value


def _of_camera(state: bpy.types.PropertyGroup) -> list[str]:
    # With "=", because a tiny negative number would be parsed as an option.
    found = []
    if state.camera == "PITCH":
        found.append(f"--pitch={math.degrees(state.pitch):.7g}")
    if state.camera == "HORIZON":
        found += [f"--horizon={state.horizon:.7g}", f"--roll={math.degrees(state.roll):.7g}"]
    if state.use_fov:
        found.append(f"--fov={math.degrees(state.fov):.7g}")
    return found


def _asking(state: bpy.types.PropertyGroup, online: bool) -> list[str]:
    url, model = state.ask_url.strip(), state.ask_model.strip()
    if not url or not state.send_photo:
        return []
    if not is_allowed(url, online=online):
        raise InputError(f"Ask a Model: {OFFLINE}; allow it there, or take the consent back")
    if not model:
        raise InputError("Ask a Model: no model is named; give its name as the endpoint calls it")
    return [f"--ask={url}", f"--model={model}", "--send-photo"]


def _file(path: str, what: str) -> Path:
    blend_trust.require(path)
    found = Path(bpy.path.abspath(path.strip())).resolve()
    if not found.is_file():
        raise InputError(f"{what}: there is no file {found}; choose where it is now, or clear the field")
    return found


REPORT_FILE = "report.html"


def made_folder(state: bpy.types.PropertyGroup) -> Path | None:
    """Return the scene folder if it holds a scene of this very photo."""
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
    """Return the photo that ``stamp`` refers to. Cached for panels; ``changed`` is the file's modification time."""
    found = read_json(stamp)
    return str(found.get("photo", "")) if isinstance(found, dict) else ""


def found_mask(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup) -> Path | None:
    """Return the file of the last estimated mask of the object in ``box``, if there is one."""
    folder = made_folder(state)
    path = None if folder is None else folder / "masks" / f"{object_name(state, box)}.png"
    return path if path is not None and path.is_file() else None


def report_page(state: bpy.types.PropertyGroup) -> Path | None:
    """Return the report page of the last reconstruction, if there is one."""
    folder = made_folder(state)
    page = None if folder is None else folder / REPORT_FILE
    return page if page is not None and page.is_file() else None


def take_camera(state: bpy.types.PropertyGroup, camera: Camera) -> None:
    """Store the horizon of ``camera``, to be shown and as start of a correction."""
    state.has_found = True
    state.found_horizon, state.found_roll = photo_maths.of_camera(camera)
    state.found_pitch, state.found_fov = photo_maths.pitch_of_camera(camera), photo_maths.fov_of_camera(camera)
