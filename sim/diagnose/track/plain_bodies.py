# SPDX-License-Identifier: MIT
"""A video and the size of one body → a capture: no scene, no texture, no start at rest (docs/from-video.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..capture import Capture, CaptureObject, Ground, Trial
from ..capture_checks import check_capture
from .box_pose import BoxMotion, follow_box
from .motion_view import MotionView, understand_motion
from .moving_regions import MovingRegions, Region, find_moving_regions
from .path_pieces import noise_px, stopped_at, wobble_px
from .path_relations import bodies, shown_share
from .pose_estimation import Array
from .region_track import link_regions, true_times, with_missing_frames
from .track_input import BodyRequest, VideoTrial
from .video_file import Video

STAGE = "track"
MOST_FRAMES = 160
"""Frames of a capture; more of a slow recording add work, not knowledge."""
LEAST_FRAMES = 10
ELEVATIONS = tuple(math.radians(a) for a in (0, 15, 25, 35, 45, 55, 65, 75, 90))
"""Angles of the camera above the ground that are tried against outlines."""
CLEAR, FROM_ABOVE = 0.1, math.radians(55)
"""Relative difference of an outline from the body's, and elevation, at which a body is surely seen from above."""
CENTRE_PX = 0.2
"""Standard deviation of a centre in px that no scatter shows: an edge is known to about half a pixel, and its contrast
changes along the way."""
RIVAL = 0.4
"""Freedom of another body's path, over that of the chosen one, from which a warning names it."""
LEAST_SHOWN = 0.75
"""Share of its outline that one region of a body that is no ball has to fill; with less, lengths are off by 15 %."""
MISSHAPEN = 0.35
"""Relative difference between an outline and the body's from which a warning is given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoMotion:
    """Result of following a plain body. capture: of one trial. view: where the motion lies in the picture. found: the
    video's regions.

    frames: (T,) of the video, for the capture's samples. places: (T, 2) px of the centre. regions: those of the body.
    box: the body as a box that turns, at the same samples, where its faces tell the camera. others: regions of other
    bodies that move as freely, each in the order of frames.
    """

    capture: Capture
    view: MotionView
    found: MovingRegions
    frames: NDArray[np.int64]
    places: Array
    regions: tuple[Region, ...]
    box: BoxMotion | None = None
    others: tuple[tuple[Region, ...], ...] = ()


def follow_plain_body(
    video: VideoTrial,
    body: BodyRequest,
    *,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> VideoMotion:
    """Return the free motion of ``body`` in ``video`` as a capture; gravity, ground and scale come from the video.

    Raises InputError for an unreadable video, where nothing moves, nothing moves as one body, or too few frames are
    left; Cancelled on request.
    """
    path, item = video.path, body.capture_object()
    with Video(path) as source:
        info = source.info
    progress = StageProgress(on_event, STAGE, max(1, 2 * info.frames))
    found = _found_regions(video, max(1, 2 * info.frames), progress, cancelled)
    followed = _followed(video, body, found, info.fps)
    regions = followed.regions
    places = np.array([r.middle for r in regions]) / found.scale
    clock, missing = with_missing_frames(followed.times, places)
    length_px, length, elevation, misfit = apparent_size(regions, body, item, found.scale)
    standing = float(-item.vertices[:, 2].min())
    view = understand_motion(
        clock,
        places,
        diameter_px=length_px,
        diameter=length,
        clearance=standing,
        elevation=elevation,
        where=str(path),
        from_above=body.kind != "ball" and misfit < CLEAR and elevation >= FROM_ABOVE,
        rim=0.5 * body.diameter if body.kind == "cylinder" and body.diameter is not None else None,
    )
    if view.on_rim:
        item = body.capture_object(on_rim=True)
    path_px, box = places, None
    if view.kind == "surface" and body.kind == "box":
        picture = info.width, info.height
        seen_so = _seen_as_box(regions, item, found.scale, picture, followed.times, standing, str(path))
        if seen_so is not None:
            view, box, path_px, clock, missing = seen_so
            misfit = 0.0
    kept, free = _samples(path, regions, clock, view, box)
    points = view.points[kept - view.first]
    noise_of_centre = _centre_noise(body, view, clock[free], path_px[free], None if box is None else box.at(free))
    turns = None if box is None else box.turns[kept]
    trial, noise = _trial(path.stem, clock[kept], points, item, view, noise_of_centre, turns)
    capture = _capture(body, item, view, trial, noise)
    for message in (*view.notes, *followed.warnings, *_doubts(body, missing, misfit)):
        progress.notice(f"{path.name}: {message}")
    return VideoMotion(
        capture=capture,
        view=view,
        found=found,
        frames=np.array([regions[k].frame for k in kept]),
        places=places[kept],
        regions=tuple(regions[k] for k in kept),
        box=None if box is None else box.at(kept),
        others=followed.others,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Followed:
    """The body that moves most freely. regions: where it is seen whole, each in a frame of its own. times: (n,) s of
    these. others: see ``VideoMotion``."""

    regions: list[Region]
    times: Array
    warnings: tuple[str, ...]
    others: tuple[tuple[Region, ...], ...]


def _doubts(body: BodyRequest, missing: int, misfit: float) -> list[str]:
    """Return warnings of ``missing`` frames, and of an outline that is off that of ``body`` by the share ``misfit``."""
    said = []
    if missing:
        said.append(f"{missing} frames are missing in the file: the body jumps ahead and goes on as before")
    if misfit > MISSHAPEN:
        said.append(
            f"what moves does not look like a {body.kind} of that shape (outline {100 * misfit:.0f} % off); "
            "its scale is rough"
        )
    return said


def _found_regions(video: VideoTrial, steps: int, progress: StageProgress, cancelled: IsCancelled) -> MovingRegions:
    """Return the moving regions of ``video``; each frame is looked at twice, so it has ``steps`` of work."""
    count = 0

    def on_frame() -> None:
        nonlocal count
        count += 1
        if cancelled():
            raise Cancelled("tracking was cancelled; nothing was written")
        if count % 10 == 0:
            progress.report(min(count, steps), video.path.name)

    found = find_moving_regions(video.path, video.start_frame, video.end_frame, on_frame)
    progress.report(steps, video.path.name)
    if len(found.stamps) < LEAST_FRAMES:
        raise InputError(
            f"{video.path}: {len(found.stamps)} frames could be read; a motion needs {LEAST_FRAMES}: give a longer part"
        )
    return found


def _capture(body: BodyRequest, item: CaptureObject, view: MotionView, trial: Trial, noise: float) -> Capture:
    """The capture of one ``trial`` of ``item`` over the ground that ``view`` found."""
    ground = Ground(
        point=tuple(float(v) for v in view.point),  # type: ignore[arg-type]
        normal=tuple(float(v) for v in view.normal),  # type: ignore[arg-type]
        friction=body.friction,
        restitution=body.restitution,
    )
    return check_capture(
        Capture(
            gravity=(0.0, 0.0, -9.81),
            ground=ground,
            objects=(item,),
            noise_sigma=noise,
            camera=None,
            trials=(trial,),
        )
    )


def _followed(video: VideoTrial, body: BodyRequest, found: MovingRegions, fps: float) -> _Followed:
    """Return the body that moves most freely in ``found``. fps: frame rate that the file claims.

    Raises InputError where nothing moves, nothing moves as one body, or too little of it is seen.
    """
    path = video.path
    linked = link_regions(found)
    paths = bodies(linked, found.faint)
    if not any(found.regions):
        raise InputError(f"{path}: nothing moves in it; check --start-frame and --end-frame")
    chosen = [p for p in paths if p.freedom() > 0]
    if not chosen:
        raise InputError(
            f"{path}: nothing moves through it as one body of its own; film it alone before a still background"
        )
    times, fresh, notes = true_times(found.stamps, found.change, fps, video.fps_override)
    warnings = [notes] if notes else []
    if found.to_background is not None:
        warnings.append(f"the camera drifts by up to {found.drift:.1f} px; frames are aligned to the background")
    rivals = [p for p in chosen[1:] if p.freedom() > RIVAL * chosen[0].freedom()]
    if rivals:
        x, y = chosen[0].middles[0] / found.scale
        warnings.append(
            f"more than one body moves; the one that begins at x = {x:.0f}, y = {y:.0f} px is followed: "
            "--start-frame and --end-frame choose another"
        )
    regions = [r for r in chosen[0].regions if not r.cut and fresh[r.frame]]
    if len(regions) < LEAST_FRAMES:
        raise InputError(f"{path}: the body is seen whole in {len(regions)} frames; a motion needs {LEAST_FRAMES}")
    if body.kind != "ball" and (shown := shown_share(chosen[0], linked)) < LEAST_SHOWN:
        raise InputError(
            f"{path}: one region shows {100 * shown:.0f} % of the body, the rest looks like the background or comes in "
            "pieces, so that its size gives no scale: film it before a background of another colour, or paint it"
        )
    return _Followed(
        regions=regions,
        times=times[[r.frame for r in regions]],
        warnings=tuple(warnings),
        others=tuple(tuple(p.regions) for p in rivals),
    )


def _samples(
    path: Path, regions: list[Region], clock: Array, view: MotionView, box: BoxMotion | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the numbers of the ``regions`` that the capture keeps, and of all in free motion.

    Raises InputError where too few are kept.
    """
    last = view.first + stopped_at(clock[view.first : view.last + 1], view.points)
    step = max(1, math.ceil((last - view.first + 1) / MOST_FRAMES))
    kept = np.arange(view.first, last + 1, step)
    free = np.arange(view.first, view.last + 1)
    if box is not None:
        kept, free = kept[box.sound[kept]], free[box.sound[free]]
    if len(kept) < LEAST_FRAMES:
        first, end = regions[int(kept[0])].frame, regions[int(kept[-1])].frame
        raise InputError(
            f"{path}: the body is seen in free motion in {len(kept)} frames, {first} to {end}; a motion needs "
            f"{LEAST_FRAMES}: film it at a higher frame rate, with nothing in front of it"
        )
    return kept, free


