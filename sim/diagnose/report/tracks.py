# SPDX-License-Identifier: MIT
"""Motion of a take in the plane it is drawn in: seen from the side, or as the camera saw it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..capture import Camera, Capture, Trial
from ..diagnosis import TrialArrays

Array = NDArray[np.float64]
_NOWHERE = 1e6
"""m; a model that has come this far has diverged and is not drawn."""

Plane = Callable[[Array], Array]
"""(…, 3) m in the world to (…, 2) in the plane."""


@dataclass(frozen=True, kw_only=True)
class Path:
    """One object's way, (N, 2), and outlines at some moments, each (M, 2); all in the plane."""

    centres: Array
    outlines: tuple[Array, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TakeTracks:
    """What is drawn of one take, object by object.

    unit: "m" (horizontal and height) or "px" (right and down). observed: ways as seen; dots: (M, 2) the points seen at
    the moments of the outlines. nominal, found: over the frames given. before, after: over the times predicted.
    ground: two ends (2, 2) of the believed ground, or None where it is not seen from the side.
    """

    name: str
    role: str
    unit: str
    observed: tuple[Array, ...]
    dots: Array
    nominal: tuple[Path, ...]
    found: tuple[Path, ...]
    before: tuple[Path, ...]
    after: tuple[Path, ...]
    ground: Array | None


def take_tracks(trial: Trial, arrays: TrialArrays, capture: Capture) -> TakeTracks:
    """The ways of all objects of ``trial``; what is missing or of another shape is left out."""
    frames, count = trial.observed.shape[:2]
    nominal, found = (_shaped(a, (frames, count, 3)) for a in (arrays.nominal, arrays.found))
    wanted = 0 if trial.predict_times is None else len(trial.predict_times)
    before, after = (_shaped(a, (wanted, count, 3)) for a in (arrays.before, arrays.after))
    in_pixels = trial.pixels is not None
    plane: Plane
    if in_pixels:
        assert capture.camera is not None
        plane, observed = camera_plane(capture.camera), trial.observed
    else:
        axis = _main_direction(trial.observed, nominal, before)
        plane = side_plane(axis)
        observed = plane(trial.observed)
    flat = {
        name: plane(a) for name, a in (("nominal", nominal), ("found", found), ("before", before), ("after", after))
    }
    reference = flat["found"] if np.isfinite(flat["found"]).any() else flat["nominal"]
    members = [np.flatnonzero(trial.object_index == i) for i in range(len(capture.objects))]
    members = [m for m in members if len(m)]
    moments = _moments(trial.seen, wanted)
    ends = [wanted - 1] if wanted else []
    return TakeTracks(
        name=trial.name,
        role=trial.role,
        unit="px" if in_pixels else "m",
        observed=tuple(_observed_centres(observed[:, m], reference[:, m]) for m in members),
        dots=observed[moments].reshape(-1, 2)[np.isfinite(observed[moments]).all(axis=-1).reshape(-1)],
        nominal=tuple(_path(flat["nominal"][:, m], moments) for m in members),
        found=tuple(_path(flat["found"][:, m], moments) for m in members),
        before=tuple(_path(flat["before"][:, m], ends) for m in members) if wanted else (),
        after=tuple(_path(flat["after"][:, m], ends) for m in members) if wanted else (),
        ground=None if in_pixels else _ground_line(capture, axis, [observed, *flat.values()]),
    )


def side_plane(axis: Array) -> Plane:
    """Seen from the side: along the horizontal unit vector ``axis`` (2,), and up."""
    return lambda places: np.stack([places[..., :2] @ axis, places[..., 2]], axis=-1)


def camera_plane(camera: Camera) -> Plane:
    """As the camera sees it, in pixels; NaN for what is behind it."""
    inverse = np.linalg.inv(camera.matrix)

    def project(places: Array) -> Array:
        seen = places @ inverse[:3, :3].T + inverse[:3, 3]
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(seen[..., 2:] > 1e-6, seen[..., 2:], np.nan)
            return np.asarray(seen[..., :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy))

    return project


def mean_where(values: Array, axis: int) -> Array:
    """Mean of the finite numbers along ``axis``; NaN where there are none."""
    good = np.isfinite(values)
    count = good.sum(axis=axis)
    total = np.where(good, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _shaped(array: Array | None, shape: tuple[int, ...]) -> Array:
    if array is None or np.shape(array) != shape:
        return np.full(shape, np.nan)
    places = np.asarray(array, dtype=np.float64)
    return np.where(np.abs(places) < _NOWHERE, places, np.nan)


def _main_direction(*places: Array) -> Array:
    """(2,) unit vector of the horizontal direction in which most of the motion goes, towards where it goes."""
    ways = np.concatenate([mean_where(p, 1)[:, :2] for p in places if len(p)])
    ways = ways[np.isfinite(ways).all(axis=1)]
    if len(ways) < 2 or float(np.ptp(ways, axis=0).max()) < 1e-9:
        return np.array([1.0, 0.0])
    axis: Array = np.linalg.svd(ways - ways.mean(axis=0), full_matrices=False)[2][0]
    first = mean_where(places[0], 1)[:, :2]
    first = first[np.isfinite(first).all(axis=1)]
    leads = float((first[-1] - first[0]) @ axis) if len(first) > 1 else float(axis[0])
    return axis if leads >= 0 else -axis


def _observed_centres(observed: Array, reference: Array) -> Array:
    """(T, 2) centre of the points (T, K, 2), those not seen replaced by where a model has them, moved along.

    The plain mean of those seen would jump whenever a point is lost.
    """
    if not np.isfinite(reference).any():
        return mean_where(observed, 1)
    shift = mean_where(observed - reference, 1)
    moved = mean_where(reference, 1) + shift
    return np.where(np.isfinite(moved), moved, mean_where(observed, 1))


def _moments(seen: NDArray[np.bool_], wanted: int) -> list[int]:
    """Frames of the outlines: the first, one in the middle and the last with points; of a short take the first."""
    frames = np.flatnonzero(seen.any(axis=1))
    if not len(frames):
        return []
    if wanted:
        return [int(frames[0])]
    return sorted({int(frames[0]), int(frames[len(frames) // 2]), int(frames[-1])})


def _path(places: Array, moments: list[int]) -> Path:
    outlines = [_outline(places[i]) for i in moments if i < len(places)]
    return Path(centres=mean_where(places, 1), outlines=tuple(o for o in outlines if len(o)))


def _outline(places: Array) -> Array:
    """Convex outline (M, 2) of places (K, 2); (0, 2) where they have none."""
    known = places[np.isfinite(places).all(axis=1)]
    if len(known) < 3:
        return np.empty((0, 2))
    try:
        return np.asarray(known[ConvexHull(known).vertices])
    except (QhullError, ValueError):
        return np.empty((0, 2))


def _ground_line(capture: Capture, axis: Array, drawn: list[Array]) -> Array | None:
    normal, point = capture.ground.unit_normal, np.asarray(capture.ground.point)
    if normal[2] < 0.5:
        return None
    places = np.concatenate([d.reshape(-1, 2) for d in drawn])
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return None
    ends = np.array([places[:, 0].min(), places[:, 0].max()])
    slope = -float(normal[:2] @ axis) / normal[2]
    return np.stack([ends, point[2] + slope * (ends - float(point[:2] @ axis))], axis=1)
