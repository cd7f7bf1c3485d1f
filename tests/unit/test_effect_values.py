# SPDX-License-Identifier: MIT
"""Numbers of single effects: forces, contact, material, mass and observation, against closed forms."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.constitutive import (
    SandMaterial,
    VonMisesMaterial,
)
from physgen.sim.effects.camera_pose import true_camera
from physgen.sim.effects.mass_offset import pellet_width
from physgen.sim.effects.registry import effect
from physgen.sim.effects.stiffness import youngs_modulus
from physgen.sim.effects.time_scale import true_times
from physgen.sim.errors import InputError
from physgen.sim.mpm.bodies import BodyForces
from physgen.sim.mpm.colliders import Collider
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import GROUND_NAME
from scipy.spatial.transform import Rotation

from .effect_worlds import BOX, JELLY, SOLID, body, die, put, rich_world, world

# ---- forces ---------------------------------------------------------------------------------------------------------


def test_drag_adds_up_against_one_air():
    setup = put(world(body()), "air_drag", drag_per_mass=0.1)
    setup = put(setup, "wind", drag_per_mass=0.2, wind_x=3.0, wind_z=-1.0)
    setup = put(setup, "wind", drag_per_mass=0.0, wind_x=1.0, wind_y=2.0)
    setup = put(setup, "wind", drag_per_mass=0.0, wind_x=0.0, wind_y=0.5, wind_z=4.0)
    forces = setup.bodies[0].forces
    assert forces.drag == pytest.approx(0.3) and forces.wind == (4.0, 2.5, 3.0)


def test_forces_of_a_kind_add_up():
    setup = world()
    for fraction in (0.25, 0.5):
        setup = put(setup, "buoyancy", fraction=fraction)
        setup = put(setup, "magnus", bodies=("die",), lift_per_mass=fraction)
    assert [b.forces.gravity_factor for b in setup.bodies] == [0.25, 0.25]
    assert [b.forces.lift for b in setup.bodies] == [0.0, 0.75]


def test_too_much_of_a_force_names_effect_and_body():
    setup = put(world(), "magnus", lift_per_mass=9.0)
    with pytest.raises(InputError, match="'magnus': body 'jelly': force lift is 18"):
        put(setup, "magnus", lift_per_mass=9.0)


def test_gravity_leans_towards_the_azimuth():
    x, y, z = put(world(), "gravity_tilt", angle=0.033124427509456635, azimuth=1.071651346925354).gravity
    g, angle, azimuth = 9.81, 0.033124427509456635, 1.071651346925354
    expected = (g * math.sin(angle) * math.cos(azimuth), g * math.sin(angle) * math.sin(azimuth), -g * math.cos(angle))
    np.testing.assert_allclose((x, y, z), expected, rtol=1e-12)


@given(angle=st.floats(0, math.pi), azimuth=st.floats(-math.pi, math.pi))
def test_gravity_keeps_its_strength_at_any_time(angle, azimuth):
    setup = rich_world()
    after = put(setup, "gravity_tilt", angle=angle, azimuth=azimuth)
    turn = Rotation.from_rotvec(angle * np.array([math.sin(azimuth), -math.cos(azimuth), 0.0]))
    for time in (0.0, 0.3, 2.0):
        np.testing.assert_allclose(after.gravity_at(time), turn.apply(setup.gravity_at(time)), atol=1e-12)


def test_a_body_has_one_tether():
    setup = put(world(), "tether", bodies=("die",), stiffness_per_mass=2.0, anchor_x=1.0, string=0.0)
    forces = setup.bodies[1].forces
    assert (forces.tether_stiffness, forces.tether_length, forces.tether_anchor) == (2.0, 0.3, (1.0, 0.0, 1.0))
    assert not forces.tether_string and setup.bodies[0].forces == BodyForces()
    with pytest.raises(InputError, match="'tether': body 'die': has a tether already"):
        put(setup, "tether")


# ---- contact --------------------------------------------------------------------------------------------------------


def test_friction_of_two_out_of_three():
    setup = put(world(body(), body("other"), die()), "friction", bodies=("die", "other"), friction=0.6)
    found = {pair: setup.contact(*pair).friction for pair in [(n, GROUND_NAME) for n in ("jelly", "other", "die")]}
    assert list(found.values()) == [0.3, 0.6, 0.6]
    assert setup.contact("jelly", "other").friction == setup.contact("die", "other").friction == 0.6


def test_friction_of_all_and_of_one():
    setup = world(body(), body("other"), colliders=(Collider(name="table", surface=BOX),))
    everywhere = put(setup, "friction", friction=0.6)
    for pair in (("jelly", GROUND_NAME), ("other", GROUND_NAME), ("jelly", "table"), ("jelly", "other")):
        assert everywhere.contact(*pair).friction == 0.6
    assert everywhere.contact("jelly", GROUND_NAME).static_friction == pytest.approx(0.9)
    assert everywhere.ground.friction == 0.6 and not everywhere.contacts.pairs
    one = put(setup, "friction", bodies=("jelly",), friction=0.6)
    for pair in (("jelly", GROUND_NAME), ("jelly", "table"), ("other", "jelly")):
        assert one.contact(*pair).friction == 0.6
    for pair in (("other", GROUND_NAME), ("other", "table")):
        assert one.contact(*pair) == setup.contact(*pair)
    assert put(one, "friction", friction=0.1).contact("jelly", GROUND_NAME).friction == 0.1


@given(believed=st.floats(0, 10), ratio=st.floats(1, 100), friction=st.floats(0, 10))
def test_a_static_coefficient_stays_above_the_kinetic_one(believed, ratio, friction):
    ground = Ground(friction=believed, static_friction=max(believed, min(10.0, believed * ratio)))
    contact = put(world(ground=ground), "friction", friction=friction).contact("jelly", GROUND_NAME)
    assert contact.friction == friction <= contact.sticking <= 10


def test_contacts_of_rigid_bodies_only():
    setup = put(put(world(), "restitution", restitution=0.9), "rolling_resistance", lever_arm=0.01)
    setup = put(setup, "rolling_resistance", lever_arm=0.02)
    contact = setup.contact("die", GROUND_NAME)
    assert contact.restitution == 0.9 and contact.rolling_resistance == pytest.approx(0.03)
    assert contact.friction == 0.3 and contact.static_friction == 0.45
    assert setup.contact("jelly", GROUND_NAME) == world().contact("jelly", GROUND_NAME)


def test_rolling_resistance_of_the_only_body_is_on_the_ground():
    assert (
        put(world(die()), "rolling_resistance", lever_arm=0.01).contact("die", GROUND_NAME).rolling_resistance == 0.01
    )


def test_adhesion_adds_up_within_one_reach():
    setup = put(put(world(), "adhesion", pull_per_mass=30.0), "adhesion", bodies=("die",), pull_per_mass=4.0)
    assert setup.contact("die", GROUND_NAME).adhesion == 34.0
    assert setup.contact("jelly", GROUND_NAME).adhesion == 30.0
    assert setup.contact("die", GROUND_NAME).adhesion_reach == 0.005
    with pytest.raises(InputError, match=r"'adhesion': reach is 0.01: .* within 0.005 m already"):
        put(setup, "adhesion", reach=0.01)


# ---- material -------------------------------------------------------------------------------------------------------


def test_stiffness_multiplies_and_knows_its_value():
    setup = put(put(world(), "stiffness", factor=0.5), "stiffness", factor=4.0)
    jelly, rigid = setup.bodies
    assert jelly.material == dataclasses.replace(JELLY, youngs_modulus=2e5) and rigid.material == die().material
    assert youngs_modulus(body(), 2.0) == 2e5
    with pytest.raises(InputError, match="'die'"):
        youngs_modulus(die(), 2.0)


def test_damping_adds_up():
    assert put(world(), "internal_damping", damping_time=2e-4).bodies[0].material.damping_time == pytest.approx(3e-4)


def test_yielding_keeps_everything_else():
    fibred = put(world(), "anisotropy", fibre_modulus=3e4, axis_z=0.0, axis_y=0.5)
    material = put(fibred, "plastic_yield", yield_stress=2e3).bodies[0].material
    assert isinstance(material, VonMisesMaterial) and material.yield_stress == 2e3
    assert dataclasses.asdict(material) == {**dataclasses.asdict(fibred.bodies[0].material), "yield_stress": 2e3}
    other_way = put(
        put(world(), "plastic_yield", yield_stress=2e3), "anisotropy", fibre_modulus=3e4, axis_z=0, axis_y=1
    )
    assert other_way.bodies[0].material == material


def test_fibres_have_one_axis():
    setup = put(world(), "anisotropy", fibre_modulus=3e4, axis_x=1.0)
    material = setup.bodies[0].material
    np.testing.assert_allclose(material.fibre_axis, np.array([1, 0, 1]) / math.sqrt(2))
    again = put(setup, "anisotropy", fibre_modulus=1e4, axis_x=-0.5, axis_z=-0.5)
    assert again.bodies[0].material.fibre_modulus == 4e4
    with pytest.raises(InputError, match=r"axis is .* along .* already"):
        put(setup, "anisotropy")


def test_stiffness_goes_from_one_end_to_the_other():
    setup = world(body())
    after = put(setup, "stiffness_gradient", slope=0.5, direction_z=0.0, direction_x=-0.2).bodies[0]
    x = setup.bodies[0].positions[:, 0]
    np.testing.assert_allclose(after.stiffness_scale, 1 - 0.5 * (x - 0.325) / 0.025, rtol=1e-12)
    twice = put(put(setup, "stiffness_gradient", slope=0.5), "stiffness_gradient", slope=-0.5).bodies[0]
    s = (setup.bodies[0].positions[:, 2] - 0.115) / 0.015
    np.testing.assert_allclose(twice.stiffness_scale, 1 - 0.25 * s**2, rtol=1e-12)


def test_a_gradient_leaves_the_fluid_in_a_body_alone():
    before = rich_world().bodies[2]
    after = put(rich_world(), "stiffness_gradient", direction_x=1.0).bodies[2]
    fluid = before.material_index == 1
    np.testing.assert_array_equal(after.stiffness_scale[fluid], before.stiffness_scale[fluid])
    assert (after.stiffness_scale[~fluid] != before.stiffness_scale[~fluid]).any()


def test_sand_comes_with_the_mass_and_the_moduli_of_the_body():
    setup = put(world(), "sandy", start=2.0, friction_angle=0.5)
    setup = put(setup, "sandy", start=1.0, friction_angle=0.7)
    after = setup.bodies[0]
    assert after.material_track == ((1.0, 2), (2.0, 1))
    assert after.materials == (SandMaterial(**SOLID, friction_angle=0.5), SandMaterial(**SOLID, friction_angle=0.7))
    assert after.material == JELLY and after.masses.tobytes() == body().masses.tobytes()
    same_time = put(setup, "sandy", start=1.0, friction_angle=0.9).bodies[0]
    assert same_time.material_track == ((1.0, 3), (2.0, 1))
    assert put(rich_world(), "sandy", start=1.0).bodies[2].material_track == ((1.0, 3), (3.0, 1))


@pytest.mark.parametrize(
    "track", [((-1.0, 0),), ((1.0, 0), (1.0, 0)), ((2.0, 0), (1.0, 0)), ((math.nan, 0),), ((1.0, 1),), ((1.0, -1),)]
)
def test_a_bad_material_track_is_an_input_error(track):
    with pytest.raises(InputError, match="'jelly': material_track"):
        body(material_track=track)
    with pytest.raises(InputError, match="materials"):
        die(material_track=((1.0, 0),))


# ---- mass -----------------------------------------------------------------------------------------------------------


@given(
    fraction=st.floats(1e-6, 0.9),
    x=st.floats(-0.019, 0.019),
    y=st.floats(-0.014, 0.014),
    z=st.floats(-0.009, 0.009),
)
@settings(deadline=None)
def test_a_pellet_moves_the_centre_of_mass_exactly(fraction, x, y, z):
    before = rich_world().bodies[2]
    before = dataclasses.replace(before, density_scale=None, material_index=None)
    setup = put(world(before), "mass_offset", fraction=fraction, offset_x=x, offset_y=y, offset_z=z)
    after = setup.bodies[0]
    np.testing.assert_allclose(
        after.center_of_mass, before.center_of_mass + fraction * np.array([x, y, z]), rtol=0, atol=1e-9
    )
    assert after.masses.sum() == pytest.approx(before.masses.sum(), rel=1e-12) and (after.density_scale > 0).all()
    assert after.material == before.material


def test_a_pellet_has_the_inertia_of_a_pellet():
    before = body(cells=(10, 10, 10))
    offset = np.array([0.01, -0.02, 0.03])
    after = put(world(before), "mass_offset", fraction=0.2, offset_x=0.01, offset_y=-0.02, offset_z=0.03).bodies[0]

    def second(b, about):
        r = b.positions - about
        return r.T @ (b.masses[:, None] * r)

    mass, center = before.masses.sum(), before.center_of_mass
    pellet = 0.8 * second(before, center) + 0.2 * mass * np.outer(offset, offset)
    extra = second(after, center) - pellet
    np.testing.assert_allclose(
        extra, 0.2 * mass * pellet_width(before, 0.2) ** 2 * np.eye(3), atol=0.003 * np.trace(pellet)
    )
    # A moment of inertia is two of the second moments: within two percent of that with a point of mass.
    assert np.trace(extra) / np.trace(pellet) < 0.02


def test_uneven_bodies_take_pellets_too():
    before = rich_world().bodies[2]
    after = put(world(before), "mass_offset", fraction=0.3, offset_x=0.01, offset_z=0.0).bodies[0]
    np.testing.assert_allclose(after.center_of_mass, before.center_of_mass + np.array([0.003, 0, 0]), atol=1e-12)


def test_factors_on_the_inertia_multiply():
    setup = put(put(world(), "inertia", bodies=("die",), factor=1.5), "inertia", factor=0.8)
    assert setup.bodies[1].inertia_factor == pytest.approx(1.2)
    np.testing.assert_array_equal(setup.bodies[1].masses, die().masses)
    with pytest.raises(InputError, match=r"inertia_factor.*deforms"):
        body(inertia_factor=1.2)
    with pytest.raises(InputError, match=r"inertia_factor.*above 0"):
        die(inertia_factor=0.0)


# ---- observation ----------------------------------------------------------------------------------------------------


def test_a_fast_clock_makes_gravity_strong():
    times = np.linspace(0.5, 1.5, 5)
    true = true_times({"rate": 1.2}, times)
    np.testing.assert_allclose(true, 0.5 + 1.2 * (times - 0.5))
    fall = -0.5 * 9.81 * (true - 0.5) ** 2
    assert 2 * np.polyfit(times, fall, 2)[0] == pytest.approx(-9.81 * 1.2**2)
    assert true_times({"rate": 1.0}, times).tobytes() == times.tobytes()
    assert true_times({"rate": 2.0}, times, first=0.0)[0] == 1.0
    with pytest.raises(InputError, match="rate"):
        true_times({"rate": -1.0}, times)


def test_a_moved_camera():
    believed = np.eye(4)
    believed[:3, :3] = Rotation.from_euler("xyz", (-1.9, 0.2, 0.1)).as_matrix()
    believed[:3, 3] = (0.3, -2.0, 1.0)
    neutral = effect("camera_pose").neutral_values(world())
    assert true_camera(neutral, believed).tobytes() == believed.tobytes()
    values = {**neutral, "rotation_z": math.pi / 2, "shift_x": 0.5}
    moved = true_camera(values, believed, pivot=(0.0, -1.0, 0.0))
    np.testing.assert_allclose(moved[:3, 3], (1.5, -0.7, 1.0), atol=1e-12)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(
        moved[:3, 2], Rotation.from_rotvec((0, 0, math.pi / 2)).apply(believed[:3, 2]), atol=1e-12
    )
