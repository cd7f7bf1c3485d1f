# SPDX-License-Identifier: MIT
"""Small scenes that tests build from scratch."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import settings
from physgen.sim.scene.folder import SceneFolder, save_scene
from physgen.sim.scene.materials import load_preset
from physgen.sim.scene.model import Camera, Scene, SceneObject

# CI draws the same examples every time, so that a landing is not refused for what it did not touch; `make test`
# draws new ones.
settings.register_profile("ci", derandomize=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))


@pytest.fixture
def ball_scene(tmp_path):
    """A factory of scene folders with balls of 10 cm a little above the ground, 15 cm apart."""

    def make(*, preset="soft", velocity=(0.0, 0.0, 1.0), count=1, name="scene", height=0.052, **changes) -> SceneFolder:
        root = tmp_path / name
        (root / "meshes").mkdir(parents=True, exist_ok=True)
        items = []
        for index in range(count):
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
            mesh.apply_translation((0.15 * index, 0.0, height))
            mesh.export(root / f"meshes/ball{index}.glb")
            items.append(
                SceneObject(
                    name=f"ball{index}",
                    mesh=f"meshes/ball{index}.glb",
                    size_m=0.1,
                    material=load_preset(preset),
                    velocity=velocity,
                )
            )
        grey = np.full((40, 60, 3), 128, np.uint8)
        for file in ("photo.png", "background.png"):
            cv2.imwrite(str(root / file), grey)
        camera = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=LOOKING_AWAY)
        return save_scene(root, Scene(**{"camera": camera, "objects": tuple(items), **changes}))

    return make
