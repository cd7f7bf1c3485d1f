# SPDX-License-Identifier: MIT
"""The worlds of one rigid body: flights, bounces, sliding and rolling against closed forms; small captures fitted."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.rigid import fit_rigid
from physgen.sim.diagnose.rigid.observed_poses import (
    another_side_up,
    observe_body,
    perturbed,
    state_difference,
    turns_on_a_face,
)
from physgen.sim.diagnose.rigid.quaternions import as_matrix, from_rotvec, multiply
from physgen.sim.diagnose.rigid.rigid_candidates import CANDIDATE_EFFECTS
from physgen.sim.diagnose.rigid.rigid_fits import REFITS, shown_keys
from physgen.sim.diagnose.rigid.rigid_localisation import _directions
from physgen.sim.diagnose.rigid.rigid_simulator import SLOTS, RigidWorlds, rigid_body
from physgen.sim.diagnose.rigid.start_numbers import MissingForces, tether_start
from physgen.sim.diagnose.rigid.world_settings import BodyScene
from physgen.sim.effects.registry import effect

RADIUS = 0.04


def item(mesh, density=500.0):
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=density, stiffness="hard")
    return CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))


def sphere():
    return item(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS))


def box(size=(0.1, 0.1, 0.1)):
    return item(trimesh.creation.box(size))


def scene_of(thing, trials=(), friction=0.3, restitution=0.5, sigma=1e-4):
    ground = Ground(friction=friction, restitution=restitution)
    capture = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=ground,
        objects=(thing,),
        noise_sigma=sigma,
        camera=None,
        trials=tuple(trials),
    )
    return BodyScene(capture=capture, body=rigid_body(thing), middle=np.zeros(3))


def run(scene, state, times, **changes):
    import dataclasses

    numbers = scene.numbers([dataclasses.replace(scene.base, **changes)])
    return RigidWorlds(body=scene.body, threads=1).run(np.atleast_2d(state), numbers, [np.asarray(times)])[0]


def state(place, velocity=(0, 0, 0), spin=(0, 0, 0)):
    return np.array([*place, 1, 0, 0, 0, *velocity, *spin], dtype=float)


@pytest.mark.parametrize("inset", [0.0, 0.3])
def test_friction_under_a_face_stops_a_turn_by_the_lever_at_which_it_acts(inset):
    scene = scene_of(box((0.06, 0.06, 0.06)), friction=0.2)
    times = np.linspace(0.0, 0.06, 4)
    record = run(scene, state((0, 0, 0.03), spin=(0, 0, 12)), times, inset=inset)
    lever, inertia = 0.06 / np.sqrt(2) * (1 - inset), 0.06**2 / 6
    assert 12 - record[:, 12] == pytest.approx(0.2 * 9.81 * lever / inertia * times, rel=0.03, abs=0.05)
    # What slides without turning is slowed down alike.
    slid = run(scene, state((0, 0, 0.03), velocity=(0.5, 0, 0)), times, inset=inset)
    assert slid[-1, 7] == pytest.approx(0.5 - 0.2 * 9.81 * times[-1], abs=0.01)


@pytest.mark.parametrize(("rate", "rise", "found"), [(8.0, 0.0, True), (0.5, 0.0, False), (8.0, 0.2, False)])
def test_a_body_that_slides_and_turns_on_a_face_is_told_from_others(rate, rise, found):
    times = np.linspace(0.0, 0.3, 30)
    c, s, zero = np.cos(rate * times), np.sin(rate * times), 0 * times
    turns = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1).reshape(-1, 3, 3)
    rest = np.array([[0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0, 0, 0.03]])
    points = np.einsum("tij,kj->tki", turns, rest) + np.stack([0.4 * times, zero, 0.03 + rise * times], axis=1)[:, None]
    trial = Trial(
        name="slide", role="fit", times=times, points=points, pixels=None,
        object_index=np.zeros(4, dtype=np.int64), rest_points=rest,
    )  # fmt: skip
    scene = scene_of(box((0.06, 0.06, 0.06)), trials=(trial,))
    seen = [observe_body(scene.capture, trial, 0, scene.body.center)]
    assert turns_on_a_face(seen, np.array([0.0, 0.0, 1.0]), scene.body.bound) is found


@pytest.mark.parametrize(
    ("spin", "turn", "found"),
    [(0.0, 0.3, False), (2.0, 0.3, False), (3.0, 0.0, False), (1.0, 0.9, True), (0.0, 1.6, True), (0.5, 3.1, True)],
)
def test_a_body_lies_on_another_face_where_another_side_is_up(spin, turn, found):
    """Turned about the upright it lies on the same one, tipped by more than half a right angle it does not."""
    up, lies = np.array([0.0, 0.6, 0.8]), from_rotvec(np.array([0.4, -1.1, 0.7]))
    tipped = multiply(from_rotvec(turn * np.array([1.0, 0.0, 0.0])), lies)
    assert another_side_up(lies, multiply(from_rotvec(spin * up), tipped), up) is found


def test_a_cube_that_tumbles_as_predicted_lies_nowhere_else():
    """It turns by three right angles in all: the sides that are up are compared at the same instant."""
    rng = np.random.default_rng(1)
    times, trials, rest = np.arange(0, 0.4, 0.02), [], 0.03 * np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, -1]])
    for n in range(2):
        turns = as_matrix(from_rotvec(np.outer(times, [12.0, 2.0 * n, 1.0])))
        path = np.outer(times, [1.0, 0.5 * n, 2.0]) - np.outer(times**2, [0, 0, 4.905]) + [0, 0, 1.0]
        points = path[:, None] + np.einsum("tij,kj->tki", turns, rest)
        trials.append(
            Trial(
                name=f"take{n}",
                role="fit",
                times=times,
                points=points + 2e-4 * rng.normal(size=points.shape),
                pixels=None,
                object_index=np.zeros(len(rest), dtype=np.int64),
                rest_points=rest,
            )
        )
    found = fit_rigid(scene_of(box((0.06, 0.06, 0.06)), trials, sigma=2e-4).capture, ["buoyancy"]).nominal
    assert found.heldout_elsewhere == (False, False) and max(found.heldout_trials) < 3.0


def test_an_icosphere_is_a_sphere_and_a_cube_is_not():
    ball, cube = rigid_body(sphere()), rigid_body(box())
    assert ball.round and ball.radius == pytest.approx(RADIUS, rel=1e-3)
    assert not cube.round and len(cube.corners) == 8
    assert cube.inertia == pytest.approx(0.1**2 / 6 * np.eye(3), abs=1e-9)


@pytest.mark.parametrize("height", [0.5, 1.0, 1.4, 2.0])
def test_a_cylinder_of_many_corners_is_no_sphere(height):
    """All its corners lie on one."""
    made = trimesh.creation.cylinder(radius=RADIUS, height=height * RADIUS, sections=64)
    assert not rigid_body(item(made)).round


@pytest.mark.parametrize("count", [(6, 8), (8, 16), (32, 32)])
def test_a_coarse_sphere_of_rings_is_a_sphere(count):
    assert rigid_body(item(trimesh.creation.uv_sphere(radius=RADIUS, count=count))).round


@settings(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-8, 8)] * 3))
def test_free_flight_is_the_parabola(velocity, spin):
    t = np.array([0.05, 0.13, 0.3])
    found = run(scene_of(box()), state((0, 0, 50), velocity, spin), t)
    expected = np.array([0, 0, 50]) + np.outer(t, velocity) + 0.5 * np.outer(t**2, (0, 0, -9.81))
    assert found[:, :3] == pytest.approx(expected, abs=1e-9)
    assert found[:, 10:13] == pytest.approx(np.tile(spin, (3, 1)), abs=1e-9)


def test_a_spinning_brick_keeps_energy_and_angular_momentum():
    scene = scene_of(box((0.06, 0.1, 0.2)))
    found = run(scene, state((0, 0, 50), (0, 0, 0), (0.1, 9.0, 0.1)), np.linspace(0.05, 1.0, 20))
    turn = as_matrix(found[:, 3:7])
    inertia = turn @ scene.body.inertia @ turn.swapaxes(1, 2)
    momentum = np.einsum("tij,tj->ti", inertia, found[:, 10:13])
    energy = 0.5 * np.sum(momentum * found[:, 10:13], axis=1)
    assert momentum == pytest.approx(np.tile(momentum[0], (20, 1)), rel=1e-9, abs=1e-12)
    assert energy == pytest.approx(np.full(20, energy[0]), rel=2e-3)


def test_drag_slows_as_in_closed_form():
    k, v, t = 0.2, 3.0, np.array([0.5])
    found = run(scene_of(sphere()), state((0, 0, 50), (v, 0, 0)), t, gravity=np.zeros(3), drag=k)
    assert found[0, 0] == pytest.approx(np.log1p(k * v * t[0]) / k, abs=1e-7)


@settings(max_examples=12, deadline=None)
@given(st.floats(0.15, 0.95), st.floats(0.5, 4.0))
def test_a_ball_leaves_with_its_restitution(restitution, speed):
    found = run(
        scene_of(sphere()),
        state((0, 0, RADIUS + 0.01), (0, 0, -speed)),
        [0.1],
        gravity=np.zeros(3),
        restitution=restitution,
    )
    # The fitted bodies' dashpots are 2 % weak, and a bounce of 20 steps is resolved to about a percent.
    assert found[0, 9] / speed == pytest.approx(restitution, abs=0.035)


@pytest.mark.parametrize("rub", [0.1, 0.3])
def test_an_impact_keeps_sliding_as_its_grip_says(rub):
    """Where friction would suffice, the sliding left at the contact is exp(-rate t) after the contact's time t."""
    scene, restitution = scene_of(sphere(), friction=5.0), 0.9
    start = state((0, 0, RADIUS + 0.01), (1, 0, -2))
    found = run(scene, start, [0.1], gravity=np.zeros(3), restitution=restitution, rub=rub)[0]
    left = found[7] - found[11] * RADIUS
    # A nearly elastic contact lasts about half a period of its spring, in which the rate acts for rub times pi.
    assert left == pytest.approx(np.exp(-rub * np.pi), abs=0.05)


