# SPDX-License-Identifier: MIT
"""A scene at rest, as a default motion sees it: its things, their supports and sides, how near they are, the frame."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from ..scene.model import Camera, Ground, SceneObject

Array = NDArray[np.float64]

FINE_POINTS = 4000
"""Points of a surface that distances are measured to."""

ROUND = 0.85
"""Sphericity 36 π V² / A³ of the hull above which a thing rolls: 1 for a ball, 0.67 for a tin, 0.52 for a cube."""


EDGE_ON = math.cos(math.radians(80.0))
"""Cosine to the camera below which a photo tells little of a surface: a pixel there covers six times its length."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Pieces of a body's surface: centres (N, 3) m, and areas (N, 3) m², their normals as long as they are large."""

    centres: Array
    areas: Array

    @classmethod
    def of(cls, vertices: Array, faces: NDArray[np.int64]) -> Surface:
        """Return that of a mesh: vertices (V, 3), faces (T, 3) counter-clockwise from outside; about FINE_POINTS."""
        corners = vertices[faces[:: max(1, len(faces) // FINE_POINTS)]]
        edges = corners[:, 1:] - corners[:, :1]
        return cls(corners.mean(axis=1), 0.5 * np.cross(edges[:, 0], edges[:, 1]))

    def faces(self, eye: Array) -> tuple[Array, Array]:
        """Return for each piece how large (N,) it looks from ``eye`` (3,), in sr, and the cosine (N,) to it."""
        ways = eye - self.centres
        far = np.linalg.norm(ways, axis=1)
        facing = np.einsum("ij,ij->i", self.areas, ways)
        cosines = facing / np.maximum(far * np.linalg.norm(self.areas, axis=1), 1e-30)
        return np.maximum(facing, 0.0) / far**3, cosines

    def guessed(self, now: Surface, eye: Array) -> float:
        """Return the share, 0 to 1, of what ``eye`` (3,) sees of the body as it is ``now`` that it saw from behind or
        edge on when the body was like this, beyond such a share then. What a body hides of itself counts as seen.
        """
        looked, cosines = self.faces(eye)
        looks = now.faces(eye)[0]
        unknown = cosines < EDGE_ON
        shares = [float(each[unknown].sum() / max(float(each.sum()), 1e-30)) for each in (looks, looked)]
        return max(0.0, shares[0] - shares[1])


@dataclass(frozen=True, eq=False)
class Thing:
    """An object as it rests.

    hull: (K, 3) corners of its convex hull, with points of its surface in between; points: (N, 3) of its surface;
    surface: which way it faces; centre: (3,); base: (B, 3) what it stands on; heights: of lowest and highest point over
    the ground; round: whether it rolls; carried: whether it stands on another object; free: whether it may be moved.
    """

    item: SceneObject
    hull: Array
    points: Array
    surface: Surface
    centre: Array
    base: Array
    heights: tuple[float, float]
    round: bool
    carried: bool = False
    free: bool = True

    @property
    def tall(self) -> float:
        """Return the height in m."""
        return self.heights[1] - self.heights[0]

    def extent(self, direction: Array) -> float:
        """Return the extent in m along the unit vector ``direction`` (3,)."""
        return float(np.ptp(self.hull @ direction))

    def tips(self, way: Array, up: Array) -> float:
        """Return by how many radians it leans, at most, along the level unit vector ``way`` (2,) before it falls."""
        across = np.cross(up, way)
        # Where the base ends along a narrow strip in that direction; a narrow base ends soon, whatever its length.
        foot = (self.base - self.centre) @ np.stack([way, across], axis=1)
        ahead = foot[foot[:, 0] > 0]
        if len(ahead) == 0:
            return 0.0
        turns = np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]))
        reach = float(np.linalg.norm(ahead[turns <= max(0.3, float(turns.min()))], axis=1).max())
        return math.atan2(reach, max(float((self.centre - self.base.mean(axis=0)) @ up), 1e-9))

    def shifted(self, way: Array) -> Thing:
        """Return the thing moved along the ground by ``way`` (3,) m."""
        return dataclasses.replace(
            self,
            hull=self.hull + way,
            points=self.points + way,
            surface=Surface(self.surface.centres + way, self.surface.areas),
            centre=self.centre + way,
            base=self.base + way,
        )

    def turned(self, angle: float, up: Array) -> Thing:
        """Return the thing turned in place by ``angle`` radians about the vertical ``up`` (3,) through its centre."""

        def turn(points: Array) -> Array:
            return self.centre + rotated(points - self.centre, up, angle)

        return dataclasses.replace(
            self,
            hull=turn(self.hull),
            points=turn(self.points),
            surface=Surface(turn(self.surface.centres), rotated(self.surface.areas, up, angle)),
            base=turn(self.base),
        )


