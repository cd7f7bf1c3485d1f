# SPDX-License-Identifier: GPL-3.0-or-later
"""A drawn picture of things on a ground, with the share of light that their shadows leave each pixel.

Things, cameras and lamps are those of the benchmark's pictures from other seeds; surfaces, light and everything that
disturbs are drawn here. Masks and camera are given as wrong as the program finds them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.reconstruct_pictures import cases
from physgen.benchmarks.reconstruct_pictures.cases import Case
from physgen.sim.scene.model import Camera
from physgen.sim.srgb import linear_to_bytes

from .plane_patterns import albedo, clouds
from .plane_shadows import Plane, light_on

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]
Values = NDArray[np.float64]

FIRST_SEED = 20_000
"""Of the arrangements; those of the benchmark's sets begin at 7013, 100 and 900."""
TEXTURE = 1100
"""Pixels along a pattern."""
WALLS = ("plain", "plain", "concrete", "fbm", "stripes", "patches", "dots")


@dataclass(frozen=True, eq=False)
class DrawnPicture:
    """pixels: (H, W, 3) sRGB. kept: (H, W) share of the light past all things. masks: (H, W) of each thing, and camera,
    as they are found: both a little wrong. light: sun, overcast, window or two."""

    pixels: NDArray[np.uint8]
    kept: Picture
    masks: tuple[Mask, ...]
    camera: Camera
    light: str


def draw_picture(number: int) -> DrawnPicture:
    """Return picture ``number``, from 0. Raises ValueError for a negative one, and where no arrangement is found."""
    if number < 0:
        # Below, the seeds of the benchmark's own sets would come.
        raise ValueError(f"picture {number}: numbers begin at 0")
    case = cases.draw_seed(FIRST_SEED + number, f"drawn {number}")
    rng = np.random.default_rng(10**7 + number)
    camera = _scaled(case.camera, rng.uniform(0.4, 0.6))
    light, kept, sky, size = _surfaces(case, camera, rng)
    light = light * _uneven(sky.shape, rng)[..., None]
    if rng.random() < 0.2:
        light = light * _foreign_shadow(sky, rng)[..., None]
    masks = _visible(case, camera)
    if rng.random() < 0.15:
        light = _mirrored(light, case, camera, rng)
    away = float(np.linalg.norm(camera.position))
    for item in case.items:
        grain = np.exp(0.3 * clouds(sky.shape, max(4, size / 2 * camera.fx / away), rng, 4))
        light = np.where(masks[item.name][..., None], item.paint[0] * grain[..., None] * 1.5, light)
    pixels = _taken(light, rng)
    given = _found_masks([masks[item.name] for item in case.items], kept, rng)
    found = _found_camera(camera, rng)
    return DrawnPicture(pixels=pixels, kept=kept, masks=tuple(given), camera=found, light=case.light)


def _scaled(camera: Camera, scale: float) -> Camera:
    sides = {"width": round(camera.width * scale), "height": round(camera.height * scale)}
    lens = {key: getattr(camera, key) * scale for key in ("fx", "fy", "cx", "cy")}
    return dataclasses.replace(camera, **sides, **lens)


def _surfaces(case: Case, camera: Camera, rng: np.random.Generator) -> tuple[Picture, Picture, Mask, float]:
    """Linear light (H, W, 3) of ground and wall, the share (H, W) of it past the things, where neither is, and the
    things' size in metres."""
    parts = [part for item in case.items for part in item.parts]
    points = np.concatenate(parts)
    top, low, high = points[:, 2].max(), points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    size = max(float((high - low).max()), float(top))
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([x + 0.5, y + 0.5], axis=-1).astype(float))
    ground = Plane(np.zeros(3), np.eye(3), low - 3.2 * top, high + 3.2 * top)
    planes, depths = [ground], [_depth(ground, camera, rays)]
    if case.wall is not None:
        planes.append(_wall(case, low, high, top))
        depths.append(_depth(planes[1], camera, rays))
    nearest = np.min(depths, axis=0)
    light, kept = np.zeros((*nearest.shape, 3), np.float32), np.ones(nearest.shape, np.float32)
    # Lit things give back some of the light that they block, and lit ground shines on the wall.
    strength = sum(lamp.strength for lamp in case.lamps)
    paint = float(np.mean([item.paint[0] for item in case.items]))
    loss = float(np.clip(1.0 - paint * (0.6 + 0.5 * strength) * rng.uniform(0.7, 1.3), 0.15, 1.0))
    bounce = rng.uniform(0.15, 0.5) * (1.0 + strength)
    for plane, depth in zip(planes, depths, strict=True):
        region = np.isfinite(depth) & (depth == nearest)
        if not region.any():
            continue
        places = plane.in_frame(camera.position + np.where(region, depth, 0.0)[..., None] * rays)
        # A wall sees the sides that the lamps do not reach.
        lost = loss if plane is ground else 1.0
        lit, bare = light_on(plane, parts, case, rng, loss=lost, bounce=bounce)
        seen = np.stack([plane.sampled(lit[..., k], places, float(bare[k])) for k in range(3)], axis=-1)
        painted = _painted(plane, places, size, rng, wall=plane is not ground)
        light = np.where(region[..., None], painted * seen, light)
        kept = np.where(region, seen.mean(axis=-1) / bare.mean(), kept)
    sky = ~np.isfinite(nearest)
    light[sky] = 1.2
    return light, kept, sky, size