def test_a_sliding_cube_stops_after_v2_over_2_mu_g():
    mu, speed = 0.3, 1.0
    found = run(scene_of(box()), state((0, 0, 0.05), (speed, 0, 0)), [0.1, 1.0], friction=mu)
    assert found[0, 7] == pytest.approx(speed - mu * 9.81 * 0.1, rel=0.02)
    assert found[1, 0] == pytest.approx(speed**2 / (2 * mu * 9.81), rel=0.03)
    assert np.abs(found[1, 7:13]).max() < 0.01


@pytest.mark.parametrize("corners", [8, 16, 24, 32, 48])
def test_a_sliding_cylinder_stops_there_however_finely_its_rim_is_drawn(corners):
    scene = scene_of(item(trimesh.creation.cylinder(radius=0.025, height=0.05, sections=corners)), friction=0.2)
    path = run(scene, state((0, 0, 0.025), velocity=(1.0, 0, 0)), [0.1, 0.2, 0.4, 0.7])
    assert path[-1, 0] == pytest.approx(1.0 / (2 * 0.2 * 9.81), rel=0.01)
    # Six points carry it: on the first six of the rim it would tip by 0.6 to 10 degrees.
    assert np.abs(path[:, 4:7]).max() < np.radians(0.05) / 2


def test_a_sliding_ball_ends_up_rolling_at_five_sevenths():
    found = run(scene_of(sphere()), state((0, 0, RADIUS), (1, 0, 0)), [0.6], friction=0.4)
    assert found[0, 7] == pytest.approx(5 / 7, rel=0.01)
    assert found[0, 11] == pytest.approx(5 / 7 / RADIUS, rel=0.01)


