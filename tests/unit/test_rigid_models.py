# SPDX-License-Identifier: MIT
"""MJCF and URDF become rigid bodies; masses, centres and inertia against MuJoCo's own."""

import json

import numpy as np
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.app.import_folder import import_folder
from physgen.sim.app.scene_bodies import mass_of
from physgen.sim.errors import InputError
from physgen.sim.importers.rigid_models import read_rigid_model
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh

mujoco = pytest.importorskip("mujoco")

SCENE = """<mujoco>
  <compiler angle="{angle}" eulerseq="{order}" meshdir="parts"/>
  <option gravity="0 0 -3.7"/>
  <default><geom density="700" friction="0.6 0.005 0.0001"/>
    <default class="heavy"><geom density="2500"/></default></default>
  <asset><mesh name="wedge" file="wedge.stl" scale="0.5 1 1"/>
    <mesh name="inline" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.2"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 .1" friction="0.8"/>
    <geom name="wall" type="box" size="0.05 0.5 0.5" pos="1 0 0.5"/>
    <body name="dumbbell" pos="0 0 0.6" euler="{euler}"><freejoint/>
      <geom type="capsule" fromto="-0.1 0 0.02 0.1 0 0" size="0.02"/>
      <geom type="sphere" class="heavy" size="0.05" pos="-0.15 0 0"/>
      <geom type="cylinder" size="0.06 0.02" pos="0.2 0 0" quat="1 0 1 0"/>
      <body pos="0 0.1 0"><joint type="hinge" axis="0 0 1"/>
        <geom type="ellipsoid" size="0.02 0.03 0.04" axisangle="1 1 0 {turn}"/></body>
    </body>
    <body name="wedge" pos="0.3 0.3 0.5" xyaxes="0 1 0 -1 0 0"><freejoint/><geom type="mesh" mesh="wedge"/></body>
    <body name="pebble" pos="-0.3 0.3 0.5"><joint type="free"/><geom type="mesh" mesh="inline" mass="0.2"/></body>
    <body name="given" pos="-0.3 -0.3 0.5" zaxis="1 0 1"><freejoint/>
      <inertial pos="0.01 0 0" mass="0.4" diaginertia="0.002 0.003 0.004" quat="0.9 0.1 0.2 0"/>
      <geom type="box" size="0.1 0.05 0.05"/></body>
  </worldbody>
</mujoco>"""


@pytest.fixture
def parts(tmp_path):
    (tmp_path / "parts").mkdir()
    prism = trimesh.creation.cylinder(0.1, 0.2, sections=3)
    prism.apply_translation((0.02, 0.03, 0.04))
    prism.export(tmp_path / "parts" / "wedge.stl")
    return tmp_path


