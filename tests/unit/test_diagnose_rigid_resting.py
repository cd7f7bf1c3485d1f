# SPDX-License-Identifier: MIT
"""Bodies that lie, slide or roll on the ground from the start, in pixels and in points."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from physgen.sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.rigid import fit_rigid
from physgen.sim.diagnose.rigid.held_out_score import middle_frame
from physgen.sim.diagnose.rigid.observed_poses import fit_rotation, observe_body, project
from physgen.sim.diagnose.rigid.quaternions import as_matrix, from_rotvec
from physgen.sim.diagnose.rigid.resting_contact import height, resting_state
from physgen.sim.diagnose.rigid.rigid_search import body_problem
from physgen.sim.diagnose.rigid.rigid_simulator import rigid_body
from physgen.sim.diagnose.rigid.world_settings import BodyScene
from physgen.sim.diagnose.work import Work

SIZE = (0.12, 0.08, 0.05)
LENS = {"width": 1280, "height": 720, "fx": 1200.0, "fy": 1200.0, "cx": 640.0, "cy": 360.0}


def camera():
    """Looks from (0, -1.5, 1) at the origin."""
    forward = np.array([0.0, 1.5, -1.0]) / np.hypot(1.5, 1.0)
    right = np.array([1.0, 0.0, 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = [0.0, -1.5, 1.0]
    return Camera(**LENS, world_from_camera=tuple(tuple(row) for row in matrix))


def filmed(lift):
    """(scene, sight) of a box that slides to the right and turns; ``lift`` (T,) m takes it off the ground."""
    mesh = trimesh.creation.box(SIZE)
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=500.0, stiffness="hard")
    thing = CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    times = np.arange(len(lift)) / 240
    yaw = from_rotvec((0.3 + 2.0 * times)[:, None] * np.array([0.0, 0.0, 1.0]))
    middle = np.stack([-0.1 + 0.8 * times - 1.5 * times**2, 0.02 * np.ones_like(times), SIZE[2] / 2 + lift], axis=1)
    points = middle[:, None] + np.einsum("fij,kj->fki", as_matrix(yaw), mesh.vertices)
    noise = np.random.default_rng(1).normal(scale=0.4, size=(*points.shape[:2], 2))
    trial = Trial(
        name="take",
        role="fit",
        times=times,
        points=None,
        pixels=project(camera(), points) + noise,
        object_index=np.zeros(len(mesh.vertices), dtype=np.int64),
        rest_points=np.asarray(mesh.vertices),
    )
    capture = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=0.3, restitution=0.2),
        objects=(thing,),
        noise_sigma=0.4,
        camera=camera(),
        trials=(trial,),
    )
    body = rigid_body(thing)
    return BodyScene(capture=capture, body=body, middle=np.zeros(3)), observe_body(capture, trial, 0, body.center)


def test_a_box_that_slides_is_on_the_ground_from_the_start():
    found = resting_state(*filmed(np.zeros(30)))
    assert found is not None
    state, _ = found
    assert state[:3] == pytest.approx([-0.1, 0.02, SIZE[2] / 2], abs=1e-3)
    assert state[7:10] == pytest.approx([0.8, 0.0, 0.0], abs=0.03)
    assert state[12] == pytest.approx(2.0, abs=0.15)


def test_a_box_that_rises_does_not_lie():
    times = np.arange(30) / 240
    assert resting_state(*filmed(1.2 * times - 4.9 * times**2)) is None


def test_height_changes_as_its_slope_says():
    scene, _ = filmed(np.zeros(5))
    state = np.array([0.0, 0.0, 0.1, *from_rotvec(np.array([0.3, 0.2, 0.1])), *np.zeros(6)])
    here, slope = height(scene, state)
    moved = state.copy()
    moved[2] += 0.01
    assert height(scene, moved)[0] == pytest.approx(here + 0.01 * slope[2])
    assert slope[:3] == pytest.approx([0, 0, 1])


def test_the_nearest_turn_of_turned_points_is_theirs():
    rng = np.random.default_rng(0)
    places = rng.normal(size=(6, 3))
    turn = as_matrix(from_rotvec(rng.normal(size=3)))
    assert fit_rotation(places, places @ turn.T) == pytest.approx(turn, abs=1e-9)


def rolling(rise=0.0, takes=2, frames=60):
    """Points on a ball that rolls from the start, or leaves the ground with ``rise`` m/s, 150 frames a second."""
    rng, radius = np.random.default_rng(5), 0.0335
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    rest = radius * as_matrix(from_rotvec(rng.normal(size=(40, 3))))[:, :, 0]
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=650.0, stiffness="hard")
    thing = CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    times, trials = np.arange(frames) / 150, []
    for n in range(takes):
        way = np.array([np.cos(n), np.sin(n), 0.0]) * 0.8
        up = np.maximum(rise * times - 0.5 * 9.81 * times**2, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
        path = np.outer(times, way) + np.array([0.0, 0.0, radius]) + up
        spin = np.cross([0.0, 0.0, 1.0], way) / radius
        points = path[:, None] + np.einsum("tij,kj->tki", as_matrix(from_rotvec(np.outer(times, spin))), rest)
        points += 6e-4 * rng.normal(size=points.shape)
        trials.append(
            Trial(
                name=f"take{n}",
                role="fit",
                times=times,
                points=points,
                pixels=None,
                object_index=np.zeros(len(rest), dtype=np.int64),
                rest_points=rest,
            )
        )
    return Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=0.5, restitution=0.7),
        objects=(thing,),
        noise_sigma=6e-4,
        camera=None,
        trials=tuple(trials),
    )


def test_a_ball_that_rolls_from_the_start_does_not_seem_to_rise():
    for trial in body_problem(rolling(), 0, Work()).trials:
        # Free flight from the first frames made it 0.08 to 0.2 m/s. A point has a noise of 0.6 mm.
        assert abs(trial.states[0][9]) < 0.03 and trial.states[0][2] == pytest.approx(0.0335, abs=6e-4)


def test_a_ball_that_leaves_the_ground_rises():
    for trial in body_problem(rolling(rise=0.8, frames=20), 0, Work()).trials:
        assert trial.states[0][9] == pytest.approx(0.8, abs=0.03)


def test_a_long_rest_does_not_take_the_half_that_judges():
    """Of a cup that hops for 0.3 of 2 s the later half was rest that is not fitted, and no error was held out."""
    (trial, _) = body_problem(rolling(), 0, Work()).trials
    assert trial.end == 60 and middle_frame(trial) == 30
    assert middle_frame(dataclasses.replace(trial, end=12)) == 6


def test_nothing_is_missing_where_a_ball_rolls():
    """States that hopped on the ground once looked like adhesion. Every effect contains the nominal model."""
    fits = fit_rigid(rolling(), ["adhesion", "restitution", "rolling_resistance"])
    assert fits.nominal.misfit < 1.2
    gains = [c.log_evidence - fits.nominal.log_evidence for c in fits.candidates]
    assert max(gains) < 8.0 and min(gains) > -40.0
