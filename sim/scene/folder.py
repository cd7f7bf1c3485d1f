# SPDX-License-Identifier: MIT
"""Scene folders on disk: load, check, hash, save (format: docs/file-formats.md)."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from ..atomic import recover, write_json
from ..errors import InputError
from ..files import MOST_HASHED, is_file, open_file, read_bytes, same_file, shown
from ..folder_lock import lock_beside
from ..validation import MAX_JSON_BYTES, parse, read_json, to_json
from .model import FORMAT, Ground, SceneModel
from .scene_object import SceneObject

SCENE_FILE = "scene.json"


@dataclass(frozen=True)
class Scene:
    """A scene folder: its path and its content, as loaded. Made by ``reconstruct``, ``load_scene`` and ``compose``.

    root: the folder, which file names in the scene are relative to. model: the content of ``scene.json``, immutable;
    ``with_model`` and ``save`` make a changed scene. World frame: metres, Z up.

    >>> import dataclasses, physgen
    >>> scene = physgen.load_scene("scene")  # doctest: +SKIP
    >>> moon = dataclasses.replace(scene.model, gravity=(0, 0, -1.62))  # doctest: +SKIP
    >>> scene = scene.with_model(moon).save()  # doctest: +SKIP
    """

    root: Path
    model: SceneModel

    def __repr__(self) -> str:
        return f"Scene(root={str(self.root)!r}, objects: {', '.join(item.name for item in self.objects)})"

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """The scene's objects, in order."""
        return self.model.objects

    def file(self, name: str) -> Path:
        """Return the path of the scene's file ``name``; InputError when it would lie outside the folder."""
        return inside(self.root, name)

    def files(self) -> list[str]:
        """Return the names of all files that the scene needs besides ``scene.json``: those that it names itself, then
        materials, textures and buffers that its meshes name (``side_files``).
        """
        named = referenced_files(self.model)
        beside = []
        for item in self.objects:
            folder = PurePosixPath(item.mesh).parent
            beside += [(folder / name).as_posix() for name in side_files(self.file(item.mesh))]
        return list(dict.fromkeys((*named, *beside)))

    def hash(self) -> str:
        """Return the SHA-256 of all that the scene's motion depends on (``motion_inputs``), as 64 hex digits.

        Files count by content, not by name; photo, camera and light do not count. A bake's ``inputs_hash`` is over the
        same and the bake's options. Computed anew at every call, because files may have changed. Raises InputError
        when a file cannot be read.
        """
        return hashlib.sha256(json.dumps(self.motion_inputs(), sort_keys=True).encode()).hexdigest()

    def motion_inputs(self) -> dict[str, Any]:
        """Return what ``hash`` is taken over, as JSON: objects, ground, gravity, contacts and effects."""
        scene = self.model
        objects = []
        for item in scene.objects:
            fields: dict[str, Any] = to_json(item)
            for irrelevant in ("mask", "shadow", "shading", "occlusion_order", "size_m"):
                del fields[irrelevant]
            fields["material"].pop("preset")
            for later in ("asleep", "held", "material_tracks", "stiffness_map", "density_map"):
                if not fields[later]:
                    # Older scenes have no such field either.
                    del fields[later]
            fields["mesh"] = file_hash(self.file(item.mesh))
            if item.splats is None:
                # Older scenes have no such field, and their bakes stay valid.
                del fields["splats"]
            else:
                fields["splats"] = file_hash(self.file(item.splats))
            if item.motion is not None and item.motion.vertices_file is not None:
                fields["motion"]["vertices_file"] = file_hash(self.file(item.motion.vertices_file))
            for kind, factors in (("stiffness_map", item.stiffness_map), ("density_map", item.density_map)):
                if factors is not None and factors.file is not None:
                    fields[kind]["file"] = file_hash(self.file(factors.file)) + Path(factors.file).suffix.lower()
            objects.append(fields)
        ground: dict[str, Any] | None = None
        if scene.ground is not None:
            ground = to_json(scene.ground)
            for visible_only in ("reflectivity", "reflection_roughness"):
                del ground[visible_only]
        return {
            "objects": objects,
            "ground": ground,
            "gravity": scene.gravity,
            "gravity_track": to_json(scene.gravity_track),
            "contacts": to_json(scene.contacts),
            "effects": to_json(scene.effects),
        }

    def geometry_hash(self) -> str:
        """Return the SHA-256 of the objects' names, meshes and rest poses, which a bake must share with the scene that
        it is shown in. Raises InputError when a mesh cannot be read.
        """
        content = [[o.name, file_hash(self.file(o.mesh)), o.world_from_mesh] for o in self.objects]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def with_model(self, model: SceneModel) -> Scene:
        """Return this folder with another content, not saved yet."""
        return Scene(root=self.root, model=model)

    def save(self) -> Scene:
        """Write ``scene.json`` whole or not at all; return the scene. The files it names are not written.

        Raises InputError while another command changes the folder.
        """
        with lock_beside(self.root):
            return save_scene(self.root, self.model)


