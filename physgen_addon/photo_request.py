# SPDX-License-Identifier: GPL-3.0-or-later
"""What ``physgen reconstruct`` is asked for: the photo, its boxes and what was said of them, as its arguments."""

from __future__ import annotations

import math
from pathlib import Path

import bpy

from ..sim.errors import InputError
from ..sim.scene.names import fitting_names
from .asking import OFFLINE, is_allowed
from .paths import folder_beside, require_folder

LEAST_PX = 8
"""A smaller rectangle is a slip of the hand, not an object."""

OF_OBJECTS = ("kind", "shape", "back", "thickness", "mesh", "mesh-up")
"""Flags of single objects, given as NAME=VALUE."""


def scene_folder(state: bpy.types.PropertyGroup) -> Path:
    """Where the scene of the photo will be: where the artist says, else beside the .blend, else beside the photo.

    A temporary folder would be gone with everything in it when Blender closes. Raises InputError where nothing can be
    written.
    """
    if state.output.strip():
        return require_folder(state.output, "Scene Folder")
    photo = photo_file(state)
    beside = Path(bpy.data.filepath).resolve().parent if bpy.data.filepath else photo.parent
    return folder_beside(beside / photo.stem, "scene")


def photo_file(state: bpy.types.PropertyGroup) -> Path:
    """The photo's file, absolute."""
    return Path(bpy.path.abspath(state.path)).resolve()


def named_boxes(state: bpy.types.PropertyGroup) -> list[tuple[str, bpy.types.PropertyGroup]]:
    """The boxes in the order in which the command gets them, each with the name that its object's files get."""
    # The command takes sizes from the first box on, so boxes with one go first.
    boxes = sorted(state.boxes, key=lambda box: box.size_m <= 0)
    # A name that begins with a dash would be taken for an option.
    return list(zip(fitting_names([box.name.strip(" -") for box in boxes]), boxes, strict=True))


def object_name(state: bpy.types.PropertyGroup, box: bpy.types.PropertyGroup) -> str:
    """The name that the files of the object in ``box`` get."""
    return next(name for name, other in named_boxes(state) if other == box)


def mask_files(state: bpy.types.PropertyGroup, scene: Path) -> dict[str, tuple[Path, bpy.types.Image]]:
    """By object's name: the file that holds its mask, beside the scene folder ``scene``, and the image to write there.

    Not in that folder, which every reconstruction replaces; not temporary, because a later correction reads it again.
    """
    folder = scene.with_name(f"{scene.name}_masks")
    return {name: (folder / f"{name}.png", box.mask) for name, box in named_boxes(state) if box.mask is not None}


def arguments(state: bpy.types.PropertyGroup, *, online: bool | None = None) -> list[str]:
    """The command's arguments; only what was set is among them.

    online: whether Blender may use the network; None asks its preferences. Raises InputError for what is missing or
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
    if state.depth.strip():
        found += ["--depth", str(_file(state.depth, "Depth Map"))]
    if state.report:
        found.append("--report")
    return found + _asking(state, bpy.app.online_access if online is None else online)


def _of_objects(state: bpy.types.PropertyGroup, known: list[tuple[str, bpy.types.PropertyGroup]]) -> list[str]:
    masks = mask_files(state, scene_folder(state)) if any(box.mask for _, box in known) else {}
    given = {"mask": [f"{name}={path}" for name, (path, _) in masks.items()]}
    for flag in OF_OBJECTS:
        given[flag] = [f"{name}={value}" for name, box in known if (value := _said(box, flag))]
    return [word for flag, values in given.items() if values for word in (f"--{flag}", *values)]


def _said(box: bpy.types.PropertyGroup, flag: str) -> str:
    """What ``box`` says for ``flag``; empty where the reconstruction is to judge."""
    if flag == "thickness":
        return f"{box.thickness:.7g}" if box.thickness > 0 else ""
    value = getattr(box, flag.replace("-", "_")).strip()
    if flag == "mesh":
        return str(_file(value, f"box {box.name}: Mesh")) if value else ""
    # Which axis is up is said of a mesh alone.
    return "" if value == "auto" or (flag == "mesh-up" and not box.mesh.strip()) else value


def _of_camera(state: bpy.types.PropertyGroup) -> list[str]:
    # With "=", because a tiny negative number would be taken for an option.
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
    found = Path(bpy.path.abspath(path.strip())).resolve()
    if not found.is_file():
        raise InputError(f"{what}: there is no file {found}; choose where it is now, or clear the field")
    return found
