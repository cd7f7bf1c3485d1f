# SPDX-License-Identifier: MIT
"""What a diagnosis found, put into a scene folder, and the two bakes around it."""

import dataclasses
import json
import math

import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.app.add_effect import (
    AddRequest,
    add_and_bake,
    found_effects,
    with_effects,
    without_effects,
)
from physgen.sim.effects.registry import effects
from physgen.sim.errors import Cancelled, InputError, SimulationError
from physgen.sim.events import ignore
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.model import Camera, Effect, SceneModel, SceneObject

POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, -0.6, 0.8, -1.0), (0.0, -0.8, -0.6, 1.0), (0.0, 0.0, 0.0, 1.0))
DRAG = {"air_drag": {"drag_per_mass": 0.041}}


def a_scene(*scene_effects):
    return SceneModel(
        camera=Camera(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, world_from_camera=POSE),
        objects=(
            SceneObject(name="cup", mesh="cup.stl", size_m=0.1),
            SceneObject(name="pen", mesh="cup.stl", size_m=1),
        ),
        effects=scene_effects,
    )


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "scene"
    root.mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(root / "cup.stl")
    for name in ("photo.png", "background.png"):
        (root / name).write_bytes(b"-")
    save_scene(root, a_scene())
    return root


def a_report(effect="air_drag", names=None, **parameters):
    entry = {
        "name": effect,
        "kind": "force",
        "parameters": {k: {"value": v, "unit": "1"} for k, v in parameters.items()},
    }
    return {"verdict": {"effect": effect, "effects": names}, "effects": [entry]}


def test_the_verdicts_numbers_are_read():
    assert found_effects(a_report(names=["air_drag"], drag_per_mass=0.041)) == DRAG
    # A report by another program need not list the effects.
    assert found_effects(a_report(drag_per_mass=0.041)) == DRAG


@pytest.mark.parametrize("effect", ["none", "unknown", None])
def test_no_finding_is_nothing_to_add(effect):
    with pytest.raises(InputError, match="no effect to add"):
        found_effects(a_report(effect))


@pytest.mark.parametrize("value", [None, "much", math.nan, True])
def test_values_that_are_not_numbers_are_named(value):
    with pytest.raises(InputError, match=r"air_drag\.drag_per_mass"):
        found_effects(a_report(drag_per_mass=value))


def test_an_effect_that_the_ranking_lacks_is_named():
    with pytest.raises(InputError, match="'wind' has no parameters"):
        found_effects(a_report(names=["air_drag", "wind"], drag_per_mass=0.041))


def test_a_new_effect_goes_last_and_an_old_one_keeps_place_and_objects():
    old = Effect(name="air_drag", parameters=(("drag_per_mass", 9.0),), objects=("cup",))
    buoyancy = Effect(name="buoyancy", parameters=(("fraction", 0.1),))
    changed = with_effects(a_scene(old, buoyancy), {"friction": {"friction": 0.2}, **DRAG})
    assert changed.effects == (
        Effect(name="air_drag", parameters=(("drag_per_mass", 0.041),), objects=("cup",)),
        buoyancy,
        Effect(name="friction", parameters=(("friction", 0.2),)),
    )
    assert without_effects(changed, ["air_drag", "friction"]).effects == (buoyancy,)


def test_two_of_the_same_name_become_one():
    twice = [Effect(name="air_drag", parameters=(("drag_per_mass", n),)) for n in (1.0, 2.0)]
    assert with_effects(a_scene(*twice), DRAG).effects == (
        Effect(name="air_drag", parameters=(("drag_per_mass", 0.041),)),
    )


@pytest.mark.parametrize("name", ["time_scale", "camera_pose"])
def test_observation_effects_are_refused(name):
    with pytest.raises(InputError, match="concerns how the recording was made"):
        with_effects(a_scene(), {name: effects()[name].defaults})


def test_out_of_range_is_refused_with_both_names(folder):
    before = (folder / "scene.json").read_bytes()
    with pytest.raises(InputError, match="effect 'air_drag': drag_per_mass is -1"):
        with_effects(load_scene(folder).model, {"air_drag": {"drag_per_mass": -1.0}})
    assert (folder / "scene.json").read_bytes() == before


