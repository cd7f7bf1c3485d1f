# SPDX-License-Identifier: GPL-3.0-or-later
"""The preview's worker as Blender meets it: a real process, requests on its input, events on its output."""

import dataclasses
import json
import queue
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import trimesh
from physgen.sim.app.preview_server import MAX_LINE, parse_request, read_line
from physgen.sim.app.preview_simulation import STEPS_PER_SECOND, ProxyMesh, prepare_preview, proxy_mesh, without_tiny
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import IDENTITY4, Box, Camera, Contact, Effect, Material, SceneModel, SceneObject
from physgen.sim.weak_cache import WeakCache

WAIT_S = 120.0
"""A worker that compiles on a busy machine takes its time; a test that waits this long has failed."""


def scene_folder(root: Path, **fields) -> Scene:
    """A ball of 10 cm in the air."""
    (root / "meshes").mkdir(parents=True)
    ball = trimesh.creation.icosphere(2, 0.05)
    ball.apply_translation((0, 0, 0.1))
    ball.export(root / "meshes" / "ball.ply")
    for name in ("photo.png", "background.png"):
        (root / name).write_bytes(b"")
    material = fields.pop("material", Material(law="rigid"))
    item = SceneObject(name="ball", mesh="meshes/ball.ply", size_m=0.1, material=material, **fields)
    camera = Camera(width=4, height=4, fx=4.0, fy=4.0, cx=2.0, cy=2.0, world_from_camera=IDENTITY4)
    scene = SceneModel(camera=camera, objects=(item,), photo="photo.png", background="background.png")
    return save_scene(root, scene)


