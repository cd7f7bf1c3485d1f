# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth and volume of bodies made from one silhouette, against bodies of known geometry.

    python -m physgen.benchmarks.shapes [--only BODY …] [--pitch DEG …] [--sheet FILE.png]

Bodies of balls, capsules and boxes stand on the ground in front of a known camera; their silhouettes, without pictures
or names, become bodies. Thickness is the length of a pixel's ray inside the body, from its first to its last surface
in holes' absence; truth is exact, by ray intersection. Reported for each body and pitch:

    thickness   mean of |made − true| over the silhouette, over the mean of the true thickness
    depth       mean distance of the made front from the true one, over the body's true mean thickness
    volume      made over true
    iou         overlap of the silhouettes

``--sheet`` draws each body beside the truth from eight sides.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser, print_result
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.shape.built_body import build_body
from physgen.sim.scene.model import Camera
from PIL import Image

Points = NDArray[np.float64]
Faces = NDArray[np.int64]
Point = tuple[float, float, float]

WIDTH, HEIGHT, FOCAL = 480, 360, 520.0
SIZE = 0.4
"""Scale of the bodies over the distance of their feet from the camera."""


@dataclass(frozen=True)
class Capsule:
    """All points within ``radius`` of the segment from ``start`` to ``end``; a ball where both are equal."""

    start: Point
    end: Point
    radius: float

    def interval(self, origin: Points, rays: Points) -> tuple[Points, Points]:
        """Return where each of ``rays`` (n, 3) from ``origin`` (3,) enters and leaves; enter > leave for a miss."""
        a, b = np.array(self.start), np.array(self.end)
        ends = [_ball(origin - centre, rays, self.radius) for centre in (a, b)]
        axis = b - a
        length = float(np.linalg.norm(axis))
        if length > 1e-9:
            ends.append(_tube(origin - a, rays, axis / length, length, self.radius))
        return np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)


@dataclass(frozen=True)
class Block:
    """An upright box. low, high: its corners."""

    low: Point
    high: Point

    def interval(self, origin: Points, rays: Points) -> tuple[Points, Points]:
        """As for ``Capsule``."""
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (np.array(self.low) - origin) / rays, (np.array(self.high) - origin) / rays
        return np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)


def _ball(offset: Points, rays: Points, radius: float) -> tuple[Points, Points]:
    square, along = (rays**2).sum(axis=1), rays @ offset
    root = along**2 - square * (offset @ offset - radius**2)
    hit = root > 0
    root = np.sqrt(np.where(hit, root, 0.0))
    return (
        np.where(hit, (-along - root) / square, np.inf),
        np.where(hit, (-along + root) / square, -np.inf),
    )


def _tube(offset: Points, rays: Points, axis: Points, length: float, radius: float) -> tuple[Points, Points]:
    across, side = rays - (rays @ axis)[:, None] * axis, offset - (offset @ axis) * axis
    square = np.maximum((across**2).sum(axis=1), 1e-18)
    along = across @ side
    root = along**2 - square * (side @ side - radius**2)
    hit = root > 0
    root = np.sqrt(np.where(hit, root, 0.0))
    low, high = (-along - root) / square, (-along + root) / square
    slope, start = rays @ axis, offset @ axis
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = -start / slope, (length - start) / slope
    low = np.maximum(low, np.fmin(first, last))
    high = np.minimum(high, np.fmax(first, last))
    hit &= low < high
    return np.where(hit, low, np.inf), np.where(hit, high, -np.inf)


Body = list[Capsule | Block]


def _ball_at(x: float, y: float, z: float, radius: float) -> Capsule:
    return Capsule((x, y, z), (x, y, z), radius)


def bear() -> Body:
    """A plush bear that sits, its legs towards the camera and to the sides."""
    made: Body = [_ball_at(0, 0, 0.24, 0.24), _ball_at(0, -0.02, 0.58, 0.2), _ball_at(0, -0.19, 0.55, 0.08)]
    for side in (-1.0, 1.0):
        made += [
            _ball_at(side * 0.16, 0, 0.77, 0.075),
            Capsule((side * 0.2, -0.02, 0.36), (side * 0.38, -0.1, 0.24), 0.07),
            Capsule((side * 0.14, -0.1, 0.085), (side * 0.26, -0.3, 0.085), 0.085),
        ]
    return made