def _centre_noise(body: BodyRequest, view: MotionView, clock: Array, path_px: Array, box: BoxMotion | None) -> float:
    """Return the standard deviation in px of the centres ``path_px`` (n, 2) at ``clock`` (n,) s. box: at these."""
    noise = noise_px(path_px)
    if body.kind in ("box", "mesh") and view.kind == "surface":
        noise = max(noise, wobble_px(clock, path_px))
    if box is not None:
        # What a turn that is a little wrong moves the middles of the faces by, sideways.
        arm = 0.5 * float(np.mean(box.edges[:2])) * view.scale
        aside = np.stack([box.turns * arm, np.zeros(len(clock))], axis=1)
        noise = max(noise, wobble_px(clock, aside))
    return noise


def _seen_as_box(
    regions: list[Region],
    item: CaptureObject,
    scale: float,
    picture: tuple[int, int],
    times: Array,
    standing: float,
    where: str,
) -> tuple[MotionView, BoxMotion, Array, Array, int] | None:
    """Return what three faces of a box tell: its view with the camera, its motion, its path (N, 2) in px as seen from
    straight above, times (N,) s with those of missing frames, and how many these are. None where no such box is seen
    sliding on a level surface. scale: working px per video px. times: (N,) s. standing: m of its centre above ground.
    """
    edges = np.ptp(item.vertices, axis=0)
    box = follow_box([r.outline / scale for r in regions], edges, picture)
    if box is None:
        return None
    widths = [np.sqrt(r.area) / scale for r in regions]
    finest = float(np.median(widths)) / float(np.sqrt(edges[0] * edges[1]))
    above = box.centres[:, :2] * (finest, -finest)
    clock, missing = with_missing_frames(times, above)
    try:
        view = understand_motion(
            clock,
            above,
            diameter_px=finest * float(edges[0]),
            diameter=float(edges[0]),
            clearance=standing,
            elevation=math.pi / 2,
            where=where,
        )
    except InputError:
        return None
    if view.kind != "surface":
        return None
    turned = math.degrees(abs(box.turns[view.last] - box.turns[view.first]))
    camera = box.camera
    notes = (
        f"a box that slides on a level surface and turns by {turned:.0f}°",
        f"the camera by its edges: {math.degrees(camera.pitch):.0f}° below the horizon, {1e3 * camera.height:.0f} mm "
        f"above the ground, focal length {camera.focal:.0f} px; outlines fit within {box.residual:.1f} px",
    )
    return replace(view, notes=notes, camera=camera, start=box.centres[view.first]), box, above, clock, missing


