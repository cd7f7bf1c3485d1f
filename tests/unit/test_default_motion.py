# SPDX-License-Identifier: MIT
"""The motion chosen where none is given, the clip that suits it, and what is said of a clip before it is rendered."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.batch.commands import photo_commands
from physgen.batch.stages import Choices, choose_motion
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.app.clip_check import Clip, clip_notices, rehearsal_options, rehearsed
from physgen.sim.app.default_motion import SLOW, default_motion, fitted, tells_motion
from physgen.sim.app.free_space import Surface, hidden_share
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Camera, SceneModel, SceneObject


def looking_down(pitch_deg, distance, size=(600, 400), focal=550.0):
    """A camera that sees the origin in the middle, from ``distance`` m behind and above."""
    pitch = math.radians(pitch_deg)
    ahead = np.array([0.0, math.cos(pitch), -math.sin(pitch)])
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = -distance * ahead
    return Camera(
        width=size[0], height=size[1], fx=focal, fy=focal, cx=size[0] / 2, cy=size[1] / 2,
        world_from_camera=tuple(map(tuple, pose.tolist())),
    )  # fmt: skip


@pytest.fixture
def table(tmp_path):
    """A factory of scenes without a photo: boxes (x, y, z of the underside, width, depth, height) and presets."""

    def make(boxes, presets=("medium",), camera=None, **changes):
        root = tmp_path / "table"
        (root / "meshes").mkdir(parents=True, exist_ok=True)
        items = []
        for number, (x, y, z, *extents) in enumerate(boxes):
            mesh = trimesh.creation.box(extents).subdivide().subdivide()
            mesh.apply_translation((x, y, z + extents[2] / 2))
            mesh.export(root / f"meshes/{number}.glb")
            preset = load_preset(presets[number % len(presets)])
            name, file = f"box{number}", f"meshes/{number}.glb"
            items.append(SceneObject(name=name, mesh=file, size_m=max(extents), material=preset, **changes))
        scene = SceneModel(camera=camera or looking_down(30, 1.0), objects=tuple(items), photo=None, background=None)
        return save_scene(root, scene)

    return make


def flight(scene, move, times):
    """The vertices (T, V, 3) of a box in free flight of its first move, from the scene's own numbers."""
    item = next(item for item in scene.objects if item.name == move.name)
    vertices = load_object_mesh(scene, item).vertices
    centre = vertices.mean(axis=0)
    found = []
    for t in times:
        turn = trimesh.transformations.rotation_matrix(np.linalg.norm(item.spin) * t, item.spin)[:3, :3] \
            if any(item.spin) else np.eye(3)  # fmt: skip
        fall = np.array([0.0, 0.0, -0.5 * 9.81 * t * t])
        found.append((vertices - centre) @ turn.T + centre + np.asarray(item.velocity) * t + fall)
    return np.array(found)


BOX = st.tuples(
    st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.just(0.0),
    st.floats(0.02, 0.2), st.floats(0.02, 0.2), st.floats(0.02, 0.2),
)  # fmt: skip


@given(box=BOX, pitch=st.floats(10, 70), preset=st.sampled_from(["medium", "plush", "wood", "sand"]))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_seen_at_rest_stays_in_the_picture(table, box, pitch, preset):
    scene = table([box], [preset], looking_down(pitch, 0.8))
    motion = default_motion(scene)
    assert motion == default_motion(scene)
    moved = motion.applied(scene)
    size = (scene.model.camera.width, scene.model.camera.height)

    def beyond(points):
        pixels = scene.model.camera.project(points)[..., :2]
        return max(0.0, float(-pixels.min()), float((pixels - size).max()))

    vertices = load_object_mesh(scene, scene.objects[0]).vertices
    rest = beyond(vertices)
    # What the frame cuts at rest may leave it by a little more.
    most = rest + (0.12 * np.ptp(scene.model.camera.project(vertices)[:, :2], axis=0).max() if rest else 0.0) + 1e-6
    gone = np.zeros(3)
    for number, move in enumerate(motion.moves):
        if move.slides:
            # Friction takes v² / (2 μ g): the box is as free of the frame's edges where it stops.
            turn = 0.5 * move.spin[2] * move.flight_s
            stop = (
                vertices @ trimesh.transformations.rotation_matrix(turn, (0, 0, 1))[:3, :3].T
                if number == 0
                else vertices
            )
            assert beyond(stop + gone + np.asarray(move.aside)) <= most
            assert move.aside[2] == pytest.approx(0.0, abs=1e-6)
            gone = gone + move.aside
            continue
        if number:
            # From where it came to rest; its velocity is set then, and its spin is not.
            assert move.spin == (0.0, 0.0, 0.0) and move.height == pytest.approx(
                move.velocity[2] ** 2 / (2 * 9.81), rel=0.01
            )
            gone = gone + move.aside
            continue
        gone = gone + move.aside
        path = flight(moved, move, np.linspace(0, move.flight_s, 40))
        assert beyond(path) <= most
        # It peaks where the move says, and comes down where it says, as low as it stood, but for its lean.
        rise = (path.mean(axis=1) - path[0].mean(axis=0))[:, 2]
        assert rise.max() == pytest.approx(move.height, rel=0.01)
        assert np.allclose(path[-1].mean(axis=0) - path[0].mean(axis=0), move.aside, atol=1e-4)


