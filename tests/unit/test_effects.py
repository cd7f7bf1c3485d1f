# SPDX-License-Identifier: MIT
"""Effects: each documents itself, leaves its input alone, does nothing at its neutral values, and what it computes."""

import ast
import dataclasses
import json
import math
import re
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.constitutive import (
    ElasticMaterial,
    FluidMaterial,
    NeoHookeanMaterial,
    RigidMaterial,
    SandMaterial,
    SnowMaterial,
    VonMisesMaterial,
)
from physgen.sim.effects.camera_pose import true_camera
from physgen.sim.effects.mass_offset import pellet_width
from physgen.sim.effects.registry import KINDS, apply_effects, effect, effect_to_json, effects
from physgen.sim.effects.schema import SECTIONS
from physgen.sim.effects.stiffness import youngs_modulus
from physgen.sim.effects.time_scale import true_times
from physgen.sim.errors import InputError
from physgen.sim.mpm.bodies import BodyForces, BodyParticles
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.solver_options import Ground
from physgen.sim.mpm.surface_contact import GROUND_NAME, ContactTable, SurfaceContact
from physgen.sim.mpm.world_setup import WorldSetup
from physgen.sim.scene.model import Effect as SceneEffect
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
VOCABULARY = {
    "force": ("air_drag", "wind", "magnus", "buoyancy", "gravity_tilt", "tether"),
    "contact": ("friction", "restitution", "rolling_resistance", "adhesion"),
    "material": ("stiffness", "internal_damping", "plastic_yield", "anisotropy", "stiffness_gradient", "sandy"),
    "mass": ("mass_offset",),
    "observation": ("time_scale", "camera_pose"),
}
NAMES = [name for names in VOCABULARY.values() for name in names]
NO_NEUTRAL = ("plastic_yield", "sandy")
SOLID = {"density": 800.0, "youngs_modulus": 1e5, "poisson_ratio": 0.3}
JELLY = ElasticMaterial(**SOLID, damping_time=1e-4)
BOX = Surface(
    vertices=np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]),
    faces=np.array([[0, 1, 2]]),
)


def body(name="jelly", material=JELLY, *, cells=(5, 4, 3), **changes):
    """A block with 1 cm a particle, its corner at (0.3, 0, 0.1)."""
    axes = [0.01 * (np.arange(n) + 0.5) for n in cells]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + np.array([0.3, 0.0, 0.1])
    surface = BOX if isinstance(material, RigidMaterial) else None
    volumes = np.full(len(positions), 1e-6)
    return BodyParticles(
        **{
            "name": name,
            "positions": positions,
            "volumes": volumes,
            "material": material,
            "surface": surface,
            **changes,
        }
    )


def die(name="die", **changes):
    return body(name, RigidMaterial(density=1200.0), **changes)


def world(*bodies, **changes):
    ground = Ground(friction=0.3, static_friction=0.45, restitution=0.2)
    return WorldSetup(**{"bodies": bodies or (body(), die()), "ground": ground, **changes})


def rich_world():
    """Something of everything, so that whatever an effect might touch is there to be touched."""
    mixed = body(
        "mixed",
        materials=(FluidMaterial(density=1000.0, bulk_modulus=1e5, viscosity=0.0), NeoHookeanMaterial(**SOLID)),
        material_index=np.arange(60) % 3,
        density_scale=np.linspace(0.5, 2.0, 60),
        stiffness_scale=np.linspace(0.8, 1.2, 60),
        material_track=((3.0, 1),),
        forces=BodyForces(drag=0.01, wind=(1.0, 0.0, 0.0), lift=0.1, gravity_factor=0.9),
    )
    return world(
        body(),
        die(),
        mixed,
        gravity_track=Track(times=np.array([0.0, 1.0]), values=np.array([[0.0, 0.0, -9.81], [1.0, 0.0, -5.0]])),
        colliders=(Collider(name="table", surface=BOX),),
        contacts=ContactTable().with_pair("jelly", "table", SurfaceContact(friction=0.7, static_friction=0.9)),
    )


def same(a, b):
    """Whether two values are equal to the last bit, dataclasses by their fields."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


def close(a, b):
    """The same within rounding."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(close(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(close(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray | float):
        return np.allclose(a, b, rtol=1e-9, atol=1e-15)
    return a == b


def good_values(item):
    """Values in range: hypothesis draws them."""
    drawn = {}
    for parameter in item.parameters:
        numbers = st.floats(parameter.low, parameter.high)
        drawn[parameter.name] = st.sampled_from([0.0, 1.0]) if parameter.whole else numbers
    return st.fixed_dictionaries(drawn)


def put(setup, name, bodies=None, **changes):
    return effect(name).apply(setup, {**effect(name).defaults, **changes}, bodies=bodies)


# ---- the registry ---------------------------------------------------------------------------------------------------


