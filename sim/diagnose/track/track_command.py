# SPDX-License-Identifier: MIT
"""The command ``physgen track``: arguments and execution."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from ...atomic import replacing
from ...errors import InputError
from ...events import Event, IsCancelled, OnEvent, ignore, never
from ...scene.folder import Scene, load_scene
from ..capture import Capture, Trial
from ..capture_folder import load_capture, save_capture
from .track_input import BodyRequest, TrackOptions, VideoTrial, parse_body


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``physgen track``."""
    defaults = TrackOptions()
    parser.add_argument("videos", type=Path, nargs="+", metavar="VIDEO", help="one trial each: MP4, MOV, AVI …")
    parser.add_argument("--scene", type=Path, metavar="SCENE", help="scene folder that the videos show")
    plain = "without a scene: the one body that moves, such as ball:diameter=0.04 (docs/from-video.md)"
    parser.add_argument("--object", metavar="BODY", help=plain)
    parser.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="new capture folder")
    objects = "names of the objects to track (default: all that move)"
    parser.add_argument("--objects", nargs="+", action="extend", default=[], metavar="NAME", help=objects)
    start = "first frame to use, from 0, one for all or one per video; it shows the scene as reconstructed (default 0)"
    parser.add_argument("--start-frame", type=int, nargs="+", action="extend", default=[], metavar="N", help=start)
    end = "last frame to use, one for all or one per video (default: the last)"
    parser.add_argument("--end-frame", type=int, nargs="+", action="extend", default=[], metavar="N", help=end)
    fps = "true frame rate of the recording, one for all or one per video (default: the file's own times)"
    parser.add_argument("--fps-override", type=float, nargs="+", action="extend", default=[], metavar="FPS", help=fps)
    predict = (
        "withhold frames later than SECONDS after the first one, to be predicted: of the last video, or of the one "
        "called NAME (its file name without suffix)"
    )
    parser.add_argument(
        "--predict-from", nargs="+", action="extend", default=[], metavar="[NAME=]SECONDS", help=predict
    )
    withheld = "folder for the withheld frames of predict trials (default: dropped)"
    parser.add_argument("--withheld", type=Path, metavar="DIR", help=withheld)
    density = f"target number of points per object (default {defaults.density})"
    parser.add_argument("--density", type=int, default=defaults.density, metavar="N", help=density)
    contrast = f"grey levels per pixel below which a patch has no texture (default {defaults.min_contrast:g})"
    parser.add_argument("--min-contrast", type=float, default=defaults.min_contrast, metavar="LEVELS", help=contrast)
    score = f"correlation with its first sight below which a point counts as hidden (default {defaults.min_score:g})"
    parser.add_argument("--min-score", type=float, default=defaults.min_score, metavar="R", help=score)


def run_command(options: argparse.Namespace, on_event: OnEvent, cancelled: IsCancelled) -> Event:
    """Run the command with parsed ``options``; return the ``done`` event, whose ``summary`` is human-readable."""
    trials = parse_trials(
        options.videos,
        start_frames=options.start_frame,
        end_frames=options.end_frame,
        fps_overrides=options.fps_override,
        predict_from=options.predict_from,
    )
    if (options.scene is None) == (options.object is None):
        raise InputError("give either --scene SCENE or --object BODY, such as ball:diameter=0.04")
    if options.object is not None:
        if options.objects or options.withheld is not None or options.predict_from:
            raise InputError("--objects, --predict-from and --withheld need --scene")
        capture = track_plain(trials, parse_body(options.object), options.out, on_event, cancelled)
        return {"event": "done", "stage": "track", "capture": str(options.out), "summary": summary(capture)}
    capture = track(
        load_scene(options.scene),
        trials,
        out=options.out,
        objects=options.objects,
        options=TrackOptions(density=options.density, min_contrast=options.min_contrast, min_score=options.min_score),
        withheld=options.withheld,
        on_event=on_event,
        cancelled=cancelled,
    )
    return {"event": "done", "stage": "track", "capture": str(options.out), "summary": summary(capture)}


def track_plain(
    trials: Sequence[VideoTrial], body: BodyRequest, out: Path, on_event: OnEvent, cancelled: IsCancelled
) -> Capture:
    """Return the free motion of ``body`` in one video as a capture, written to ``out``; no scene is needed.

    Raises InputError for more than one video, what ``follow_plain_body`` raises, and when ``out`` exists.
    """
    if len(trials) != 1:
        raise InputError(f"{len(trials)} videos: with --object each becomes a capture of its own; give one")
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder")
    from .plain_bodies import follow_plain_body

    save_capture(follow_plain_body(trials[0], body, on_event=on_event, cancelled=cancelled).capture, out)
    return load_capture(out)


