# SPDX-License-Identifier: MIT
"""Figures of a video without a reference: flickering, smoothness, how much moves, what of the first frame is kept.

Flickering, smoothness and dynamic degree have the formulas of VBench (Huang et al., CVPR 2024; Vchitect/VBench,
Apache-2.0); the networks in its smoothness and dynamic degree are replaced by classical flow, and the titles say so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..composite.image_metrics import psnr, ssim_map
from ..errors import Cancelled, InputError
from ..events import IsCancelled
from ..srgb import read_rgb
from .evaluation import HIGHER, LOWER, NEITHER, Curve, Measure, Section
from .flow import FlowEstimator, between
from .footage import Footage, Frame, reduced
from .physics_iq import ASPECT, motion_masks

SIDE = 960
"""Longest side in pixels at which a video is looked at by itself; longer ones are reduced."""
SAMPLED_FPS = 8.0
"""Of the frames between which VBench's dynamic degree takes the flow."""
FASTEST_SHARE = 0.05
"""Of the pixels of a frame: the fastest ones are averaged."""
MOVES_PX, MOVES_SIDE = 6.0, 256.0
"""A frame moves where they are faster than 6 pixels for each 256 of its shorter side."""
MARGIN = 11
"""Pixels around what ever moves that are not background either: the window of SSIM."""
LEAST_BACKGROUND = 0.02
"""Share of the picture that must be background for its figures to say anything."""
MOST_SSIM = 60
"""Frames of which SSIM is taken, evenly spaced; PSNR is of all."""


@dataclass
class _Pass:
    """Figures that one pass over the frames collects."""

    first: Frame | None = None
    count: int = 0
    differences: list[float] = field(default_factory=list)
    errors: list[tuple[int, float, float]] = field(default_factory=list)
    speeds: list[tuple[int, float]] = field(default_factory=list)
    moved: NDArray[np.bool_] | None = None
    areas: list[float] = field(default_factory=list)


def without_reference(
    video: Footage, most: int, *, photo: Path | None, flow: FlowEstimator, flow_name: str, cancelled: IsCancelled
) -> Section:
    """Return the section of the first ``most`` frames of ``video`` by itself.

    photo: what its first frame should equal; None leaves that out. flow_name: of ``flow``, for the titles. Raises
    InputError for a video of one frame, Cancelled on request.
    """
    found = _first_pass(video, most, flow, cancelled)
    if found.count < 2:
        raise InputError(f"{video.name}: is one frame long; motion needs two or more")
    assert found.first is not None and found.moved is not None
    height, width = found.first.shape[:2]
    size = f", reduced to {width}x{height}" if (width, height) != (video.width, video.height) else ""
    background, curves = _background(video, most, found, cancelled)
    notices = list(video.notices)
    if not any(found.areas):
        notices.append(
            f"{video.name}: nothing moves; a video that stands still is perfectly smooth, free of flicker and "
            "consistent, so that none of these figures says anything"
        )
    return Section(
        name="alone",
        title="Without a real video",
        text=f"{found.count} frames of {video.name} at {video.fps:g} a second{size}",
        measures=(*_motion(video, found, flow_name), *_first_frame(found.first, photo), *background),
        curves=(*_motion_curves(video, found, flow_name), *curves),
        notices=tuple(notices),
    )


def _first_pass(video: Footage, most: int, flow: FlowEstimator, cancelled: IsCancelled) -> _Pass:
    found = _Pass()
    recent: list[Frame] = []
    sampled: Frame | None = None
    step = max(1, round(video.fps / SAMPLED_FPS))

    def looked_at(frame: Frame) -> Frame:
        nonlocal sampled
        if cancelled():
            raise Cancelled("the evaluation was cancelled; nothing was written")
        small, index = reduced(frame, SIDE), found.count
        if index == 0:
            found.first = small
        else:
            found.differences.append(float(cv2.absdiff(small, recent[-1]).mean()))
        if index % step == 0:
            if sampled is not None:
                found.speeds.append((index, _fastest(flow(sampled, small))))
            sampled = small
        recent.append(small)
        del recent[:-3]
        # VBench drops every second frame and compares it with what is put in its place.
        if index % 2 == 0 and index:
            made = cv2.absdiff(recent[1], between(recent[0], recent[2], flow)).mean(axis=2)
            moving = cv2.absdiff(recent[0], recent[2]).max(axis=2) > 10
            found.errors.append((index - 1, float(made.mean()), float(made[moving].mean()) if moving.any() else 0.0))
        found.count += 1
        return small

    for mask in motion_masks(map(looked_at, video.frames(most))):
        moving = mask > 0
        found.areas.append(float(moving.mean()))
        found.moved = moving if found.moved is None else found.moved | moving
    return found


