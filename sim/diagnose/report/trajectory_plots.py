# SPDX-License-Identifier: MIT
"""Tracks of points on a plane: observed, nominal and with the effect, as paths and as figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...html import Markup, Picture, element, join, label, short_number, shortened
from ..capture import Camera, Capture, Trial
from ..capture_geometry import mean_known
from ..diagnosis import Diagnosis, TrialArrays
from .diagnosis_charts import curve
from .effect_words import found_effects, found_label
from .number_format import axis_unit, quantity_text, tick_text, with_unit

Array = NDArray[np.float64]
_NOWHERE = 1e6
"""m; beyond this a model has diverged and is not drawn."""

Plane = Callable[[Array], Array]
"""(…, 3) m in the world to (…, 2) in the plane."""


@dataclass(frozen=True, kw_only=True)
class ProjectedPath:
    """One object's path (N, 2) and convex outlines (M, 2) at some moments, in the plane of the picture."""

    centres: Array
    outlines: tuple[Array, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TrialTracks:
    """The drawn paths of one trial, object by object.

    unit: "m" (horizontal and height) or "px" (right and down). observed: observed paths; dots: (M, 2) observed points
    at the moments of the outlines. nominal, found: over the given frames. before, after: over the predicted times.
    ground: two ends (2, 2) of the assumed ground line, or None where it is not seen from the side.
    """

    name: str
    role: str
    unit: str
    observed: tuple[Array, ...]
    dots: Array
    nominal: tuple[ProjectedPath, ...]
    found: tuple[ProjectedPath, ...]
    before: tuple[ProjectedPath, ...]
    after: tuple[ProjectedPath, ...]
    ground: Array | None


def trial_tracks(trial: Trial, arrays: TrialArrays, capture: Capture) -> TrialTracks:
    """Return the paths of all objects of ``trial``, without what is missing or of another shape."""
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
    return TrialTracks(
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
    """Return the side view: along the horizontal unit vector ``axis`` (2,), and up."""
    return lambda places: np.stack([places[..., :2] @ axis, places[..., 2]], axis=-1)


def camera_plane(camera: Camera) -> Plane:
    """Return the projection to the camera's pixels; NaN behind it."""
    inverse = np.linalg.inv(camera.matrix)

    def project(places: Array) -> Array:
        seen = places @ inverse[:3, :3].T + inverse[:3, 3]
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(seen[..., 2:] > 1e-6, seen[..., 2:], np.nan)
            return np.asarray(seen[..., :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy))

    return project


def _shaped(array: Array | None, shape: tuple[int, ...]) -> Array:
    if array is None or np.shape(array) != shape:
        return np.full(shape, np.nan)
    places = np.asarray(array, dtype=np.float64)
    return np.where(np.abs(places) < _NOWHERE, places, np.nan)


def _main_direction(*places: Array) -> Array:
    """Return the (2,) horizontal unit vector of the main direction of motion."""
    ways = np.concatenate([mean_known(p, 1)[:, :2] for p in places if len(p)])
    ways = ways[np.isfinite(ways).all(axis=1)]
    if len(ways) < 2 or float(np.ptp(ways, axis=0).max()) < 1e-9:
        return np.array([1.0, 0.0])
    axis: Array = np.linalg.svd(ways - ways.mean(axis=0), full_matrices=False)[2][0]
    first = mean_known(places[0], 1)[:, :2]
    first = first[np.isfinite(first).all(axis=1)]
    leads = float((first[-1] - first[0]) @ axis) if len(first) > 1 else float(axis[0])
    return axis if leads >= 0 else -axis


def _observed_centres(observed: Array, reference: Array) -> Array:
    """Return the centre (T, 2) of points (T, K, 2), with unseen points filled in from a shifted model.

    The plain mean would jump whenever a point is lost.
    """
    if not np.isfinite(reference).any():
        return mean_known(observed, 1)
    shift = mean_known(observed - reference, 1)
    moved = mean_known(reference, 1) + shift
    return np.where(np.isfinite(moved), moved, mean_known(observed, 1))


def _moments(seen: NDArray[np.bool_], wanted: int) -> list[int]:
    """Return the frames with outlines: first, middle and last with points; only the first of a predict trial."""
    frames = np.flatnonzero(seen.any(axis=1))
    if not len(frames):
        return []
    if wanted:
        return [int(frames[0])]
    return sorted({int(frames[0]), int(frames[len(frames) // 2]), int(frames[-1])})


def _path(places: Array, moments: list[int]) -> ProjectedPath:
    outlines = [_outline(places[i]) for i in moments if i < len(places)]
    return ProjectedPath(centres=mean_known(places, 1), outlines=tuple(o for o in outlines if len(o)))


def _outline(places: Array) -> Array:
    """Return the convex hull (M, 2) of places (K, 2); (0, 2) where there is none."""
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


MAX_TAKES = 12
WIDTH, HEIGHT = 300.0, 236.0
_TOP, _MARGIN = 26.0, 14.0
_DOTS_APART = 7.0
_PLACES = 160
"""Vertices of a path; more are not visible at this size."""


def shown_trials(diagnosis: Diagnosis, capture: Capture) -> list[TrialTracks]:
    """Return the trials with a picture, in the capture's order."""
    both = [(t, diagnosis.trials[t.name]) for t in capture.trials if t.name in diagnosis.trials]
    return [trial_tracks(trial, arrays, capture) for trial, arrays in both[:MAX_TAKES]]


def tracks_pictures(diagnosis: Diagnosis, capture: Capture) -> list[Picture]:
    """Return a picture of each trial."""
    with_found = bool(found_effects(diagnosis.verdict))
    return [_picture(trial, with_found, found_label(diagnosis.verdict)) for trial in shown_trials(diagnosis, capture)]


def tracks_legend(diagnosis: Diagnosis) -> Picture:
    """Return the legend of the track pictures."""
    entries = [
        (element("circle", cx=10, cy=0, r=2.3, class_="panel observed-line", stroke_width=1.1), "observed"),
        (
            element("path", d="M0 0H20", class_="line nominal-line", stroke_width=2, stroke_dasharray="6 3"),
            "nominal model",
        ),
    ]
    if found_effects(diagnosis.verdict):
        caption = shortened(found_label(diagnosis.verdict), 34)
        entries.append((element("path", d="M0 0H20", class_="line found-line", stroke_width=2), caption))
    y, parts = 10.0, []
    for mark, caption in entries:
        parts.append(element("g", mark, transform=f"translate(0 {short_number(y)})"))
        parts.append(label(caption, 28, y + 4))
        y += 20
    return Picture(
        width=WIDTH,
        height=y,
        title="Legend",
        description="; ".join(caption for _, caption in entries),
        body=join(parts),
    )


def _picture(trial: TrialTracks, with_found: bool, found: str) -> Picture:
    place = _Placement(trial, with_found)
    parts: list[Markup | None] = [
        element("rect", x=0, y=_TOP, width=WIDTH, height=HEIGHT - _TOP, rx=6, class_="panel"),
        label(shortened(trial.name, 24), 0, 15, class_="ink strong"),
        label("prediction" if trial.role == "predict" else "", WIDTH, 15, class_="quiet", anchor="end"),
    ]
    if trial.ground is not None:
        parts.append(element("path", d=place.curve(trial.ground), class_="line tick", stroke_width=1))
    parts += [_way(place, path, "nominal", "6 3") for path in (*trial.nominal, *trial.before)]
    if with_found:
        parts += [_way(place, path, "found", None) for path in (*trial.found, *trial.after)]
    for centres in trial.observed:
        parts += [
            element("circle", cx=x, cy=y, r=2.3, class_="panel observed-line", stroke_width=1.1)
            for x, y in spaced(place.places(centres))
        ]
    parts += [
        element("circle", cx=x, cy=y, r=1.1, class_="observed-fill dot") for x, y in place.places(trial.dots[:200])
    ]
    parts.append(_scale_bar(place, trial.unit))
    seen = "as the camera saw it" if trial.unit == "px" else "from the side"
    lines = f"observed, nominal model{f', and {found}' if with_found else ''}"
    return Picture(
        width=WIDTH,
        height=HEIGHT,
        title=f"{shortened(trial.name, 40)}, {seen}",
        description=f"Paths of the objects' centres: {lines}.{_parting(trial, with_found, found)}",
        body=join(parts),
    )


def spaced(places: Array) -> list[tuple[float, float]]:
    """Return the places (N, 2) that keep a minimum distance from the previous one shown."""
    shown: list[tuple[float, float]] = []
    for x, y in places.tolist():
        if not shown or (x - shown[-1][0]) ** 2 + (y - shown[-1][1]) ** 2 >= _DOTS_APART**2:
            shown.append((x, y))
    return shown


def _parting(trial: TrialTracks, with_found: bool, found: str) -> str:
    """Return how far the simulated paths end from the observed one, or from each other where it is withheld."""
    sentences = []
    if trial.role == "predict":
        for before, after in zip(trial.before, trial.after, strict=False):
            if with_found and len(before.centres) and np.isfinite(before.centres[-1] + after.centres[-1]).all():
                apart = float(np.linalg.norm(before.centres[-1] - after.centres[-1]))
                sentences.append(f"At the end of the prediction the two are {quantity_text(apart, trial.unit)} apart.")
        return "".join(f" {s}" for s in sentences)
    for observed, nominal, better in zip(trial.observed, trial.nominal, trial.found, strict=True):
        for path, words in ((nominal, "the nominal model"), (better, found if with_found else "")):
            both = np.isfinite(observed + path.centres).all(axis=1)
            if words and both.any():
                apart = float(np.linalg.norm((observed - path.centres)[both][-1]))
                sentences.append(f"At the end {words} is {quantity_text(apart, trial.unit)} off.")
    return "".join(f" {s}" for s in sentences)


def _way(place: _Placement, path: ProjectedPath, class_: str, dashes: str | None) -> Markup:
    outlines = [
        element("path", d=place.curve(np.concatenate([o, o[:1]])), class_=f"line {class_}-line", stroke_width=1)
        for o in path.outlines
    ]
    centres = path.centres[:: max(1, len(path.centres) // _PLACES)]
    if len(centres) and len(path.centres):
        centres = np.concatenate([centres, path.centres[-1:]])
    way = element(
        "path", d=place.curve(centres), class_=f"line {class_}-line", stroke_width=1.8, stroke_dasharray=dashes
    )
    return join([*outlines, way])


def bar_text(length: float, unit: str) -> str:
    """Return a round length with its unit."""
    factor, name = axis_unit(length, unit)
    return with_unit(tick_text(length * factor), name)


def _scale_bar(place: _Placement, unit: str) -> Markup | None:
    length = place.bar
    if length is None:
        return None
    pixels, y = length * place.scale, HEIGHT - 10
    return join(
        [
            element(
                "path",
                d=f"M10 {short_number(y - 4)}V{short_number(y)}H{short_number(10 + pixels)}V{short_number(y - 4)}",
                class_="line tick",
            ),
            label(bar_text(length, unit), 16 + pixels, y, class_="quiet halo", size=11),
        ]
    )


class _Placement:
    """Maps the plane of a trial to its picture: one scale for both axes, everything inside."""

    def __init__(self, trial: TrialTracks, with_found: bool) -> None:
        paths = (*trial.nominal, *trial.before, *(trial.found + trial.after if with_found else ()))
        shown = [trial.dots, *trial.observed, *(p.centres for p in paths), *(o for p in paths for o in p.outlines)]
        places = np.concatenate([s.reshape(-1, 2) for s in shown]) if shown else np.empty((0, 2))
        places = places[np.isfinite(places).all(axis=1)]
        # A diverged path must not shrink the rest to a dot.
        if len(places):
            middle = np.median(places, axis=0)
            reach = np.linalg.norm(places - middle, axis=1)
            usual = 6 * max(float(np.percentile(reach, 75)), 1e-9)
            places = places[reach <= usual]
        self.low, high = (places.min(axis=0), places.max(axis=0)) if len(places) else (np.zeros(2), np.ones(2))
        extent = np.maximum(high - self.low, 1e-9)
        room = np.array([WIDTH - 2 * _MARGIN, HEIGHT - _TOP - 2 * _MARGIN - 24])
        self.scale = float((room / extent).min())
        self.offset = (room - extent * self.scale) / 2 + (_MARGIN, _MARGIN)
        self.extent, self.down = extent, trial.unit == "px"
        wanted = 70 / self.scale
        power = 10.0 ** np.floor(np.log10(wanted))
        self.bar = float(max(f * power for f in (1, 2, 5) if f * power <= wanted)) if len(places) > 1 else None

    def places(self, flat: Array) -> Array:
        """Return picture positions (N, 2) of the finite points of ``flat`` (M, 2) that lie inside."""
        found = self._moved(flat)
        inside = (found >= (0, _TOP)).all(axis=1) & (found <= (WIDTH, HEIGHT)).all(axis=1)
        return found[inside & np.isfinite(found).all(axis=1)]

    def curve(self, flat: Array) -> str:
        """Return the path through ``flat`` (M, 2), broken outside the picture."""
        found = self._moved(flat)
        with np.errstate(invalid="ignore"):
            inside = (found >= (0, _TOP)).all(axis=1) & (found <= (WIDTH, HEIGHT)).all(axis=1)
        found = np.where(inside[:, None], found, np.nan)
        return curve(found[:, 0], found[:, 1])

    def _moved(self, flat: Array) -> Array:
        x, y = ((flat - self.low) * self.scale).T
        y = y if self.down else self.extent[1] * self.scale - y
        return np.stack([x + self.offset[0], y + self.offset[1] + _TOP], axis=1)
