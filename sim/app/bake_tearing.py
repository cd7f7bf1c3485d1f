# SPDX-License-Identifier: MIT
"""Torn skins of a bake: particles are kept while they are far apart; at the end skins are cut where they parted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..cache.bake_folder import MATTER_FILES, BakedObject, BakeManifest
from ..cache.checksums import Checksum, file_sum, span_for
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..cache.torn_skins import write_torn_skin
from ..constitutive import SHAPED
from ..errors import Cancelled, InputError
from ..events import IsCancelled
from ..npz import read_npy
from ..scene.meshes import ObjectMesh
from ..tearing.blocks import OPENING, Blocks, make_blocks, opening_times, regrouped, stretches
from ..tearing.torn_skin import TornMotion, tear

if TYPE_CHECKING:
    from .simulation import Simulation

Array = NDArray[np.float64]


class Tears:
    """What a body of a bake has to say about its skin's tears; of matter that has a shape, and so parts in pieces."""

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
