# SPDX-License-Identifier: GPL-3.0-or-later
"""Compose Objects in Blender, with the real optimiser in its process: what moves, what stays, what is refused."""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from mathutils import Matrix
from physgen.physgen_addon import background_jobs
from physgen.physgen_addon.operators import compose_ops
from physgen.physgen_addon.operators.compose_ops import Compose, PHYSGEN_OT_compose_objects
from physgen.physgen_addon.scene_io.export_compose import ORIGINAL, export_composition
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh

STEPS = 6
"""The first takes the balls apart already; what a step is is tested where the optimiser is."""


@pytest.fixture(autouse=True)
def settings(addon):
    bpy.context.scene.physgen_compose.method = "ppps"
    bpy.context.scene.physgen_compose.steps = STEPS


def a_ball(name, x, radius=0.05, subdivisions=3):
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=subdivisions, radius=radius, location=(x, 0, 0.2))
    item = bpy.context.object
    item.name = item.data.name = name
    return item


def select(active, *others):
    bpy.context.view_layer.update()
    for item in bpy.context.view_layer.objects:
        item.select_set(item in (active, *others))
    bpy.context.view_layer.objects.active = active


def points(item):
    result = np.empty(3 * len(item.data.vertices), dtype=np.float32)
    item.data.vertices.foreach_get("co", result)
    return result.reshape(-1, 3).astype(np.float64)


def world(item):
    matrix = np.array(item.matrix_world)
    return points(item) @ matrix[:3, :3].T + matrix[:3, 3]


def deepest_in_ball(item, centre, radius=0.05):
    return max(0.0, radius - float(np.linalg.norm(world(item) - centre, axis=1).min()))


def refused(words):
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.physgen.compose_objects()


@pytest.mark.long
def test_the_active_object_stays_and_the_others_yield():
    stays, yields = a_ball("Stays.001", 0.0), a_ball("Yields", 0.08)
    # An object of another scale and turn: its mesh is in its own space.
    yields.data.transform(Matrix.Scale(0.5, 4))
    yields.scale, yields.rotation_euler = (2, 2, 2), (0.3, 0.2, 0.1)
    select(stays, yields)
    before, rest = points(stays), points(yields)
    sunk = deepest_in_ball(yields, (0, 0, 0.2))
    assert bpy.ops.physgen.compose_objects() == {"FINISHED"}
    assert np.array_equal(points(stays), before) and stays.data.shape_keys is None
    assert sunk > 0.015 and deepest_in_ball(yields, (0, 0, 0.2)) < 0.05 * sunk
    assert len(points(yields)) == len(rest) and not np.allclose(points(yields), rest)
    # The shape from before can be dialled back.
    key = yields.data.shape_keys.key_blocks[ORIGINAL]
    kept = np.empty(rest.size, dtype=np.float32)
    key.data.foreach_get("co", kept)
    assert key.value == 0 and np.array_equal(kept.reshape(-1, 3), rest)
    shown = yields.evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert np.allclose(points(shown), points(yields))
    pair = bpy.context.scene.physgen_compose.pairs[0]
    assert pair.name == "Stays.001 – Yields"
    assert pair.volume_before > 1e-6 and pair.volume_after < 0.01 * pair.volume_before
    assert pair.deepest_before == pytest.approx(0.02, abs=0.003)
    assert not background_jobs.running()


@pytest.mark.long
def test_objects_that_share_a_mesh_part_ways_and_undo_takes_it_all_back():
    one = a_ball("one", 0.0, subdivisions=2)
    two = bpy.data.objects.new("two", one.data)
    two.location = (0.085, 0, 0.2)
    bpy.context.scene.collection.objects.link(two)
    bpy.context.scene.physgen_compose.keep_original = False
    select(two, one)
    rest = points(two)
    bpy.ops.ed.undo_push(message="before")
    # As from a button: Blender keeps the state after it by itself.
    assert bpy.ops.physgen.compose_objects("EXEC_DEFAULT", True) == {"FINISHED"}
    one, two = bpy.data.objects["one"], bpy.data.objects["two"]
    assert two.data != one.data and np.array_equal(points(two), rest) and not np.allclose(points(one), rest)
    assert one.data.shape_keys is None and two.data.shape_keys is None
    assert len(bpy.context.scene.physgen_compose.pairs) == 1
    bpy.ops.ed.undo()
    one, two = bpy.data.objects["one"], bpy.data.objects["two"]
    assert two.data == one.data and np.array_equal(points(one), rest)
    assert len(bpy.context.scene.physgen_compose.pairs) == 0


