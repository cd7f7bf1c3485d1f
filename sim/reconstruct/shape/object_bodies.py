# SPDX-License-Identifier: MIT
"""A body for each object, from its outline, a user's mesh or a mesher, placed on what supports it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...atomic import scratch_prefix
from ...errors import InputError
from ...files import read_bytes
from ...scene.meshes import MAX_MESH_BYTES
from ...scene.model import Camera
from ...trust import trusted_spec
from ..adapters.adapter_registry import adapter_content
from ..adapters.protocols import Mesher
from ..adapters.resolve import resolve
from ..camera.depth_map import DepthMap
from ..photo_layers import Layers
from ..reconstruct_options import ObjectRequest, ReconstructOptions
from ..segmentation.matting import foreground_colours, soft_alpha
from ..stage_cache import Arrays, Notice, StageCache, Steps
from ..user_mesh.fit_user_mesh import fit_mesh
from .body_texture import TexturedSurface, crop_texture
from .built_body import build_body
from .inflate import inflate
from .inflated_mesh import shadow_mesh
from .object_placement import PlacedBody, TriangleMesh, hung, place_on_supports, separate, turned_view
from .texture_atlas import textured_body

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Pixels = NDArray[np.uint8]

USER_MESH = "mesh"
"""Shape name of a body that comes from a user's mesh or a mesher."""


@dataclass(frozen=True)
class Body:
    """surface: closed, in the camera's unit, standing on z = 0 or a support, or hanging. shape: a primitive's name,
    ``inflated``, ``built_body.LYING`` or ``USER_MESH``. turned: the view in which it was made if it hangs."""

    surface: TexturedSurface
    shape: str
    turned: Camera | None = None

    @property
    def extent(self) -> float:
        """Return the largest extent along the world's axes, in the camera's unit."""
        return float(np.ptp(self.surface.vertices, axis=0).max())

    @property
    def size(self) -> tuple[float, float]:
        """Return width, the mean of both directions, and height, in the camera's unit."""
        x, y, z = (float(v) for v in np.ptp(self.surface.vertices, axis=0))
        return (x * y) ** 0.5, z


def make_bodies(
    layers: Layers,
    view: Camera,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    store: StageCache,
    steps: Steps,
    *,
    depth: DepthMap | None = None,
) -> list[Body]:
    """Return the bodies of ``objects``, whose names and kinds are resolved, each where the photo shows it.

    depth: a depth map of the photo, which shapes the fronts of inflated bodies. Raises InputError for an outline or
    mesh that no body can be made from.
    """
    mesher = None if options.mesher is None else resolve("mesher", trusted_spec(options.mesher), steps.cancelled)
    bodies = []
    for i, item in enumerate(objects):
        steps.begin(f"mesh {item.name}")
        full, seen, colours = layers.full[i], layers.seen[i], layers.colours[i]
        turned = turned_view(view, full)
        own, own_depth = (view, depth) if turned is None else (turned, None)
        inputs = {"full": full, "seen": seen, "pixels": colours, "view": own, "name": item.name}
        if item.mesh is None and mesher is None:
            fields = {name: getattr(item, name) for name in ("kind", "shape", "back", "thickness")}
            others = np.logical_or.reduce([np.zeros_like(full), *layers.seen[:i], *layers.seen[i + 1 :]])
            if own_depth is not None:
                fields |= {"depth": own_depth.values, "disparity": own_depth.disparity, "others": others}
            made = store.run(
                "mesh",
                {**inputs, **fields, "vertices": options.mesh_vertices},
                partial(_built, own, full, seen, colours, item, options, own_depth, others),
            )
        else:
            given = {
                "up": item.mesh_up,
                "points": item.mesh_points,
                "mesher": adapter_content("mesher", options.mesher),
            }
            file = None if item.mesh is None else _content(item.mesh)
            made = store.run(
                "fit", {**inputs, **given, "file": file}, partial(_fitted, own, full, seen, colours, item, mesher)
            )
        soft, shading = made.get("alpha"), made.get("shading")
        surface = TexturedSurface(made["vertices"], made["faces"], made["uv"], made["picture"], soft, shading)
        bodies.append(Body(surface, str(made["shape"]), turned))
    bodies = _on_supports(view, layers.seen, bodies, objects, steps.notice)
    return _separated(view, layers.front_to_back, bodies, objects, steps.notice)


