# SPDX-License-Identifier: MIT
"""Things that a photo does not show and that fall into it: a ball, a block, or a mesh of the user's own."""

from __future__ import annotations

import dataclasses
import io
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..errors import InputError
from ..folder_lock import lock_beside
from ..scene.folder import Scene
from ..scene.material import load_preset
from ..scene.meshes import read_mesh
from ..scene.model import SceneObject, Vector
from ..validation import finite, quantity, require, require_quantities

if TYPE_CHECKING:
    import trimesh
    from PIL import Image

SHAPES = ("ball", "block", "mesh")
TEXTURE_PX = 128
GRAIN = 5.0
"""Spread of a plain surface's brightness, of 255: without any, a thing looks computed among photographed ones."""


@dataclass(frozen=True, kw_only=True)
class Drop:
    """One thing that falls in. World frame of a reconstructed scene: metres, x right, y away, z up from the ground.

    name: as of any object. shape: ``ball``, ``block`` with rounded edges, or ``mesh``. size_m: largest extent, 1e-4 to
    1e3 m; a mesh file is scaled to it. place: of its centre at the start; outside the picture, or the first frame is
    not the photo. velocity, spin: m/s, rad/s. preset: material. colours: sRGB, 0 to 255; a second one makes stripes.
    mesh: GLB, OBJ, PLY or STL file of the shape ``mesh``, z up, with its own texture or in the first colour.
    """

    name: str
    shape: str = "ball"
    size_m: float = quantity(0.05, 1e-4, 1e3, "metres")
    place: Vector = (0.0, 0.0, 0.5)
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    preset: str = "medium"
    colours: tuple[Vector, ...] = ((200.0, 60.0, 40.0),)
    mesh: Path | None = None

    def __post_init__(self) -> None:
        require(self.shape in SHAPES, f"{self.name}: shape", self.shape, f"choose one of {', '.join(SHAPES)}")
        require(
            (self.shape == "mesh") == (self.mesh is not None), f"{self.name}: mesh", self.mesh, "give a file or not"
        )
        require_quantities(self, f"{self.name}: ")
        for field, value in (("place", self.place), ("velocity", self.velocity), ("spin", self.spin)):
            require(finite(*value), f"{self.name}: {field}", value, "give three finite numbers")
        good = 1 <= len(self.colours) <= 2 and all(0 <= part <= 255 for colour in self.colours for part in colour)
        require(good, f"{self.name}: colours", self.colours, "give one or two colours of three numbers from 0 to 255")


def add_drops(scene: Scene, drops: Sequence[Drop]) -> Scene:
    """Return ``scene`` with ``drops``, saved; what was dropped under the same names before is replaced.

    Raises InputError for a name that the scene's own objects have, an unknown preset, an unreadable mesh, or a scene
    that another process is changing; nothing is written then.
    """
    with lock_beside(scene.root):
        return _dropped(scene, drops)


def _dropped(scene: Scene, drops: Sequence[Drop]) -> Scene:
    names = [drop.name for drop in drops]
    own = [item for item in scene.objects if item.name not in names or item.mask is not None]
    if taken := [item.name for item in own if item.name in names] or sorted({n for n in names if names.count(n) > 1}):
        raise InputError(f"{taken[0]}: is the name of another object; choose another name for the dropped one")
    made = [(drop, load_preset(drop.preset), _mesh(drop)) for drop in drops]
    items: list[SceneObject] = []
    for drop, material, (vertices, content) in made:
        file = f"meshes/dropped_{drop.name}.glb"
        scale = drop.size_m / float(np.ptp(vertices, axis=0).max())
        middle = (vertices.max(axis=0) + vertices.min(axis=0)) / 2.0
        pose = np.diag([scale, scale, scale, 1.0])
        pose[:3, 3] = np.asarray(drop.place) - scale * middle
        items.append(
            SceneObject(
                name=drop.name,
                mesh=file,
                world_from_mesh=tuple(tuple(float(v) for v in row) for row in pose),  # type: ignore[misc]
                size_m=drop.size_m,
                material=material,
                velocity=drop.velocity,
                spin=drop.spin,
                occlusion_order=len(own) + len(items),
            )
        )
        target = scene.file(file)
        target.parent.mkdir(exist_ok=True)
        with replacing(target) as partial:
            if isinstance(content, Path):
                shutil.copyfile(content, partial)
            else:
                partial.write_bytes(content)
    model = dataclasses.replace(scene.model, objects=(*own, *items))
    return scene.with_model(model) if model == scene.model else scene.with_model(model).save()


def _mesh(drop: Drop) -> tuple[NDArray[np.float64], bytes | Path]:
    """Return the vertices (V, 3) of a drop's mesh, in its file's units, and the GLB file: its bytes, or a path."""
    import trimesh

    if drop.mesh is not None:
        given = read_mesh(drop.mesh)
        vertices, faces = np.asarray(given.vertices), np.asarray(given.faces)
        if drop.mesh.suffix.lower() == ".glb":
            return vertices, drop.mesh
    else:
        body = trimesh.creation.icosphere(subdivisions=4) if drop.shape == "ball" else _block()
        vertices, faces = np.asarray(body.vertices), np.asarray(body.faces)
    visual = trimesh.visual.TextureVisuals(uv=_around(vertices), image=_picture(drop))
    shaped = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
    buffer = io.BytesIO()
    shaped.export(buffer, file_type="glb")
    return vertices, buffer.getvalue()


def _block(rounding: float = 0.16, steps: int = 4) -> trimesh.Trimesh:
    """Return a cube with edge 2 whose edges are rounded by ``rounding``."""
    import trimesh

    cube = trimesh.creation.box((2.0, 2.0, 2.0))
    for _ in range(steps):
        cube = cube.subdivide()
    inner = np.clip(cube.vertices, -1.0 + rounding, 1.0 - rounding)
    out = cube.vertices - inner
    length = np.linalg.norm(out, axis=1, keepdims=True)
    cube.vertices = inner + np.where(length > 0, rounding * out / np.maximum(length, 1e-9), 0.0)
    return cube


def _around(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return texture coordinates (V, 2) by direction from the centre; mirrored halves, so that no seam shows."""
    x, y, z = (vertices - vertices.mean(axis=0)).T
    azimuth = np.abs(np.arctan2(y, x)) / np.pi
    return np.stack([azimuth, 0.5 + np.arctan2(z, np.hypot(x, y)) / np.pi], axis=1)


def _picture(drop: Drop) -> Image.Image:
    """Return the texture: one colour, or stripes from pole to pole, with a little grain."""
    from PIL import Image

    random = np.random.default_rng(0)
    column = np.arange(TEXTURE_PX) * 4 // TEXTURE_PX % len(drop.colours)
    rows = np.asarray(drop.colours, dtype=np.float64)[column][None].repeat(TEXTURE_PX, axis=0)
    grained = rows + GRAIN * random.standard_normal((TEXTURE_PX, TEXTURE_PX, 1))
    return Image.fromarray(np.clip(grained, 0, 255).astype(np.uint8))
