# SPDX-License-Identifier: MIT
"""The estimates that make a scene, and the files that hold them: pictures, meshes, and the scene that names both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..scene.model import Camera, Ground, Light, SceneModel, SceneObject
from .appearance.appearance_estimate import ObjectAppearance
from .camera import ground_camera as cameras
from .lighting.ground_gloss import GroundGloss
from .photo_layers import Layers
from .reasoning.material_decision import ObjectPhysics, to_material
from .reconstruct_options import ObjectRequest
from .shape.body_texture import glb_bytes, world_from_gltf
from .shape.object_bodies import Body


@dataclass(frozen=True, kw_only=True)
class SceneEstimate:
    """The estimates that make a scene, lengths in the unit of ``view``; lists in the order of the objects.

    metres: per unit. view: camera above z = 0.
    """

    pixels: NDArray[np.uint8]
    layers: Layers
    view: Camera
    bodies: Sequence[Body]
    metres: float
    light: Light
    looks: Sequence[ObjectAppearance]
    gloss: GroundGloss


def write_scene(
    folder: Path,
    found: SceneEstimate,
    objects: Sequence[ObjectRequest],
    physics: Sequence[ObjectPhysics],
    friction: float,
) -> SceneModel:
    """Write all files except the light's and ``scene.json`` into ``folder``; return the scene that refers to them.

    objects: with their names. physics: material of each. friction: of the ground.
    """
    names = [item.name or "" for item in objects]
    layers = found.layers
    for sub in ("masks", "shadows", "holes", "meshes", "albedo", "shading"):
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
        surface, look = found.bodies[i].surface, found.looks[i]
        if surface.shading is not None:
            save_png(folder / "shading" / f"{name}.png", surface.shading)
        save_png(folder / "albedo" / f"{name}.png", look.albedo)
        content = glb_bytes(surface, bases[i], found.metres, roughness=look.roughness, metallic=look.metallic)
        (folder / "meshes" / f"{name}.glb").write_bytes(content)
    origin = bases[0] * (1.0, 1.0, 0.0)
    return SceneModel(
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
                asleep=True,
                occlusion_order=layers.front_to_back.index(i),
                mask=f"masks/{name}.png",
                shadow=f"shadows/{name}.png",
                shading=None if found.bodies[i].surface.shading is None else f"shading/{name}.png",
            )
            for i, name in enumerate(names)
        ),
        ground=Ground(
            friction=friction,
            reflectivity=found.gloss.reflectivity,
            reflection_roughness=found.gloss.roughness,
        ),
        light=found.light,
    )


def _base_centre(body: Body) -> NDArray[np.float64]:
    """Centre (3,) of the part that rests on the ground or another object, in the body's unit."""
    vertices = body.surface.vertices
    bottom = float(vertices[:, 2].min())
    low = vertices[vertices[:, 2] <= bottom + 1e-6 * np.ptp(vertices[:, 2]) + 1e-12]
    return np.array([*((low[:, :2].min(axis=0) + low[:, :2].max(axis=0)) / 2.0), bottom])


def save_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write ``pixels`` (H, W) or (H, W, 3) as a PNG."""
    Image.fromarray(pixels).save(path, format="PNG", compress_level=4)
