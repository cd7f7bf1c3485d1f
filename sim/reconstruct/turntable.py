# SPDX-License-Identifier: MIT
"""A body from all sides: views from a circle around it, on neutral ground, in its own colours, evenly lit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from ..scene.folder import Scene
from ..scene.meshes import read_mesh
from ..scene.scene_object import SceneObject
from ..scene.shading import evenly_lit, read_shading
from .mesh_raster import Paint, colours, paint_of, rasterise

Pixels = NDArray[np.uint8]
Points = NDArray[np.float64]

AZIMUTHS = tuple(range(0, 360, 45))
"""Views of a sheet, degrees."""
SIDE = 360
"""Pixels along a side of a view."""
RISE_DEG = 12.0
"""Angle of the views above the horizontal."""
ANGLE_DEG = 18.0
"""Angle within which the body lies, whatever its size."""
FINER = 2
"""Pixels are averaged from so many samples along a side."""
WALL, GROUND, INK = (226, 226, 226), (198, 198, 198), (70, 70, 70)
"""sRGB of what is behind, of the ground and of letters; neutral, so that they tint nothing."""
UP = np.array([0.0, 0.0, 1.0])
CONTACT_SHARE = 0.06
"""Share of the height below which a body's outline on the ground is drawn darker, so that hovering shows."""


@dataclass(frozen=True, eq=False)
class Turned:
    """A body to be viewed.

    vertices: (V, 3) metres. faces: (T, 3). paint: its colours. up: (3,) unit normal of the ground. front: (3,) unit,
    level, towards the viewer at azimuth 0. ground: height of the ground along ``up``, metres. centre: (3,), radius: of
    the ball around the centre that every view contains, metres.
    """

    vertices: Points
    faces: NDArray[np.int64]
    paint: Paint
    up: Points
    front: Points
    ground: float
    centre: Points
    radius: float


@dataclass(frozen=True, eq=False)
class View:
    """A view: ``pixels`` (side, side, 3) sRGB on the neutral ground, ``cover`` (side, side) share of each pixel, 0 to
    1, that shows the body, ``body`` (side, side, 3) its colours alone where ``cover`` > 0."""

    pixels: Pixels
    cover: NDArray[np.float32]
    body: Pixels