@contextlib.contextmanager
def unchanged_scene(scene: Scene) -> Iterator[None]:
    """Raise InputError at the end where another command has changed the folder of ``scene`` meanwhile, so that what was
    read of it may be of two scenes. All that change one write ``scene.json`` anew, or exchange the folder."""
    with contextlib.ExitStack() as held:
        try:
            is_same = held.enter_context(same_file(scene.root / SCENE_FILE, MAX_JSON_BYTES))
        except FileNotFoundError:
            raise InputError(f"{scene.root}: {SCENE_FILE} is missing; reconstruct the scene again") from None
        yield
        if not is_same():
            raise InputError(f"{scene.root}: was changed by another command meanwhile; run this one again")


MOST_NAME, MOST_PART = 1024, 255
"""Characters of a name within a folder, and bytes between its slashes: what every file system can hold."""


def inside(root: Path, name: str) -> Path:
    """Return ``root / name`` for a relative ``name`` with forward slashes that stays inside ``root``.

    Raises InputError for absolute names, drive letters, ``..`` and links that lead out.
    """
    if len(name) > MOST_NAME or any(len(part.encode("utf-8", "replace")) > MOST_PART for part in name.split("/")):
        raise InputError(f"file name {shown(name)!r}: is too long; names have at most {MOST_PART} bytes a part")
    pure = PurePosixPath(name)
    if not name or "\\" in name or "\0" in name or ":" in name or pure.is_absolute() or ".." in pure.parts:
        raise InputError(f"file name {name!r}: must be relative to {root}, with forward slashes and without '..'")
    path = root / pure
    try:
        inside_root = path.resolve().is_relative_to(root.resolve())
    except (OSError, ValueError, RuntimeError) as error:
        # A lone surrogate, or links in a circle.
        raise InputError(f"file name {name!r}: no file can be called that ({error})") from None
    if not inside_root:
        raise InputError(f"file name {name!r}: leads out of {root}")
    return path


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as 64 hex digits; InputError when it cannot be read."""
    try:
        with open_file(path, MOST_HASHED) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error


MOST_NAMED_BYTES = 8 * 2**30
"""Of all files that a scene names, as often as it names them: so much is read and hashed."""


def load_scene(root: str | Path) -> Scene:
    """Return the scene in the folder ``root``, checked.

    >>> import physgen
    >>> scene = physgen.load_scene("scene")  # doctest: +SKIP

    Raises InputError when ``scene.json`` is missing, malformed or of another format, or names files that are missing or
    lie outside the folder.
    """
    root = Path(root)
    try:
        if not root.exists():
            # A run that replaced it may have been killed between two steps.
            recover(root)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{shown(root)}: no folder can be called that ({error.__class__.__name__})") from None
    path = root / SCENE_FILE
    data = read_json(path, folder=root)
    folder = Scene(root=root, model=parse_scene(data, str(path)))
    left = MOST_NAMED_BYTES
    for name in referenced_files(folder.model):
        file = folder.file(name)
        if not is_file(file):
            raise InputError(
                f"{path}: names {name!r}, which is missing or cannot be read; restore it or reconstruct the scene again"
            )
        left -= file.stat().st_size
        if left < 0:
            raise InputError(f"{path}: names files of more than {MOST_NAMED_BYTES >> 30} GiB; reduce its meshes")
    return folder


def parse_scene(data: Any, where: str) -> SceneModel:
    """Return the scene of parsed JSON; ``where`` names the file in messages."""
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
    return parse(SceneModel, fields, where)


def _effect_from_json(value: Any, where: str) -> Any:
    """Return an effect's JSON with parameters as pairs (immutable in memory) in place of an object (readable)."""
    if isinstance(value, dict) and "parameters" in value:
        if not isinstance(value["parameters"], dict):
            raise InputError(f"{where}.parameters: expected an object of numbers by name")
        return {**value, "parameters": [list(pair) for pair in sorted(value["parameters"].items())]}
    return value


def scene_to_json(scene: SceneModel) -> dict[str, Any]:
    """Return the content of ``scene.json``."""
    data = {"format": FORMAT, **to_json(scene)}
    data["effects"] = [
        {"name": e.name, "parameters": dict(e.parameters), **({"objects": list(e.objects)} if e.objects else {})}
        for e in scene.effects
    ]
    return data


