# SPDX-License-Identifier: MIT
"""The effects of ``sim/effects`` on matter that deforms, against closed forms.

Forces act in symplectic Euler steps of dt, so a velocity is off by dt times the change of acceleration at most, and a
time at which something sets in by dt.
"""

from __future__ import annotations

import dataclasses
import io
import math

import numpy as np
import pytest
from physgen.sim.constitutive import DAMPED, FIBRED, ElasticMaterial, VonMisesMaterial
from physgen.sim.effects.registry import apply_effects
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import GROUND_NAME
from physgen.sim.mpm.world import Worlds
from physgen.sim.mpm.world_setup import WorldSetup
from physgen.sim.scene.model import Effect
from scipy.integrate import quad, solve_ivp

G = 9.81
DOWN = np.array([0.0, 0.0, -G])
NO_GRAVITY = (0.0, 0.0, 0.0)
STEP = 5e-4
"""Longest substep in s of the default options."""


def effect(name: str, **parameters: float) -> Effect:
    return Effect(name=name, parameters=tuple(parameters.items()))


def under(setup: WorldSetup, effects, similarity, options) -> Worlds:
    """The world with the effects in it."""
    return Worlds([apply_effects(setup, effects)], similarity=similarity, options=options)


def mean_velocity(worlds: Worlds, world: int = 0) -> np.ndarray:
    view = worlds[world]
    return np.average(view.velocities(0), axis=0, weights=view.bodies[0].masses)


def center(worlds: Worlds, world: int = 0) -> np.ndarray:
    view = worlds[world]
    return np.average(view.positions(0), axis=0, weights=view.bodies[0].masses)


# ---- forces ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drag", [0.5, 8.0])
def test_air_drag_leads_to_the_terminal_velocity(box, options, similarity, drag):
    """v = V tanh(r t), V = sqrt(g / k), r = sqrt(g k), at all times and in the end, within (r dt)² and 1e-4 of V: the
    drag is exact for itself and stands between two halves of gravity, which is of second order (Strang)."""
    setup = WorldSetup(bodies=(box(cells=(3, 3, 3)),))
    worlds = under(setup, [effect("air_drag", drag_per_mass=drag)], similarity, options)
    terminal, rate = math.sqrt(G / drag), math.sqrt(G * drag)
    allowed = terminal * ((rate * STEP) ** 2 + 1e-4)
    for _ in range(5):
        worlds.advance(0.1)
        expected = [0.0, 0.0, -terminal * math.tanh(rate * worlds.time())]
        assert np.abs(mean_velocity(worlds) - expected).max() < allowed
    if drag > 1:
        worlds.advance(0.3)
        assert abs(mean_velocity(worlds)[2] + terminal) < allowed


def test_wind_takes_a_body_along(box, options, similarity):
    """Without gravity w - v = w / (1 + k |w| t), within 1e-4 of w as the drag is exact for itself, and the drift w t -
    ln(1 + k |w| t) / k along w, within that and dt/2 of the change of velocity (symplectic Euler)."""
    wind, drag = np.array([3.0, -1.0, 2.0]), 2.0
    setup = WorldSetup(bodies=(box(cells=(3, 3, 3)),), gravity=NO_GRAVITY)
    blow = effect("wind", drag_per_mass=drag, wind_x=3.0, wind_y=-1.0, wind_z=2.0)
    worlds = under(setup, [blow], similarity, options)
    start, strength = center(worlds), np.linalg.norm(wind)
    for _ in range(4):
        worlds.advance(0.05)
        t, rate = worlds.time(), drag * strength
        assert np.abs(mean_velocity(worlds) - wind * (1 - 1 / (1 + rate * t))).max() < 1e-4 * strength
        drift = wind * (t - math.log(1 + rate * t) / rate)
        assert np.abs(center(worlds) - start - drift).max() < strength * (STEP / 2 + 1e-4 * t)