def _fastest(flow: NDArray[np.float32]) -> float:
    """Return the mean length in pixels of the fastest twentieth of ``flow`` (H, W, 2)."""
    speed = np.sort(np.hypot(flow[..., 0], flow[..., 1]).ravel())[::-1]
    return float(speed[: max(1, int(len(speed) * FASTEST_SHARE))].mean())


def _motion(video: Footage, found: _Pass, flow_name: str) -> list[Measure]:
    assert found.first is not None and found.moved is not None
    side = min(found.first.shape[:2])
    step = max(1, round(video.fps / SAMPLED_FPS))
    speeds = np.array([speed for _, speed in found.speeds])
    needed = round(4 * (len(found.speeds) + 1) / 16)
    fast = int((speeds > max(1.0, SAMPLED_FPS / video.fps) * MOVES_PX * side / MOVES_SIDE).sum())
    short = "" if len(speeds) else f"needs more than {step} frames at this rate"
    by = f"({flow_name} flow)"
    errors = np.array([row[1:] for row in found.errors]).reshape(-1, 2)
    few = "" if len(errors) else "needs three frames"
    moving = errors[errors[:, 1] > 0, 1]
    return [
        Measure(
            name="temporal_flickering",
            title="Steadiness (VBench's temporal flickering)",
            value=1.0 - float(np.mean(found.differences)) / 255.0,
            better=HIGHER,
            still=1.0,
            note="any motion lowers it: read it beside how much moves",
        ),
        Measure(
            name="motion_smoothness",
            title=f"Motion smoothness {by}",
            value=1.0 - float(errors[:, 0].mean()) / 255.0 if len(errors) else None,
            better=HIGHER,
            still=1.0,
            note=few,
        ),
        Measure(
            name="interpolation_error",
            title=f"Error of the frame between, where it moves {by}",
            value=float(moving.mean()) if len(moving) else 0.0 if len(errors) else None,
            unit="of 255",
            better=LOWER,
            still=0.0,
            note=few,
        ),
        Measure(
            name="motion_speed",
            title=f"Speed of the fastest twentieth {by}",
            value=float(speeds.mean()) / side * video.fps / step if len(speeds) else None,
            unit="sides/s",
            better=NEITHER,
            still=0.0,
            note=short,
        ),
        Measure(
            name="dynamic_degree",
            title=f"Dynamic degree {by}",
            value=float(fast >= needed) if len(speeds) else None,
            better=NEITHER,
            still=0.0,
            note=short or f"{fast} of {len(speeds)} steps are fast, {needed} are needed",
        ),
        Measure(
            name="moving_area",
            title="Share of the picture that ever moves",
            value=float(found.moved.mean()),
            better=NEITHER,
            still=0.0,
        ),
    ]


