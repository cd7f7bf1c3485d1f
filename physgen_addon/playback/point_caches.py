# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked point caches: validated against the scene, read, and attached as native Mesh Cache modifiers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy

from ...sim.cache.bake_folder import SURFACE, WORLD_SPACE, Bake, BakeManifest
from ...sim.cache.pc2 import Pc2Reader
from ...sim.errors import InputError
from ...sim.folder_lock import is_locked
from ...sim.scene.folder import Scene
from ..paths import for_blender

MODIFIER = "PhysGen cache"


@dataclass(frozen=True)
class Flow:
    """Particles of a granular or fluid object.

    surface: shown as a surface around them, else as grains. from_sample: first sample at which they are shown, because
    the object's skin tears; None: never.
    """

    cache: Pc2Reader
    surface: bool
    from_sample: int | None = None

    def shown_at(self, sample: int) -> bool:
        """Return whether ``sample`` shows them."""
        return self.from_sample is not None and sample >= self.from_sample


@dataclass(frozen=True)
class Tear:
    """The skin of an object cut open where its matter parts. cache: its vertices; file: of its triangles; from_sample:
    first sample with an open crack."""

    cache: Pc2Reader
    file: Path
    from_sample: int

    def shown_at(self, sample: int) -> bool:
        """Return whether ``sample`` shows it in place of the whole mesh."""
        return sample >= self.from_sample


@dataclass(frozen=True)
class OpenedBake:
    """A bake that matches a scene: caches in the order of its objects, and particles and torn skins (None: without)."""

    folder: Path
    manifest: BakeManifest
    caches: tuple[Pc2Reader, ...]
    flows: tuple[Flow | None, ...]
    tears: tuple[Tear | None, ...] = ()

    @property
    def first_frame(self) -> int:
        """Frame number of sample 0, the scene at rest."""
        return self.manifest.frame_start

    @property
    def last_frame(self) -> int:
        """Number of the last frame that every cache holds."""
        return self.manifest.frame_start + min(cache.sample_count for cache in self.every) - 1

    @property
    def every(self) -> tuple[Pc2Reader, ...]:
        """All caches, particles last."""
        return self.caches + tuple(each.cache for each in (*self.flows, *self.tears) if each is not None)

    @property
    def unfinished(self) -> str:
        """Return how to complete an incomplete bake, in words; empty for a complete one."""
        whole = self.manifest.frame_start + self.manifest.frames - 1
        if self.last_frame >= whole:
            return ""
        if is_locked(self.folder):
            return f"the bake of {whole} frames in {self.folder} is still running: wait for it"
        return (
            f"the bake of {whole} frames in {self.folder} was stopped: run `physgen bake` again, it goes on from there"
        )


def open_bake(bake: Bake, scene: Scene) -> OpenedBake:
    """Return ``bake`` with its caches open, in the order of the objects of ``scene``.

    Raises InputError if an object of the scene has no cache in it, or a cache is damaged or empty.
    """
    folder, manifest = bake.root, bake.manifest
    files = {item.name: item for item in manifest.objects}
    caches: list[Pc2Reader] = []
    flows: list[Flow | None] = []
    tears: list[Tear | None] = []
    for item in scene.objects:
        if item.name not in files:
            raise InputError(f"{folder}: holds no cache of object {item.name!r}; bake the scene again")
        baked = files[item.name]
        caches.append(Pc2Reader(folder / baked.file))
        particles = None if baked.points_file is None else Pc2Reader(folder / baked.points_file)
        flows.append(None if particles is None else Flow(cache=particles, surface=baked.points_as == SURFACE))
        tears.append(None)
        if baked.torn_file is not None and baked.torn_skin is not None:
            tears[-1] = Tear(Pc2Reader(folder / baked.torn_file), folder / baked.torn_skin, baked.torn_from)
    opened = OpenedBake(folder=folder, manifest=manifest, caches=tuple(caches), flows=tuple(flows), tears=tuple(tears))
    for cache in opened.every:
        if cache.sample_count < 1:
            raise InputError(f"{cache.path}: holds no sample yet; let the bake run on")
    return opened


def require_scene(bake: OpenedBake, folder: Scene) -> None:
    """Raise InputError if ``bake`` was made from other meshes or poses."""
    known = bake.manifest.geometry_hash
    if known and known != folder.geometry_hash():
        raise InputError(
            f"{bake.folder}: was baked from other meshes or poses than {folder.root} has now; bake the scene again"
        )


def require_world(bake: OpenedBake) -> None:
    """Raise InputError unless the samples of ``bake`` are in world metres."""
    other = next((item for item in bake.manifest.objects if item.space != WORLD_SPACE), None)
    if other is not None:
        raise InputError(
            f"{bake.folder}: the samples of {other.name!r} are in the space of its mesh, and are needed in the "
            f"world's; bake again with space {WORLD_SPACE!r} (physgen bake without --space)"
        )


def require_fit(cache: Pc2Reader, vertex_count: int, name: str) -> None:
    """Raise InputError unless ``cache`` has the mesh's number of vertices: Blender only warns on the console."""
    if cache.vertex_count != vertex_count:
        raise InputError(
            f"{cache.path}: has {cache.vertex_count} vertices, the mesh of {name!r} has {vertex_count}; bake again"
        )


def attach(item: bpy.types.Object, cache: Pc2Reader, first_frame: int) -> bpy.types.Modifier:
    """Attach ``cache`` to ``item``, whose mesh it must match (``require_fit``); sample 0 shows at ``first_frame``.

    Samples are in object space: the object's matrix must be the identity for a bake of the space "world", and the
    scene's ``world_from_mesh`` for one of the space "mesh". An earlier PhysGen cache is replaced.
    """
    require_fit(cache, len(item.data.vertices), item.name)
    modifier = item.modifiers.get(MODIFIER) or item.modifiers.new(MODIFIER, "MESH_CACHE")
    modifier.cache_format = "PC2"
    modifier.filepath = for_blender(cache.path.resolve())
    modifier.interpolation = "LINEAR"
    modifier.frame_start = first_frame
    return modifier


def attach_as_first(item: bpy.types.Object, cache: Pc2Reader, path: str, first_frame: int) -> bpy.types.Modifier:
    """``attach`` for objects with modifiers of their own, which then act on the played mesh.

    path: of the cache as stored in the file, such as ``//cache/cube.pc2``. Unchanged properties are not set, so that
    nothing is evaluated again.
    """
    require_fit(cache, len(item.data.vertices), item.name)
    for_blender(cache.path.resolve())
    modifier = item.modifiers.get(MODIFIER)
    if modifier is None:
        modifier = item.modifiers.new(MODIFIER, "MESH_CACHE")
    index = item.modifiers.find(MODIFIER)
    if index > 0:
        item.modifiers.move(index, 0)
        modifier = item.modifiers[0]
    wanted = {"cache_format": "PC2", "filepath": path, "interpolation": "LINEAR", "frame_start": float(first_frame)}
    for name, value in wanted.items():
        if getattr(modifier, name) != value:
            setattr(modifier, name, value)
    return modifier


def detach(item: bpy.types.Object) -> None:
    """Remove the cache from ``item``."""
    modifier = item.modifiers.get(MODIFIER)
    if modifier is not None:
        item.modifiers.remove(modifier)