def save_scene(root: Path, scene: SceneModel) -> Scene:
    """Write ``scene.json`` into ``root`` atomically; the caller writes the files that it names, and holds the folder
    where that is no new one (``Scene.save``)."""
    for name in referenced_files(scene):
        inside(root, name)
    write_json(root / SCENE_FILE, scene_to_json(scene))
    return Scene(root=root, model=scene)


def require_photo(folder: Scene) -> tuple[str, str, Ground]:
    """Return the names of photo and clean plate, and the ground: what rendering into the photo needs.

    Raises InputError for a scene without a photo or without a ground.
    """
    scene = folder.model
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


def referenced_files(scene: SceneModel) -> list[str]:
    """Return the names of all files that ``scene`` needs, the photo first if there is one."""
    names = [name for name in (scene.photo, scene.background) if name is not None]
    for item in scene.objects:
        track = item.motion.vertices_file if item.motion else None
        seen = (item.mesh, item.mask, item.shadow, track, item.splats, item.shading)
        names += [name for name in seen if name is not None]
        factors = [factors.file for factors in (item.stiffness_map, item.density_map) if factors is not None]
        names += [name for name in factors if name is not None]
    names += [name for name in (scene.light.environment, scene.depth) if name is not None]
    return names


MOST_NAMING, MOST_LIBRARY = 512 * 2**20, 4 * 2**20
"""Bytes of a mesh file that is searched for names, as many as a mesh may have, and of a material library."""
MOST_LIBRARIES, MOST_BESIDE, MOST_LINE = 64, 10_000, 2**16
"""Libraries that a mesh may name, names in it and them, and characters of a line with names."""

_MTL_TEXTURE = re.compile(r"(?:map_\w+|bump|disp|decal|norm|refl)\s+(.+)", re.IGNORECASE)


def side_files(mesh: Path) -> list[str]:
    """Return the files that a mesh file refers to, relative to its folder: an OBJ's material libraries and their
    textures, a glTF's buffers and images. Other formats are self-contained.

    Files that are missing or lie outside the mesh's folder are left out; the mesh is read without them. A library names
    no further ones. Raises InputError for more names than any mesh has.
    """
    tried: set[str] = set()
    found = _beside(mesh, mesh, tried)
    libraries = [name for name in found if name.lower().endswith(".mtl")]
    if len(libraries) > MOST_LIBRARIES:
        raise InputError(f"{mesh}: names {len(libraries)} material libraries; export it again with one")
    for library in libraries:
        textures = _beside(mesh, mesh.parent / library, tried)
        found += [name for name in textures if not name.lower().endswith(".mtl")]
    return list(dict.fromkeys(found))


def _beside(mesh: Path, path: Path, tried: set[str]) -> list[str]:
    """Return the files that ``path``, of the mesh or a library of it, names, relative to the mesh's folder.

    tried: names that were looked at before, which are not again.
    """
    found: list[str] = []
    for name in _named_beside(path):
        if len(name) > MOST_NAME:
            continue
        wanted = (path.parent.relative_to(mesh.parent) / name.replace("\\", "/")).as_posix()
        if wanted in tried:
            continue
        tried.add(wanted)
        if len(tried) > MOST_BESIDE:
            raise InputError(f"{mesh}: names more than {MOST_BESIDE} files; export it again with its textures inside")
        try:
            inner = inside(mesh.parent, wanted)
        except InputError:
            continue
        if inner.is_file():
            found.append(inner.relative_to(mesh.parent).as_posix())
    return found


def _named_beside(path: Path) -> Iterator[str]:
    """Yield the file names in an OBJ, MTL or glTF file, as they are written there; none if it cannot be read."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".gltf":
            yield from _named_in_gltf(json.loads(read_bytes(path, MOST_NAMING)))
        elif suffix in (".obj", ".mtl"):
            most = MOST_NAMING if suffix == ".obj" else MOST_LIBRARY
            with io.TextIOWrapper(open_file(path, most), encoding="utf-8", errors="replace") as file:
                for line in map(str.strip, iter(lambda: file.readline(MOST_LINE), "")):
                    # Several names may follow, and one name may hold spaces; options may come before a texture's.
                    if suffix == ".obj" and line.startswith("mtllib "):
                        yield from (line.removeprefix("mtllib ").strip(), *line.split()[1:])
                    elif suffix == ".mtl" and (texture := _MTL_TEXTURE.match(line)):
                        yield from (texture[1], texture[1].split()[-1])
    except (OSError, InputError, ValueError, RecursionError, MemoryError):
        return


def _named_in_gltf(document: Any) -> Iterator[str]:
    for kind in ("buffers", "images"):
        listed = document.get(kind) if isinstance(document, dict) else None
        for entry in listed if isinstance(listed, list) else []:
            uri = entry.get("uri") if isinstance(entry, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                yield unquote(uri)