def test_impossible_composition_is_reported_and_changes_nothing():
    one, two = a_ball("one", 0.0, subdivisions=2), a_ball("two", 0.4, subdivisions=2)
    select(one, two)
    rest = points(two)
    refused(r"do not touch: they are 30\.\d cm apart")
    two.location.x = 0.08
    select(one)
    assert not bpy.ops.physgen.compose_objects.poll()
    select(one, two)
    bpy.context.scene.physgen_compose.method = "pse-sds"
    refused("there is no photo.*choose the method Physics")
    bpy.context.scene.physgen_compose.method = "ppps"
    modifier = two.modifiers.new("Array", "ARRAY")
    refused("'two'.*'Array' changes its shape.*apply it or hide it")
    two.modifiers.remove(modifier)
    two.shape_key_add(name="Basis")
    two.shape_key_add(name="fat")
    refused("'two'.*shape key 'fat'")
    two.shape_key_clear()
    two.data.polygons[0].select = True
    faces = [tuple(face.vertices) for face in two.data.polygons][8:]
    vertices = points(two)
    two.data.clear_geometry()
    two.data.from_pydata(vertices.tolist(), [], faces)
    refused("'two'.*not closed.*fill its holes")
    assert np.array_equal(points(two), rest)
    assert not list(Path(bpy.app.tempdir).glob("compose-*"))


def test_export_keeps_vertices_and_local_space(tmp_path):
    item, other = a_ball("Ball/ü", 0.0), a_ball("b", 0.08)
    bpy.context.scene.unit_settings.scale_length = 0.1
    item.scale = (1, 2, 1)
    found = export_composition(bpy.context.scene, [item, other], tmp_path, photo=None)
    folder = load_scene(tmp_path)
    mesh = load_object_mesh(folder, folder.model.objects[0])
    assert [entry.label for entry in found] == ["Ball/ü", "b"] and found[0].name == folder.model.objects[0].name
    assert np.array_equal(mesh.in_file, points(item)) and np.allclose(mesh.vertices, 0.1 * world(item))
    assert folder.model.ground is None and folder.model.photo is None


class Live(Compose):
    """As the modal timer drives it."""

    def __init__(self):
        self.said = []

    def report(self, kind, text):
        self.said.append((*kind, text))

    def run_until(self, reached):
        give_up = time.monotonic() + 120
        while not reached() and time.monotonic() < give_up:
            assert self.tick() is None, self.said
            time.sleep(0.05)
        assert reached(), self.said


@pytest.mark.long
def test_progress_is_shown_and_cancelling_changes_nothing():
    one, two = a_ball("one", 0.0, subdivisions=2), a_ball("two", 0.08, subdivisions=2)
    bpy.context.scene.physgen_compose.steps = 100_000
    select(one, two)
    rest = points(two)
    live = Live()
    job = live.begin(bpy.context)
    live.run_until(lambda: (job.done or 0) > 2)
    assert job.fraction is not None and job.fraction < 0.1 and not PHYSGEN_OT_compose_objects.poll(bpy.context)
    bpy.ops.physgen.cancel_job()
    assert live.tick() == {"CANCELLED"} and background_jobs.running() is None
    assert np.array_equal(points(two), rest) and two.data.shape_keys is None


def nothing_moved(command, *_, **__):
    """In place of ``run_stage``: a composition in which nothing had to move."""
    source, out = command[command.index("compose") + 1], command[command.index("--out") + 1]
    shutil.copytree(source, out)
    (Path(out) / "compose.json").write_text('{"pairs": []}')
    return {"event": "done"}


def test_a_mesh_that_was_edited_meanwhile_is_left_alone(monkeypatch):
    monkeypatch.setattr(compose_ops, "run_stage", nothing_moved)
    one, two = a_ball("one", 0.0, subdivisions=2), a_ball("two", 0.08, subdivisions=2)
    select(one, two)
    live = Live()
    live.begin(bpy.context)
    two.name = "renamed"
    two.data.clear_geometry()
    while (result := live.tick()) is None:
        time.sleep(0.05)
    assert result == {"CANCELLED"} and "was changed meanwhile" in live.said[-1][1]
