# SPDX-License-Identifier: MIT
"""How each object looks without the photo's light on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.equirectangular import Radiance
from ..scene.model import Camera, Light
from .appearance.estimate import estimate_appearance
from .bodies import Body
from .layers import Layers
from .options import ObjectRequest
from .physics.apply import ObjectPhysics
from .shape.support import Mesh
from .shape.texture import TexturedSurface
from .stage_store import Arrays, Notice, StageStore
from .steps import Steps


@dataclass(frozen=True)
class Look:
    """albedo: (h, w, 3) uint8, laid out as the body's texture. roughness, metallic: of its shader, 0 to 1."""

    albedo: NDArray[np.uint8]
    roughness: float
    metallic: float


def estimate_looks(
    layers: Layers,
    view: Camera,
    bodies: Sequence[Body],
    objects: Sequence[ObjectRequest],
    physics: Sequence[ObjectPhysics],
    radiance: Radiance,
    light: Light,
    store: StageStore,
    steps: Steps,
) -> list[Look]:
    """Albedo, roughness and metallic of each of the ``bodies``, lit by ``radiance`` and the sun of ``light``."""
    looks = []
    for i, item in enumerate(objects):
        steps.begin(f"look of {item.name}")
        surface = bodies[i].surface
        others = [(body.surface.vertices, body.surface.faces) for j, body in enumerate(bodies) if j != i]
        inputs = {
            "pixels": layers.colours[i],
            "seen": layers.seen[i],
            "background": layers.background,
            "surface": [surface.vertices, surface.faces, surface.uv, surface.picture],
            "others": others,
            "radiance": radiance,
            "light": light,
            "view": view,
            "known": [item.name, physics[i].metallic, physics[i].appearance_roughness],
        }

        def look(notice: Notice, i: int = i, surface: TexturedSurface = surface, others: list[Mesh] = others) -> Arrays:
            appearance, albedo = estimate_appearance(
                view,
                surface,
                layers.seen[i],
                layers.colours[i],
                layers.background,
                others,
                radiance,
                light,
                physics[i],
                notice,
                objects[i].name or "",
            )
            return {"albedo": albedo, "numbers": np.array([appearance.roughness, appearance.metallic])}

        made = store.run("look", inputs, look)
        roughness, metallic = (float(v) for v in made["numbers"])
        looks.append(Look(made["albedo"], roughness, metallic))
    return looks
