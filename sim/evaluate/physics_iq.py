# SPDX-License-Identifier: MIT
"""The four measures of Physics-IQ, its scores relative to two takes of an event, and their section of a report.

Motamed, Culp, Swersky, Jaini and Geirhos, *Do generative video models understand physical principles?*, WACV 2026,
arXiv 2501.09038; its program is google-deepmind/physics-iq-benchmark (Apache-2.0), whose definitions these follow step
by step. The verified score is that of Rädsch et al., *Physics-IQ Verified*, arXiv 2606.18943.

One thing differs: the benchmark stores its masks as compressed videos before it reads them again, here they stay exact.
The section compares a video with one or two recordings of the real event, with a still video beside.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .evaluation import HIGHER, LOWER, Curve, Measure, Section
from .footage import SAME_RATE, Footage, Frame, at_rate

Array = NDArray[np.float64]
Masks = NDArray[np.bool_]

ALPHA = 0.3
"""Share of each new frame in the running average."""
THRESHOLD = 10
"""Grey levels of 255 by which a frame must differ from the running average."""
KERNEL = 5
"""Side in pixels of the Gaussian and of the opening and closing."""
QUARTER = 4
MOST_BYTES = 2**31
"""Of the frames of one video at quarter size."""
DECIMALS = 4
"""The benchmark's table rounds each frame's value before it makes the score."""
EPSILON = 1e-8

NAMES = ("spatial_iou", "spatiotemporal_iou", "weighted_iou", "mse")
"""The four measures. The three of overlap are 1 at best and 0 at worst, the error the other way around."""


def motion_masks(frames: Iterable[Frame]) -> Iterator[NDArray[np.uint8]]:
    """Yield a mask (H, W) of what moves for each of ``frames`` (H, W, 3): 255 there, else 0; the first is empty.

    A frame is taken to grey and blurred by a 5×5 Gaussian. Where it differs by more than 10 of 255 from the running
    average, which already holds it with a share of 0.3, it moves; an opening and a closing by a 5×5 square follow.
    """
    kernel = np.ones((KERNEL, KERNEL), np.uint8)
    average: NDArray[np.float64] | None = None
    for frame in frames:
        grey = cv2.GaussianBlur(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), (KERNEL, KERNEL), 0)
        if average is None:
            average = grey.astype(np.float64)
            yield np.zeros(grey.shape, np.uint8)
            continue
        cv2.accumulateWeighted(grey, average, ALPHA)
        difference = cv2.absdiff(grey, cv2.convertScaleAbs(average))
        moving = cv2.threshold(difference, THRESHOLD, 255, cv2.THRESH_BINARY)[1]
        moving = cv2.morphologyEx(moving, cv2.MORPH_OPEN, kernel)
        yield np.asarray(cv2.morphologyEx(moving, cv2.MORPH_CLOSE, kernel), dtype=np.uint8)


@dataclass(frozen=True, kw_only=True)
class Take:
    """A video as the measures see it: frames (T, h, w, 3) of 8 bits and masks (T, h, w), both at quarter size."""

    frames: NDArray[np.uint8]
    masks: Masks

    def __len__(self) -> int:
        return len(self.masks)

    def first(self, count: int) -> Take:
        """Return the first ``count`` frames alone."""
        return Take(frames=self.frames[:count], masks=self.masks[:count])

    def still(self) -> Take:
        """Return a video of the same length that stands still: the first frame, repeated."""
        frames = np.broadcast_to(self.frames[:1], self.frames.shape)
        return Take(frames=frames, masks=np.zeros_like(self.masks))


def quarter(width: int, height: int) -> tuple[int, int]:
    """Return the width and height at which videos are compared with a recording of ``width`` × ``height`` pixels."""
    return max(1, width // QUARTER), max(1, height // QUARTER)


def take(frames: Iterable[Frame], size: tuple[int, int], *, name: str) -> Take:
    """Return the video ``frames`` (H, W, 3) at ``size`` (width, height); masks are made at its own size.

    Raises InputError, naming it ``name``, for no frame, and for more than fits in ``MOST_BYTES``.
    """
    small: list[NDArray[np.uint8]] = []
    masks: list[Masks] = []
    most = MOST_BYTES // (4 * size[0] * size[1])

    def watched() -> Iterator[Frame]:
        for frame in frames:
            if len(small) >= most:
                raise InputError(f"{name}: is longer than {most} frames of its size; cut it (--seconds)")
            small.append(np.asarray(cv2.resize(frame, size), dtype=np.uint8))
            yield frame

    for mask in motion_masks(watched()):
        masks.append(np.asarray(cv2.resize(mask, size) > 127))
    if not small:
        raise InputError(f"{name}: no frame of it can be read; convert it to MP4 (H.264)")
    return Take(frames=np.stack(small), masks=np.stack(masks))


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The four measures of one video against another.

    spatial_iou: overlap of where anything ever moved. spatiotemporal_iou: (T,) overlap in each frame. weighted_iou:
    overlap weighted by how long it moved there. mse: (T,) mean squared error of each frame, of values 0 to 1.
    """

    spatial_iou: float
    spatiotemporal_iou: Array
    weighted_iou: float
    mse: Array

    def values(self) -> dict[str, float]:
        """Return each of ``NAMES`` as one number, over time the mean."""
        return {
            "spatial_iou": self.spatial_iou,
            "spatiotemporal_iou": float(self.spatiotemporal_iou.mean()),
            "weighted_iou": self.weighted_iou,
            "mse": float(self.mse.mean()),
        }

    def rounded(self) -> dict[str, float]:
        """Return ``values`` as the benchmark's table has them: each frame rounded to four decimals first."""
        return self.values() | {
            "spatiotemporal_iou": float(self.spatiotemporal_iou.round(DECIMALS).mean()),
            "mse": float(self.mse.round(DECIMALS).mean()),
        }