@pytest.mark.parametrize("z", [-2.0, 2.0])
def test_inertia_acts_in_contact_and_not_in_flight(z):
    freedom, ball, brick = CANDIDATE_EFFECTS["inertia"], scene_of(sphere()), scene_of(box((0.06, 0.1, 0.2)))
    setting = freedom.change(ball, ball.base, np.array([z]))
    factor = freedom.values(ball, setting, np.array([z]))["factor"]
    # What slides without spin ends up rolling at 1 / (1 + J / m r²) of its speed.
    found = run(ball, state((0, 0, RADIUS), (1, 0, 0)), [0.6], friction=0.4, inertia=factor)
    assert factor == pytest.approx(np.exp(0.25 * z)) and found[0, 7] == pytest.approx(1 / (1 + 0.4 * factor), rel=0.01)
    thrown = state((0, 0, 50), (1, 0, 2), (0.1, 9.0, 0.1))
    flown = [run(brick, thrown, [0.2, 0.5], inertia=k) for k in (1.0, factor)]
    assert flown[1][:, :13] == pytest.approx(flown[0][:, :13], abs=1e-9)


def test_rolling_resistance_takes_five_sevenths_b_g_over_r():
    lever, radius = 0.002, RADIUS
    start = state((0, 0, radius), (1, 0, 0), (0, 1 / radius, 0))
    found = run(scene_of(sphere()), start, [0.5], friction=0.8, rolling=lever)
    assert found[0, 7] == pytest.approx(1 - 5 / 7 * lever * 9.81 / radius * 0.5, rel=0.01)