def dog() -> Body:
    """A dog seen from its side."""
    made: Body = [
        Capsule((-0.28, 0, 0.42), (0.25, 0, 0.44), 0.14),
        Capsule((0.3, 0, 0.5), (0.4, 0, 0.64), 0.08),
        _ball_at(0.44, 0, 0.7, 0.12),
        Capsule((0.5, 0, 0.68), (0.6, 0, 0.66), 0.06),
        Capsule((-0.4, 0, 0.46), (-0.58, 0, 0.62), 0.03),
    ]
    for x in (-0.3, 0.27):
        for y in (-0.09, 0.09):
            made.append(Capsule((x + 0.3 * y, y, 0.38), (x + 0.5 * y, y, 0.05), 0.05))
    return made


def snowman() -> Body:
    """Three balls and two thin arms."""
    return [
        _ball_at(0, 0, 0.27, 0.27),
        _ball_at(0, 0, 0.66, 0.2),
        _ball_at(0, 0, 0.96, 0.14),
        Capsule((-0.15, 0, 0.7), (-0.5, 0, 0.9), 0.02),
        Capsule((0.15, 0, 0.7), (0.5, 0, 0.85), 0.02),
    ]


def figure() -> Body:
    """A person with arms away from the body."""
    made: Body = [Capsule((0, 0, 0.55), (0, 0, 0.7), 0.12), _ball_at(0, 0, 0.93, 0.1)]
    made.append(Capsule((0, 0, 0.78), (0, 0, 0.9), 0.05))
    for side in (-1.0, 1.0):
        made.append(Capsule((side * 0.1, 0, 0.75), (side * 0.36, 0, 0.5), 0.045))
        made.append(Capsule((side * 0.07, 0, 0.5), (side * 0.14, 0, 0.06), 0.06))
    return made


def cactus() -> Body:
    """A thick stem with two bent arms."""
    return [
        Capsule((0, 0, 0.13), (0, 0, 0.85), 0.13),
        Capsule((0, 0, 0.4), (-0.3, 0, 0.42), 0.06),
        Capsule((-0.3, 0, 0.42), (-0.3, 0, 0.7), 0.06),
        Capsule((0, 0, 0.55), (0.28, 0, 0.57), 0.05),
        Capsule((0.28, 0, 0.57), (0.28, 0, 0.8), 0.05),
    ]


def chair() -> Body:
    """A chair with four legs, a seat and two slats."""
    made: Body = [Block((-0.24, -0.23, 0.43), (0.24, 0.23, 0.475))]
    for low, high in ((-0.24, -0.195), (0.195, 0.24)):
        made.append(Block((low, -0.23, 0.0), (high, -0.185, 0.45)))
        made.append(Block((low, 0.185, 0.0), (high, 0.23, 0.95)))
    for z in (0.62, 0.84):
        made.append(Block((-0.2, 0.195, z), (0.2, 0.22, z + 0.1)))
    return made


def table() -> Body:
    """A table with four legs."""
    made: Body = [Block((-0.5, -0.3, 0.5), (0.5, 0.3, 0.54))]
    for x in (-0.48, 0.44):
        for y in (-0.28, 0.24):
            made.append(Block((x, y, 0.0), (x + 0.04, y + 0.04, 0.52)))
    return made


def shelf() -> Body:
    """Three boards between two sides, no back."""
    made: Body = [Block((x, -0.13, 0.0), (x + 0.03, 0.13, 0.9)) for x in (-0.35, 0.32)]
    made += [Block((-0.34, -0.13, z), (0.34, 0.13, z + 0.03)) for z in (0.08, 0.46, 0.87)]
    return made


BODIES: dict[str, Callable[[], Body]] = {
    body.__name__: body for body in (bear, dog, snowman, figure, cactus, chair, table, shelf)
}


def view(pitch_deg: float) -> tuple[Camera, Points]:
    """Return a camera at ``pitch_deg`` and a place (3,) on the ground somewhat below the middle of its picture."""
    camera = camera_above_ground(WIDTH, HEIGHT, FOCAL, math.radians(pitch_deg))
    away = 1.0 / math.tan(math.radians(pitch_deg + 6.0))
    return camera, np.array([0.0, away, 0.0])


