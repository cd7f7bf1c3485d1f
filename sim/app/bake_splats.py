# SPDX-License-Identifier: MIT
"""The splats of an object in a bake: read, and led by what leads the object's mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..gaussians.moving import as_points, bind_splats, half_axes, moved_half_axes, placed
from ..gaussians.ply.read import read_splats
from ..gaussians.splats import Splats
from ..scene.folder import SceneFolder
from ..scene.meshes import ObjectMesh
from ..scene.model import SceneObject

Array = NDArray[np.float64]

LEAST_BESIDE = 0.5
"""Share of the splats that must lie in the mesh's box, grown to three times its size; others are of something else."""


def load_object_splats(folder: SceneFolder, item: SceneObject, mesh: ObjectMesh) -> Splats | None:
    """The splats of ``item``, whose mesh is ``mesh``, in the mesh file's own coordinates; None for one without.

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
        """vertices: (V, 3) of the mesh; particles: (P, 3) of the matter, None for a collider; at rest in the world."""
        self.rest = rest
        self._world = placed(rest, world_from_mesh)
        self._vertices = vertices
        self._binding = None if particles is None else bind_splats(self._world, particles)

    def at_rest(self, *, in_world: bool) -> Array:
        """In the world, or in the mesh file's coordinates, where they are the file's own to rounding."""
        splats = self._world if in_world else self.rest
        return as_points(splats.centres, half_axes(splats))

    def with_matter(self, positions: Array, gradients: Array) -> Array:
        """In the world, where particles (P, 3) and their deformation gradients (P, 3, 3) have taken them."""
        assert self._binding is not None
        return as_points(*moved_half_axes(self._world, self._binding, positions, gradients))

    def with_vertices(self, vertices: Array) -> Array:
        """In the world, where the rigid motion that took the mesh to ``vertices`` (V, 3) takes them."""
        matrix = _affine_map(self._vertices, vertices)
        return self.at_rest(in_world=True) @ matrix[:3] + matrix[3]


def _affine_map(before: Array, after: Array) -> Array:
    """(4, 3) M with [before, 1] M = after in least squares; about the middle, so that places far away cost nothing."""
    middle = before.mean(axis=0)
    found = np.linalg.lstsq(np.column_stack([before - middle, np.ones(len(before))]), after, rcond=None)[0]
    found[3] -= middle @ found[:3]
    return np.asarray(found)
