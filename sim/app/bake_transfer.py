# SPDX-License-Identifier: MIT
"""Transfer the bake, or the physics, of a scene exported from Blender to the photo's scene that was imported there.

Blender bakes its own objects: meshes in their own space, under the names they have there. The render stage needs the
photo's scene folder and world metres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cache.bake_check import require_intact
from ..cache.bake_folder import MESH_SPACE, WORLD_SPACE, Bake, BakedObject, save_manifest
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..errors import InputError
from ..events import OnEvent, ignore
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from ..scene.model import SceneModel, SceneObject
from ..scene.overrides import PHYSICS_FIELDS

MOVED_SHARE = 0.01
"""Fraction of an object's size; farther from its position in the photo it counts as moved."""


def transfer_bake(
    photo: Scene, baked_scene: Scene, bake: Bake, *, out: Path, names: Mapping[str, str], on_event: OnEvent = ignore
) -> Bake:
    """Return ``bake`` of ``baked_scene`` as a bake of ``photo``, in the new folder ``out``.

    names: name in ``photo`` → name in ``baked_scene``; objects left out stay where the photo shows them.

    Raises InputError when ``baked_scene`` has changed since the bake, an object is missing from it, or an object's
    vertices differ from the photo's scene, or files of ``bake`` are not what was written.
    """
    require_intact(bake)
    manifest = bake.manifest
    if manifest.geometry_hash and manifest.geometry_hash != baked_scene.geometry_hash():
        raise InputError(f"{bake.root}: was baked from other meshes or positions; bake the scene again")
    files = {item.name: item for item in manifest.objects}
    bodies = {item.name: item for item in baked_scene.objects}
    out.mkdir(parents=True)
    placed = []
    for item in photo.objects:
        name = names.get(item.name)
        if name is not None and (name not in files or name not in bodies):
            raise InputError(f"{bake.root}: has no cache of object {name!r}; bake the scene again")
        cache = None if name is None else (Pc2Reader(bake.root / files[name].file), files[name], bodies[name])
        placed.append(_transfer_object(photo, item, cache, manifest.frames_done, out, on_event))
    # The checksums are of the samples before they were moved.
    result = dataclasses.replace(manifest, objects=tuple(placed), checksums=(), geometry_hash=photo.geometry_hash())
    save_manifest(out, result)
    return Bake(root=out, manifest=result)


def _transfer_object(
    folder: Scene,
    item: SceneObject,
    cache: tuple[Pc2Reader, BakedObject, SceneObject] | None,
    samples: int,
    out: Path,
    on_event: OnEvent,
) -> BakedObject:
    rest = load_object_mesh(folder, item).vertices
    result = BakedObject(name=item.name, file=f"{item.name}.pc2", vertices=len(rest), space=WORLD_SPACE)
    if cache is None:
        with Pc2Writer(out / result.file, vertex_count=len(rest)) as writer:
            for _ in range(samples):
                writer.append(rest)
        return result
    reader, baked, body = cache
    if reader.vertex_count != len(rest):
        raise InputError(
            f"object {item.name!r}: its mesh has {reader.vertex_count} vertices and had {len(rest)} in the photo's "
            "scene, whose texture it uses: undo the change of the mesh and bake again"
        )
    matrix = np.asarray(body.world_from_mesh) if baked.space == MESH_SPACE else np.eye(4)
    _write_transformed(reader, matrix, samples, out / result.file)
    if np.abs(_transformed(reader.sample(0), matrix) - rest).max() > MOVED_SHARE * item.size_m:
        message = f"{item.name} does not start where the photo shows it; frames differ from the photo there"
        on_event({"event": "notice", "stage": "render", "message": message})
    if baked.points_file is None:
        return result
    points = Pc2Reader(reader.path.parent / baked.points_file)
    file = f"{item.name}.points.pc2"
    _write_transformed(points, matrix, samples, out / file)
    return dataclasses.replace(result, points_file=file, points=points.vertex_count, points_as=baked.points_as)


def _write_transformed(reader: Pc2Reader, matrix: NDArray[np.float64], samples: int, path: Path) -> None:
    with Pc2Writer(path, vertex_count=reader.vertex_count) as writer:
        for index in range(samples):
            writer.append(_transformed(reader.sample(index), matrix))


def _transformed(sample: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return sample.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


KEPT_FIELDS = ("role", "splats", "motion", "stiffness_map", "density_map")
"""Physics of an object that is not taken over: the photo's own, or given in the mesh of the export."""


def transfer_physics(photo: Scene, exported: Scene, names: Mapping[str, str]) -> SceneModel:
    """Return the content of ``photo`` with the physics of ``exported``: of its objects, ground and world.

    names: as in ``transfer_bake``. A farm bakes the result itself, in world metres.

    Raises InputError for what the photo's scene cannot say: objects that are in one of the two only, were moved or
    reshaped since, collide along keyframes, or have weights painted on their mesh.
    """
    bodies = {item.name: item for item in exported.objects}
    back = {theirs: ours for ours, theirs in names.items()}
    strangers = [name for name in bodies if name not in back]
    if strangers:
        raise InputError(
            f"not in the photo: {', '.join(strangers)}; a farm renders into the photo: take them out of the simulation"
        )
    objects = []
    for item in photo.objects:
        body = bodies.get(names.get(item.name, ""))
        if body is None:
            raise InputError(f"object {item.name!r}: is in the photo and not in the simulation; add it, as a collider")
        _require_same_place(photo, item, exported, body)
        for field, what in (("motion", "moves by keyframes"), ("stiffness_map", WEIGHTS), ("density_map", WEIGHTS)):
            if getattr(body, field) is not None:
                raise InputError(f"object {body.name!r}: {what}, which a farm's scene cannot have; bake it here")
        taken = {field: getattr(body, field) for field in PHYSICS_FIELDS if field not in KEPT_FIELDS}
        objects.append(dataclasses.replace(item, role=body.role, **taken))
    ground = exported.model.ground
    if ground is not None and photo.model.ground is not None:
        # The mirror in the photo's floor is the photo's; Blender has no such numbers.
        kept = {name: getattr(photo.model.ground, name) for name in ("reflectivity", "reflection_roughness")}
        ground = dataclasses.replace(ground, **kept)
    effects = tuple(
        dataclasses.replace(item, objects=tuple(back[name] for name in item.objects)) for item in exported.model.effects
    )
    return dataclasses.replace(
        photo.model,
        objects=tuple(objects),
        ground=ground,
        effects=effects,
        gravity=exported.model.gravity,
        gravity_track=exported.model.gravity_track,
    )


WEIGHTS = "has weights painted on its mesh"


def _require_same_place(photo: Scene, item: SceneObject, exported: Scene, body: SceneObject) -> None:
    rest, now = load_object_mesh(photo, item).vertices, load_object_mesh(exported, body).vertices
    if rest.shape != now.shape or np.abs(rest - now).max() > MOVED_SHARE * item.size_m:
        raise InputError(
            f"object {body.name!r}: is not where and as the photo shows it, and a farm's scene is the photo's; move it "
            "back, or bake and render it here"
        )
