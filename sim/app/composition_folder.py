# SPDX-License-Identifier: MIT
"""Folder of a composition: what moved is written anew, everything else is shared with the source scene.

``compose.json`` records what was done.
"""

from __future__ import annotations

import dataclasses
import math
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import InputError
from ..gaussians.compose.compose_options import ComposeRequest
from ..gaussians.compose.composition_parts import Composition
from ..gaussians.compose.penetration import Penetration
from ..gaussians.splat_ply import write_splats
from ..gaussians.splats import Splats
from ..scene.folder import Scene, inside, referenced_files, save_scene, unchanged_scene
from ..scene.model import SceneModel, SceneObject
from ..scene.scene_output import COMPOSE_FILE, PHYSICS_FILE, replacing_folder
from ..scene.textured_mesh import moved_suffix, transformed, write_moved_mesh
from ..version import VERSION
from .compose_inputs import (
    ContactGroup,
    ImageSimilarity,
)

Array = NDArray[np.float64]

UNNAMED_FILES = ("masks", "full", "shadows", "holes", "albedo", PHYSICS_FILE)
"""Files of a scene that ``scene.json`` does not name. A composition cannot be corrected like the reconstruction that it
came from, so ``reconstruct.json``, stages and report are not copied."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MovedObject:
    """A deformed object.

    vertices: (V, 3) world metres, in the order of its mesh file; faces: (T, 3); splats: in the coordinates of its mesh
    file, or None.
    """

    vertices: Array
    faces: NDArray[np.int64]
    splats: Splats | None = None


@contextmanager
def composition_folder(scene: Scene, out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes ``out`` on success and is deleted otherwise.

    Raises InputError where ``out`` is the folder of ``scene``, inside it or a parent of it, or holds anything but an
    earlier composition, so that a scene with edits is never replaced, and where ``scene`` is changed meanwhile.
    """
    ours, theirs = out.resolve(), scene.root.resolve()
    if ours == theirs or theirs in ours.parents or ours in theirs.parents:
        raise InputError(f"{out}: is the scene, inside it or a parent of it; choose another folder for the composition")
    holds = out.is_dir() and any(out.iterdir())
    if holds and not (out / COMPOSE_FILE).is_file():
        raise InputError(f"{out}: holds something other than a composition; choose an empty or new folder")
    with replacing_folder(out) as partial, unchanged_scene(scene):
        yield partial


def write_composition(
    source: Scene, target: Path, moved: Mapping[str, MovedObject], record: Mapping[str, Any]
) -> Scene:
    """Write the scene of ``source`` with the ``moved`` objects, by name, into the new folder ``target``, and ``record``
    as ``compose.json``. Returns the new scene folder. Raises InputError when something cannot be written.
    """
    objects = []
    taken = {item.mesh.casefold() for item in source.model.objects}
    for item in source.model.objects:
        if item.name in moved:
            item = _write_moved(source, target, item, moved[item.name], taken)
        objects.append(item)
    scene = dataclasses.replace(source.model, objects=tuple(objects))
    unmoved = tuple(item for item in scene.objects if item.name not in moved)
    beside = source.with_model(dataclasses.replace(scene, objects=unmoved)).files()
    names = {*referenced_files(scene), *beside, *_unnamed_files(source.root)}
    for name in sorted(names):
        place = inside(target, name)
        if not place.exists():
            _link_or_copy(source.file(name), place)
    write_json(target / COMPOSE_FILE, record)
    return save_scene(target, scene)


def _write_moved(source: Scene, target: Path, item: SceneObject, moved: MovedObject, taken: set[str]) -> SceneObject:
    """Return ``item`` with its own mesh and splat files; objects that shared a mesh have deformed differently."""
    path = source.file(item.mesh)
    name = f"{item.mesh.rpartition('.')[0]}{moved_suffix(path)}"
    users = sum(other.mesh == item.mesh for other in source.model.objects)
    if users > 1 or (name != item.mesh and name.casefold() in taken):
        name = f"meshes/{item.name} fitted{moved_suffix(path)}"
    matrix = np.linalg.inv(np.asarray(item.world_from_mesh, dtype=np.float64))
    write_moved_mesh(path, inside(target, name), transformed(moved.vertices, matrix), moved.faces)
    albedo = f"albedo/{Path(item.mesh).stem}.png"
    if Path(name).stem != Path(item.mesh).stem and (source.root / albedo).is_file():
        _link_or_copy(source.file(albedo), inside(target, f"albedo/{Path(name).stem}.png"))
    changes: dict[str, Any] = {"mesh": name, "size_m": float(np.ptp(moved.vertices, axis=0).max())}
    if moved.splats is not None:
        changes["splats"] = f"splats/{item.name}.ply"
        place = inside(target, changes["splats"])
        place.parent.mkdir(parents=True, exist_ok=True)
        write_splats(place, moved.splats)
    return dataclasses.replace(item, **changes)


def _unnamed_files(root: Path) -> Iterator[str]:
    """Yield the relative paths of ``UNNAMED_FILES`` that exist in ``root``."""
    for entry in UNNAMED_FILES:
        path = root / entry
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        yield from (file.relative_to(root).as_posix() for file in files if file.is_file())


def _link_or_copy(source: Path, target: Path) -> None:
    """Hard-link ``source`` to ``target`` where the file system supports it, else copy it. Raises InputError."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); free space") from error


FORMAT = "physgen-compose/1"


@dataclass(frozen=True, kw_only=True, eq=False)
class GroupResult:
    """A composed group. likeness: before and after, None without a photo; pairs: as in ``compose.json``."""

    group: ContactGroup
    composed: Composition
    likeness: tuple[ImageSimilarity, ImageSimilarity] | None
    pairs: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]


def composition_record(scene: SceneModel, request: ComposeRequest, fits: Sequence[GroupResult]) -> dict[str, Any]:
    """Return the content of ``compose.json`` (docs/file-formats.md)."""
    return {
        "format": FORMAT,
        "method": request.options.method,
        "seed": request.options.seed,
        "options": {
            **dataclasses.asdict(request.options),
            "splats": request.splats,
            "guidance": request.guidance,
            "prompt": request.prompt,
        },
        "picture": scene.photo if request.picture else None,
        "groups": [
            {
                "objects": [body.name for body in fit.group.bodies],
                "likeness": None if fit.likeness is None else [_similarity_json(item) for item in fit.likeness],
                "moved": _displacements(fit),
            }
            for fit in fits
        ],
        "pairs": [pair for fit in fits for pair in fit.pairs],
        "notes": [note for fit in fits for note in fit.notes],
        "versions": _versions(),
    }


def _similarity_json(found: ImageSimilarity) -> dict[str, float | None]:
    return {"psnr_db": found.psnr if math.isfinite(found.psnr) else None, "ssim": found.ssim}


def _displacements(fit: GroupResult) -> dict[str, dict[str, float]]:
    """Return mean and largest vertex displacement in metres, by the names of deformable objects."""
    result = {}
    for body, part in zip(fit.group.bodies[1:], fit.composed.parts[1:], strict=True):
        way = np.linalg.norm(part.surface.vertices - body.surface.vertices, axis=1)
        result[body.name] = {"mean_m": float(way.mean()), "farthest_m": float(way.max())}
    return result


def _versions() -> Mapping[str, str]:
    return {
        "physgen": VERSION,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "taichi": version("taichi"),
    }


def penetration_json(found: Penetration) -> dict[str, float]:
    """Return one state of a pair as in ``compose.json``."""
    return {"volume_m3": found.volume, "share": found.share, "deepest_m": found.deepest}
