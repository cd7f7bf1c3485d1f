# SPDX-License-Identifier: MIT
"""From an outline to the body of an object: a fitted primitive or an inflated one, closed, standing on the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera
from ..options import ObjectRequest, ReconstructOptions
from .body import stability
from .choose import Choice, choose
from .crop import Crop, crop_of
from .inflate import inflate
from .kinds import KindShape, kind_shape
from .lattice import bent_mesh
from .mesh import BodyMesh, inflated_mesh
from .primitives import drawn
from .repair import WORTH_SAYING
from .solid import solid_mesh
from .unseen import colour_pixels
from .warp import fitting

Mask = NDArray[np.bool_]
Notice = Callable[[str], None]

TOPPLES = 0.05
"""Stability below which a notice says that the body may topple."""
BENT = 0.98
"""Silhouette overlap above which the bent primitive is the body; below, the outline is cut out of it."""
KEPT = 0.96
"""Overlap of the finished silhouette with the mask that a primitive has to keep."""
UNLIKELY = 0.8
"""Overlap of a shape that the user asked for, below which a notice says that it does not look like one."""


@dataclass(frozen=True)
class Body:
    """The body of one object. The camera is 1 unit above the ground z = 0.

    mesh: closed surface, world units. shape: ``box``, ``cylinder``, ``sphere`` or ``inflated``.
    stability: how safely it stands, 1 as a cube does, negative when it topples; a ball counts as standing.
    fit: overlap (IoU) of its silhouette in the photo's view with the outline it was made from.
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
) -> Body:
    """The body whose outline in the photo is ``full``.

    camera: 1 unit above the ground z = 0. full: (H, W), not empty, the object's outline, completed where something
    hides it. seen: (H, W) the part of it that the photo shows; None for all. pixels: (H, W, 3) sRGB, the photo,
    whose inner edges help to tell a box' depth from its height.

    Raises InputError when the outline is empty or too thin for any closed surface.
    """
    if not full.any():
        raise InputError(f"{request.name or 'object'}: its outline is empty; draw the box around the object")
    name = request.name or "object"
    seen = full if seen is None else seen & full
    kind = kind_shape(request.kind)
    crop = crop_of(full)
    # Whoever chooses a back means an inflated body.
    shape = "inflated" if request.shape == "auto" and request.back != "auto" else request.shape
    choice = choose(camera, crop, full, seen, pixels, shape=shape, kind=kind, thickness=request.thickness)
    if choice is None and request.shape not in ("auto", "inflated"):
        notice(f"{name}: no {request.shape} on the ground has this outline; it is inflated instead, check the horizon")
    if choice is not None and request.shape != "auto" and choice.overlap < UNLIKELY:
        notice(
            f"{name}: its outline overlaps that of the best {request.shape} by {choice.overlap:.2f} only; "
            "shape auto or inflated may suit it better"
        )
    if choice is None:
        mesh, margin, lost = _inflated(camera, full, request, kind, options.mesh_vertices)
        shape = "inflated"
    else:
        part = 1.0 if request.thickness is None or choice.primitive.name == "box" else request.thickness
        mesh, lost = _solid(camera, crop, choice, full, part, options.mesh_vertices)
        shape = choice.primitive.name
        margin = 1.0 if shape == "sphere" else stability(mesh.vertices, mesh.faces)
    fit = silhouette_overlap(camera, mesh, full)
    if choice is not None and fit < KEPT and request.shape == "auto":
        # A primitive by name or by looks that does not keep the outline is none.
        choice, shape = None, "inflated"
        mesh, margin, lost = _inflated(camera, full, request, kind, options.mesh_vertices)
        fit = silhouette_overlap(camera, mesh, full)
    elif fit < KEPT:
        notice(f"{name}: the body's silhouette overlaps its mask by {fit:.2f} only; give another shape or mask")
    if lost > WORTH_SAYING:
        notice(f"{name}: {lost:.0%} of its surface hung loose beside it and was removed; check its mask")
    if margin < TOPPLES:
        notice(f"{name}: may topple, its base does not carry its centre of mass; a larger thickness helps")
    mesh = replace(mesh, colours=colour_pixels(camera, mesh, crop, None if choice is None else choice.primitive))
    return Body(mesh=mesh, shape=shape, stability=margin, fit=fit)


def _solid(
    camera: Camera, crop: Crop, choice: Choice, full: Mask, thickness: float, target: int
) -> tuple[BodyMesh, float]:
    own = drawn(choice.primitive, camera, crop.mask.shape, crop.left, crop.top)
    fitted = fitting(crop, own)
    bent = bent_mesh(camera, crop, choice.primitive, fitted, target)
    if not fitted.parts.any() and silhouette_overlap(camera, bent, full) >= BENT:
        return bent, 0.0
    return solid_mesh(camera, crop, choice.primitive, fitted, target, thickness)


def _inflated(
    camera: Camera, full: Mask, request: ObjectRequest, kind: KindShape | None, target: int
) -> tuple[BodyMesh, float, float]:
    thickness = request.thickness
    if thickness is None and kind is not None and kind.shape == "inflated":
        thickness = kind.thickness
    back = request.back
    if back == "auto":
        back = "symmetric" if kind is None else kind.back
    silhouette = inflate(full, thickness)
    if request.shape == "inflated" and silhouette.slab and thickness is None:
        silhouette = inflate(full, 1.0)
    return inflated_mesh(camera, silhouette, target, flat=back == "flat")


def silhouette_overlap(camera: Camera, mesh: BodyMesh, full: Mask) -> float:
    """IoU of the silhouette of ``mesh`` in the photo's view with ``full`` (H, W), inside the photo."""
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