def _first_frame(first: Frame, photo: Path | None) -> list[Measure]:
    values: tuple[float | None, float | None] = (None, None)
    note = "needs the photo (--photo)"
    if photo is not None:
        picture = np.ascontiguousarray(read_rgb(photo)[..., ::-1])
        same = np.asarray(cv2.resize(picture, first.shape[1::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)
        values = psnr(first, same), float(ssim_map(first / 255.0, same / 255.0).mean())
        note = "equal" if np.isinf(values[0] or 0.0) else ""
        high, wide = picture.shape[:2]
        if abs(wide * first.shape[0] / (high * first.shape[1]) - 1) > ASPECT:
            note = f"the photo has another shape, {wide}x{high} pixels, and is stretched to the frame's"
    return [
        Measure(
            name="first_frame_psnr",
            title="First frame against the photo",
            value=values[0],
            unit="dB",
            better=HIGHER,
            note=note,
        ),
        Measure(
            name="first_frame_ssim",
            title="First frame against the photo, structure (SSIM)",
            value=values[1],
            better=HIGHER,
            note=note,
        ),
    ]


def _background(
    video: Footage, most: int, found: _Pass, cancelled: IsCancelled
) -> tuple[list[Measure], tuple[Curve, ...]]:
    """Return the figures of what never moves against the first frame, and their curves."""
    assert found.first is not None and found.moved is not None
    window = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
    outside = cv2.dilate(found.moved.astype(np.uint8), window) == 0
    share = float(outside.mean())
    titles = {
        "background_psnr": ("Background against the first frame", "dB"),
        "background_ssim": ("Background against the first frame, structure (SSIM)", ""),
    }
    if share < LEAST_BACKGROUND:
        note = f"only {share:.1%} of the picture never moves"
        return [
            Measure(name=n, title=t, value=None, unit=u, better=HIGHER, note=note) for n, (t, u) in titles.items()
        ], ()
    rows: dict[str, tuple[list[int], list[float]]] = {name: ([], []) for name in titles}
    spacing = max(1, -(-found.count // MOST_SSIM))
    before = found.first / 255.0
    errors = []
    for index, frame in enumerate(video.frames(most)):
        if cancelled():
            raise Cancelled("the evaluation was cancelled; nothing was written")
        if index == 0:
            continue
        small = reduced(frame, SIDE)
        difference = (small.astype(np.float64) - found.first)[outside]
        errors.append(float(np.mean(difference**2)))
        rows["background_psnr"][0].append(index)
        rows["background_psnr"][1].append(np.nan if errors[-1] == 0 else 10 * np.log10(255.0**2 / errors[-1]))
        if index % spacing == 0 or index == found.count - 1:
            rows["background_ssim"][0].append(index)
            rows["background_ssim"][1].append(float(ssim_map(small / 255.0, before)[outside].mean()))
    mean = float(np.mean(errors))
    values = {
        "background_psnr": np.inf if mean == 0 else 10 * np.log10(255.0**2 / mean),
        "background_ssim": float(np.mean(rows["background_ssim"][1])),
    }
    note = f"{share:.0%} of the picture never moves"
    measures = [
        Measure(name=name, title=title, value=float(values[name]), unit=unit, better=HIGHER, note=note)
        for name, (title, unit) in titles.items()
    ]
    if mean == 0:
        measures[0] = Measure(
            name="background_psnr",
            title=titles["background_psnr"][0],
            value=float("inf"),
            unit="dB",
            better=HIGHER,
            note=f"{note}, and is equal in all frames",
        )
    curves = tuple(
        Curve(
            name=name, title=titles[name][0], unit=titles[name][1], times=np.array(at) / video.fps, values=np.array(v)
        )
        for name, (at, v) in rows.items()
    )
    return measures, curves


def _motion_curves(video: Footage, found: _Pass, flow_name: str) -> tuple[Curve, ...]:
    def curve(name: str, title: str, unit: str, at: list[int], values: list[float]) -> Curve:
        return Curve(
            name=name, title=title, unit=unit, times=np.array(at) / video.fps, values=np.array(values, np.float64)
        )

    side = min(found.first.shape[:2]) if found.first is not None else 1
    step = max(1, round(video.fps / SAMPLED_FPS))
    return (
        curve("moving_area", "Share of the picture that moves", "", list(range(found.count)), found.areas),
        curve(
            "temporal_flickering",
            "Difference of successive frames",
            "of 255",
            list(range(1, found.count)),
            found.differences,
        ),
        curve(
            "interpolation_error",
            f"Error of the frame between, where it moves ({flow_name} flow)",
            "of 255",
            [row[0] for row in found.errors],
            [row[2] for row in found.errors],
        ),
        curve(
            "motion_speed",
            f"Speed of the fastest twentieth ({flow_name} flow)",
            "sides/s",
            [row[0] for row in found.speeds],
            [row[1] / side * video.fps / step for row in found.speeds],
        ),
    )