def test_every_name_of_the_vocabulary_is_there_in_its_kind():
    assert list(effects()) == NAMES
    assert {kind: tuple(n for n, e in effects().items() if e.kind == kind) for kind in KINDS} == VOCABULARY


@pytest.mark.parametrize("name", NAMES)
def test_every_effect_documents_itself(name):
    item = effect(name)
    path = ROOT / "sim" / "effects" / f"{name}.py"
    assert item.description == ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")), clean=False)
    assert len(item.summary) > 15 and all(len(item.section(title)) > 3 for title in SECTIONS)
    assert item.section("Equation").count("Source:") == 0
    names = [parameter.name for parameter in item.parameters]
    assert names and len(set(names)) == len(names) and set(item.neutral) <= set(names)
    for parameter in item.parameters:
        assert re.fullmatch(r"[a-z_]+", parameter.name) and parameter.unit and parameter.description
        assert parameter.low < parameter.high and parameter.check(parameter.default) == parameter.default
    json.dumps(effect_to_json(item), allow_nan=False)


@pytest.mark.parametrize("name", NAMES)
def test_every_effect_is_in_the_documentation(name):
    text = (ROOT / "docs" / "simulation.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
    assert len(rows) == 1 and all(f"`{p.name}`" in rows[0] for p in effect(name).parameters)


def test_every_effect_file_is_registered():
    helpers = {"__init__", "schema", "setup_changes", "registry"}
    assert {path.stem for path in (ROOT / "sim" / "effects").glob("*.py")} - helpers == set(NAMES)


def test_no_effect_imports_taichi():
    for path in (ROOT / "sim" / "effects").glob("*.py"):
        assert "taichi" not in path.read_text(encoding="utf-8").lower().replace("no taichi", ""), path


# ---- what holds for all ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in NAMES if n not in NO_NEUTRAL])
@pytest.mark.parametrize("make", [lambda: world(body()), lambda: world(die()), world, rich_world])
def test_the_neutral_values_change_nothing(name, make):
    setup = make()
    item = effect(name)
    try:
        neutral = item.neutral_values(setup)
        result = item.apply(setup, neutral)
    except InputError as error:
        assert "no body" in str(error)
        return
    if item.current is None:
        assert result is setup
    elif len(setup.bodies) == 1:
        assert same(result, setup)


@pytest.mark.parametrize("name", NO_NEUTRAL)
def test_effects_without_a_neutral_value_say_so(name):
    assert effect(name).neutral_values(world()) is None


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@settings(max_examples=15, deadline=None)
def test_applying_leaves_the_input_alone(name, data):
    item = effect(name)
    setup, before = rich_world(), rich_world()
    bodies = data.draw(st.none() | st.sampled_from([("jelly",), ("die",), ("mixed", "jelly")]))
    values = data.draw(good_values(item))
    given_values = dict(values)
    try:
        result = item.apply(setup, values, bodies=bodies)
        again = item.apply(setup, values, bodies=bodies)
    except InputError as error:
        assert repr(name) in str(error)
    else:
        assert same(result, again)
    assert same(setup, before) and values == given_values


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_any_effects_together_give_a_world_or_a_reason(data):
    setup = world(body(), body("other"), die())
    chosen = data.draw(st.lists(st.sampled_from(NAMES), max_size=5))
    listed = [SceneEffect(name=n, parameters=tuple(data.draw(good_values(effect(n))).items())) for n in chosen]
    try:
        result = apply_effects(setup, listed)
    except InputError as error:
        assert re.match(r"effects\[\d\]: effect '", str(error))
    else:
        assert [b.name for b in result.bodies] == ["jelly", "other", "die"]
        for before, after in zip(setup.bodies, result.bodies, strict=True):
            assert after.masses.sum() == pytest.approx(before.masses.sum(), rel=1e-12)
            assert (after.masses > 0).all()


def test_no_effects_cost_nothing():
    setup = world()
    assert apply_effects(setup, ()) is setup


def test_observations_leave_the_world_as_it_is():
    setup = world()
    for name in VOCABULARY["observation"]:
        assert put(setup, name) is setup


@pytest.mark.parametrize("order", list(permutations(range(4)))[::5])
def test_effects_compose_in_any_order(order):
    setup = rich_world()
    listed = [
        SceneEffect(name="air_drag", parameters=(("drag_per_mass", 0.2),), objects=("mixed",)),
        SceneEffect(name="wind", parameters=tuple({**effect("wind").defaults, "wind_y": 2.0}.items())),
        SceneEffect(name="stiffness", parameters=(("factor", 3.0),)),
        SceneEffect(name="sandy", parameters=(("start", 1.0), ("friction_angle", 0.5)), objects=("mixed", "jelly")),
    ]
    assert close(apply_effects(setup, [listed[i] for i in order]), apply_effects(setup, listed))


# ---- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (SceneEffect(name="gravitation"), r"effects\[0\].*'gravitation'.*choose.*gravity_tilt"),
        (SceneEffect(name="magnus"), "magnus.*'lift_per_mass' is missing.*0.01"),
        (SceneEffect(name="magnus", parameters=(("lift", 1.0), ("lift_per_mass", 1.0))), "'lift' is unknown.*lift_per"),
        (SceneEffect(name="magnus", parameters=(("lift_per_mass", 11.0),)), "lift_per_mass is 11.0: give -10 to 10"),
        (SceneEffect(name="magnus", parameters=(("lift_per_mass", math.nan),)), "lift_per_mass is nan"),
        (SceneEffect(name="magnus", parameters=(("lift_per_mass", True),)), "lift_per_mass is True"),
        (SceneEffect(name="magnus", parameters=(("lift_per_mass", 1.0), ("lift_per_mass", 2.0))), "twice"),
        (SceneEffect(name="air_drag", parameters=(("drag_per_mass", 1.0),), objects=("cup",)), "'cup'.*'jelly', 'die'"),
        (SceneEffect(name="air_drag", parameters=(("drag_per_mass", -1.0),)), "0 to 100 1/m"),
        (SceneEffect(name="gravity_tilt", parameters=(("angle", 0.1), ("azimuth", 0.0)), objects=("die",)), "whole"),
        (
            SceneEffect(name="internal_damping", parameters=(("damping_time", 0.1),), objects=("die",)),
            "'internal_damping': body 'die' is rigid.*give it a material",
        ),
        (
            SceneEffect(name="rolling_resistance", parameters=(("lever_arm", 0.1),), objects=("jelly",)),
            "'rolling_resistance': body 'jelly' deforms.*internal_damping",
        ),
        (SceneEffect(name="sandy", parameters=(("start", 0.1), ("friction_angle", 0.5)), objects=("die",)), "rigid"),
        (
            SceneEffect(name="anisotropy", parameters=tuple({**effect("anisotropy").defaults, "axis_z": 0.0}.items())),
            "axis is .*direction",
        ),
        (
            SceneEffect(name="tether", parameters=tuple({**effect("tether").defaults, "string": 0.5}.items())),
            "string is 0.5: give a whole number",
        ),
        (
            SceneEffect(
                name="mass_offset", parameters=tuple({**effect("mass_offset").defaults, "offset_x": 0.04}.items())
            ),
            r"'jelly': offset is \(0.04, .*give at most 0\.\d+ times",
        ),
    ],
)  # fmt: skip
def test_bad_effects_are_named_with_their_remedy(item, words):
    with pytest.raises(InputError, match=words):
        apply_effects(world(), [item])