def test_a_thing_in_the_middle_hops_and_its_clip_is_long_enough(table):
    scene = table([(0, 0, 0, 0.07, 0.07, 0.07)])
    motion = default_motion(scene)
    move, push, last = motion.moves
    assert 0.3 * 0.07 < move.height < 1.2 * 0.07 and any(move.aside)
    # Flights of a fifth of a second are slowed down; each has its quarter of the clip.
    seconds = motion.frames / motion.fps
    assert motion.slow >= 2 and 2.0 <= seconds <= 4.5
    middles = [motion.slow * (each.start_s + 0.5 * each.flight_s) / seconds for each in motion.moves]
    assert middles == pytest.approx([0.25, 0.5, 0.75], abs=0.08)
    assert push.start_s > move.landed_s and last.start_s > push.landed_s
    assert push.slides and not last.slides and motion.sentence.count("box0") == 3
    assert "box0 hops" in motion.sentence and f"{motion.slow:g} times slower" in motion.sentence
    assert default_motion(scene, slow=1.0).slow == 1.0
    given = default_motion(scene, frames=24)
    assert given.frames == 24 and given.moves[-1].landed_s * given.slow < 1.0
    # Applied, it is what a scene folder says; nothing else has changed.
    moved = motion.applied(scene)
    assert load_scene(scene.root) == moved and moved.objects[0].velocity == move.velocity
    keys = moved.objects[0].velocity_keys
    assert [(key.time_s, key.value) for key in keys] == [(m.start_s, m.velocity) for m in (push, last)]
    still = dataclasses.replace(moved.objects[0], velocity=(0, 0, 0), spin=(0, 0, 0), start_time=0.0, velocity_keys=())
    assert still == scene.objects[0] and inputs_hash(moved, BakeOptions()) != inputs_hash(scene, BakeOptions())


def test_larger_things_hop_less_for_their_size_the_largest_slide_and_what_flows_hops_least(table):
    def share(extent, preset="medium"):
        scene = table([(0, 0, 0, extent, extent, extent)], [preset], looking_down(30, 10 * extent))
        return default_motion(scene).moves[0].height / extent

    assert share(0.05) > 1.3 * share(0.45) > 0.0 == share(2.0)
    assert share(0.1, "sand") < 0.5 * share(0.1) and share(0.1, "wood") < share(0.1)
    assert default_motion(table([(0, 0, 0, 0.1, 0.1, 0.1)], ["sand"])).moves[0].aside == (0.0, 0.0, 0.0)


def test_neighbours_are_not_hit(table):
    boxes = [(0, 0, 0, 0.1, 0.1, 0.1), (0.16, 0, 0, 0.1, 0.1, 0.3), (-0.16, 0, 0, 0.1, 0.1, 0.1)]
    scene = table(boxes, camera=looking_down(25, 1.2))
    motion = default_motion(scene)
    moved = motion.applied(scene)
    assert len(motion.moves) >= 2 and [m.start_s for m in motion.moves] == sorted(m.start_s for m in motion.moves)
    at_rest = {item.name: load_object_mesh(scene, item).vertices for item in scene.objects}
    gone = set()
    for move in motion.moves:
        if move.name in gone:
            continue
        path = flight(moved, move, np.linspace(0, move.flight_s, 20))
        for name, other in at_rest.items():
            if name != move.name:
                apart = np.maximum(path.min(axis=1) - other.max(axis=0), other.min(axis=0) - path.max(axis=1))
                assert (apart.max(axis=1) > 0).all(), (move.name, name)
        # The next one finds it where it came down.
        gone.add(move.name)
        at_rest[move.name] = path[-1]


