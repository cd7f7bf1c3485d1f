# SPDX-License-Identifier: MIT
"""Light at an object's surface from sky, sun and ground: occluded irradiance, GGX reflections.

Light is measured so that a white matt surface lying open on the ground has brightness (1, 1, 1): a photo's white
balance makes the whole light white, and its exposure makes such a surface about white. Diffuse shading is irradiance
over π: the unoccluded sky is integrated over its whole map, and occlusion is sampled in ``LATTICE`` directions by
depth maps (Williams, Casting Curved Shadows on Curved Surfaces, SIGGRAPH 1978; filtered over four cells as by Reeves,
Salesin and Cook, SIGGRAPH 1987). Occluded directions see other surfaces.

Reflections are GGX microfacets (Walter et al., EGSR 2007): D F G / (4 n·l n·v) with α = roughness² (Burley, Physically
Based Shading at Disney, 2012), Smith's height-correlated G (Heitz, JCGT 2014), Schlick's F (1994), and Karis' fit of
the environment term (Physically Based Shading on Mobile, 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...plane_axes import plane_axes
from ...scene.equirectangular import LUMINANCE, Radiance, directions
from ...scene.model import Camera, Light
from ..lighting.ground_lighting import sun_disc, surface_points

Values = NDArray[np.float64]


def spherical_convolution(picture: Values, weight: Callable[[Values], Values]) -> Values:
    """Return the integral (H, W, C) of ``picture`` (H, W, C) times ``weight`` of the cosine to each pixel's direction.

    A rotation about the vertical only shifts columns, so between two rows this is a circular convolution, computed as
    products of Fourier coefficients: W times less work than over all pairs of pixels, with the same result.
    """
    height, width = picture.shape[:2]
    towards, solid = directions(height, width)
    cosine = np.einsum("ik,jdk->ijd", towards[:, 0], towards)
    kernel = np.fft.rfft(weight(np.clip(cosine, -1.0, 1.0)), axis=2)
    light = np.fft.rfft(picture * solid[..., None], axis=1)
    # Row i, column c meets row j, column c + d with the kernel's d: a correlation, hence the conjugate.
    product = np.einsum("ijf,jfc->ifc", kernel.conj(), light, optimize=True)
    return np.asarray(np.fft.irfft(product, n=width, axis=1))


Points = NDArray[np.float64]

CELLS = 64
"""Cells along the longer side of the shaded points."""
SLACK = 1.5
"""Depth bias in cells."""


class Occluders:
    """Shadows on ``points`` (N, 3) with unit ``normals`` (N, 3) by surfaces sampled densely by ``surface`` (M, 3)."""

    def __init__(self, surface: Points, points: Points, normals: Points) -> None:
        self._surface = surface
        cell = max(float(np.ptp(points, axis=0).max()), 1e-12) / CELLS
        self._cell = cell
        # Offset from the surface, or a point would shadow itself.
        self._points = points + SLACK * cell * normals

    def reached(self, direction: Points) -> NDArray[np.float64]:
        """Return the share (N,) of light from the unit vector ``direction`` (3,) that reaches each point past the
        surfaces."""
        first, second = plane_axes(direction)
        axes, cell = np.stack([first, second, direction]), self._cell
        # One array a component: this is computed in more than a hundred directions.
        x, y, height = np.ascontiguousarray((self._surface @ axes.T).T)
        places = np.ascontiguousarray((self._points @ axes.T).T)
        low = places[:2].min(axis=1) - 2 * cell
        columns, rows = (int(v) + 4 for v in np.ptp(places[:2], axis=1) / cell)
        column, row = np.floor((x - low[0]) / cell), np.floor((y - low[1]) / cell)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        lowest = float(min(places[2].min(), height.min())) - 4 * cell
        depth = np.full(rows * columns, lowest, dtype=np.float64)
        np.maximum.at(depth, (row * columns + column)[inside].astype(np.int64), height[inside])
        grid = depth.reshape(rows, columns).astype(np.float32)
        closed = cv2.morphologyEx(grid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        flat = np.asarray(closed, dtype=np.float64).ravel()
        x, y = (places[0] - low[0]) / cell - 0.5, (places[1] - low[1]) / cell - 0.5
        column, row = np.floor(x), np.floor(y)
        right, lower = x - column, y - row
        index = (row * columns + column).astype(np.int64)
        limit = places[2] + SLACK * cell
        open_to = np.zeros(len(limit))
        for step, share in (
            (0, (1 - right) * (1 - lower)),
            (1, right * (1 - lower)),
            (columns, (1 - right) * lower),
            (columns + 1, right * lower),
        ):
            open_to += share * (flat[index + step] <= limit)
        return open_to


SKY_SIZE = (64, 32)
LATTICE = 128
"""Directions in which occlusion is sampled."""
SUN_POINTS = 8
LOWEST_SUN = 0.05
USUAL_GROUND = 0.3
BRIGHTEST_GROUND = 0.8
"""Albedo: white paper and snow are slightly brighter, ordinary grounds darker."""


@dataclass(frozen=True, eq=False)
class LocalLighting:
    """The light of a scene above the ground z = 0.

    sky: (32, 64, 3) radiance, black below the horizon. ground: (3,) albedo. sun: (3,) unit vector towards the sun, or
    None. sun_radiance: irradiance over π of a surface that faces the sun. sun_angle: its diameter in rad. white: (3,)
    linear pixel values of brightness 1.
    """

    sky: NDArray[np.float64]
    ground: Points
    sun: Points | None
    sun_radiance: float
    sun_angle: float
    white: Points

    @property
    def ground_radiance(self) -> Points:
        """Return the radiance RGB (3,) of ground in open light."""
        return self.ground


def local_lighting(
    camera: Camera, background: NDArray[np.float32], place: Points, size: float, radiance: Radiance, light: Light
) -> LocalLighting:
    """Return the light around ``place`` (3,) on the ground, over ``size``, both in the unit of ``camera``.

    background: (H, W, 3) linear, without the objects and their shadows. radiance: the environment.
    """
    sky = cv2.resize(np.asarray(radiance, dtype=np.float32), SKY_SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)
    towards, solid = directions(SKY_SIZE[1], SKY_SIZE[0])
    sky[towards[..., 2] <= 0] = 0.0
    open_light = np.einsum("hwc,hw,hw->c", sky, np.maximum(towards[..., 2], 0.0), solid) / np.pi
    level = max(float(open_light @ LUMINANCE), 1e-9)
    strength = light.sun_strength if light.sun_direction is not None else 0.0
    sky = sky / np.maximum(open_light, 0.05 * level) / (1.0 + strength)
    sun, sun_radiance = None, 0.0
    if light.sun_direction is not None and strength > 0:
        sun = np.asarray(light.sun_direction, dtype=np.float64)
        sun_radiance = strength / (1.0 + strength) / max(float(sun[2]), LOWEST_SUN)
    colour = _ground_colour(camera, background, place, size)
    exposure = 1.0 if colour is None else max(1.0, float(colour @ LUMINANCE) / BRIGHTEST_GROUND)
    ground = np.full(3, USUAL_GROUND) if colour is None else np.clip(colour / exposure, 0.02, 0.95)
    return LocalLighting(sky, ground, sun, sun_radiance, light.sun_angle, np.full(3, exposure))


def _ground_colour(camera: Camera, background: NDArray[np.float32], place: Points, size: float) -> Points | None:
    """Median colour of the surrounding ground; None if too little is visible."""
    steps = np.linspace(-2.0, 2.0, 41) * size
    x, y = np.meshgrid(steps, steps)
    spots = np.column_stack([x.ravel() + place[0], y.ravel() + place[1], np.zeros(x.size)])
    at = camera.project(spots)
    height, width = background.shape[:2]
    inside = (at[:, 2] > 0) & (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height)
    if inside.sum() < 60:
        return None
    columns, rows = at[inside, :2].astype(int).T
    return np.asarray(np.median(background[rows, columns], axis=0), dtype=np.float64)


def sphere_directions(count: int = LATTICE) -> Points:
    """Return unit vectors (count, 3) evenly over the sphere, in sunflower order."""
    number = np.arange(count)
    height = 1.0 - (2.0 * number + 1.0) / count
    turn = number * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])


def sun_points(scene: LocalLighting, count: int = SUN_POINTS) -> Points:
    """Return unit vectors (count, 3) over the sun's disc, above the horizon. Requires a sun."""
    assert scene.sun is not None
    disc, weight = sun_disc(scene.sun, scene.sun_angle, count)
    return disc[weight > 0] if (weight > 0).any() else scene.sun[None]


