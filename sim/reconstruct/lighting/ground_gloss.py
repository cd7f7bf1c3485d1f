# SPDX-License-Identifier: MIT
"""Whether the ground mirrors the objects: reflectance, roughness, and the ground without their mirror images.

The bodies, seen by the camera mirrored at the ground, are what a glossy ground would show. Ground y₀ shows
y₀ + s (M − A y₀): M the blurred mirror image, A its coverage, s its share (``floor_reflection``). Both sides are
compared relative to the ground's level nearby, so that slow changes of light and ground count for nothing, and after an
even darkening of each mirror image is taken out, which a shadow or the missing light of a wall behind may be. What is
left is colour and structure, which no shadow has. The same picture beside its place, or turned left to right, says how
well anything correlates there by chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite import floor_reflection
from ...scene.model import Camera, Ground
from ...srgb import bytes_to_linear, linear_to_bytes
from ..shape.body_texture import TexturedSurface
from .ground_roughness import DARKEST, LEVEL, VARNISH, MirrorImage, fitted_roughness, mirror_image, open_ground

Mask = NDArray[np.bool_]
Image = NDArray[np.float32]
Values = NDArray[np.float64]

OBJECT_SIDE = 110
"""Largest size in pixels of the largest object in the picture that is compared."""
ROUGHNESSES = (0.0, 0.06, 0.1, 0.14, 0.19, 0.25, 0.32)
"""Roughnesses with which mirror images are looked for; ``ground_roughness`` then tells it finer."""
WIDTHS = (0.5, 0.75, 1.0, 1.5, 2.0)
"""Widths of the mirror image by which it is moved aside, both ways, as controls."""
SLACK = (-0.05, 0.0, 0.05)
"""Heights of the mirror image by which it may lie off: horizon and bodies are estimates."""
LEAST_CORRELATION, MARGIN, FACTOR = 0.25, 0.15, 2.0
"""Correlation that a mirror image needs, by how much it exceeds the controls', and how many times these it is. Chosen
with one glossy table in sight (0.56 against 0.19)."""
LEAST, MOST_OFF = 0.005, 0.7
"""Least reflectivity of a ground that mirrors; share over that of the view's angle alone below which none is taken."""
FEWEST = 150
"""Fewest pixels of an image that are compared."""
MOST_DEVIATING = 3.0
"""Standard deviations beyond which a pixel counts as that far: glints and scratches."""
VISIBLE = 0.1
"""Coverage above which a pixel belongs to the mirror image."""


@dataclass(frozen=True, eq=False)
class GroundGloss:
    """reflectivity: at normal incidence, 0 if nothing was found; roughness: see ``Ground``. correlation: of the photo
    with the mirror images, -1 to 1; by_chance: the largest of the controls. images: (H, W) of each object, where the
    ground shows it. pixels: (H, W, 3) the photo without them."""

    reflectivity: float
    roughness: float
    correlation: float
    by_chance: float
    images: tuple[Mask, ...]
    pixels: NDArray[np.uint8]


def estimate_gloss(
    pixels: NDArray[np.uint8], covered: Mask, camera: Camera, surfaces: Sequence[TexturedSurface]
) -> GroundGloss:
    """Return the gloss of the ground z = 0 below ``surfaces`` in the photo ``pixels`` (H, W, 3) sRGB.

    covered: (H, W) objects and things, which hide the ground. camera: above the ground.
    """
    none = GroundGloss(0.0, Ground().reflection_roughness, 0.0, 0.0, (np.zeros_like(covered),) * len(surfaces), pixels)
    extents = [np.ptp(camera.project(s.vertices)[:, :2], axis=0).max() for s in surfaces]
    scale = min(1.0, OBJECT_SIDE / max(float(max(extents)), 1.0))
    mirrored = [_Kept.of(mirror_image(camera, surface, scale)) for surface in surfaces]
    if not any(m.light.values[..., 3].sum() >= FEWEST for m in mirrored):
        return none
    comparison = _Comparison(pixels, covered, camera, mirrored)
    found = max((comparison.fit(r) for r in ROUGHNESSES), key=lambda fit: fit.correlation)
    controls = [comparison.fit(found.roughness, aside=side * by) for by in WIDTHS for side in (-1.0, 1.0)]
    controls.append(comparison.fit(found.roughness, turned=True))
    by_chance = max(0.0, *(fit.correlation for fit in controls))
    enough = max(LEAST_CORRELATION, by_chance + MARGIN, FACTOR * by_chance)
    grazing = comparison.grazing
    if found.correlation < enough or found.share < MOST_OFF * grazing:
        return GroundGloss(0.0, none.roughness, found.correlation, by_chance, none.images, pixels)
    # So small a picture hardly tells how sharp a mirror image is.
    roughness = fitted_roughness(pixels, covered, camera, surfaces, found.roughness)
    # A view taken for flatter than it is leaves less than Fresnel's share at that angle; far less is something else.
    share = comparison.fit(roughness).share
    reflectivity = min(max((share - grazing) / max(1.0 - grazing, 1e-6), LEAST), 1.0)
    gloss = Ground(reflectivity=reflectivity, reflection_roughness=roughness)
    images, bare = _without(pixels, covered, camera, gloss, (mirror_image(camera, s, 1.0) for s in surfaces))
    return GroundGloss(reflectivity, roughness, found.correlation, by_chance, images, bare)


