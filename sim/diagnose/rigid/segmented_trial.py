# SPDX-License-Identifier: MIT
"""Trials as chains of segments between nodes, and what the evaluation of a model at given states says of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .observed_poses import ObservedBody

Array = NDArray[np.float64]


@dataclass(kw_only=True, eq=False)
class SegmentedTrial:
    """A body in a trial, split at nodes. nodes: (N,) frames, rising. states: (N, 13). end: frame after the last used.

    prior: (12,) standard deviation of the initial guess of the first state. spin_cover: (3, 3) covariance of its spin
    in its place, where other takes tell it. Per segment: covers, (12, 12) covariance of the defect at its end; weights,
    (F,) of its frames.
    """

    observations: ObservedBody
    nodes: list[int]
    states: Array
    end: int
    guess: Array
    prior: Array
    covers: list[Array] = field(default_factory=list)
    weights: list[Array] = field(default_factory=list)
    spin_cover: Array | None = None

    @property
    def spans(self) -> list[tuple[int, int]]:
        """Return first and last frame of every segment."""
        return list(zip(self.nodes, [*self.nodes[1:], self.end], strict=True))


@dataclass(kw_only=True, eq=False)
class Segment:
    """Simulation of one segment. frames: (F,). record: (F, 17), unperturbed; arrival: (17,), at the next node.

    turn: (F, 6, 12 + B), come: (12, 12 + B): Jacobians of poses and arrival with respect to start and beliefs.
    """

    trial: int
    index: int
    frames: NDArray[np.int64]
    record: Array
    arrival: Array
    chi2: Array
    defect: Array | None
    turn: Array | None = None
    come: Array | None = None


@dataclass(kw_only=True, eq=False)
class NormalEquations:
    """Normal equations of one trial: Hessian of states and numbers (12 N + P), negative gradient."""

    hessian: Array
    slope: Array
    cost: float

    def add(self, own: slice, tail: slice, hessian: Array, slope: Array, following: slice | None = None) -> None:
        """Add equations of the state at ``own``, the numbers at ``tail`` and the next state at ``following``."""
        end = 12 + len(self.slope) - tail.start
        places = [(own, slice(0, 12)), (tail, slice(12, end))]
        if following is not None:
            places.append((following, slice(end, end + 12)))
        for row, rows in places:
            self.slope[row] += slope[rows]
            for column, columns in places:
                self.hessian[row, column] += hessian[rows, columns]


@dataclass(kw_only=True, eq=False)
class Evaluation:
    """Evaluation of one model at given states and numbers."""

    segments: list[Segment]
    linear: list[NormalEquations]
    cost: float