@pytest.mark.parametrize("lift, spin", [(1.0, 8.0), (-2.0, 5.0), (5.0, 40.0)])
def test_magnus_bends_the_way_into_a_circle(box, options, similarity, lift, spin):
    """v turns at the rate s w about the spin, at constant speed (the lift does no work): angle within two substeps and
    the strain rho w² r² / E by which the spinning body widens and slows, speed within 1e-4, size within that strain."""
    body = box(cells=(4, 4, 4), spin=(0.0, 0.0, spin), velocity=(0.5, 0.0, 0.3), youngs_modulus=2e6)
    setup = WorldSetup(bodies=(body,), gravity=NO_GRAVITY)
    worlds = under(setup, [effect("magnus", lift_per_mass=lift)], similarity, options)
    reach = float(np.abs(body.positions[:, 0]).max())
    strain = 1000.0 * spin**2 * 2 * reach**2 / 2e6
    for _ in range(4):
        worlds.advance(0.05)
        v = mean_velocity(worlds)
        turned = lift * spin * worlds.time()
        error = (math.atan2(v[1], v[0]) - turned + math.pi) % (2 * math.pi) - math.pi
        assert abs(error) < 2 * STEP * abs(lift * spin) + 2 * strain * abs(turned)
        assert math.hypot(v[0], v[1]) == pytest.approx(0.5, rel=1e-4)
        assert v[2] == pytest.approx(0.3, rel=1e-4)
    arms = worlds[0].positions(0) - center(worlds)
    before = np.linalg.norm(body.positions - body.center_of_mass, axis=1)
    assert np.linalg.norm(arms, axis=1) == pytest.approx(before, rel=2 * strain + 1e-3)


@pytest.mark.parametrize("fraction", [0.4, 1.0, 1.7, -0.5])
def test_buoyancy_carries_a_share_of_the_weight(box, options, similarity, fraction):
    """v = (1 - f) g t within rounding."""
    setup = WorldSetup(bodies=(box(cells=(3, 3, 3)),))
    worlds = under(setup, [effect("buoyancy", fraction=fraction)], similarity, options)
    worlds.advance(0.2)
    assert np.abs(mean_velocity(worlds) - (1 - fraction) * DOWN * 0.2).max() < 1e-4 * G * 0.2


def test_gravity_tilt_turns_the_fall(box, options, similarity):
    """v = |g| t (sin a cos b, sin a sin b, -cos a) within rounding."""
    angle, azimuth = 0.3, 2.0
    setup = WorldSetup(bodies=(box(cells=(3, 3, 3)),))
    worlds = under(setup, [effect("gravity_tilt", angle=angle, azimuth=azimuth)], similarity, options)
    worlds.advance(0.2)
    leaning = math.sin(angle)
    expected = G * 0.2 * np.array([leaning * math.cos(azimuth), leaning * math.sin(azimuth), -math.cos(angle)])
    assert np.abs(mean_velocity(worlds) - expected).max() < 1e-4 * G * 0.2


def tether(stiffness: float, length: float, height: float, string: float) -> Effect:
    return effect(
        "tether",
        stiffness_per_mass=stiffness,
        rest_length=length,
        anchor_x=0.0,
        anchor_y=0.0,
        anchor_z=height,
        string=string,
    )


@pytest.mark.parametrize("stiffness", [400.0, 10_000.0])
def test_a_spring_swings_at_its_frequency(box, options, similarity, stiffness):
    """x = cos(sqrt(k) t): frequency within (w dt)² / 24 and 1e-4, and no more than 1e-3 of the amplitude is won or lost
    a period: a spring that feels the place of one substep ago would win pi w dt, 3 % of it."""
    body = box(cells=(3, 3, 3))
    setup = WorldSetup(bodies=(body,), gravity=NO_GRAVITY)
    anchor, stretch = float(body.center_of_mass[2]) + 0.4, 0.05
    worlds = under(setup, [tether(stiffness, 0.4 - stretch, anchor, 0.0)], similarity, options)
    omega = math.sqrt(stiffness)
    rest = body.center_of_mass[2] + stretch
    times, places = [], []
    for _ in range(100):
        worlds.advance(0.05 * 2 * math.pi / omega)
        times.append(worlds.time())
        places.append((center(worlds)[2] - rest) / stretch)
    t, x = np.array(times), np.array(places)
    crossings = []
    for i in range(len(t) - 1):
        if x[i] * x[i + 1] < 0:
            # The zero of a sine of this frequency through both samples.
            a, b = omega * (t[i + 1] - t[i]), x[i + 1] / x[i]
            crossings.append(t[i] + math.atan2(math.sin(a), math.cos(a) - b) / omega)
    measured = math.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    assert measured == pytest.approx(omega, rel=(omega * STEP) ** 2 / 24 + 1e-4)
    growth = float(np.abs(x[-20:]).max() / np.abs(x[:20]).max())
    assert abs(growth - 1) < 4 * 1e-3