def test_what_rolls_moves_last_and_what_was_moved_does_something_else_before(table):
    scene = table([(-0.15, 0, 0, 0.08, 0.08, 0.08), (0.15, 0, 0, 0.06, 0.06, 0.06)])
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    ball.apply_translation((0.15, 0, 0.03))
    ball.export(scene.root / "meshes/1.glb")
    first, second, last = default_motion(scene).moves
    assert [first.name, second.name, last.name] == ["box0", "box0", "box1"]
    assert not first.slides and second.slides
    # Straight up: thrown aside it would roll on.
    assert last.aside == (0.0, 0.0, 0.0) == last.spin and last.height > 0.02


def test_nothing_comes_to_stand_before_another(table):
    # The way with most to see would end before the farther one (a fifth of it hidden, not a tenth as at rest).
    scene = table([(0.25, 0.15, 0, 0.1, 0.1, 0.12), (0.1, -0.12, 0, 0.1, 0.1, 0.1)], camera=looking_down(15, 1.0))
    camera = scene.model.camera
    far, near = (load_object_mesh(scene, item).vertices for item in scene.objects)
    before = hidden_share(camera, far, near)
    assert 0.05 < before < 0.15 and hidden_share(camera, near, far) == before
    places = {"box0": far, "box1": near}
    for move in default_motion(scene).moves:
        places[move.name] = places[move.name] + np.asarray(move.aside)
        assert hidden_share(camera, *places.values()) <= before + 0.05


def test_what_falls_over_easily_slides_along_its_length(table):
    scene = table([(0, 0, 0, 0.15, 0.02, 0.2)])
    book, *_ = (motion := default_motion(scene)).moves
    assert book.slides and book.spin[:2] == (0.0, 0.0) and "box0 slides" in motion.sentence
    # Along its board: across it tips at 0.02 / 0.2, which is less than the friction.
    assert abs(book.aside[0]) > 0.05 and abs(book.aside[1]) < 1e-6 and book.aside[2] == 0.0
    speed = np.linalg.norm(book.velocity)
    friction = speed**2 / (2 * 9.81 * np.linalg.norm(book.aside))
    assert friction == pytest.approx(scene.model.ground_plane.friction, rel=0.01)
    assert book.flight_s == pytest.approx(speed / (friction * 9.81), rel=0.01)
    crate, *_ = default_motion(table([(0, 0, 0, 0.15, 0.2, 0.2)])).moves
    assert not crate.slides
    # A pencil on its end tips over every edge, so it may only hop, and hardly.
    pencil, *_ = default_motion(table([(0, 0, 0, 0.02, 0.02, 0.2)])).moves
    assert not pencil.slides and pencil.aside == (0.0, 0.0, 0.0) and pencil.height < 0.4 * 0.2


def test_furniture_slides_and_what_has_no_room_above_does_too(table):
    crate, *_ = default_motion(table([(0, 0, 0, 1.0, 1.0, 0.8)], camera=looking_down(30, 8.0))).moves
    assert crate.slides
    # It reaches the picture's upper edge but not its sides.
    scene = table([(0, 0, 0, 0.25, 0.25, 0.25)], camera=looking_down(15, 0.9, focal=520.0))
    shifted = dataclasses.replace(scene.model.camera, cy=156.0)
    tops = shifted.project(load_object_mesh(scene, scene.objects[0]).vertices)
    assert 0 < tops[:, 1].min() < 10 and tops[:, 1].max() < 400 and tops[:, 0].min() > 60
    tall, *_ = default_motion(save_scene(scene.root, dataclasses.replace(scene.model, camera=shifted))).moves
    assert tall.slides and abs(tall.aside[0]) > 0.02


@given(share=st.floats(0.1, 1.0))
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_slower_move_is_what_gravity_and_friction_make_of_less_speed(table, share):
    for extents in ((0.07, 0.07, 0.07), (0.15, 0.02, 0.2)):
        move, *_ = default_motion(table([(0, 0, 0, *extents)])).moves
        slow = move.slower(share)
        up = slow.velocity[2]
        assert slow.height == pytest.approx(up**2 / (2 * 9.81), rel=1e-4, abs=1e-9)
        level = np.array([*slow.velocity[:2], 0.0])
        assert np.allclose(slow.aside, level * slow.flight_s * (0.5 if slow.slides else 1.0), rtol=1e-4, atol=1e-9)


