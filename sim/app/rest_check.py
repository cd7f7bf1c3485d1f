# SPDX-License-Identifier: MIT
"""Whether the objects of a scene stay where they are when it is baked: the engine's own rule, without running it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from ..errors import InputError
from ..mpm.sleeping import Sleepers
from ..scene.bake_quality import COARSEST
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from ..scene.model import SceneModel
from .bake_options import BakeOptions
from .world_setup import prepare_world

STILL = (0.0, 0.0, 0.0)


def at_rest(folder: Scene, notice: Callable[[str], None]) -> SceneModel:
    """Return the model of ``folder`` in which whatever is said to be asleep stays where it is: what nothing carries is
    held.

    It is judged as a bake judges it (``sim/mpm/sleeping.py``), with the particles of the coarsest quality and before
    anything is thrown: by what carries the object and where its centre of mass is. ``notice`` receives a sentence for
    each object that is held. A scene that cannot be baked is returned as it is; the bake says why.
    """
    model = folder.model
    calm = tuple(dataclasses.replace(item, velocity=STILL, spin=STILL) for item in model.objects)
    scene = Scene(root=folder.root, model=dataclasses.replace(model, objects=calm))
    try:
        meshes = [load_object_mesh(scene, item) for item in calm]
        prepared = prepare_world(scene, meshes, BakeOptions(frames=2, quality=COARSEST))
    except InputError:
        return model
    sleepers = Sleepers(prepared.setup, prepared.solver.cell_size(prepared.similarity))
    restless = {
        body.name
        for body, wants, sleeps in zip(prepared.setup.bodies, sleepers.wanting, sleepers.asleep, strict=True)
        if wants and not sleeps
    }
    for name in sorted(restless):
        notice(
            f"{name}: nothing carries its centre of mass, as if it hung or leaned; it is held where the photo shows it "
            f"until something touches it (--set {name}.held=false lets it go). If it stands by itself, check its mask "
            "and the horizon, or give another shape or a larger thickness"
        )
    objects = tuple(dataclasses.replace(item, held=item.held or item.name in restless) for item in model.objects)
    return dataclasses.replace(model, objects=objects)