def test_a_string_pulls_only_when_taut(box, options, similarity):
    """Slack it does nothing: free flight to rounding. Taut it turns the body back like a spring, and lets it go with
    its speed, within dt of the pull k d of its longest stretch d = v / sqrt(k)."""
    body = box(cells=(3, 3, 3), velocity=(0.0, 0.0, -1.0))
    setup = WorldSetup(bodies=(body,), gravity=NO_GRAVITY)
    stiffness, length = 2500.0, 0.3
    anchor = float(body.center_of_mass[2]) + 0.2
    worlds = under(setup, [tether(stiffness, length, anchor, 1.0)], similarity, options)
    pushed = under(setup, [tether(stiffness, length, anchor, 0.0)], similarity, options)
    worlds.advance(0.09)
    pushed.advance(0.09)
    assert np.abs(mean_velocity(worlds) - [0.0, 0.0, -1.0]).max() < 1e-4
    assert abs(mean_velocity(pushed)[2] + 1.0) > 0.5
    worlds.advance(0.01 + math.pi / 50 / 2)
    deepest = anchor - center(worlds)[2] - length
    assert deepest == pytest.approx(1.0 / 50, rel=0.03)
    worlds.advance(math.pi / 50 / 2 + 0.02)
    assert mean_velocity(worlds)[2] == pytest.approx(1.0, abs=STEP * stiffness / 50)


def test_several_effects_at_once_follow_their_equation(box, options, similarity):
    """Drag, wind, lift, buoyancy, tilt and a tether together: the numerical solution of the sum of their equations. A
    step of first order is off by dt/2 of its change of acceleration, so the velocity is within dt times all changes of
    acceleration on the way (the first counts too), the place within that times t. The drag acts on local velocities:
    linear in the spin, it slows that of a cube by k |u| (1 + (1 - u u^T / |u|²) / 2), u the velocity in the air."""
    spin = np.array([0.0, 1.0, 0.5])
    body = box(cells=(4, 4, 4), velocity=(0.6, 0.2, 0.5), spin=tuple(spin), youngs_modulus=2e6)
    setup = WorldSetup(bodies=(body,))
    effects = [
        effect("air_drag", drag_per_mass=0.7),
        effect("wind", drag_per_mass=0.5, wind_x=2.0, wind_y=-1.0, wind_z=0.0),
        effect("magnus", lift_per_mass=5.0),
        effect("buoyancy", fraction=0.3),
        effect("gravity_tilt", angle=0.4, azimuth=1.0),
        tether(150.0, 0.1, 0.5, 0.0),
    ]
    worlds = under(setup, effects, similarity, options)
    gravity = 0.7 * G * np.array([math.sin(0.4) * math.cos(1.0), math.sin(0.4) * math.sin(1.0), -math.cos(0.4)])
    wind, anchor = np.array([2.0, -1.0, 0.0]), np.array([0.0, 0.0, 0.5])

    def acceleration(y: np.ndarray) -> np.ndarray:
        arm, through = anchor - y[:3], y[3:6] - wind
        distance = np.linalg.norm(arm)
        pull = 150.0 * (distance - 0.1) * arm / distance
        return gravity - 1.2 * np.linalg.norm(through) * through + 5.0 * np.cross(y[6:], through) + pull

    def change(_: float, y: np.ndarray) -> np.ndarray:
        through = y[3:6] - wind
        speed = np.linalg.norm(through)
        slower = 1.5 * y[6:] - 0.5 * through * (through @ y[6:]) / speed**2
        return np.concatenate([y[3:6], acceleration(y), -1.2 * speed * slower])

    start = np.concatenate([body.center_of_mass, body.velocity, spin])
    exact = solve_ivp(change, (0.0, 0.3), start, t_eval=np.linspace(0.0, 0.3, 301), rtol=1e-9, atol=1e-9).y.T
    pushes = np.array([acceleration(y) for y in exact])
    changes = np.linalg.norm(pushes[0]) + np.linalg.norm(np.diff(pushes, axis=0), axis=1).cumsum()
    for i in range(50, 301, 50):
        worlds.advance(0.05)
        allowed = STEP * changes[i - 1]
        assert np.abs(mean_velocity(worlds) - exact[i, 3:6]).max() < allowed
        assert np.abs(center(worlds) - exact[i, :3]).max() < allowed * worlds.time()


