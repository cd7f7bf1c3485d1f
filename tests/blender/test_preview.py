# SPDX-License-Identifier: GPL-3.0-or-later
"""Live preview and arrows without a window: the client driven by hand, against the real worker."""

import sys
import time
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from mathutils import Matrix, Vector
from physgen.physgen_addon import gizmos as maths
from physgen.physgen_addon.gizmos import SHOW_ARROWS
from physgen.physgen_addon.interpreter import cli_command
from physgen.physgen_addon.preview import live_preview, preview_session
from physgen.physgen_addon.preview.preview_session import Session
from physgen.physgen_addon.preview.preview_worker import Clip, shade_vertices
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.errors import InputError

WAIT_S = 120.0


pytestmark = pytest.mark.usefixtures("addon")


def add_body(name="Ball", law="rigid", location=(0.0, 0.0, 1.0)):
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, radius=0.2, location=location)
    item = bpy.context.object
    item.name = name
    item.physgen.enabled = True
    item.physgen.material.law = law
    bpy.context.view_layer.update()
    return item


def step_until(session, reached):
    """Step ``session`` as the timer does."""
    end = time.monotonic() + WAIT_S
    while not reached():
        assert time.monotonic() < end, (session.state, session.message)
        session.step()
        time.sleep(0.01)


def command(runs):
    return cli_command(Path(sys.executable), "preview", "--out", str(runs))


def test_frames_arrive_a_changed_number_runs_again_and_stop_leaves_nothing():
    ball = add_body("Ball ä.001")
    scene = bpy.context.scene
    scene.physgen.simulation.frame_end = 8
    scene.use_gravity = False
    session = Session(scene.session_uid, command)
    session.start()
    step_until(session, lambda: session.state in ("playing", "error"))
    assert session.message == "" and session.clip.done == 8
    first = session.clip
    assert np.ptp([sample.mean(axis=0) for sample in first.proxies[0].samples], axis=0).max() < 1e-5

    ball.physgen.velocity = (0.0, 3.0, 0.0)
    step_until(session, lambda: session.clip is not first and session.state in ("playing", "error"))
    moved = session.clip.proxies[0].samples
    assert moved[7].mean(axis=0) - moved[0].mean(axis=0) == pytest.approx([0, 3 * 7 / 24, 0], abs=1e-3)

    second = session.clip
    ball.location.x = 5.0
    step_until(session, lambda: session.clip is not second and session.state in ("playing", "error"))
    assert session.clip.proxies[0].samples[0].mean(axis=0)[0] == pytest.approx(5.0, abs=1e-3)

    root = session._root
    assert root.is_dir()
    session.stop()
    assert session.join(WAIT_S) and not root.exists()


def test_preview_reports_invalid_scenes_and_recovers():
    ball = add_body()
    ball.scale.z = 0.0
    session = Session(bpy.context.scene.session_uid, command)
    session.step(0.0)
    assert session.state == "error" and "Ball" in session.message
    ball.scale.z = 1.0
    bpy.context.view_layer.update()
    session.step(10.0)
    assert session._number == 1
    session.stop()
    assert not session._root.exists()


def test_a_worker_that_cannot_start_is_an_error_and_no_hang():
    def broken(runs):
        raise InputError("no Python that can simulate")

    add_body()
    session = Session(bpy.context.scene.session_uid, broken)
    session.start()
    step_until(session, lambda: session.state == "error")
    assert "no Python" in session.message
    session.stop()
    assert session.join(5.0) and not session._root.exists()


def test_a_worker_that_dies_says_its_last_words():
    add_body()
    dying = [sys.executable, "-c", "raise SystemExit('out of luck')"]
    session = Session(bpy.context.scene.session_uid, lambda runs: dying)
    session.start()
    step_until(session, lambda: session.state == "error")
    assert "out of luck" in session.message
    session.stop()
    assert session.join(5.0) and not session._root.exists()


