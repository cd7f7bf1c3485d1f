# SPDX-License-Identifier: MIT
"""Scenes and bakes as USD, opened again with pxr: bodies, masses, materials, points, poses, times, camera."""

import dataclasses
import io
import math
import subprocess
import sys

import numpy as np
import physgen
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.app.scene_bodies import mass_of
from physgen.sim.app.usd_particles import mpm_material, prepared_particles
from physgen.sim.cache.bake_folder import Bake, BakedObject, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.model import Camera, Ground, SceneModel, SceneObject
from PIL import Image
from scipy.spatial.transform import Rotation

from ..conftest import LOOKING_AWAY, complete_manifest

pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade

FRAMES = 5
TILT = Rotation.from_euler("xyz", [0.3, -0.2, 0.5])


def a_crate():
    """A box with texture coordinates and a picture, 0.2 by 0.1 by 0.06 m."""
    box = trimesh.creation.box((0.2, 0.1, 0.06))
    picture = Image.fromarray(np.full((4, 4, 3), 90, np.uint8))
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] * 4 + 0.5, image=picture)
    return box


@pytest.fixture
def scene(tmp_path):
    root = tmp_path / "scene"
    (root / "meshes").mkdir(parents=True)
    a_crate().export(root / "meshes/crate.glb")
    trimesh.creation.icosphere(subdivisions=2, radius=0.05).export(root / "meshes/jelly.glb")
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = TILT.as_matrix(), [0.3, 0.0, 0.5]
    rigid = dataclasses.replace(load_preset("soft"), law="rigid", density=600.0)
    crate = SceneObject(
        name="my crate", mesh="meshes/crate.glb", size_m=0.2, material=rigid, world_from_mesh=tuple(map(tuple, place)),
        friction=0.3, static_friction=0.5, restitution=0.4, velocity=(1.0, 0.0, 2.0), spin=(0.0, 0.0, math.pi),
    )  # fmt: skip
    jelly = SceneObject(name="jelly", mesh="meshes/jelly.glb", size_m=0.1, material=load_preset("soft"))
    camera = Camera(width=60, height=40, fx=50.0, fy=55.0, cx=33.0, cy=18.0, world_from_camera=LOOKING_AWAY)
    ground = Ground(point=(0.0, 0.0, -0.1), normal=(0.0, 0.0, 1.0), friction=0.7)
    grey = Image.fromarray(np.full((40, 60, 3), 128, np.uint8))
    for name in ("photo.png", "background.png"):
        grey.save(root / name)
    return save_scene(root, SceneModel(camera=camera, ground=ground, objects=(crate, jelly)))


def moved(scene, index, sample):
    """Points of an object in the world at a sample: the crate flies and turns, the jelly is squeezed."""
    item = scene.objects[index]
    mesh = trimesh.load(scene.file(item.mesh), process=False, force="mesh")
    matrix = np.array(item.world_from_mesh)
    points = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    t = sample / 24
    if index == 0:
        centre = matrix[:3, 3]
        return (
            (points - centre) @ Rotation.from_rotvec([0, 0, 40 * t]).as_matrix().T
            + centre
            + [t, 0, 2 * t - 4.9 * t * t]
        )
    return points * [1 + t, 1 + t, 1 - t]


@pytest.fixture
def bake(scene, tmp_path):
    root = tmp_path / "bake"
    root.mkdir()
    items = []
    for index, name in enumerate(("my crate", "jelly")):
        count = len(moved(scene, index, 0))
        with Pc2Writer(root / f"{index}.pc2", vertex_count=count) as writer:
            for sample in range(FRAMES):
                writer.append(moved(scene, index, sample))
        items.append(BakedObject(name=name, file=f"{index}.pc2", vertices=count))
    grains = moved(scene, 1, 0)[:40] * 0.5
    with Pc2Writer(root / "grains.pc2", vertex_count=40) as writer:
        for sample in range(FRAMES):
            writer.append(grains - np.array([0, 0, 0.01 * sample]))
    items[1] = dataclasses.replace(items[1], points_file="grains.pc2", points=40)
    manifest = complete_manifest(*items, frames=FRAMES, geometry_hash=scene.geometry_hash())
    save_manifest(root, manifest)
    return Bake(root=root, manifest=manifest)


