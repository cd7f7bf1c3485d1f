# SPDX-License-Identifier: MIT
"""What a diagnosis found, as a model for MuJoCo and as a layer for USD Physics."""

import numpy as np
import pytest
import trimesh
from physgen.sim.app.export_patch import patch_text
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.errors import InputError

STEP = 1e-4


def a_capture(mesh, place, density=200.0):
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=density, stiffness="hard")
    item = CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    points = np.broadcast_to(np.array(place, dtype=float), (12, 1, 3)).copy()
    trial = Trial(
        name="take", role="fit", times=np.arange(12) / 60, points=points, pixels=None,
        object_index=np.zeros(1, dtype=np.int64), rest_points=np.zeros((1, 3)),
    )  # fmt: skip
    ground = Ground(friction=0.5, restitution=0.5)
    return Capture(
        gravity=(0.0, 0.0, -9.81), ground=ground, objects=(item,), noise_sigma=1e-3, camera=None, trials=(trial,)
    )


def ball(radius=0.05, **options):
    return a_capture(trimesh.creation.icosphere(subdivisions=3, radius=radius), (0, 0, 1.0), **options)


def box(height=0.02):
    return a_capture(trimesh.creation.box((0.1, 0.1, 0.04)), (0, 0, height))


def played(capture, found, seconds, velocity=(0, 0, 0), spin=(0, 0, 0)):
    """Positions (T, 3) and velocities (T, 3) of the body in MuJoCo, a row a step."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(patch_text(capture, found, "mjcf")[0])
    assert model.opt.timestep == pytest.approx(STEP)
    data = mujoco.MjData(model)
    data.qvel[:3], data.qvel[3:] = velocity, spin
    rows = []
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
        rows.append(np.r_[data.qpos[:3], data.qvel[:3]])
    rows = np.array(rows)
    return rows[:, :3], rows[:, 3:]


def test_found_friction_slows_a_box_in_mujoco():
    _, velocity = played(box(), {"friction": {"friction": 0.2}}, 0.3, velocity=(1.0, 0, 0))
    assert (velocity[-1, 0] - velocity[999, 0]) / (0.3 - 0.1) == pytest.approx(-0.2 * 9.81, rel=0.03)


@pytest.mark.parametrize("restitution", [0.3, 0.6, 0.85])
def test_found_restitution_bounces_a_ball_in_mujoco(restitution):
    place, velocity = played(ball(), {"restitution": {"restitution": restitution}}, 0.7)
    down, up = -velocity[:, 2].min(), velocity[np.argmin(velocity[:, 2]) :, 2].max()
    assert place[:, 2].min() > 0.03
    assert up / down == pytest.approx(restitution, abs=0.05)


def test_found_drag_wind_and_lift_act_on_a_ball_in_mujoco():
    _, velocity = played(ball(), {"air_drag": {"drag_per_mass": 0.1}}, 0.1, velocity=(8.0, 0, 0))
    assert velocity[-1, 0] == pytest.approx(8.0 / (1 + 0.1 * 8.0 * 0.1), rel=0.01)
    wind = {"drag_per_mass": 0.1, "wind_x": 0.0, "wind_y": 3.0, "wind_z": 0.0}
    assert played(ball(), {"wind": wind}, 0.1)[1][-1, 1] == pytest.approx(0.1 * 9.0 * 0.1, rel=0.05)
    found = {"magnus": {"lift_per_mass": 0.01}}
    _, velocity = played(ball(), found, 0.1, velocity=(5.0, 0, 0), spin=(0, 0, 60.0))
    assert velocity[-1, 1] == pytest.approx(0.01 * 60 * 5 * 0.1, rel=0.03)


def test_found_gravity_mass_offset_tether_and_rolling_reach_mujoco():
    mujoco = pytest.importorskip("mujoco")
    place, _ = played(ball(), {"buoyancy": {"fraction": 0.2}}, 0.2)
    assert 1 - place[-1, 2] == pytest.approx(0.5 * 0.8 * 9.81 * 0.04, rel=0.02)
    place, _ = played(ball(), {"gravity_tilt": {"angle": 0.1, "azimuth": np.pi / 2}}, 0.2)
    assert place[-1, 1] == pytest.approx(0.5 * 9.81 * np.sin(0.1) * 0.04, rel=0.02)
    offset = {"fraction": 0.25, "offset_x": 0.04, "offset_y": 0.0, "offset_z": 0.0}
    model = mujoco.MjModel.from_xml_string(patch_text(box(), {"mass_offset": offset}, "mjcf")[0])
    assert model.body_ipos[1] == pytest.approx([0.01, 0, 0], abs=1e-6)
    assert model.body_mass[1] == pytest.approx(200 * 0.1 * 0.1 * 0.04)
    held = {"stiffness_per_mass": 400.0, "rest_length": 0.2, "anchor_x": 0.0, "anchor_y": 0.0, "anchor_z": 1.2}
    place, _ = played(ball(), {"tether": {**held, "string": 1.0}}, 1.0)
    assert place[:, 2].min() == pytest.approx(1 - 2 * 9.81 / 400, abs=0.005)
    rolling = {"rolling_resistance": {"lever_arm": 0.003}}
    model = mujoco.MjModel.from_xml_string(patch_text(ball(), rolling, "mjcf")[0])
    assert model.geom_friction[:, 2] == pytest.approx([0.003, 0.003])


def test_found_inertia_reaches_mujoco_beside_a_pellet_and_usd():
    mujoco = pytest.importorskip("mujoco")
    mass, uniform = 200 * 0.1 * 0.1 * 0.04, np.array([0.1**2 + 0.04**2, 0.1**2 + 0.04**2, 0.1**2 + 0.1**2]) / 12
    found = {"inertia": {"factor": 1.5}}
    model = mujoco.MjModel.from_xml_string(patch_text(box(), found, "mjcf")[0])
    assert model.body_mass[1] == pytest.approx(mass)
    assert np.sort(model.body_inertia[1]) == pytest.approx(1.5 * mass * uniform)
    # A pellet of a quarter of the mass, 4 cm off the middle.
    found["mass_offset"] = {"fraction": 0.25, "offset_x": 0.04, "offset_y": 0.0, "offset_z": 0.0}
    model = mujoco.MjModel.from_xml_string(patch_text(box(), found, "mjcf")[0])
    off = 0.75 * 1.5 * uniform + 0.75 * 0.25 * 0.04**2 * np.array([0, 1, 1])
    assert model.body_ipos[1] == pytest.approx([0.01, 0, 0], abs=1e-9)
    assert np.sort(model.body_inertia[1]) == pytest.approx(np.sort(mass * off))
    text, notes = patch_text(box(), {"inertia": {"factor": 1.5}}, "usd")
    line = next(line for line in text.splitlines() if "physics:diagonalInertia" in line)
    moments = [float(n) for n in line.split("(")[1].rstrip(")").split(",")]
    assert moments == pytest.approx(np.sort(1.5 * mass * uniform)) and not notes


def test_what_has_no_counterpart_is_said():
    adhesion = {"adhesion": {"pull_per_mass": 30.0, "reach": 0.004}}
    text, notes = patch_text(ball(), adhesion, "mjcf")
    assert "adhesion has no counterpart" in notes[0] and "pull_per_mass = 30" in text
    text, notes = patch_text(ball(), {"time_scale": {"rate": 1.02}}, "usd")
    assert "corrects the recording" in notes[0]
    with pytest.raises(InputError, match="give mjcf or usd"):
        patch_text(ball(), {}, "urdf")


def test_usd_has_friction_restitution_gravity_and_keeps_the_rest_as_data(tmp_path):
    found = {"friction": {"friction": 0.21}, "air_drag": {"drag_per_mass": 0.07}}
    text, notes = patch_text(ball(), found, "usd")
    assert text.startswith("#usda 1.0") and "float physics:dynamicFriction = 0.21" in text
    assert any("no air_drag" in note for note in notes)
    Usd = pytest.importorskip("pxr.Usd")
    path = tmp_path / "found.usda"
    path.write_text(text, encoding="utf-8")
    stage = Usd.Stage.Open(str(path))
    material = stage.GetPrimAtPath("/World/found")
    assert material.GetAttribute("physics:restitution").Get() == pytest.approx(0.5)
    assert stage.GetPrimAtPath("/World/body").GetCustomData()["physgen"]["air_drag:drag_per_mass"] == 0.07
    assert stage.GetPrimAtPath("/World/physicsScene").GetAttribute("physics:gravityMagnitude").Get() == pytest.approx(
        9.81
    )