def _content(path: Path) -> NDArray[np.uint8]:
    try:
        return np.frombuffer(read_bytes(path, MAX_MESH_BYTES, what="mesh"), dtype=np.uint8)
    except FileNotFoundError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check its name") from None


def _arrays(surface: TexturedSurface, shape: str) -> Arrays:
    return {
        "vertices": surface.vertices,
        "faces": surface.faces,
        "uv": surface.uv,
        "picture": surface.picture,
        "shape": np.array(shape),
        **({} if surface.alpha is None else {"alpha": surface.alpha}),
        **({} if surface.shading is None else {"shading": surface.shading}),
    }


def _built(
    view: Camera,
    full: Mask,
    seen: Mask,
    colours: Pixels,
    item: ObjectRequest,
    options: ReconstructOptions,
    depth: DepthMap | None,
    others: Mask,
    notice: Notice,
) -> Arrays:
    body = build_body(view, full, item, options, notice, seen=seen, pixels=colours, depth=depth, others=others)
    alpha = soft_alpha(colours, full, others=others)
    # Where something else hides the outline, the photo shows nothing of its edge.
    guessed = cv2.dilate((full & ~seen).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    alpha[guessed & full] = 1.0
    texture = crop_texture(foreground_colours(colours, alpha), full, alpha)
    return _arrays(textured_body(view, body.mesh, texture, full), body.shape)


def _fitted(
    view: Camera,
    full: Mask,
    seen: Mask,
    colours: Pixels,
    item: ObjectRequest,
    mesher: Mesher | None,
    notice: Notice,
) -> Arrays:
    with tempfile.TemporaryDirectory(prefix=scratch_prefix("mesh")) as place:
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
    return _arrays(fitted.surface, USER_MESH)


def _on_supports(
    view: Camera, seen: Sequence[Mask], bodies: Sequence[Body], objects: Sequence[ObjectRequest], notice: Notice
) -> list[Body]:
    """``bodies``, with those that stand on other bodies moved onto them, and those that stand on nothing in the air."""
    standing = [body.surface.vertices for body in bodies if body.turned is None]
    placed = [
        body if body.turned is None else _moved(body, hung(view, body.turned, body.surface.vertices, standing))
        for body in bodies
    ]
    found = place_on_supports(view, seen, [(body.surface.vertices, body.surface.faces) for body in placed])
    for item in found:
        vertices = placed[item.upper].surface.vertices
        placed[item.upper] = _moved(placed[item.upper], view.position + item.factor * (vertices - view.position))
        notice(f"{objects[item.upper].name} stands on {objects[item.lower].name}; it is placed there")
    for i in {i for i, body in enumerate(bodies) if body.turned is not None} - {item.upper for item in found}:
        notice(
            f"{objects[i].name}: its foot lies above the horizon, so it stands on nothing and hangs in the air, at "
            f"{'the distance of the nearest other object' if standing else 'a guessed distance'}; if it stands, give a "
            "smaller horizon_y or a larger pitch_deg"
        )
    return placed


def _moved(body: Body, vertices: Points) -> Body:
    return replace(body, surface=replace(body.surface, vertices=vertices))


def _separated(
    view: Camera, front_to_back: Sequence[int], bodies: Sequence[Body], objects: Sequence[ObjectRequest], notice: Notice
) -> list[Body]:
    """``bodies``, none of which reaches into another; what the photo shows of them stays."""
    placed = [PlacedBody(body.surface.vertices, body.surface.faces, body.shape == "inflated") for body in bodies]
    vertices, found = separate(view, placed, front_to_back)
    for item in found:
        name, other = objects[item.yielding].name, objects[item.other].name
        notice(
            f"{name} and {other} would share space: {name} gives way by up to {item.share:.0%} of its size, on the "
            "side that the photo does not show"
        )
    return [_moved(body, places) for body, places in zip(bodies, vertices, strict=True)]


def shadow_casters(view: Camera, full: Sequence[Mask], bodies: Sequence[Body]) -> list[TriangleMesh]:
    """Return the meshes that cast shadows: of inflated bodies their masks inflated plainly, else their own surfaces.

    An inflated body is moved back until it stands, so its shadow would be displaced; one that hangs is not.
    """
    result = []
    for mask, body in zip(full, bodies, strict=True):
        if body.shape == "inflated" and body.turned is None:
            bare = shadow_mesh(view, inflate(mask))
            result.append((bare.vertices, bare.faces))
        else:
            result.append((body.surface.vertices, body.surface.faces))
    return result
