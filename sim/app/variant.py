# SPDX-License-Identifier: MIT
"""Scene folder → another scene folder with the same things in it and other physics."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from ..atomic import replacing
from ..cache.lock import folder_lock
from ..effects.registry import effect
from ..errors import InputError
from ..scene.folder import (
    SCENE_FILE,
    SceneFolder,
    inside,
    load_scene,
    parse_scene,
    referenced_files,
    save_scene,
    scene_to_json,
)
from ..scene.model import Scene, Vector
from .bake_inputs import file_hash
from .reconstruct import with_physics


def make_variant(
    root: Path,
    out: Path,
    *,
    presets: Sequence[str] = (),
    velocities: Sequence[Vector] = (),
    spins: Sequence[Vector] = (),
    overrides: Sequence[str] = (),
    effects: str | None = None,
) -> SceneFolder:
    """Make ``out`` the scene of the folder ``root`` with other physics, as ``with_physics`` says.

    effects: all that the variant has, as JSON of the list in ``scene.json``; None keeps those of the scene.
    Files are shared with ``root`` by hard links where the file system has them, else copied; those that are the same
    already are left alone. Every file is written whole, ``scene.json`` last.

    Raises InputError for a scene, physics or effects that cannot be used, and for a folder with other things in it.
    """
    source = load_scene(root)
    scene = with_physics(source.scene, presets=presets, velocities=velocities, spins=spins, overrides=overrides)
    if effects is not None:
        scene = _with_effects(scene, effects)
    if out.resolve() == root.resolve():
        raise InputError(f"{out}: is the scene itself; choose another folder for the variant")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder for the variant")
    if out.is_dir() and not (out / SCENE_FILE).is_file() and any(not p.name.startswith(".") for p in out.iterdir()):
        leftovers = {Path(name).parts[0] for name in referenced_files(scene)}
        if any(p.name not in leftovers for p in out.iterdir() if not p.name.startswith(".")):
            raise InputError(f"{out}: holds other files and no scene; choose an empty or new folder")
    with folder_lock(out):
        for name in referenced_files(scene):
            _share(source.file(name), inside(out, name))
        try:
            if load_scene(out).scene == scene:
                return SceneFolder(root=out, scene=scene)
        except InputError:
            pass
        return save_scene(out, scene)


def _with_effects(scene: Scene, text: str) -> Scene:
    try:
        listed = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"effects: not readable as JSON ({error}); give a list as in scene.json") from None
    if not isinstance(listed, list):
        raise InputError("effects: expected a list of effects as in scene.json")
    changed = parse_scene({**scene_to_json(scene), "effects": listed}, "effects")
    for index, item in enumerate(changed.effects):
        try:
            effect(item.name).checked(dict(item.parameters))
        except InputError as error:
            raise InputError(f"effects[{index}]: {error}") from None
    return changed


def _share(source: Path, target: Path) -> None:
    """Make ``target`` the same file as ``source``, or one with the same bytes."""
    try:
        if target.is_file() and (target.samefile(source) or file_hash(target) == file_hash(source)):
            return
    except OSError:
        pass
    with replacing(target) as partial:
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