def _trial(
    name: str,
    times: Array,
    points: Array,
    item: CaptureObject,
    view: MotionView,
    noise: float,
    turns: Array | None,
) -> tuple[Trial, float]:
    """Return the trial, and its noise in m. A ball or a disc on its rim is its centre; other bodies keep their side to
    the ground, and turn about its normal by ``turns`` (T,) rad where that is known."""
    clean = "".join(c if c.isalnum() or c in "_-" else "_" for c in name).strip("_") or "take"
    vertices = item.vertices
    rest, turn = np.zeros((1, 3)), np.eye(3)
    if not _is_round(item) and not view.on_rim:
        half = vertices.max(axis=0)
        rest = np.array([[0, 0, 0], [half[0], 0, 0], [0, half[1], 0], [0, 0, half[2]], [-half[0], 0, 0]], dtype=float)
        across = np.array([0.0, 1.0, 0.0])
        along = np.cross(across, view.normal)
        turn = np.stack([along, across, view.normal], axis=1)
    moved = (rest @ turn.T)[None]
    if turns is not None and len(rest) > 1:
        c, s, zero = np.cos(turns), np.sin(turns), np.zeros(len(turns))
        spin = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1).reshape(-1, 3, 3)
        moved = np.einsum("ij,tjk,lk->tli", turn, spin, rest)
    observed = points[:, None] + moved
    trial = Trial(
        name=clean,
        role="fit",
        times=times - times[0],
        points=observed,
        pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64),
        rest_points=rest,
    )
    return trial, float(np.hypot(noise, CENTRE_PX)) / view.scale


