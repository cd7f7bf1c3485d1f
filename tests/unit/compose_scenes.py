# SPDX-License-Identifier: MIT
"""Scenes of balls that touch, or do not."""

import dataclasses

import trimesh
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.model import Camera, SceneModel, SceneObject

LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=LOOKING_AWAY)


def a_scene(root, meshes, **changes):
    (root / "meshes").mkdir(parents=True)
    items = []
    for number, (name, mesh) in enumerate(meshes.items()):
        mesh.export(root / f"meshes/{name}.ply")
        made = SceneObject(name=name, mesh=f"meshes/{name}.ply", size_m=0.1, occlusion_order=len(meshes) - number)
        items.append(dataclasses.replace(made, **changes.get(name, {})))
    return save_scene(root, SceneModel(camera=CAMERA, objects=tuple(items), photo=None, background=None))


def ball(x, radius=0.05, z=0.05):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation((x, 0, z))
    return mesh
