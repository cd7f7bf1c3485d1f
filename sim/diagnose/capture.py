# SPDX-License-Identifier: MIT
"""Captures: observations of a real motion, and the nominal model of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

STIFFNESSES = ("soft", "medium", "hard")

Vector = tuple[float, float, float]
Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The assumed ground plane. normal: any length; friction: Coulomb coefficient; restitution: None if unknown."""

    point: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    friction: float = 0.5
    restitution: float | None = None

    def __post_init__(self) -> None:
        if math.hypot(*self.normal) < 1e-9:
            raise InputError(f"normal is {list(self.normal)}: give a direction, not three zeros")
        if not 0 <= self.friction <= 10:
            raise InputError(f"friction is {self.friction!r}: give 0 to 10")
        if self.restitution is not None and not 0 <= self.restitution <= 1:
            raise InputError(f"restitution is {self.restitution!r}: give 0 to 1, or null where it is not known")

    @property
    def unit_normal(self) -> Array:
        """Return the unit normal (3,)."""
        normal = np.asarray(self.normal, dtype=np.float64)
        return normal / np.linalg.norm(normal)


@dataclass(frozen=True, kw_only=True)
class ObjectBelief:
    """Assumed properties of an object. Density in kg/m³, Young's modulus in Pa (None with ``hard``: a rigid body)."""

    name: str
    mesh: str
    density_kg_m3: float
    stiffness: str
    youngs_modulus_pa: float | None = None
    poisson_ratio: float = 0.3

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("name is empty: name the object")
        if self.stiffness not in STIFFNESSES:
            raise InputError(f"stiffness is {self.stiffness!r}: give {', '.join(STIFFNESSES)}")
        if not 1e-3 <= self.density_kg_m3 <= 1e5:
            raise InputError(f"density_kg_m3 is {self.density_kg_m3!r}: give 0.001 to 100000")
        if self.youngs_modulus_pa is None and self.stiffness != "hard":
            raise InputError(f"youngs_modulus_pa is null: give it for a {self.stiffness} object, or call it hard")
        if self.youngs_modulus_pa is not None and not 1 <= self.youngs_modulus_pa <= 1e13:
            raise InputError(f"youngs_modulus_pa is {self.youngs_modulus_pa!r}: give 1 to 1e13, or null if rigid")
        if not 0 <= self.poisson_ratio < 0.5:
            raise InputError(f"poisson_ratio is {self.poisson_ratio!r}: give 0 to below 0.5")

    @property
    def rigid(self) -> bool:
        """Return whether it is modelled as a rigid body."""
        return self.youngs_modulus_pa is None


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera with OpenCV axes (x right, y down, z forward); pixels, and metres in ``world_from_camera``."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: tuple[tuple[float, float, float, float], ...]

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"width and height are {self.width} and {self.height}: give pixels")
        if not (self.fx > 0 and self.fy > 0):
            raise InputError(f"fx and fy are {self.fx!r} and {self.fy!r}: give focal lengths in pixels, above 0")
        matrix = np.asarray(self.world_from_camera, dtype=np.float64)
        if matrix.shape != (4, 4):
            raise InputError(f"world_from_camera has shape {matrix.shape}: give 4 rows of 4 numbers")
        turn = matrix[:3, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-9):
            raise InputError("world_from_camera: give a rotation and a shift; this scales or shears")
        if np.linalg.det(turn) < 0:
            raise InputError("world_from_camera mirrors: its axes are left-handed; flip one of them")

    @property
    def matrix(self) -> Array:
        """Return world_from_camera (4, 4)."""
        return np.asarray(self.world_from_camera, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class CaptureObject:
    """An object: assumed properties, and its mesh in its rest frame, (V, 3) in m and (F, 3) vertex indices."""

    belief: ObjectBelief
    vertices: Array
    faces: NDArray[np.int64]

    @property
    def name(self) -> str:
        """Return its name."""
        return self.belief.name


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One recorded trial. T frames, K tracked points.

    times: (T,) s, rising. points: (T, K, 3) m, world, NaN where not seen; or pixels: (T, K, 2); the other is None.
    object_index: (K,) object of a point. rest_points: (K, 3) m, in the object's rest frame.
    predict_times: (P,) s, after the last frame; only of a ``predict`` trial.
    """

    name: str
    role: str
    times: Array
    points: Array | None
    pixels: Array | None
    object_index: NDArray[np.int64]
    rest_points: Array
    predict_times: Array | None = None

    @property
    def observed(self) -> Array:
        """Return points (T, K, 3) or pixels (T, K, 2), whichever is given."""
        found = self.points if self.points is not None else self.pixels
        assert found is not None
        return found

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Return (T, K): whether a point was seen."""
        return np.asarray(np.isfinite(self.observed).all(axis=2))


@dataclass(frozen=True, kw_only=True)
class Capture:
    """A loaded capture. gravity: assumed, m/s²; noise_sigma: of one coordinate, m for points, pixels for pixels.

    warnings: problems that do not prevent a diagnosis.

    >>> import physgen
    >>> capture = physgen.load_capture("capture")  # doctest: +SKIP
    >>> [(trial.name, trial.role, len(trial.times)) for trial in capture.trials]  # doctest: +SKIP
    [('toss_1', 'fit', 120), ('toss_2', 'predict', 24)]
    """

    gravity: Vector
    ground: Ground
    objects: tuple[CaptureObject, ...]
    noise_sigma: float
    camera: Camera | None
    trials: tuple[Trial, ...]
    root: Path | None = None
    warnings: tuple[str, ...] = field(default=())

    def __repr__(self) -> str:
        objects = ", ".join(item.belief.name for item in self.objects)
        return f"Capture(root={str(self.root)!r}, objects: {objects}; trials: {', '.join(t.name for t in self.trials)})"

    @property
    def fit_trials(self) -> tuple[Trial, ...]:
        """Return the complete trials."""
        return tuple(t for t in self.trials if t.role == "fit")

    @property
    def predict_trials(self) -> tuple[Trial, ...]:
        """Return the trials with only their first frames."""
        return tuple(t for t in self.trials if t.role == "predict")