def test_a_rehearsal_tells_when_a_motion_is_over_and_what_leaves(table, tmp_path):
    import physgen

    scene = table([(0, 0, 0, 0.07, 0.07, 0.07)], ["wood"])
    motion = default_motion(scene)
    move, *_ = motion.moves
    options = rehearsal_options(motion, BakeOptions())

    def rehearse(motion, number):
        bake = physgen.bake(motion.applied(scene), out=tmp_path / str(number), options=options)
        return rehearsed(scene, bake, motion)

    found = rehearse(motion, 0)
    assert found.leaving == {}
    # It ends after it came down, soon, and the clip a little later.
    again = found.motion
    assert again.moves[-1].landed_s <= again.action_s < again.moves[-1].landed_s + 0.4
    after = again.frames / again.fps - again.slow * again.action_s
    assert 0.24 < after < 0.6
    assert [each.velocity for each in again.moves] == [each.velocity for each in motion.moves]
    # Three times as fast sideways it slides out of the picture, which a hop of its own does not tell.
    fast = dataclasses.replace(move, velocity=(6.0 * np.sign(move.velocity[0]), 0.0, move.velocity[2]))
    gone = rehearse(dataclasses.replace(motion, moves=(fast,)), 1)
    assert list(gone.leaving) == ["box0"] and gone.leaving["box0"].startswith("box0 leaves the picture")
    assert gone.tamed(scene).moves[0].velocity == pytest.approx(0.75 * np.asarray(fast.velocity))


def test_what_carries_something_stays_and_what_it_carries_comes_down_on_it(table):
    scene = table([(0, 0, 0, 0.2, 0.2, 0.05), (0, 0, 0.05, 0.06, 0.06, 0.06)])
    move, *more = default_motion(scene).moves
    assert all(each.name == "box1" and not any(each.aside) for each in more)
    assert move.name == "box1" and move.aside == (0.0, 0.0, 0.0) and move.spin == (0.0, 0.0, 0.0)


def test_what_fills_the_picture_leaves_it_by_little(table):
    scene = table([(0, 0, 0, 0.2, 0.2, 0.2)], camera=looking_down(30, 0.62))
    move, *_ = default_motion(scene).moves
    path = flight(default_motion(scene).applied(scene), move, np.linspace(0, move.flight_s, 20))
    pixels = scene.model.camera.project(path)[..., :2]
    assert 0 < -pixels.min() < 0.12 * np.ptp(pixels[0], axis=0).max() + 1e-6


def test_what_has_no_room_is_left_alone_and_that_is_said(table):
    filling = looking_down(0, 0.5, focal=1000.0)
    for scene in (
        table([(0, 0.1, -0.1, 0.2, 0.05, 0.4)], camera=filling),
        table([(0, 0, 0, 0.1, 0.1, 0.1)], role="collider"),
        save_scene((t := table([(0, 0, 0, 0.1, 0.1, 0.1)])).root, dataclasses.replace(t.model, gravity=(0, 0, 0.0))),
    ):
        motion = default_motion(scene)
        assert motion.moves == () and "nothing moves" in motion.sentence and motion.applied(scene).model == scene.model


def test_what_a_rehearsal_set_in_motion_is_at_rest_again_where_nothing_moves(table):
    """The bake's process reads the scene from its folder, and refuses another one than it was given."""
    scene = table([(0, 0, 0, 0.1, 0.1, 0.1)])
    motion = default_motion(scene)
    assert motion.moves and load_scene(motion.applied(scene).root).model != scene.model
    still = dataclasses.replace(motion, moves=()).applied(scene)
    assert still.model == scene.model == load_scene(scene.root).model


def test_a_request_that_says_how_things_move_is_left_alone():
    assert not tells_motion((), (), ("cup.density=300", "ground.friction=0.2"))
    assert tells_motion(((0.0, 0.0, 0.0),), (), ()) and tells_motion((), ((0.0, 0.0, 1.0),), ())
    assert tells_motion((), (), ("cup.velocity=0,0,1",)) and tells_motion((), (), ("scene.gravity=0,0,-1",))


