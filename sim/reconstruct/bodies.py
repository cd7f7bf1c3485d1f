# SPDX-License-Identifier: MIT
"""A body for each outline: a primitive, an inflated one, or a mesh that somebody brought; and what stands on what."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.model import Camera
from .adapters.names import adapter_content
from .adapters.protocols import Mesher
from .adapters.resolve import resolve
from .given.build import fit_mesh
from .layers import Layers
from .options import ObjectRequest, ReconstructOptions
from .shape.build import build_body
from .shape.inflate import inflate
from .shape.mesh import bare_mesh
from .shape.support import Mesh, place_on_supports
from .shape.texture import TexturedSurface, crop_texture, worn
from .stage_store import Arrays, Notice, StageStore
from .steps import Steps

Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8]

GIVEN = "mesh"
"""The shape of what was not made from the outline."""


@dataclass(frozen=True)
class Body:
    """surface: closed, in the unit of the camera over z = 0. shape: what it was taken for, or ``GIVEN``."""

    surface: TexturedSurface
    shape: str

    @property
    def extent(self) -> float:
        """Largest extent along the world's axes, in the camera's unit."""
        return float(np.ptp(self.surface.vertices, axis=0).max())


def make_bodies(
    layers: Layers,
    view: Camera,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    store: StageStore,
    steps: Steps,
) -> list[Body]:
    """The bodies of ``objects``, whose names and kinds are settled, each where the photo shows it.

    Raises InputError for an outline or mesh that no body can be made from.
    """
    mesher = None if options.mesher is None else resolve("mesher", options.mesher, steps.cancelled)
    bodies = []
    for i, item in enumerate(objects):
        steps.begin(f"mesh {item.name}")
        full, seen, colours = layers.full[i], layers.seen[i], layers.colours[i]
        inputs = {"full": full, "seen": seen, "pixels": colours, "view": view, "name": item.name}
        if item.mesh is None and mesher is None:
            fields = {name: getattr(item, name) for name in ("kind", "shape", "back", "thickness")}
            made = store.run(
                "mesh",
                {**inputs, **fields, "vertices": options.mesh_vertices},
                partial(_built, view, full, seen, colours, item, options),
            )
        else:
            told = {"up": item.mesh_up, "points": item.mesh_points, "mesher": adapter_content("mesher", options.mesher)}
            file = None if item.mesh is None else _content(item.mesh)
            made = store.run(
                "fit", {**inputs, **told, "file": file}, partial(_fitted, view, full, seen, colours, item, mesher)
            )
        surface = TexturedSurface(made["vertices"], made["faces"], made["uv"], made["picture"])
        bodies.append(Body(surface, str(made["shape"])))
    return _on_supports(view, layers.seen, bodies, objects, steps.notice)


def _content(path: Path) -> NDArray[np.uint8]:
    try:
        return np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check its name") from None


def _arrays(surface: TexturedSurface, shape: str) -> Arrays:
    return {
        "vertices": surface.vertices,
        "faces": surface.faces,
        "uv": surface.uv,
        "picture": surface.picture,
        "shape": np.array(shape),
    }


def _built(
    view: Camera,
    full: Mask,
    seen: Mask,
    colours: Pixels,
    item: ObjectRequest,
    options: ReconstructOptions,
    notice: Notice,
) -> Arrays:
    body = build_body(view, full, item, options, notice, seen=seen, pixels=colours)
    return _arrays(worn(body.mesh, crop_texture(colours, full)), body.shape)


def _fitted(
    view: Camera,
    full: Mask,
    seen: Mask,
    colours: Pixels,
    item: ObjectRequest,
    mesher: Mesher | None,
    notice: Notice,
) -> Arrays:
    with tempfile.TemporaryDirectory(prefix="physgen-mesh-") as place:
        path = item.mesh
        if path is None:
            assert mesher is not None
            path = mesher(colours, full, Path(place))
        fitted = fit_mesh(
            path,
            view,
            seen,
            full,
            colours,
            name=item.name or "object",
            up=item.mesh_up,
            points=item.mesh_points,
            notice=notice,
        )
    return _arrays(fitted.surface, GIVEN)


def _on_supports(
    view: Camera, seen: Sequence[Mask], bodies: Sequence[Body], objects: Sequence[ObjectRequest], notice: Notice
) -> list[Body]:
    """``bodies``, those on other bodies brought there."""
    placed = list(bodies)
    for found in place_on_supports(view, seen, [(body.surface.vertices, body.surface.faces) for body in bodies]):
        surface = placed[found.upper].surface
        vertices = view.position + found.factor * (surface.vertices - view.position)
        placed[found.upper] = replace(placed[found.upper], surface=replace(surface, vertices=vertices))
        notice(f"{objects[found.upper].name} stands on {objects[found.lower].name}; it is placed there")
    return placed


def casters(view: Camera, full: Sequence[Mask], bodies: Sequence[Body]) -> list[Mesh]:
    """What throws the shadows: an inflated body stands where it can, its bare outline where the photo shows it."""
    result = []
    for mask, body in zip(full, bodies, strict=True):
        if body.shape == "inflated":
            bare = bare_mesh(view, inflate(mask))
            result.append((bare.vertices, bare.faces))
        else:
            result.append((body.surface.vertices, body.surface.faces))
    return result
