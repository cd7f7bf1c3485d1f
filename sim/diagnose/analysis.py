# SPDX-License-Identifier: MIT
"""What the fits of one kind of body hand over to the verdict: every candidate, and what follows from each.

``rigid`` and ``soft`` implement ``Fits``; ``evidence`` and ``diagnosis`` know nothing else of them.
"""

from __future__ import annotations

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
    """A fitted number: value in ``unit`` with its 95 % interval from low to high."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class CandidateFit:
    """The nominal model with ``effects`` added, fitted.

    effects: names, as in ``sim.effects``; () for the nominal model itself.
    parameters: effect → parameter of that effect's schema → estimate. These numbers go to ``Effect.apply`` as they are.
    beliefs: what the nominal model has anyway (``friction``, ``restitution``, ``youngs_modulus_pa``), where refitted.
    log_evidence: log probability in nats of all fit takes given this candidate, with states, beliefs and parameters
        integrated out (Laplace) and the freedom of its parameters thereby paid for. Comparable between all candidates
        of one capture: the same data, the same noise.
    heldout_log_score: (takes,) log probability in nats of each fit take when the parameters were fitted without it.
    heldout_rms_m: root mean square distance in m between observed and predicted points on data that no fit saw.
    misfit: root mean square of the residual of the fit over what noise and the model's own grain would leave; 1 is
        explained, far above 1 means that something is missing still.
    """

    effects: tuple[str, ...]
    parameters: Mapping[str, Mapping[str, Estimate]]
    beliefs: Mapping[str, Estimate] = field(default_factory=dict)
    log_evidence: float
    heldout_log_score: Array
    heldout_rms_m: float
    misfit: float


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A stretch of a take in one of ``PHASES``, from start_s to end_s in the recording's time."""

    start_s: float
    end_s: float
    phase: str


@dataclass(frozen=True, kw_only=True)
class Discrepancy:
    """Where the nominal model lacks something in one take. T frames, K points.

    frame_score: (T,) m/s², force per mass that it lacks there, not the error accumulated so far.
    point_score: (T, K) the same at every point.
    residual: (T, K, 3) m, or (T, K, 2) pixels: observed minus nominal; NaN where not seen.
    intervals: the whole take, cut into phases.
    directions: shares by ``DIRECTIONS``, together 1: how the lacking force points.
    """

    frame_score: Array
    point_score: Array
    residual: Array
    intervals: tuple[Interval, ...]
    directions: Mapping[str, float]


class Fits(Protocol):
    """All candidates fitted to one capture.

    nominal: the model as believed. refitted: the same with its own parameters fitted. candidates: one or two effects.
    floor_rms_m: distance in m that noise alone leaves on data that no fit saw.
    numerics_rms_m: how far the nominal model's prediction moves when its resolution or time step is changed.
    """

    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    numerics_rms_m: float

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """Points (P, K, 3) in m at the ``predict_times`` of every predict trial, by its name."""

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """Points (T, K, 3) in m at the frames of every trial, by its name, started from its first frames."""

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """By trial. With a ``fit``: as that candidate explains it, which has less noise than the raw measurement."""