@pytest.mark.parametrize(
    ("given", "motion", "frames", "slow"),
    [
        ([], True, True, True),
        (["--frames", "30"], True, False, True),
        (["--slow", "2"], True, True, False),
        (["--still"], False, True, True),
        (["--velocity", "0,0,0"], False, True, True),
    ],
)
def test_run_chooses_what_is_not_given(given, motion, frames, slow, tmp_path, monkeypatch):
    from physgen.batch import cli, stages

    asked = []
    monkeypatch.setattr(stages, "photo_to_video", lambda request, *_: asked.append(request))
    arguments = ["run", "photo.png", "--box", "1,2,30,40", "--out", str(tmp_path / "v.mp4"), *given]
    assert cli.main(arguments) == 0
    assert asked[0].choices == stages.Choices(motion=motion, frames=frames, slow=slow)
    assert asked[0].bake == BakeOptions(frames=30 if "--frames" in given else 48, slow=2.0 if "--slow" in given else 1)


def test_still_and_a_velocity_contradict_each_other(tmp_path):
    options = SimpleNamespace(
        out=tmp_path / "v.mp4", still=True, preset=[], velocity=[(0, 0, 1)], spin=[], overrides=[], work=None
    )
    with pytest.raises(InputError, match=r"--still: a motion is given"):
        photo_commands.run_run(options, None, None)


CAMERA = looking_down(20, 1.0)
CUBE = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().vertices + np.array([0.0, 0.0, 0.05])


def said(shifts, slow=1.0, cameras=None, first=1):
    """Notices about a cube displaced by ``shifts`` (F, 3)."""
    poses = [[CUBE + np.asarray(shift)] for shift in shifts]
    return clip_notices(["cube"], poses, cameras or [CAMERA] * len(poses), Clip(first=first, fps=24.0, slow=slow))


def test_a_thing_that_leaves_is_named_with_edge_and_frame():
    away = np.linspace(0, 2.0, 48)[:, None]
    (text,) = said(away * (1.0, 0.0, 0.0))
    assert text.startswith("cube leaves the picture over its right edge at frame") and "does not come back" in text
    (text,) = said(away * (0.0, 0.0, 1.0))
    assert "upper edge" in text
    # Thrown up and caught again.
    rise = np.concatenate([away[:24], away[:24][::-1]])
    (text,) = said(rise * (0.0, 0.0, 1.0), first=10)
    frame = int(text.partition("is back at frame ")[2].split(";")[0])
    assert 34 < frame < 58
    # At the very end nobody minds, and what comes from outside is not leaving.
    assert said(np.concatenate([np.linspace(0, 0.02, 47)[:, None], [[2.0]]]) * (1.0, 0.0, 0.0)) == []
    assert said(away[::-1] * (1.0, 0.0, 0.0)) == []
    (text,) = said(np.tile((9.0, 0.0, 0.0), (48, 1)))[:1]
    assert text.startswith("cube is never in the picture")


def test_a_clip_in_which_nothing_moves_or_all_is_over_at_once_is_named():
    assert said(np.zeros((48, 3)))[0].startswith("nothing moves in these 48 frames")
    short = np.zeros((48, 3))
    short[:6, 2] = (0.0, 0.02, 0.03, 0.03, 0.02, 0.0)
    (text,) = said(short)
    assert "over after 0.21 s of 2 s" in text and text.endswith("--slow 8")
    assert said(short, slow=8.0) == []
    long = 0.05 * np.sin(np.linspace(0, 9, 48))[:, None] * (0.0, 0.0, 1.0)
    assert said(long) == []
    # While the camera moves, something is always seen to move; one frame is no clip.
    moving = [dataclasses.replace(CAMERA, cx=CAMERA.cx + n) for n in range(48)]
    assert said(np.zeros((48, 3)), cameras=moving) == [] and said(np.zeros((1, 3))) == []


def test_slow_motion_is_a_faster_clock_not_repeated_frames(ball_scene):
    scene = ball_scene()
    assert BakeOptions(fps=24.0, slow=4.0).rate == 96.0
    # Bakes made before there was slow motion stay valid; others are others.
    assert inputs_hash(scene, BakeOptions()) == inputs_hash(scene, BakeOptions(slow=1.0))
    assert inputs_hash(scene, BakeOptions()) != inputs_hash(scene, BakeOptions(slow=2.0))
    for wrong in (0.0, -1.0, 101.0, math.nan):
        with pytest.raises(InputError, match="slow is"):
            BakeOptions(slow=wrong)