# ---- matter ----------------------------------------------------------------------------------------------------------


def bar_frequency(box, effects, similarity, options, cell) -> float:
    """Angular frequency of the first longitudinal mode of a free bar of 16 cells, nu = 0, that is let go bent by it."""
    body = box(cells=(3, 3, 16), youngs_modulus=1e5, poisson_ratio=0.0)
    setup = WorldSetup(bodies=(body,), gravity=NO_GRAVITY)
    worlds = under(setup, effects, similarity, options)
    mode = np.cos(math.pi * body.positions[:, 2] / (16 * cell))
    state = worlds.checkpoint()
    scale = worlds.cells.scale
    velocities, gradients = np.zeros((body.count, 3)), np.zeros((body.count, 3, 3))
    velocities[:, 2] = 0.02 * mode
    gradients[:, 2, 2] = -0.02 * math.pi / (16 * cell) * np.sin(math.pi * body.positions[:, 2] / (16 * cell))
    state["v"] = (velocities[state["ids"]] * scale).astype(np.float32)
    state["C"] = gradients[state["ids"]].astype(np.float32)
    worlds.restore(state)
    times, places = [0.0], [0.0]
    crossings: list[float] = []
    while len(crossings) < 4:
        worlds.advance(0.002)
        times.append(worlds.time())
        places.append(float(mode @ (worlds[0].positions(0) - body.positions)[:, 2]))
        a, b = places[-2], places[-1]
        if a * b < 0:
            crossings.append(times[-2] + (times[-1] - times[-2]) * a / (a - b))
    return math.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])


def test_stiffness_sets_the_pitch_of_a_bar(box, options, similarity, cell):
    """w = pi/L sqrt(c E / rho) within 5 % (as docs/physics.md asks of the wave speed); four times as stiff sounds twice
    as high within 1 %, which is left for the time between two looks."""
    believed = bar_frequency(box, [], similarity, options, cell)
    stiffer = bar_frequency(box, [effect("stiffness", factor=4.0)], similarity, options, cell)
    assert believed == pytest.approx(math.pi / (16 * cell) * math.sqrt(1e5 / 1000.0), rel=0.05)
    assert stiffer / believed == pytest.approx(2.0, rel=0.01)


