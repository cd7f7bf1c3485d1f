# SPDX-License-Identifier: MIT
"""Meshes whose vertices move: what moved is where it was put, and nothing else has changed."""

import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.scene.glb import accessor_values, glb_chunks, read_textured_mesh
from physgen.sim.scene.meshes import read_mesh
from physgen.sim.scene.moved_mesh import moved_suffix, write_moved_mesh
from PIL import Image


def textured():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    # A seam: a vertex that is there twice.
    vertices = np.concatenate([mesh.vertices, mesh.vertices[:1]])
    faces = mesh.faces.copy()
    faces[0][faces[0] == 0] = len(mesh.vertices)
    uv = np.column_stack([np.linspace(0, 1, len(vertices)), np.linspace(0.2, 0.9, len(vertices))])
    image = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    return trimesh.Trimesh(
        vertices, faces, visual=trimesh.visual.TextureVisuals(uv=uv, material=material), process=False
    )


def bent(vertices):
    return vertices * (1.0, 0.5, 2.0) + 0.1 * vertices[:, :1] ** 2 + (3.0, -2.0, 0.5)


def test_a_glb_keeps_all_but_its_places(tmp_path):
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)) @ np.diag([2.0, 2.0, -2.0, 1.0])
    scene.add_geometry(textured(), transform=turn)
    source, target = tmp_path / "a.glb", tmp_path / "b.glb"
    source.write_bytes(scene.export(file_type="glb", include_normals=True))
    before = read_textured_mesh(source)
    wanted = bent(before.vertices)
    write_moved_mesh(source, target, wanted, before.faces)
    after, theirs = read_textured_mesh(target), read_mesh(target)
    document, binary = glb_chunks(target.read_bytes())
    assert after.vertices == pytest.approx(wanted, abs=1e-5)
    assert np.asarray(theirs.vertices) == pytest.approx(wanted, abs=1e-5)
    assert np.array_equal(after.faces, before.faces) and np.array_equal(after.uv, before.uv)
    assert after.picture == before.picture
    # Of the new shape, which is convex: outward, of length 1, and the same on both sides of the seam.
    index = document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    local = accessor_values(document, binary, index, 3).astype(np.float64)
    normals = local @ np.linalg.inv(turn[:3, :3])
    assert np.linalg.norm(local, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert (np.einsum("vi,vi->v", normals, wanted - wanted.mean(axis=0)) > 0).all()
    assert np.array_equal(local[0], local[-1])


@pytest.mark.parametrize("kind", ["ply", "stl", "obj"])
def test_other_formats_keep_order_and_faces(tmp_path, kind):
    mesh = trimesh.creation.icosphere(subdivisions=1)
    source = tmp_path / f"a.{kind}"
    mesh.export(source)
    before = read_mesh(source)
    wanted = bent(np.asarray(before.vertices))
    target = tmp_path / f"b{moved_suffix(source)}"
    write_moved_mesh(source, target, wanted, np.asarray(before.faces))
    after = read_mesh(target)
    assert np.asarray(after.vertices) == pytest.approx(wanted, abs=1e-5)
    assert np.array_equal(after.faces, before.faces)


def test_a_binary_ply_keeps_what_else_it_holds(tmp_path):
    source, target = tmp_path / "a.ply", tmp_path / "b.ply"
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    source.write_bytes(mesh.export(file_type="ply", vertex_normal=False))
    write_moved_mesh(source, target, bent(np.asarray(mesh.vertices)), np.asarray(mesh.faces))
    assert np.array_equal(read_mesh(target).visual.vertex_colors, mesh.visual.vertex_colors)
    assert len(source.read_bytes()) == len(target.read_bytes())


def test_what_cannot_be_moved_is_said(tmp_path):
    source = tmp_path / "a.glb"
    with pytest.raises(InputError, match="no such mesh"):
        write_moved_mesh(source, tmp_path / "b.glb", np.zeros((3, 3)), np.zeros((1, 3), int))
    trimesh.creation.box().export(source)
    with pytest.raises(InputError, match=r"has 8 vertices: 9"):
        write_moved_mesh(source, tmp_path / "b.glb", np.random.default_rng(0).random((9, 3)), np.array([[0, 1, 8]]))
    source.write_bytes(b"glTF" + bytes(50))
    with pytest.raises(InputError, match="not a readable mesh"):
        write_moved_mesh(source, tmp_path / "b.glb", np.zeros((8, 3)), np.zeros((1, 3), int))