def test_a_slow_bake_holds_the_same_motion_at_more_moments(ball_scene, tmp_path):
    import physgen

    scene = ball_scene(preset="wood", velocity=(0.2, 0.0, 1.0), height=0.06)
    options = BakeOptions(frames=4, quality="preview")
    real = physgen.bake(scene, out=tmp_path / "real", options=options)
    slow = physgen.bake(scene, out=tmp_path / "slow", options=dataclasses.replace(options, frames=10, slow=3.0))
    assert (slow.manifest.fps, slow.manifest.rate, physgen.load_bake(slow.root).manifest.slow) == (24.0, 72.0, 3.0)
    for number in range(4):
        here, there = real.vertices("ball0", 1 + number), slow.vertices("ball0", 1 + 3 * number)
        # In free flight, to the steps of the engine's clock.
        assert np.abs(here - there).max() < 1e-4
    # Between them it is on its way, as a camera with so many frames would see it: a parabola.
    heights = np.array([slow.vertices("ball0", n)[:, 2].mean() for n in range(1, 11)])
    times = np.arange(10) / 72.0
    assert np.abs(heights - heights[0] - times + 0.5 * 9.81 * times**2).max() < 5e-4


def test_what_falls_over_in_a_rehearsal_hops_calmly_and_else_stays(table, tmp_path):
    import physgen

    scene = table([(0, 0, 0, 0.05, 0.05, 0.14)], ["wood"])
    motion = default_motion(scene)
    tripped = dataclasses.replace(motion.moves[0], velocity=(1.2, 0.0, 0.0), spin=(0.0, 9.0, 0.0))
    motion = dataclasses.replace(motion, moves=(tripped,))
    bake = physgen.bake(motion.applied(scene), out=tmp_path / "0", options=rehearsal_options(motion, BakeOptions()))
    assert rehearsed(scene, bake, motion).toppled == ("box0",)
    calm, *_ = default_motion(scene, calm=["box0"]).moves
    assert not calm.slides and calm.aside == (0.0, 0.0, 0.0) and calm.spin == (0.0, 0.0, 0.0)
    motion = dataclasses.replace(motion, moves=(calm,))
    bake = physgen.bake(motion.applied(scene), out=tmp_path / "1", options=rehearsal_options(motion, BakeOptions()))
    assert rehearsed(scene, bake, motion).toppled == ()
    low, *_ = default_motion(scene, calm=["box0"], low=["box0"]).moves
    assert low.height == pytest.approx(calm.height / 4) and low.velocity[2] == pytest.approx(
        calm.velocity[2] / 2, rel=1e-4
    )
    assert default_motion(scene, still=["box0"]).moves == ()


def test_what_falls_over_as_it_hops_straight_up_hops_lower_before_it_stays(table, tmp_path):
    """A can whose mask made a thin slab of it stood still for two seconds."""
    scene = table([(0, 0, 0, 0.09, 0.022, 0.15)], ["wood"])
    # As bodies are that were cut out: its foot is round, so that it comes down on a point.
    mesh = load_object_mesh(scene, scene.objects[0])
    vertices = mesh.vertices.copy()
    vertices[:, 2] += 0.12 * np.abs(vertices[:, 1]) * (vertices[:, 2] < 0.001)
    trimesh.Trimesh(vertices, mesh.faces).export(scene.root / scene.objects[0].mesh)
    moved, _ = choose_motion(
        scene,
        BakeOptions(),
        Choices(motion=True, frames=True, slow=True),
        lambda event: None,
        rehearsals=tmp_path / "r",
    )
    assert moved.objects[0].velocity[2] > 0.1 and (tmp_path / "r" / "2").is_dir()


def test_what_is_narrow_and_alone_does_not_hop_on_the_spot_twice_in_a_row(table):
    motion = default_motion(table([(0, 0, 0, 0.03, 0.03, 0.14)]))
    assert motion.moves and any(move.on_the_spot for move in motion.moves)
    pairs = zip(motion.moves, motion.moves[1:], strict=False)
    assert not any(one.on_the_spot and other.on_the_spot for one, other in pairs)


