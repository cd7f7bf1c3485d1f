# SPDX-License-Identifier: MIT
"""What a bake will cost, without baking: the scene is sampled and checked as for the bake itself."""

from __future__ import annotations

from ..scene.folder import SceneFolder
from ..scene.meshes import load_object_mesh
from .bake_inputs import BakeOptions
from .setup_world import PreparedWorld, prepare_world


def estimate_bake(folder: SceneFolder, options: BakeOptions) -> PreparedWorld:
    """The world that a bake of ``folder`` would begin with; its ``cost`` is the answer.

    Raises InputError as ``setup_world.prepare_world`` does; ``require_affordable`` says what the bake would refuse.
    """
    meshes = [load_object_mesh(folder, item) for item in folder.scene.objects]
    return prepare_world(folder, meshes, options)