def test_adhesion_holds_what_would_leave_slowly():
    held = run(scene_of(sphere()), state((0, 0, RADIUS + 0.02), (0, 0, -0.3)), [0.4], pull=40.0, reach=0.005)
    assert _top(0.0) > _top(40.0) + 0.005
    assert held[0, 2] < RADIUS + 0.002


def _top(pull):
    times = np.linspace(0.01, 0.5, 100)
    found = run(scene_of(sphere()), state((0, 0, RADIUS + 0.05)), times, pull=pull, reach=0.005)
    return found[found[:, 15] > 0][:, 2].max() - RADIUS


def test_adhesion_matters_where_a_body_leaves_and_hardly_where_it_rests():
    """A resting body's jitter was as much of a separation as a bounce."""
    from scipy.spatial.transform import Rotation

    rng, times, pull, reach = np.random.default_rng(6), np.arange(0, 0.7, 1 / 480), 60.0, 0.004
    rest = RADIUS * Rotation.random(12, random_state=0).as_matrix()[:, :, 0]
    trials, paths = [], []
    for n, height in enumerate((0.05, 0.08, 0.11)):
        begin = state((0, 0, RADIUS + height), (0.2, 0, 0))
        paths.append(run(scene_of(sphere()), begin, times, pull=pull, reach=reach))
        points = paths[-1][:, None, :3] + np.einsum("tij,kj->tki", as_matrix(paths[-1][:, 3:7]), rest)
        trials.append(
            Trial(
                name=f"take{n}",
                role="fit",
                times=times,
                points=points + 1e-4 * rng.normal(size=points.shape),
                pixels=None,
                object_index=np.zeros(12, dtype=np.int64),
                rest_points=rest,
                predict_times=None,
            )
        )
    fits = fit_rigid(scene_of(sphere(), trials).capture, ["adhesion"])
    score = fits.discrepancy(fits.candidates[0])["take2"].frame_score
    gap = paths[2][:, 2] - RADIUS
    leaves, lies = (paths[2][:, 9] > 0.1) & (gap < 0.5 * reach), (times > 0.6) & (gap < 1e-4)
    assert leaves.sum() >= 1 and lies.sum() > 10
    assert score[leaves].min() > score[lies].max()
    assert score[(gap > 0.01) & (times < 0.12)].max() == 0.0


def test_a_start_sunk_into_the_ground_is_not_thrown_up():
    found = run(scene_of(box()), state((0, 0, 0.05 - 3e-4), (0.2, 0, 0)), np.linspace(0.01, 0.3, 30))
    assert found[:, 2].max() < 0.05 + 1e-4


def test_changes_of_states_are_undone_by_their_difference():
    rng = np.random.default_rng(1)
    some = np.concatenate([rng.normal(size=3), [1, 0, 0, 0], rng.normal(size=6)])
    change = 0.3 * rng.normal(size=12)
    assert state_difference(some, perturbed(some, change)) == pytest.approx(change, abs=1e-12)


@pytest.mark.parametrize("name", sorted(set(CANDIDATE_EFFECTS) - {"camera_pose"}))
def test_values_are_what_the_effect_takes(name):
    freedom, scene = CANDIDATE_EFFECTS[name], scene_of(box())
    z = np.full(freedom.size, 0.3)
    setting = freedom.change(scene, scene.base, z)
    assert effect(name).checked(freedom.values(scene, setting, z))
    assert np.isfinite(scene.numbers([setting])).all()


