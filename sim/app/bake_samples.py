# SPDX-License-Identifier: MIT
"""The contents of a bake at each frame: vertices of every object, particles of those that flow, splats, torn skins.

Splats move with the object's mesh. Particles are kept while they are far apart; at the end skins are cut where they
parted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..cache.bake_folder import GRAINS, MATTER_FILES, MESH_SPACE, SURFACE, BakedObject, BakeManifest
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..cache.torn_skin_file import write_torn_skin
from ..checksums import Checksum, file_sum, span_for
from ..constitutive import FLUID, SHAPED, RigidMaterial
from ..errors import Cancelled, InputError
from ..events import IsCancelled
from ..gaussians.splat_ply import read_splats, write_splats
from ..gaussians.splats import (
    Splats,
    as_points,
    bind_splats,
    deformed_half_axes,
    from_points,
    half_axes,
    transform_splats,
)
from ..npz import read_npy
from ..scene.folder import Scene
from ..scene.meshes import ObjectMesh
from ..scene.model import SceneObject
from ..skinning import bind, deform
from ..tearing.blocks import OPENING, Blocks, make_blocks, opening_times, regrouped, stretches
from ..tearing.cut_skin import TornMotion, tear
from .bake_options import BakeOptions
from .scene_to_world import PreparedWorld

if TYPE_CHECKING:
    from .simulation import Simulation


Array = NDArray[np.float64]


class Tears:
    """Writer of a body's torn skin: keeps particles while it bakes, cuts the skin at the end. Only for matter with a
    shape, which parts in pieces."""

    @classmethod
    def of(
        cls, simulation: Simulation, body: int, baked: BakedObject, mesh: ObjectMesh, mesh_from_world: Array | None
    ) -> Tears | None:
        """Return it for the body number ``body`` of ``simulation``; None for one that cannot tear in pieces."""
        found = simulation.world.bodies[body]
        materials = (found.material, *found.materials)
        if found.rigid or any(getattr(material, "cohesion", None) != SHAPED for material in materials):
            return None
        return cls(simulation, body, baked.name, mesh, mesh_from_world)

    def __init__(
        self, simulation: Simulation, body: int, name: str, mesh: ObjectMesh, mesh_from_world: Array | None
    ) -> None:
        self._world, self._body, self._name = simulation.world, body, name
        self._mesh, self._mesh_from_world = mesh, mesh_from_world
        found = self._world.bodies[body]
        self._rest = np.asarray(found.positions)
        self._plastic = any(getattr(material, "plastic", False) for material in (found.material, *found.materials))
        self._blocks: Blocks = make_blocks(self._rest, float(np.sum(found.volumes)))

    def record(self, out: Path, sample: int) -> None:
        """Keep the particles of ``sample``, the present one, where some are far apart. Raises InputError, OSError."""
        positions = self._world.positions(self._body)
        if sample == 0 or stretches(self._blocks, positions).max(initial=0.0) < OPENING:
            return
        gradients = self._world.deformation_gradients(self._body).reshape(-1, 9)
        with replacing(out / MATTER_FILES.format(name=self._name, sample=sample)) as partial:
            np.save(partial, np.concatenate([positions, gradients], axis=1).astype("<f4"))

    def _matter(self, out: Path, sample: int) -> tuple[Array, Array] | None:
        """Positions and gradients of the particles in ``sample``; None where they were not kept."""
        path = out / MATTER_FILES.format(name=self._name, sample=sample)
        shape = (len(self._rest), 12)
        if not path.exists():
            return None
        # Its shape is known, so nothing larger is read.
        numbers = read_npy(path, 4 * math.prod(shape))
        if numbers.shape != shape or numbers.dtype != np.dtype("<f4"):
            raise InputError(f"{path}: damaged, of shape {numbers.shape}; delete it, and bake again")
        numbers = numbers.astype(np.float64)
        return numbers[:, :3], numbers[:, 3:].reshape(-1, 3, 3)

    def finish(
        self, out: Path, baked: BakedObject, manifest: BakeManifest, cancelled: IsCancelled
    ) -> tuple[BakedObject, list[Checksum]] | None:
        """Write the torn skin of the complete bake ``out``; return ``baked`` with its files, and their checksums; None
        where nothing has parted. Raises Cancelled, InputError, OSError."""
        samples = range(manifest.frames)
        kept = [sample for sample in samples if (out / MATTER_FILES.format(name=self._name, sample=sample)).is_file()]
        if not kept:
            return None

        def read() -> Iterator[tuple[int, Array, Array | None]]:
            for sample in kept:
                if cancelled():
                    raise Cancelled("bake cancelled while skins were cut; run it again to continue")
                found = self._matter(out, sample)
                if found is not None:
                    yield sample, found[0], None if self._plastic else found[1]

        last = self._matter(out, kept[-1])
        blocks = self._blocks if last is None else regrouped(self._blocks, self._rest, last[0])
        opens = opening_times(blocks, read())
        motion = tear(self._mesh.vertices, self._mesh.faces, self._rest, blocks, opens)
        if motion is None:
            return None
        skin, name = motion.skin, f"{self._name}.torn"
        write_torn_skin(out / f"{name}.npz", skin)
        regular = Pc2Reader(out / baked.file)
        span = span_for(manifest.frames)
        with Pc2Writer(
            out / f"{name}.pc2", vertex_count=len(skin.parents), start_frame=manifest.frame_start, span=span
        ) as writer:
            for sample in samples:
                if cancelled():
                    raise Cancelled("bake cancelled while skins were cut; run it again to continue")
                writer.append(self._sample(out, sample, regular, motion, skin.first))
            sums = [writer.checksum(f"{name}.pc2", ended=True)]
        sums.append(Checksum(file=f"{name}.npz", sums=file_sum(out / f"{name}.npz")))
        count, first = len(skin.parents), skin.first
        torn = dataclasses.replace(baked, torn_file=f"{name}.pc2", torn_skin=f"{name}.npz", torn=count, torn_from=first)
        return torn, sums

    def _sample(self, out: Path, sample: int, regular: Pc2Reader, motion: TornMotion, first: int) -> Array:
        """The torn skin in ``sample``, in the space of the bake; while nothing has parted, the mesh's own vertices are
        the cache's to the bit."""
        matrix = self._mesh_from_world
        whole = regular.sample(sample).astype(np.float64)
        world = whole
        if matrix is not None:
            back = np.linalg.inv(matrix)
            world = whole @ back[:3, :3].T + back[:3, 3]
        if sample == 0:
            world = self._mesh.vertices
        matter = self._matter(out, sample) if sample >= first else None
        places: Array = motion.vertices(sample, world, *(matter or (None, None)))
        if matrix is not None:
            places = places @ matrix[:3, :3].T + matrix[:3, 3]
        if sample < first:
            places[: len(whole)] = whole
        return places


