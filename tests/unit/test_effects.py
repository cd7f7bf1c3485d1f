# SPDX-License-Identifier: MIT
"""Effects: each documents itself, leaves its input alone, does nothing at its neutral values, and what it computes."""

import ast
import json
import math
import re
from itertools import permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.constitutive import (
    FluidMaterial,
    RigidMaterial,
    SandMaterial,
    SnowMaterial,
    VonMisesMaterial,
)
from physgen.sim.effects.registry import KINDS, apply_effects, effect, effect_to_json, effects
from physgen.sim.effects.schema import SECTIONS
from physgen.sim.errors import InputError
from physgen.sim.mpm.surface_contact import GROUND_NAME
from physgen.sim.scene.model import Effect as SceneEffect

from .effect_worlds import (
    JELLY,
    NAMES,
    NO_NEUTRAL,
    ROOT,
    SOLID,
    VOCABULARY,
    body,
    close,
    die,
    good_values,
    put,
    rich_world,
    same,
    world,
)

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
        ("inertia", ["elastic", "clay", "snow", "sand", "fluid"]),
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
