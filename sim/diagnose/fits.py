# SPDX-License-Identifier: MIT
"""What the fits of one kind of body deliver: candidates with their evidence, and where the nominal model is off.

``rigid`` and ``soft`` implement ``Fits``; model comparison and report know nothing else of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PHASES = ("flight", "impact", "contact", "rest")
DIRECTIONS = ("normal", "along_velocity", "along_gravity", "other")


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A fitted number: value in ``unit`` with its 95 % interval [low, high]."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class CandidateFit:
    """The nominal model with ``effects`` added, fitted.

    effects: names, as in ``sim.effects``; () for the nominal model.
    parameters: effect → parameter of its schema → estimate, as ``Effect.apply`` takes them.
    beliefs: re-fitted parameters of the nominal model (``friction``, ``restitution``, ``youngs_modulus_pa``).
    log_evidence: log marginal likelihood in nats of all fit trials (Laplace approximation over states, beliefs and
        parameters). Comparable between all candidates of one capture: same data, same noise.
    heldout_log_score: (trials,) log probability in nats of each fit trial when the parameters were fitted without it.
    heldout_rms_m: RMS distance in m between observed and predicted points on held-out data.
    heldout_chi: the same, each trial's over what noise and contacts make of its prediction, RMS of the trials: one that
        tumbled chaotically does not decide whether a model predicts better. NaN where that is not known.
    heldout_trials: what ``heldout_chi`` is the RMS of, in the order of bodies and trials; () where that is not known.
    heldout_elsewhere: of each of these, whether the body comes to lie on another face than predicted.
    bending: nats by which a missing force, beside a slow error of the recording, explains what the model leaves of
        whole trials; of single tracked points, measured for the nominal model and the re-fitted one. Else 0.
    misfit: RMS residual over what noise and numerical error would leave; 1 is explained, far above 1 means that
        something is still missing.
    limit: of a deformable body, misfit above which the right candidate leaves one in six times, by what two lattices
        leave open; NaN of a rigid one, whose limit is a constant of the comparison.
    """

    effects: tuple[str, ...]
    parameters: Mapping[str, Mapping[str, Estimate]]
    beliefs: Mapping[str, Estimate] = field(default_factory=dict)
    log_evidence: float
    heldout_log_score: Array
    heldout_rms_m: float
    misfit: float
    heldout_chi: float = math.nan
    heldout_trials: tuple[float, ...] = ()
    heldout_elsewhere: tuple[bool, ...] = ()
    bending: float = 0.0
    limit: float = math.nan


@dataclass(frozen=True, kw_only=True)
class PhaseInterval:
    """A time interval of a trial in one of ``PHASES``, from start_s to end_s of recorded time."""

    start_s: float
    end_s: float
    phase: str


@dataclass(frozen=True, kw_only=True)
class Discrepancy:
    """Localised discrepancy of the nominal model in one trial. T frames, K points.

    frame_score: (T,) m/s², missing force per mass in each frame, not the accumulated error.
    point_score: (T, K) the same at every point.
    residual: (T, K, 3) m or (T, K, 2) pixels, observed minus nominal; NaN where not seen.
    intervals: the whole trial, split into phases.
    directions: direction of the missing force as shares by ``DIRECTIONS``; they sum to 1.
    """

    frame_score: Array
    point_score: Array
    residual: Array
    intervals: tuple[PhaseInterval, ...]
    directions: Mapping[str, float]


class FittedModels(Protocol):
    """The basis of a verdict: all candidates fitted to one capture.

    nominal: the model as given. refitted: the same with its own parameters fitted. candidates: one or two effects each.
    floor_rms_m: noise floor, distance in m that noise alone leaves on held-out data.
    grain_rms_m: distance in m by which the simulator's own uncertainty, at contacts and in its steps, moves the nominal
        model's prediction of held-out data.
    """

    @property
    def nominal(self) -> CandidateFit:
        """Return the model as given."""
        ...

    @property
    def refitted(self) -> CandidateFit:
        """Return the nominal model with its own parameters fitted."""
        ...

    @property
    def candidates(self) -> tuple[CandidateFit, ...]:
        """Return the fitted candidates."""
        ...

    @property
    def floor_rms_m(self) -> float:
        """Return the noise floor in m."""
        ...

    @property
    def grain_rms_m(self) -> float:
        """Return the simulator's uncertainty in m."""
        ...


class Fits(FittedModels, Protocol):
    """The fits of one capture: what is decided from, and what the models predict."""

    def numerics_rms_m(self, fit: CandidateFit) -> float:
        """Return the distance in m by which predictions of ``fit`` change with resolution or time step."""

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """Return points (P, K, 3) in m at the ``predict_times`` of every predict trial, by its name."""

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """Return points (T, K, 3) in m at the frames of every trial, by its name, simulated from its first frames."""

    def hidden_spins(self, fit: CandidateFit) -> dict[str, Array]:
        """Return the spin (3,) in rad/s at the first frame of every trial, by its name, whose points do not show it: of
        the one body of a capture."""

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """Return the discrepancy by trial; with a ``fit`` as that candidate explains it, which is less noisy."""