def of_mujoco(path, name):
    """Mass, centre and tensor in the world of a body with what hangs on it, at the file's pose."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    top = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    members = [i for i in range(model.nbody) if model.body_rootid[i] == top]
    mass = sum(model.body_mass[i] for i in members)
    centre = sum(model.body_mass[i] * data.xipos[i] for i in members) / mass
    tensor = np.zeros((3, 3))
    for i in members:
        turn, d = data.ximat[i].reshape(3, 3), data.xipos[i] - centre
        tensor += turn @ np.diag(model.body_inertia[i]) @ turn.T
        tensor += model.body_mass[i] * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, centre, tensor


@pytest.mark.parametrize(
    ("angle", "order", "euler", "turn"),
    [("degree", "xyz", "30 40 50", "35"), ("radian", "ZYX", "0.5 0.6 0.7", "0.6"), ("degree", "zyz", "10 20 30", "5")],
)
def test_masses_and_inertia_are_those_of_mujoco(parts, angle, order, euler, turn):
    path = parts / "scene.xml"
    path.write_text(SCENE.format(angle=angle, order=order, euler=euler, turn=turn))
    model = read_rigid_model(path)
    assert [b.name for b in model.bodies] == ["fixed", "dumbbell", "wedge", "pebble", "given"]
    assert model.gravity == (0, 0, -3.7) and model.ground[2] == 0.8
    assert any("joint of body" in note and "frozen" in note for note in model.notes)
    for body in model.bodies[1:]:
        mass, centre, tensor = of_mujoco(path, body.name)
        assert body.inertia.mass == pytest.approx(mass, rel=1e-6), body.name
        np.testing.assert_allclose(body.inertia.centre, centre, atol=1e-6, err_msg=body.name)
        np.testing.assert_allclose(body.inertia.tensor, tensor, atol=1e-5 * np.abs(tensor).max(), err_msg=body.name)
        assert body.friction == 0.6


def test_urdf_has_the_same_mass_and_inertia_as_in_mujoco(parts):
    path = parts / "robot.urdf"
    path.write_text("""<robot name="r">
      <link name="base"><inertial><origin xyz="0.1 0 0.2" rpy="0.3 0.2 0.1"/><mass value="2"/>
        <inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial>
        <visual><geometry><mesh filename="package://r/parts/wedge.stl" scale="2 2 2"/></geometry></visual>
        <collision><origin xyz="0 0 0.1"/><geometry><box size="0.2 0.4 0.3"/></geometry></collision></link>
      <link name="arm"><inertial><mass value="0.5"/>
        <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial>
        <collision><geometry><cylinder radius="0.05" length="0.3"/></geometry></collision></link>
      <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0.3 0 0" rpy="0 1.2 0.4"/>
        <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>""")
    model = read_rigid_model(path)
    (body,) = model.bodies
    assert body.vertices[:, 2].min() == pytest.approx(0) and any("arm is frozen" in n for n in model.notes)
    # MuJoCo welds the root of a URDF to its world, so the same tree is read there with a free joint before it.
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    for mesh in list(spec.geoms):
        if mesh.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(mesh)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    mass = compiled.body_mass[1:].sum()
    centre = (compiled.body_mass[1:, None] * data.xipos[1:]).sum(axis=0) / mass
    tensor = np.zeros((3, 3))
    for i in range(1, compiled.nbody):
        turn, d = data.ximat[i].reshape(3, 3), data.xipos[i] - centre
        tensor += turn @ np.diag(compiled.body_inertia[i]) @ turn.T
        tensor += compiled.body_mass[i] * (d @ d * np.eye(3) - np.outer(d, d))
    assert body.inertia.mass == pytest.approx(mass) == pytest.approx(2.5)
    lift = body.inertia.centre[2] - centre[2]
    np.testing.assert_allclose(body.inertia.centre, centre + np.array([0, 0, lift]), atol=1e-9)
    np.testing.assert_allclose(body.inertia.tensor, tensor, atol=1e-9)


def test_the_command_makes_a_scene_of_the_right_masses(parts, capsys):
    path = parts / "scene.xml"
    path.write_text(SCENE.format(angle="degree", order="xyz", euler="30 40 50", turn="35"))
    assert main(["import", str(path), "--out", str(parts / "out"), "--json"]) == 0
    said = " ".join(json.loads(line).get("message", "") for line in capsys.readouterr().out.splitlines())
    assert "given: as a homogeneous body" in said and "wedge: as" not in said
    scene = load_scene(parts / "out")
    assert [o.role for o in scene.objects] == ["collider", "dynamic", "dynamic", "dynamic", "dynamic"]
    assert scene.model.ground.friction == 0.8 and scene.model.gravity == (0.0, 0.0, -3.7)
    for item in scene.objects[1:]:
        mesh = load_object_mesh(scene, item)
        found = mass_of(item, mesh.vertices, mesh.faces)
        assert found.mass == pytest.approx(of_mujoco(path, item.name)[0], rel=1e-4), item.name
    wedge = scene.objects[2]
    mesh = load_object_mesh(scene, wedge)
    np.testing.assert_allclose(
        np.sort(mass_of(wedge, mesh.vertices, mesh.faces).inertia),
        np.linalg.eigvalsh(of_mujoco(path, "wedge")[2]),
        rtol=1e-4,
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><mujoco/>", "entities"),
        ("<mujoco", "not readable as XML"),
        ("<sdf/>", "root is 'sdf'"),
        ("<mujoco/>", "no body with a shape"),
        ("<mujoco><include file='x.xml'/></mujoco>", "mj_saveLastXML"),
        ("<mujoco><worldbody><body><freejoint/><geom size='-1'/></body></worldbody></mujoco>", "above 0"),
        ("<mujoco><worldbody><body><freejoint/><geom size='x'/></body></worldbody></mujoco>", "give numbers"),
        ("<mujoco><worldbody><body><freejoint/><geom size='nan'/></body></worldbody></mujoco>", "finite"),
        (
            "<mujoco><worldbody><body><freejoint/><geom type='capsule' size='0.1 1e308'/></body></worldbody></mujoco>",
            "finite",
        ),
        ("<mujoco><worldbody><body><freejoint/><geom type='hfield'/></body></worldbody></mujoco>", "not read"),
        ("<mujoco><worldbody><body><freejoint/><geom size='1' mass='0'/></body></worldbody></mujoco>", "mass of 0"),
        (
            "<mujoco><asset><mesh name='m' file='../../etc/x.stl'/></asset><worldbody><geom type='mesh' mesh='m'/>"
            "</worldbody></mujoco>",
            "x.stl",
        ),
        ("<robot><link name='a'><visual><geometry><torus/></geometry></visual></link></robot>", "torus"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, text, words):
    path = tmp_path / "m.xml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        import_folder(path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_balls_radius_is_the_first_of_its_sizes(tmp_path):
    """MuJoCo ignores the others; two of them ended in a traceback."""
    path = tmp_path / "m.xml"
    path.write_text("<mujoco><worldbody><body><freejoint/><geom size='0.1 0.2'/></body></worldbody></mujoco>")
    (body,) = read_rigid_model(path).bodies
    assert np.ptp(body.vertices, axis=0).max() == pytest.approx(0.2, rel=0.01)


def test_deep_nesting_is_refused(tmp_path):
    path = tmp_path / "m.xml"
    path.write_text("<mujoco><worldbody>" + "<body>" * 300 + "</body>" * 300 + "</worldbody></mujoco>")
    with pytest.raises(InputError, match="deeper"):
        read_rigid_model(path)