def test_numbers_of_matter_reach_the_kernels(box, options, similarity):
    """Damping time, yield stress, fibres and moduli as the kernels' table and particles have them; the laws themselves
    are validated in test_mpm_constitutive_laws and unit/test_mpm_laws."""
    setup = WorldSetup(bodies=(box(cells=(3, 3, 3), youngs_modulus=1e5, poisson_ratio=0.25),))
    shear = 1e5 / 2.5
    plain = under(setup, [], similarity, options)[0].group._engine
    damped = under(setup, [effect("internal_damping", damping_time=3e-3)], similarity, options)[0].group._engine
    assert damped.laws == plain.laws | DAMPED
    assert damped.worlds.arrays().materials.to_numpy()[1] == np.float32(3e-3)
    yielding = under(setup, [effect("plastic_yield", yield_stress=2e3)], similarity, options)[0].group._engine
    assert yielding.laws == 1 << VonMisesMaterial.number
    assert yielding.worlds.arrays().materials.to_numpy()[2] == pytest.approx(
        math.sqrt(2 / 3) * 2e3 / (2 * shear), rel=1e-6
    )
    fibred = under(
        setup, [effect("anisotropy", fibre_modulus=3e5, axis_x=0.0, axis_y=0.5, axis_z=0.0)], similarity, options
    )[0].group._engine
    assert fibred.laws == plain.laws | FIBRED
    assert fibred.worlds.arrays().materials.to_numpy()[6:10] == pytest.approx(
        [3e5 / (2 * shear), 0.0, 1.0, 0.0], rel=1e-6
    )
    stiffer = under(setup, [effect("stiffness", factor=3.0)], similarity, options)[0].group._engine
    ratio = stiffer.state()["constants"][:, 1:3] / plain.state()["constants"][:, 1:3]
    assert ratio == pytest.approx(np.full_like(ratio, 3.0), rel=1e-6)


@pytest.mark.parametrize("slope", [0.7, -0.7])
def test_a_graded_column_sags_as_computed(box, options, similarity, cell, slope):
    """Strain rho g (H - z) / E(z) of a column on pins, nu = 0: sag of its lower and its upper part, each of three
    cells, as mean over five of its swings, within 5 % (the modulus is asked for as closely)."""
    height, modulus = 10 * cell, 2e5
    body = box(cells=(3, 3, 10), youngs_modulus=modulus, poisson_ratio=0.0)
    z = body.positions[:, 2]
    body = dataclasses.replace(body, pins=z < cell / 2)
    setup = WorldSetup(bodies=(body,))
    graded = effect("stiffness_gradient", slope=slope, direction_x=0.0, direction_y=0.0, direction_z=1.0)
    worlds = under(setup, [graded], similarity, options)

    def modulus_at(z: float) -> float:
        return modulus * (1 + slope * (2 * z / height - 1))

    layers = np.array([2.25, 5.25, 8.25]) * cell
    chosen = [np.abs(z - layer) < 0.1 * cell for layer in layers]
    # Undamped, the column swings about its state of rest: the mean over several swings of the slowest mode is that.
    sags = []
    wave = math.sqrt(modulus / 1000.0)
    for _ in range(100):
        worlds.advance(5 * 4 * height / wave / 100)
        moved = (worlds[0].positions(0) - body.positions)[:, 2]
        sags.append([moved[mine].mean() for mine in chosen])
    sag = -np.mean(sags, axis=0)
    for a in range(2):
        expected = quad(lambda z: 1000.0 * G * (height - z) / modulus_at(z), layers[a], layers[a + 1])[0]
        assert sag[a + 1] - sag[a] == pytest.approx(expected, rel=0.05)


def test_mass_offset_moves_the_centre_of_rotation(box, options, similarity, cell):
    """The centre of mass moves by f d to 1e-9 of it and the mass stays; in free flight it goes straight on while the
    body turns about it: the middle of the shape circles on |f d|, within 1 % and the strain of the pellet's pull."""
    body = box(cells=(4, 4, 4), velocity=(0.3, 0.0, 0.2), spin=(0.0, 0.0, 12.0), youngs_modulus=2e6)
    setup = WorldSetup(bodies=(body,), gravity=NO_GRAVITY)
    loaded = effect("mass_offset", fraction=0.4, offset_x=cell, offset_y=0.0, offset_z=0.0)
    worlds = under(setup, [loaded], similarity, options)
    heavy = worlds[0].bodies[0]
    arm = np.array([0.4 * cell, 0.0, 0.0])
    assert np.abs(heavy.center_of_mass - body.center_of_mass - arm).max() < 1e-9 * cell
    assert heavy.masses.sum() == pytest.approx(body.masses.sum(), rel=1e-12)
    for _ in range(4):
        worlds.advance(0.05)
        t = worlds.time()
        straight = heavy.center_of_mass + t * np.array([0.3, 0.0, 0.2])
        assert np.abs(center(worlds) - straight).max() < 1e-4 * t
        c, s = math.cos(12.0 * t), math.sin(12.0 * t)
        middle = worlds[0].positions(0).mean(axis=0) - center(worlds)
        assert np.abs(middle + 0.4 * cell * np.array([c, s, 0.0])).max() < 0.01 * 0.4 * cell


