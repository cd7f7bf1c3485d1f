# SPDX-License-Identifier: MIT
"""Observed, nominal and found motion of every take: a small picture each, of equal scale in both directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...page.markup import Markup, Picture, element, join, label, short, shortened
from ..capture import Capture
from ..diagnosis import Diagnosis
from .axes import curve
from .quantities import axis_unit, quantity_text, tick_text, with_unit
from .tracks import Path, TakeTracks, take_tracks
from .words import found_effects, found_label

Array = NDArray[np.float64]

MAX_TAKES = 12
WIDTH, HEIGHT = 300.0, 236.0
_TOP, _MARGIN = 26.0, 14.0
_DOTS_APART = 7.0
_PLACES = 160
"""Corners of a way; more cannot be told apart at this size."""


def shown_takes(diagnosis: Diagnosis, capture: Capture) -> list[TakeTracks]:
    """The takes with a picture, in the capture's order."""
    both = [(t, diagnosis.trials[t.name]) for t in capture.trials if t.name in diagnosis.trials]
    return [take_tracks(trial, arrays, capture) for trial, arrays in both[:MAX_TAKES]]


def tracks_pictures(diagnosis: Diagnosis, capture: Capture) -> list[Picture]:
    """A picture of each take."""
    with_found = bool(found_effects(diagnosis.verdict))
    return [_picture(take, with_found, found_label(diagnosis.verdict)) for take in shown_takes(diagnosis, capture)]


def tracks_legend(diagnosis: Diagnosis) -> Picture:
    """What the lines mean, on one narrow picture."""
    entries = [
        (element("circle", cx=10, cy=0, r=2.3, class_="panel observed-line", stroke_width=1.1), "observed"),
        (
            element("path", d="M0 0H20", class_="line nominal-line", stroke_width=2, stroke_dasharray="6 3"),
            "as simulated",
        ),
    ]
    if found_effects(diagnosis.verdict):
        said = shortened(found_label(diagnosis.verdict), 34)
        entries.append((element("path", d="M0 0H20", class_="line found-line", stroke_width=2), said))
    y, parts = 10.0, []
    for mark, said in entries:
        parts.append(element("g", mark, transform=f"translate(0 {short(y)})"))
        parts.append(label(said, 28, y + 4))
        y += 20
    return Picture(
        width=WIDTH,
        height=y,
        title="What the lines mean",
        description="; ".join(said for _, said in entries),
        body=join(parts),
    )


def _picture(take: TakeTracks, with_found: bool, found: str) -> Picture:
    place = _Placement(take, with_found)
    parts: list[Markup | None] = [
        element("rect", x=0, y=_TOP, width=WIDTH, height=HEIGHT - _TOP, rx=6, class_="panel"),
        label(shortened(take.name, 24), 0, 15, class_="ink strong"),
        label("prediction" if take.role == "predict" else "", WIDTH, 15, class_="quiet", anchor="end"),
    ]
    if take.ground is not None:
        parts.append(element("path", d=place.curve(take.ground), class_="line tick", stroke_width=1))
    parts += [_way(place, path, "nominal", "6 3") for path in (*take.nominal, *take.before)]
    if with_found:
        parts += [_way(place, path, "found", None) for path in (*take.found, *take.after)]
    for centres in take.observed:
        parts += [
            element("circle", cx=x, cy=y, r=2.3, class_="panel observed-line", stroke_width=1.1)
            for x, y in spaced(place.places(centres))
        ]
    parts += [
        element("circle", cx=x, cy=y, r=1.1, class_="observed-fill dot") for x, y in place.places(take.dots[:200])
    ]
    parts.append(_scale_bar(place, take.unit))
    seen = "as the camera saw it" if take.unit == "px" else "from the side"
    lines = f"observed, as simulated{f', and {found}' if with_found else ''}"
    return Picture(
        width=WIDTH,
        height=HEIGHT,
        title=f"{shortened(take.name, 40)}, {seen}",
        description=f"Way of the objects' centres: {lines}.{_parting(take, with_found, found)}",
        body=join(parts),
    )


def spaced(places: Array) -> list[tuple[float, float]]:
    """The places (N, 2) that are at least some pixels from the one shown before."""
    shown: list[tuple[float, float]] = []
    for x, y in places.tolist():
        if not shown or (x - shown[-1][0]) ** 2 + (y - shown[-1][1]) ** 2 >= _DOTS_APART**2:
            shown.append((x, y))
    return shown


