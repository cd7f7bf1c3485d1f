# SPDX-License-Identifier: MIT
"""Mirror images of bodies in the ground, and the ground's roughness, told by how blurred the photo's are.

A mirror image is the more blurred, the higher the mirrored point is (``floor_reflection.blur_sigma``).
The photo is compared with mirror images of every roughness scale by scale (a Laplacian pyramid): a ground too smooth
promises detail that the photo lacks, one too rough lacks what the photo shows. Ground has a grain of its own at each
scale; it decides how much that scale counts, as in a Gaussian likelihood whose variance in each band is unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ...composite import floor_reflection
from ...composite.pull_push import spread_values
from ...scene.model import Camera, Ground
from ...srgb import bytes_to_linear
from ..mesh_raster import Paint, colours, visible_pixels
from ..shape.body_texture import TexturedSurface

Mask = NDArray[np.bool_]
Image = NDArray[np.float32]
Values = NDArray[np.float64]
Place = tuple[float, float, float]

VARNISH = 0.04
"""Reflectivity of the mirror images that are compared; the share that is found is measured in this one's."""
DARKEST = 4e-3
"""Linear light below which ratios are unreliable."""
LEVEL = 0.5
"""Blur that tells the ground's level, over the smaller side of the mirror images."""
FIT_SIDE = 240
"""Size in pixels of the largest object in the picture on which blur is measured, at most."""
SMOOTHEST, ROUGHEST, CANDIDATES = 0.02, 0.4, 9
"""Range of roughness, and how many are tried before the best is refined. Below, the blur is less than a pixel of most
photos; beyond, a mirror image is a haze."""
REFINED = 0.02
"""Logarithm to which roughness is refined."""
ROUNDS = 2
"""Times that place and roughness are found in turn."""
COARSEST = 12
"""Smaller side in pixels of a mirror image in the coarsest band."""
FEWEST = 60
"""Fewest pixels of a band that are compared."""
MOST_DEVIATING = 10.0
"""Standard deviations beyond which a band counts as that far: glints and scratches."""
ASIDE, UP, TALLER = 0.04, 0.06, 0.1
"""Distance by which a mirror image may lie off, over its width and height, and by how much it may be taller or lower:
horizon and bodies are estimates."""


@dataclass(frozen=True, eq=False)
class MirrorImage:
    """One body in the ground, sharp: colour (h, w, 3) linear, alpha (h, w), sigma (h, w) pixels of blur at roughness 1,
    slant of the view."""

    colour: Image
    alpha: Image
    sigma: Image
    slant: float

    def blurred(self, roughness: float) -> Image:
        """Colour and coverage (h, w, 4) in a ground of ``roughness``."""
        one = np.ones_like(self.alpha)
        layer = floor_reflection.mirrored_layer(
            self.colour, self.alpha, self.sigma * np.float32(roughness**2), one, self.slant
        )
        return np.dstack([layer.colour, layer.alpha])

    def within(self, window: tuple[slice, slice]) -> MirrorImage:
        """Return the part in ``window``."""
        return MirrorImage(self.colour[window], self.alpha[window], self.sigma[window], self.slant)


def mirror_image(camera: Camera, surface: TexturedSurface, scale: float) -> MirrorImage:
    """Return how a mirror at z = 0 shows ``surface`` to ``camera``, on the photo's grid times ``scale``."""
    ground = Ground(reflection_roughness=1.0)
    below = floor_reflection.mirrored_camera(camera, ground)
    width, height = size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    shown = visible_pixels(below, surface.vertices, surface.faces, scale)
    at = below.project(surface.vertices)
    at[:, :2] *= (width / camera.width, height / camera.height)
    paint = Paint(texture=surface.picture, uv=surface.uv)
    light = np.rint(colours(shown, at, surface.faces, paint)).clip(0, 255).astype(np.uint8)
    colour, alpha = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    colour[shown.rows, shown.columns], alpha[shown.rows, shown.columns] = bytes_to_linear(light), 1.0
    blur = floor_reflection.blur_sigma(camera, ground, surface.vertices) * (height / camera.height)
    sigma = spread_values(at[:, :2], at[:, 2], blur, size)
    flipped = [np.ascontiguousarray(np.fliplr(image), dtype=np.float32) for image in (colour, alpha, sigma)]
    _, cosine = floor_reflection.fresnel(camera, ground, size)
    seen = flipped[1] > 0
    return MirrorImage(flipped[0], flipped[1], flipped[2], float(cosine[seen].mean()) if seen.any() else 1.0)


