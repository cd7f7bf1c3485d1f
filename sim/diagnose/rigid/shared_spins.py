# SPDX-License-Identifier: MIT
"""Spins that no point shows: how large they are along and across the path is learned from the other takes.

A path tells the spin across it, which bends it, at once, but the spin along it only once its direction has changed: a
few first frames leave that open, and it decides where the rest goes. What throws or strikes a ball does so alike in all
takes of a recording. Empirical Bayes: the two variances are those under which the other takes are likeliest
(expectation–maximisation, with a linear path about each take's fit), and a take itself has no part in its own."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .multiple_shooting import Fit
from .observed_poses import SPIN, VELOCITY
from .state_tracking import fit_states

Array = NDArray[np.float64]

LEAST_TAKES = 3
"""Other takes from which a variance is learned: that of one more draw, with n of them, is n / (n - 2) times theirs."""

ROUNDS = 200
"""Steps of the expectation–maximisation; more change nothing visible."""

LEAST = 0.02
"""Least standard deviation over that of the first prior."""


def share_spins(fit: Fit) -> Fit:
    """Return ``fit`` with every take's hidden spin near those of the others, its numbers and evidence unchanged.

    Unchanged where some trial shows its spin, or fewer than ``LEAST_TAKES`` complete ones are left.
    """
    trials = fit.problem.trials
    if not all(t.observations.hides_spin for t in trials):
        return fit
    parts = fit.problem.evaluate(fit.model, fit.z, fit.states, fixed=True).linear
    frames = [_along(states[0, VELOCITY]) for states in fit.states]
    known = {}
    for i, (trial, part, axes) in enumerate(zip(trials, parts, frames, strict=True)):
        if trial.observations.trial.role == "fit":
            whole = np.linalg.inv(np.linalg.inv(part.hessian)[9:12, 9:12])
            own = axes.T @ (whole - np.diag(trial.prior[9:12] ** -2.0)) @ axes
            known[i] = own, axes.T @ whole @ (fit.states[i][0, SPIN] - trial.guess[SPIN])
    shared = []
    for i, (trial, axes) in enumerate(zip(trials, frames, strict=True)):
        others = [both for k, both in known.items() if k != i]
        if len(others) >= LEAST_TAKES:
            sizes = likeliest_variances(others, float(trial.prior[9]) ** 2) * len(others) / (len(others) - 2)
            trial = dataclasses.replace(trial, spin_cover=axes * sizes @ axes.T)
        shared.append(trial)
    problem = dataclasses.replace(fit.problem, trials=shared)
    states = fit_states(problem, fit.model, fit.z, fit.states, 6)
    return dataclasses.replace(
        fit, problem=problem, states=states, evaluation=problem.evaluate(fit.model, fit.z, states)
    )


def likeliest_variances(takes: list[tuple[Array, Array]], first: float) -> Array:
    """Return variances (3,) of a normal spin about 0, the second and third equal, under which ``takes`` are likeliest.

    takes: information (3, 3) on each one's spin, along its path first, and that times its likeliest spin (3,). first:
    the variance to start from.
    """
    sizes = np.full(3, first)
    for _ in range(ROUNDS):
        squares = np.zeros(3)
        for own, pull in takes:
            cover = np.linalg.inv(own + np.diag(1.0 / sizes))
            squares += (cover @ pull) ** 2 + np.diag(cover)
        squares[1:] = squares[1:].mean()
        sizes = np.maximum(squares / len(takes), LEAST**2 * first)
    return sizes


def _along(velocity: Array) -> Array:
    """Return axes (3, 3), columns, the first along ``velocity`` (3,)."""
    return np.linalg.qr(np.column_stack([velocity + 1e-12, np.eye(3)]))[0]
