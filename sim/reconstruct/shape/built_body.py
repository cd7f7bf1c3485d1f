# SPDX-License-Identifier: MIT
"""The body of one object from its outline: a primitive, furniture, or its mask inflated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera
from ..camera.depth_map import DepthMap
from ..reconstruct_options import ObjectRequest, ReconstructOptions
from ..stage_cache import Notice
from .boards import board_mesh
from .body_texture import colour_pixels, corner_pixels
from .furniture import furniture_boards
from .inflate import Crop, crop_mask, inflate
from .inflated_mesh import TOPPLES, BodyMesh, inflated_mesh
from .primitive_choice import PrimitiveChoice, choose_primitive
from .primitive_mesh import bent_mesh, solid_mesh, warp_to_outline
from .primitives import Box, rasterize
from .reference_surfaces import front_of
from .shape_kinds import FURNITURE, KindShape, shape_of_kind
from .stability import footed, support_of
from .surface_mesh import WORTH_SAYING

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
LYING = "lying"
"""Shape name of an inflated body that lies where a wall would stand on an edge."""
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
        mesh, _ = board_mesh(camera, crop, boards, target)
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
