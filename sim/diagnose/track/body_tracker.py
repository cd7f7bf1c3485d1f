# SPDX-License-Identifier: MIT
"""Tracks the points of one object from frame to frame.

Each frame: Lucas–Kanade from the previous one with a forward-backward check; the object's pose from the consistent
points; then every point facing the camera is searched at its predicted pixel, compared with its reference patch warped
to the current view. So points do not drift, are recovered after an occlusion, and dropped when something covers them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture import Camera
from .feature_tracking import (
    Image,
    align,
    extract_patches,
    find_corners,
    grid_offsets,
    smoothed,
    track_points,
    view_maps,
    warp,
)
from .pose_estimation import (
    LEAST_POINTS,
    Array,
    Located,
    Mask,
    Pose,
    Surface,
    cast,
    continued,
    facing,
    locate,
    project,
    silhouette,
)
from .track_input import SceneBody, TrackOptions

Grey = NDArray[np.uint8]

LEAST_FACING = 0.3
"""Cosine to the viewing direction below which a patch is too foreshortened (73 degrees)."""
SOFT_TOLERANCE = 0.15
"""Tolerance of points of a deformable body about its best rigid pose, over the body's size in the image."""
LOOSEST_RIGID = 0.06
"""The same for a rigid body, whose mesh may be inexact."""
REFILL_BELOW = 0.7
"""Fraction of the target number of points below which new ones are added."""
SHUTTERS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Candidate shutter times, as fractions of the frame interval."""
SHUTTER_VOTES = 9
"""Fast frames that vote on the shutter time; then their median is fixed."""
STREAK_PX = 3.0
"""Motion per frame from which blur reveals the shutter time."""
LOOKS = 3
"""Search iterations per frame: each starts from a better pose, with better warps and more points in reach."""
LARGEST_BEND = 0.9
"""Least cosine between the normals within a patch (26 degrees): no single warp fits across an edge."""
REFILL_EVERY = 3
"""Frames between two searches for new points, which cost more than tracking."""
PROBATION_FRAMES = 3
PROBATION_PX = 8.0
"""Frames, and motion in the image, through which a new point must move with the object before it counts: it may be on
an occluder."""
LIFT_PX, LIFT_SHARE = 1.5, 0.015
"""Median residual of the fitted pose above which new points cannot be placed on the mesh: the larger of pixels and that
fraction of the object's size in the image."""


@dataclass(frozen=True)
class View:
    """A frame for trackers: grey (H, W) and its smoothed copy."""

    grey: Grey
    smooth: Image

    @classmethod
    def of(cls, grey: Grey) -> View:
        """Return the view of a frame."""
        return cls(grey=np.asarray(cv2.GaussianBlur(grey, (3, 3), 0)), smooth=smoothed(grey))