LEAST_BESIDE = 0.5
"""Share of the splats that must lie in the mesh's box, grown to three times its size; others are of something else."""


def load_object_splats(folder: Scene, item: SceneObject, mesh: ObjectMesh) -> Splats | None:
    """Return the splats of ``item``, whose mesh is ``mesh``, in the mesh file's own coordinates; None for one without.

    Raises InputError for a file that cannot be read, or whose splats lie far from the mesh.
    """
    if item.splats is None:
        return None
    splats = read_splats(folder.file(item.splats))
    low, high = mesh.in_file.min(axis=0), mesh.in_file.max(axis=0)
    reach = float((high - low).max())
    beside = ((splats.centres > low - reach) & (splats.centres < high + reach)).all(axis=1)
    if beside.mean() < LEAST_BESIDE:
        raise InputError(
            f"object {item.name}: {1 - beside.mean():.0%} of the splats in {item.splats} lie far from the mesh "
            f"{item.mesh}: both must be in the same coordinates; import the splats again (physgen import)"
        )
    return splats


class MovingSplats:
    """Splats of one object, as the points of ``moving.as_points`` (4N, 3).

    rest: in the mesh file's coordinates, which names their opacities and colours.
    """

    def __init__(self, rest: Splats, world_from_mesh: Array, vertices: Array, particles: Array | None) -> None:
        """vertices: (V, 3) of the mesh; particles: (P, 3), None for a collider; both at rest in the world."""
        self.rest = rest
        self._world = transform_splats(rest, world_from_mesh)
        self._vertices = vertices
        self._binding = None if particles is None else bind_splats(self._world, particles)

    def at_rest(self, *, in_world: bool) -> Array:
        """Return them in the world, or in the mesh file's coordinates, where they equal the file's to rounding."""
        splats = self._world if in_world else self.rest
        return as_points(splats.centres, half_axes(splats))

    def with_matter(self, positions: Array, gradients: Array) -> Array:
        """Return them in the world, moved by particles (P, 3) and their deformation gradients (P, 3, 3)."""
        assert self._binding is not None
        return as_points(*deformed_half_axes(self._world, self._binding, positions, gradients))

    def with_vertices(self, vertices: Array) -> Array:
        """Return them in the world, where the rigid motion that took the mesh to ``vertices`` (V, 3) takes them."""
        matrix = _affine_map(self._vertices, vertices)
        return self.at_rest(in_world=True) @ matrix[:3] + matrix[3]


def _affine_map(before: Array, after: Array) -> Array:
    """(4, 3) M with [before, 1] M = after in least squares; about the middle, so that places far away cost nothing."""
    middle = before.mean(axis=0)
    found = np.linalg.lstsq(np.column_stack([before - middle, np.ones(len(before))]), after, rcond=None)[0]
    found[3] -= middle @ found[:3]
    return np.asarray(found)