@dataclass(frozen=True)
class _Fit:
    """share: of the ground's light that the mirror image replaces, mean over it."""

    roughness: float
    correlation: float
    share: float


@dataclass(frozen=True, eq=False)
class _Cropped:
    """A picture (h, w, C) that is 0 outside ``values``, at ``top`` and ``left``: of many small things in a large photo,
    each takes its own pixels and not all of the photo's."""

    values: Image
    top: int
    left: int
    size: tuple[int, int]

    @classmethod
    def of(cls, image: Image) -> _Cropped:
        """Return ``image`` without the rows and columns around it that are 0."""
        there = image.any(axis=2)
        rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
        top, left = (int(rows[0]), int(columns[0])) if len(rows) else (0, 0)
        end = (int(rows[-1]) + 1, int(columns[-1]) + 1) if len(rows) else (0, 0)
        return cls(image[top : end[0], left : end[1]].copy(), top, left, (image.shape[0], image.shape[1]))

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of ``values`` in the picture."""
        height, width = self.values.shape[:2]
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    def whole(self) -> Image:
        """Return the picture, the same to the bit."""
        image = np.zeros((*self.size, self.values.shape[2]), np.float32)
        image[self.window] = self.values
        return image


@dataclass(frozen=True, eq=False)
class _Kept:
    """A mirror image while others are made. light: colour and alpha."""

    light: _Cropped
    sigma: Image
    slant: float

    @classmethod
    def of(cls, image: MirrorImage) -> _Kept:
        """Return what is kept of ``image``."""
        return cls(_Cropped.of(np.dstack([image.colour, image.alpha])), image.sigma, image.slant)

    def blurred(self, roughness: float) -> _Cropped:
        """As of a ``MirrorImage``."""
        light = self.light.whole()
        colour, alpha = np.ascontiguousarray(light[..., :3]), np.ascontiguousarray(light[..., 3])
        return _Cropped.of(MirrorImage(colour, alpha, self.sigma, self.slant).blurred(roughness))


class _Comparison:
    """The photo's ground beside mirror images."""

    def __init__(self, pixels: NDArray[np.uint8], covered: Mask, camera: Camera, mirrored: Sequence[_Kept]) -> None:
        height, width = mirrored[0].light.size
        size = (width, height)
        light = cv2.resize(bytes_to_linear(pixels), size, interpolation=cv2.INTER_AREA)
        self._known, shares = open_ground(covered, camera, size)
        self._boxes = [_extent(m.light.values[..., 3]) for m in mirrored]
        sides = [min(box) for box in self._boxes if min(box) > 1]
        self._sigma = max(3.0, LEVEL * min(sides, default=6))
        self._weight = cv2.GaussianBlur(self._known, (0, 0), self._sigma)
        self._ground = np.maximum(self._level(np.asarray(light, np.float32)), DARKEST)
        relative = self._deviation(np.asarray(light, np.float32))
        usual = MOST_DEVIATING * float(relative[self._known > 0].std() if self._known.any() else 1.0)
        # Glints must not decide whether there is an image; what it is worth is measured on all of it.
        self._seen, self._whole = np.clip(relative, -usual, usual), relative
        self._shares, self._mirrored = shares, mirrored
        inside = np.zeros((height, width), bool)
        for one in mirrored:
            inside[one.light.window] |= one.light.values[..., 3] > 0
        self._mean_share = float(shares[inside].mean())
        self.grazing = max((self._mean_share - VARNISH) / (1.0 - VARNISH), 0.0)
        self._blurred: tuple[float, list[_Cropped]] = (-1.0, [])

    def fit(self, roughness: float, *, aside: float = 0.0, turned: bool = False) -> _Fit:
        """Return the best fit within ``SLACK``. aside: widths by which all are moved; turned: left to right."""
        if roughness != self._blurred[0]:
            self._blurred = roughness, [m.blurred(roughness) for m in self._mirrored]
        fits = [self._at(roughness, aside, up, turned) for up in SLACK]
        return max(fits, key=lambda fit: fit.correlation)

    def _at(self, roughness: float, aside: float, up: float, turned: bool) -> _Fit:
        expected, seen, whole = [], [], []
        for cropped, (width, height) in zip(self._blurred[1], self._boxes, strict=True):
            image = cropped.whole()
            columns = np.flatnonzero((image[..., 3] > VISIBLE).any(axis=0))
            if not len(columns):
                continue
            if turned:
                across = slice(columns[0], columns[-1] + 1)
                image[:, across] = image[:, across][:, ::-1]
            shift = np.array([[1, 0, aside * width], [0, 1, up * height]], dtype=np.float32)
            moved = np.asarray(cv2.warpAffine(image, shift, image.shape[1::-1], flags=cv2.INTER_LINEAR))
            reach = 2 * max(1, round(0.12 * width)) + 1
            around = cv2.dilate((moved[..., 3] > VISIBLE).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
            use = around & (self._known > 0)
            if use.sum() < max(FEWEST, 0.25 * around.sum()):
                continue
            cover = (moved[..., 3] * self._shares)[..., None] * self._ground
            change = moved[..., :3] * self._shares[..., None] - cover
            values = [v[use].ravel().astype(np.float64) for v in (self._deviation(change), self._seen, self._whole)]
            even = self._deviation(cover)[use].ravel().astype(np.float64)
            values = [v - even * (float(even @ v) / max(float(even @ even), 1e-12)) for v in values]
            expected.append(values[0])
            seen.append(values[1])
            whole.append(values[2])
        if not expected:
            return _Fit(roughness, 0.0, 0.0)
        x, y, all_of_it = (np.concatenate(each) for each in (expected, seen, whole))
        power = float(x @ x)
        correlation = float(x @ y) / max(float(np.sqrt(power * float(y @ y))), 1e-12)
        return _Fit(roughness, correlation, float(x @ all_of_it) / max(power, 1e-12) * self._mean_share)

    def _level(self, light: Image) -> Image:
        around = cv2.GaussianBlur(light * self._known[..., None], (0, 0), self._sigma)
        return np.asarray(around / np.maximum(self._weight, 1e-4)[..., None], dtype=np.float32)

    def _deviation(self, light: Image) -> Image:
        """``light`` (h, w, 3) without its level nearby, over that of the ground."""
        return np.asarray((light - self._level(light)) / self._ground, dtype=np.float32)


def _extent(alpha: Image) -> tuple[int, int]:
    rows, columns = np.nonzero(alpha > 0)
    return (int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1) if len(rows) else (1, 1)


def _without(
    pixels: NDArray[np.uint8], covered: Mask, camera: Camera, ground: Ground, mirrored: Iterable[MirrorImage]
) -> tuple[tuple[Mask, ...], NDArray[np.uint8]]:
    """Where each mirror image is seen, and the photo without them."""
    height, width = pixels.shape[:2]
    share, _ = floor_reflection.fresnel(camera, ground, (width, height))
    light, images = bytes_to_linear(pixels), []
    changed = np.zeros_like(covered)
    for one in mirrored:
        image = one.blurred(ground.reflection_roughness)
        part = image * share[..., None]
        # What was seen is ground (1 - share) + mirror image; darker than a third no ground becomes.
        bare = np.maximum((light - part[..., :3]) / (1.0 - np.minimum(part[..., 3:], 0.9)), light / 3.0)
        shown = (image[..., 3] > 0.004) & ~covered & (share > 0)
        light = np.where(shown[..., None], bare, light)
        images.append(shown)
        changed |= shown
    return tuple(images), np.where(changed[..., None], linear_to_bytes(light), pixels)