def test_what_is_narrow_and_fills_the_picture_is_pushed_more_than_once(table):
    # It stands firmly along its width, not along its depth; above it there is no room.
    scene = table([(0, 0, 0, 0.15, 0.05, 0.25)], camera=looking_down(15, 0.9, focal=520.0))
    shifted = dataclasses.replace(scene.model.camera, cy=156.0)
    motion = default_motion(save_scene(scene.root, dataclasses.replace(scene.model, camera=shifted)))
    assert len(motion.moves) > 1 and all(move.slides for move in motion.moves)


def turned(degrees):
    return trimesh.transformations.rotation_matrix(math.radians(degrees), (0, 0, 1))[:3, :3]


def test_guessed_sides_are_those_that_faced_away():
    eye = np.array([0.0, -50.0, 0.0])
    box = trimesh.creation.box((0.1, 0.05, 0.1)).subdivide().subdivide()
    rest = Surface.of(box.vertices, box.faces)

    def share(mesh, degrees):
        now = Surface.of(mesh.vertices @ turned(degrees).T, mesh.faces)
        return Surface.of(mesh.vertices, mesh.faces).guessed(now, eye)

    # From afar: of a box half as deep as wide a side of 0.05 sin a appears beside the front's 0.1 cos a.
    for degrees in (-40, 10, 40):
        side = 0.5 * math.tan(math.radians(abs(degrees)))
        assert share(box, degrees) == pytest.approx(side / (1 + side), abs=0.005)
    assert share(box, 180) == pytest.approx(1.0, abs=0.005) and rest.guessed(rest, eye) == 0.0
    # Of a round can the strip within 10 degrees of its edge counts as well.
    can = trimesh.creation.cylinder(0.05, 0.1, sections=180)
    edge, more = (0.5 * (1 - math.cos(math.radians(angle))) for angle in (10, 50))
    assert share(can, 40) == pytest.approx(more - 0.5 * edge - 0.5 * edge, abs=0.01)


def test_a_move_turns_no_guessed_side_to_the_camera_and_leans_or_turns_but_not_both(table):
    """A can, 30 cm away: what came down leaning as it turned rolled on about its rim."""
    can = trimesh.creation.cylinder(0.05, 0.12, sections=64).subdivide()
    can.apply_translation((0, 0, 0.06))
    for mesh in (
        can,
        trimesh.creation.box((0.1, 0.1, 0.12), transform=trimesh.transformations.translation_matrix((0, 0, 0.06))),
    ):
        scene = table([(0, 0, 0, 0.1, 0.1, 0.12)], ["wood"], looking_down(20, 0.6))
        mesh.export(scene.root / "meshes/0.glb")
        hop, *_ = default_motion(scene).moves
        spin = np.asarray(hop.spin)
        assert not hop.slides and spin.any() and (spin[2] == 0.0 or not spin[:2].any())
        body = load_object_mesh(scene, scene.objects[0])
        after = (body.vertices - body.vertices.mean(axis=0)) @ turned(math.degrees(spin[2] * hop.flight_s)).T
        after += body.vertices.mean(axis=0) + hop.aside
        eye = np.asarray(scene.model.camera.world_from_camera)[:3, 3]
        assert Surface.of(body.vertices, body.faces).guessed(Surface.of(after, body.faces), eye) <= 0.06
        assert default_motion(scene, plain=["box0"]).moves[0].spin == (0.0, 0.0, 0.0)


def test_a_rehearsal_tells_what_shows_guessed_sides(table, tmp_path):
    import physgen

    scene = table([(0, 0, 0, 0.1, 0.1, 0.08)], ["wood"])
    motion = default_motion(scene)
    for number, (spin, names) in enumerate((((0.0, 0.0, 0.0), ()), ((0.0, 0.0, 4.0), ("box0",)))):
        move = dataclasses.replace(motion.moves[0], velocity=(0.0, 0.0, 0.7), aside=(0.0, 0.0, 0.0), spin=spin)
        tried = dataclasses.replace(motion, moves=(move,))
        out = tmp_path / str(number)
        bake = physgen.bake(tried.applied(scene), out=out, options=rehearsal_options(tried, BakeOptions()))
        found = rehearsed(scene, bake, tried)
        assert (found.turned, found.toppled) == (names, ())