def parse_trials(
    videos: Sequence[Path],
    *,
    start_frames: Sequence[int] = (),
    end_frames: Sequence[int] = (),
    fps_overrides: Sequence[float] = (),
    predict_from: Sequence[str] = (),
) -> list[VideoTrial]:
    """Return the videos with their options. Raises InputError when their numbers do not match."""
    count = len(videos)
    starts = _spread("--start-frame", start_frames, count)
    ends = _spread("--end-frame", end_frames, count)
    rates = _spread("--fps-override", fps_overrides, count)
    seconds: list[float | None] = [None] * count
    stems = [path.stem for path in videos]
    for text in predict_from:
        name, equals, number = text.rpartition("=")
        if equals and stems.count(name) != 1:
            raise InputError(f"--predict-from {text!r}: name one of the videos: {', '.join(stems)}")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"--predict-from {text!r}: give SECONDS or NAME=SECONDS")
        seconds[stems.index(name) if equals else count - 1] = value
    return [
        VideoTrial(
            path=path,
            start_frame=starts[i] or 0,
            end_frame=ends[i],
            fps_override=rates[i],
            predict_from=seconds[i],
        )
        for i, path in enumerate(videos)
    ]


def _spread(flag: str, values: Sequence[Any], count: int) -> list[Any]:
    if len(values) not in (0, 1, count):
        raise InputError(f"{flag}: {len(values)} given for {count} videos; give one for all or one per video")
    return [None] * count if not values else list(values) * count if len(values) == 1 else list(values)


def track(
    scene: Scene,
    videos: Sequence[VideoTrial | str | Path],
    *,
    out: str | Path,
    objects: Sequence[str] = (),
    options: TrackOptions | None = None,
    withheld: Path | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Capture:
    """Return the motion of the scene's objects in ``videos`` as a capture, one trial per video; ``out`` is its folder.

    videos: files, or ``VideoTrial`` where only a part of one counts. objects: names of those to track; empty: all that
    move. withheld: folder for ``NAME.npz`` with ``times``, ``pixels``, ``object_index`` and ``rest_points`` of the
    withheld frames of each predict trial; None drops them.

    >>> import physgen
    >>> scene = physgen.load_scene("scene")  # doctest: +SKIP
    >>> capture = physgen.track(scene, ["toss_1.mp4", "toss_2.mp4"], out="capture")  # doctest: +SKIP

    Raises InputError for videos in which nothing can be tracked and when ``out`` exists; Cancelled when cancelled.
    """
    out = Path(out)
    trials = [video if isinstance(video, VideoTrial) else VideoTrial(path=Path(video)) for video in videos]
    for target in (out, withheld):
        if target is not None and target.exists():
            raise InputError(f"{target}: already exists; choose another folder")
    if withheld is not None and withheld.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{withheld}: lies inside the capture, where a diagnosis could see it; choose another folder")
    # OpenCV's trackers and what they need: only for who tracks, not for who asks for the arguments.
    from .track_videos import track_videos

    tracked = track_videos(trials, scene, objects=objects, options=options, on_event=on_event, cancelled=cancelled)
    save_capture(tracked.capture, out)
    if withheld is not None and tracked.withheld:
        _save_withheld(tracked.withheld, withheld)
    loaded = load_capture(out)
    for warning in tracked.capture.warnings:
        on_event({"event": "notice", "stage": "track", "message": warning})
    names = {f.name: getattr(loaded, f.name) for f in fields(loaded)}
    return Capture(**{**names, "warnings": tracked.capture.warnings})


def _save_withheld(trials: dict[str, Trial], folder: Path) -> None:
    with replacing(folder) as partial:
        partial.mkdir(parents=True)
        for name, trial in trials.items():
            assert trial.pixels is not None
            np.savez(
                partial / f"{name}.npz",
                times=trial.times,
                pixels=trial.pixels,
                object_index=trial.object_index,
                rest_points=trial.rest_points,
            )


def summary(capture: Capture) -> str:
    """Return a human-readable summary, one line per trial."""
    lines = []
    for trial in capture.trials:
        seen = trial.seen.sum(axis=1)
        lines.append(
            f"{trial.name} ({trial.role}): {len(trial.times)} frames in {trial.times[-1] - trial.times[0]:.3g} s, "
            f"{trial.rest_points.shape[0]} points, {int(np.median(seen))} in a frame"
        )
    unit = "px" if capture.camera is not None else "m"
    lines.append(f"scatter of a coordinate: {capture.noise_sigma:.2g} {unit}")
    return "\n".join(lines)
