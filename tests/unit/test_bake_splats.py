# SPDX-License-Identifier: MIT
"""Splat objects in scenes and bakes: every splat follows the matter, frame by frame, as PLY files and as a cache."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from physgen.sim.app.bake import bake, is_up_to_date
from physgen.sim.app.bake_estimate import bake_cost
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.cache.bake_folder import disk_usage, free_bake, load_manifest
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.gaussians.splat_ply import read_splats, write_splats
from physgen.sim.gaussians.splats import Splats, from_points, transform_splats
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.model import Key, Material, Motion
from scipy.spatial import cKDTree

QUICK = BakeOptions(frames=4, fps=24.0, quality="preview")
CENTRE = np.array([0.0, 0.0, 0.052])


@pytest.fixture
def splat_scene(ball_scene):
    """A factory of scenes with one ball of 10 cm that is seen as ``count`` splats inside it."""

    def make(count=400, within=0.045, matrix=None, changes=None, **scene):
        folder = ball_scene(**scene)
        random = np.random.default_rng(2)
        directions = random.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        splats = Splats(
            centres=CENTRE + within * random.uniform(0, 1, (count, 1)) ** (1 / 3) * directions,
            scales=random.uniform(1e-3, 4e-3, (count, 3)),
            rotations=random.normal(size=(count, 4)),
            opacities=random.uniform(0.2, 0.9, count),
            colours=random.uniform(0, 1, (count, 3)),
        )
        write_splats(folder.root / "splats" / "ball0.ply", splats)
        item = dataclasses.replace(folder.model.objects[0], splats="splats/ball0.ply", **(changes or {}))
        if matrix is not None:
            item = dataclasses.replace(item, world_from_mesh=matrix)
        return save_scene(folder.root, dataclasses.replace(folder.model, objects=(item, *folder.model.objects[1:])))

    return make


def frames(out, count=4):
    return [read_splats(out / "ball0.splats" / f"{i:04d}.ply") for i in range(1, count + 1)]


def everything(out):
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.suffix in (".ply", ".pc2")}


def assert_covariances(splats, wanted, tolerance):
    size = np.linalg.norm(wanted, axis=(1, 2))
    assert (np.linalg.norm(splats.covariances() - wanted, axis=(1, 2)) / size).max() < tolerance


def test_falling_splats_fall_and_keep_their_shape(splat_scene, tmp_path):
    folder = splat_scene(velocity=(0.3, 0.0, 1.0))
    manifest = bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK).manifest
    rest, last = frames(tmp_path / "bake")[0], frames(tmp_path / "bake")[-1]
    file = read_splats(folder.file("splats/ball0.ply"))
    np.testing.assert_allclose(rest.centres, file.centres, atol=1e-8)
    assert_covariances(rest, file.covariances(), 1e-5)
    time = 3 / 24
    expected = np.array([0.3 * time, 0.0, time - 0.5 * 9.81 * time**2])
    assert np.abs(last.centres - rest.centres - expected).max() < 0.005 * 0.5 * 9.81 * time**2
    # The ball is soft, and begins to breathe in the air.
    assert_covariances(last, rest.covariances(), 0.02)
    np.testing.assert_allclose(last.opacities, file.opacities, atol=2e-6)
    np.testing.assert_allclose(last.colours, file.colours, atol=1e-6)
    baked = manifest.objects[0]
    assert (baked.splats_file, baked.splats_folder, baked.splats) == ("ball0.splats.pc2", "ball0.splats", 400)
    cache = Pc2Reader(tmp_path / "bake" / "ball0.splats.pc2")
    assert (cache.vertex_count, cache.sample_count) == (1600, 4)
    assert_covariances(from_points(file, cache.sample(3)), last.covariances(), 1e-3)


def test_each_covariance_follows_the_matter_around_it(splat_scene, tmp_path):
    """A ball of clay thrown at the ground. F at a splat is found from its neighbours' centres alone: the affine map
    that takes them from the first frame to the last. It is only that of their mean, hence the tolerance."""
    folder = splat_scene(count=3000, preset="clay", velocity=(0.0, 0.0, -5.0))
    bake(load_scene(folder.root), out=tmp_path / "bake", options=dataclasses.replace(QUICK, frames=3))
    rest, _, last = frames(tmp_path / "bake", 3)
    inner = np.flatnonzero(np.linalg.norm(rest.centres - CENTRE, axis=1) < 0.035)
    near = cKDTree(rest.centres).query(rest.centres[inner], k=24)[1]
    before, after = rest.centres[near], last.centres[near]
    before, after = before - before.mean(axis=1, keepdims=True), after - after.mean(axis=1, keepdims=True)
    f = np.linalg.solve(before.transpose(0, 2, 1) @ before, before.transpose(0, 2, 1) @ after).transpose(0, 2, 1)
    wanted = f @ rest.covariances()[inner] @ f.transpose(0, 2, 1)
    found = last.covariances()[inner]
    error = np.linalg.norm(found - wanted, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
    moved = np.linalg.norm(rest.covariances()[inner] - wanted, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
    assert np.median(moved) > 0.1, "the ball is dented"
    assert np.median(error) < 0.1 * np.median(moved) and np.percentile(error, 95) < 0.25 * np.percentile(moved, 95)


def test_a_rigid_ball_turns_its_splats(splat_scene, tmp_path):
    folder = splat_scene(height=0.4, changes={"material": Material(law="rigid"), "spin": (0.0, 9.0, 0.0)})
    write_splats(
        folder.file("splats/ball0.ply"),
        transform_splats(read_splats(folder.file("splats/ball0.ply")), up_by(0.4 - 0.052)),
    )
    bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)
    rest, last = frames(tmp_path / "bake")[0], frames(tmp_path / "bake")[-1]
    angle = 9.0 * 3 / 24
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    np.testing.assert_allclose(last.scales, rest.scales, rtol=1e-5)
    assert_covariances(last, turn @ rest.covariances() @ turn.T, 1e-3)


def up_by(height):
    matrix = np.eye(4)
    matrix[2, 3] = height
    return matrix


def test_in_the_space_of_the_mesh_splats_begin_as_the_file_has_them(splat_scene, tmp_path):
    matrix = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    folder = splat_scene(matrix=matrix)
    bake(load_scene(folder.root), out=tmp_path / "mesh", options=dataclasses.replace(QUICK, space="mesh"))
    bake(load_scene(folder.root), out=tmp_path / "world", options=QUICK)
    file = read_splats(folder.file("splats/ball0.ply"))
    assert np.array_equal(frames(tmp_path / "mesh")[0].centres, file.centres)
    for own, world in zip(frames(tmp_path / "mesh"), frames(tmp_path / "world"), strict=True):
        there = transform_splats(own, np.array(matrix))
        np.testing.assert_allclose(there.centres, world.centres, atol=1e-7)
        assert_covariances(there, world.covariances(), 1e-4)


def test_splats_of_a_collider_go_where_it_goes(splat_scene, tmp_path):
    keys = (Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 0.0, np.pi / 2)))
    folder = splat_scene(
        count=50, changes={"role": "collider", "velocity": (0, 0, 0), "motion": Motion(rotations=keys, pivot=(0, 0, 0))}
    )
    other = dataclasses.replace(
        folder.model.objects[0], name="faller", role="dynamic", motion=None, splats=None, velocity=(0, 0, 0)
    )
    other = dataclasses.replace(other, world_from_mesh=tuple(map(tuple, up_by(0.3).tolist())))
    save_scene(folder.root, dataclasses.replace(folder.model, objects=(*folder.model.objects, other)))
    bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)
    rest, last = frames(tmp_path / "bake")[0], frames(tmp_path / "bake")[-1]
    angle = np.pi / 2 * 3 / 24
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(last.centres, rest.centres @ turn.T, atol=1e-7)
    assert_covariances(last, turn @ rest.covariances() @ turn.T, 1e-4)


def test_a_stopped_bake_goes_on_to_the_same_bytes_and_a_lost_frame_is_baked_again(splat_scene, tmp_path):
    folder = splat_scene(count=50)
    bake(load_scene(folder.root), out=tmp_path / "whole", options=QUICK)
    asked = iter([False] * 14 + [True])
    with pytest.raises(Cancelled):
        bake(load_scene(folder.root), out=tmp_path / "parts", options=QUICK, cancelled=lambda: next(asked))
    done = load_manifest(tmp_path / "parts").frames_done
    assert 0 < done < 4
    # As a kill in the middle of a frame leaves them.
    (tmp_path / "parts/ball0.splats" / f".{done + 1:04d}.partial-1.ply").write_bytes(b"half")
    (tmp_path / "parts/ball0.splats" / f"{done + 1:04d}.ply").write_bytes(b"of another time")
    notices = []
    bake(load_scene(folder.root), out=tmp_path / "parts", options=QUICK, on_event=notices.append)
    assert any("continuing" in n.get("message", "") for n in notices)
    assert everything(tmp_path / "parts") == everything(tmp_path / "whole")
    out = tmp_path / "whole"
    assert is_up_to_date(load_scene(folder.root), out, QUICK)
    (out / "ball0.splats/0002.ply").unlink()
    assert not is_up_to_date(load_scene(folder.root), out, QUICK)
    shorter = dataclasses.replace(QUICK, frames=2)
    bake(load_scene(folder.root), out=out, options=shorter)
    assert {path.name for path in (out / "ball0.splats").iterdir()} == {"0001.ply", "0002.ply"}
    write_splats(folder.file("splats/ball0.ply"), read_splats(folder.file("splats/ball0.ply")).subset(np.arange(40)))
    assert not is_up_to_date(load_scene(folder.root), out, shorter)


def test_splat_caches_are_estimated_and_freed(splat_scene, tmp_path):
    folder, out = splat_scene(count=2000), tmp_path / "bake"
    told = bake_cost(folder, QUICK).disk_bytes
    bake(load_scene(folder.root), out=out, options=QUICK)
    files = [path for path in out.rglob("*") if path.is_file()]
    took = sum(path.stat().st_size for path in files)
    assert disk_usage(out) == took
    particles = load_manifest(out).particles
    # The rest is for two checkpoints, which are gone, and what is rounded up.
    assert took <= told <= 1.05 * took + 2 * 190 * particles
    (out / "ball0.splats/of mine.txt").write_text("kept")
    assert free_bake(out) == took
    assert [path.name for path in out.rglob("*") if path.is_file()] == ["of mine.txt"]


def test_splats_of_another_place_are_refused(splat_scene, tmp_path):
    folder = splat_scene(count=50)
    write_splats(
        folder.file("splats/ball0.ply"), transform_splats(read_splats(folder.file("splats/ball0.ply")), up_by(5.0))
    )
    with pytest.raises(InputError, match="far from the mesh"):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=QUICK)


@pytest.mark.parametrize("name", ["../ball0.ply", "/etc/ball0.ply", "a\\b.ply", "c:x.ply"])
def test_a_scene_names_splats_inside_its_folder_only(splat_scene, name):
    folder = splat_scene(count=5)
    text = (folder.root / "scene.json").read_text()
    (folder.root / "scene.json").write_text(text.replace("splats/ball0.ply", name.replace("\\", "\\\\")))
    with pytest.raises(InputError, match="file name"):
        load_scene(folder.root)


def test_objects_that_cannot_have_splats_are_named(splat_scene):
    folder = splat_scene(count=5)
    item = folder.model.objects[0]
    assert load_scene(folder.root).model == folder.model
    with pytest.raises(InputError, match="PLY file of splats"):
        dataclasses.replace(item, splats="splats/ball0.glb")
    with pytest.raises(InputError, match="vertices_file"):
        dataclasses.replace(item, role="collider", motion=Motion(vertices_file="track.npz"))
    folder.file("splats/ball0.ply").unlink()
    with pytest.raises(InputError, match="which is missing"):
        load_scene(folder.root)