def moved(body: Body, scale: float, offset: Points) -> Body:
    """Return ``body`` scaled about the origin and moved by ``offset`` (3,)."""

    def at(point: Point) -> Point:
        x, y, z = (float(v) for v in scale * np.array(point) + offset)
        return x, y, z

    return [
        Capsule(at(part.start), at(part.end), scale * part.radius)
        if isinstance(part, Capsule)
        else Block(at(part.low), at(part.high))
        for part in body
    ]


@dataclass(frozen=True)
class Truth:
    """A body as the camera sees it. mask: (H, W); front, thickness: (H, W) depths; volume."""

    mask: NDArray[np.bool_]
    front: Points
    thickness: Points
    volume: float


def seen_by(camera: Camera, body: Body) -> Truth:
    """Return silhouette, depths and volume of ``body`` above the ground, exact up to pixels."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2).astype(np.float64))
    origin = camera.position
    ground = np.where(rays[:, 2] < 0, -origin[2] / np.minimum(rays[:, 2], -1e-12), np.inf)
    spans = [part.interval(origin, rays) for part in body]
    low = np.stack([enter for enter, _ in spans])
    high = np.minimum(np.stack([leave for _, leave in spans]), ground)
    low = np.where(high > low, low, np.inf)
    order = np.argsort(low, axis=0)
    low, high = np.take_along_axis(low, order, 0), np.take_along_axis(high, order, 0)
    end = np.full(len(rays), -np.inf)
    thickness, volume = np.zeros(len(rays)), 0.0
    for enter, leave in zip(low, high, strict=True):
        start, stop = np.maximum(enter, end), leave
        add = np.isfinite(enter) & (stop > start)
        thickness[add] += (stop - start)[add]
        volume += float((stop[add] ** 3 - start[add] ** 3).sum()) / (3.0 * camera.fx * camera.fy)
        end = np.where(add, stop, end)
    shape = (camera.height, camera.width)
    return Truth(np.isfinite(low[0]).reshape(shape), low[0].reshape(shape), thickness.reshape(shape), volume)


def covered(corners: Points, size: tuple[int, int]) -> tuple[Faces, Faces, Points, Points]:
    """Return each pair of a triangle and a pixel that it covers: triangle, flat pixel, weights (n, 3), and the sign of
    each triangle's area.

    corners: (T, 3, 2) in pixels; size: (height, width).
    """
    height, width = size
    low = np.maximum(np.ceil(corners.min(axis=1) - 0.5), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) - 0.5), [width - 1, height - 1]).astype(np.int64)
    span = np.maximum(high - low + 1, 0)
    count = span[:, 0] * span[:, 1]
    triangle = np.repeat(np.arange(len(corners)), count)
    index = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    x = low[triangle, 0] + index % np.maximum(span[triangle, 0], 1)
    y = low[triangle, 1] + index // np.maximum(span[triangle, 0], 1)
    a, b, c = (corners[:, i] for i in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    offset = np.column_stack([x + 0.5, y + 0.5]) - a[triangle]
    safe = np.where(np.abs(area) < 1e-12, np.inf, area)[triangle]
    e, f = (b - a)[triangle], (c - a)[triangle]
    u = (offset[:, 0] * f[:, 1] - offset[:, 1] * f[:, 0]) / safe
    v = (e[:, 0] * offset[:, 1] - e[:, 1] * offset[:, 0]) / safe
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (np.abs(area) > 1e-12)[triangle]
    weights = np.column_stack([1.0 - u - v, u, v])[inside]
    return triangle[inside], (y * width + x)[inside], weights, np.sign(area)


def depths_of(camera: Camera, vertices: Points, faces: Faces) -> tuple[Points, Points]:
    """Return front depth (H, W), inf where nothing is, and thickness (H, W) of a closed mesh, by rasterisation."""
    size = (camera.height, camera.width)
    corners = camera.project(vertices)[faces]
    triangle, pixel, weights, sign = covered(corners[..., :2], size)
    depth = 1.0 / (weights / corners[triangle, :, 2]).sum(axis=1)
    front = np.full(size[0] * size[1], np.inf)
    np.minimum.at(front, pixel, depth)
    thickness = np.bincount(pixel, weights=sign[triangle] * depth, minlength=size[0] * size[1])
    return front.reshape(size), np.abs(thickness).reshape(size)


def measured(name: str, pitch_deg: float) -> tuple[dict[str, float | str], Points, Faces]:
    """Return the figures of one body, and the mesh that was made of its silhouette."""
    camera, place = view(pitch_deg)
    body = moved(BODIES[name](), SIZE * float(np.hypot(place[1], 1.0)), place)
    truth = seen_by(camera, body)
    notices: list[str] = []
    request = ObjectRequest(box=(0, 0, WIDTH, HEIGHT), name=name)
    made = build_body(camera, truth.mask, request, ReconstructOptions(mesh_vertices=3000), notices.append)
    front, thickness = depths_of(camera, made.mesh.vertices, made.mesh.faces)
    both = truth.mask & np.isfinite(front) & np.isfinite(truth.front)
    mean = float(truth.thickness[truth.mask].mean())
    a, b, c = (made.mesh.vertices[made.mesh.faces[:, i]] for i in range(3))
    volume = float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)
    figures: dict[str, float | str] = {
        "thickness": float(np.abs(thickness - truth.thickness)[both].mean()) / mean,
        "depth": float(np.abs(front - truth.front)[both].mean()) / mean,
        "volume": volume / truth.volume,
        "iou": made.fit,
        "stability": made.stability,
        "shape": made.shape,
    }
    return figures, made.mesh.vertices, made.mesh.faces


SIDE = 150
"""Pixels of one view of a sheet."""


def drawn(vertices: Points, faces: Faces, turn: float, extent: float, tilt: float = 0.25) -> NDArray[np.uint8]:
    """Return a shaded parallel view (SIDE, SIDE) of a mesh turned by ``turn`` radians about Z and seen from above by
    ``tilt``."""
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    c, s = math.cos(turn), math.sin(turn)
    x, y, z = ((vertices - centre) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T).T
    up, depth = z * math.cos(tilt) + y * math.sin(tilt), y * math.cos(tilt) - z * math.sin(tilt)
    scale = 0.86 * SIDE / extent
    corners = np.column_stack([SIDE / 2 + scale * x, SIDE / 2 - scale * up])[faces]
    a, b, c3 = (np.column_stack([x, up, -depth])[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c3 - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    shade = 60 + 180 * np.clip(normal @ np.array([-0.4, 0.65, 0.65]), 0, 1)
    triangle, pixel, weights, _ = covered(corners, (SIDE, SIDE))
    here = (weights * depth[faces][triangle]).sum(axis=1)
    # The last one written to a pixel stays: the nearest.
    order = np.argsort(-here, kind="stable")
    image = np.full(SIDE * SIDE, 255.0)
    image[pixel[order]] = shade[triangle[order]]
    return np.clip(image, 0, 255).reshape(SIDE, SIDE).astype(np.uint8)


def turntable(vertices: Points, faces: Faces) -> NDArray[np.uint8]:
    """Return eight shaded views side by side, (SIDE, 8 SIDE)."""
    size = np.ptp(vertices, axis=0)
    extent = float(max(np.hypot(size[0], size[1]), size[2]))
    return np.concatenate([drawn(vertices, faces, k * math.pi / 4.0, extent) for k in range(8)], axis=1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = benchmark_parser("shapes", __doc__, only=["snowman"], pitch=[25.0])
    parser.add_argument("--only", nargs="+", choices=sorted(BODIES), default=list(BODIES), metavar="BODY")
    parser.add_argument("--pitch", type=float, nargs="+", default=[15.0, 30.0], metavar="DEG")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="eight views of each body")
    options = parser.parse_args(arguments)
    result: dict[str, object] = {}
    rows = []
    for name in options.only:
        for pitch in options.pitch:
            figures, vertices, faces = measured(name, pitch)
            result[f"{name} {pitch:g}"] = {
                key: value if isinstance(value, str) else round(value, 3) for key, value in figures.items()
            }
            if options.sheet:
                rows.append(turntable(vertices, faces))
    if rows:
        Image.fromarray(np.concatenate(rows)).save(options.sheet)
    print_result(result, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