Mesh = tuple[Points, NDArray[np.integer]]

POINTS_A_CELL, POINTS = 4.0, (4000, 200_000)
"""Points per cell on each surface for the depth maps, and their limits."""
PATCH = 20
"""Samples along a side of the ground patch."""
PATCH_REACH = 2.5
"""Margin of the patch around the object, over its largest extent."""


@dataclass(frozen=True, eq=False)
class Shading:
    """Light at N points. ambient: (N, 3) by sky, ground and other surfaces; sun: (N,). reached: (N,) unoccluded share
    of the sun, 0 to 1, before the cosine; openness: (N,) visible share of sky and ground, 0 to 1."""

    ambient: Points
    sun: NDArray[np.float64]
    reached: NDArray[np.float64]
    openness: NDArray[np.float64]

    @property
    def total(self) -> Points:
        """Return the brightness (N, 3) of a white matt surface."""
        return self.ambient + self.sun[:, None]


def shade(
    scene: LocalLighting,
    points: Points,
    normals: Points,
    own: Mesh,
    others: Sequence[Mesh],
    surface_colour: Points,
) -> Shading:
    """Return the light at ``points`` (N, 3) with unit ``normals`` (N, 3) on the surface ``own`` among ``others``.

    surface_colour: (3,) albedo assumed for all reflecting surfaces.
    """
    extent = float(np.ptp(own[0], axis=0).max())
    solid = np.concatenate([_dense(mesh, extent / CELLS) for mesh in (own, *others)])
    occluders = Occluders(solid, points, normals)
    towards = sphere_directions()
    sky = _gathered(scene.sky, towards)
    patch = _GroundPatch(scene, own[0].mean(axis=0), extent * PATCH_REACH, solid, towards, sky)
    unoccluded, seen_light = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    bounced, hidden = np.zeros((len(points), 3)), np.zeros(len(points))
    for direction, light in zip(towards, sky, strict=True):
        cosine = np.maximum(normals @ direction, 0.0) * (4.0 / len(towards))
        reached = occluders.reached(direction)
        hidden += cosine * (1.0 - reached)
        if direction[2] > 0:
            unoccluded += cosine[:, None] * light
            seen_light += (cosine * reached)[:, None] * light
        else:
            bounced += (cosine * reached)[:, None] * patch.radiance(points, direction)
    exact = _sky_irradiance(scene.sky, normals)
    ratio = np.where(unoccluded > 1e-6, seen_light / np.maximum(unoccluded, 1e-6), 1.0)
    sun, reached_sun = np.zeros(len(points)), np.zeros(len(points))
    if scene.sun is not None:
        disc = sun_points(scene)
        for direction in disc:
            reached = occluders.reached(direction) / len(disc)
            reached_sun += reached
            sun += scene.sun_radiance * reached * np.maximum(normals @ direction, 0.0)
    direct = exact * np.minimum(ratio, 1.0) + bounced
    usual = float(np.median((direct + sun[:, None]).mean(axis=1)))
    ambient = direct + hidden[:, None] * surface_colour * usual
    return Shading(ambient, sun, reached_sun, np.clip(1.0 - hidden, 0.0, 1.0))