class Worker:
    """The process, and its events as they come."""

    def __init__(self, out: Path) -> None:
        command = [sys.executable, "-m", "physgen.batch.cli", "preview", "--out", str(out)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._events = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self._events.put(json.loads(line))

    def write(self, data: bytes) -> None:
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def ask(self, number: int, scene: Scene, **request) -> None:
        self.write(json.dumps({"id": number, "scene": str(scene.root), "frames": 6, **request}).encode() + b"\n")

    def until(self, kind: str, number: int | None = None) -> list[dict]:
        """The events up to one of this kind and request."""
        events = []
        while True:
            events.append(self._events.get(timeout=WAIT_S))
            if events[-1]["event"] == kind and events[-1].get("id") == number:
                return events


@pytest.fixture(scope="module")
def worker(tmp_path_factory):
    """One for all, because it compiles once; in the end it has to go when its input is closed."""
    runs = tmp_path_factory.mktemp("runs")
    found = Worker(runs)
    yield found
    found.process.stdin.close()
    try:
        assert found.process.wait(WAIT_S) == 0
        assert list(runs.iterdir()) == []
    finally:
        found.process.kill()


def test_a_run_arrives_frame_by_frame_and_the_next_one_takes_its_place(worker, tmp_path):
    scene = scene_folder(tmp_path / "scene")
    worker.ask(1, scene, overrides=["ball.velocity=1,0,0", "scene.gravity=0,0,0"], fps=20.0)
    events = worker.until("done", 1)
    started = next(event for event in events if event["event"] == "started")
    folder = Path(started["folder"])
    assert [event["done"] for event in events if event["event"] == "frame"] == [1, 2, 3, 4, 5, 6]
    faces = np.load(folder / "ball.faces.npy")
    cache = Pc2Reader(folder / "ball.pc2")
    assert (len(faces), cache.vertex_count) == (started["objects"][0]["triangles"], started["objects"][0]["vertices"])
    way = cache.sample(5).mean(axis=0) - cache.sample(0).mean(axis=0)
    assert way == pytest.approx([0.25, 0, 0], abs=1e-3)

    worker.ask(2, scene, overrides=["ball.velocity=0,2,0"], fps=20.0)
    worker.until("done", 2)
    assert Pc2Reader(folder.with_name("run-2") / "ball.pc2").sample_count == 6


def test_a_newer_request_ends_the_running_one(worker, tmp_path):
    scene = scene_folder(tmp_path / "scene", start_time=1e4)
    worker.ask(1, scene, frames=1000, fps=1.0)
    worker.until("started", 1)
    worker.ask(2, scene)
    events = worker.until("done", 2)
    assert {"event": "cancelled", "id": 1} in events
    assert {"event": "done", "id": 1} not in [{k: e.get(k) for k in ("event", "id")} for e in events]


def test_wrong_requests_are_answered_and_the_worker_lives_on(worker, tmp_path):
    scene = scene_folder(tmp_path / "scene")
    worker.write(b"\xff\xfe nonsense\n[1, 2]\n\n" + b"[" * 100_000 + b"\n")
    for _ in range(3):
        assert worker.until("error")[-1]["kind"] == "InputError"
    worker.write(b'{"id": 3, "scene": "' + b"x" * (2 * MAX_LINE) + b'"}\n')
    assert "longer" in worker.until("error")[-1]["message"]
    worker.write(b'{"id": 4, "scene": "nowhere", "speed": 2}\n')
    assert "speed" in worker.until("error", 4)[-1]["message"]
    worker.ask(5, scene, overrides=["cube.velocity=1,0,0"])
    assert "'cube'" in worker.until("error", 5)[-1]["message"]
    worker.ask(6, Scene(root=tmp_path / "gone", model=scene.model))
    assert "gone" in worker.until("error", 6)[-1]["message"]
    worker.ask(7, scene)
    worker.until("done", 7)


def test_server_ends_when_input_closes_during_a_run(tmp_path):
    worker = Worker(tmp_path / "runs")
    worker.ask(1, scene_folder(tmp_path / "scene", start_time=1e4), frames=1000, fps=1.0)
    worker.until("started", 1)
    worker.process.stdin.close()
    worker.process.wait(WAIT_S)
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.parametrize(
    "change", [{"id": -1}, {"frames": 1}, {"fps": 0.0}, {"particles": 10}, {"id": True}, {"overrides": "a"}]
)
def test_requests_out_of_range_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        parse_request(json.dumps({"id": 1, "scene": "s", **change}).encode())


def test_a_long_line_is_skipped_to_its_end(tmp_path):
    path = tmp_path / "lines"
    path.write_bytes(b"x" * (3 * MAX_LINE) + b"\nnext\r\nlast")
    with path.open("rb") as stream:
        with pytest.raises(InputError, match="longer"):
            read_line(stream)
        assert [read_line(stream) for _ in range(3)] == [b"next", b"last", None]


@pytest.mark.parametrize("law", ["fixed_corotated", "sand", "fluid"])
def test_stiff_matter_is_softened_to_the_steps_that_there_are(tmp_path, law):
    stiff = Material(law=law, youngs_modulus=1e9, bulk_modulus=1e9)
    folder = scene_folder(tmp_path / "scene", material=stiff)
    meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
    prepared, notices = prepare_preview(folder, meshes, frames=24, fps=24.0, particles=2000)
    assert 500 <= prepared.particle_count <= 4000
    assert 1 / prepared.stable_step < 2 * STEPS_PER_SECOND
    assert any("ball" in text and "softer" in text for text in notices)
    soft = scene_folder(tmp_path / "soft", material=Material(youngs_modulus=1e4))
    assert prepare_preview(soft, meshes, frames=24, fps=24.0, particles=2000)[1] == []


def test_thin_walls_and_small_pins_do_not_stop_a_coarse_run(tmp_path):
    pin = Box(low=(0.0, 0.0, 0.145), high=(0.001, 0.001, 0.146))
    folder = scene_folder(tmp_path / "scene", material=Material(), fill=False, shell_thickness=1e-4, pins=(pin,))
    meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
    prepared, _ = prepare_preview(folder, meshes, frames=24, fps=24.0, particles=2000)
    pinned = prepared.setup.bodies[0].pins
    assert 0 < pinned.sum() < 0.05 * prepared.particle_count


@pytest.mark.parametrize(("share", "stays"), [(0.4, True), (0.1, False)])
def test_objects_of_several_sizes_take_a_bounded_number_of_particles(tmp_path, share, stays):
    folder = scene_folder(tmp_path / "scene", material=Material())
    rows = ((share, 0.0, 0.0, 0.3), (0.0, share, 0.0, 0.0), (0.0, 0.0, share, 0.1), (0.0, 0.0, 0.0, 1.0))
    large = folder.model.objects[0]
    scene = dataclasses.replace(
        folder.model,
        objects=(large, dataclasses.replace(large, name="small", world_from_mesh=rows)),
        effects=(Effect(name="wind", objects=("small",)), Effect(name="wind", objects=("ball", "small"))),
        contacts=(Contact(between=("ball", "small"), friction=0.1), Contact(between=("ball", "ground"), friction=0.1)),
    )
    folder = Scene(root=folder.root, model=scene)
    meshes = [load_object_mesh(folder, item) for item in scene.objects]
    scene, left, notices = without_tiny(scene, meshes, 2000)
    assert left == ([0, 1] if stays else [0]) and len(notices) == (0 if stays else 1)
    assert len(scene.effects) == len(scene.contacts) == (2 if stays else 1)
    prepared, _ = prepare_preview(
        Scene(root=folder.root, model=dataclasses.replace(scene, effects=())),
        [meshes[i] for i in left],
        frames=24,
        fps=24.0,
        particles=2000,
    )
    assert 1000 < prepared.particle_count < 7000


def test_a_fine_mesh_gets_a_proxy_of_its_shape():
    ball = trimesh.creation.icosphere(5, 0.5)
    mesh = ProxyMesh(vertices=np.asarray(ball.vertices), faces=np.asarray(ball.faces))
    small = proxy_mesh(mesh, most=2000)
    assert 500 < len(small.vertices) <= 2000
    radii = np.linalg.norm(small.vertices, axis=1)
    assert radii.min() > 0.47 and radii.max() < 0.501
    assert trimesh.Trimesh(small.vertices, small.faces, process=False).area == pytest.approx(ball.area, rel=0.05)


def test_vertices_in_one_place_become_one_vertex():
    box = trimesh.creation.box((1, 1, 1))
    torn = ProxyMesh(vertices=box.vertices[box.faces].reshape(-1, 3), faces=np.arange(36).reshape(-1, 3))
    small = proxy_mesh(torn)
    assert len(small.vertices) == 8 and len(small.faces) == 12


def test_results_are_kept_as_long_as_their_owner():
    class Owner:
        pass

    kept, made = WeakCache(most=2), []
    owner = Owner()
    for value in (1, 1, 2, 3, 3, 1):
        assert kept.get(owner, value, lambda value=value: made.append(value) or value) == value
    assert made == [1, 2, 3, 1]
    del owner
    assert len(kept._of) == 0
