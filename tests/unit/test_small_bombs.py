# SPDX-License-Identifier: MIT
"""Small folders from somebody else that ask for much: hours, all memory, or files that are not theirs."""

import contextlib
import dataclasses
import json
import os
import signal
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from physgen.batch.farm.planning.job_file import load_job
from physgen.sim import atomic
from physgen.sim.app.scene_bodies import colliders_of
from physgen.sim.cache.bake_folder import BakedObject, free_bake, save_manifest
from physgen.sim.diagnose.capture_folder import load_capture
from physgen.sim.errors import InputError
from physgen.sim.folder_lock import folder_lock
from physgen.sim.importers.coco_masks import masks_from_json
from physgen.sim.importers.recordings import read_recording
from physgen.sim.importers.rigid_models import read_rigid_model
from physgen.sim.mpm.scene_contacts import contact_table
from physgen.sim.processes import own_mark
from physgen.sim.scene.folder import load_scene, parse_scene, save_scene, scene_to_json, side_files
from physgen.sim.scene.meshes import load_object_mesh, load_vertex_track, read_mesh
from physgen.sim.scene.scene_object import Contact, Motion

from ..conftest import complete_manifest

CPU_S = 8.0
"""Far above what each takes now, and below what it took."""


@contextlib.contextmanager
def within_seconds():
    """At most ``CPU_S`` of computing, whatever else the machine does."""

    def stop(*_):
        raise AssertionError("takes too long")

    former = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, former)


def test_libraries_that_name_each_other_come_to_an_end(tmp_path):
    (tmp_path / "x.obj").write_text("mtllib a.mtl\nmtllib b.mtl\n")
    for name in "ab":
        (tmp_path / f"{name}.mtl").write_text("map_Kd a.mtl\nmap_Ks b.mtl\nbump skin.png\n")
    (tmp_path / "skin.png").write_bytes(b"")
    with within_seconds():
        assert side_files(tmp_path / "x.obj") == ["a.mtl", "b.mtl", "skin.png"]


def test_a_mesh_names_a_bounded_number_of_files(tmp_path, monkeypatch):
    monkeypatch.setattr("physgen.sim.scene.folder.MOST_BESIDE", 100)
    (tmp_path / "x.obj").write_text("mtllib " + " ".join(map(str, range(120))))
    with pytest.raises(InputError, match="names more than 100 files"):
        side_files(tmp_path / "x.obj")
    for index in range(70):
        (tmp_path / f"{index}.mtl").write_text("")
    (tmp_path / "x.obj").write_text("".join(f"mtllib {index}.mtl\n" for index in range(70)))
    with pytest.raises(InputError, match="names 70 material libraries"):
        side_files(tmp_path / "x.obj")


def many_objects(scene, count):
    """The JSON of ``scene`` with ``count`` objects, of different friction."""
    data = scene_to_json(scene.model)
    (first,) = data["objects"]
    data["objects"] = [{**first, "name": f"o{i}", "friction": 0.01 + 1e-4 * i} for i in range(count)]
    return data


def test_a_scene_has_a_bounded_number_of_objects(ball_scene, monkeypatch):
    monkeypatch.setattr("physgen.sim.scene.model.MOST_OBJECTS", 5)
    assert len(parse_scene(many_objects(ball_scene(), 5), "scene").objects) == 5
    with pytest.raises(InputError, match="number of objects is 6: a scene has at most 5"):
        parse_scene(many_objects(ball_scene(), 6), "scene")


def test_the_table_of_contacts_takes_as_long_as_it_has_pairs(ball_scene):
    scene = parse_scene(many_objects(ball_scene(), 300), "scene")
    scene = dataclasses.replace(scene, contacts=(Contact(between=("o3", "o1"), friction=0.25),))
    with within_seconds():
        table = contact_table(scene)
    assert len(table.pairs) >= 300 * 299 // 2
    assert table.between("o1", "o3").friction == table.between("o3", "o1").friction == 0.25