def _depth(plane: Plane, camera: Camera, rays: Values) -> Values:
    """Depth (H, W) along ``rays`` at which they meet the front of ``plane``, else inf."""
    toward = rays @ plane.axes[2]
    with np.errstate(all="ignore"):
        depth = np.where(toward < -1e-6, ((plane.origin - camera.position) @ plane.axes[2]) / toward, np.inf)
    return np.where(depth > 0, depth, np.inf)


def _wall(case: Case, low: Values, high: Values, top: float) -> Plane:
    assert case.wall is not None
    along = np.array([1.0, math.tan(case.wall_turn), 0.0])
    along /= np.linalg.norm(along)
    up = np.array([0.0, 0.0, 1.0])
    axes = np.stack([along, up, np.cross(along, up)])
    edges = np.array([low[0] - 2.5 * top, -0.05 * top]), np.array([high[0] + 2.5 * top, 2.5 * top])
    return Plane(np.array([0.0, case.wall, 0.0]), axes, *edges)


def _painted(plane: Plane, places: Values, size: float, rng: np.random.Generator, *, wall: bool) -> Picture:
    """Albedo (H, W, 3) of ``plane`` at ``places``; of a ground sometimes with another surface beside it."""
    span = max(float((plane.high - plane.low).max()) * 1.3, 1e-6)
    shape, unit = (TEXTURE, TEXTURE), TEXTURE / span * size
    texture = albedo(shape, unit, rng, str(rng.choice(WALLS)) if wall else None)
    if not wall and rng.random() < 0.3:
        beside = albedo(shape, unit, rng)
        turn, middle = rng.uniform(0, 6.28), TEXTURE * (0.5 + rng.uniform(-0.35, 0.35, 2))
        y, x = np.mgrid[:TEXTURE, :TEXTURE]
        across = math.cos(turn) * (x - middle[0]) + math.sin(turn) * (y - middle[1])
        other = across > TEXTURE * rng.uniform(0.05, 0.3)
        if rng.random() < 0.4:
            along = -math.sin(turn) * (x - middle[0]) + math.cos(turn) * (y - middle[1])
            other |= along > TEXTURE * rng.uniform(0.05, 0.3)
        texture = np.where(other[..., None], beside, texture)
    at = ((places[..., :2] - (plane.low + plane.high) / 2) / span + 0.5) * TEXTURE
    at = np.where(np.isfinite(at), at, 0).clip(-1e5, 1e5).astype(np.float32)
    steps = cv2.Sobel(at, cv2.CV_32F, 1, 0, ksize=1) / 2, cv2.Sobel(at, cv2.CV_32F, 0, 1, ksize=1) / 2
    total = np.zeros((*at.shape[:2], 3), np.float32)
    # Four places in a pixel, or distant patterns flicker.
    for x, y in ((-0.25, -0.25), (0.25, 0.25), (-0.25, 0.25), (0.25, -0.25)):
        moved = at + x * steps[0] + y * steps[1]
        total += cv2.remap(texture, moved[..., 0], moved[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return total / 4


def _uneven(shape: tuple[int, int], rng: np.random.Generator) -> Values:
    """Light (H, W) that falls off across the picture, with a vignette and at times a pool of a lamp."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    x, y = x / shape[1] - 0.5, y / shape[0] - 0.5
    slope = rng.normal(size=2) * 0.25
    field = np.exp(slope[0] * x + slope[1] * y - rng.uniform(0, 0.6) * (x**2 + y**2))
    if rng.random() < 0.3:
        at = rng.uniform(-0.5, 0.5, 2)
        bright = rng.uniform(0.2, 0.8)
        field *= 1 + bright * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / rng.uniform(0.05, 0.4))
    return np.asarray(field)


def _foreign_shadow(sky: Mask, rng: np.random.Generator) -> Values:
    """Share (H, W) of light past something outside of the picture: its shadow is no thing's."""
    height, width = sky.shape
    corners = np.int32(rng.uniform(-0.2, 1.2, (4, 2)) * (width, height))
    side = np.int32([(width, 0), (-width, 0), (0, height), (0, -height)][rng.integers(0, 4)])
    covered = np.zeros(sky.shape, np.float32)
    cv2.fillConvexPoly(covered, cv2.convexHull(corners + side // 2), 1.0)
    covered = cv2.GaussianBlur(covered, (0, 0), rng.uniform(0.7, 12))
    return np.asarray(1 - rng.uniform(0.2, 0.7) * covered * ~sky)


def _visible(case: Case, camera: Camera) -> dict[str, Mask]:
    items = {item.name: item for item in case.items}
    before = np.zeros((camera.height, camera.width), bool)
    masks = {}
    for name in case.order:
        whole = cases.silhouette(camera, items[name])
        masks[name] = whole & ~before
        before = before | whole
    return masks


def _mirrored(light: Picture, case: Case, camera: Camera, rng: np.random.Generator) -> Picture:
    """``light`` with faint mirror images of the things, as on a polished ground."""
    strength = rng.uniform(0.03, 0.25)
    for item in case.items:
        below = [part * (1, 1, -1) for part in item.parts]
        image = cases.hulls(camera, [part for part in below if (camera.project(part)[:, 2] > 0).all()])
        share = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(0.6, 4))[..., None]
        light = light * (1 - strength * share) + strength * share * item.paint[0] * rng.uniform(0.3, 1.2)
    return light


def _taken(light: Picture, rng: np.random.Generator) -> NDArray[np.uint8]:
    """sRGB of ``light`` as a camera takes it: a little soft, exposed, with its tone curve, grain and JPEG."""
    light = cv2.GaussianBlur(light, (0, 0), rng.uniform(0.35, 0.9))
    light = light * rng.uniform(0.7, 1.0) * 0.85 / max(np.percentile(light.max(axis=-1), 99), 1e-6)
    light = np.clip(light, 0, 1) ** rng.uniform(0.85, 1.15)
    pixels = linear_to_bytes(light.astype(np.float32)).astype(np.float32)
    grain = cv2.GaussianBlur(rng.normal(size=pixels.shape).astype(np.float32), (0, 0), 0.6)
    grain *= rng.uniform(0.6, 3.0) / grain.std()
    whole = np.clip(np.rint(pixels + grain), 0, 255).astype(np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(75, 98))]
    file = cv2.imencode(".jpg", whole[..., ::-1], quality)[1]
    return np.ascontiguousarray(cv2.imdecode(file, cv2.IMREAD_COLOR)[..., ::-1])


def _found_masks(masks: Sequence[Mask], kept: Picture, rng: np.random.Generator) -> list[Mask]:
    """``masks`` (H, W) a pixel too large or small at times, or with a strip of their shadow."""
    found = []
    for index, true in enumerate(masks):
        mask, chance = true, rng.random()
        if chance < 0.2:
            mask = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        elif chance < 0.4:
            mask = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        if rng.random() < 0.12:
            beside = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
            mask = mask | ((kept < rng.uniform(0.4, 0.8)) & beside)
        for other, blocked in enumerate(masks):
            if other != index:
                mask = mask & ~blocked
        found.append(np.asarray(mask))
    return found


def _found_camera(camera: Camera, rng: np.random.Generator) -> Camera:
    """``camera`` pitched a few degrees wrong, and with another focal length."""
    turn, longer = math.radians(rng.normal() * 3.0), float(np.exp(rng.normal() * 0.07))
    pitch = np.eye(4)
    pitch[1:3, 1:3] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    pose = np.array(camera.world_from_camera) @ pitch
    rows = tuple(tuple(float(value) for value in row) for row in pose)
    return dataclasses.replace(
        camera,
        fx=camera.fx * longer,
        fy=camera.fy * longer,
        world_from_camera=rows,  # type: ignore[arg-type]
    )