def baked_objects(
    folder: Scene,
    meshes: Sequence[ObjectMesh],
    splats: Sequence[Splats | None],
    prepared: PreparedWorld,
    options: BakeOptions,
) -> tuple[BakedObject, ...]:
    """Return the caches of a bake of the scene, one entry per object."""
    return tuple(
        _baked_object(item.name, len(mesh.vertices), len(seen or ()), prepared, slot, options)
        for slot, (item, mesh, seen) in enumerate(zip(folder.model.objects, meshes, splats, strict=True))
    )


def _baked_object(
    name: str, vertices: int, splats: int, prepared: PreparedWorld, slot: int, options: BakeOptions
) -> BakedObject:
    points = _points(prepared, slot) if options.points else 0
    index = prepared.body_of_object[slot]
    material = None if index is None else prepared.setup.bodies[index].material
    return BakedObject(
        name=name,
        file=f"{name}.pc2",
        vertices=vertices,
        space=options.space,
        points_file=f"{name}.points.pc2" if points else None,
        points=points,
        points_as=SURFACE if points and getattr(material, "cohesion", None) == FLUID else GRAINS,
        splats_file=f"{name}.splats.pc2" if splats else None,
        splats_folder=f"{name}.splats" if splats else None,
        splats=splats,
    )


def _points(prepared: PreparedWorld, slot: int) -> int:
    """Particles of object ``slot`` if it has no shape to return to, so that its skin can tear, else 0."""
    index = prepared.body_of_object[slot]
    if index is None:
        return 0
    body = prepared.setup.bodies[index]
    if isinstance(body.material, RigidMaterial):
        return 0
    return body.count if any(m.cohesion != SHAPED for m in (body.material, *body.materials)) else 0


class ObjectSampler:
    """Samples of object number ``slot`` of the scene, as ``baked`` says, at the present time of ``simulation``."""

    def __init__(
        self,
        slot: int,
        baked: BakedObject,
        mesh: ObjectMesh,
        splats: Splats | None,
        world_from_mesh: Array,
        simulation: Simulation,
    ) -> None:
        """splats: of the object in its mesh file's own coordinates."""
        self._slot = slot
        self._baked = baked
        self._mesh = mesh
        self._simulation = simulation
        self._body = simulation.body_of_object[slot]
        self._rest = simulation.rest_positions[slot]
        self._binding = None if self._rest is None else bind(mesh.vertices, self._rest)
        self._mesh_from_world = np.linalg.inv(world_from_mesh) if baked.space == MESH_SPACE else None
        self._splats = None if splats is None else MovingSplats(splats, world_from_mesh, mesh.vertices, self._rest)
        self.tears = (
            None if self._body is None else Tears.of(simulation, self._body, baked, mesh, self._mesh_from_world)
        )

    def samples(self, index: int) -> dict[str, Array]:
        """Return by file name the points of sample ``index``, (V, 3) or (N, 3) in the space of the bake.

        Sample 0 is the scene at rest to the last bit, so that it renders as the photo: the mesh's own vertices.
        """
        if index == 0:
            found = {self._baked.file: self._mesh.vertices if self._mesh_from_world is None else self._mesh.in_file}
        else:
            found = {self._baked.file: self._placed(self._vertices())}
        if self._baked.points_file is not None:
            assert self._body is not None and self._rest is not None
            points = self._rest if index == 0 else self._simulation.world.positions(self._body)
            found[self._baked.points_file] = self._placed(points)
        if self._splats is not None and self._baked.splats_file is not None:
            found[self._baked.splats_file] = self._splat_points(index)
        return found

    def write_splats(self, out: Path, frame: int, samples: Mapping[str, Array]) -> None:
        """Write the PLY file of ``frame`` into the bake folder ``out``; nothing for an object without splats.

        samples: what ``samples`` returned of that frame. Raises InputError when it cannot be written.
        """
        file = self._baked.splat_frame(frame)
        if self._splats is not None and self._baked.splats_file is not None and file is not None:
            write_splats(out / file, from_points(self._splats.rest, samples[self._baked.splats_file]))

    def _vertices(self) -> Array:
        moved = self._led_vertices()
        if moved is not None:
            return moved
        if self._binding is None or self._body is None:
            return self._mesh.vertices
        return deform(self._binding, *self._matter(self._body))

    def _led_vertices(self) -> Array | None:
        """Of a collider that moves."""
        return self._simulation.collider_vertices(self._slot)

    def _matter(self, body: int) -> tuple[Array, Array]:
        """Positions and deformation gradients of the body's particles."""
        world = self._simulation.world
        return world.positions(body), world.deformation_gradients(body)

    def _splat_points(self, index: int) -> Array:
        assert self._splats is not None
        if index == 0:
            return self._splats.at_rest(in_world=self._mesh_from_world is None)
        if self._body is not None:
            return self._placed(self._splats.with_matter(*self._matter(self._body)))
        return self._placed(self._splats.with_vertices(self._vertices()))

    def _placed(self, points: Array) -> Array:
        """World ``points`` (N, 3) in the space of the bake."""
        matrix = self._mesh_from_world
        return points if matrix is None else points @ matrix[:3, :3].T + matrix[:3, 3]
