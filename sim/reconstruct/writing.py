# SPDX-License-Identifier: MIT
"""The scene folder's files: pictures, masks, meshes, and the scene that names them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..scene.model import Camera, Ground, Light, Scene, SceneObject
from .bodies import Body
from .layers import Layers
from .looks import Look
from .options import ObjectRequest
from .physics.apply import ObjectPhysics, to_material
from .shape.texture import glb_bytes, world_from_gltf
from .view import camera as cameras


@dataclass(frozen=True, kw_only=True)
class Found:
    """All that is known of the photo, lengths in the unit of ``view``; lists in the order of the objects.

    metres: of that unit. view: camera over z = 0.
    """

    pixels: NDArray[np.uint8]
    layers: Layers
    view: Camera
    bodies: Sequence[Body]
    metres: float
    light: Light
    looks: Sequence[Look]


def write_scene(
    folder: Path,
    found: Found,
    objects: Sequence[ObjectRequest],
    physics: Sequence[ObjectPhysics],
    friction: float,
) -> Scene:
    """Write all files but the light's and ``scene.json`` into ``folder``; the scene that names them.

    objects: with their names. physics: what each is made of. friction: of the ground.
    """
    names = [item.name or "" for item in objects]
    layers = found.layers
    for sub in ("masks", "shadows", "holes", "meshes", "albedo"):
        (folder / sub).mkdir()
    save_png(folder / "photo.png", found.pixels)
    save_png(folder / "background.png", layers.background)
    bases = [_base_centre(body) for body in found.bodies]
    for i, name in enumerate(names):
        for sub, layer in (("masks", layers.seen[i]), ("shadows", layers.shadows[i]), ("holes", layers.holes[i])):
            save_png(folder / sub / f"{name}.png", layer.astype(np.uint8) * 255)
        if (layers.full[i] != layers.seen[i]).any():
            (folder / "full").mkdir(exist_ok=True)
            save_png(folder / "full" / f"{name}.png", layers.full[i].astype(np.uint8) * 255)
        look = found.looks[i]
        save_png(folder / "albedo" / f"{name}.png", look.albedo)
        content = glb_bytes(
            found.bodies[i].surface, bases[i], found.metres, roughness=look.roughness, metallic=look.metallic
        )
        (folder / "meshes" / f"{name}.glb").write_bytes(content)
    origin = bases[0] * (1.0, 1.0, 0.0)
    return Scene(
        camera=cameras.scaled_to_metres(found.view, origin, found.metres),
        objects=tuple(
            SceneObject(
                name=name,
                mesh=f"meshes/{name}.glb",
                world_from_mesh=world_from_gltf((bases[i] - origin) * found.metres),
                size_m=found.bodies[i].extent * found.metres,
                material=to_material(physics[i]),
                fill=physics[i].fill,
                roughness=physics[i].roughness,
                velocity=objects[i].velocity,
                spin=objects[i].spin,
                occlusion_order=layers.front_to_back.index(i),
                mask=f"masks/{name}.png",
                shadow=f"shadows/{name}.png",
            )
            for i, name in enumerate(names)
        ),
        ground=Ground(friction=friction),
        light=found.light,
    )


def _base_centre(body: Body) -> NDArray[np.float64]:
    """Middle (3,) of the part that rests on the ground or another object, in the body's unit."""
    vertices = body.surface.vertices
    bottom = float(vertices[:, 2].min())
    low = vertices[vertices[:, 2] <= bottom + 1e-6 * np.ptp(vertices[:, 2]) + 1e-12]
    return np.array([*((low[:, :2].min(axis=0) + low[:, :2].max(axis=0)) / 2.0), bottom])


def save_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write ``pixels`` (H, W) or (H, W, 3), losslessly."""
    Image.fromarray(pixels).save(path, format="PNG", compress_level=4)
