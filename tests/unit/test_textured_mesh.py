# SPDX-License-Identifier: MIT
"""The GLB reader of our own: what trimesh reads, without it; garbage is refused by name.

Meshes whose vertices move: what moved is where it was put, and nothing else has changed."""

import contextlib
import io
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.scene import textured_mesh
from physgen.sim.scene.glb import accessor_values, glb_chunks
from physgen.sim.scene.meshes import read_mesh
from physgen.sim.scene.textured_mesh import moved_suffix, read_textured_mesh, write_moved_mesh
from PIL import Image


def textured():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    uv = np.column_stack([np.linspace(0, 1, len(mesh.vertices)), np.linspace(0.2, 0.9, len(mesh.vertices))])
    image = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    image.format = "PNG"
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)


@pytest.fixture(scope="module")
def content():
    return textured().export(file_type="glb")


def chunks(content):
    length = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + length]), content[20 + length :]


def packed(document, rest):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def test_reads_the_same_as_trimesh(tmp_path, content):
    path = tmp_path / "ball.glb"
    path.write_bytes(content)
    own, other = textured_mesh._parse(content), read_mesh(path)
    assert np.array_equal(own.vertices, other.vertices) and np.array_equal(own.faces, other.faces)
    assert np.allclose(own.uv, other.visual.uv, atol=1e-7)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(own.picture))), np.arange(48).reshape(4, 4, 3))


@pytest.mark.parametrize(
    "node",
    [
        {"translation": [1, 2, 3], "rotation": [0.5, 0.5, 0.5, 0.5], "scale": [1, 2, 3]},
        {"matrix": [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 5, 6, 7, 1]},
        {"scale": [-1, 1, 1]},
    ],
)
def test_places_of_nodes_count(tmp_path, content, node):
    document, rest = chunks(content)
    index = next(i for i, n in enumerate(document["nodes"]) if "mesh" in n)
    document["nodes"][index] |= node
    path = tmp_path / "ball.glb"
    path.write_bytes(packed(document, rest))
    own, other = read_textured_mesh(path), read_mesh(path)
    assert own.picture is not None
    assert np.allclose(own.vertices, other.vertices, atol=1e-6) and np.array_equal(own.faces, other.faces)


def test_other_files_come_through_trimesh_without_their_texture(tmp_path):
    two = trimesh.Scene([textured(), trimesh.creation.box()])
    two.export(tmp_path / "two.glb")
    trimesh.creation.box().export(tmp_path / "box.ply")
    for name in ("two.glb", "box.ply"):
        own, other = read_textured_mesh(tmp_path / name), read_mesh(tmp_path / name)
        assert np.array_equal(own.vertices, other.vertices) and np.array_equal(own.faces, other.faces)
        assert own.uv is None and own.picture is None


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"cup\.glb: there is no such mesh"):
        read_textured_mesh(tmp_path / "cup.glb")


DAMAGES = {
    "indices beyond the vertices": lambda d: d["accessors"][d["meshes"][0]["primitives"][0]["indices"]].update(
        bufferView=d["accessors"][d["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]["bufferView"], count=3
    ),
    "count of garbage": lambda d: d["accessors"][0].update(count=2**40),
    "negative start": lambda d: d["bufferViews"][0].update(byteOffset=-4),
    "circle of nodes": lambda d: d["nodes"][0].update(children=[0]),
    "other file": lambda d: d["buffers"][0].update(uri="../../secret.bin"),
    "place that is no number": lambda d: d["nodes"][0].update(matrix=["x"] * 16),
    "negative index": lambda d: d["meshes"][0]["primitives"][0].update(indices=-1),
    "no nodes": lambda d: d.pop("nodes"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_damaged_references_are_refused(tmp_path, content, what):
    document, rest = chunks(content)
    DAMAGES[what](document)
    path = tmp_path / "ball.glb"
    path.write_bytes(packed(document, rest))
    with pytest.raises(InputError, match=r"ball\.glb"):
        read_textured_mesh(path)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_garbage_is_refused_or_read_but_never_worse(tmp_path, content, data):
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, min(len(content) - 1, 2600)))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(content)))
    path = tmp_path / "ball.glb"
    path.write_bytes(bytes(damaged[:cut]) if data.draw(st.booleans()) else bytes(damaged))
    with contextlib.suppress(InputError):
        mesh = read_textured_mesh(path)
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)


def textured_sphere():
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
    scene.add_geometry(textured_sphere(), transform=turn)
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


def test_meshes_that_cannot_be_deformed_are_named(tmp_path):
    source = tmp_path / "a.glb"
    with pytest.raises(InputError, match="no such mesh"):
        write_moved_mesh(source, tmp_path / "b.glb", np.zeros((3, 3)), np.zeros((1, 3), int))
    trimesh.creation.box().export(source)
    with pytest.raises(InputError, match=r"has 8 vertices, but 9"):
        write_moved_mesh(source, tmp_path / "b.glb", np.random.default_rng(0).random((9, 3)), np.array([[0, 1, 8]]))
    source.write_bytes(b"glTF" + bytes(50))
    with pytest.raises(InputError, match="not a readable mesh"):
        write_moved_mesh(source, tmp_path / "b.glb", np.zeros((8, 3)), np.zeros((1, 3), int))
