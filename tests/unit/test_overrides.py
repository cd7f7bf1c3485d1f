# SPDX-License-Identifier: MIT
"""``--set OBJECT.FIELD=VALUE``: what it changes, and what it says when it cannot."""

import dataclasses

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.app.reconstruct import Physics, set_all_physics, set_physics
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.overrides import apply_overrides, check_overrides


def changed(folder, *overrides):
    return apply_overrides(folder.model, overrides)


def test_fields_of_objects_materials_ground_and_scene(ball_scene):
    folder = ball_scene(count=2)
    scene = changed(
        folder,
        "ball0.preset=wood",
        "ball0.law=fixed_corotated",
        "ball0.material.density=600",
        "ball1.roughness = 0.25",
        "ball1.fill=false",
        "ball1.velocity=0,-1,2.5",
        'ball1.pins=[{"low": [0, 0, 0], "high": [1, 1, 1]}]',
        "ground.static_friction=0.6",
        "scene.gravity=0,0,-1.62",
    )
    wood = dataclasses.replace(load_preset("wood"), law="fixed_corotated", density=600.0)
    assert scene.objects[0].material == wood
    ball = scene.objects[1]
    assert (ball.roughness, ball.fill, ball.velocity, len(ball.pins)) == (0.25, False, (0.0, -1.0, 2.5), 1)
    assert (scene.ground.static_friction, scene.gravity) == (0.6, (0.0, 0.0, -1.62))
    assert changed(folder) is folder.model


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ball0", "give OBJECT.FIELD=VALUE"),
        ("ball0.density", "give OBJECT.FIELD=VALUE"),
        ("mug.density=1", "no object 'mug'; choose ball0, ground, scene"),
        ("ball0.colour=red", "no field 'colour'; known are role"),
        ("ball0.mesh=/etc/passwd", "no field 'mesh'"),
        ("scene.photo=x", "no field 'photo'; known are gravity"),
        ("ground.normal=0,0,1", "no field 'normal'"),
        ("ball0.density=-3", "material.density is -3"),
        ("ball0.density=heavy", "density: expected a number, found 'heavy'"),
        ("ball0.density=NaN", "density: expected a finite number"),
        ("ball0.poisson_ratio=0.5", r"poisson_ratio is 0\.5: give a number from 0 to 0\.49"),
        ("ball0.preset=unobtainium", "choose one of"),
        ("ball0.velocity=1,2", "velocity: expected 3 entries"),
    ],
)
def test_invalid_overrides_are_named(ball_scene, text, words):
    with pytest.raises(InputError, match=words):
        changed(ball_scene(), text)
    with pytest.raises(InputError):
        check_overrides(["ball0"], [text])


@given(st.text(max_size=40))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_garbage_is_an_input_error(ball_scene, text):
    scene = ball_scene().model
    for override in (text, f"ball0.{text}", f"ball0.friction={text}"):
        try:
            apply_overrides(scene, [override])
        except InputError as error:
            assert "--set" in str(error)


def test_the_same_command_gives_the_same_scene_whatever_ran_before(ball_scene):
    root = ball_scene().root
    first = set_all_physics(load_scene(root), Physics(presets=("soft",))).model
    more = [
        "ball0.friction=0.1",
        "ground.friction=0.9",
        "scene.gravity=0,0,-1",
        "ball0.density=77",
        "ball0.role=collider",
    ]
    assert (
        set_all_physics(load_scene(root), Physics(presets=("soft",), overrides=tuple(more)))
        .model.objects[0]
        .material.density
        == 77
    )
    assert set_all_physics(load_scene(root), Physics(presets=("soft",))).model == first == load_scene(root).model


def test_set_physics_keeps_what_it_is_not_told(ball_scene):
    root = ball_scene().root
    set_physics(load_scene(root), Physics(overrides=("ball0.friction=0.1",)))
    item = set_physics(load_scene(root), Physics(velocities=((1.0, 0.0, 0.0),))).model.objects[0]
    assert (item.friction, item.velocity, item.material.preset) == (0.1, (1.0, 0.0, 0.0), "soft")