def _dense(mesh: Mesh, cell: float) -> Points:
    """Points over ``mesh``, several in each square of side ``cell``, so that no light leaks through."""
    a, b, c = (mesh[0][mesh[1][:, corner]] for corner in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2.0
    count = np.clip(POINTS_A_CELL * area / max(cell, 1e-12) ** 2, *POINTS)
    return surface_points(*mesh, count=int(count))


def _gathered(sky: NDArray[np.float64], towards: Points) -> Points:
    """Mean radiance (D, 3) of ``sky`` in the part of the sphere around each of ``towards`` (D, 3); energy is
    conserved."""
    pixels, solid = directions(*sky.shape[:2])
    nearest = np.argmax(pixels.reshape(-1, 3) @ towards.T, axis=1)
    result = np.zeros((len(towards), 3))
    np.add.at(result, nearest, (sky * solid[..., None]).reshape(-1, 3))
    return result / (4 * np.pi / len(towards))


def _sky_irradiance(sky: NDArray[np.float64], normals: Points) -> Points:
    """Irradiance over π (N, 3) by ``sky`` alone at unit ``normals`` (N, 3), through a map over all normals."""
    table = spherical_convolution(sky, lambda cosine: np.maximum(cosine, 0.0) / np.pi)
    return sample_map(table, normals)


def sample_map(table: NDArray[np.float64], towards: Points) -> Points:
    """Return ``table`` (H, 2 H, 3), equirectangular, in the unit vectors ``towards`` (N, 3), bilinear."""
    height, width = table.shape[:2]
    around = np.concatenate([table[:, -1:], table, table[:, :1]], axis=1).astype(np.float32)
    column = (0.5 - np.arctan2(towards[:, 1], towards[:, 0]) / (2 * np.pi)) * width + 0.5
    row = (0.5 - np.arcsin(np.clip(towards[:, 2], -1, 1)) / np.pi) * height - 0.5
    return sample_picture(around, column, row)


def sample_picture(picture: NDArray[np.float32], column: NDArray[np.float64], row: NDArray[np.float64]) -> Points:
    """Return ``picture`` (H, W, C) at pixel indices (N,), bilinear. OpenCV allows at most 32767 of them a row."""
    count, columns = len(column), 1024
    padded = -(-max(count, 1) // columns) * columns
    x, y = (np.pad(v.astype(np.float32), (0, padded - count)).reshape(-1, columns) for v in (column, row))
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float64).reshape(padded, -1)[:count]


class _GroundPatch:
    """The ground around an object, darker where objects occlude its light."""

    def __init__(
        self, scene: LocalLighting, middle: Points, reach: float, solid: Points, towards: Points, sky: Points
    ) -> None:
        self._scene, self._low, self._step = scene, middle[:2] - reach, 2 * reach / (PATCH - 1)
        steps = np.arange(PATCH) * self._step
        x, y = np.meshgrid(self._low[0] + steps, self._low[1] + steps)
        places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        up = np.broadcast_to((0.0, 0.0, 1.0), places.shape)
        above = Occluders(solid, places, up)
        upper = towards[:, 2] > 0
        total, found = np.zeros(3), np.zeros((len(places), 3))
        for direction, light in zip(towards[upper], sky[upper], strict=True):
            total += light * direction[2]
            found += above.reached(direction)[:, None] * light * direction[2]
        sky_share = float((_sky_irradiance(scene.sky, np.array([[0.0, 0.0, 1.0]]))).mean())
        light_here = found / np.maximum(total, 1e-9) * sky_share
        if scene.sun is not None:
            disc = sun_points(scene)
            for direction in disc:
                reached = above.reached(direction) * max(float(direction[2]), 0.0)
                light_here += scene.sun_radiance * reached[:, None] / len(disc)
        self._light = np.asarray(light_here * scene.ground, dtype=np.float32).reshape(PATCH, PATCH, 3)

    def radiance(self, points: Points, direction: Points) -> Points:
        """Return RGB (N, 3) of the ground hit by rays from ``points`` (N, 3) along ``direction`` (3,), downward."""
        far = np.maximum(points[:, 2], 0.0) / max(-float(direction[2]), 1e-3)
        at = (points[:, :2] + far[:, None] * direction[:2] - self._low) / self._step
        inside = ((at >= 0) & (at <= PATCH - 1)).all(axis=1)
        return np.where(inside[:, None], sample_picture(self._light, at[:, 0], at[:, 1]), self._scene.ground_radiance)


DIELECTRIC_F0 = 0.04
LEAST_ROUGHNESS = 0.03


def sun_lobe(
    scene: LocalLighting, normals: Points, views: Points, roughness: float, f0: float, disc: Points | None = None
) -> NDArray[np.float64]:
    """Return the reflected sun (N,) at unit ``normals`` (N, 3) towards unit ``views`` (N, 3), unoccluded.

    f0: reflectance at normal incidence. disc: unit vectors (D, 3) over the sun in place of the scene's.
    """
    alpha = max(roughness, LEAST_ROUGHNESS) ** 2
    if disc is None:
        disc = sun_points(scene)
    # One array a component: rows of three are slow.
    n, v = np.ascontiguousarray(normals.T), np.ascontiguousarray(views.T)
    facing = np.maximum(_dot(n, v), 1e-3)
    result = np.zeros(len(normals))
    for light in disc:
        lit = np.maximum(normals @ light, 0.0)
        half = v + light[:, None]
        half /= np.maximum(np.sqrt(_dot(half, half)), 1e-9)
        straight = np.clip(_dot(n, half), 0.0, 1.0)
        # 1 - cos² loses precision for a sharp lobe, so compute the sine by the cross product.
        across = np.stack([n[i] * half[j] - n[j] * half[i] for i, j in ((1, 2), (2, 0), (0, 1))])
        sine2 = _dot(across, across)
        spread = alpha**2 / (np.pi * (sine2 + alpha**2 * straight**2) ** 2 + 1e-30)
        smith = lit * np.sqrt(facing**2 * (1 - alpha**2) + alpha**2) + facing * np.sqrt(
            lit**2 * (1 - alpha**2) + alpha**2
        )
        fresnel = f0 + (1.0 - f0) * (1.0 - np.clip(_dot(v, half), 0.0, 1.0)) ** 5
        # D F G / (4 n·l n·v) times n·l, with G / (4 n·l n·v) = 1 / (2 smith); π for brightness from irradiance over π.
        result += np.where(lit > 0, spread * fresnel * 0.5 / np.maximum(smith, 1e-9) * lit, 0.0)
    return result * (np.pi * scene.sun_radiance / len(disc))


def _dot(first: Points, second: Points) -> NDArray[np.float64]:
    """Inner products (N,) of the columns of ``first`` and ``second``, both (3, N)."""
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


def sky_lobe(
    scene: LocalLighting, normals: Points, views: Points, roughness: float, f0: NDArray[np.float64] | float
) -> Points:
    """Return the reflected sky and ground (N, 3), unoccluded; ``f0``: a number or RGB (3,)."""
    height, width = scene.sky.shape[:2]
    towards, _ = directions(height, width)
    around = np.where(towards[..., 2:] > 0, scene.sky, scene.ground_radiance)
    alpha = max(roughness, 0.12) ** 2

    def lobe(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
        # About the mirror direction at normal incidence: h halfway between it and the light.
        straight2 = (1.0 + cosine) / 2.0
        return np.maximum(cosine, 0.0) * alpha**2 / (straight2 * (alpha**2 - 1.0) + 1.0) ** 2

    both = spherical_convolution(np.concatenate([around, np.ones((height, width, 1))], axis=2), lobe)
    blurred = both[..., :3] / both[..., 3:]
    facing = np.clip((normals * views).sum(axis=1), 1e-3, 1.0)
    mirrored = 2.0 * (normals * views).sum(axis=1, keepdims=True) * normals - views
    scale, bias = _karis(roughness, facing)
    return sample_map(blurred, mirrored) * (np.asarray(f0) * scale[:, None] + bias[:, None])


def _karis(roughness: float, facing: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y, z, w = (a * roughness + b for a, b in ((-1.0, 1.0), (-0.0275, 0.0425), (-0.572, 1.04), (0.022, -0.04)))
    bent = np.minimum(x * x, np.exp2(-9.28 * facing)) * x + y
    return -1.04 * bent + z, 1.04 * bent + w