def test_the_operator_needs_a_body_and_toggles():
    assert not bpy.ops.physgen.toggle_preview.poll()
    add_body()
    assert bpy.ops.physgen.toggle_preview() == {"FINISHED"}
    session = live_preview.session()
    assert session is not None and session.scene() == bpy.context.scene
    bpy.context.scene.name = "renamed"
    assert session.scene() == bpy.context.scene
    assert bpy.ops.physgen.toggle_preview() == {"FINISHED"}
    assert live_preview.session() is None
    assert session.join(WAIT_S)


def test_another_file_ends_the_preview():
    add_body()
    bpy.ops.physgen.toggle_preview()
    session = live_preview.session()
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    assert live_preview.session() is None and session.join(WAIT_S)


def test_numbers_change_numbers_and_shapes_change_shapes():
    ball = add_body()
    scene = bpy.context.scene
    numbers, shapes = preview_session.watched_numbers(scene), preview_session.watched_shapes(scene)
    ball.physgen.velocity.x = 2.0
    ball.physgen.pushes.add().velocity.x = 3.0
    ball.physgen.material.density = 500.0
    ball.physgen.own_surface = True
    scene.physgen.world.friction = 0.1
    scene.gravity.z = -1.0
    changed = set(preview_session.watched_numbers(scene)) - set(numbers)
    assert {text.split("=")[0] for text in changed} == {
        "Ball.velocity",
        "Ball.velocity_keys",
        "Ball.density",
        "Ball.friction",
        "Ball.static_friction",
        "Ball.restitution",
        "Ball.contact_mode",
        "ground.friction",
        "scene.gravity",
    }
    assert preview_session.watched_shapes(scene) == shapes
    ball.physgen.pushes.clear()
    assert "Ball.velocity_keys=[]" in preview_session.watched_numbers(scene)
    ball.data.vertices[0].co.x += 0.01
    bent = preview_session.watched_shapes(scene)
    ball.location.x += 1.0
    assert len({shapes, bent, preview_session.watched_shapes(scene)}) == 3


def test_a_clip_waits_for_the_worker_and_then_begins_again(tmp_path):
    points = np.zeros((3, 3), dtype=np.float32)
    np.save(tmp_path / "a.faces.npy", np.array([[0, 1, 2]], dtype=np.int32))
    with Pc2Writer(tmp_path / "a.pc2", vertex_count=3) as writer:
        for number in range(10):
            writer.append(points + number)
    clip = Clip(tmp_path, {"objects": [{"name": "a", "vertices": 3}]}, frames=10, fps=10.0)
    clip.read(3)
    times = np.arange(0.0, 1.0, 0.1)
    assert [clip.frame_at(now) for now in times] == [0, 1, 2, 2, 2, 2, 2, 2, 2, 2]
    clip.read(10)
    assert [float(sample[0, 0]) for sample in clip.proxies[0].samples] == list(range(10))
    shown = [clip.frame_at(now) for now in np.arange(1.0, 3.0, 0.1)]
    again = shown.index(0)
    assert shown[:again] == [3, 4, 5, 6, 7, 8] + [9] * (again - 6) and 9 <= again <= 12
    assert shown[again:] == list(range(20 - again))
    np.save(tmp_path / "a.faces.npy", np.array([[0, 1, 3]], dtype=np.int32))
    with pytest.raises(InputError, match="damaged"):
        Clip(tmp_path, {"objects": [{"name": "a", "vertices": 3}]}, frames=10, fps=10.0)


def test_the_lit_side_is_brighter():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
    up, down = (shade_vertices(points, np.array([face], dtype=np.int32)) for face in ((0, 1, 2), (2, 1, 0)))
    assert (up[:, :3] > 1.5 * down[:, :3]).all() and (up[:, 3] == down[:, 3]).all()


def look_down(distance=10.0):
    """A perspective matrix that looks down the Z axis from ``distance``, 90 degrees wide and high."""
    near, far = 0.1, 100.0
    depth = [[0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)], [0, 0, -1, 0]]
    view = np.eye(4)
    view[2, 3] = -distance
    return np.array([[1, 0, 0, 0], [0, 1, 0, 0], *depth], dtype=np.float64) @ view