def turned(
    mesh: trimesh.Trimesh,
    viewer: Points,
    *,
    up: Points = UP,
    ground: float | None = None,
) -> Turned:
    """Return ``mesh`` in world metres, to be viewed from the side of ``viewer`` (3,) at azimuth 0.

    up: (3,) normal of the ground. ground: its height along ``up``; the body's lowest point by default.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    # Vertices that no triangle uses must not widen the view.
    used = vertices[np.unique(faces)]
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    front = np.asarray(viewer, dtype=np.float64) - centre
    front = front - (front @ up) * up
    length = float(np.linalg.norm(front))
    if length < 1e-9:  # Seen from right above: any side will do.
        front, length = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))]), 1.0
    front = front / np.linalg.norm(front)
    heights = used @ up
    return Turned(
        vertices=vertices,
        faces=faces,
        paint=paint_of(mesh),
        up=up,
        front=front,
        ground=float(heights.min()) if ground is None else ground,
        centre=centre,
        radius=max(float(np.linalg.norm(used - centre, axis=1).max()), 1e-9),
    )


def turned_object(folder: Scene, item: SceneObject) -> Turned:
    """Return the object ``item`` of a scene, to be viewed from its camera's side, without the light of its photo as far
    as that is known.

    Raises InputError for a mesh or shading that cannot be read.
    """
    mesh = read_mesh(folder.file(item.mesh))
    mesh.apply_transform(np.asarray(item.world_from_mesh))
    ground = folder.model.ground
    body = turned(mesh, folder.model.camera.position, up=UP if ground is None else ground.unit_normal)
    shading, texture = read_shading(folder, item), body.paint.texture
    if shading is None or texture is None:
        return body
    even = evenly_lit(texture, shading, f"{item.name}: {item.shading}")
    return replace(body, paint=replace(body.paint, texture=even))


def view(body: Turned, azimuth: float, *, side: int = SIDE, rise: float = RISE_DEG, ground: bool = True) -> View:
    """Return ``body`` from ``azimuth`` degrees: 90 shows its right side as its viewer at 0 sees it, 180 its back.

    rise: degrees above the horizontal, below 90. ground: whether the neutral ground is drawn below it.
    """
    camera = _camera(body, azimuth, rise, side * FINER)
    projected = camera.project(body.vertices)
    shown = rasterise(projected, body.faces, (side * FINER, side * FINER))
    backdrop = _backdrop(camera, body, side * FINER) if ground else np.full((side * FINER,) * 2 + (3,), WALL, np.uint8)
    seen = shown.on_grid((side * FINER, side * FINER))
    return _averaged(seen, colours(shown, projected, body.faces, body.paint), backdrop, side)


def _averaged(seen: NDArray[np.bool_], colour: NDArray[np.float32], backdrop: Pixels, side: int) -> View:
    alone = np.zeros((*seen.shape, 3), dtype=np.float32)
    alone[seen] = colour
    share = cv2.resize(seen.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA)
    small = cv2.resize(alone, (side, side), interpolation=cv2.INTER_AREA)
    around = np.where(seen[..., None], 0.0, backdrop).astype(np.float32)
    behind = cv2.resize(around, (side, side), interpolation=cv2.INTER_AREA)
    own = small / np.maximum(share, 1e-6)[..., None]
    return View(
        pixels=np.clip(np.rint(small + behind), 0, 255).astype(np.uint8),
        cover=np.asarray(share, dtype=np.float32),
        body=np.clip(np.rint(own), 0, 255).astype(np.uint8),
    )


@dataclass(frozen=True, eq=False)
class _Lens:
    """axes: (3, 3) right, down and ahead as rows; focal and middle in pixels."""

    position: Points
    axes: Points
    focal: float
    middle: float

    def project(self, points: Points) -> Points:
        local = (points - self.position) @ self.axes.T
        depth = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = self.focal * local[..., :2] / depth[..., None] + self.middle
        return np.concatenate([flat, depth[..., None]], axis=-1)


def _camera(body: Turned, azimuth: float, rise: float, side: int) -> _Lens:
    turn, lift = math.radians(azimuth), math.radians(rise)
    right_of_front = np.cross(body.up, body.front)
    level = math.cos(turn) * body.front + math.sin(turn) * right_of_front
    towards = math.cos(lift) * level + math.sin(lift) * body.up
    right = np.cross(body.up, level)
    axes = np.stack([right, np.cross(right, towards), -towards])
    half = math.radians(ANGLE_DEG / 2)
    return _Lens(body.centre + towards * body.radius / math.sin(half), axes, side / 2 / math.tan(half), side / 2)


def _backdrop(camera: _Lens, body: Turned, side: int) -> Pixels:
    """A disc of ground with the body's lowest part as a darker patch, before a lighter wall."""
    picture = np.full((side, side, 3), WALL, dtype=np.uint8)
    along = np.cross(body.up, body.front)
    foot = body.centre + (body.ground - float(body.centre @ body.up)) * body.up
    angles = np.linspace(0, 2 * math.pi, 97)[:-1, None]
    rim = foot + 1.25 * body.radius * (np.cos(angles) * body.front + np.sin(angles) * along)
    _polygon(picture, camera.project(rim), GROUND)
    heights = body.vertices @ body.up - body.ground
    low = body.vertices[heights < CONTACT_SHARE * max(float(heights.max()), 1e-9)]
    if len(low) > 2:
        flat = low - (low @ body.up - body.ground)[:, None] * body.up
        shadow = np.zeros((side, side), dtype=np.uint8)
        for x, y, _ in np.rint(camera.project(flat)).astype(int):
            cv2.circle(shadow, (int(x), int(y)), max(1, side // 90), 255, cv2.FILLED)
        soft = cv2.GaussianBlur(shadow, (0, 0), side / 90).astype(np.float32)[..., None] / 255.0
        picture = np.asarray(picture * (1.0 - 0.3 * soft), dtype=np.uint8)
    return picture


def _polygon(picture: Pixels, projected: Points, colour: tuple[int, int, int]) -> None:
    if (projected[:, 2] > 0).all():
        places = np.rint(projected[:, :2] * 16).astype(np.int32)
        cv2.fillPoly(picture, [places], colour, lineType=cv2.LINE_AA, shift=4)


NAMES = {0: "front", 90: "right side", 180: "back", 270: "left side"}
FROM_ABOVE_DEG = 89.0


def sheet(body: Turned, *, side: int = SIDE) -> Pixels:
    """Return the turntable (2 side, 5 side, 3): eight views, the view from above, and the legend, row by row.

    The upper row has 0 to 135 degrees and the view from above, the lower one 180 to 315 and the legend.
    """
    views = [view(body, azimuth, side=side).pixels for azimuth in AZIMUTHS]
    for azimuth, picture in zip(AZIMUTHS, views, strict=True):
        write(picture, f"{azimuth}", NAMES.get(azimuth, ""))
    above = view(body, 0.0, side=side, rise=FROM_ABOVE_DEG, ground=False).pixels
    write(above, "", "from above")
    upper = np.concatenate([*views[:4], above], axis=1)
    lower = np.concatenate([*views[4:], _legend(side)], axis=1)
    return np.concatenate([upper, lower])


def row(body: Turned, azimuths: Sequence[float], *, side: int = SIDE) -> Pixels:
    """Return views from ``azimuths`` side by side (side, n side, 3), each with its angle."""
    pictures = [view(body, azimuth, side=side).pixels for azimuth in azimuths]
    for azimuth, picture in zip(azimuths, pictures, strict=True):
        write(picture, f"{azimuth:g}", NAMES.get(round(azimuth), ""))
    return np.concatenate(pictures, axis=1)


def write(picture: Pixels, degrees: str, words: str) -> None:
    """Write an angle with its sign of degrees, and words, into the top left corner of a view."""
    scale = picture.shape[0] / 640
    font, x, y = cv2.FONT_HERSHEY_SIMPLEX, round(14 * scale), round(32 * scale)
    if degrees:
        cv2.putText(picture, degrees, (x, y), font, scale, INK, 1, cv2.LINE_AA)
        # OpenCV's letters have no sign of degrees. Sixteenths of a pixel.
        x += cv2.getTextSize(degrees, font, scale, 1)[0][0] + round(7 * scale)
        cv2.circle(picture, (16 * x, round(14 * 16 * scale)), round(4 * 16 * scale), INK, 1, cv2.LINE_AA, shift=4)
        x += round(20 * scale)
    cv2.putText(picture, words, (x, y), font, scale, INK, 1, cv2.LINE_AA)


def _legend(side: int) -> Pixels:
    """A plan: the body in the middle, the photo's camera below it, the views around."""
    picture = np.full((side, side, 3), WALL, dtype=np.uint8)
    middle, reach = side / 2, side * 0.36
    centre = (round(middle), round(middle))
    cv2.circle(picture, centre, round(reach), GROUND, 2, cv2.LINE_AA)
    cv2.circle(picture, centre, round(reach * 0.38), GROUND, cv2.FILLED, cv2.LINE_AA)
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, side / 760
    for azimuth in AZIMUTHS:
        turn = math.radians(azimuth)
        x, y = middle + reach * math.sin(turn), middle + reach * math.cos(turn)
        text = f"{azimuth}"
        (width, height), _ = cv2.getTextSize(text, font, scale, 1)
        cv2.circle(picture, (round(x), round(y)), round(side * 0.055), WALL, cv2.FILLED, cv2.LINE_AA)
        cv2.putText(picture, text, (round(x - width / 2), round(y + height / 2)), font, scale, INK, 1, cv2.LINE_AA)
    for text, y in (("body", middle), ("photo taken here", side * 0.965)):
        (width, height), _ = cv2.getTextSize(text, font, scale, 1)
        cv2.putText(picture, text, (round(middle - width / 2), round(y + height / 2)), font, scale, INK, 1, cv2.LINE_AA)
    write(picture, "", "views, seen from above")
    return picture