def compare(a: Take, b: Take) -> Comparison:
    """Return the measures of ``a`` against ``b``, which are of one length and size; they are symmetric."""
    assert a.frames.shape == b.frames.shape and a.masks.shape == b.masks.shape
    return Comparison(
        spatial_iou=float(overlap(a.masks.any(axis=0)[None], b.masks.any(axis=0)[None])[0]),
        spatiotemporal_iou=overlap(a.masks, b.masks),
        weighted_iou=weighted_overlap(a.masks.mean(axis=0), b.masks.mean(axis=0)),
        mse=squared_error(a.frames, b.frames),
    )


def overlap(a: Masks, b: Masks) -> Array:
    """Return intersection over union (T,) of masks (T, h, w); 1 where both are empty."""
    both, either = (a & b).sum(axis=(1, 2)), (a | b).sum(axis=(1, 2))
    return np.where(either == 0, 1.0, both / np.maximum(either, 1))


def weighted_overlap(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Return Σ min(a, b) / Σ max(a, b) of two maps of non-negative weights; 1 where both are zero."""
    most = float(np.maximum(a, b).sum())
    return 1.0 if most == 0 else float(np.minimum(a, b).sum()) / most


def squared_error(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Array:
    """Return the mean squared error (T,) of frames (T, h, w, 3), of values from 0 to 1."""
    pairs = zip(a, b, strict=True)
    return np.array([np.mean((_unit(x) - _unit(y)) ** 2) for x, y in pairs], dtype=np.float64)


def _unit(frame: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.asarray(frame / 255.0, dtype=np.float32)


def original_score(ours: dict[str, float], takes: dict[str, float]) -> float | None:
    """Return the Physics-IQ score, 0 to 100, of the means ``ours`` relative to ``takes``, two real takes compared.

    100 ((S/S' + T/T' + W/W')/3 - (E - E')), clipped: overlaps of space S, of space and time T, weighted W, and the
    error E; a prime marks the two takes. None where the takes have nothing in common, so that nothing can be said.
    """
    shares = [(ours[name], takes[name]) for name in NAMES[:3]]
    if any(real <= 0 for _, real in shares):
        return None
    raw = sum(found / real for found, real in shares) / 3 - (ours["mse"] - takes["mse"])
    return 100.0 * min(max(raw, 0.0), 1.0)


def verified_scores(ours: dict[str, float], takes: dict[str, float]) -> dict[str, float]:
    """Return the score of each of ``NAMES``, 0 to 1, of one view; their mean is the verified score of that view.

    An overlap counts relative to that of the two takes, the error of the takes relative to the video's.
    """
    found = {name: ours[name] / (takes[name] + EPSILON) for name in NAMES[:3]}
    ratio = ours["mse"] / (takes["mse"] + EPSILON)
    found["mse"] = 1.0 if ratio <= 0 else 1.0 / ratio
    return {name: min(max(value, 0.0), 1.0) for name, value in found.items()}


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
    if len(recordings) == 2 and recordings[0].path.resolve() == recordings[1].path.resolve():
        notices.append(
            f"{recordings[0].name}: is given twice: the two takes are equal, and the scores have no meaning; give "
            "another take of the event"
        )
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
    elif (video.width, video.height) != (other.width, other.height):
        found.append(
            f"{video.name}: has {video.width}x{video.height} pixels and {other.name} {other.width}x{other.height}; "
            "both are compared at a quarter of the first recording's size"
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
    limits = f"; the two takes of each other: {_values_text(between)}" if between else ""
    return Section(
        name="against",
        title="Against a real video",
        text=f"the first {seconds:.3g} s ({len(ours)} frames) of {video.name} beside {names}{limits}",
        measures=(*_measures(found, still), *_scores(found, still, between)),
        curves=_curves(found, still, between, np.arange(len(ours)) / video.fps),
        notices=tuple(notices),
    )


def _values_text(found: Comparison) -> str:
    values = found.values()
    words = zip(("spatial IoU", "spatiotemporal IoU", "weighted IoU", "MSE"), values.values(), strict=True)
    return ", ".join(f"{name} {value:.3g}" for name, value in words)


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
