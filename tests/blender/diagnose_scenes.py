# SPDX-License-Identifier: GPL-3.0-or-later
"""A box that is thrown, for the tests of the Diagnose panel: captures, a made-up diagnosis, and what Blender shows."""

import numpy as np
import pytest
import trimesh

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.playback.geometry_nodes import COLOUR
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.capture_folder import save_capture
from physgen.sim.diagnose.diagnosis import (
    Diagnosis,
    Gap,
    Localisation,
    ObjectShare,
    RankedEffect,
    TrialArrays,
    Verdict,
    write_diagnosis,
)
from physgen.sim.diagnose.fits import Estimate

RATE = 50.0
FRAMES = 12
REST = trimesh.creation.box((0.1, 0.06, 0.04))
TRACKED = np.asarray(REST.vertices)
NOMINAL_OFF, FOUND_OFF = np.array([0.05, 0.0, 0.0]), np.array([0.0, 0.001, 0.0])
"""How far the models of the made-up diagnosis are from the truth."""
LOOK = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -2.0), (0.0, -1.0, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0))


def pose(times):
    """A throw with spin about z: rotations (T, 3, 3) and places (T, 3)."""
    c, s, o = np.cos(3 * times), np.sin(3 * times), np.zeros_like(times)
    turns = np.stack([np.stack([c, -s, o], 1), np.stack([s, c, o], 1), np.stack([o, o, o + 1], 1)], axis=1)
    return turns, np.stack([times, 0.2 * times, 0.5 + times - 4.9 * times**2], axis=1)


def moved(times, points=TRACKED):
    turns, places = pose(times)
    return np.einsum("tij,kj->tki", turns, points) + places[:, None]


def a_trial(name, times, *, points=None, role="fit", predict=None, pixels=None):
    count = len(TRACKED)
    return Trial(
        name=name,
        role=role,
        times=times,
        points=None if pixels is not None else (moved(times) if points is None else points),
        pixels=pixels,
        object_index=np.zeros(count, dtype=np.int64),
        rest_points=TRACKED,
        predict_times=predict,
    )


def a_capture(*trials, rigid=True, camera=None):
    belief = ObjectBelief(
        name="box",
        mesh="box.obj",
        density_kg_m3=500.0,
        stiffness="hard" if rigid else "soft",
        youngs_modulus_pa=None if rigid else 1e5,
    )
    body = CaptureObject(belief=belief, vertices=np.asarray(REST.vertices), faces=np.asarray(REST.faces))
    return Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(),
        objects=(body,),
        noise_sigma=0.001,
        camera=camera,
        trials=trials,
    )


def times(count=FRAMES, start=0.3):
    return start + np.arange(count) / RATE


def a_throw(folder):
    """Two takes of the box; the first has a point that is lost now and then, the second is withheld after 5 frames."""
    first = moved(times())
    first[3:6, 2] = np.nan
    second = a_trial("later", times(5, 0.0), role="predict", predict=times(7, 5 / RATE))
    capture = a_capture(a_trial("take é", times(), points=first), second)
    save_capture(capture, folder / "throw")
    return capture, folder / "throw"


def a_diagnosis(capture, effect="air_drag", scores=None):
    trials = {}
    for trial in capture.trials:
        truth = moved(trial.times)
        later = None if trial.predict_times is None else moved(trial.predict_times)
        ramp = np.tile(np.linspace(0, 4, len(trial.times))[:, None], (1, len(TRACKED)))
        trials[trial.name] = TrialArrays(
            times=trial.times,
            frame_score=ramp.mean(axis=1),
            point_score=ramp if scores is None else scores,
            residual=np.zeros((*trial.observed.shape[:2], trial.observed.shape[2])),
            nominal=truth + NOMINAL_OFF,
            found=truth + FOUND_OFF,
            before=None if later is None else later + NOMINAL_OFF,
            after=None if later is None else later + FOUND_OFF,
        )
    drag = {"drag_per_mass": Estimate(value=0.04, unit="1/m", low=0.03, high=0.05)}
    found = () if effect in ("none", "unknown") else (effect,)
    ranking = (
        RankedEffect(name=effect, kind="force", probability=0.7, parameters=drag if found else {}, closed_fraction=0.9),
        RankedEffect(name="wind", kind="force", probability=0.3),
    )
    return Diagnosis(
        verdict=Verdict(effect=effect, probability=0.7, alternatives=("wind",), effects=found),
        effects=ranking,
        gap=Gap(
            before_rms_m=0.05,
            refitted_rms_m=0.02,
            after_rms_m=0.003,
            noise_floor_rms_m=0.002,
            closed_fraction=0.97,
            closed_fraction_ci95=(0.9, 0.99),
            resolvable=True,
        ),
        controls={},
        next_experiment="Throw it the other way.",
        where=Localisation(objects=(ObjectShare(name="box", share=1.0),), intervals=(), direction={}),
        trials=trials,
        summary="Air drag is missing.",
        warnings=("few points",),
    )


def save_diagnosis(diagnosis, folder):
    folder.mkdir(exist_ok=True)
    write_diagnosis(diagnosis, folder)
    return folder


def load(folder):
    state = bpy.context.scene.physgen_diagnose
    state.capture = str(folder)
    assert bpy.ops.physgen.load_capture() == {"FINISHED"}
    return state


def shown_points(layer):
    """Centres (N, 3) of the spheres of ``layer`` at the current frame, sorted."""
    graph = bpy.context.evaluated_depsgraph_get()
    places = [
        tuple(i.matrix_world.translation)
        for i in graph.object_instances
        if i.is_instance and i.parent.original.get("physgen_layer") == layer
    ]
    return sorted_rows(np.array(places).reshape(-1, 3))


def sorted_rows(points):
    """By place, to a tenth of a millimetre, so that two sets of points can be compared."""
    return points[np.lexsort(np.round(points, 4).T)]


def shown_body(layer):
    """Evaluated vertices (V, 3) in world metres and colours (V, 4) of the body of ``layer`` that is in sight."""
    graph = bpy.context.evaluated_depsgraph_get()
    for item in bpy.context.scene.objects:
        if item.get("physgen_role") == "body" and item.get("physgen_layer") == layer and item.visible_get():
            mesh = item.evaluated_get(graph).data
            places, colours = np.empty(3 * len(mesh.vertices)), np.empty(4 * len(mesh.vertices))
            mesh.vertices.foreach_get("co", places)
            if len(mesh.vertices):
                mesh.attributes[COLOUR].data.foreach_get("color", colours)
            matrix = np.asarray(item.matrix_world)
            return places.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3], colours.reshape(-1, 4)
    raise AssertionError(f"no body of {layer} in sight")