@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_it_opens_again_with_all_that_it_was_written_from(scene, bake, tmp_path, ending):
    file = tmp_path / f"out.{ending}"
    notes = physgen.export_usd(scene, file, bake=bake)
    assert any("jelly" in note for note in notes)
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (1, FRAMES, 24)
    physics = UsdPhysics.Scene(stage.GetPrimAtPath("/World/physicsScene"))
    assert physics.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)
    assert tuple(physics.GetGravityDirectionAttr().Get()) == (0, 0, -1)

    crate = stage.GetPrimAtPath("/World/my_crate")
    mass = UsdPhysics.MassAPI(crate)
    assert mass.GetMassAttr().Get() == pytest.approx(600 * 0.2 * 0.1 * 0.06, rel=1e-6)
    # m/12 (b² + c²) of a box, about the axes that the tensor is diagonal in.
    a, b, c = 0.2, 0.1, 0.06
    m = 600 * a * b * c / 12
    axes = Rotation.from_quat([*mass.GetPrincipalAxesAttr().Get().imaginary, mass.GetPrincipalAxesAttr().Get().real])
    tensor = axes.as_matrix() @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ axes.as_matrix().T
    wanted = TILT.as_matrix() @ np.diag([m * (b * b + c * c), m * (a * a + c * c), m * (a * a + b * b)])
    np.testing.assert_allclose(tensor, wanted @ TILT.as_matrix().T, atol=1e-7)
    body = UsdPhysics.RigidBodyAPI(crate)
    assert tuple(body.GetVelocityAttr().Get()) == (1, 0, 2)
    assert body.GetAngularVelocityAttr().Get()[2] == pytest.approx(180)
    shape = stage.GetPrimAtPath("/World/my_crate/mesh")
    assert shape.HasAPI(UsdPhysics.CollisionAPI) and not crate.GetChildren()[0].HasAPI(UsdPhysics.RigidBodyAPI)
    bound, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial("physics")
    material = UsdPhysics.MaterialAPI(bound.GetPrim())
    said = [material.GetDynamicFrictionAttr(), material.GetStaticFrictionAttr(), material.GetRestitutionAttr()]
    assert [value.Get() for value in said] == pytest.approx([0.3, 0.5, 0.4])
    picture = UsdShade.Shader(stage.GetPrimAtPath("/World/Materials/my_crate/texture")).GetInput("file").Get()
    assert Image.open(io.BytesIO(open(picture.resolvedPath, "rb").read())).size == (4, 4)  # noqa: PTH123, SIM115
    uv = UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get()
    np.testing.assert_allclose(sorted(map(tuple, uv)), sorted(map(tuple, a_crate().visual.uv)), atol=1e-6)
    ground = stage.GetPrimAtPath("/World/ground")
    assert ground.HasAPI(UsdPhysics.CollisionAPI) and not ground.HasAPI(UsdPhysics.RigidBodyAPI)

    for index, path in ((0, "/World/my_crate/mesh"), (1, "/World/jelly/mesh")):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
        for sample in range(FRAMES):
            matrix = np.array(mesh.ComputeLocalToWorldTransform(sample + 1))
            points = np.array(mesh.GetPointsAttr().Get(sample + 1)) @ matrix[:3, :3] + matrix[3, :3]
            np.testing.assert_allclose(points, moved(scene, index, sample), atol=2e-7)
            low, high = np.array(mesh.GetExtentAttr().Get(sample + 1))
            inner = np.array(mesh.GetPointsAttr().Get(sample + 1))
            assert (inner >= low - 1e-7).all() and (inner <= high + 1e-7).all()
    # A rigid body has poses and one set of points; a soft one points in every frame.
    assert UsdGeom.Mesh(shape).GetPointsAttr().GetNumTimeSamples() == 0
    assert UsdGeom.Mesh(stage.GetPrimAtPath("/World/jelly/mesh")).GetPointsAttr().GetTimeSamples() == [1, 2, 3, 4, 5]
    # Interpolated half way, a body that turns stays on its way: no quaternion changes its sign.
    turn = UsdGeom.Xformable(crate).GetLocalTransformation(2.5).ExtractRotationMatrix()
    half = Rotation.from_rotvec([0, 0, 40 * 1.5 / 24]).as_matrix()
    assert np.abs(np.array(turn).T - half).max() < 0.02
    cloud = UsdGeom.Points(stage.GetPrimAtPath("/World/jelly/particles"))
    grains = np.array(cloud.GetPointsAttr().Get(3))
    np.testing.assert_allclose(grains, moved(scene, 1, 0)[:40] * 0.5 + [0, 0, -0.02], atol=1e-7)
    assert cloud.GetWidthsInterpolation() == "constant" and 0.01 < cloud.GetWidthsAttr().Get()[0] < 0.1


