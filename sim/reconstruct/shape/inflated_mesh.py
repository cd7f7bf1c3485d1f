# SPDX-License-Identifier: MIT
"""Meshes of inflated silhouettes on the ground: marching cubes over pixels and depth, relaxed.

Each pixel's ray holds material from ``ref − h`` to ``ref + b h``, cut where it enters the ground. The reference depth
is that of a wall facing the camera, or of the ground in front of the wall, whichever is nearer: the silhouette is kept
exactly, the base is flat, and the body reaches from its visible line of contact to behind the wall. The wall of a box
is upright; that of a sphere leans back until it is perpendicular to the view; other things lie between. A leaning body
is thicker behind (b > 1) so that it does not overhang. Moving the wall back enlarges the base, until the centre of
mass lies well above it. What is thin and would topple, or is a ring on its side, lies on the ground (`lying.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...mpm.geometry.triangles import signed_volume
from ...scene.model import Camera
from .floor_limbs import with_limbs
from .inflate import Silhouette
from .lying import lying_surface, ring_lies
from .reference_surfaces import ReferenceSurface, measured_surfaces, reference_surfaces, standing_surfaces
from .stability import footed, settled, support_of
from .surface_mesh import RELAXATION_ROUNDS, Faces, Points, relax, surface_of_size

STABLE = 0.25
"""Steadiness (``SupportMargin``) at which the wall moves back no farther."""
BARE_THICKNESS = 0.8
"""Thickness of objects that are neither round nor boxes, over their widest inscribed circle: few are as deep as
wide."""
FLAT = 0.0
"""``ReferenceSurface.back`` of a body entirely in front of its reference surface."""
TOPPLES = 0.05
"""Steadiness below which a body may topple."""
GROUND_TOLERANCE_PX = 0.75
"""Vertices nearer to the ground than this are put onto it; marching cubes leaves them slightly off."""


@dataclass(frozen=True)
class BodyMesh:
    """A closed triangle surface. vertices: (V, 3) world units; faces: (T, 3), counter-clockwise from outside.

    pixels: (V, 2) photo pixels at which the camera sees each vertex. colours: (V, 2) photo pixels whose colours the
    vertices have; None for ``pixels``. corner_colours: (T, 3, 2) those of the corners of each face, which differ from
    the vertices' along the edges of a box; None for the vertices'. lies: whether it lies on the ground, where a wall
    would stand on an edge.
    """

    vertices: Points
    faces: Faces
    pixels: Points
    colours: Points | None = None
    corner_colours: Points | None = None
    lies: bool = False


class _DepthField:
    """φ(x, y, t) > 0 inside: x, y in crop pixels (centres at integers), t in pixels along the ray from the reference.

    φ = min(h² − t², 2 h_max (t_ground − t)): the inflated silhouette, cut by the ground; t / b for t behind the
    reference, where the body is b times as thick, and in front of a measured middle for t as high as it was measured.
    """

    def __init__(self, silhouette: Silhouette, reference: ReferenceSurface) -> None:
        self._square = silhouette.square_height
        height, width = self._square.shape
        rows, columns = np.mgrid[:height, :width]
        pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
        middle, ground, rays = reference.depths(pixels)
        self.half_thickness = silhouette.half_thickness
        self._back = reference.back
        self._measured = reference.middle is not None
        cap = 8.0 * self._back * self.half_thickness + 16.0
        with np.errstate(invalid="ignore"):
            below = (ground - middle) * np.linalg.norm(rays, axis=1) / reference.unit_per_pixel
        self._ground = np.minimum(np.nan_to_num(below, nan=cap, posinf=cap), cap).reshape(height, width)
        self._steep = np.ones_like(self._square)
        self._gentle = np.ones_like(self._square)
        self._front = self._behind = self.half_thickness
        if reference.middle is not None:
            inflated = np.sqrt(np.maximum(self._square, 0.25))
            self._steep = inflated / np.maximum(reference.middle.rise, 0.2 * inflated)
            self._front = max(self._front, float(reference.middle.rise.max()))
            if reference.middle.behind is not None:
                self._gentle = 1.0 / reference.middle.behind
                self._behind = max(self._behind, float((inflated * reference.middle.behind).max()))

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return both arguments of the minimum (n), (n) at ``points`` (n, 3) as x, y, t."""
        at = points[:, 1::-1].T
        square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
        ground = ndimage.map_coordinates(self._ground, at, order=1, mode="nearest")
        steep, gentle = self._slopes(at)
        t = points[:, 2]
        return self._film(square, steep, gentle, t), 2.0 * self.half_thickness * (ground - t)

    def _slopes(self, at: Points) -> tuple[Points, Points]:
        """Factors of t in front of and behind the middle at ``at`` (2, n), each (n) or (1) where they are 1."""
        if not self._measured:
            return np.ones(1), np.ones(1)
        steep = ndimage.map_coordinates(self._steep, at, order=1, mode="nearest")
        return steep, ndimage.map_coordinates(self._gentle, at, order=1, mode="nearest")

    def _film(self, square: Points, steep: Points, gentle: Points, t: Points) -> Points:
        if self._back == FLAT:
            return np.asarray(np.minimum(square - (steep * t) ** 2, -2.0 * self.half_thickness * t))
        return np.asarray(square - np.where(t > 0, gentle * t / self._back, steep * t) ** 2)

    def value(self, points: Points) -> Points:
        """Return φ (n,) at ``points`` (n, 3)."""
        film, ground = self.sample(points)
        return np.minimum(film, ground)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid (x, y, t) of ``spacing`` pixels, the grid's first corner (3,) and its spacing along each
        axis.

        Thin bodies get finer steps in depth, or they would fall between two layers of the grid.
        """
        steps = np.array([spacing, spacing, min(spacing, self.half_thickness / 3.0)])
        height, width = self._square.shape
        extents = (self._front, self._back * self._behind)
        front, behind = (int(np.ceil(extent / steps[2])) + 2 for extent in extents)
        # Half a cell off t = 0, so that no grid node lies exactly on the surface along the outline.
        first = np.array([0.25, 0.25, -(front + 0.5) * steps[2]])
        counts = (
            int((width - 1) // spacing) + 1,
            int((height - 1) // spacing) + 1,
            front + behind + 2,
        )
        axes = [first[i] + steps[i] * np.arange(counts[i]) for i in range(3)]
        flat = np.stack(np.meshgrid(axes[0], axes[1], [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
        at = flat[:, 1::-1].T
        square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
        ground = 2.0 * self.half_thickness * ndimage.map_coordinates(self._ground, at, order=1, mode="nearest")
        steep, gentle = (slope if len(slope) == 1 else slope.reshape(*counts[:2], 1) for slope in self._slopes(at))
        shape = (counts[0], counts[1], 1)
        t = axes[2][None, None, :]
        film = self._film(square.reshape(shape), steep, gentle, t)
        field = np.minimum(film, ground.reshape(shape) - 2.0 * self.half_thickness * t)
        # A closed surface needs a negative border.
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32), first, steps


def inflated_mesh(
    camera: Camera,
    silhouette: Silhouette,
    target: int = 12_000,
    *,
    flat: bool = False,
    front: Points | None = None,
    leans: bool = False,
) -> tuple[BodyMesh, float, float]:
    """Return the closed surface of the body with about ``target`` vertices, standing or lying on the ground.

    Also its steadiness (``SupportMargin``) and the share of its surface that was disconnected and removed. The first
    reference surface with which it stands safely is used, or the best. That is judged on the mesh itself: the contact
    is often a narrow strip, which anything coarser would miss.

    flat: nothing behind the reference surface. front: (h, w) depth along the optical axis of the visible front on the
    silhouette's crop, units, NaN where unknown; None inflates about a wall, or about legs where they stand. leans:
    whether something is there that it may lean on; then it does not lie. Raises InputError when the silhouette is too
    thin for a closed surface.
    """
    lying = None if flat or front is not None or leans else lying_surface(camera, silhouette)
    if lying is not None and ring_lies(camera, silhouette):
        return _lying_mesh(camera, silhouette, lying, target)
    body, steadiness, lost = _standing_mesh(camera, silhouette, target, flat=flat, front=front)
    if lying is not None and steadiness < TOPPLES:
        laid = _lying_mesh(camera, silhouette, lying, target)
        if laid[1] > steadiness:
            return laid
    return body, steadiness, lost


def _lying_mesh(
    camera: Camera, silhouette: Silhouette, lying: ReferenceSurface, target: int
) -> tuple[BodyMesh, float, float]:
    field = _DepthField(silhouette, lying)
    points, faces, lost = surface_of_size(field, float(silhouette.mask.sum()), target)
    points = relax(field, points, faces)
    body = replace(_to_world(silhouette, lying, points, faces), lies=True)
    return body, support_of(body.vertices, body.faces).steadiness, lost


def _standing_mesh(
    camera: Camera, silhouette: Silhouette, target: int, *, flat: bool, front: Points | None
) -> tuple[BodyMesh, float, float]:
    best: tuple[ReferenceSurface, Points, Faces, float, float] | None = None
    if front is not None:
        choices = measured_surfaces(camera, silhouette, front)
    elif silhouette.slab or flat:
        choices = reference_surfaces(camera, silhouette)
    else:
        choices = chain(standing_surfaces(camera, silhouette), reference_surfaces(camera, silhouette))
    on_legs = best_stands = False
    for reference in choices:
        # Moved back, legs would become flaps on the ground: only what would topple otherwise is.
        if on_legs and reference.middle is None and best is not None and best[4] > 0.0:
            break
        standing = front is None and reference.middle is not None
        on_legs |= standing
        if flat:
            reference = replace(reference, back=FLAT)
        elif reference.middle is None and not silhouette.slab:
            reference = with_limbs(reference, silhouette)
        field = _DepthField(silhouette, reference)
        points, faces, lost = surface_of_size(field, float(silhouette.mask.sum()), target)
        # One round brings the base onto the ground; the rest is for the one that is taken.
        points = relax(field, points, faces, 1)
        body = _to_world(silhouette, reference, points, faces)
        if standing:
            # Longer feet change little else, so they may be as long as the margin wants them, on the ground as a whole.
            settled_feet = settled(camera, silhouette, body.vertices, body.faces)
            steadiness, enough = support_of(settled_feet, body.faces).share, 1.0
        else:
            steadiness, enough = support_of(body.vertices, body.faces).steadiness, STABLE
        if best is None or steadiness > best[4]:
            best = (reference, points, faces, lost, steadiness)
            best_stands = standing
        # A relief need not stand by itself, as long as it touches the ground: moving it back only enlarges it.
        if steadiness >= enough or (flat and steadiness > -1.0):
            break
    assert best is not None
    reference, points, faces, lost, _ = best
    points = relax(_DepthField(silhouette, reference), points, faces, RELAXATION_ROUNDS - 1)
    body = _to_world(silhouette, reference, points, faces)
    if not flat:
        body = _footed(camera, silhouette, body, on_legs=best_stands)
    return body, support_of(body.vertices, body.faces).steadiness, lost


def _footed(camera: Camera, silhouette: Silhouette, body: BodyMesh, *, on_legs: bool) -> BodyMesh:
    """``body`` with a broader base on the side that the photo does not show."""
    vertices, moved = footed(camera, silhouette, body.vertices, body.faces, on_legs=on_legs)
    pixels = np.where(moved[:, None], camera.project(vertices)[:, :2], body.pixels)
    return replace(body, vertices=vertices, pixels=pixels)


def shadow_mesh(camera: Camera, silhouette: Silhouette, target: int = 3000) -> BodyMesh:
    """Return the plain inflated mask: neither moved back nor thickened for stability.

    Used for casting shadows, which need the object's true position but no stability. Raises InputError as
    ``inflated_mesh`` does.
    """
    thin = 1.0 if silhouette.slab else 1.0 - (1.0 - BARE_THICKNESS) * (1.0 - silhouette.roundness)
    silhouette = replace(silhouette, square_height=silhouette.square_height * thin**2)
    reference = replace(next(reference_surfaces(camera, silhouette)), back=1.0)
    points, faces, _ = surface_of_size(_DepthField(silhouette, reference), float(silhouette.mask.sum()), target)
    return _to_world(silhouette, reference, points, faces)


def _to_world(silhouette: Silhouette, reference: ReferenceSurface, points: Points, faces: Faces) -> BodyMesh:
    pixels = points[:, :2] + np.array([silhouette.left + 0.5, silhouette.top + 0.5])
    middle, ground, rays = reference.depths(pixels)
    per_depth = reference.unit_per_pixel / np.linalg.norm(rays, axis=1)
    depth = np.maximum(middle + points[:, 2] * per_depth, 0.02 * middle)
    near_ground = np.abs(depth - ground) < GROUND_TOLERANCE_PX * per_depth
    depth = np.where(near_ground, ground, np.minimum(depth, ground))
    return standing_mesh(reference.camera, pixels, depth, faces)


def standing_mesh(camera: Camera, pixels: Points, depth: Points, faces: Faces) -> BodyMesh:
    """Return the closed surface with vertices at ``depth`` (V,) along the rays through ``pixels`` (V, 2), on the
    ground."""
    position = camera.position
    vertices = position + depth[:, None] * camera.rays(pixels)
    # Scaling about the centre of projection moves nothing in the photo: bring the lowest point onto the ground.
    lowest = float(vertices[:, 2].min())
    factor = position[2] / (position[2] - lowest)
    vertices = position + factor * (vertices - position)
    vertices[np.abs(vertices[:, 2]) < 1e-9 * position[2], 2] = 0.0
    if signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1].copy()
    return BodyMesh(vertices=vertices, faces=faces, pixels=pixels)
