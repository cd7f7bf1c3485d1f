# SPDX-License-Identifier: MIT
"""Follows the points of one object from frame to frame.

Each frame: Lucas–Kanade from the last one, both ways; the object's pose from what agrees; then every point that this
pose turns towards the camera is looked for where it should be, comparing with its first sight warped to the present
view. So points do not drift, come back after an occlusion, and are given up where something else is in their place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture import Camera
from .beliefs import SceneBody
from .corners import find_corners
from .flow import follow
from .options import TrackOptions
from .patches import Image, align, cut, grid_offsets, smoothed, view_maps, warp
from .pose import LEAST_POINTS, Array, Located, Mask, Pose, continued, locate, project
from .surface import Surface, cast, facing, silhouette

Grey = NDArray[np.uint8]

LEAST_FACING = 0.3
"""Cosine to the view below which a patch is too foreshortened (73 degrees)."""
SOFT_TOLERANCE = 0.15
"""How far points of a body that deforms may be off its best rigid pose, over the body's size in the picture."""
LOOSEST_RIGID = 0.06
"""The same of a rigid body, whose mesh may be a guess."""
REFILL_BELOW = 0.7
"""Share of the wanted points below which new ones are sought."""
SHUTTERS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of a frame's time for which a camera's shutter may be open."""
SHUTTER_VOTES = 9
"""Fast frames that are asked which of them it is; their median then stands."""
STREAK_PX = 3.0
"""Way from frame to frame from which on blur tells the shutter."""
LOOKS = 3
"""A look from a better pose has better warps and brings more points in reach; after a few it is good enough."""
LARGEST_BEND = 0.9
"""Cosine between the surface's normals within a patch (26 degrees): across an edge no one warp fits a patch."""
REFILL_EVERY = 3
"""Frames between two searches for new points, which cost more than following them."""
PROBATION_FRAMES = 3
PROBATION_PX = 8.0
"""Frames through which, and way in the picture along which a new point must go with the object before it counts: it may
sit on something that has come in front of it."""
LIFT_PX, LIFT_SHARE = 1.5, 0.015
"""Median distance from the fitted pose above which new points could not be placed on the mesh: pixels, or that share of
the object's size in the picture if it is more."""


@dataclass(frozen=True)
class View:
    """A frame as trackers need it: grey (H, W) and its smoothed copy."""

    grey: Grey
    smooth: Image

    @classmethod
    def of(cls, grey: Grey) -> View:
        """The view of a frame."""
        return cls(grey=np.asarray(cv2.GaussianBlur(grey, (3, 3), 0)), smooth=smoothed(grey))