def schemas(prim):
    """Names of all schemas that ``prim`` applies, those that are not installed here included."""
    return set(prim.GetMetadata("apiSchemas").GetAddedOrExplicitItems())


def test_particles_of_what_deforms_are_those_of_a_bake_in_the_schema_of_newton(scene, tmp_path):
    """By name: newton-physics itself is not installed here. ``benchmarks.peers --usd`` has it step such a file."""
    moving = dataclasses.replace(scene.model.objects[1], velocity=(0.0, 1.0, 0.5), spin=(0.0, 0.0, 2.0))
    scene = save_scene(scene.root, dataclasses.replace(scene.model, objects=(scene.model.objects[0], moving)))
    physgen.export_usd(scene, tmp_path / "s.usda")
    stage = Usd.Stage.Open(str(tmp_path / "s.usda"))
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    prepared, why = prepared_particles(scene)
    body = prepared.setup.bodies[1]
    owner = stage.GetPrimAtPath("/World/physicsScene")
    assert why == "" and "NewtonMPMSceneAPI" in schemas(owner)
    cell = prepared.solver.cell_size(prepared.similarity)
    assert owner.GetAttribute("newton:mpm:voxelSize").Get() == pytest.approx(cell)
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/jelly/matter"))
    prim = points.GetPrim()
    assert schemas(prim) >= {"NewtonPointsDeformableSimAPI", "PhysicsDeformableBodyAPI"}
    assert prim.GetRelationship("physics:simulationOwner").GetTargets() == [owner.GetPath()]
    matrix = np.array(points.ComputeLocalToWorldTransform(1))
    places = np.array(points.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
    np.testing.assert_allclose(places, body.positions, atol=1e-7)
    masses = np.array(prim.GetAttribute("physics:masses").Get(), dtype=float)
    np.testing.assert_allclose(masses, moving.material.density * body.volumes, rtol=1e-6)
    speeds = np.array(points.GetVelocitiesAttr().Get(), dtype=float)
    np.testing.assert_allclose(masses @ speeds / masses.sum(), moving.velocity, atol=1e-6)
    arms = places - masses @ places / masses.sum()
    np.testing.assert_allclose(speeds - moving.velocity, np.cross(moving.spin, arms), atol=1e-6)
    bound, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
    assert "NewtonMPMMaterialAPI" in schemas(bound.GetPrim())
    said = bound.GetPrim().GetAttribute("newton:mpm:youngsModulus").Get()
    assert said == pytest.approx(moving.material.youngs_modulus)
    # A rigid body has none.
    assert not stage.GetPrimAtPath("/World/my_crate/matter")


def test_each_law_says_where_it_yields():
    sand, clay, water = (mpm_material(load_preset(name)) for name in ("sand", "clay", "water"))
    assert sand["internalFriction"] == pytest.approx(math.tan(0.576)) and sand["tensileYieldRatio"] == 0
    assert clay["yieldStress"] == pytest.approx(load_preset("clay").yield_stress / math.sqrt(3))
    assert clay["internalFriction"] == 0 and "youngsModulus" not in water and water["internalFriction"] == 0
    rubber = mpm_material(load_preset("medium"))
    assert rubber["tensileYieldRatio"] == 1 and "yieldStress" not in rubber


def test_a_scene_that_cannot_be_baked_is_exported_without_particles(scene, tmp_path):
    low = dataclasses.replace(scene.model, ground=Ground(point=(0.0, 0.0, 5.0)))
    notes = physgen.export_usd(save_scene(scene.root, low), tmp_path / "s.usda")
    assert any("no particles are written" in note and "ground" in note for note in notes)
    stage = Usd.Stage.Open(str(tmp_path / "s.usda"))
    assert stage.GetPrimAtPath("/World/jelly/mesh") and not stage.GetPrimAtPath("/World/jelly/matter")


def test_its_camera_sees_points_at_the_same_pixels(scene, tmp_path):
    physgen.export_usd(scene, tmp_path / "s.usda")
    stage = Usd.Stage.Open(str(tmp_path / "s.usda"))
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(1).frustum
    camera = scene.model.camera
    for point in ([0.1, 0.2, 0.3], [-0.4, 1.0, 0.1], [0.3, 2.0, 0.6]):
        seen = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(Gf.Vec3d(*point))
        pixel = (seen[0] + 1) / 2 * camera.width, (1 - seen[1]) / 2 * camera.height
        x, y, z = np.linalg.inv(camera.world_from_camera)[:3] @ [*point, 1.0]
        assert pixel == pytest.approx((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), abs=1e-6)


def test_masses_are_those_of_solids_and_shells(scene):
    crate, ball = scene.objects[0], trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    ball.apply_translation((1.0, 2.0, 3.0))
    found = mass_of(crate, ball.vertices, ball.faces)
    assert found.mass == pytest.approx(600 * ball.volume) and found.centre == pytest.approx([1, 2, 3])
    np.testing.assert_allclose(
        np.sort(found.inertia), np.sort(np.linalg.eigvalsh(600 * ball.moment_inertia)), rtol=1e-6
    )
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    shell = mass_of(crate, cube.vertices, cube.faces, thickness=0.001)
    assert shell.mass == pytest.approx(600 * 6 * 0.01 * 0.001)
    # Of six thin squares: 5/18 m a².
    assert shell.inertia == pytest.approx([5 / 18 * shell.mass * 0.01] * 3)
    with pytest.raises(InputError, match="encloses no volume"):
        mass_of(crate, cube.vertices, cube.faces[:, ::-1])


def test_what_cannot_be_written_is_one_line(scene, bake, tmp_path, capsys, monkeypatch):
    out = tmp_path / "x.usda"
    assert main(["export", str(bake.root), "--usd", str(out)]) == 3
    assert "--bake" in capsys.readouterr().err
    other = dataclasses.replace(bake, manifest=dataclasses.replace(bake.manifest, geometry_hash="0" * 64))
    with pytest.raises(InputError, match="another scene"):
        physgen.export_usd(scene, out, bake=other)
    with pytest.raises(InputError, match=r"\.usda or \.usdc"):
        physgen.export_usd(scene, tmp_path / "x.obj")
    assert main(["export", str(scene.root), "--usd", str(out), "--bake", str(bake.root)]) == 0
    with pytest.raises(InputError, match="is there already"):
        physgen.export_usd(scene, out)
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"pip install 'physgen\[usd\]'"):
        physgen.export_usd(scene, tmp_path / "y.usda")
    assert not (tmp_path / "y.usda").exists()


FULL_DISK = """
import resource, sys
from physgen.batch.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
sys.exit(main(["export", sys.argv[1], "--usd", sys.argv[2]]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of a file")
@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_a_disk_that_is_full_is_one_line_and_keeps_no_texture(scene, tmp_path, ending):
    before = set(tmp_path.rglob("*"))
    command = [sys.executable, "-c", FULL_DISK, str(scene.root), str(tmp_path / f"x.{ending}")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 3 and "cannot be written" in done.stderr and done.stderr.count("\n") == 1
    assert set(tmp_path.rglob("*")) == before


def test_importing_it_needs_no_pxr():
    code = "import sys, physgen.sim.app.export_usd, physgen.batch.cli; assert 'pxr' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