def glb(document, binary=b"\0" * 1024):
    """A GLB file with the description ``document``."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


TRIANGLES = {"componentType": 5126, "type": "VEC3", "count": 30, "bufferView": 0}
MANY = {**TRIANGLES, "count": 30_000}
PART = {"attributes": {"POSITION": 0}}


@pytest.mark.parametrize(
    "change",
    [
        # Numbers without data are zeros, as many as it says.
        {"accessors": [{"componentType": 5126, "type": "VEC3", "count": 10**9}]},
        # The same bytes again and again.
        {"bufferViews": [{"buffer": 0, "byteLength": 2**20}] * 4000},
        # One mesh, or one part of it, at many places.
        {"nodes": [{"mesh": 0}] * 9000, "accessors": [MANY]},
        {"meshes": [{"primitives": [PART] * 9000}], "accessors": [MANY]},
        {"nodes": [{"mesh": 0}] * 10_001},
        {"extras": [0] * 1001},
    ],
    ids=["no-data", "views", "places", "parts", "nodes", "text"],
)
def test_a_gltf_that_unpacks_to_too_much_is_refused_before_it_is(tmp_path, change, monkeypatch):
    if "extras" in change:
        monkeypatch.setattr("physgen.sim.scene.meshes.MAX_COMMAS", 1000)
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 1024}],
        "bufferViews": [{"buffer": 0, "byteLength": 360}],
        "accessors": [TRIANGLES],
        "meshes": [{"primitives": [PART]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    (tmp_path / "x.glb").write_bytes(glb(document))
    assert len(read_mesh(tmp_path / "x.glb").vertices) == 30
    (tmp_path / "x.glb").write_bytes(glb({**document, **change}))
    (tmp_path / "x.gltf").write_text(json.dumps({**document, **change}))
    for name in ("x.glb", "x.gltf"):
        with pytest.raises(InputError, match=r"unpacks to|more than 10000|too many parts"):
            read_mesh(tmp_path / name)


def test_a_buffer_that_is_named_many_times_is_read_as_often_as_it_fits(tmp_path, monkeypatch):
    monkeypatch.setattr("physgen.sim.scene.meshes.MAX_MESH_BYTES", 2000)
    exported = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box()))
    for name, content in exported.items():
        (tmp_path / name).write_bytes(content)
    document = json.loads((tmp_path / "model.gltf").read_text())
    assert len(read_mesh(tmp_path / "model.gltf").faces) == 12
    (tmp_path / "more.bin").write_bytes(b"\0" * 1900)
    document["buffers"] += [{"uri": "more.bin", "byteLength": 1900}] * 3
    (tmp_path / "model.gltf").write_text(json.dumps(document, separators=(",", ":")))
    with pytest.raises(InputError, match="there is no such mesh"):
        read_mesh(tmp_path / "model.gltf")


@pytest.fixture
def capture(tmp_path):
    """A capture whose two trials are one small file that unpacks to 2.4 MB."""
    (tmp_path / "capture").mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "capture" / "box.ply")
    arrays = {"times": np.arange(1000.0), "points": np.zeros((1000, 100, 3)), "object_index": np.zeros(100)}
    np.savez_compressed(tmp_path / "capture" / "take.npz", rest_points=np.zeros((100, 3)), **arrays)
    belief = {"name": "box", "mesh": "box.ply", "density_kg_m3": 400, "stiffness": "hard"}
    document = {"format": "physgen-capture/1", "gravity": [0, 0, -9.81], "ground": {}, "noise_sigma": 0.001}
    document["objects"] = [belief]
    document["trials"] = [{"name": name, "file": "take.npz", "role": "fit"} for name in "ab"]
    (tmp_path / "capture" / "capture.json").write_text(json.dumps(document))
    return tmp_path / "capture"


def test_trials_together_unpack_to_a_bounded_size(capture, monkeypatch):
    assert len(load_capture(capture).trials) == 2
    monkeypatch.setattr("physgen.sim.diagnose.capture_folder.MAX_CAPTURE_BYTES", 4_000_000)
    with pytest.raises(InputError, match="its trials take more than"):
        load_capture(capture)


def test_small_numbers_of_a_trial_count_as_what_they_become(capture, monkeypatch):
    monkeypatch.setattr("physgen.sim.diagnose.capture_folder.MAX_TRIAL_BYTES", 1_000_000)
    arrays = {"times": np.arange(1000.0), "points": np.zeros((1000, 100, 3), np.uint8), "object_index": np.zeros(100)}
    np.savez_compressed(capture / "take.npz", rest_points=np.zeros((100, 3)), **arrays)
    with pytest.raises(InputError, match="more numbers than fit"):
        load_capture(capture)


def test_meshes_that_a_capture_names_again_and_again_are_bounded(capture, monkeypatch):
    monkeypatch.setattr("physgen.sim.diagnose.capture_folder.MAX_CAPTURE_BYTES", 4_900_000)
    document = json.loads((capture / "capture.json").read_text())
    trimesh.creation.icosphere(5).export(capture / "box.ply")
    document["objects"] = [{**document["objects"][0], "name": f"o{i}"} for i in range(20)]
    (capture / "capture.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="its meshes take more than"):
        load_capture(capture)
    document["objects"] *= 60
    (capture / "capture.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="at most 1000"):
        load_capture(capture)


def test_a_file_with_a_hole_of_many_gigabytes_is_not_read_to_its_end(ball_scene):
    scene = ball_scene()
    with (scene.root / "meshes" / "ball0.glb").open("r+b") as file:
        file.truncate(9 * 2**30)
    with within_seconds(), pytest.raises(InputError, match="names files of more than 8 GiB"):
        load_scene(scene.root)


def test_vertex_tracks_together_are_bounded(ball_scene, monkeypatch):
    scene = ball_scene(count=2)
    items = []
    for item in scene.objects:
        mesh = load_object_mesh(scene, item)
        name = f"{item.name}.npz"
        np.savez_compressed(scene.root / name, times=np.arange(2.0), vertices=np.stack([mesh.vertices] * 2))
        assert len(load_vertex_track(scene.root / name, len(mesh.vertices))[0]) == 2
        moved = dataclasses.replace(item, role="collider", velocity=(0.0, 0.0, 0.0), motion=Motion(vertices_file=name))
        items.append((moved, mesh))
    assert len(colliders_of(scene, items)) == 2
    monkeypatch.setattr("physgen.sim.app.scene_bodies.MOST_TRACKS_BYTES", 40_000)
    with pytest.raises(InputError, match="ball1: the vertex tracks up to its own take more"):
        colliders_of(scene, items)


def test_a_job_makes_a_bounded_number_of_simulations(tmp_path, monkeypatch):
    monkeypatch.setattr("physgen.batch.farm.planning.job_file.MOST_SIMULATIONS", 5)
    (tmp_path / "cup.png").write_bytes(b"any")
    scene = '[[scenes]]\nname = "{}"\nphoto = "cup.png"\nboxes = [[1, 2, 30, 40]]\n'
    text = 'format = "physgen-jobs/1"\nname = "job"\n[matrix]\nseeds = [0, 1, 2]\n'
    (tmp_path / "jobs.toml").write_text(text + scene.format("a"))
    assert len(load_job(tmp_path / "jobs.toml").scenes[0].variants) == 3
    (tmp_path / "jobs.toml").write_text(text + scene.format("a") + scene.format("b"))
    with pytest.raises(InputError, match="more than 5 simulations"):
        load_job(tmp_path / "jobs.toml")


@pytest.mark.parametrize("name", ["../../mine/a", "/mine/a", "**/a", "**a", "*", "[", "a"])
def test_names_in_a_bake_are_no_patterns_of_what_is_deleted(tmp_path, name):
    bake, mine = tmp_path / "bake", tmp_path / "mine"
    for folder in (bake / "checkpoints", mine):
        folder.mkdir(parents=True)
        (folder / "a.00001.matter.npy").write_text("mine")
    save_manifest(bake, complete_manifest(BakedObject(name=name, file="a.pc2", vertices=4)))
    free_bake(bake)
    assert (mine / "a.00001.matter.npy").read_text() == "mine"
    assert (bake / "checkpoints" / "a.00001.matter.npy").exists() == (name != "a")


def test_a_lock_that_is_another_file_of_the_users_is_not_written(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    (tmp_path / "bake").mkdir()
    os.link(tmp_path / "thesis.txt", tmp_path / "bake" / ".lock")
    with pytest.raises(InputError, match="another name of another file"), folder_lock(tmp_path / "bake"):
        pass
    assert (tmp_path / "thesis.txt").read_text() == "mine"
    (tmp_path / "bake" / ".lock").unlink()
    os.mkfifo(tmp_path / "bake" / ".lock")
    with pytest.raises(InputError, match="a pipe"), folder_lock(tmp_path / "bake"):
        pass


@pytest.mark.parametrize("name", [".", ".."])
def test_what_was_moved_aside_is_not_put_back_over_the_folder_itself(ball_scene, name):
    root = ball_scene().root
    mark = own_mark()
    left = Path(root, f".{name}.old-{dataclasses.replace(mark, pid=2**22 + 7)}")
    left.mkdir()
    assert len(atomic.recover(root)) == 1 and not left.exists()
    assert load_scene(root) == save_scene(root, load_scene(root).model)


def test_a_mesh_that_a_model_names_again_and_again_is_read_once_and_bounded(tmp_path, monkeypatch):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.stl")
    asset = '<asset><mesh name="m" file="box.stl"/></asset>'
    bodies = "".join(f'<body name="b{i}"><freejoint/><geom type="mesh" mesh="m"/></body>' for i in range(30))
    (tmp_path / "x.xml").write_text(f"<mujoco>{asset}<worldbody>{bodies}</worldbody></mujoco>")
    model = read_rigid_model(tmp_path / "x.xml")
    assert len(model.bodies) == 30 and all(len(body.faces) == 12 for body in model.bodies)
    monkeypatch.setattr("physgen.sim.importers.rigid_parts.MAX_ALL_VERTICES", 20 * len(model.bodies[0].vertices))
    with pytest.raises(InputError, match="vertices together"):
        read_rigid_model(tmp_path / "x.xml")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("x.csv", "time,x,y,z\n" + "0,0,0,0\n" * 100),
        ("x.csv", "time," + ",".join(f"p{i}_x,p{i}_y" for i in range(20)) + "\n1,2\n"),
        ("x.trk", None),
    ],
)
def test_tables_of_motion_are_bounded(tmp_path, monkeypatch, name, text):
    if text is None:
        point = "<property name='framedata'><property name='[{}]'><object><property name='x'>1</property></object>"
        point = point.replace("</object>", "<property name='y'>1</property></object></property></property>")
        mass = "<object class='tracker.PointMass'><property name='name'>{}</property>{}</object>"
        masses = "".join(mass.format(i, point.format(i)) for i in range(30))
        frame = "".join(f"<property name='{n}'>1</property>" for n in ("xscale", "xorigin", "yorigin"))
        system = f"<object class='ImageCoordSystem'><object class='FrameData'>{frame}</object></object>"
        clip = "<object class='ClipControl'><property name='delta_t'>40</property></object>"
        text = f"<x>{masses}{system}{clip}</x>"
        (tmp_path / name).write_text(text)
        assert read_recording(tmp_path / name)[0].points.shape == (30, 30, 3)
    (tmp_path / name).write_text(text)
    monkeypatch.setattr("physgen.sim.importers.recordings.MOST_CELLS", 300)
    monkeypatch.setattr("physgen.sim.importers.recordings.MOST_COLUMNS", 30)
    with pytest.raises(InputError, match=r"at most 300|too many; save fewer"):
        read_recording(tmp_path / name)


def test_a_long_heading_is_refused_within_seconds(tmp_path):
    (tmp_path / "x.csv").write_text("time,x,y,z" + " " * 100_000 + "a\n" + "0,0,0,0\n" * 9)
    with within_seconds(), pytest.raises(InputError, match="a heading of 100002 characters"):
        read_recording(tmp_path / "x.csv")


def test_polygons_that_take_too_long_to_fill_are_refused(tmp_path):
    angles = np.linspace(0, 6.2, 20_000)
    star = np.stack([1000 + 990 * np.cos(37 * angles), 1000 + 990 * np.sin(41 * angles)], axis=1).round(1)
    small = [10, 10, 40, 10, 40, 30]
    for corners, good in ((small, True), (star.ravel().tolist(), False)):
        (tmp_path / "masks.json").write_text(json.dumps([{"segmentation": [corners]}]))
        with (
            within_seconds(),
            contextlib.nullcontext() if good else pytest.raises(InputError, match="too many corners"),
        ):
            assert masks_from_json(tmp_path / "masks.json", 2000, 2000, "photo.png")[0].mask.sum() > 200


@pytest.mark.parametrize(("place", "most"), [("effects", 1000), ("pins", 1000)])
def test_lists_in_a_scene_are_bounded(ball_scene, place, most):
    data = scene_to_json(ball_scene().model)
    where = data if place == "effects" else data["objects"][0]
    one = {"name": "wind", "parameters": {}} if place == "effects" else {"low": [-1, -1, -1], "high": [1, 1, 1]}
    where[place] = [one] * most
    parse_scene(data, "scene")
    where[place] = [one] * (most + 1)
    with pytest.raises(InputError, match=f"number of {place} is {most + 1}"):
        parse_scene(data, "scene")


@pytest.mark.parametrize("other", ["CUP", "\u8c48", "stra\u00dfe"])
def test_names_that_some_disk_takes_for_one_are_refused(ball_scene, other):
    """Letters large and small, and letters that are composed to the same one (NFC), as on macOS."""
    twins = {"CUP": "cup", "\u8c48": "\uf900", "stra\u00dfe": "STRASSE"}
    data = many_objects(ball_scene(), 2)
    data["objects"][0]["name"], data["objects"][1]["name"] = other, twins[other]
    with pytest.raises(InputError, match="a name of its own"):
        parse_scene(data, "scene")