@pytest.mark.parametrize("count", [1, 2, 9])
def test_a_pose_is_judged_by_moments_as_by_every_point(count):
    """Sums over the points of a frame, of which some are not seen, replace the points."""
    rng = np.random.default_rng(count)
    rest = rng.normal(0.0, 0.05, (count, 3))
    points = np.array([0.3, -1.0, 2.0]) + rng.normal(0.0, 0.05, (6, count, 3))
    points[3, 0], points[4] = np.nan, np.nan
    times, index = np.arange(6) / 60.0, np.zeros(count, np.int64)
    trial = Trial(name="a", role="fit", times=times, points=points, pixels=None, object_index=index, rest_points=rest)
    seen = observe_body(scene_of(sphere(), [trial], sigma=2e-3).capture, trial, 0, np.zeros(3))
    turns = rng.normal(size=(6, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    places = rng.normal(0.0, 0.3, (6, 3))
    gap, slope = seen.residuals(places, turns, np.arange(6))
    gap, slope = gap.reshape(6, -1), slope.reshape(6, -1, 6)
    chi2, down, info = seen.information(places, turns, np.arange(6))
    assert chi2 == pytest.approx(np.sum(gap**2, axis=1), rel=1e-9)
    assert down == pytest.approx(np.einsum("frp,fr->fp", slope, gap), rel=1e-9, abs=1e-6)
    assert info == pytest.approx(np.einsum("frp,frq->fpq", slope, slope), rel=1e-9, abs=1e-6)
    assert chi2[4] == 0 and not info[4].any()


def test_an_offset_centre_moves_the_centre_of_mass():
    freedom, scene = CANDIDATE_EFFECTS["mass_offset"], scene_of(box())
    z = np.array([0.5, 0.0, 0.0, 0.0])
    setting = freedom.change(scene, scene.base, z)
    values = freedom.values(scene, setting, z)
    row = scene.numbers([setting])[0]
    assert row[SLOTS["center"]] == pytest.approx([values["fraction"] * values["offset_x"], 0, 0])


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1))
def test_a_hidden_mass_reaches_the_surface_and_not_beyond(way):
    sides = np.array([0.06, 0.1, 0.2])
    brick, ball = rigid_body(box(tuple(sides))), rigid_body(sphere())
    direction = np.array(way) / np.linalg.norm(way)
    wanted = np.min(0.5 * sides / np.maximum(np.abs(direction), 1e-12))
    assert brick.reach(direction) == pytest.approx(wanted, rel=1e-6)
    assert ball.reach(direction) == pytest.approx(ball.radius)
    freedom, scene = CANDIDATE_EFFECTS["mass_offset"], scene_of(box(tuple(sides)))
    values = freedom.values(scene, scene.base, np.array([*(3.0 * direction), -3.0]))
    place = np.array([values[f"offset_{a}"] for a in "xyz"])
    assert np.linalg.norm(place) <= wanted * (1 + 1e-9)


def test_missing_forces_point_to_the_tether():
    rng = np.random.default_rng(4)
    anchor, stiffness, length = np.array([0.3, -0.4, 0.9]), 0.8, 0.25
    places = rng.uniform(-0.5, 0.5, (20, 3)) + np.array([0, 0, 0.3])
    line = anchor - places
    distance = np.linalg.norm(line, axis=1)
    forces = (stiffness * np.maximum(distance - length, 0) / distance)[:, None] * line + rng.normal(0, 0.01, (20, 3))
    found = tether_start(
        MissingForces(places=places, forces=forces, deviations=np.full(20, 0.01)), middle=np.array([0, 0, 0.3])
    )
    assert found is not None
    assert found[2] == pytest.approx(anchor, abs=0.1) and found[0] == pytest.approx(stiffness, rel=0.3)
    pushed = MissingForces(places=places, forces=-forces, deviations=np.full(20, 0.01))
    nothing = MissingForces(places=places, forces=0.0 * forces, deviations=np.full(20, 0.01))
    assert tether_start(pushed, np.zeros(3)) is None and tether_start(nothing, np.zeros(3)) is None