def _parting(take: TakeTracks, with_found: bool, found: str) -> str:
    """How far the simulated ways end from the observed one, or from each other where that was not seen."""
    said = []
    if take.role == "predict":
        for before, after in zip(take.before, take.after, strict=False):
            if with_found and len(before.centres) and np.isfinite(before.centres[-1] + after.centres[-1]).all():
                apart = float(np.linalg.norm(before.centres[-1] - after.centres[-1]))
                said.append(f"At the end of the prediction the two are {quantity_text(apart, take.unit)} apart.")
        return "".join(f" {s}" for s in said)
    for observed, nominal, better in zip(take.observed, take.nominal, take.found, strict=True):
        for path, words in ((nominal, "as simulated"), (better, found if with_found else "")):
            both = np.isfinite(observed + path.centres).all(axis=1)
            if words and both.any():
                apart = float(np.linalg.norm((observed - path.centres)[both][-1]))
                said.append(f"At the end {words} is {quantity_text(apart, take.unit)} off.")
    return "".join(f" {s}" for s in said)


def _way(place: _Placement, path: Path, class_: str, dashes: str | None) -> Markup:
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
    """A round length with its unit."""
    factor, name = axis_unit(length, unit)
    return with_unit(tick_text(length * factor), name)


def _scale_bar(place: _Placement, unit: str) -> Markup | None:
    length = place.bar
    if length is None:
        return None
    pixels, y = length * place.scale, HEIGHT - 10
    return join(
        [
            element("path", d=f"M10 {short(y - 4)}V{short(y)}H{short(10 + pixels)}V{short(y - 4)}", class_="line tick"),
            label(bar_text(length, unit), 16 + pixels, y, class_="quiet", size=11),
        ]
    )


class _Placement:
    """From the plane of a take into its picture: one scale for both directions, everything inside."""

    def __init__(self, take: TakeTracks, with_found: bool) -> None:
        paths = (*take.nominal, *take.before, *(take.found + take.after if with_found else ()))
        shown = [take.dots, *take.observed, *(p.centres for p in paths), *(o for p in paths for o in p.outlines)]
        places = np.concatenate([s.reshape(-1, 2) for s in shown]) if shown else np.empty((0, 2))
        places = places[np.isfinite(places).all(axis=1)]
        # What has flown off to nowhere must not shrink the rest to a dot.
        if len(places):
            middle = np.median(places, axis=0)
            reach = np.linalg.norm(places - middle, axis=1)
            usual = 6 * max(float(np.percentile(reach, 75)), 1e-9)
            places = places[reach <= usual]
        self.low, high = (places.min(axis=0), places.max(axis=0)) if len(places) else (np.zeros(2), np.ones(2))
        extent = np.maximum(high - self.low, 1e-9)
        room = np.array([WIDTH - 2 * _MARGIN, HEIGHT - _TOP - 2 * _MARGIN - 16])
        self.scale = float((room / extent).min())
        self.offset = (room - extent * self.scale) / 2 + (_MARGIN, _MARGIN)
        self.extent, self.down = extent, take.unit == "px"
        wanted = 70 / self.scale
        power = 10.0 ** np.floor(np.log10(wanted))
        self.bar = float(max(f * power for f in (1, 2, 5) if f * power <= wanted)) if len(places) > 1 else None

    def places(self, flat: Array) -> Array:
        """(N, 2) places in the picture of those of ``flat`` (M, 2) that are numbers and inside."""
        found = self._moved(flat)
        inside = (found >= (0, _TOP)).all(axis=1) & (found <= (WIDTH, HEIGHT)).all(axis=1)
        return found[inside & np.isfinite(found).all(axis=1)]

    def curve(self, flat: Array) -> str:
        """The path through ``flat`` (M, 2); places outside are left out."""
        found = self._moved(flat)
        with np.errstate(invalid="ignore"):
            inside = (found >= (0, _TOP)).all(axis=1) & (found <= (WIDTH, HEIGHT)).all(axis=1)
        found = np.where(inside[:, None], found, np.nan)
        return curve(found[:, 0], found[:, 1])

    def _moved(self, flat: Array) -> Array:
        x, y = ((flat - self.low) * self.scale).T
        y = y if self.down else self.extent[1] * self.scale - y
        return np.stack([x + self.offset[0], y + self.offset[1] + _TOP], axis=1)