@settings(max_examples=40, deadline=None)
@given(st.sampled_from([e for e in effects().values() if e.kind != "observation"]), st.data())
def test_every_effect_survives_the_file(effect, data):
    values = {
        p.name: float(round(v)) if p.whole else v
        for p in effect.parameters
        for v in [data.draw(st.floats(p.low, p.high, allow_nan=False))]
    }
    scene = with_effects(a_scene(), {effect.name: values})
    assert dict(scene.effects[0].parameters) == values
    assert with_effects(scene, {effect.name: values}) == scene


class Bakes:
    """Stands in for the bakes: remembers which effects the scene had, and fails when told to."""

    def __init__(self, *errors):
        self.errors = list(errors)
        self.seen = []

    def __call__(self, scene, out, on_event, cancelled):
        self.seen.append((out.name, [e.name for e in load_scene(scene.root).model.effects]))
        error = self.errors.pop(0) if self.errors else None
        if error is not None:
            raise error
        on_event({"event": "progress", "stage": "bake", "done": 1, "total": 1})
        return {"event": "done"}


def a_request(folder, **changes):
    request = {"found": DRAG, "before": folder.parent / "a", "after": folder.parent / "b"}
    return AddRequest(**{**request, "bake_before": True, **changes})


def test_before_is_baked_without_and_after_with_the_effect(folder):
    save_scene(folder, a_scene(Effect(name="air_drag", parameters=(("drag_per_mass", 9.0),))))
    bakes, events = Bakes(), []
    done = add_and_bake(load_scene(folder), request=a_request(folder), run_bake=bakes, on_event=events.append)
    assert bakes.seen == [("a", []), ("b", ["air_drag"])]
    folders = {"scene": folder, "before": folder.parent / "a", "after": folder.parent / "b"}
    assert done == {"event": "done", **{name: str(path) for name, path in folders.items()}}
    assert [e["stage"] for e in events] == ["bake before", "bake after"]
    effects_in_file = json.loads((folder / "scene.json").read_text())["effects"]
    assert effects_in_file == [{"name": "air_drag", "parameters": {"drag_per_mass": 0.041}}]


def test_a_bake_that_is_there_is_not_made_again(folder):
    bakes = Bakes()
    add_and_bake(load_scene(folder), request=a_request(folder, bake_before=False), run_bake=bakes, on_event=ignore)
    assert bakes.seen == [("b", ["air_drag"])]


@pytest.mark.parametrize("errors", [[SimulationError("no")], [Cancelled("no")], [None, SimulationError("no")]])
def test_a_failure_leaves_the_scene_as_it_was(folder, errors):
    before = load_scene(folder).model
    with pytest.raises((SimulationError, Cancelled)):
        add_and_bake(load_scene(folder), request=a_request(folder), run_bake=Bakes(*errors), on_event=ignore)
    assert load_scene(folder).model == before


def test_cancelling_the_second_bake_keeps_the_effect_so_that_it_can_go_on(folder):
    with pytest.raises(Cancelled):
        add_and_bake(
            load_scene(folder), request=a_request(folder), run_bake=Bakes(None, Cancelled("no")), on_event=ignore
        )
    assert [e.name for e in load_scene(folder).model.effects] == ["air_drag"]


def test_while_it_bakes_the_scene_is_whole_and_what_others_change_stays(folder):
    """Killed in the first bake, it left a scene without an effect of the user's; a correction meanwhile was lost."""
    own = a_scene(Effect(name="air_drag", parameters=(("drag_per_mass", 9.0),), objects=("cup",)))
    save_scene(folder, own)
    seen = []

    def bake(scene, out, on_event, cancelled):
        seen.append(load_scene(folder).model)
        if out.name == "b":
            save_scene(folder, dataclasses.replace(own, gravity=(0.0, 0.0, -1.62)))
        return {"event": "done"}

    add_and_bake(load_scene(folder), request=a_request(folder), run_bake=bake)
    assert seen == [own, own]
    found = load_scene(folder).model
    assert found.gravity == (0.0, 0.0, -1.62) and found.effects[0].objects == ("cup",)
    assert dict(found.effects[0].parameters) == DRAG["air_drag"]