def _is_round(item: CaptureObject) -> bool:
    """Return whether the body, centred on its middle, is a ball: its faces are as far from there as its corners."""
    a, b, c = (item.vertices[item.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    far = np.abs((normals * a).sum(axis=1)) / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    return bool(far.min() > 0.97 * np.linalg.norm(item.vertices, axis=1).max())


def apparent_size(
    regions: list[Region], body: BodyRequest, item: CaptureObject, scale: float
) -> tuple[float, float, float, float]:
    """Return a length in video px, the same in m, the camera's elevation in rad, and how badly the outline fits.

    A ball is measured across its motion, so that blur does not widen it; other bodies by the area and proportions of
    their outline, seen from every elevation. scale: working px per video px.
    """
    if body.kind == "ball":
        across = float(np.median([4 * r.axes[1] for r in regions]))
        wide = float(np.median([r.axes[0] / r.axes[1] for r in regions]))
        assert body.diameter is not None
        return across / scale, body.diameter, math.pi / 2, max(0.0, wide - 2.5)
    area = float(np.median([r.area for r in regions]))
    ratio = float(np.median([r.axes[0] / r.axes[1] for r in regions]))
    best: tuple[float, float, float] | None = None
    for elevation in ELEVATIONS:
        seen = [_outline(item.vertices, elevation, yaw) for yaw in np.linspace(0, math.pi, 12, endpoint=False)]
        areas, ratios = np.array([s[0] for s in seen]), np.array([s[1] for s in seen])
        off = abs(math.log(ratio / float(np.median(ratios))))
        if best is None or off < best[0] - 0.01:
            best = off, elevation, float(np.sqrt(np.median(areas)))
    assert best is not None
    off, elevation, length = best
    return math.sqrt(area) / scale, length, max(elevation, math.radians(20)), off


def _outline(vertices: Array, elevation: float, yaw: float) -> tuple[float, float]:
    """Return the area in m² and the ratio of the axes of the body's outline from afar."""
    c, s = math.cos(yaw), math.sin(yaw)
    x = c * vertices[:, 0] - s * vertices[:, 1]
    y = (s * vertices[:, 0] + c * vertices[:, 1]) * math.sin(elevation) + vertices[:, 2] * math.cos(elevation)
    try:
        hull = ConvexHull(np.stack([x, y], axis=1))
    except QhullError:
        raise InputError("object: the body is flat: give a closed body") from None
    corners = np.stack([x, y], axis=1)[hull.vertices]
    middle = corners.mean(axis=0)
    a, b = corners - middle, np.roll(corners, -1, axis=0) - middle
    part = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    total = float(part.sum())
    centre = (part[:, None] * (a + b) / 3).sum(axis=0) / total
    second = sum(
        p / 6 * (np.outer(u, u) + np.outer(v, v) + 0.5 * (np.outer(u, v) + np.outer(v, u)))
        for p, u, v in zip(part, a, b, strict=True)
    ) / total - np.outer(centre, centre)
    low, high = np.linalg.eigvalsh(second)
    return abs(total), math.sqrt(max(high, 1e-18) / max(low, 1e-18))