def test_what_bounces_is_left_alone_until_it_has_come_down_for_good(table):
    """A can that was pushed as it bounced tripped, in a photo; wood leaves the ground with half of its speed."""
    box = (0, 0, 0, 0.1, 0.1, 0.1)
    hop, push, *_ = default_motion(table([box], ["wood"])).moves
    bounces = sum(0.5**n for n in range(1, 4)) * hop.flight_s
    assert not hop.slides and push.name == hop.name and push.start_s >= hop.landed_s + bounces
    dead, after, *_ = default_motion(table([box], ["wood"], restitution=0.0)).moves
    assert dead.flight_s == hop.flight_s and after.start_s - dead.landed_s < 0.5 * (push.start_s - hop.landed_s)


def test_what_falls_over_in_a_later_move_is_spared_that_one(table, tmp_path):
    import physgen

    scene = table([(0, 0, 0, 0.06, 0.06, 0.1)], ["wood"], friction=3.0)
    motion = default_motion(scene, plain=["box0"])
    hop = dataclasses.replace(motion.moves[0], velocity=(0.0, 0.0, motion.moves[0].velocity[2]), aside=(0.0, 0.0, 0.0))
    # Its foot sticks to the ground.
    tripped = dataclasses.replace(hop, start_s=hop.landed_s + hop.pause_s, velocity=(1.2, 0.0, hop.velocity[2]))
    motion = dataclasses.replace(motion, moves=(hop, tripped))
    bake = physgen.bake(motion.applied(scene), out=tmp_path / "0", options=rehearsal_options(motion, BakeOptions()))
    found = rehearsed(scene, bake, motion)
    assert found.toppled == ("box0",) and found.good == {"box0": 1}
    shorter = found.shortened(scene)
    assert [move.velocity for move in shorter.moves] == [hop.velocity]
    # Where already the first one goes wrong, fewer do not help.
    assert dataclasses.replace(found, good={"box0": 0}).shortened(scene) is None


def test_what_bounces_for_long_at_the_end_gets_time_instead_of_a_hop_that_repeats_another(table):
    scene = table([(-0.1, 0, 0, 0.03, 0.1, 0.12), (0.1, 0, 0, 0.05, 0.05, 0.05)], ["wood", "medium"])
    motion = default_motion(scene)
    first = next(move for move in motion.moves if not move.slides)
    again = dataclasses.replace(first, aside=(0.0, 0.0, 0.0), height=0.8 * first.height)
    other = dataclasses.replace(again, name="box1" if first.name == "box0" else "box0")
    moves = (first, again, other)
    short, long = (fitted(scene, moves, dict.fromkeys(SLOW, settle), fps=24.0) for settle in (0.1, 1.6))
    assert [move.name for move in short.moves] == [move.name for move in moves]
    assert [move.name for move in long.moves] == [first.name, other.name]
    assert long.frames / long.fps / long.slow - long.moves[-1].landed_s > 0.5
    long_settles = dict.fromkeys(SLOW, 1.6)
    # What comes last stays.
    assert len(fitted(scene, (first, other, other), long_settles, fps=24.0).moves) == 3
    # Where what comes later goes somewhere too, a thing that does not leave the way there free stays as well.
    assert any(first.aside) and other.on_the_spot
    aside = dataclasses.replace(other, aside=(0.01, 0.0, 0.0))
    assert [move.name for move in fitted(scene, (first, first, other), long_settles, fps=24.0).moves] == [
        first.name,
        other.name,
    ]
    assert len(fitted(scene, (first, first, aside), long_settles, fps=24.0).moves) == 3


def test_what_rolls_out_of_the_picture_at_any_speed_stays_if_something_else_moves(table, tmp_path):
    """A stone far behind a duck rolled out of the picture at the end of its clip."""
    scene = table([(-0.25, 0, 0, 0.05, 0.05, 0.05), (0.08, 0, 0, 0.06, 0.06, 0.06)], ["wood"], friction=1.0)
    trimesh.creation.icosphere(radius=0.025).apply_translation((-0.25, 0, 0.025)).export(
        scene.root / scene.objects[0].mesh
    )
    # Downhill to the left, along which a ball rolls once it is awake.
    model = dataclasses.replace(scene.model, gravity=(-3.0, 0.0, -9.0))
    scene = scene.with_model(model).save()
    options = BakeOptions(frames=108, slow=2.0)
    moved, _ = choose_motion(scene, options, Choices(motion=True), lambda event: None, rehearsals=tmp_path / "r")
    ball, box = moved.objects
    assert ball.velocity == (0.0, 0.0, 0.0) and any(box.velocity)
