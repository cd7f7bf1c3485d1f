# SPDX-License-Identifier: MIT
"""Which primitive an outline shows, if any: what the user says, what things of that kind are, what fits.

Three fits differ in how well they explain the outline far more than in how many numbers they have: a ball's outline
fits a box or a cylinder with 0.86 to 0.95 of overlap, the right one with 0.98 and more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from .crop import Crop
from .edges import InnerEdges
from .fit import fit_box, fit_cylinder, fit_sphere
from .kinds import KindShape
from .outline import Outline, outline_of
from .primitives import Primitive, Revolved, Sphere, drawn
from .revolve import Carver

Mask = NDArray[np.bool_]

CLEAR = 0.957
"""Overlap that makes an unnamed thing a primitive."""
CERTAIN = 0.985
"""Overlap that no wrong shape reaches: nothing else is tried."""
SIMPLER = {"sphere": 0.0, "cylinder": 0.006, "box": 0.012}
"""Overlap that a shape with more numbers has to gain."""
OF_KIND = 0.85
"""Overlap of the outline without handles that a thing needs when its kind says what it is."""
ROUND = (0.8, 1.25)
"""Depth over width, given by the user, that round things can have."""
OBLATE = (0.72, 1.2)
"""Height over width that an unnamed ball has."""
WITH_PARTS = 0.94
"""Overlap of the outline without thin parts that makes an unnamed thing a primitive with a handle."""
SPILL = 0.035
"""Area of the primitive outside the outline over the outline's, at most, for a primitive with a handle."""
HANDLE = 0.13
"""Half the width of parts that are thin, over the size of the object."""
GAIN = 0.008
"""Overlap that a curved profile has to gain over a straight one."""
SYMMETRIC = 0.955
"""Overlap that makes an unnamed thing a body of revolution with any profile."""


@dataclass(frozen=True)
class Choice:
    """A primitive and its overlap (IoU) with the outline."""

    primitive: Primitive
    overlap: float


def choose(
    camera: Camera,
    crop: Crop,
    full: Mask,
    seen: Mask,
    pixels: NDArray[np.uint8] | None,
    *,
    shape: str = "auto",
    kind: KindShape | None = None,
    thickness: float | None = None,
) -> Choice | None:
    """The primitive for the outline ``full`` (H, W), None for a body that is to be inflated.

    shape: what the user wants, ``auto`` leaves it open. seen: (H, W) the part of ``full`` that nothing hides.
    pixels: (H, W, 3) sRGB, whose inner edges tell the depth of boxes.
    """
    if shape == "inflated" or (shape == "auto" and kind is not None and kind.shape == "inflated"):
        return None
    if shape == "auto" and thickness is not None and kind is None and not ROUND[0] <= thickness <= ROUND[1]:
        # Neither a ball nor a can has this depth; a box may.
        found = _Candidates(camera, crop, full, seen, pixels, kind, thickness).of("box")
        return found if found is not None and found.overlap >= CLEAR else None
    candidates = _Candidates(camera, crop, full, seen, pixels, kind, thickness)
    if shape != "auto":
        return candidates.of(shape)
    if kind is not None:
        found = candidates.of(kind.shape)
        if found is not None and max(found.overlap, candidates.bare_overlap(found.primitive)) >= OF_KIND:
            return found
    return candidates.best()


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
        self._found: dict[str, Choice | None] = {}

    def of(self, shape: str) -> Choice | None:
        """The best ``shape``; None when it cannot stand where the outline is."""
        if shape not in self._found:
            self._found[shape] = self._fit(shape)
        return self._found[shape]

    def _fit(self, shape: str) -> Choice | None:
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

    def best(self) -> Choice | None:
        """The simplest shape that explains the outline; None when none does."""
        found: list[tuple[float, Choice]] = []
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

    def _handled(self) -> Choice | None:
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

    def _profiled(self, straight: Choice | None) -> Choice | None:
        """``straight``, or a body with a curved profile where that explains much more."""
        if straight is None or straight.overlap > CERTAIN or not isinstance(straight.primitive, Revolved):
            return straight
        crop = self._crop
        body = Carver(self._camera, crop.mask, crop.distance, crop.left, crop.top).best(straight.primitive)
        curved = self._judged(None if body is None else (body, 0.0))
        if curved is None:
            return straight
        gain = max(
            curved.overlap - straight.overlap,
            self.bare_overlap(curved.primitive) - self.bare_overlap(straight.primitive),
        )
        return curved if gain > GAIN else straight

    @staticmethod
    def _curved(choice: Choice) -> bool:
        return isinstance(choice.primitive, Revolved) and len(choice.primitive.radii) > 2

    @staticmethod
    def _better(first: Choice | None, second: Choice | None) -> Choice | None:
        if first is None or second is None:
            return first or second
        return first if first.overlap >= second.overlap else second

    def _judged(self, found: tuple[Primitive, float] | None) -> Choice | None:
        if found is None:
            return None
        return Choice(found[0], self._overlap(found[0], self._crop.mask))

    def _drawn(self, primitive: Primitive) -> Mask:
        crop = self._crop
        return drawn(primitive, self._camera, crop.mask.shape, crop.left, crop.top) & crop.photo

    def _overlap(self, primitive: Primitive, mask: Mask) -> float:
        image = self._drawn(primitive)
        return float((image & mask).sum() / max(1, int((image | mask).sum())))

    def bare_overlap(self, primitive: Primitive) -> float:
        """Overlap with the outline without its thin parts."""
        return self._overlap(primitive, self._without_parts())

    def _without_parts(self) -> Mask:
        """The outline without what is thinner than ``HANDLE``: a cup without its handle; holes are filled."""
        if self._bare is None:
            mask = self._crop.mask
            radius = max(2, round(HANDLE * float(np.sqrt(mask.sum()))))
            filled = mask
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
            opened = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
            # Opening rounds corners off: give back what is near, but not the handle's roots.
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