class BodyTracker:
    """The points of one object. ``rest`` (K, 3) m grows as points are added; ``places`` (K, 2) px, NaN where not seen.

    residual: (K, 2) px, places minus the fitted pose's. trusted: (K,) whether a point has shown that it goes with the
    object; others must be left out. pose: the last one; ``lost``: frames since it was seen.
    """

    def __init__(self, body: SceneBody, camera: Camera, options: TrackOptions, pose: Pose, view: View) -> None:
        self.body = body
        self.pose = pose
        self.lost = 0
        self.rest = np.empty((0, 3))
        self.places = np.empty((0, 2))
        self.residual = np.empty((0, 2))
        self.trusted = np.empty(0, dtype=np.bool_)
        self._dropped = np.empty(0, dtype=np.bool_)
        self._agreed = np.empty((0, 2))
        self._before: Pose | None = None
        self._shutters: list[float] = []
        self._camera, self._options = camera, options
        self._normals = np.empty((0, 3))
        self._grids = np.empty((0, 25, 3))
        self._face_normals = body.surface.normals
        shown = silhouette(body.surface, pose, camera)
        self._area = float(shown.sum())
        self._half = int(np.clip(round(0.07 * np.sqrt(max(self._area, 1.0))), 4, 10))
        reach = 2 * int(np.ceil(2.2 * self._half)) + 1
        self._crops: Image = np.empty((0, reach, reach), dtype=np.float32)
        self._view = view

    @property
    def size(self) -> float:
        """Size in the picture, px: the side of a square of its area at the start."""
        return float(np.sqrt(max(self._area, 1.0)))

    @property
    def _largest(self) -> float:
        share = LOOSEST_RIGID if self.body.rigid else SOFT_TOLERANCE
        return max(self._options.rigid_tolerance_px, share * self.size)

    @property
    def _shutter(self) -> float:
        """Share of a frame's time for which the shutter is open, as far as it is known."""
        return float(np.median(self._shutters)) if self._shutters else 0.0

    @property
    def _tolerance(self) -> float:
        return self._options.rigid_tolerance_px if self.body.rigid else self._largest

    def add_points(self, view: View, frame: int, allowed: Mask | None, others: Sequence[tuple[Surface, Pose]]) -> int:
        """Seek corners on what ``view`` shows of the object at ``pose`` and put them onto its mesh; how many.

        allowed: (H, W) further limit on where, or None. others: surfaces that may hide it.
        """
        camera, half = self._camera, self._half
        shown = silhouette(self.body.surface, self.pose, camera)
        if allowed is not None:
            shown &= allowed
        # A patch across the outline would show what is behind the object as well.
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * half + 1, 2 * half + 1))
        bordered = cv2.copyMakeBorder(shown.astype(np.uint8), half, half, half, half, cv2.BORDER_CONSTANT, value=0)
        inner = cv2.erode(bordered, kernel)[half:-half, half:-half]
        seen = np.isfinite(self.places).all(axis=1)
        spacing = max(4.0, 0.6 * float(np.sqrt(self._area / self._options.density)))
        for x, y in self.places[seen] - 0.5:
            cv2.circle(inner, (round(x), round(y)), round(spacing), 0, -1)
        wanted = self._options.density - int(seen.sum())
        corners = find_corners(
            view.grey,
            inner > 0,
            count=wanted,
            half=half,
            spacing=spacing,
            min_contrast=self._options.min_contrast,
        )
        if len(corners) == 0:
            return 0
        hits = cast(self.body.surface, self.pose, camera, corners)
        good = hits.face >= 0
        normals = self._face_normals[np.maximum(hits.face, 0)]
        good[good] &= facing(hits.rest[good], normals[good], self.pose) > LEAST_FACING
        good &= ~_hidden(corners, hits.depth, others, camera) & self._smooth(corners, normals)
        if not good.any():
            return 0
        corners, rest, normals = corners[good], hits.rest[good], normals[good]
        self.rest = np.concatenate([self.rest, rest])
        self._normals = np.concatenate([self._normals, normals])
        around = (corners[:, None] + grid_offsets(half)).reshape(-1, 2)
        grid = cast(self.body.surface, self.pose, camera, around).rest.reshape(-1, 25, 3)
        self._grids = np.concatenate([self._grids, grid])
        self._crops = np.concatenate([self._crops, cut(view.smooth, corners, half)])
        self.places = np.concatenate([self.places, corners])
        self.residual = np.concatenate([self.residual, np.full((len(corners), 2), np.nan)])
        self.trusted = np.concatenate([self.trusted, np.full(len(corners), frame == 0)])
        self._dropped = np.concatenate([self._dropped, np.zeros(len(corners), dtype=np.bool_)])
        self._agreed = np.concatenate([self._agreed, np.zeros((len(corners), 2))])
        return len(corners)

    def _smooth(self, corners: Array, normals: Array) -> Mask:
        """(N,): whether the surface bends little within the patches around ``corners``."""
        good = np.ones(len(corners), dtype=np.bool_)
        for offset in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            hits = cast(self.body.surface, self.pose, self._camera, corners + 0.8 * self._half * np.array(offset))
            around = self._face_normals[np.maximum(hits.face, 0)]
            good &= (hits.face >= 0) & ((around * normals).sum(axis=1) > LARGEST_BEND)
        return good

    def step(self, view: View, frame: int, others: Sequence[tuple[Surface, Pose]]) -> None:
        """Go on to ``view``. others: surfaces of the scene's other objects, that may hide this one."""
        predicted = self.pose if self._before is None else continued(self._before, self.pose)
        rough = self._from_last_frame(view, predicted)
        if rough is None:
            rough = self._search(view, predicted)
        found = None if rough is None else self._look(view, rough, others)
        if found is None:
            self.places = np.full_like(self.places, np.nan)
            self.residual = np.full_like(self.residual, np.nan)
            self.lost += 1
            # What is out of sight goes on as before for a while; where it is after longer, nobody knows.
            if self.lost <= 15:
                self._before, self.pose = self.pose, predicted
        else:
            self._before = self.pose if self.lost == 0 else None
            self.pose, self.lost = found, 0
            if frame % REFILL_EVERY == 0:
                self._refill(view, frame, others)
        self._view = view

    def _from_last_frame(self, view: View, predicted: Pose) -> Pose | None:
        """A pose by Lucas–Kanade from the points seen in the last frame."""
        seen = np.flatnonzero(np.isfinite(self.places).all(axis=1) & self.trusted)
        if len(seen) < LEAST_POINTS:
            return None
        camera, rest, start = self._camera, self.rest[seen], self.places[seen]
        ahead = project(camera, predicted.apply(rest)) - project(camera, self.pose.apply(rest))
        best: Located | None = None
        # A body that hits something does not go on as before: then from where it was. A body that starts or stops fast
        # is sharp in one frame and blurred in the other: then by what both show.
        tries = ((start + np.nan_to_num(ahead), predicted, 0.0), (start, self.pose, 0.0), (start, self.pose, 0.6))
        for guess, initial, blur in tries:
            ends, miss = follow(
                _blurred(self._view.grey, blur * self._half),
                _blurred(view.grey, blur * self._half),
                start,
                guess,
                self._half,
            )
            good = miss <= self._options.max_round_trip_px * (3 if blur else 1)
            if good.sum() < LEAST_POINTS:
                continue
            fitted = locate(camera, rest[good], ends[good], initial, tolerance=self._tolerance, largest=self._largest)
            if fitted is not None and (best is None or fitted.inliers.sum() > 1.3 * best.inliers.sum()):
                best = fitted
            if best is not None and best.inliers.sum() >= 0.6 * len(seen):
                break
        return None if best is None else best.pose

    def _search(self, view: View, predicted: Pose) -> Pose | None:
        """A pose by looking for the points' first sights around where they would be at ``predicted``."""
        expected = project(self._camera, predicted.apply(self.rest))
        good = self.trusted & (facing(self.rest, self._normals, predicted) > 2 * LEAST_FACING)
        good &= np.isfinite(expected).all(axis=1)
        chosen = np.flatnonzero(good)
        if len(chosen) < LEAST_POINTS:
            return None
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), 24)).astype(int)]
        streaks = self._shutter * np.nan_to_num(expected - project(self._camera, self.pose.apply(self.rest)))[chosen]
        patches = warp(self._crops[chosen], self._maps(chosen, predicted), self._half, streaks)
        radius = int(0.25 * self.size) + 10 + 6 * min(self.lost, 10)
        half = self._half
        height, width = view.grey.shape
        rest, places = [], []
        for i, template in zip(chosen, patches.values, strict=True):
            x, y = np.floor(expected[i]).astype(int)
            left, top = max(0, x - radius - half), max(0, y - radius - half)
            right, bottom = min(width, x + radius + half + 1), min(height, y + radius + half + 1)
            if right - left < 2 * half + 2 or bottom - top < 2 * half + 2:
                continue
            scores = cv2.matchTemplate(
                view.smooth[top:bottom, left:right], template.astype(np.float32), cv2.TM_CCOEFF_NORMED
            )
            _, best, _, (column, row) = cv2.minMaxLoc(scores)
            if best > max(0.8, self._options.min_score):
                rest.append(self.rest[i])
                places.append((left + column + half + 0.5, top + row + half + 0.5))
        if len(rest) < LEAST_POINTS:
            return None
        fitted = locate(
            self._camera,
            np.array(rest),
            np.array(places),
            predicted,
            tolerance=self._tolerance,
            largest=self._largest,
        )
        return None if fitted is None or fitted.inliers.sum() < LEAST_POINTS + 2 else fitted.pose

    def _maps(self, chosen: NDArray[np.int64], pose: Pose) -> Array:
        """(N, 2, 5): from pixels of the present view to pixels of the first sight."""
        camera = self._camera
        middle = project(camera, pose.apply(self.rest[chosen]))
        around = project(camera, pose.apply(self._grids[chosen].reshape(-1, 3))).reshape(-1, 25, 2)
        return view_maps(around - middle[:, None], self._half)

    def _look(self, view: View, rough: Pose, others: Sequence[tuple[Surface, Pose]]) -> Pose | None:
        """Look for all points at the pose ``rough``, keep what is there; the refined pose, or None if too few are."""
        camera, half = self._camera, self._half
        found: tuple[NDArray[np.int64], Array, Mask, Located] | None = None
        for _ in range(LOOKS):
            chosen, guesses = self._expected(view, rough, others)
            if len(chosen) < LEAST_POINTS:
                return None
            places, score = self._aligned(view, chosen, guesses, rough)
            good = (score >= self._options.min_score) & (np.linalg.norm(places - guesses, axis=1) <= 0.6 * half + 1)
            voting = good & self.trusted[chosen]
            fitted = locate(
                camera,
                self.rest[chosen[voting]],
                places[voting],
                rough,
                tolerance=self._tolerance,
                largest=self._largest,
            )
            if fitted is None:
                return None
            rest = self.rest[chosen]
            shift = project(camera, fitted.pose.apply(rest)) - project(camera, rough.apply(rest))
            rough, found = fitted.pose, (chosen, places, good, fitted)
            if np.nanmax(np.abs(shift)) < 0.5:
                break
        assert found is not None
        chosen, places, good, best = found
        residual = places - project(camera, best.pose.apply(self.rest[chosen]))
        good &= np.linalg.norm(residual, axis=1) <= best.limit
        last = self.places
        self.places, self.residual = np.full_like(last, np.nan), np.full_like(last, np.nan)
        self.places[chosen[good]], self.residual[chosen[good]] = places[good], residual[good]
        self._judge(chosen[~good], chosen[good], last)
        return best.pose

    def _aligned(self, view: View, chosen: NDArray[np.int64], guesses: Array, pose: Pose) -> tuple[Array, Array]:
        """Where the points ``chosen`` are, and how well that looks like their first sight, blurred by their motion.

        For which share of a frame's time the camera's shutter is open is not known; fast motion tells.
        """
        camera, crops, maps = self._camera, self._crops[chosen], self._maps(chosen, pose)
        rest = self.rest[chosen]
        way = project(camera, pose.apply(rest)) - project(camera, self.pose.apply(rest))
        way = np.nan_to_num(way) * (self.lost == 0)
        fast = float(np.median(np.linalg.norm(way, axis=1))) > STREAK_PX
        if fast and len(self._shutters) < SHUTTER_VOTES:
            found = {}
            for share in SHUTTERS:
                found[share] = align(view.smooth, warp(crops, maps, self._half, share * way), guesses, self._half)
            best = max(SHUTTERS, key=lambda share: float(np.median(found[share][1])))
            self._shutters.append(best)
            return found[best]
        return align(view.smooth, warp(crops, maps, self._half, self._shutter * way), guesses, self._half)

    def _judge(self, missing: NDArray[np.int64], there: NDArray[np.int64], last: Array) -> None:
        """New points that went along for long enough count from now on; one that was not where it had to be never."""
        self._dropped[missing] |= ~self.trusted[missing]
        way = np.linalg.norm(self.places[there] - last[there], axis=1)
        self._agreed[there] += np.stack([np.ones(len(there)), np.nan_to_num(way)], axis=1)
        self.trusted |= ~self._dropped & (self._agreed >= (PROBATION_FRAMES, PROBATION_PX)).all(axis=1)

    def _expected(
        self, view: View, pose: Pose, others: Sequence[tuple[Surface, Pose]]
    ) -> tuple[NDArray[np.int64], Array]:
        """Points that a camera would see at ``pose``, and where."""
        camera, half = self._camera, self._half
        height, width = view.grey.shape
        local = pose.apply(self.rest)
        pixels = project(camera, local)
        if not self.body.rigid:
            pixels = pixels + self._deformation()
        with np.errstate(invalid="ignore"):
            inside = ((pixels > half + 1) & (pixels < [width - half - 1, height - half - 1])).all(axis=1)
        inside &= ~self._dropped & (facing(self.rest, self._normals, pose) > LEAST_FACING)
        chosen = np.flatnonzero(inside)
        depth = local[chosen, 2]
        own = cast(self.body.surface, pose, camera, project(camera, local[chosen]))
        hidden = own.depth < depth - 0.02 * self._extent
        hidden |= _hidden(pixels[chosen], depth, others, camera)
        return chosen[~hidden], pixels[chosen[~hidden]]

    def _deformation(self) -> Array:
        """(K, 2) px: how far points were off the rigid pose in the last frame, of unseen ones by their neighbours."""
        known = np.flatnonzero(np.isfinite(self.residual).all(axis=1) & self.trusted)
        if len(known) == 0:
            return np.zeros((len(self.rest), 2))
        distance = np.linalg.norm(self.rest[:, None] - self.rest[known][None], axis=2)
        weight = 1.0 / (distance**2 + (0.02 * self._extent) ** 2)
        near = np.argsort(distance, axis=1)[:, :6]
        chosen = np.take_along_axis(weight, near, axis=1)
        return np.asarray(
            (self.residual[known][near] * chosen[:, :, None]).sum(axis=1) / chosen.sum(axis=1, keepdims=True)
        )

    @property
    def _extent(self) -> float:
        return float(np.ptp(self.body.surface.vertices, axis=0).max())

    def _refill(self, view: View, frame: int, others: Sequence[tuple[Surface, Pose]]) -> None:
        seen = np.isfinite(self.places).all(axis=1)
        if seen.sum() >= REFILL_BELOW * self._options.density:
            return
        known = np.isfinite(self.residual).all(axis=1) & self.trusted
        if known.sum() < LEAST_POINTS + 3:
            return
        if float(np.median(np.linalg.norm(self.residual[known], axis=1))) > max(LIFT_PX, LIFT_SHARE * self.size):
            return
        self.add_points(view, frame, None, others)


def _blurred(grey: Grey, sigma: float) -> Grey:
    return grey if sigma <= 0 else np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma), dtype=np.uint8)


def _hidden(pixels: Array, depth: Array, others: Sequence[tuple[Surface, Pose]], camera: Camera) -> Mask:
    """(N,): whether another object is in front."""
    hidden = np.zeros(len(pixels), dtype=np.bool_)
    for surface, pose in others:
        hidden |= cast(surface, pose, camera, pixels).depth < depth
    return hidden
