# SPDX-License-Identifier: MIT
"""The engine, started from the first frames of a take, follows motion that is known in closed form."""

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.fits import CandidateFit, Estimate
from physgen.sim.diagnose.verification_run import rotate_vectors, run_verification, starting_state
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, -9.81])
DRAG = 0.3


def fit(*effects, **parameters):
    return CandidateFit(
        effects=effects,
        parameters={
            name: {k: Estimate(value=v, unit="", low=v, high=v) for k, v in parameters.items()} for name in effects
        },
        log_evidence=0.0,
        heldout_log_score=np.zeros(1),
        heldout_rms_m=0.0,
        misfit=1.0,
    )


def flight(drag, frames=60, rate=120.0, spin=(2.0, -3.0, 1.0), lift=0.0):
    """A ball in flight under quadratic drag and lift by Runge–Kutta of fourth order: times and points of a spinning
    frame."""
    times = np.arange(frames) / rate
    rest = 0.04 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -0.6, 0.8]])

    def slope(state):
        v = state[3:]
        return np.concatenate([v, GRAVITY - drag * np.linalg.norm(v) * v + lift * np.cross(spin, v)])

    state, way = np.array([0.0, 0.0, 1.0, 3.0, 0.5, 2.0]), []
    step = 1 / rate / 20
    for _ in range(frames):
        way.append(state[:3])
        for _ in range(20):
            a = slope(state)
            b = slope(state + step / 2 * a)
            c = slope(state + step / 2 * b)
            d = slope(state + step * c)
            state = state + step / 6 * (a + 2 * b + 2 * c + d)
    turns = Rotation.from_rotvec(times[:, None] * np.array(spin)).as_matrix()
    points = np.array(way)[:, None] + np.einsum("tij,kj->tki", turns, rest)
    trial = Trial(
        name="take01", role="fit", times=times, points=points, pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64), rest_points=rest,
    )  # fmt: skip
    return trial


def ball(trial, **belief):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    fields = {"name": "ball", "mesh": "ball.obj", "density_kg_m3": 60.0, "stiffness": "hard"} | belief
    item = CaptureObject(
        belief=ObjectBelief(**fields), vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces)
    )
    return Capture(
        gravity=(0.0, 0.0, -9.81), ground=Ground(point=(0.0, 0.0, -5.0)), objects=(item,), noise_sigma=1e-4,
        camera=None, trials=(trial,),
    )  # fmt: skip


def test_the_starting_state_is_read_from_the_first_frames():
    trial = flight(0.0)
    state = starting_state(trial, trial.points)
    centre = trial.rest_points.mean(axis=0)
    # A quadratic through frames 8 ms apart leaves the cubic term of the spinning point alone: w³ r t² / 6.
    assert np.allclose(state.velocity, np.array([3.0, 0.5, 2.0]) + np.cross([2, -3, 1], centre), atol=2e-3)
    assert np.allclose(state.spin, [2, -3, 1], atol=1e-3)
    assert np.allclose(state.rotation, np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    "belief",
    [
        pytest.param({}, id="rigid"),
        pytest.param({"stiffness": "soft", "youngs_modulus_pa": 5e4}, id="soft", marks=pytest.mark.slow),
    ],
)
def test_the_engine_confirms_drag_in_flight(belief):
    # Without spin: air holds back every part of a deforming body by its own velocity, and so stops a spin.
    trial = flight(DRAG, frames=25, spin=(0.0, 0.0, 0.0))
    capture = ball(trial, **belief)
    without = flight(0.0, frames=25, spin=(0.0, 0.0, 0.0)).points
    found = fit("air_drag", drag_per_mass=DRAG)
    result = run_verification(capture, trial, fit(), found, without, trial.points, lambda: False)
    # A fifth of a second at 3.6 m/s under drag of 0.3/m: k v² t² / 2 = 8 cm at the end, 3.5 cm in the mean.
    assert result.before_rms_m > 0.02
    # Symplectic Euler with steps of 0.2 ms is off by about step / time, on a way of 2 m.
    assert result.after_rms_m < 2e-3 and result.numerics_rms_m < 2e-3 and result.word == "confirmed"
    assert result.against_model_rms_m < 2e-3


def test_a_wrong_verdict_is_not_confirmed():
    trial = flight(0.0)
    found = fit("air_drag", drag_per_mass=DRAG)
    result = run_verification(ball(trial), trial, fit(), found, trial.points, flight(DRAG).points, lambda: False)
    assert result.word == "contradicted" and result.before_rms_m < 2e-3 < result.after_rms_m


@pytest.mark.long
def test_a_spin_that_no_point_shows_is_given_to_the_engine():
    """One tracked point, as of a ball: without its spin the engine has no lift, and would contradict a true verdict."""

    def centre(trial):
        middle = trial.points[:, [0, 3]].mean(axis=1, keepdims=True)
        return dataclasses.replace(
            trial, points=middle, object_index=np.zeros(1, dtype=np.int64), rest_points=np.zeros((1, 3))
        )

    spin, lift = (40.0, -60.0, 20.0), 0.02
    trial, without = centre(flight(0.0, spin=spin, lift=lift)), centre(flight(0.0)).points
    found = fit("magnus", lift_per_mass=lift)
    told = [
        run_verification(ball(trial), trial, fit(), found, without, trial.points, lambda: False, verdict_spin=given)
        for given in (np.array(spin), None)
    ]
    # A lift of 0.02 · 75 · 4 = 6 m/s² across half a second: 0.7 m at the end.
    assert told[0].word == "confirmed" and told[0].after_rms_m < 5e-3 and told[0].before_rms_m > 0.2
    assert told[1].after_rms_m > 0.2


@pytest.mark.long
def test_a_fast_clock_is_given_to_the_engine():
    real = flight(DRAG * 0, frames=60)
    recorded = dataclasses.replace(real, times=real.times / 1.1)
    found = fit("time_scale", rate=1.1)
    nominal = flight(0.0, rate=120.0 * 1.1).points
    result = run_verification(ball(recorded), recorded, fit(), found, nominal, recorded.points, lambda: False)
    assert result.word == "confirmed" and result.after_rms_m < 2e-3


def test_only_vectors_are_turned():
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    values = rotate_vectors(
        {"axis_x": 1.0, "axis_y": 0.0, "axis_z": 0.0, "fibre_modulus": 5.0, "offset_x": 2.0}, quarter
    )
    assert values["fibre_modulus"] == 5.0 and values["offset_x"] == 2.0
    assert np.allclose([values[f"axis_{a}"] for a in "xyz"], [0, 1, 0])
