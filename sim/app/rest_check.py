# SPDX-License-Identifier: MIT
"""Whether the objects of a scene stay where they are when it is baked: the engine's own rule, without running it."""

from __future__ import annotations

from ..errors import InputError
from ..mpm.sleeping import Sleepers
from ..scene.bake_quality import COARSEST
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from .bake_options import BakeOptions
from .world_setup import prepare_world


def rest_notices(folder: Scene) -> list[str]:
    """Return a sentence for each object of ``folder`` that is said to be asleep and would move by itself.

    It is judged as a bake judges it (``sim/mpm/sleeping.py``), with the particles of the coarsest quality: by what
    carries the object and where its centre of mass is. Objects that are thrown, or driven, are not judged. Nothing is
    said of a scene that cannot be baked; the bake says why.
    """
    try:
        meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
        prepared = prepare_world(folder, meshes, BakeOptions(frames=2, quality=COARSEST))
    except InputError:
        return []
    sleepers = Sleepers(prepared.setup, prepared.solver.cell_size(prepared.similarity))
    return [
        f"{body.name}: will not stay where the photo shows it, because nothing carries its centre of mass; check its "
        "mask and the horizon, give another shape or a larger thickness, or make it a collider (role)"
        for body, wants, sleeps in zip(prepared.setup.bodies, sleepers.wanting, sleepers.asleep, strict=True)
        if wants and not sleeps
    ]
