# SPDX-License-Identifier: MIT
"""Rigid bodies that touch nothing: flight, spin, drag, lift, tethers."""

from __future__ import annotations

import numpy as np
import pytest
from physgen.sim.mpm.bodies import BodyForces
from physgen.sim.mpm.colliders import Track
from physgen.sim.mpm.world_setup import WorldSetup

G = 9.81
NO_GRAVITY = (0.0, 0.0, 0.0)


def test_free_spin_conserves_angular_momentum_and_energy(box_body, rigid_bodies):
    """L within 1e-12 (it is the state); energy within 1e-4, of the order of (w dt)² = 1e-4 at 10 rad/s and 1 ms."""
    body = box_body(size=(0.1, 0.2, 0.3), spin=(6.0, 5.0, 6.0))
    world = rigid_bodies(WorldSetup(bodies=(body,), gravity=NO_GRAVITY))
    start = world.pose(0, "box")
    for _ in range(10):
        world.advance(1e-3, 100)
        now = world.pose(0, "box")
        assert np.linalg.norm(now.angular_momentum - start.angular_momentum) < 1e-12 * np.linalg.norm(
            start.angular_momentum
        )
        assert now.kinetic == pytest.approx(start.kinetic, rel=1e-4)
    assert np.allclose(now.rotation @ now.rotation.T, np.eye(3), atol=1e-12)


def test_spin_about_the_middle_axis_flips(box_body, rigid_bodies):
    """Dzhanibekov: the axis turns over again and again, the energy stays within 1e-3 and nothing grows."""
    body = box_body(size=(0.1, 0.2, 0.3), spin=(0.0, 10.0, 0.01))
    world = rigid_bodies(WorldSetup(bodies=(body,), gravity=NO_GRAVITY))
    start = world.pose(0, "box")
    along = []
    for _ in range(60):
        world.advance(1e-3, 50)
        now = world.pose(0, "box")
        along.append(now.rotation[:, 1] @ now.angular_momentum / np.linalg.norm(now.angular_momentum))
        assert now.kinetic == pytest.approx(start.kinetic, rel=1e-3)
    assert min(along) < -0.95
    assert max(along) > 0.95


def test_free_fall_is_exact(ball_body, rigid_bodies):
    """z = v t - g t²/2 within 1e-9 m: steady forces are integrated exactly."""
    body = ball_body(velocity=(0.3, 0.0, 1.0))
    world = rigid_bodies(WorldSetup(bodies=(body,)))
    world.advance(5e-4, 400)
    t = 0.2
    assert world.pose(0, "ball").center == pytest.approx([0.3 * t, 0.0, t - 0.5 * G * t * t], abs=1e-9)
    energy = world.pose(0, "ball").kinetic + world.pose(0, "ball").potential
    mass = float(body.masses.sum())
    assert energy == pytest.approx(0.5 * mass * (0.09 + 1.0), rel=1e-9)


def test_drag_slows_as_one_over_time(ball_body, rigid_bodies):
    """v = v0 / (1 + k v0 t), the solution of v' = -k v², within 1e-9."""
    body = ball_body(velocity=(2.0, 0.0, 0.0), forces=BodyForces(drag=3.0))
    world = rigid_bodies(WorldSetup(bodies=(body,), gravity=NO_GRAVITY))
    world.advance(1e-3, 200)
    assert world.pose(0, "ball").velocity[0] == pytest.approx(2.0 / (1 + 3.0 * 2.0 * 0.2), rel=1e-9)


def test_lift_turns_the_velocity(ball_body, rigid_bodies):
    """Velocity across the spin turns at the rate lift w and keeps its size, both within 1e-9."""
    body = ball_body(velocity=(1.0, 0.0, 0.0), spin=(0.0, 0.0, 20.0), forces=BodyForces(lift=0.5))
    world = rigid_bodies(WorldSetup(bodies=(body,), gravity=NO_GRAVITY))
    world.advance(1e-3, 100)
    angle = 0.5 * 20.0 * 0.1
    assert world.pose(0, "ball").velocity == pytest.approx([np.cos(angle), np.sin(angle), 0.0], abs=1e-9)


def test_tether_swings_as_a_spring(ball_body, rigid_bodies):
    """x = x0 cos(w t) within 1 % of x0 after a period (first order in w dt = 0.01), and no energy is gained."""
    forces = BodyForces(tether_stiffness=100.0, tether_anchor=(0.0, 0.0, 0.0))
    world = rigid_bodies(WorldSetup(bodies=(ball_body(center=(0.1, 0.0, 0.0), forces=forces),), gravity=NO_GRAVITY))
    world.advance(1e-3, int(2 * np.pi / 10 * 1000))
    assert world.pose(0, "ball").center[0] == pytest.approx(0.1, abs=1e-3)
    world.advance(1e-3, 3000)
    pose = world.pose(0, "ball")
    mass = 4 / 3 * np.pi * 0.1**3 * 1000
    assert pose.kinetic + 50.0 * mass * pose.center @ pose.center == pytest.approx(50.0 * mass * 0.01, rel=0.02)


def test_acceleration_gravity_and_velocity_tracks(ball_body, rigid_bodies):
    """v = (a + g) t over a segment with both steady, within 1e-9; a velocity key sets the velocity at its time."""
    push = Track(times=np.array([0.0]), values=np.array([[2.0, 0.0, 0.0]]))
    keys = Track(times=np.array([0.1]), values=np.array([[0.0, 5.0, 0.0]]))
    gravity = Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -10.0]]))
    body = ball_body(acceleration=push, velocity_keys=keys)
    world = rigid_bodies(WorldSetup(bodies=(body,), gravity_track=gravity))
    world.set_segments({0: (0.0, 0.1)})
    world.advance(1e-3, 100)
    assert world.pose(0, "ball").velocity == pytest.approx([0.2, 0.0, -0.05], abs=1e-9)
    world.set_segments({0: (0.1, 0.2)})
    assert world.pose(0, "ball").velocity == pytest.approx([0.0, 5.0, 0.0], abs=1e-12)