def fitted_roughness(
    pixels: NDArray[np.uint8], covered: Mask, camera: Camera, surfaces: Sequence[TexturedSurface], start: float
) -> float:
    """Return the roughness of the ground z = 0, which mirrors ``surfaces`` in ``pixels`` (H, W, 3) sRGB.

    covered: (H, W) objects and things, which hide the ground. start: a rough estimate, which is returned where the
    mirror images are too small or too hidden to tell.
    """
    extents = [np.ptp(camera.project(s.vertices)[:, :2], axis=0).max() for s in surfaces]
    scale = min(1.0, FIT_SIDE / max(float(max(extents)), 1.0))
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    light = np.asarray(cv2.resize(bytes_to_linear(pixels), size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    known, shares = open_ground(covered, camera, size)
    parts = [
        part
        for surface in surfaces
        if (part := _Part.made(mirror_image(camera, surface, scale), light, known, shares)) is not None
    ]
    if not parts:
        return start
    found = min(max(start, SMOOTHEST), ROUGHEST)
    for _ in range(ROUNDS):
        places = [part.placed(found) for part in parts]

        def misfit(roughness: float, at: Sequence[Place] = tuple(places)) -> float:
            return _misfit([part.bands(roughness, place) for part, place in zip(parts, at, strict=True)])

        found = _least(misfit)
    return found


def open_ground(covered: Mask, camera: Camera, size: tuple[int, int]) -> tuple[Image, Image]:
    """Return where ground is seen without a mix of objects, 0 or 1, and what it mirrors at ``VARNISH``, both (h, w)."""
    # Pixels along an outline mix object and ground.
    seam = max(1, round(0.7 * camera.width / size[0]))
    closed = cv2.dilate(covered.astype(np.uint8), np.ones((2 * seam + 1,) * 2, np.uint8)).astype(np.float32)
    shares, cosine = floor_reflection.fresnel(camera, Ground(reflectivity=VARNISH), size)
    known = (cv2.resize(closed, size, interpolation=cv2.INTER_AREA) < 0.02) & (cosine > 0)
    return known.astype(np.float32), shares


@dataclass(frozen=True, eq=False)
class _Bands:
    """Pixels of one body's mirror image, band by band, finest first: photo (N,), mirror image (N,), and an even
    darkening of it (N,)."""

    photo: tuple[Values, ...]
    image: tuple[Values, ...]
    even: tuple[Values, ...]


class _Part:
    """The photo around one mirror image, relative to the ground's level."""

    def __init__(self, image: MirrorImage, relative: Image, level: Image, known: Image, shares: Image) -> None:
        self._image, self._level, self._known, self._shares = image, level, known, shares
        rows, columns = np.nonzero(image.alpha > 0)
        self._width, self._height = float(np.ptp(columns) + 1), float(np.ptp(rows) + 1)
        self._foot, self._middle = float(rows.min()), float(columns.mean())
        self._depth = max(1, int(np.log2(max(min(self._width, self._height) / COARSEST, 2.0))))
        self._photo = _pyramid(relative, known, self._depth)
        near = cv2.dilate(
            (image.alpha > 0).astype(np.uint8), np.ones((2 * round(0.12 * self._width) + 1,) * 2, np.uint8)
        )
        self._use, here = [], near.astype(np.float32)
        for band, weight in self._photo:
            here = np.asarray(cv2.resize(here, band.shape[1::-1], interpolation=cv2.INTER_AREA))
            self._use.append((here > 0.5) & (weight > 0.5))
        self._blurred: dict[float, Image] = {}

    @classmethod
    def made(cls, image: MirrorImage, light: Image, known: Image, shares: Image) -> _Part | None:
        """Return the part of the photo around ``image``, or None where too little of it can be seen."""
        rows, columns = np.nonzero(image.alpha > 0)
        if len(rows) < FEWEST or known[rows, columns].mean() < 0.25:
            return None
        room = round(0.4 * (np.ptp(columns) + np.ptp(rows)) / 2 + 8)
        window = (
            slice(max(0, rows.min() - room), rows.max() + room + 1),
            slice(max(0, columns.min() - room), columns.max() + room + 1),
        )
        light, known, shares = light[window], known[window], shares[window]
        sigma = max(3.0, LEVEL * min(np.ptp(columns), np.ptp(rows)))
        around = cv2.GaussianBlur(light * known[..., None], (0, 0), sigma)
        weight = np.maximum(cv2.GaussianBlur(known, (0, 0), sigma), 1e-4)
        level = np.maximum(np.asarray(around / weight[..., None], np.float32), np.float32(DARKEST))
        return cls(image.within(window), np.asarray(light / level, np.float32), level, known, shares)

    def placed(self, roughness: float) -> Place:
        """Return by how much the mirror image of ``roughness`` lies aside, lower and is taller: pixels, pixels, share;
        from coarse to fine."""
        limits = np.array([ASIDE * self._width, UP * self._height, TALLER])
        fine = np.array([0.5, 0.5, 0.5 / self._height])
        best, step = np.zeros(3), limits / 2.0
        while (step > fine).any():
            step = np.maximum(step, fine / 2.0)
            most, better = self._agreement(roughness, best, step), True
            while better:
                better = False
                for axis, sign in ((a, s) for a in range(3) for s in (-1.0, 1.0)):
                    tried = best.copy()
                    tried[axis] = np.clip(tried[axis] + sign * step[axis], -limits[axis], limits[axis])
                    value = self._agreement(roughness, tried, step)
                    if value > most + 1e-9:
                        best, most, better = tried, value, True
            step = step / 2.0
        return (float(best[0]), float(best[1]), float(best[2]))

    def _agreement(self, roughness: float, place: Values, step: Values) -> float:
        """Correlation of photo and mirror image in the bands that are coarser than ``step``."""
        coarse = max(float(step[0]), float(step[1]), float(step[2]) * self._height)
        first = int(np.clip(np.log2(max(coarse, 1.0)), 0, self._depth - 1))
        bands = self.bands(roughness, (float(place[0]), float(place[1]), float(place[2])), first)
        total, count = 0.0, 0
        for photo, image, even in zip(bands.photo, bands.image, bands.even, strict=True):
            x, y = (v - even * (float(even @ v) / max(float(even @ even), 1e-12)) for v in (image, photo))
            total += len(x) * float(x @ y) / max(float(np.sqrt((x @ x) * (y @ y))), 1e-12)
            count += len(x)
        return total / max(count, 1)

    def bands(self, roughness: float, place: Place, first: int = 0) -> _Bands:
        """Return photo and mirror image of ``roughness`` at ``place`` from band ``first`` on."""
        if roughness not in self._blurred:
            self._blurred = {roughness: self._image.blurred(roughness)}
        aside, down, taller = place
        move = np.array([[1, 0, aside], [0, 1 + taller, down - taller * self._foot]], dtype=np.float32)
        layer = np.asarray(cv2.warpAffine(self._blurred[roughness], move, self._known.shape[::-1]))
        even = layer[..., 3] * self._shares
        change = layer[..., :3] * self._shares[..., None] / self._level - even[..., None]
        made = _pyramid(np.dstack([change, even]), self._known, self._depth)
        photo, image, darker = [], [], []
        for (seen, _), (expected, _), use in list(zip(self._photo, made, self._use, strict=True))[first:]:
            if use.sum() < FEWEST:
                continue
            here = seen[use].astype(np.float64)
            usual = MOST_DEVIATING * here.std()
            photo.append(np.clip(here, -usual, usual).ravel())
            image.append(expected[use][:, :3].astype(np.float64).ravel())
            darker.append(np.repeat(expected[use][:, 3].astype(np.float64), 3))
        return _Bands(tuple(photo), tuple(image), tuple(darker))


def _pyramid(values: Image, known: Image, depth: int) -> list[tuple[Image, Image]]:
    """Return ``depth`` bands (h, w, C) of ``values`` and weights (h, w), finest first, from what is ``known`` alone."""
    bands, total, weight = [], values * known[..., None], known
    for _ in range(depth):
        below, less = cv2.pyrDown(total), cv2.pyrDown(weight)
        size = weight.shape[::-1]
        wide = cv2.pyrUp(below, dstsize=size) / np.maximum(cv2.pyrUp(less, dstsize=size), 1e-4)[..., None]
        here = total / np.maximum(weight, 1e-4)[..., None]
        bands.append((np.asarray(here - wide, np.float32), np.asarray(weight, np.float32)))
        total, weight = np.asarray(below, np.float32), np.asarray(less, np.float32)
    return bands


def _misfit(parts: Sequence[_Bands]) -> float:
    """Return minus twice the log likelihood, up to a constant, of the photo given the mirror images ``parts``.

    One gain for all, an even darkening for each part, and a variance for each band of each.
    """
    variance = [[max(float(v @ v) / len(v), 1e-12) for v in part.photo] for part in parts]
    for _ in range(4):
        size = 1 + len(parts)
        matrix, right = np.eye(size) * 1e-9, np.zeros(size)
        for i, (part, spread) in enumerate(zip(parts, variance, strict=True)):
            for y, x, even, each in zip(part.photo, part.image, part.even, spread, strict=True):
                pair = (0, 1 + i)
                matrix[np.ix_(pair, pair)] += np.array([[x @ x, x @ even], [x @ even, even @ even]]) / each
                right[list(pair)] += np.array([x @ y, even @ y]) / each
        gain, *darker = np.linalg.solve(matrix, right)
        variance = [
            [
                max(float(np.mean(np.square(y - max(gain, 0.0) * x - dark * even))), 1e-12)
                for y, x, even in zip(part.photo, part.image, part.even, strict=True)
            ]
            for part, dark in zip(parts, darker, strict=True)
        ]
    return sum(
        len(y) * float(np.log(each))
        for part, spread in zip(parts, variance, strict=True)
        for y, each in zip(part.photo, spread, strict=True)
    )


def _least(misfit: Callable[[float], float]) -> float:
    """Return the roughness of least ``misfit``: the best of a grid, refined between its neighbours."""
    grid = np.linspace(np.log(SMOOTHEST), np.log(ROUGHEST), CANDIDATES)
    best = int(np.argmin([misfit(float(np.exp(v))) for v in grid]))
    sides = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(
        lambda v: misfit(float(np.exp(v))), bounds=sides, method="bounded", options={"xatol": REFINED}
    )
    return float(np.exp(found.x))
