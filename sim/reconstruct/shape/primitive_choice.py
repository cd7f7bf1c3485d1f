# SPDX-License-Identifier: MIT
"""Choose the primitive that an outline shows, if any: by request, by the object's kind, or by fit.

Fits differ in how well they explain the outline far more than in their number of parameters: a sphere's outline fits a
box or a cylinder with an overlap of 0.86 to 0.95, the right one with 0.98 and more.

Bottles, vases and cups get a curved profile: the largest surface of revolution about a vertical axis inside the
outline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize

from ...scene.model import Camera
from .flat_disc import is_disc, looks_down
from .inflate import Crop
from .primitive_fit import InnerEdges, fit_box, fit_cylinder, fit_disc, fit_sphere
from .primitives import Outline, Primitive, Sphere, SurfaceOfRevolution, outline_of, rasterize
from .shape_kinds import FURNITURE, KindShape

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]
Field = NDArray[np.float64]

HEIGHTS = 28
"""Circles between the ground and the top."""
AROUND = 32
"""Points on each circle."""
LATERAL = 0.75
"""Cosine of the angle from the line of sight below which a point of a circle is lateral."""
BROAD_BASE = 0.015
"""Overlap traded for a base as wide as the body: a pointed base would topple."""
TALLER = 1.6
"""Largest height over that of the straight body."""
SIDE = 160
"""Pixels along the longer side of the outline in the search for the axis."""


class Carver:
    """Largest surfaces of revolution inside one outline, given on a crop of the photo.

    At every height the widest circle about the axis whose picture stays inside the outline: perspective is exact, and a
    one-sided handle does not widen it. Circles limited only by the far rim of the outline would put a dome over every
    cup seen from above, so the body ends below them.
    """

    def __init__(self, camera: Camera, mask: Mask, distance: Field, left: int, top: int) -> None:
        """mask, distance: (h, w) and its signed distance in pixels; left, top: the crop's first pixel in the photo."""
        self._camera, self._mask, self._distance, self._left, self._top = camera, mask, distance, left, top
        step = max(1, max(mask.shape) // SIDE)
        # Every step-th pixel is the picture of a camera with larger pixels.
        self._small = mask[::step, ::step]
        self._small_camera = replace(
            camera,
            fx=camera.fx / step,
            fy=camera.fy / step,
            cx=(camera.cx - left - 0.5) / step + 0.5,
            cy=(camera.cy - top - 0.5) / step + 0.5,
        )

    def carve(self, x: float, y: float, highest: float, widest: float) -> SurfaceOfRevolution | None:
        """Return the body about the vertical through ``x``, ``y``, up to ``highest`` and ``widest`` (units); None if
        there is none."""
        heights = np.linspace(0.0, highest, HEIGHTS)
        turn = 2.0 * np.pi * np.arange(AROUND) / AROUND
        axis = np.array([x, y])
        away = axis - self._camera.position[:2]
        away = away / max(float(np.linalg.norm(away)), 1e-12)
        circle = np.column_stack([np.cos(turn), np.sin(turn)])
        lateral = np.abs(circle @ away) < LATERAL
        pixel = float(self._camera.project(np.array([x, y, 0.0]))[2]) / self._camera.fx
        if pixel <= 0:
            return None

        def room(radii: Points) -> Field:
            ground = axis + radii[:, None, None] * circle[None]
            points = np.concatenate([ground, np.broadcast_to(heights[:, None, None], (*ground.shape[:2], 1))], axis=-1)
            at = self._camera.project(points)[..., :2] - [self._left + 0.5, self._top + 0.5]
            found = ndimage.map_coordinates(self._distance, at[..., ::-1].reshape(-1, 2).T, order=1, mode="nearest")
            return np.asarray(found).reshape(ground.shape[:2])

        low, high = np.zeros(HEIGHTS), np.full(HEIGHTS, widest)
        for _ in range(11):
            middle = (low + high) / 2.0
            fits = room(middle).min(axis=1) >= 0.0
            low, high = np.where(fits, middle, low), np.where(fits, high, middle)
        space = room(low)
        held = np.where(lateral[None], space, np.inf).min(axis=1) < space.min(axis=1) + 1.0
        solid = low > 1.5 * pixel
        if not solid[0] or not (held & solid).any():
            return None
        end = int(np.flatnonzero(held & solid)[-1]) + 1
        first_gap = np.flatnonzero(~solid[:end])
        end = int(first_gap[0]) if len(first_gap) else end
        if end < 3:
            return None
        radii = ndimage.gaussian_filter1d(low[:end], 0.7, mode="nearest")
        return SurfaceOfRevolution(x, y, tuple(float(v) for v in heights[:end]), tuple(float(v) for v in radii))

    def overlap(self, body: Primitive) -> float:
        """Return the intersection over union with the outline, on the small picture."""
        image = rasterize(body, self._small_camera, self._small.shape, 0.0, 0.0)
        return float((image & self._small).sum() / max(1, int((image | self._small).sum())))

    def best(self, guess: SurfaceOfRevolution) -> SurfaceOfRevolution | None:
        """Return the body with the largest overlap near ``guess``, slightly preferring a broad base."""
        scale = max(guess.radii)
        widest, highest = 4.0 * scale, TALLER * guess.height

        def loss(offset: Points) -> float:
            body = self.carve(guess.x + offset[0] * scale, guess.y + offset[1] * scale, highest, widest)
            if body is None:
                return 1.0
            return -self.overlap(body) - BROAD_BASE * min(1.0, body.radii[0] / max(body.radii))

        towards = np.array([guess.x, guess.y]) - self._camera.position[:2]
        towards /= max(float(np.linalg.norm(towards)), 1e-12)
        start = min((step * towards for step in (0.0, -0.4, 0.4, -0.8, 0.8)), key=loss)
        simplex = start + np.array([np.zeros(2), 0.2 * towards, 0.1 * np.array([-towards[1], towards[0]])])
        options = {"initial_simplex": simplex, "maxfev": 40, "xatol": 5e-3}
        found = minimize(loss, start, method="Nelder-Mead", options=options)
        return self.carve(guess.x + found.x[0] * scale, guess.y + found.x[1] * scale, highest, widest)


CLEAR = 0.957
"""Overlap from which an object of unknown kind is a primitive."""
CERTAIN = 0.985
"""Overlap that no wrong shape reaches: nothing else is tried."""
SIMPLER = {"sphere": 0.0, "cylinder": 0.006, "box": 0.012}
"""Overlap that a shape with more parameters has to gain."""
FREE_HEIGHT = 0.02
"""Overlap that a ball may have over a disc of one proportion, as its height over width is free."""
OF_KIND = 0.85
"""Overlap without handles that a primitive by kind needs."""
ROUND = (0.8, 1.25)
"""Range of user-given depth over width of round objects."""
OBLATE = (0.72, 1.2)
"""Range of height over width of a sphere of unknown kind."""
WITH_PARTS = 0.94
"""Overlap without thin parts from which an object of unknown kind is a primitive with a handle."""
SPILL = 0.035
"""Largest area of the primitive outside the outline over the outline's, for a primitive with a handle."""
HANDLE = 0.13
"""Half the width of thin parts over the object's size."""
GAIN = 0.008
"""Overlap that a curved profile has to gain over a straight one."""
BESIDE = 0.5
"""Least distance of a handle's middle from the axis, over the radius: a neck or a foot is at both sides."""
SYMMETRIC = 0.955
"""Overlap from which an object of unknown kind is a surface of revolution of any profile."""


@dataclass(frozen=True)
class PrimitiveChoice:
    """A primitive and its overlap (IoU) with the outline."""

    primitive: Primitive
    overlap: float


def choose_primitive(
    camera: Camera,
    crop: Crop,
    full: Mask,
    seen: Mask,
    pixels: NDArray[np.uint8] | None,
    *,
    shape: str = "auto",
    kind: KindShape | None = None,
    thickness: float | None = None,
) -> PrimitiveChoice | None:
    """Return the primitive for the mask ``full`` (H, W), None for a body to be inflated.

    shape: the requested shape or ``auto``. seen: (H, W) the visible part of ``full``. pixels: (H, W, 3) sRGB, whose
    inner edges determine the depth of boxes.
    """
    if shape == "inflated" or (shape == "auto" and kind is not None and kind.shape in ("inflated", FURNITURE)):
        return None
    if shape == "auto" and thickness is not None and kind is None and not ROUND[0] <= thickness <= ROUND[1]:
        # Neither a sphere nor a can has this depth; a box may.
        found = _Candidates(camera, crop, full, seen, pixels, kind, thickness).of("box")
        return found if found is not None and found.overlap >= CLEAR else None
    candidates = _Candidates(camera, crop, full, seen, pixels, kind, thickness)
    if shape != "auto":
        return candidates.of(shape)
    if kind is not None:
        found = candidates.of(kind.shape)
        if found is not None and max(found.overlap, candidates.bare_overlap(found.primitive)) >= OF_KIND:
            return found
    return candidates.lying(candidates.best())


class _Candidates:
    def __init__(
        self,
        camera: Camera,
        crop: Crop,
        full: Mask,
        seen: Mask,
        pixels: NDArray[np.uint8] | None,
        kind: KindShape | None,
        thickness: float | None,
    ) -> None:
        self._camera, self._crop, self._thickness, self._kind = camera, crop, thickness, kind
        self._full, self._seen, self._pixels = full, seen, pixels
        self._outline = outline_of(full, seen)
        self._bare: Mask | None = None
        self._found: dict[str, PrimitiveChoice | None] = {}

    def of(self, shape: str) -> PrimitiveChoice | None:
        """Return the best ``shape``; None if it cannot stand where the outline is."""
        if shape not in self._found:
            self._found[shape] = self._fit(shape)
        return self._found[shape]

    def _fit(self, shape: str) -> PrimitiveChoice | None:
        fits: dict[str, Callable[[Outline], tuple[Primitive, float] | None]] = {
            "sphere": lambda outline: fit_sphere(self._camera, outline),
            "cylinder": lambda outline: fit_cylinder(self._camera, outline),
            "box": self._box,
        }
        found = self._judged(fits[shape](self._outline))
        if shape != "cylinder":
            return found
        if found is None or found.overlap < CLEAR:
            found = self._better(found, self._judged(fits[shape](self._bare_outline())))
        return self._profiled(found)

    def best(self) -> PrimitiveChoice | None:
        """Return the simplest shape that explains the outline; None if none does."""
        found: list[tuple[float, PrimitiveChoice]] = []
        for shape in ("sphere", "cylinder", "box"):
            choice = self.of(shape)
            if choice is None:
                continue
            if isinstance(choice.primitive, Sphere) and not OBLATE[0] <= choice.primitive.squash <= OBLATE[1]:
                continue
            if choice.overlap >= CERTAIN and not self._curved(choice):
                return choice
            limit = CLEAR if not self._curved(choice) else SYMMETRIC
            score = choice.overlap - SIMPLER[shape] - (0.012 if self._curved(choice) else 0.0)
            if choice.overlap >= limit:
                found.append((score, choice))
        if found:
            return max(found, key=lambda item: item[0])[1]
        return self._handled()

    def lying(self, found: PrimitiveChoice | None) -> PrimitiveChoice | None:
        """Return ``found``, or a disc that lies on the ground if it is a ball seen from above that looks flat."""
        if found is None or not isinstance(found.primitive, Sphere):
            return found
        if self._pixels is None or not looks_down(self._camera):
            return found
        flat = self._judged(fit_disc(self._camera, self._outline))
        if (
            flat is None
            or flat.overlap < found.overlap - FREE_HEIGHT
            or not is_disc(self._pixels, self._full & self._seen)
        ):
            return found
        return flat

    def _handled(self) -> PrimitiveChoice | None:
        """A cylinder with a handle."""
        choice = self.of("cylinder")
        if choice is None or self.bare_overlap(choice.primitive) < WITH_PARTS:
            return None
        image = self._drawn(choice.primitive)
        spilt = float((image & ~self._crop.mask).sum()) / float(self._crop.mask.sum())
        return choice if spilt < SPILL and choice.overlap > 0.75 else None

    def _box(self, outline: Outline) -> tuple[Primitive, float] | None:
        edges = None if self._pixels is None else InnerEdges(self._pixels, self._full, self._seen)
        flat = self._kind.thickness if self._kind is not None and self._kind.shape == "box" else None
        return fit_box(self._camera, outline, edges, flatness=flat, thickness=self._thickness)

    def _profiled(self, straight: PrimitiveChoice | None) -> PrimitiveChoice | None:
        """``straight``, or a body with a curved profile if that explains much more."""
        if straight is None or straight.overlap > CERTAIN or not isinstance(straight.primitive, SurfaceOfRevolution):
            return straight
        crop = self._crop
        body = Carver(self._camera, crop.mask, crop.distance, crop.left, crop.top).best(straight.primitive)
        curved = self._judged(None if body is None else (body, 0.0))
        if curved is None:
            return straight
        bare = self.bare_overlap(curved.primitive) - self.bare_overlap(straight.primitive)
        # Beside a handle a profile gains by bulging towards it, and by a dome on a rim that is not seen well.
        gain = bare if self._one_sided(straight.primitive) else max(bare, curved.overlap - straight.overlap)
        return curved if gain > GAIN else straight

    def _one_sided(self, body: SurfaceOfRevolution) -> bool:
        """Whether what reaches out of a well fitting ``body`` lies on one side of it, as a handle does."""
        if self.bare_overlap(body) < WITH_PARTS:
            return False
        outside = self._crop.mask & ~self._drawn(body)
        across = np.nonzero(outside)[1] + self._crop.left + 0.5
        middle = self._camera.project(np.array([[body.x, body.y, body.height / 2.0]]))[0]
        radius = max(body.radii) * self._camera.fx / float(middle[2])
        return len(across) > 0 and abs(float(across.mean() - middle[0])) > BESIDE * radius

    @staticmethod
    def _curved(choice: PrimitiveChoice) -> bool:
        return isinstance(choice.primitive, SurfaceOfRevolution) and len(choice.primitive.radii) > 2

    @staticmethod
    def _better(first: PrimitiveChoice | None, second: PrimitiveChoice | None) -> PrimitiveChoice | None:
        if first is None or second is None:
            return first or second
        return first if first.overlap >= second.overlap else second

    def _judged(self, found: tuple[Primitive, float] | None) -> PrimitiveChoice | None:
        if found is None:
            return None
        return PrimitiveChoice(found[0], self._overlap(found[0], self._crop.mask))

    def _drawn(self, primitive: Primitive) -> Mask:
        crop = self._crop
        return rasterize(primitive, self._camera, crop.mask.shape, crop.left, crop.top) & crop.photo

    def _overlap(self, primitive: Primitive, mask: Mask) -> float:
        image = self._drawn(primitive)
        return float((image & mask).sum() / max(1, int((image | mask).sum())))

    def bare_overlap(self, primitive: Primitive) -> float:
        """Return the overlap with the outline without its thin parts."""
        return self._overlap(primitive, self._without_parts())

    def _without_parts(self) -> Mask:
        """The mask without parts thinner than ``HANDLE``: a cup without its handle."""
        if self._bare is None:
            mask = self._crop.mask
            radius = max(2, round(HANDLE * float(np.sqrt(mask.sum()))))
            # A slit or notch in the mask must not make a thin part of what lies beyond it.
            slit = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * (radius // 5) + 1, 2 * (radius // 5) + 1))
            filled = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, slit)
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
            opened = cv2.morphologyEx(filled, cv2.MORPH_OPEN, kernel) > 0
            # Opening rounds corners: restore nearby pixels, but not the handle's roots.
            near = ndimage.binary_dilation(opened, iterations=max(1, radius // 5))
            labels, count = ndimage.label(mask & ~opened)
            if count:
                areas = ndimage.sum_labels(mask, labels, np.arange(1, count + 1))
                small = np.concatenate([[False], areas < 0.01 * mask.sum()])
                near |= small[labels]
            bare = mask & (opened | near) if opened.any() else mask
            self._bare = bare
        return self._bare

    def _bare_outline(self) -> Outline:
        crop, (height, width) = self._crop, self._full.shape
        bare = np.zeros_like(self._full)
        top, left = max(0, crop.top), max(0, crop.left)
        bottom, right = min(height, crop.top + crop.mask.shape[0]), min(width, crop.left + crop.mask.shape[1])
        part = self._without_parts()
        bare[top:bottom, left:right] = part[top - crop.top : bottom - crop.top, left - crop.left : right - crop.left]
        return outline_of(bare, self._seen | ~bare)
