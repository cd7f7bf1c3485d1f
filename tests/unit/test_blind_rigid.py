# SPDX-License-Identifier: MIT
"""The rigid generator against closed forms."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("mujoco")

from physgen.blind_check.case import Lens, draw_camera, project
from physgen.blind_check.mujoco_world import (
    STEP_S,
    Body,
    RigidWorld,
    State,
    bounce_of_damping,
    damping_of_bounce,
    simulate_rigid,
)
from physgen.blind_check.rigid_cases import SEARCH_STEP_S, rigid_case
from physgen.blind_check.rigid_causes import KNOWN_CAUSES
from physgen.sim.diagnose.capture_folder import load_capture, save_capture

BALL = Body(shape="sphere", half=(0.04, 0.04, 0.04), density=400.0)
CUBE = Body(shape="cube", half=(0.04, 0.04, 0.04), density=400.0)
TIMES = np.arange(60) / 100
_PLAIN = Lens()


def _state(z, velocity=(0, 0, 0), spin=(0, 0, 0)):
    return State(
        position=np.array([0.0, 0.0, z]),
        quaternion=np.array([1.0, 0, 0, 0]),
        velocity=np.array(velocity, dtype=float),
        spin=np.array(spin, dtype=float),
    )


def _world(body=BALL, **changes):
    return RigidWorld(body=body, **{"friction": 0.3, "restitution": 0.5, **changes})


def test_free_flight_is_a_parabola_to_a_micrometre():
    motion = simulate_rigid(_world(), _state(5.0, (1, 2, 3), (4, 5, 6)), TIMES)
    fallen = 5 + 3 * TIMES - 4.905 * TIMES**2
    exact = np.column_stack([TIMES, 2 * TIMES, fallen])
    assert np.abs(motion.position - exact).max() < 1e-6
    assert not motion.touched.any()


@pytest.mark.parametrize("step", [STEP_S, SEARCH_STEP_S])
@pytest.mark.parametrize("restitution", [0.25, 0.5, 0.75])
def test_a_ball_bounces_to_e_squared_of_its_height(restitution, step):
    times = np.linspace(0, 0.6, 601)
    motion = simulate_rigid(_world(restitution=restitution), _state(0.54), times, step=step)
    height = motion.position[:, 2] - 0.04
    first = int(np.argmin(height[:400]))
    assert np.sqrt(height[first:].max() / 0.5) == pytest.approx(restitution, abs=0.03)
    assert motion.struck[first - 3 : first + 4].any() and not motion.struck[: first - 5].any()


def test_damping_and_bounce_are_inverse_and_a_free_spring_loses_nothing():
    assert bounce_of_damping(1e-6) == pytest.approx(1.0, abs=1e-4)
    for restitution in (0.2, 0.4, 0.9):
        assert bounce_of_damping(damping_of_bounce(restitution)) == pytest.approx(restitution, abs=1e-9)


def test_a_sliding_cube_is_braked_by_mu_g():
    times = np.arange(40) / 100
    motion = simulate_rigid(_world(CUBE), _state(0.04, (1.5, 0, 0)), times)
    exact = 1.5 * times - 0.5 * 0.3 * 9.81 * times**2
    assert np.abs(motion.position[:, 0] - exact).max() < 0.02 * exact[-1]
    # It rattles on its edges, so not each single frame has a contact.
    assert motion.slid.mean() > 0.3


def test_a_rolling_ball_keeps_rolling_unless_something_resists():
    start = _state(0.04, (1, 0, 0), (0, 25, 0))
    plain = simulate_rigid(_world(), start, TIMES).position[:, 0]
    held = simulate_rigid(_world(rolling=0.02 * 0.04), start, TIMES).position[:, 0]
    assert np.abs(plain - TIMES).max() < 1e-3
    # The torque -b N brakes the rolling ball by b g R / (R² + k²), k² = 2 R² / 5.
    lost = TIMES[-1] - held[-1]
    assert lost == pytest.approx(0.5 * 0.02 * 9.81 * 5 / 7 * TIMES[-1] ** 2, rel=0.05)


def test_the_ground_turns_a_ball_until_it_rolls_and_a_cube_until_it_rests():
    """Another inertia acts there, and neither in flight nor where a ball rolls on."""
    times = np.arange(40) / 100
    ball = simulate_rigid(_world(), _state(0.04, (1, 0, 0)), times)
    rolls = 2 * 1.0 / (7 * 0.3 * 9.81)
    # It is pressed down anew a few times, so not each single frame has a contact.
    assert ball.turned[:10].mean() > 0.5 and not ball.turned[times > rolls + 0.02].any() and ball.touched[20:].all()
    assert not simulate_rigid(_world(), _state(5.0, (1, 2, 3), (4, 5, 6)), times).turned.any()
    lying = simulate_rigid(_world(CUBE), _state(0.04), times)
    assert lying.touched.all() and not lying.turned[5:].any()


def test_adhesion_takes_its_work_from_the_bounce():
    times, pull, reach = np.linspace(0, 0.5, 501), 30.0, 0.005
    free, held = (
        simulate_rigid(_world(adhesion=a), _state(0.54), times).position[:, 2] - 0.04 for a in (None, (pull, reach))
    )
    low = int(np.argmin(free[:400]))
    # Work per mass: pull times half the reach, and as much as gravity does over the height that is lost.
    assert free[low:].max() - held[low:].max() == pytest.approx(pull * reach / 2 / 9.81, rel=0.25)


def test_a_pellet_keeps_the_loaded_centre_on_the_parabola():
    fraction, at = 0.5, (0.03, 0.0, 0.0)
    motion = simulate_rigid(_world(pellet=(fraction, at)), _state(5.0, spin=(0, 0, 10)), TIMES)
    centre = motion.position + motion.rotation @ (np.array(at) * fraction / (1 + fraction))
    speed = 10 * 0.03 * fraction / (1 + fraction)
    exact = np.column_stack([0.01 + 0 * TIMES, speed * TIMES, 5 - 4.905 * TIMES**2])
    assert np.abs(centre - exact).max() < 1e-4


@pytest.mark.parametrize("name", sorted(set(KNOWN_CAUSES) - {"camera_pose", "time_scale"}))
def test_every_cause_changes_the_motion_and_more_with_its_strength(name):
    rng = np.random.default_rng(3)
    world = _world(BALL)
    cause = KNOWN_CAUSES[name](world, rng)
    starts = {"roll": _state(0.04, (1, 0, 0), (0, 25, 0)), "slide": _state(0.04, (1.5, 0, 0))}
    state = starts.get(cause.styles[0], _state(0.3, (1, 0.5, 0.5), (3, 4, 15)))
    plain = simulate_rigid(world, state, TIMES).points(np.eye(3) * 0.04)
    sizes = []
    for strength in (cause.low, cause.low * 3):
        moved = simulate_rigid(cause.change(strength, world), state, TIMES).points(np.eye(3) * 0.04)
        sizes.append(np.linalg.norm(moved - plain, axis=2).mean())
    assert 1e-6 < sizes[0] < sizes[1]


def test_a_case_can_be_written_and_read_and_its_truth_fits_the_noise(tmp_path):
    case = rigid_case(("gravity_tilt",), np.random.default_rng(3))
    save_capture(case.capture, tmp_path / "c")
    capture = load_capture(tmp_path / "c")
    assert case.truth.effect == "gravity_tilt" and case.truth.effect_rms_over_noise >= 8
    for trial in capture.trials:
        true = case.truth.trials[trial.name]
        if trial.points is not None:
            noise = np.nanstd(trial.points - true.points)
        else:
            noise = np.nanstd(trial.observed - project(true.points, capture.camera, _PLAIN))
        assert noise == pytest.approx(capture.noise_sigma, rel=0.15)
        assert 0.01 < np.isnan(trial.observed).mean() < 0.75
        if trial.role == "predict":
            assert len(trial.predict_times) == len(true.withheld)
            assert trial.predict_times[0] > trial.times[-1]


def test_a_camera_sees_what_it_looks_at_in_its_middle():
    target = np.array([0.1, -0.2, 0.3])
    camera = draw_camera(target, 2.0, np.random.default_rng(0))
    above = project(np.stack([target, target + np.array([0, 0, 0.1])]), camera, _PLAIN)
    assert above[0] == pytest.approx([640, 360], abs=1e-6)
    assert above[1, 1] < 360


def test_none_is_believed_as_it_is():
    case = rigid_case((), np.random.default_rng(8))
    assert case.truth.effect == "none" and case.truth.effects == ()
    assert not any(t.active.any() for t in case.truth.trials.values())
    assert dataclasses.asdict(case.truth)["effect_rms_over_noise"] == 0.0