@pytest.mark.slow
def test_plastic_yield_leaves_a_dent(box, options, similarity, cell):
    """A free bar, nu = 0, its ends flying at each other: the kinetic energy above what it can store goes into yielding,
    so the part e of its length that stays lost obeys K / (Y V) - Y / 2E < e < K / (Y V), within 5 % of K / (Y V).
    The elastic bar has all its length back."""
    height, modulus, yield_stress, rate = 12 * cell, 2e6, 1e4, 6.0
    body = box(cells=(4, 4, 12), youngs_modulus=modulus, poisson_ratio=0.0)
    setup = WorldSetup(bodies=(body,), gravity=NO_GRAVITY)
    strain = 1000.0 * rate**2 * height**2 / 24 / yield_stress
    lost = []
    for effects in ([effect("plastic_yield", yield_stress=yield_stress)], []):
        worlds = under(setup, effects, similarity, options)
        state = worlds.checkpoint()
        arms = body.positions[state["ids"], 2] - height / 2
        state["v"] = np.zeros_like(state["v"])
        state["v"][:, 2] = -rate * arms * worlds.cells.scale
        state["C"] = np.zeros_like(state["C"])
        state["C"][:, 2, 2] = -rate
        worlds.restore(state)
        z = body.positions[:, 2]
        top, bottom = z > height - cell / 2, z < cell / 2
        worlds.advance(0.1)
        lengths = []
        for _ in range(40):
            worlds.advance(0.002)
            now = worlds[0].positions(0)[:, 2]
            lengths.append(now[top].mean() - now[bottom].mean())
        lost.append(1 - float(np.mean(lengths)) / (height - cell / 2))
    assert strain - yield_stress / (2 * modulus) - 0.05 * strain < lost[0] < 1.05 * strain
    assert abs(lost[1]) < 0.05 * strain


@pytest.mark.slow
def test_sandy_lets_a_tower_collapse(box, options, similarity, cell):
    """It stands until its time, and is below 0.8 of its height half a second after: dry sand does not stand upright."""
    setup = WorldSetup(bodies=(box(cells=(4, 4, 8), youngs_modulus=2e5),), ground=Ground(friction=0.5))
    worlds = under(setup, [effect("sandy", start=0.1, friction_angle=0.4)], similarity, options)
    worlds.advance(0.1)
    assert worlds[0].positions(0)[:, 2].max() > 0.95 * 8 * cell
    worlds.advance(0.5)
    assert worlds[0].positions(0)[:, 2].max() < 0.8 * 8 * cell


# ---- contact ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.15, 0.5])
def test_friction_stops_a_sliding_body(box, options, similarity, friction):
    """a = -mu g within 3 %, as on a slope (test_mpm_contact)."""
    body = box(cells=(6, 6, 3), velocity=(2.0, 0.0, 0.0))
    setup = WorldSetup(bodies=(body,), ground=Ground(friction=0.9))
    worlds = under(setup, [effect("friction", friction=friction)], similarity, options)
    track = []
    for _ in range(14):
        worlds.advance(0.02)
        track.append((worlds.time(), mean_velocity(worlds)[0]))
    assert np.polyfit(*np.array(track).T, 1)[0] == pytest.approx(-friction * G, rel=0.03)


PULL, REACH = 30.0, 0.01