class BodyTracker:
    """The points of one object. ``rest`` (K, 3) m grows as points are added; ``places`` (K, 2) px, NaN where not seen.

    residual: (K, 2) px, places minus their projection at the fitted pose. trusted: (K,) whether a point has moved with
    the object for long enough to be used. pose: the last one; ``lost``: frames since it was seen.
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
        """Return its size in px: the side of a square with its initial image area."""
        return float(np.sqrt(max(self._area, 1.0)))

    @property
    def _largest(self) -> float:
        share = LOOSEST_RIGID if self.body.rigid else SOFT_TOLERANCE
        return max(self._options.rigid_tolerance_px, share * self.size)

    @property
    def _shutter(self) -> float:
        """Return the shutter time as a fraction of the frame interval, as far as it is known."""
        return float(np.median(self._shutters)) if self._shutters else 0.0

    @property
    def _tolerance(self) -> float:
        return self._options.rigid_tolerance_px if self.body.rigid else self._largest

    def add_points(self, view: View, frame: int, allowed: Mask | None, others: Sequence[tuple[Surface, Pose]]) -> int:
        """Add corners on the visible part of the object, mapped onto its mesh; return their number.

        allowed: (H, W) additional mask, or None. others: surfaces that may occlude it.
        """
        camera, half = self._camera, self._half
        shown = silhouette(self.body.surface, self.pose, camera)
        if allowed is not None:
            shown &= allowed
        # A patch across the silhouette would include background.
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
        self._crops = np.concatenate([self._crops, extract_patches(view.smooth, corners, half)])
        self.places = np.concatenate([self.places, corners])
        self.residual = np.concatenate([self.residual, np.full((len(corners), 2), np.nan)])
        self.trusted = np.concatenate([self.trusted, np.full(len(corners), frame == 0)])
        self._dropped = np.concatenate([self._dropped, np.zeros(len(corners), dtype=np.bool_)])
        self._agreed = np.concatenate([self._agreed, np.zeros((len(corners), 2))])
        return len(corners)

    def _smooth(self, corners: Array, normals: Array) -> Mask:
        """Return (N,): whether the surface is nearly flat within the patches around ``corners``."""
        good = np.ones(len(corners), dtype=np.bool_)
        for offset in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            hits = cast(self.body.surface, self.pose, self._camera, corners + 0.8 * self._half * np.array(offset))
            around = self._face_normals[np.maximum(hits.face, 0)]
            good &= (hits.face >= 0) & ((around * normals).sum(axis=1) > LARGEST_BEND)
        return good

    def step(self, view: View, frame: int, others: Sequence[tuple[Surface, Pose]]) -> None:
        """Track into ``view``. others: surfaces of other objects that may occlude this one."""
        predicted = self.pose if self._before is None else continued(self._before, self.pose)
        rough = self._from_last_frame(view, predicted)
        if rough is None:
            rough = self._search(view, predicted)
        found = None if rough is None else self._look(view, rough, others)
        if found is None:
            self.places = np.full_like(self.places, np.nan)
            self.residual = np.full_like(self.residual, np.nan)
            self.lost += 1
            # Out of sight the motion is extrapolated for a while; after that the pose is unknown.
            if self.lost <= 15:
                self._before, self.pose = self.pose, predicted
        else:
            self._before = self.pose if self.lost == 0 else None
            self.pose, self.lost = found, 0
            if frame % REFILL_EVERY == 0:
                self._refill(view, frame, others)
        self._view = view

    def _from_last_frame(self, view: View, predicted: Pose) -> Pose | None:
        """Return a pose by Lucas–Kanade from the points seen in the last frame."""
        seen = np.flatnonzero(np.isfinite(self.places).all(axis=1) & self.trusted)
        if len(seen) < LEAST_POINTS:
            return None
        camera, rest, start = self._camera, self.rest[seen], self.places[seen]
        ahead = project(camera, predicted.apply(rest)) - project(camera, self.pose.apply(rest))
        best: Located | None = None
        # After an impact extrapolation fails: start from the last pose. A body that starts or stops abruptly is sharp
        # in one frame and blurred in the other: use what both show.
        tries = ((start + np.nan_to_num(ahead), predicted, 0.0), (start, self.pose, 0.0), (start, self.pose, 0.6))
        for guess, initial, blur in tries:
            ends, miss = track_points(
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
        """Return a pose by searching reference patches around their pixels at ``predicted``."""
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
        """Return maps (N, 2, 5) from pixels of the current view to pixels of the reference view."""
        camera = self._camera
        middle = project(camera, pose.apply(self.rest[chosen]))
        around = project(camera, pose.apply(self._grids[chosen].reshape(-1, 3))).reshape(-1, 25, 2)
        return view_maps(around - middle[:, None], self._half)

    def _look(self, view: View, rough: Pose, others: Sequence[tuple[Surface, Pose]]) -> Pose | None:
        """Search all points at the pose ``rough`` and keep those found; return the refined pose, None with too few."""
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
        """Return the pixels of the points ``chosen`` and their correlation with motion-blurred reference patches.

        The shutter time is unknown at first and estimated from fast motion.
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
        """Promote new points that moved with the object for long enough; reject those that were not where predicted."""
        self._dropped[missing] |= ~self.trusted[missing]
        way = np.linalg.norm(self.places[there] - last[there], axis=1)
        self._agreed[there] += np.stack([np.ones(len(there)), np.nan_to_num(way)], axis=1)
        self.trusted |= ~self._dropped & (self._agreed >= (PROBATION_FRAMES, PROBATION_PX)).all(axis=1)

    def _expected(
        self, view: View, pose: Pose, others: Sequence[tuple[Surface, Pose]]
    ) -> tuple[NDArray[np.int64], Array]:
        """Return the points visible at ``pose`` and their pixels."""
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
        """Return (K, 2) px: offsets from the rigid pose in the last frame, interpolated for unseen points."""
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
    """Return (N,): whether another object is in front."""
    hidden = np.zeros(len(pixels), dtype=np.bool_)
    for surface, pose in others:
        hidden |= cast(surface, pose, camera, pixels).depth < depth
    return hidden
