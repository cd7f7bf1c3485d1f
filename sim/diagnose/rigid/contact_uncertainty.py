# SPDX-License-Identifier: MIT
"""How far a contact model can be trusted, and what that makes of the observations after each contact.

Two simulators with the same coefficients differ by a share of the impulse exchanged, because they resolve a contact of
a few milliseconds in different steps; a face or an edge that lands flat differs by more than a sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .observed_poses import PUSHED, QUATERNION, RUBBED, TOUCHED
from .rigid_simulator import RigidBody
from .segment_paths import Model
from .shooting_problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ContactUncertainty:
    """Standard deviations. blow: relative, of an impact's impulse; tangential: relative, of friction's; late: s, of the
    duration of an impact; these depend on the body's shape. floor_speed: m/s, floor_shift: m, of every contact."""

    blow: float
    tangential: float
    late: float
    floor_speed: float = 1.5e-3
    floor_shift: float = 5e-5


ROUND = ContactUncertainty(blow=0.006, tangential=0.02, late=2.5e-4)
CORNERED = ContactUncertainty(blow=0.03, tangential=0.04, late=3e-4)


def contact_uncertainty(body: RigidBody) -> ContactUncertainty:
    """Return the contact uncertainty for the body's shape."""
    return ROUND if body.round else CORNERED


def contact_spread(
    uncertainty: ContactUncertainty, body: RigidBody, record: Array, weight: float
) -> tuple[Array, Array]:
    """Return standard deviations of speed (F,) m/s and position (F,) m from the contacts in ``record`` (F, 17).

    weight: nominal gravity normal to the ground, m/s², whose impulse on a resting body is no impact.
    """
    touched = record[:, TOUCHED]
    blow = np.maximum(record[:, PUSHED] - weight * touched, 0.0)
    speed = np.hypot(uncertainty.blow * blow, uncertainty.tangential * record[:, RUBBED])
    speed = np.hypot(speed, uncertainty.floor_speed * (touched > 0))
    place = np.hypot(uncertainty.late * blow, uncertainty.floor_shift * (touched > 0))
    return speed, place


def segment_covariance(
    uncertainty: ContactUncertainty, body: RigidBody, record: Array, times: Array, weight: float
) -> Array:
    """Return the covariance (12, 12) of the state at the end of a segment: ``record`` (F, 17) at ``times`` (F,) s."""
    speed, place = contact_spread(uncertainty, body, record, weight)
    # An error made during the segment keeps moving the body.
    made = np.diff(np.concatenate([[0.0], speed**2]))
    since = times[-1] - np.concatenate([[times[0]], times[:-1]])
    moved = np.sqrt(np.sum(np.maximum(made, 0.0) * since**2) / 3) + place[-1] + 2e-5
    size = body.bound
    turn = 1.0 if body.round else 1.5
    spin = turn * speed[-1] / size + 1e-3
    deviations = np.repeat([moved, moved * turn / size + 1e-4, speed[-1] + 2e-4, spin], 3)
    return np.diag(deviations**2)


def frame_weights(
    uncertainty: ContactUncertainty, body: RigidBody, record: Array, times: Array, weight: float, info: Array
) -> Array:
    """Return the weights (F,) of a segment's frames. info: (F, 6, 6) on the pose, reduced by contact uncertainty."""
    speed, place = contact_spread(uncertainty, body, record, weight)
    made = np.maximum(np.diff(np.concatenate([[0.0], speed**2])), 0.0)
    before = np.concatenate([[times[0]], times[:-1]])
    since = np.maximum(times[:, None] - before[None], 0.0)
    moved = np.sqrt(np.sum(made[None] * since**2, axis=1) / 3) + place
    after = np.cumsum(moved > 0)
    # The same error affects all later frames, which limits their combined information.
    known = np.trace(info[:, :3, :3], axis1=1, axis2=2) / 3
    together = np.cumsum(np.where(moved > 0, known, 0.0))
    total = together[-1] if after[-1] else 0.0
    return np.where(moved > 0, 1.0 / (1.0 + total * moved**2), 1.0)


def weight_contacts(problem: Problem, model: Model, z: Array) -> None:
    """Set covariances and weights of every segment of ``problem`` from the contacts in a run of ``model``."""
    scene = problem.scene
    uncertainty = contact_uncertainty(scene.body)
    weight = float(np.linalg.norm(scene.capture.gravity))
    states = [t.states for t in problem.trials]
    look = problem.evaluate(model, z, states, slopes=False)
    for trial in problem.trials:
        trial.covers, trial.weights = [], []
    for segment in look.segments:
        trial = problem.trials[segment.trial]
        a, b = trial.spans[segment.index]
        record = np.concatenate([segment.record, segment.arrival[None]]) if b < trial.end else segment.record
        times = trial.observations.times[a : a + len(record)]
        trial.covers.append(segment_covariance(uncertainty, scene.body, record, times, weight))
        _, _, info = trial.observations.information(
            segment.record[:, :3], segment.record[:, QUATERNION], segment.frames
        )
        count = len(segment.frames)
        trial.weights.append(frame_weights(uncertainty, scene.body, segment.record, times[:count], weight, info))