def sticking(box, similarity, options, *, normal, velocity=NO_GRAVITY, gravity=NO_GRAVITY, pull=PULL, **more) -> Worlds:
    """A box on a plane that holds on to it."""
    turned = np.eye(3) if normal[2] > 0 else np.diag([1.0, -1.0, -1.0])
    body = box(cells=(3, 3, 3), rotation=turned, velocity=velocity, **more)
    setup = WorldSetup(bodies=(body,), ground=Ground(normal=normal, friction=0.3), gravity=gravity)
    return under(setup, [effect("adhesion", pull_per_mass=pull, reach=REACH)], similarity, options)


def test_adhesion_takes_its_work_from_a_body_that_leaves(box, options, similarity):
    """v² - 2 p r is left, within two substeps of the pull; below sqrt(2 p r) a body does not come away."""
    threshold = math.sqrt(2 * PULL * REACH)
    worlds = sticking(box, similarity, options, normal=(0.0, 0.0, 1.0), velocity=(0.0, 0.0, 1.0))
    worlds.advance(0.1)
    assert mean_velocity(worlds)[2] == pytest.approx(math.sqrt(1 - threshold**2), abs=2 * STEP * PULL)
    slower = sticking(box, similarity, options, normal=(0.0, 0.0, 1.0), velocity=(0.0, 0.0, 0.9 * threshold))
    for _ in range(15):
        slower.advance(0.01)
        assert slower[0].ground_gap(0) < REACH


def test_adhesion_holds_a_body_under_a_ceiling(box, options, similarity, cell):
    """A pull above g holds it, within 0.02 cells of the ceiling; below g it falls, at g - p up to the reach and at g
    from there: after the time to the reach and 0.1 s, within two substeps of the pull."""
    ceiling = {"normal": (0.0, 0.0, -1.0), "gravity": (0.0, 0.0, -G)}
    held = sticking(box, similarity, options, pull=12.0, **ceiling)
    for _ in range(4):
        held.advance(0.1)
        assert abs(held[0].ground_gap(0)) < 0.02 * cell
    falling = sticking(box, similarity, options, pull=0.7 * G, **ceiling)
    slow = 0.3 * G
    falling.advance(math.sqrt(2 * REACH / slow) + 0.1)
    assert -mean_velocity(falling)[2] == pytest.approx(math.sqrt(2 * slow * REACH) + G * 0.1, abs=2 * STEP * 0.7 * G)


def test_adhesion_does_not_act_beyond_its_reach(box, options, similarity):
    """Free flight to the byte: a body that never comes near moves as one without adhesion."""
    worlds = sticking(box, similarity, options, normal=(0.0, 0.0, 1.0), bottom=(0.0, 0.0, 1.5 * REACH))
    worlds.advance(0.05)
    assert (mean_velocity(worlds) == 0.0).all()


def test_adhesion_makes_a_sliding_body_heavier(box, options, similarity):
    """It presses on the surface: the friction is mu (g + p), within 3 %."""
    body = box(cells=(6, 6, 3), velocity=(2.0, 0.0, 0.0))
    setup = WorldSetup(bodies=(body,), ground=Ground(friction=0.2))
    worlds = under(setup, [effect("adhesion", pull_per_mass=10.0, reach=0.02)], similarity, options)
    track = []
    for _ in range(14):
        worlds.advance(0.02)
        track.append((worlds.time(), mean_velocity(worlds)[0]))
    assert np.polyfit(*np.array(track).T, 1)[0] == pytest.approx(-0.2 * (G + 10.0), rel=0.03)


# ---- all together ----------------------------------------------------------------------------------------------------