def rotated(points: Array, axis: Array, angle: float) -> Array:
    """Return ``points`` (K, 3) turned by ``angle`` radians about the unit vector ``axis`` (3,) through the origin."""
    across = points - np.outer(points @ axis, axis)
    return np.asarray(points + (math.cos(angle) - 1.0) * across + math.sin(angle) * np.cross(axis, points))


SILHOUETTE = 128
"""Longest side in pixels at which silhouettes are compared."""


def hidden_share(camera: Camera, first: Array, second: Array) -> float:
    """Return the share, 0 to 1, of the farther one's outline that the nearer one covers, of two hulls (K, 3)."""
    pixels = [camera.project(hull) for hull in (first, second)]
    near, far = (_silhouette(camera, seen) for seen in sorted(pixels, key=lambda seen: float(np.median(seen[:, 2]))))
    return float((near & far).sum()) / max(1, int(far.sum()))


def _silhouette(camera: Camera, seen: Array) -> NDArray[np.bool_]:
    """Return where the convex outline of the projected points ``seen`` (K, 3) is, coarsely."""
    import cv2

    scale = SILHOUETTE / max(camera.width, camera.height)
    canvas = np.zeros((math.ceil(scale * camera.height), math.ceil(scale * camera.width)), dtype=np.uint8)
    if (seen[:, 2] > 0).all():
        # Far outside OpenCV's numbers overflow.
        corners = np.clip(scale * seen[:, :2], -4 * SILHOUETTE, 4 * SILHOUETTE).round().astype(np.int32)
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners), 1)
    return canvas > 0


def outside_frame(camera: Camera, points: Array, margin: float) -> NDArray[np.float64]:
    """Return how far (T,) in pixels the farthest of ``points`` (T, K, 3) lies outside the frame less its margin."""
    seen = camera.project(points)
    edge = margin * min(camera.width, camera.height)
    x, y = seen[..., 0], seen[..., 1]
    over = np.maximum.reduce([edge - x, x - camera.width + edge, edge - y, y - camera.height + edge])
    over = np.where(seen[..., 2] > 0, over, np.inf)
    return np.asarray(np.maximum(over.max(axis=-1), 0.0))


class Clearance:
    """Least distance of a thing to others: as near as it rests, or a twentieth of its size."""

    def __init__(self, thing: Thing, others: Sequence[Array]) -> None:
        from scipy.spatial import cKDTree

        self._trees = [cKDTree(points) for points in others]
        self._boxes = [(points.min(axis=0), points.max(axis=0)) for points in others]
        wanted = 0.05 * thing.item.size_m
        self._least = [min(wanted, 0.9 * float(tree.query(thing.points)[0].min())) for tree in self._trees]

    def keeps(self, path: Array) -> bool:
        """Return whether the thing stays clear along the hulls ``path`` (T, K, 3)."""
        for tree, (low, high), least in zip(self._trees, self._boxes, self._least, strict=True):
            near = (path.max(axis=1) > low - least).all(axis=1) & (path.min(axis=1) < high + least).all(axis=1)
            for hull in path[near]:
                if float(tree.query(hull)[0].min()) < least:
                    return False
        return True


