# SPDX-License-Identifier: MIT
"""A video against one or two recordings of the real event: the section of the report, with a still video beside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from .evaluation import HIGHER, LOWER, Curve, Measure, Section
from .footage import SAME_RATE, Footage, at_rate
from .physics_iq import Array, Comparison, Take, compare, original_score, quarter, take, verified_scores

ASPECT = 0.02
"""Share by which two aspect ratios may differ before it is said: the video is then stretched over the recording."""

TITLES = {
    "spatial_iou": ("Where it moves (spatial IoU)", HIGHER),
    "spatiotemporal_iou": ("Where and when (spatiotemporal IoU)", HIGHER),
    "weighted_iou": ("Where and how much (weighted IoU)", HIGHER),
    "mse": ("How pixels differ (MSE)", LOWER),
}


def against(video: Footage, recordings: Sequence[Footage], most: int) -> Section:
    """Return the section of ``video`` against one or two ``recordings``, of their first ``most`` frames.

    Raises InputError for three recordings, for less than two common frames, and for what cannot be read.
    """
    if not 1 <= len(recordings) <= 2:
        raise InputError(f"against: {len(recordings)} recordings are given; give one, or two takes of the same event")
    size = quarter(recordings[0].width, recordings[0].height)
    notices = [*video.notices, *(text for other in recordings for text in _differences(video, other))]
    ours = take(video.frames(most), size, name=video.name)
    takes = [take(at_rate(other, video.fps, most), size, name=other.name) for other in recordings]
    count = min(map(len, (ours, *takes)))
    if count < 2:
        short = next(name for name, item in _named(video, ours, recordings, takes) if len(item) < 2)
        raise InputError(f"{short}: is one frame long; motion needs two or more")
    for name, item in _named(video, ours, recordings, takes):
        if len(item) > count:
            notices.append(
                f"{name}: {len(item)} frames, of which the first {count} have a counterpart; the rest is not compared"
            )
    ours, takes = ours.first(count), [item.first(count) for item in takes]
    notices += [
        f"{name}: nothing moves by the measures' threshold; overlaps with it say nothing"
        for name, item in _named(video, ours, recordings, takes)
        if not item.masks.any()
    ]
    return _section(video, ours, takes, recordings, notices)


def _named(video: Footage, ours: Take, recordings: Sequence[Footage], takes: Sequence[Take]) -> list[tuple[str, Take]]:
    return [(video.name, ours), *zip((other.name for other in recordings), takes, strict=True)]


def _differences(video: Footage, other: Footage) -> list[str]:
    """Return what is done to bring the two together, in words."""
    found = [*other.notices]
    if abs(video.fps - other.fps) > SAME_RATE * video.fps:
        found.append(
            f"{other.name}: has {other.fps:g} frames per second and {video.name} {video.fps:g}; it is brought to "
            f"{video.fps:g} by blending neighbours"
        )
    ratio = video.width / video.height * other.height / other.width
    if abs(ratio - 1) > ASPECT:
        found.append(
            f"{video.name}: has {video.width}x{video.height} pixels and {other.name} {other.width}x{other.height}; it "
            "is stretched to the recording's shape, so that places do not correspond"
        )
    return found


def _section(
    video: Footage, ours: Take, takes: Sequence[Take], recordings: Sequence[Footage], notices: list[str]
) -> Section:
    real = takes[0]
    found, still = compare(ours, real), compare(real.still(), real)
    between = compare(real, takes[1]) if len(takes) == 2 else None
    seconds = len(ours) / video.fps
    names = " and ".join(other.name for other in recordings)
    limits = f"; the two takes: {_values_text(between)}" if between else ""
    return Section(
        name="against",
        title="Against a real video",
        text=f"the first {seconds:.3g} s ({len(ours)} frames) of {video.name} beside {names}{limits}",
        measures=(*_measures(found, still), *_scores(found, still, between)),
        curves=_curves(found, still, between, np.arange(len(ours)) / video.fps),
        notices=tuple(notices),
    )


def _values_text(found: Comparison) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in found.values().items())


def _measures(found: Comparison, still: Comparison) -> list[Measure]:
    unmoved = still.values()
    return [
        Measure(name=name, title=TITLES[name][0], value=value, better=TITLES[name][1], still=unmoved[name])
        for name, value in found.values().items()
    ]


def _scores(found: Comparison, still: Comparison, between: Comparison | None) -> list[Measure]:
    titles = {"physics_iq": "Physics-IQ score", "physics_iq_verified": "Physics-IQ verified score"}
    values: dict[str, tuple[float | None, float | None]] = dict.fromkeys(titles, (None, None))
    note = "needs a second take of the same event (--against twice)"
    if between is not None:
        takes = between.rounded()
        rows = [item.rounded() for item in (found, still)]
        original = [original_score(row, takes) for row in rows]
        verified = [100.0 * float(np.mean(list(verified_scores(row, takes).values()))) for row in rows]
        values = {"physics_iq": (original[0], original[1]), "physics_iq_verified": (verified[0], verified[1])}
        note = "" if original[0] is not None else "the two takes have no motion in common"
    return [
        Measure(name=name, title=title, value=values[name][0], unit="", better=HIGHER, still=values[name][1], note=note)
        for name, title in titles.items()
    ]


def _curves(found: Comparison, still: Comparison, between: Comparison | None, times: Array) -> tuple[Curve, ...]:
    shown = [("this video", found), ("standing still", still)]
    if between is not None:
        shown.append(("two real takes", between))
    return tuple(
        Curve(name=name, title=TITLES[name][0], label=label, times=times, values=getattr(item, name))
        for name in ("spatiotemporal_iou", "mse")
        for label, item in shown
    )