def test_absent_effects_cost_nothing(box, options, similarity):
    """Without effects, and with those that need no means, the same kernel is compiled and the same arrays are made."""
    setup = WorldSetup(bodies=(box(cells=(3, 3, 3)),), ground=Ground())
    assert apply_effects(setup, []) is setup
    plain = under(setup, [], similarity, options)
    light = [
        effect("air_drag", drag_per_mass=0.3),
        effect("buoyancy", fraction=0.2),
        effect("gravity_tilt", angle=0.1, azimuth=0.0),
        effect("friction", friction=0.7),
        effect("adhesion", pull_per_mass=5.0, reach=0.01),
        effect("stiffness", factor=0.5),
        effect("stiffness_gradient", slope=0.5, direction_x=1.0, direction_y=0.0, direction_z=0.0),
    ]
    changed = under(setup, light, similarity, options)
    for worlds in (plain, changed):
        assert worlds[0].group._engine.laws == 1
        assert worlds[0].group._engine.worlds.mean_fields == 0
        assert worlds[0].group._engine.particles.names == plain[0].group._engine.particles.names
        assert worlds.device_bytes == plain.device_bytes
    for item in (effect("magnus", lift_per_mass=0.1), tether(10.0, 0.1, 1.0, 1.0)):
        worlds = under(setup, [item], similarity, options)
        assert worlds[0].group._engine.laws == 1
        assert worlds[0].group._engine.worlds.mean_fields == 1
        assert worlds.device_bytes == plain.device_bytes


def different_worlds(box) -> list[WorldSetup]:
    """Eight worlds: different drags, and half of them with more."""
    result = []
    for i in range(8):
        body = box(cells=(3, 3, 3), velocity=(0.5, 0.0, 0.8), spin=(0.0, 5.0, 0.0), youngs_modulus=1e5 * (1 + i % 3))
        setup = WorldSetup(bodies=(body,), ground=Ground())
        effects = [effect("air_drag", drag_per_mass=0.4 * i)]
        effects += [effect("adhesion", pull_per_mass=20.0, reach=0.005 * i)] if i % 2 else []
        effects += [effect("magnus", lift_per_mass=0.5)] if i % 4 == 2 else []
        effects += [tether(50.0 * i, 0.1, 0.4, float(i % 4 == 3))] if i % 4 > 1 else []
        result.append(apply_effects(setup, effects))
    return result


def seen(worlds: Worlds, world: int) -> bytes:
    view = worlds[world]
    return b"".join(f(0).tobytes() for f in (view.positions, view.velocities, view.deformation_gradients))


@pytest.mark.usefixtures("repeatable")
def test_worlds_with_different_effects_advance_as_alone(box, options, similarity):
    """Byte for byte, and after a restart in the middle too."""
    setups = different_worlds(box)
    together = Worlds(setups, similarity=similarity, options=options)
    together.advance(0.03)
    file = io.BytesIO()
    np.savez(file, **together.checkpoint())
    together.advance(0.03)
    resumed = Worlds(setups, similarity=similarity, options=options)
    file.seek(0)
    with np.load(file, allow_pickle=False) as stored:
        resumed.restore(stored)
    resumed.advance(0.03)
    ends = []
    for i, setup in enumerate(setups):
        alone = Worlds([setup], similarity=similarity, options=options)
        alone.advance(0.03)
        alone.advance(0.03)
        assert seen(alone, 0) == seen(together, i)
        assert seen(resumed, i) == seen(together, i)
        ends.append(seen(together, i))
    assert len(set(ends)) == len(ends), "the worlds should differ, or the test is too easy"


def test_named_bodies_alone_are_changed(box, options, similarity):
    """Of two bodies the named one feels the buoyancy; the other falls freely; contacts keep their table."""
    bodies = tuple(box(cells=(3, 3, 3), bottom=(0.4 * i, 0.0, 0.5), name=name) for i, name in enumerate("ab"))
    setup = WorldSetup(bodies=bodies, ground=Ground(friction=0.3))
    effects = [
        Effect(name="buoyancy", parameters=(("fraction", 1.0),), objects=("b",)),
        Effect(name="friction", parameters=(("friction", 0.8),), objects=("a",)),
    ]
    worlds = under(setup, effects, similarity, options)
    worlds.advance(0.1)
    assert worlds[0].velocities(0).mean(axis=0)[2] == pytest.approx(-G * 0.1, rel=1e-4)
    assert abs(worlds[0].velocities(1).mean(axis=0)[2]) < 1e-5
    changed = worlds[0].setup
    assert changed.contact("a", GROUND_NAME).friction == 0.8
    assert changed.contact("b", GROUND_NAME).friction == 0.3
    assert isinstance(changed.bodies[0].material, ElasticMaterial)
