# SPDX-License-Identifier: MIT
"""Scene folders on disk: load, check, save. docs/file-formats.md describes them for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ..atomic import write_json
from ..errors import InputError
from .json_fields import parse, read_json, to_json
from .model import FORMAT, Ground, Scene

SCENE_FILE = "scene.json"


@dataclass(frozen=True)
class SceneFolder:
    """A loaded scene and the folder that its file names are relative to."""

    root: Path
    scene: Scene

    def file(self, name: str) -> Path:
        """The path of the scene's file ``name``; InputError when it would lie outside the folder."""
        return inside(self.root, name)


def inside(root: Path, name: str) -> Path:
    """``root / name`` for a relative, forward-slashed ``name`` that stays inside ``root``, links resolved.

    Raises InputError for absolute names, drive letters, ``..`` and links that lead out.
    """
    pure = PurePosixPath(name)
    if not name or "\\" in name or "\0" in name or ":" in name or pure.is_absolute() or ".." in pure.parts:
        raise InputError(f"file name {name!r}: must be relative to {root}, with forward slashes and without '..'")
    path = root / pure
    try:
        inside_root = path.resolve().is_relative_to(root.resolve())
    except (OSError, ValueError, RuntimeError) as error:
        # Half a character, links in a circle.
        raise InputError(f"file name {name!r}: no file can be called that ({error})") from None
    if not inside_root:
        raise InputError(f"file name {name!r}: leads out of {root}")
    return path


def load_scene(root: Path) -> SceneFolder:
    """Read and check the scene folder ``root``.

    Raises InputError when ``scene.json`` is missing, malformed, of another format, or names files that are not
    there or lie outside the folder.
    """
    path = root / SCENE_FILE
    data = read_json(path)
    folder = SceneFolder(root=root, scene=parse_scene(data, str(path)))
    for name in referenced_files(folder.scene):
        if not folder.file(name).is_file():
            raise InputError(f"{path}: names {name!r}, which is not there; restore it or reconstruct the scene again")
    return folder


def parse_scene(data: Any, where: str) -> Scene:
    """Scene from parsed JSON; ``where`` names the file in messages."""
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected a JSON object")
    fields = dict(data)
    found = fields.pop("format", None)
    if found != FORMAT:
        remedy = (
            "update PhysGen"
            if isinstance(found, str) and found.startswith("physgen-scene/")
            else "choose a scene folder"
        )
        raise InputError(f"{where}: format is {found!r}, this version reads {FORMAT!r}; {remedy}")
    effects = fields.get("effects")
    if isinstance(effects, list):
        fields["effects"] = [_effect_from_json(e, f"{where}: effects[{i}]") for i, e in enumerate(effects)]
    return parse(Scene, fields, where)


def _effect_from_json(value: Any, where: str) -> Any:
    """Parameters are an object in the file (readable) and pairs in memory (immutable)."""
    if isinstance(value, dict) and "parameters" in value:
        if not isinstance(value["parameters"], dict):
            raise InputError(f"{where}.parameters: expected an object of numbers by name")
        return {**value, "parameters": [list(pair) for pair in sorted(value["parameters"].items())]}
    return value


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """The content of ``scene.json``."""
    data = {"format": FORMAT, **to_json(scene)}
    data["effects"] = [
        {"name": e.name, "parameters": dict(e.parameters), **({"objects": list(e.objects)} if e.objects else {})}
        for e in scene.effects
    ]
    return data


def save_scene(root: Path, scene: Scene) -> SceneFolder:
    """Write ``scene.json`` into ``root`` whole or not at all; the files it names are the caller's to write."""
    for name in referenced_files(scene):
        inside(root, name)
    write_json(root / SCENE_FILE, scene_to_json(scene))
    return SceneFolder(root=root, scene=scene)


def require_photo(folder: SceneFolder) -> tuple[str, str, Ground]:
    """Names of the photo and its background, and the ground in it: what is needed to show anything in the photo.

    Raises InputError, with what to do instead, for a scene without a photo or without a ground.
    """
    scene = folder.scene
    if scene.photo is None or scene.background is None:
        raise InputError(
            f"{folder.root}: this scene has no photo to render into; render it in Blender, with the bake attached to "
            "its objects, or reconstruct a scene from a photo (physgen reconstruct)"
        )
    if scene.ground is None:
        raise InputError(
            f"{folder.root}: this scene has no ground, which the photo's shadows fall on; give it a ground again, "
            "below all objects if it should not hold them"
        )
    return scene.photo, scene.background, scene.ground


def referenced_files(scene: Scene) -> list[str]:
    """Names of all files that ``scene`` needs, photo first if there is one."""
    names = [name for name in (scene.photo, scene.background) if name is not None]
    for item in scene.objects:
        track = item.motion.vertices_file if item.motion else None
        names += [name for name in (item.mesh, item.mask, item.shadow, track, item.splats) if name is not None]
    names += [name for name in (scene.light.environment, scene.depth) if name is not None]
    return names
