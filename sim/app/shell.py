# SPDX-License-Identifier: MIT
"""Hollow bodies: of the particles that fill a mesh, those near its surface."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from trimesh.remesh import subdivide_to_size
from trimesh.triangles import closest_point

from ..errors import InputError
from ..mpm.sampling import MIN_PARTICLES, InteriorSample
from ..scene.meshes import ObjectMesh

SHELL_CELLS = 2.0
"""Thickness in grid cells of a shell whose object does not say one: the thinnest that bends about as it should."""


def keep_shell(sample: InteriorSample, mesh: ObjectMesh, thickness: float, spacing: float) -> InteriorSample:
    """The particles of ``sample`` whose middle is within ``thickness`` m of the surface of ``mesh``.

    The inside is empty: mass and inertia are the shell's, and nothing but the shell resists bending and pressure. The
    volume is right to about half a particle ``spacing`` of thickness. Raises InputError for a shell thinner than the
    spacing, which would have holes.
    """
    if thickness < spacing:
        raise InputError(
            f"shell_thickness is {thickness:g} m: give {spacing:.2g} m (the particle spacing) or more, or bake finer"
        )
    points, faces, owners = subdivide_to_size(
        mesh.vertices, mesh.faces, max_edge=max(spacing, 1e-9), max_iter=24, return_index=True
    )
    nearest = cKDTree(points[faces].mean(axis=1)).query(sample.positions)[1]
    triangles = mesh.vertices[mesh.faces[owners[nearest]]]
    distance = np.linalg.norm(closest_point(triangles, sample.positions) - sample.positions, axis=1)
    keep = distance <= thickness
    if int(keep.sum()) < MIN_PARTICLES:
        raise InputError(f"shell_thickness is {thickness:g} m: that leaves {int(keep.sum())} particles; give more")
    return InteriorSample(
        positions=sample.positions[keep], volumes=sample.volumes[keep], contact_radii=sample.contact_radii[keep]
    )
