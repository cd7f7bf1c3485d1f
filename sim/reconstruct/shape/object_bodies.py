# SPDX-License-Identifier: MIT
"""A body for each object: primitive, furniture, inflated mesh or user mesh, placed on what supports it."""

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
from .body_texture import TexturedSurface, colour_pixels, corner_pixels, crop_texture
from .furniture import furniture_boards, furniture_mesh
from .inflate import Crop, crop_mask, inflate
from .inflated_mesh import TOPPLES, BodyMesh, inflated_mesh, shadow_mesh
from .object_placement import PlacedBody, TriangleMesh, hung, place_on_supports, separate, turned_view
from .primitive_choice import FURNITURE, KindShape, PrimitiveChoice, choose_primitive, shape_of_kind
from .primitive_mesh import bent_mesh, solid_mesh, warp_to_outline
from .primitives import Box, rasterize
from .reference_surfaces import front_of
from .stability import footed, support_of
from .surface_mesh import WORTH_SAYING
from .texture_atlas import textured_body

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

BENT = 0.98
"""Silhouette overlap above which the warped primitive is the body; below, the outline is cut out of it."""
KEPT = 0.96
"""Overlap of the finished silhouette with the mask that a primitive has to reach."""
SAME_FIT = 0.001
"""Overlap that a box may lose when its unseen side is moved."""
TOUCH = np.ones((7, 7), np.uint8)
"""Window in pixels within which two objects touch in the photo."""
UNLIKELY = 0.8
"""Overlap of a requested shape below which a notice reports the mismatch."""


@dataclass(frozen=True)
class BuiltBody:
    """The body of one object. The camera is 1 unit above the ground z = 0.

    mesh: closed surface, world units. shape: ``box``, ``cylinder``, ``sphere``, ``inflated`` or ``LYING``. stability:
    the steadiness of its ``SupportMargin``; a sphere counts as standing. fit: overlap (IoU) of its silhouette in the
    photo's view with its mask.
    """

    mesh: BodyMesh
    shape: str
    stability: float
    fit: float


def build_body(
    camera: Camera,
    full: Mask,
    request: ObjectRequest,
    options: ReconstructOptions,
    notice: Notice,
    *,
    seen: Mask | None = None,
    pixels: NDArray[np.uint8] | None = None,
    depth: DepthMap | None = None,
    others: Mask | None = None,
) -> BuiltBody:
    """Return the body whose silhouette in the photo is ``full``.

    camera: 1 unit above the ground z = 0. full: (H, W), not empty, the object's whole mask. seen: (H, W) its visible
    part; None for all. pixels: (H, W, 3) sRGB, the photo, whose inner edges help to separate a box' depth from its
    height. depth: a depth map of the photo, which shapes the front of an inflated body. others: (H, W) other objects.

    Raises InputError when the mask is empty or too thin for a closed surface.
    """
    if not full.any():
        raise InputError(f"{request.name or 'object'}: its outline is empty; draw the box around the object")
    name = request.name or "object"
    seen = full if seen is None else seen & full
    kind = shape_of_kind(request.kind)
    crop = crop_mask(full)
    inflated = _Inflation(camera, full, request, kind, options.mesh_vertices, depth, others, notice)
    # Choosing a back implies an inflated body.
    shape = "inflated" if request.shape == "auto" and request.back != "auto" else request.shape
    built = _furniture(camera, crop, full, request, kind, options.mesh_vertices) if shape == "auto" else None
    if built is not None:
        return built
    choice = choose_primitive(camera, crop, full, seen, pixels, shape=shape, kind=kind, thickness=request.thickness)
    if choice is None and request.shape not in ("auto", "inflated"):
        notice(f"{name}: no {request.shape} on the ground has this outline; it is inflated instead, check the horizon")
    if choice is not None and request.shape != "auto" and choice.overlap < UNLIKELY:
        notice(
            f"{name}: its outline overlaps that of the best {request.shape} by only {choice.overlap:.2f}; "
            "shape auto or inflated may fit better"
        )
    if choice is None:
        mesh, margin, lost = inflated.mesh()
        shape = LYING if mesh.lies else "inflated"
    else:
        part = 1.0 if request.thickness is None or choice.primitive.name == "box" else request.thickness
        mesh, lost = _solid(camera, crop, choice, full, part, options.mesh_vertices)
        shape = choice.primitive.name
        margin = 1.0 if shape == "sphere" else support_of(mesh.vertices, mesh.faces).steadiness
    fit = silhouette_overlap(camera, mesh, full)
    if choice is not None and fit < KEPT and request.shape == "auto":
        # Reject an automatic primitive that does not keep the outline.
        choice = None
        mesh, margin, lost = inflated.mesh()
        shape = LYING if mesh.lies else "inflated"
        fit = silhouette_overlap(camera, mesh, full)
    elif fit < KEPT:
        notice(f"{name}: the body's silhouette overlaps its mask by {fit:.2f} only; give another shape or mask")
    if lost > WORTH_SAYING:
        notice(f"{name}: {lost:.0%} of its surface was disconnected and was removed; check its mask")
    primitive = None if choice is None else choice.primitive
    mesh = replace(mesh, colours=colour_pixels(camera, mesh, crop, primitive))
    if isinstance(primitive, Box):
        mesh = replace(mesh, corner_colours=corner_pixels(camera, mesh, crop, primitive))
        if request.thickness is None:
            mesh = _deeper(camera, mesh, full, fit)
            margin = support_of(mesh.vertices, mesh.faces).steadiness
    if margin < TOPPLES:
        notice(f"{name}: may topple, its centre of mass is not above its base; a larger thickness helps")
    return BuiltBody(mesh=mesh, shape=shape, stability=margin, fit=fit)