def test_an_effect_for_all_needs_somebody_to_act_on():
    with pytest.raises(InputError, match=r"'restitution': there is no body.*'jelly' deforms"):
        put(world(body()), "restitution")
    with pytest.raises(InputError, match=r"'stiffness': there is no body.*'die' is rigid"):
        put(world(die()), "stiffness")
    with pytest.raises(InputError, match="bodies is empty"):
        put(world(), "air_drag", bodies=())


@pytest.mark.parametrize(
    ("name", "refused"),
    [
        ("stiffness", ["fluid", "rigid"]),
        ("stiffness_gradient", ["fluid", "rigid"]),
        ("sandy", ["fluid", "rigid"]),
        ("internal_damping", ["sand", "fluid", "rigid"]),
        ("plastic_yield", ["snow", "sand", "fluid", "rigid"]),
        ("anisotropy", ["snow", "sand", "fluid", "rigid"]),
        ("restitution", ["elastic", "clay", "snow", "sand", "fluid"]),
        ("rolling_resistance", ["elastic", "clay", "snow", "sand", "fluid"]),
        ("friction", []),
        ("adhesion", []),
        ("mass_offset", []),
        ("tether", []),
    ],
)
def test_effects_refuse_bodies_they_do_not_apply_to(name, refused):
    matter = {
        "elastic": JELLY,
        "clay": VonMisesMaterial(**SOLID, yield_stress=1e3),
        "snow": SnowMaterial(**SOLID),
        "sand": SandMaterial(**SOLID, friction_angle=0.5),
        "fluid": FluidMaterial(density=1000.0, bulk_modulus=1e5, viscosity=0.0),
        "rigid": RigidMaterial(density=1000.0),
    }
    setup = world(*(body(kind, material) for kind, material in matter.items()))
    for kind in matter:
        if kind in refused:
            with pytest.raises(InputError, match=f"body '{kind}'"):
                put(setup, name, bodies=(kind,))
        else:
            put(setup, name, bodies=(kind,))
    result = put(setup, name)
    for before, after in zip(setup.bodies, result.bodies, strict=True):
        if before.name in refused:
            assert same(after, before)
            assert result.contact(before.name, GROUND_NAME) == setup.contact(before.name, GROUND_NAME)


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
