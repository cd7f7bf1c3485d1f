# SPDX-License-Identifier: MIT
"""A generated case: the capture that a diagnosis gets, its ground truth, and the camera that observes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..sim.diagnose.capture import Camera, Capture
from ..sim.diagnose.diagnosis import NONE
from .mujoco_world import Array


@dataclass(frozen=True, kw_only=True)
class TrialTruth:
    """Ground truth of one trial. T frames shown, P withheld, K points.

    points: (T, K, 3) m without noise; active: (T,) whether the cause acts; withheld: (P, K, 3) m and withheld_active:
    (P,), of a predict trial. point_mask: (K,) the points on which it acts, None for all.
    """

    points: Array
    active: NDArray[np.bool_]
    withheld: Array | None = None
    withheld_active: NDArray[np.bool_] | None = None
    point_mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Truth of a case. effects: the causes, strongest first; () for ``none`` and ``unknown``. mechanism: in words.

    oracle_rms_m: error of the true model on withheld frames, started from the shown frames.
    effect_rms_over_noise: size of the effect. ambiguous_with: effects indistinguishable in such data → reason.
    """

    effect: str
    effects: tuple[str, ...]
    mechanism: str
    simulator: str
    parameters: Mapping[str, Any]
    oracle_rms_m: float
    effect_rms_over_noise: float
    trials: Mapping[str, TrialTruth]
    ambiguous_with: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def label(self) -> dict[str, Any]:
        """Return the part that is sealed, as plain JSON values: everything but the arrays."""
        return {
            "effect": self.effect,
            "effects": list(self.effects),
            "mechanism": self.mechanism,
            "simulator": self.simulator,
            "parameters": dict(self.parameters),
            "ambiguous_with": dict(self.ambiguous_with),
            "oracle_rms_m": self.oracle_rms_m,
            "effect_rms_over_noise": self.effect_rms_over_noise,
            **self.notes,
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return ``TAKE.points``, ``TAKE.effect_active`` and, if present, ``points_predict``, ``point_mask``."""
        out: dict[str, NDArray[Any]] = {}
        for name, trial in self.trials.items():
            out[f"{name}.points"] = trial.points.astype(np.float32)
            out[f"{name}.effect_active"] = trial.active
            if trial.withheld is not None and trial.withheld_active is not None:
                out[f"{name}.points_predict"] = trial.withheld.astype(np.float32)
                out[f"{name}.effect_active_predict"] = trial.withheld_active
            if trial.point_mask is not None and self.effect != NONE:
                out[f"{name}.point_mask"] = trial.point_mask
        return out


@dataclass(frozen=True, kw_only=True)
class BlindCase:
    """The capture that the diagnosis sees, and the truth that it must not see."""

    capture: Capture
    truth: Truth


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Radial lens distortion k1 in x (1 + k1 r²), 0 for a pinhole."""

    k1: float = 0.0


def drop_points(frames: int, points: int, share: float, rng: np.random.Generator) -> Array:
    """Return a mask (T, K) of points lost in runs of 2 to 12 frames, about ``share`` of all."""
    out = np.zeros((frames, points), dtype=bool)
    mean = 5.0
    for point in range(points):
        wanted = share * float(rng.exponential())
        frame = 0
        while True:
            frame += 1 + int(rng.exponential(mean * (1 - min(wanted, 0.8)) / max(min(wanted, 0.8), 1e-3)))
            if frame >= frames:
                break
            run = int(np.clip(rng.exponential(mean), 2, 12))
            out[frame : frame + run, point] = True
            frame += run
    # The initial state must be observable: never lose all points of a frame.
    crowded = out.mean(axis=1) > 0.6
    out[crowded] = False
    return out


def project(points: Array, camera: Camera, lens: Lens) -> Array:
    """Return pixels (…, 2) of world ``points`` (…, 3)."""
    world_from_camera = camera.matrix
    local = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    flat = local[..., :2] / local[..., 2:]
    flat = flat * (1 + lens.k1 * np.sum(flat**2, axis=-1, keepdims=True))
    return np.asarray(flat * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def draw_camera(target: Array, distance: float, rng: np.random.Generator) -> Camera:
    """Return a camera that looks at ``target`` from ``distance`` m, slightly from above."""
    azimuth, height = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.45)
    back = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    eye = target + distance * back
    forward = -back
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return _camera(np.column_stack([right, np.cross(forward, right), forward]), eye, float(rng.uniform(840, 980)))


def moved_camera(camera: Camera, rotation: Array, shift: Array) -> Camera:
    """Return ``camera`` rotated by ``rotation`` about the world's origin and translated by ``shift`` m."""
    matrix = camera.matrix
    return _camera(rotation @ matrix[:3, :3], rotation @ matrix[:3, 3] + shift, camera.fx)


def _camera(turn: Array, eye: Array, focal: float) -> Camera:
    rows = [(*map(float, turn[i]), float(eye[i])) for i in range(3)] + [(0.0, 0.0, 0.0, 1.0)]
    return Camera(
        width=1280,
        height=720,
        fx=focal,
        fy=focal,
        cx=640.0,
        cy=360.0,
        world_from_camera=tuple((r[0], r[1], r[2], r[3]) for r in rows),
    )
