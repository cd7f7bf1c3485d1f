# SPDX-License-Identifier: MIT
"""The GLB reader of our own: what trimesh reads, without it; garbage is refused by name."""

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
from physgen.sim.scene import glb
from physgen.sim.scene.glb import read_textured_mesh
from physgen.sim.scene.meshes import read_mesh
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


def test_it_reads_what_trimesh_reads(tmp_path, content):
    path = tmp_path / "ball.glb"
    path.write_bytes(content)
    own, other = glb._parse(content), read_mesh(path)
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