def _solid(
    camera: Camera, crop: Crop, choice: PrimitiveChoice, full: Mask, thickness: float, target: int
) -> tuple[BodyMesh, float]:
    own = rasterize(choice.primitive, camera, crop.mask.shape, crop.left, crop.top)
    fitted = warp_to_outline(crop, own)
    bent = bent_mesh(camera, crop, choice.primitive, fitted, target)
    if not fitted.parts.any() and silhouette_overlap(camera, bent, full) >= BENT:
        return bent, 0.0
    return solid_mesh(camera, crop, choice.primitive, fitted, target, thickness)


def _deeper(camera: Camera, box: BodyMesh, full: Mask, fit: float) -> BodyMesh:
    """``box`` whose unseen side is as much farther away as it needs to stand safely, with the colours that it has.

    fit: overlap of its silhouette with ``full``, which stays.
    """
    vertices, moved = footed(camera, inflate(full, 1.0), box.vertices, box.faces, flat=True)
    pixels = np.where(moved[:, None], camera.project(vertices)[:, :2], box.pixels)
    deeper = replace(box, vertices=vertices, pixels=pixels)
    return deeper if silhouette_overlap(camera, deeper, full) > fit - SAME_FIT else box


@dataclass(frozen=True)
class _Inflation:
    """Options of inflating one object."""

    camera: Camera
    full: Mask
    request: ObjectRequest
    kind: KindShape | None
    target: int
    depth: DepthMap | None
    others: Mask | None
    notice: Notice

    def mesh(self) -> tuple[BodyMesh, float, float]:
        """As ``inflated_mesh``."""
        request, kind = self.request, self.kind
        thickness = request.thickness
        if thickness is None and kind is not None and kind.shape == "inflated":
            thickness = kind.thickness
        back = request.back
        if back == "auto":
            back = "symmetric" if kind is None else kind.back
        silhouette = inflate(self.full, thickness)
        if request.shape == "inflated" and silhouette.slab and thickness is None:
            silhouette = inflate(self.full, 1.0)
        front = None
        if self.depth is not None:
            others = np.zeros_like(self.full) if self.others is None else self.others
            name = request.name or "object"
            front = front_of(self.depth, self.camera, silhouette, self.full, others, name, self.notice)
        leans = self.others is not None and bool((cv2.dilate(self.full.astype(np.uint8), TOUCH)[self.others] > 0).any())
        return inflated_mesh(self.camera, silhouette, self.target, flat=back == "flat", front=front, leans=leans)


def _furniture(
    camera: Camera, crop: Crop, full: Mask, request: ObjectRequest, kind: KindShape | None, target: int
) -> BuiltBody | None:
    """A chair, table or shelf; None for anything else, or if its boards do not make one body with this outline."""
    asked = kind is not None and kind.shape == FURNITURE
    if request.thickness is not None or (kind is not None and not asked):
        return None
    boards = furniture_boards(camera, crop, asked=asked)
    if boards is None:
        return None
    try:
        mesh, _ = furniture_mesh(camera, crop, boards, target)
    except InputError:
        return None
    margin, fit = support_of(mesh.vertices, mesh.faces).steadiness, silhouette_overlap(camera, mesh, full)
    if fit < KEPT or margin < TOPPLES:
        return None
    mesh = replace(mesh, colours=colour_pixels(camera, mesh, crop, None))
    return BuiltBody(mesh=mesh, shape=FURNITURE, stability=margin, fit=fit)


def silhouette_overlap(camera: Camera, mesh: BodyMesh, full: Mask) -> float:
    """Return the IoU of the silhouette of ``mesh`` in the photo's view with ``full`` (H, W), inside the photo."""
    corners = camera.project(mesh.vertices)[:, :2][mesh.faces]
    low = np.floor(corners.min(axis=(0, 1))).astype(int) - 2
    high = np.ceil(corners.max(axis=(0, 1))).astype(int) + 2
    low = np.maximum(low, 0)
    high = np.minimum(high, [full.shape[1], full.shape[0]])
    if (high <= low).any():
        return 0.0
    scale = 2 if (high - low).max() > 900 else 4
    image = np.zeros(((high[1] - low[1]) * scale, (high[0] - low[0]) * scale), np.uint8)
    for triangle in np.round(((corners - low) * scale - 0.5) * 16).astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 255, shift=4)
    drawn_mask = np.zeros_like(full)
    part = cv2.resize(image, (int(high[0] - low[0]), int(high[1] - low[1])), interpolation=cv2.INTER_AREA) > 127
    drawn_mask[low[1] : high[1], low[0] : high[0]] = part
    return float((drawn_mask & full).sum() / max(1, int((drawn_mask | full).sum())))


Pixels = NDArray[np.uint8]

USER_MESH = "mesh"
"""Shape name of a body that comes from a user's mesh or a mesher."""
LYING = "lying"
"""Shape name of an inflated body that lies where a wall would stand on an edge."""


@dataclass(frozen=True)
class Body:
    """surface: closed, in the camera's unit, standing on z = 0 or a support, or hanging. shape: a primitive's name,
    ``inflated``, ``LYING`` or ``USER_MESH``. turned: the view in which it was made if it hangs."""

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
