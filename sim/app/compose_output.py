# SPDX-License-Identifier: MIT
"""The scene folder of a composition: what moved is written anew, everything else shared with the scene before."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import InputError
from ..gaussians.ply.write import write_splats
from ..gaussians.splats import Splats
from ..reconstruct.output import replacing_folder
from ..scene.folder import SceneFolder, inside, referenced_files, save_scene
from ..scene.glb import transformed
from ..scene.model import SceneObject
from ..scene.moved_mesh import moved_suffix, write_moved_mesh

Array = NDArray[np.float64]

COMPOSE_FILE = "compose.json"
SHARED = ("masks", "full", "shadows", "holes", "albedo", "physics.json")
"""What belongs to a scene without being named in it. A composition cannot be corrected as the reconstruction that it
came from, so ``reconstruct.json``, stages and report stay behind."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Moved:
    """What became of an object.

    vertices: (V, 3) world metres, in the order of its mesh file; faces: (T, 3); splats: its own, in its mesh file's
    coordinates, or None where it has none.
    """

    vertices: Array
    faces: NDArray[np.int64]
    splats: Splats | None = None


@contextmanager
def composition_folder(root: Path, out: Path) -> Iterator[Path]:
    """Yield a fresh folder that becomes ``out`` when all went well, and vanishes otherwise.

    Raises InputError where ``out`` is the scene ``root``, lies in it or around it, or holds anything but an earlier
    composition: a scene that somebody has worked on is never replaced.
    """
    ours, theirs = out.resolve(), root.resolve()
    if ours == theirs or theirs in ours.parents or ours in theirs.parents:
        raise InputError(f"{out}: is the scene itself, or in or around it; choose another folder for the composition")
    holds = out.is_dir() and any(out.iterdir())
    if holds and not (out / COMPOSE_FILE).is_file():
        raise InputError(f"{out}: holds something that is no composition; choose an empty or new folder")
    with replacing_folder(out) as partial:
        yield partial


def write_composition(
    source: SceneFolder, target: Path, moved: Mapping[str, Moved], record: Mapping[str, Any]
) -> SceneFolder:
    """Write the scene of ``source`` into the new folder ``target`` with the ``moved`` objects, by name, where they are
    now, and ``record`` as ``compose.json`` beside it. Raises InputError when something cannot be written.
    """
    objects = []
    taken = {item.mesh.casefold() for item in source.scene.objects}
    for item in source.scene.objects:
        if item.name in moved:
            item = _write_moved(source, target, item, moved[item.name], taken)
        objects.append(item)
    scene = dataclasses.replace(source.scene, objects=tuple(objects))
    names = set(referenced_files(scene)) | set(_companions(source.root))
    for name in sorted(names):
        place = inside(target, name)
        if not place.exists():
            _share(source.file(name), place)
    write_json(target / COMPOSE_FILE, record)
    return save_scene(target, scene)


def _write_moved(source: SceneFolder, target: Path, item: SceneObject, moved: Moved, taken: set[str]) -> SceneObject:
    """``item`` with files of its own; objects that shared a mesh have moved differently."""
    path = source.file(item.mesh)
    name = f"{item.mesh.rpartition('.')[0]}{moved_suffix(path)}"
    users = sum(other.mesh == item.mesh for other in source.scene.objects)
    if users > 1 or (name != item.mesh and name.casefold() in taken):
        name = f"meshes/{item.name} fitted{moved_suffix(path)}"
    matrix = np.linalg.inv(np.asarray(item.world_from_mesh, dtype=np.float64))
    write_moved_mesh(path, inside(target, name), transformed(moved.vertices, matrix), moved.faces)
    albedo = f"albedo/{Path(item.mesh).stem}.png"
    if Path(name).stem != Path(item.mesh).stem and (source.root / albedo).is_file():
        _share(source.file(albedo), inside(target, f"albedo/{Path(name).stem}.png"))
    changes: dict[str, Any] = {"mesh": name, "size_m": float(np.ptp(moved.vertices, axis=0).max())}
    if moved.splats is not None:
        changes["splats"] = f"splats/{item.name}.ply"
        place = inside(target, changes["splats"])
        place.parent.mkdir(parents=True, exist_ok=True)
        write_splats(place, moved.splats)
    return dataclasses.replace(item, **changes)


def _companions(root: Path) -> Iterator[str]:
    """Files of the scene that ``scene.json`` does not name."""
    for entry in SHARED:
        path = root / entry
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        yield from (file.relative_to(root).as_posix() for file in files if file.is_file())


def _share(source: Path, target: Path) -> None:
    """The same file by a hard link where the file system has them, else a copy."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); free space") from error
