# SPDX-License-Identifier: MIT
"""Files of splats become scenes: a closed body of the right size around them, upright, in their colours."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.gaussians.splat_ply import read_splats, write_splats
from physgen.sim.gaussians.splats import Splats, joined, quaternions, transform_splats
from physgen.sim.importers.splat_scene import import_splats, splat_surface
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.textured_mesh import read_textured_mesh
from scipy.spatial import cKDTree


def on_surface(mesh, count, colour=(0.5, 0.5, 0.5), opacity=0.8, seed=0):
    """Flat splats all over ``mesh``, as a fit to pictures leaves them: nothing inside."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals = mesh.face_normals[faces]
    across = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    width = 0.7 * np.sqrt(mesh.area / count)
    return Splats(
        centres=points,
        scales=np.tile([width, width, 0.15 * width], (count, 1)),
        rotations=quaternions(np.stack([across, np.cross(normals, across), normals], axis=2)),
        opacities=np.full(count, opacity),
        colours=np.tile(colour, (count, 1)),
    )


def quiet(message):
    pass


@pytest.mark.parametrize(
    "mesh, bound",
    [
        (trimesh.creation.icosphere(4), 0.04),
        (trimesh.creation.box((1.0, 2.0, 0.4)), 0.06),
        (trimesh.creation.torus(1.0, 0.3), 0.06),
    ],
)
def test_a_hollow_cloud_becomes_the_solid_that_it_shows(mesh, bound):
    """Volume within a half cell of the grid all around (a ninety-sixth of the size)."""
    found = splat_surface(on_surface(mesh, 12_000), "thing", quiet)
    body = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert body.is_watertight and body.is_winding_consistent and found.inside.all()
    assert abs(body.volume / mesh.volume - 1) < bound
    # Its hole stays: a torus has the Euler characteristic 0, the others 2.
    assert body.euler_number == mesh.euler_number
    away = cKDTree(mesh.sample(100_000)).query(body.vertices)[0] / mesh.extents.max()
    assert away.mean() < 0.006 and away.max() < 0.02
    assert 1000 < len(found.vertices) < 20_000


def test_the_shape_does_not_depend_on_unit_and_place():
    splats = on_surface(trimesh.creation.icosphere(3), 3000)
    matrix = np.diag([1e3, 1e3, 1e3, 1.0])
    matrix[:3, 3] = 5e4
    one, other = splat_surface(splats, "thing", quiet), splat_surface(transform_splats(splats, matrix), "thing", quiet)
    assert np.array_equal(one.faces, other.faces)
    np.testing.assert_allclose(other.vertices, one.vertices * 1e3 + 5e4, rtol=1e-6)


def test_floaters_fog_and_holes_do_not_matter():
    ball = trimesh.creation.icosphere(4)
    splats = on_surface(ball, 8_000)
    random = np.random.default_rng(1)
    hole = splats.centres[:, 2] > -0.98
    floating = Splats(
        centres=random.normal(size=(40, 3)) * 30,
        scales=np.full((40, 3), 0.02),
        rotations=random.normal(size=(40, 4)),
        opacities=np.full(40, 0.9),
        colours=np.zeros((40, 3)),
    )
    fog = floating.changed(centres=floating.centres / 30, scales=np.full((40, 3), 2.0))
    said = []
    found = splat_surface(joined([splats.subset(hole), floating, fog]), "ball", said.append)
    body = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert body.is_watertight and abs(body.volume / ball.volume - 1) < 0.05
    assert found.inside[: hole.sum()].all() and not found.inside[hole.sum() :].any()
    assert any("80 of" in text and "left out" in text for text in said)


def test_open_clouds_are_as_thick_as_their_splats():
    """A sheet: nothing inside, but not nothing."""
    said = []
    found = splat_surface(on_surface(trimesh.creation.box((2.0, 2.0, 1e-4)), 6000), "leaf", said.append)
    body = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert body.is_watertight and 0.005 < body.volume / 4.0 < 0.1
    assert any("enclose no volume" in text for text in said)


def test_clouds_without_a_body_are_refused():
    splats = on_surface(trimesh.creation.icosphere(2), 200)
    with pytest.raises(InputError, match="nothing is visible"):
        splat_surface(splats.changed(opacities=np.full(200, 0.01)), "ghost", quiet)
    with pytest.raises(InputError, match="no extent"):
        splat_surface(splats.changed(centres=np.zeros((200, 3))), "dot", quiet)
    with pytest.raises(InputError, match="dense"):
        splat_surface(splats.changed(opacities=np.full(200, 0.11), scales=np.full((200, 3), 1e-4)), "dust", quiet)


@pytest.mark.parametrize("up", ["y-down", "x", "z-down"])
def test_imported_splats_stand_upright_on_the_ground(tmp_path, up):
    """A pole with a red top, along any axis of the file: in the world its top is up, and it is not mirrored."""
    direction = np.zeros(3)
    direction["xyz".index(up[0])] = -1.0 if up.endswith("down") else 1.0
    turn = trimesh.geometry.align_vectors([0, 0, 1], direction)
    pole = on_surface(trimesh.creation.box((0.5, 0.5, 2.0)), 2000)
    red = np.where(pole.centres[:, 2:] > 0.5, [[0.9, 0.1, 0.1]], [[0.2, 0.3, 0.9]])
    matrix = turn.copy()
    matrix[:3, 3] = 7.0
    write_splats(tmp_path / "pole.ply", transform_splats(pole.changed(colours=red), matrix))
    folder = import_splats(tmp_path / "pole.ply", out=tmp_path / "scene", size_m=0.4, up=up)
    (item,) = folder.model.objects
    mesh = load_object_mesh(folder, item)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0).max(), 0.4, rtol=1e-6)
    np.testing.assert_allclose(
        [*(mesh.vertices.max(0) + mesh.vertices.min(0))[:2], mesh.vertices[:, 2].min()], 0, atol=1e-6
    )
    splats = transform_splats(read_splats(folder.file(item.splats)), np.array(item.world_from_mesh))
    is_red = splats.colours[:, 0] > 0.5
    assert splats.centres[is_red, 2].min() > 0.298 and splats.centres[~is_red, 2].max() < 0.302
    assert np.linalg.det(np.array(item.world_from_mesh)[:3, :3]) > 0
    seen = folder.model.camera.project(mesh.vertices)
    assert (seen[:, :2] > 0).all() and (seen[:, :2] < (960, 720)).all()
    file = trimesh.load(folder.file(item.mesh), process=False, force="mesh")
    top = mesh.vertices[:, 2] > 0.35
    # Linear, as glTF has it: 0.9 becomes 0.787.
    np.testing.assert_allclose(file.visual.vertex_colors[top, 0] / 255, 0.787, atol=0.01)
    assert len(read_textured_mesh(folder.file(item.mesh)).vertices) == len(mesh.vertices), "Blender can read it"


def test_on_the_command_line(tmp_path, capsys):
    write_splats(tmp_path / "a ball.ply", on_surface(trimesh.creation.icosphere(3), 3000))
    out = str(tmp_path / "scene")
    assert main(["import", str(tmp_path / "a ball.ply"), "--out", out, "--size", "0.3", "--up", "z"]) == 0
    assert main(["estimate", out, "--frames", "5", "--quality", "preview", "--json"]) == 0
    assert main(["import", str(tmp_path / "a ball.ply"), "--out", out, "--settings", "x.yaml"]) != 0
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "x"), "--up", "z"]) != 0
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    assert main(["import", str(tmp_path / "mesh.ply"), "--out", str(tmp_path / "y")]) != 0
    assert "mesh" in capsys.readouterr().err
