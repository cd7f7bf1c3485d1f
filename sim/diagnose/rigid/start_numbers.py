# SPDX-License-Identifier: MIT
"""Starting numbers of effects whose fit has several minima, from what the flights of the nominal model leave.

A flight is held to the recording's noise, so its curvature beyond the nominal model's is a missing force per mass at a
known place. Where these forces point to one place, a tether begins there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .multiple_shooting import Fit
from .observed_poses import QUATERNION, TOUCHED

Array = NDArray[np.float64]

WINDOW_S = 0.2
"""Time in s over which a missing force counts as constant."""

LEAST_FRAMES = 8

CLEAR = 4.0
"""Missing force over its standard deviation above which it counts."""

ANCHOR_SPREAD = 0.5
"""Standard deviation in m of an anchor about the usual one, half a metre above the motion."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MissingForces:
    """Forces per mass that the nominal model lacks in flight. places: (N, 3) m; forces, (N, 3) and deviations, (N,) of
    a component, m/s²."""

    places: Array
    forces: Array
    deviations: Array

    @property
    def clear(self) -> NDArray[np.bool_]:
        """Return (N,) whether a force is far above its noise."""
        return np.asarray(np.linalg.norm(self.forces, axis=1) > CLEAR * self.deviations)


def missing_forces(fit: Fit) -> MissingForces:
    """Return what the flights of ``fit`` lack, by windows of ``WINDOW_S``; empty for pixels, which show no depth."""
    places, forces, deviations = [], [], []
    for segment in fit.evaluation.segments:
        seen = fit.problem.trials[segment.trial].observations
        if seen.camera is not None:
            continue
        free = np.flatnonzero(segment.record[:, TOUCHED] <= 0)
        clock = seen.times[segment.frames]
        for begin in np.arange(clock[0], clock[-1], WINDOW_S):
            rows = free[(clock[free] >= begin) & (clock[free] < begin + WINDOW_S)]
            if len(rows) < LEAST_FRAMES:
                continue
            pose = segment.record[rows]
            _, slope, info = seen.information(pose[:, :3], pose[:, QUATERNION], segment.frames[rows])
            # Best translation of each frame, and the parabola through them.
            shift = slope[:, :3] / np.maximum(info[:, 0, 0], 1e-9)[:, None]
            weight = np.sqrt(info[:, 0, 0])
            t = clock[rows] - clock[rows].mean()
            basis = np.column_stack([np.ones(len(t)), t, 0.5 * t**2])
            scaled = basis * weight[:, None]
            if np.linalg.matrix_rank(scaled) < 3:
                continue
            cover = np.linalg.inv(scaled.T @ scaled)
            forces.append((cover @ scaled.T @ (shift * weight[:, None]))[2])
            deviations.append(float(np.sqrt(cover[2, 2])))
            places.append(pose[:, :3].mean(axis=0))
    return MissingForces(
        places=np.array(places).reshape(-1, 3), forces=np.array(forces).reshape(-1, 3), deviations=np.array(deviations)
    )


def tether_start(missing: MissingForces, middle: Array) -> tuple[float, float, Array] | None:
    """Return stiffness per mass (1/s²), rest length (m) and anchor (3,) of a string that pulls as ``missing`` says.

    The anchor is the place nearest to all lines along the forces (least squares), the other two follow from how the
    forces grow with distance. None where fewer than three forces are clear, or they point away from each other.
    """
    use = missing.clear
    if int(use.sum()) < 3:
        return None
    x, a = missing.places[use], missing.forces[use]
    size = np.linalg.norm(a, axis=1)
    way = a / size[:, None]
    # A direction is known as well as the force is large against its noise.
    sure = size / missing.deviations[use]
    usual = middle + np.array([0.0, 0.0, 0.5])
    anchor = usual
    for _ in range(3):
        distance = np.maximum(np.linalg.norm(anchor - x, axis=1), 0.05)
        weight = np.minimum((sure / distance) ** 2, 1e6)
        across = np.eye(3) - way[:, :, None] * way[:, None, :]
        matrix = np.einsum("n,nij->ij", weight, across) + np.eye(3) / ANCHOR_SPREAD**2
        right = np.einsum("n,nij,nj->i", weight, across, x) + usual / ANCHOR_SPREAD**2
        anchor = np.linalg.solve(matrix, right)
    line = anchor - x
    distance = np.linalg.norm(line, axis=1)
    pull = np.sum(a * line, axis=1) / np.maximum(distance, 1e-9)
    if np.mean(pull > 0) < 0.6:
        return None
    slope, offset = np.polyfit(distance, pull, 1) if np.ptp(distance) > 0.02 else (0.0, 0.0)
    length = float(np.clip(-offset / slope, 0.05, 0.9 * distance.max())) if slope > 1e-3 else 0.3
    beyond = np.maximum(distance - length, 1e-3)
    return float(np.clip(np.sum(pull * beyond) / np.sum(beyond**2), 0.02, 50.0)), length, anchor