class PlateColours:
    """Colours of the clean plate, in a perceptual space."""

    SIDE = 320
    """Longest side in pixels at which it is compared."""

    def __init__(self, scene: Scene) -> None:
        self._image: NDArray[np.float32] | None = None
        if scene.model.background is None:
            return
        import cv2

        from ..srgb import cielab, read_rgb

        image = read_rgb(scene.file(scene.model.background))
        scale = min(1.0, self.SIDE / max(image.shape[:2]))
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        self._image = cielab(np.asarray(small, dtype=np.uint8))

    def difference(self, camera: Camera, here: Array, there: Array) -> float:
        """Return how unlike the ground at the points ``here`` and ``there`` (K, 3) looks, 0 to 1: ΔE 40 is 1."""
        if self._image is None:
            return 0.0
        means = [self._colours(camera, points) for points in (here, there)]
        return min(1.0, float(np.linalg.norm(np.mean(means[0], axis=0) - np.mean(means[1], axis=0))) / 40.0)

    def _colours(self, camera: Camera, points: Array) -> NDArray[np.float32]:
        assert self._image is not None
        inner = np.concatenate([points, 0.5 * (points + points.mean(axis=0))])
        rows, columns = self._image.shape[:2]
        pixels = camera.project(inner)[:, :2] * (columns / camera.width, rows / camera.height)
        x, y = np.clip(pixels, 0, (columns - 1, rows - 1)).astype(int).T
        return self._image[y, x]


def thing_at_rest(scene: Scene, item: SceneObject, ground: Ground) -> Thing:
    """Return ``item`` of ``scene`` as it rests over ``ground``, as if nothing else were there.

    Raises InputError for a mesh that cannot be read.
    """
    from scipy.spatial import ConvexHull, QhullError
    from trimesh.remesh import subdivide_to_size

    mesh = load_object_mesh(scene, item)
    vertices, points = mesh.vertices, mesh.vertices
    if len(vertices) < FINE_POINTS:
        # A few large faces: their corners alone do not tell where they are.
        points = np.asarray(subdivide_to_size(vertices, mesh.faces, max_edge=0.04 * item.size_m, max_iter=20)[0])
    try:
        hull = ConvexHull(vertices)
        corners, sphericity = vertices[hull.vertices], 36.0 * math.pi * hull.volume**2 / hull.area**3
    except QhullError:
        # A flat sheet.
        corners, sphericity = vertices, 0.0
    corners = corners[:: max(1, len(corners) // 300)]
    heights = ground.heights(vertices)
    held = bool(item.pins) or item.goal_stiffness > 0 or item.role != "dynamic" or item.splats is not None
    return Thing(
        item=item,
        hull=np.concatenate([corners, points[:: max(1, len(points) // 300)]]),
        points=points[:: max(1, len(points) // FINE_POINTS)],
        surface=Surface.of(vertices, mesh.faces),
        centre=vertices.mean(axis=0),
        base=vertices[heights <= heights.min() + 0.06 * np.ptp(heights)],
        heights=(float(heights.min()), float(heights.max())),
        round=bool(sphericity > ROUND),
        free=not held,
    )


def with_supports(things: Sequence[Thing], up: Array) -> list[Thing]:
    """Return ``things``, knowing what stands on another and what may not move because something stands on it."""
    found = []
    for thing in things:
        slack = 0.1 * thing.tall
        above = [
            other
            for other in things
            if other is not thing
            and other.heights[0] > slack + 0.02 * other.item.size_m
            and abs(other.heights[0] - thing.heights[1]) < 0.25 * max(thing.tall, other.tall)
            and _share_floor(thing, other, up)
        ]
        carried = thing.heights[0] > 0.05 * thing.item.size_m
        found.append(dataclasses.replace(thing, carried=carried, free=thing.free and not above))
    return found


def _share_floor(a: Thing, b: Thing, up: Array) -> bool:
    across = np.eye(3) - np.outer(up, up)
    first, second = a.hull @ across, b.hull @ across
    return bool((first.max(axis=0) >= second.min(axis=0)).all() and (second.max(axis=0) >= first.min(axis=0)).all())
