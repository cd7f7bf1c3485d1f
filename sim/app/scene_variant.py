# SPDX-License-Identifier: MIT
"""Scene folder → new scene folder with the same objects and other physics."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from ..atomic import replacing
from ..effects.registry import effect
from ..errors import InputError
from ..folder_lock import LOCK_FILE, folder_lock, lock_beside
from ..scene.folder import (
    SCENE_FILE,
    Scene,
    file_hash,
    inside,
    load_scene,
    parse_scene,
    referenced_files,
    save_scene,
    scene_to_json,
    unchanged_scene,
)
from ..scene.model import SceneModel
from ..scene.scene_output import COMPOSE_FILE, STAMP_FILE, folder_kind

# Imported where they are used: Blender's process, which may lack what reconstruction needs, saves scenes with this.
if TYPE_CHECKING:
    from .reconstruct import Physics


NEVER_REPLACED = (STAMP_FILE, COMPOSE_FILE)
"""Files that no variant has: their folders hold work that a variant does not."""


def make_variant(
    source: Scene,
    *,
    out: Path,
    physics: Physics,
    effects: str | None = None,
) -> Scene:
    """Return ``source`` with other physics (see ``with_physics``) as the scene folder ``out``.

    effects: all that the variant has, as JSON of the list in ``scene.json``; None keeps those of the scene.
    Files are shared with ``source`` by hard links where the file system has them, else copied; those that are the same
    already are left alone. Every file is written whole, ``scene.json`` last.

    Raises InputError for unusable scenes, physics or effects, and for a folder with other content.
    """
    from .reconstruct import with_physics

    scene = with_physics(source.model, physics)
    return save_variant(source, scene if effects is None else _with_effects(scene, effects), out=out)


def save_variant(source: Scene, scene: SceneModel, *, out: Path) -> Scene:
    """Write ``scene``, which has the files of ``source``, as the scene folder ``out``, as ``make_variant`` does."""
    if out.resolve() == source.root.resolve():
        raise InputError(f"{out}: is the scene itself; choose another folder for the variant")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder for the variant")
    if out.is_dir() and not (out / SCENE_FILE).is_file() and any(not p.name.startswith(".") for p in out.iterdir()):
        leftovers = {Path(name).parts[0] for name in referenced_files(scene)}
        if any(p.name not in leftovers for p in out.iterdir() if not p.name.startswith(".")):
            raise InputError(f"{out}: holds other files and no scene; choose an empty or new folder")
    if (kind := folder_kind(out, NEVER_REPLACED)) is not None:
        raise InputError(f"{out}: is {kind}, which the variant would replace; choose another folder")
    new = not out.exists()
    # Held beside it, too, as by what replaces scenes: reconstruct, correct, light.
    with lock_beside(out), folder_lock(out):
        try:
            with unchanged_scene(source):
                for name in source.with_model(scene).files():
                    _link_or_copy(source.file(name), inside(out, name))
            with contextlib.suppress(InputError):
                if load_scene(out).model == scene:
                    return Scene(root=out, model=scene)
            return save_scene(out, scene)
        except BaseException:
            if new:
                _clear(out)
            raise


def _clear(out: Path) -> None:
    """Remove what is in the folder ``out``, but for its lock, which is not this function's."""
    for path in out.iterdir():
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != LOCK_FILE:
            path.unlink(missing_ok=True)


def _with_effects(scene: SceneModel, text: str) -> SceneModel:
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


def _link_or_copy(source: Path, target: Path) -> None:
    """Make ``target`` a hard link to ``source``, or a copy."""
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