def flights(lift=0.0, drag=0.0, sigma=2e-4, takes=4):
    """Thrown spinning balls by a Runge-Kutta integration of their own, seen as points; the last one is to predict."""
    from scipy.integrate import solve_ivp
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(3)
    rest = RADIUS * Rotation.random(12, random_state=0).as_matrix()[:, :, 0]
    trials = []
    for n in range(takes + 1):
        v, w = np.array([*rng.normal(size=2), 2.0]), rng.normal(size=3) * 15

        def rate(t, y, w=w):
            u = y[3:]
            return np.concatenate([u, (0, 0, -9.81) + lift * np.cross(w, u) - drag * np.linalg.norm(u) * u])

        t = np.arange(0, 0.5, 0.01)
        path = solve_ivp(rate, (0, 1), [0, 0, 1.5, *v], t_eval=t, rtol=1e-10, atol=1e-12).y[:3].T
        turns = Rotation.from_rotvec(np.outer(t, w)).as_matrix()
        points = path[:, None] + np.einsum("tij,kj->tki", turns, rest) + sigma * rng.normal(size=(len(t), 12, 3))
        last = n == takes
        trials.append(
            Trial(
                name=f"take{n}",
                role="predict" if last else "fit",
                times=t[:20] if last else t,
                points=points[:20] if last else points,
                pixels=None,
                object_index=np.zeros(12, dtype=np.int64),
                rest_points=rest,
                predict_times=t[20:] if last else None,
            )
        )
        truth = path[20:, None] + np.einsum("tij,kj->tki", turns[20:], rest)
    return scene_of(sphere(), trials, sigma=sigma).capture, truth


def test_lift_is_found_in_flights_and_predicted():
    capture, truth = flights(lift=0.002)
    fits = fit_rigid(capture, ["magnus", "air_drag", "gravity_tilt"])
    best = max((fits.nominal, *fits.candidates), key=lambda f: f.log_evidence)
    assert best.effects == ("magnus",)
    found = best.parameters["magnus"]["lift_per_mass"]
    assert found.value == pytest.approx(0.002, rel=0.02)
    assert found.low < 0.002 < found.high
    assert best.misfit < 1.4 < 3 < fits.nominal.misfit
    after = np.abs(fits.predict(best)["take4"] - truth).max()
    assert after < 0.2 * np.abs(fits.predict(fits.nominal)["take4"] - truth).max()


def skidding(factor, friction=0.3, sigma=2e-4):
    """Balls that slide without spin until they roll, in closed form; the last one is shown while it slides."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(5)
    rest = RADIUS * Rotation.random(12, random_state=0).as_matrix()[:, :, 0]
    slow, share = friction * 9.81, 0.4 * factor
    t, trials = np.arange(0, 0.5, 0.01), []
    for n, (speed, heading) in enumerate([(1.0, 0.0), (0.8, 2.0), (1.2, 4.0), (1.1, 5.5)]):
        slides = np.minimum(t, speed * share / (1 + share) / slow)
        way = speed * t - slow * slides * (t - 0.5 * slides)
        turn = slow / (share * RADIUS) * slides * (t - 0.5 * slides)
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        axis = np.array([-ahead[1], ahead[0], 0.0])
        turned = np.einsum("tij,kj->tki", Rotation.from_rotvec(turn[:, None] * axis).as_matrix(), rest)
        points = way[:, None, None] * ahead + (0, 0, RADIUS) + turned + sigma * rng.normal(size=(len(t), 12, 3))
        shown = len(t) if n < 3 else 8
        trials.append(
            Trial(
                name=f"take{n}",
                role="fit" if n < 3 else "predict",
                times=t[:shown],
                points=points[:shown],
                pixels=None,
                object_index=np.zeros(12, dtype=np.int64),
                rest_points=rest,
                predict_times=t[shown:] if n == 3 else None,
            )
        )
    return scene_of(sphere(), trials, friction=friction, sigma=sigma).capture


def test_a_hollow_ball_is_told_by_the_speed_at_which_it_begins_to_roll():
    fits = fit_rigid(skidding(5 / 3), ["friction", "inertia"])
    best = max((fits.nominal, *fits.candidates), key=lambda f: f.log_evidence)
    found = best.parameters["inertia"]["factor"]
    assert best.effects == ("inertia",) and found.low < 5 / 3 < found.high
    assert found.value == pytest.approx(5 / 3, rel=0.05)
    # The held-out error counts by trial, in units of what noise and contacts make of it.
    assert best.heldout_chi < 0.3 * fits.nominal.heldout_chi
    assert len(best.heldout_trials) == 3 and best.heldout_elsewhere == (False,) * 3
    assert best.heldout_chi == pytest.approx(np.sqrt(np.mean(np.square(best.heldout_trials))), rel=1e-9)


def test_inertia_is_missed_where_the_ground_turns_the_ball():
    """It was placed nowhere: only forces were compared, and another inertia is none."""
    fits = fit_rigid(skidding(5 / 3), ["inertia"])
    score = fits.discrepancy(fits.candidates[0])["take0"].frame_score
    # Friction turns a believed ball 5/3 times as fast, until the ball rolls, from 0.136 s on.
    assert score[2:12] == pytest.approx(2 / 3 * 0.3 * 9.81 / (0.4 * 5 / 3), rel=0.1)
    assert score[16:] == pytest.approx(0.0, abs=0.05)


def test_a_solid_ball_is_not_called_hollow():
    fits = fit_rigid(skidding(1.0), ["inertia"])
    assert all(c.log_evidence < fits.nominal.log_evidence + 2 for c in fits.candidates)


@given(st.lists(st.tuples(st.sampled_from(sorted(CANDIDATE_EFFECTS))), unique=True, max_size=8))
def test_equally_likely_candidates_come_in_the_same_order_in_every_process(keys):
    """A wrong clock and a lighter body may tie; a set's order, which differs between processes, chose among them."""
    assert list(shown_keys(keys)) == [*keys, REFITS]
    assert list(shown_keys([*keys, REFITS])) == [*keys, REFITS]


