# SPDX-License-Identifier: MIT
"""A user's mesh in the place of a body from the outline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...scene.meshes import read_mesh
from ...scene.model import Camera
from ..options import UP_AXES, Pixel
from ..shape.texture import TexturedSurface
from .alignment import Pose, align
from .mending import mend
from .reprojection import reprojected
from .sampled import Mask

POOR = 0.8
"""Overlap of outlines below which the mesh is said not to look like the object."""
UNCLEAR = 0.015
"""Cost of another turn over that of the best, below which the turn is said to be a guess."""
USUAL_UPS = {".glb": ("+y",), ".gltf": ("+y",)}
"""Formats whose specification says which axis points up; elsewhere all are tried, the most common first."""
ALL_UPS = ("+y", "+z", "-y", "-z", "+x", "-x")


@dataclass(frozen=True)
class FittedMesh:
    """surface: in the camera's unit, standing on z = 0. pose: where the file's mesh went."""

    surface: TexturedSurface
    pose: Pose


def fit_mesh(
    path: Path,
    camera: Camera,
    seen: Mask,
    full: Mask,
    pixels: NDArray[np.uint8],
    *,
    name: str,
    up: str,
    points: tuple[tuple[tuple[float, float, float], Pixel], ...],
    notice: Callable[[str], None],
) -> FittedMesh:
    """The mesh at ``path``, mended, standing where the photo shows the object, with the photo's colours.

    camera: 1 unit above z = 0. seen, full: (H, W) what is visible of the object, and its completed outline, which is
    not trusted beyond ``seen``. pixels: (H, W, 3) the photo. up: one of ``UP_AXES``. points: places on the mesh and the
    pixels of ``pixels`` that show them. Raises InputError for a file that cannot be read or a mesh without extent.
    """
    assert up in UP_AXES
    mesh = mend(read_mesh(path), name, notice)
    ups = (up,) if up != "auto" else USUAL_UPS.get(path.suffix.lower(), ALL_UPS)
    pose = align(
        camera,
        seen,
        full & ~seen,
        mesh.vertices,
        mesh.faces,
        ups=ups,
        points=points,
        colours=mesh.colours,
        pixels=pixels,
    )
    if pose.overlap < POOR and up == "auto" and len(ups) == 1:
        # A file may say what it likes: exporters forget to turn their axes.
        other = align(
            camera, seen, full & ~seen, mesh.vertices, mesh.faces,
            ups=ALL_UPS, points=points, colours=mesh.colours, pixels=pixels,
        )  # fmt: skip
        if other.overlap > pose.overlap + 0.05:
            notice(f"{name}: the mesh lies on its side by its format; its axis {other.up} is taken to point up")
            pose = other
    _say(pose, name, notice)
    return FittedMesh(reprojected(camera, mesh, pose.place(mesh.vertices), seen, pixels), pose)


def _say(pose: Pose, name: str, notice: Callable[[str], None]) -> None:
    message = f"{name}: its mesh covers its outline by {100 * pose.overlap:.0f} %"
    if pose.overlap < POOR:
        notice(f"{message}: it may be of another thing or turned wrongly; give mesh_up or a few mesh_points")
    elif pose.clear < UNCLEAR:
        notice(f"{message}, and so it does turned otherwise; a few mesh_points settle which way it faces")
    else:
        notice(message)
