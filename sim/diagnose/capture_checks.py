# SPDX-License-Identifier: MIT
"""Plausibility checks of a well-formed capture: units, handedness, rest points on the mesh."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..errors import InputError
from ..rigid_alignment import nearest_rotation
from .capture import Array, Capture, CaptureObject, Trial

LARGEST_M = 20.0
"""Mesh extent above which millimetres are assumed."""

MISFIT_SIGMAS = 12.0
"""Rigid alignment residual of a hard body, in standard deviations, above which the capture is inconsistent."""

OFF_MESH = 0.25
"""Distance of a rest point from the mesh, relative to the mesh's extent, above which a warning is given."""


def check_capture(capture: Capture) -> Capture:
    """Return ``capture`` with its warnings. Raises InputError where no diagnosis is possible."""
    warnings: list[str] = []
    for item in capture.objects:
        _check_mesh(item, warnings)
    trials = [t for t in capture.trials if _enough(t, capture, warnings)]
    if not any(t.role == "fit" for t in trials):
        raise InputError("no fit trial has three frames with points in them: track more of the motion")
    for trial in trials:
        _check_places(trial, capture, warnings)
        if trial.points is not None:
            _check_scale_and_hand(trial, capture)
    return dataclasses.replace(capture, trials=tuple(trials), warnings=tuple(dict.fromkeys(warnings)))


def _check_mesh(item: CaptureObject, warnings: list[str]) -> None:
    import trimesh

    extent = float(np.ptp(item.vertices, axis=0).max())
    if extent > LARGEST_M:
        raise InputError(
            f"object {item.name!r}: the mesh is {extent:.3g} m across, probably millimetres: export it in metres"
        )
    if extent < 1e-4:
        raise InputError(f"object {item.name!r}: the mesh is {extent:.3g} m across: export it in metres")
    mesh = trimesh.Trimesh(item.vertices, item.faces, process=True)
    if not mesh.is_watertight:
        warnings.append(f"object {item.name!r}: the mesh is not closed; its convex hull is used instead")
    elif mesh.volume < 0:
        warnings.append(f"object {item.name!r}: the mesh is inside out; its convex hull is used instead")


def _enough(trial: Trial, capture: Capture, warnings: list[str]) -> bool:
    frames = int(trial.seen.any(axis=1).sum())
    if frames >= 3:
        return True
    if trial.role == "predict":
        raise InputError(f"trial {trial.name!r}: points are seen in {frames} frames; a prediction needs at least 3")
    warnings.append(f"trial {trial.name!r}: points are seen in {frames} frames; it is left out")
    return False


def _check_places(trial: Trial, capture: Capture, warnings: list[str]) -> None:
    for index, item in enumerate(capture.objects):
        rest = trial.rest_points[trial.object_index == index]
        if len(rest) == 0:
            continue
        low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
        outside = np.maximum(np.maximum(low - rest, rest - high), 0)
        worst = float(np.linalg.norm(outside, axis=1).max() / np.ptp(item.vertices, axis=0).max())
        if worst > OFF_MESH:
            warnings.append(
                f"trial {trial.name!r}: rest points of {item.name!r} lie outside the mesh by {worst:.2g} of its extent"
            )


def _check_scale_and_hand(trial: Trial, capture: Capture) -> None:
    """Check scale and handedness: tracked points against their rest points, object by object."""
    assert trial.points is not None
    for index, item in enumerate(capture.objects):
        chosen = trial.object_index == index
        rest = trial.rest_points[chosen]
        seen = trial.seen[:, chosen]
        frame = int(seen.sum(axis=1).argmax())
        there = seen[frame]
        if there.sum() < 4:
            continue
        a, b = rest[there], trial.points[frame, chosen][there]
        size_a, size_b = _spread(a), _spread(b)
        if size_a < 1e-9:
            continue
        noise = capture.noise_sigma / size_a
        if not 0.5 < size_b / size_a < 2 and noise < 0.1:
            raise InputError(
                f"trial {trial.name!r}: points of {item.name!r} are {size_b / size_a:.3g} times as far apart as on its "
                "mesh: give both in metres"
            )
        straight, mirrored = _misfit(a, b, 1.0), _misfit(a, b, -1.0)
        flat = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)[2] < 0.05 * size_a
        if not flat and mirrored < 0.3 * straight and straight > MISFIT_SIGMAS * capture.noise_sigma:
            raise InputError(
                f"trial {trial.name!r}: points of {item.name!r} fit its mirrored mesh: left-handed axes; flip one"
            )


def _spread(points: Array) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _misfit(a: Array, b: Array, hand: float) -> float:
    """Return the RMS distance in m of ``b`` from ``a`` rotated (hand 1) or rotated and mirrored (hand -1)."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    turn = nearest_rotation(b.T @ a, hand=hand)
    return float(np.sqrt(((b - a @ turn.T) ** 2).sum(axis=1).mean()))