@pytest.mark.parametrize(
    "projection",
    [
        ((2.0, 0, 0, 0), (0, 3.0, 0, 0), (0, 0, -1.002, -0.2), (0, 0, -1, 0)),
        ((0.2, 0, 0, 0), (0, 0.3, 0, 0), (0, 0, -0.01, 0), (0, 0, 0, 1)),
    ],
    ids=["perspective", "orthographic"],
)
def test_the_preview_lies_before_the_objects_and_nowhere_else(projection):
    """Its first frame is theirs, and both showed through each other in patches."""
    projection = Matrix(projection)
    view = Matrix.Translation((0.3, -0.2, -5)) @ Matrix.Rotation(0.7, 4, "X")

    def seen(matrix, place):
        at = projection @ matrix @ Vector((*place, 1))
        return np.array(at[:3]) / at[3]

    for place in ((0, 0, 0), (0.5, -1, 2), (-1, 1, -0.5)):
        before, drawn = seen(view, place), seen(live_preview.nearer(view, projection), place)
        assert drawn[:2] == pytest.approx(before[:2], abs=1e-6) and drawn[2] < before[2] - 1e-5


def test_pixels_and_places_agree():
    matrix = look_down()
    pixel = maths.pixel_size(matrix, np.zeros(3), 400)
    # 20 m across 400 pixels.
    assert pixel == pytest.approx(0.05)
    assert maths.on_screen(matrix, np.array([pixel * 30, 0, 0]), 400, 400) == pytest.approx([230, 200])
    assert maths.on_screen(matrix, np.array([0, 0, 11.0]), 400, 400) is None


def test_a_dragged_tip_stays_in_its_plane():
    start, origin, forward = np.array([1.0, 2.0, 3.0]), np.array([0.0, -10.0, 5.0]), np.array([0.0, 1.0, 0.0])
    ray = np.array([0.2, 1.0, -0.1])
    free = maths.dragged(start, origin, ray, forward, maths.FREE)
    assert free == pytest.approx([2.4, 2.0, 3.8])
    level = maths.dragged(start, origin, ray, forward, maths.LEVEL)
    assert level == pytest.approx([4.0, 10.0, 3.0])
    assert maths.dragged(start, origin, ray, forward, maths.UPRIGHT) == pytest.approx([1.0, 2.0, 3.8])
    assert maths.dragged(start, origin, np.array([1.0, 1.0, 0.0]), forward, maths.LEVEL) is None
    assert maths.dragged(start, origin, ray, np.array([0.0, 0.0, -1.0]), maths.UPRIGHT) is None


def test_arrows_suit_the_size_of_the_body():
    # Thrown up with an arrow as long as itself, a body rises by half its size, whatever the size and the units.
    for size, unit in ((0.1, 1.0), (5.0, 1.0), (10.0, 0.01)):
        velocity = size / maths.seconds_shown(size, unit) * unit
        assert velocity**2 / (2 * maths.GRAVITY) == pytest.approx(size * unit / 2)
    assert maths.spin_length(0.3) * maths.TURN == pytest.approx(0.3)


@pytest.mark.parametrize("direction", [(0, 0, 0), (0, 0, -2), (0, 5, 0), (1, 2, 3)])
def test_frames_are_rotations_along_the_arrow(direction):
    turn = maths.frame_along(np.array(direction, dtype=float))
    assert turn @ turn.T == pytest.approx(np.eye(3)) and np.linalg.det(turn) == pytest.approx(1)
    length = np.linalg.norm(direction)
    assert turn[:, 2] == pytest.approx(np.array(direction) / length if length else [0, 0, 1])


def test_the_switch_of_the_arrows_is_in_no_file(tmp_path):
    manager = bpy.context.window_manager
    assert getattr(manager, SHOW_ARROWS)
    setattr(manager, SHOW_ARROWS, False)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert not getattr(bpy.context.window_manager, SHOW_ARROWS) or bpy.app.background
