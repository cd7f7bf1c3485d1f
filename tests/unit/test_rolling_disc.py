# SPDX-License-Identifier: MIT
"""A disc that rolls on its rim, filmed along its axis, before walls of different brightness."""

import dataclasses

import cv2
import numpy as np
import physgen
import pytest
import trimesh
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief
from physgen.sim.diagnose.rigid.rigid_search import body_problem
from physgen.sim.diagnose.rigid.rigid_simulator import RigidWorlds, on_its_rim
from physgen.sim.diagnose.rigid.world_settings import BodyScene
from physgen.sim.diagnose.track.plain_bodies import follow_plain_body
from physgen.sim.diagnose.track.track_input import parse_body
from physgen.sim.diagnose.work import Work

SIZE, FPS, SCALE, ANGLE = (300, 160), 120.0, 400.0, np.radians(6.0)
DISC = "cylinder:diameter=0.07,height=0.02"


def lying(mesh, way=(0.0, 1.0, 0.0)):
    """Return a body whose mesh has its z axis along ``way``."""
    mesh.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), way))
    belief = ObjectBelief(name="disc", mesh="disc.obj", density_kg_m3=700.0, stiffness="hard")
    return CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))


def disc(sections=48, **way):
    return lying(trimesh.creation.cylinder(radius=0.035, height=0.02, sections=sections), **way)


def rolled(path, count=110):
    """Write a video of a white disc that rolls from a light wall to a dark one; return its places (T, 2) px."""
    t = np.arange(count) / FPS
    way = 0.05 * t + 0.5 * (2 / 3) * 9.81 * np.sin(ANGLE) * t**2
    places = np.array([40.5, 60.5]) + SCALE * way[:, None] * (np.cos(ANGLE), np.sin(ANGLE))
    wall = np.full((SIZE[1], SIZE[0], 3), 170, np.uint8)
    wall[:, 170:] = 90
    rng = np.random.default_rng(4)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, SIZE)
    for place in places:
        # Centres of pixels lie at halves.
        at = [int(v) for v in np.round((place - 0.5) * 16)]
        frame = cv2.circle(wall.copy(), at, round(0.035 * SCALE * 16), (228, 226, 225), -1, cv2.LINE_AA, 4)
        writer.write(np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8))
    writer.release()
    return places


def test_a_disc_rolls_down_a_slope_past_the_edge_of_a_wall(tmp_path):
    places = rolled(tmp_path / "roll.avi")
    video = physgen.VideoTrial(path=tmp_path / "roll.avi", fps_override=FPS)
    found = follow_plain_body(video, parse_body(DISC))
    # Where it lies before both walls, the part before the dark one pulled its centre by 4 px.
    apart = found.places - places[found.frames]
    assert np.linalg.norm(apart - np.median(apart, axis=0), axis=1).max() < 0.5
    assert found.view.on_rim and found.view.kind == "slope" and found.frames[-1] >= 108
    assert found.view.scale == pytest.approx(SCALE, rel=0.03)
    problem = body_problem(found.capture, 0, Work())
    assert problem.scene.body.round and problem.scene.body.radius == pytest.approx(0.035)


def test_a_disc_on_its_rim_gains_speed_as_it_must():
    item = disc()
    normal = np.array([np.sin(ANGLE), 0.0, np.cos(ANGLE)])
    body = on_its_rim(item, normal)
    assert body is not None
    ground = Ground(point=tuple(-0.035 * normal), normal=tuple(normal), friction=0.5, restitution=0.5)
    capture = Capture(
        gravity=(0.0, 0.0, -9.81), ground=ground, objects=(item,), noise_sigma=1e-4, camera=None, trials=()
    )
    scene = BodyScene(capture=capture, body=body, middle=np.zeros(3))
    start = np.array([[0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]], dtype=float)
    times = np.linspace(0.0, 0.6, 7)
    record = RigidWorlds(body=body, threads=1).run(start, scene.numbers([scene.base]), [times])[0]
    # A uniform disc: g sin(angle) / (1 + 1/2), and it turns by its way over its radius.
    gained = np.linalg.norm(record[:, 7:10], axis=1)
    assert gained == pytest.approx(2 / 3 * 9.81 * np.sin(ANGLE) * times, rel=0.01, abs=2e-3)
    assert record[-1, 11] * 0.035 == pytest.approx(gained[-1], rel=0.01)
    # A thin ring has twice the inertia of a disc.
    ring = dataclasses.replace(scene.base, inertia=2.0)
    slower = RigidWorlds(body=body, threads=1).run(start, scene.numbers([ring]), [times])[0]
    assert np.linalg.norm(slower[-1, 7:10]) == pytest.approx(0.5 * 9.81 * np.sin(ANGLE) * times[-1], rel=0.01)


@pytest.mark.parametrize(
    "item",
    [
        disc(way=(0.0, 0.0, 1.0)),
        disc(way=(0.0, 0.8, 0.6)),
        disc(sections=6),
        lying(trimesh.creation.icosphere(subdivisions=3, radius=0.035)),
        lying(trimesh.creation.box((0.05, 0.05, 0.02))),
    ],
    ids=["standing", "tilted", "hexagonal", "ball", "box"],
)
def test_what_lies_on_no_rim_keeps_its_corners(item):
    assert on_its_rim(item, np.array([0.0, 0.0, 1.0])) is None