def test_no_effect_is_found_in_plain_motion():
    capture, _ = flights()
    fits = fit_rigid(capture, ["magnus", "air_drag", "buoyancy"])
    assert fits.nominal.misfit < 1.4
    assert all(c.log_evidence < fits.nominal.log_evidence + 2 for c in fits.candidates)


@pytest.mark.parametrize(("phase", "named"), [("impact", "normal"), ("contact", "normal"), ("flight", "along_gravity")])
def test_an_upright_force_on_level_ground_is_the_grounds_where_it_touches(phase, named):
    force, velocity = np.array([[0.0, 0.0, 50.0]]), np.array([[1.0, 0.0, 0.2]])
    found = _directions(force, velocity, np.array([0, 0, -9.81]), np.array([0.0, 0.0, 1.0]), [phase])
    assert found == {"normal": 0.0, "along_velocity": 0.0, "along_gravity": 0.0, "other": 0.0} | {named: 1.0}


def test_the_force_is_placed_where_drag_is_strong():
    capture, _ = flights(drag=0.05)
    fits = fit_rigid(capture, ["air_drag"])
    drag = next(c for c in fits.candidates if c.effects == ("air_drag",))
    assert drag.parameters["air_drag"]["drag_per_mass"].value == pytest.approx(0.05, rel=0.05)
    found = fits.discrepancy(drag)["take0"]
    assert found.frame_score.shape == (50,) and found.point_score.shape == (50, 12)
    assert {i.phase for i in found.intervals} == {"flight"}
    assert sum(found.directions.values()) == pytest.approx(1.0)
    assert found.frame_score[-1] > found.frame_score[20]  # faster at the end than near the top
    raw = fits.discrepancy(None)["take0"].frame_score
    assert raw.max() > 0


@pytest.mark.parametrize("drag", [0.0, 0.05])
def test_a_small_steady_force_is_measured_over_the_whole_flight(drag):
    """Of 0.1 to 1 m/s², where a millimetre of noise hides 5 m/s² in the frames of a tenth of a second."""
    capture, _ = flights(drag=drag, sigma=1e-3, takes=2)
    raw = fit_rigid(capture, ["magnus"]).discrepancy(None)
    for trial in capture.trials:
        middle = trial.observed.mean(axis=1)
        velocity = np.gradient(middle, trial.times, axis=0)
        wanted = drag * float(np.mean(np.sum(velocity**2, axis=1)))
        found = float(raw[trial.name].frame_score.mean())
        assert 0.5 * wanted - 0.05 <= found <= 1.5 * wanted + 0.05
