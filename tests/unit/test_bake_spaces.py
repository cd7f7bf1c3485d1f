# SPDX-License-Identifier: MIT
"""Bakes of objects that stand by their own matrix, of matter shown by its particles, of scenes without photo, floor."""

import dataclasses
import json
import resource
import shutil
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.app import bake as bake_module
from physgen.sim.app import bake_run, bake_worker
from physgen.sim.app.bake import bake
from physgen.sim.app.bake_estimate import bake_cost, estimate_bake
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.cache.bake_folder import disk_usage, load_manifest
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Effect, Material

QUICK = BakeOptions(frames=4, fps=24.0, quality="preview", points=False)
POINTS = dataclasses.replace(QUICK, points=True)

CROOKED = ((0.8, 0.3, 0.0, 0.1), (0.0, -1.2, 0.2, -0.2), (0.1, 0.0, 0.5, 0.06), (0.0, 0.0, 0.0, 1.0))
"""Another scale along each axis, sheared, mirrored and moved."""


def samples(path):
    cache = Pc2Reader(path)
    return [cache.sample(i) for i in range(cache.sample_count)]


def caches(out):
    return {path.name: path.read_bytes() for path in sorted(out.glob("*.pc2"))}


def crooked(folder):
    """The ball of the scene under the crooked matrix, resting in its middle in the mesh file."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    mesh.export(folder.root / "meshes" / "ball0.obj")
    item = dataclasses.replace(folder.model.objects[0], mesh="meshes/ball0.obj", world_from_mesh=CROOKED)
    return save_scene(folder.root, dataclasses.replace(folder.model, objects=(item,)))


def test_samples_in_the_meshs_space_are_the_worlds_seen_through_the_matrix(ball_scene, tmp_path):
    folder = crooked(ball_scene(velocity=(0.5, 0.0, 1.0)))
    bake(load_scene(folder.root), out=tmp_path / "world", options=QUICK)
    manifest = bake(
        load_scene(folder.root), out=tmp_path / "mesh", options=dataclasses.replace(QUICK, space="mesh")
    ).manifest
    assert [item.space for item in manifest.objects] == ["mesh"]
    world, mesh = samples(tmp_path / "world" / "ball0.pc2"), samples(tmp_path / "mesh" / "ball0.pc2")
    in_file = trimesh.load(folder.root / "meshes" / "ball0.obj", process=False).vertices
    assert np.array_equal(mesh[0], in_file.astype(np.float32)), "frame 1 is the mesh file to the last bit"
    matrix = np.array(CROOKED)
    for there, here in zip(world, mesh, strict=True):
        # Rounded to float32 twice, in numbers below 1.
        np.testing.assert_allclose(here @ matrix[:3, :3].T + matrix[:3, 3], there, atol=5e-7)
    assert np.abs(world[3] - world[0]).max() > 0.05, "it did move"


def test_a_mirrored_stretched_object_is_filled_like_the_same_shape_made_so(ball_scene, tmp_path):
    """Not inside out, no lighter: particles and volume as of a mesh file that has the crooked shape itself."""
    folder = crooked(ball_scene())
    by_matrix = estimate_bake(folder, QUICK)
    mesh = load_object_mesh(folder, folder.model.objects[0])
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    grown = abs(np.linalg.det(np.array(CROOKED)[:3, :3]))
    assert made.volume == pytest.approx(grown * 4 / 3 * np.pi * 0.05**3, rel=0.02)
    made.export(folder.root / "meshes" / "made.ply")
    item = dataclasses.replace(folder.model.objects[0], mesh="meshes/made.ply", world_from_mesh=np.eye(4).tolist())
    by_file = estimate_bake(save_scene(folder.root, dataclasses.replace(folder.model, objects=(item,))), QUICK)
    assert by_matrix.warnings == by_file.warnings == ()
    body, same = by_matrix.setup.bodies[0], by_file.setup.bodies[0]
    np.testing.assert_allclose(body.positions, same.positions, atol=1e-6)
    assert body.volumes.sum() == pytest.approx(made.volume, rel=1e-5)


@pytest.mark.parametrize(
    ("material", "effects", "points"),
    [
        (load_preset("sand"), (), True),
        (load_preset("water"), (), True),
        (load_preset("snow"), (), True),
        (load_preset("soft"), (Effect(name="sandy", parameters=(("friction_angle", 0.6), ("start", 0.05))),), True),
        (load_preset("clay"), (), False),
        (load_preset("wood"), (), False),
    ],
)
def test_flowing_materials_get_particle_caches(ball_scene, material, effects, points):
    folder = ball_scene(effects=effects)
    item = dataclasses.replace(folder.model.objects[0], material=material)
    folder = save_scene(folder.root, dataclasses.replace(folder.model, objects=(item,)))
    with_points, without = bake_cost(folder, POINTS), bake_cost(folder, QUICK)
    extra = with_points.disk_bytes - without.disk_bytes
    assert extra == (12 * 4 * with_points.prepared.particle_count if points else 0)


@pytest.mark.long
def test_particles_are_kept_in_the_same_space_and_go_on_to_the_same_bytes(ball_scene, tmp_path, monkeypatch):
    folder = crooked(ball_scene(preset="sand", velocity=(0.0, 0.0, -1.0)))
    options = dataclasses.replace(POINTS, space="mesh")
    whole = bake(load_scene(folder.root), out=tmp_path / "whole", options=options).manifest
    item = whole.objects[0]
    assert (item.points_file, item.points) == ("ball0.points.pc2", whole.particles)
    particles = samples(tmp_path / "whole" / "ball0.points.pc2")
    prepared = estimate_bake(folder, options)
    matrix = np.array(CROOKED)
    rest = prepared.setup.bodies[0].positions
    np.testing.assert_allclose(particles[0] @ matrix[:3, :3].T + matrix[:3, 3], rest, atol=5e-7)
    middles = [(p @ matrix[:3, :3].T + matrix[:3, 3]).mean(axis=0)[2] for p in particles]
    assert middles[3] < middles[0] - 0.01, "it falls"
    assert disk_usage(tmp_path / "whole") <= bake_cost(folder, options).disk_bytes

    # Stopped again and again, in the middle of frames, with the state kept as often as can be.
    monkeypatch.setattr(bake_run, "KEEP_SECONDS", 0.0)
    stops = 0
    for _ in range(20):
        left = iter([False] * 100)
        try:
            bake(
                load_scene(folder.root),
                out=tmp_path / "parts",
                options=options,
                cancelled=lambda left=left: next(left, True),
            )
        except Cancelled:
            stops += 1
            continue
        break
    assert stops >= 2
    assert caches(tmp_path / "parts") == caches(tmp_path / "whole")

    # Without the wish the file goes, and a complete bake that misses it is none.
    (tmp_path / "whole" / "ball0.points.pc2").unlink()
    assert not bake_module.is_up_to_date(load_scene(folder.root), tmp_path / "whole", options)
    bake(load_scene(folder.root), out=tmp_path / "parts", options=dataclasses.replace(options, points=False, frames=1))
    assert list(caches(tmp_path / "parts")) == ["ball0.pc2"]


def test_frames_can_be_played_as_they_arrive(ball_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(bake_run, "MANIFEST_SECONDS", 0.0)
    folder, out = ball_scene(preset="sand"), tmp_path / "bake"
    seen = []

    def look(event):
        if event["event"] == "progress" and event["done"]:
            manifest = load_manifest(out)
            for name, count in manifest.files.items():
                cache = Pc2Reader(out / name)
                assert cache.sample_count >= event["done"] and cache.vertex_count == count
                cache.sample(event["done"] - 1)
            seen.append((event["done"], manifest.frames_done))

    bake(load_scene(folder.root), out=out, options=POINTS, on_event=look)
    assert seen == [(1, 1), (2, 2), (3, 3), (4, 4)]


@pytest.mark.slow
def test_a_bake_that_is_killed_again_and_again_ends_with_the_same_bytes(ball_scene, tmp_path):
    """SIGKILL in the middle of frames, writes and checkpoints, of a process that checkpoints after every frame."""
    folder = ball_scene(preset="sand", velocity=(0.0, 0.0, -1.0))
    options = dataclasses.replace(POINTS, frames=6)
    bake(load_scene(folder.root), out=tmp_path / "whole", options=options)
    code = f"""
import json, sys
from pathlib import Path
from physgen.sim.app import bake as module, bake_run
from physgen.sim.scene.folder import load_scene
bake_run.CHECKPOINT_SECONDS = bake_run.KEEP_SECONDS = bake_run.MANIFEST_SECONDS = 0.0
options = module.BakeOptions(frames=6, fps=24.0, quality="preview", points=True)
module.bake(load_scene(Path({str(folder.root)!r})), out={str(tmp_path / "parts")!r}, options=options,
            on_event=lambda event: print(json.dumps(event), flush=True))
"""
    continued = 0
    for kill_at in (1, 4):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        for line in process.stdout:
            event = json.loads(line)
            continued += "continuing" in event.get("message", "")
            if event.get("done", 0) >= kill_at:
                break
        process.kill()
        process.communicate()
        manifest = load_manifest(tmp_path / "parts")
        assert manifest.state == "running" and manifest.frames_done >= kill_at
        for name in manifest.files:
            assert len(samples(tmp_path / "parts" / name)) >= manifest.frames_done
    assert continued == 1
    assert bake(load_scene(folder.root), out=tmp_path / "parts", options=options).manifest.state == "complete"
    assert caches(tmp_path / "parts") == caches(tmp_path / "whole")
    left = sorted(p.relative_to(tmp_path / "parts").as_posix() for p in (tmp_path / "parts").rglob("*") if p.is_file())
    assert left == ["ball0.pc2", "ball0.points.pc2", "manifest.json", "metrics.json", "times.json"]


@pytest.mark.long
def test_a_disk_that_is_full_of_particles_keeps_what_was_good(ball_scene, own_kernels, tmp_path):
    folder = ball_scene(preset="sand")
    particles = estimate_bake(folder, POINTS).particle_count
    job = bake_worker.BakeJob(scene=str(folder.root), out=str(tmp_path / "bake"), options=POINTS)
    (tmp_path / "job.json").write_text(json.dumps(bake_worker.job_to_json(job)))
    # The mesh's cache fits, two and a half samples of the particles do.
    limit = 32 + 30 * particles
    assert limit > 32 + 4 * 12 * 642

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    # Without a checkpoint, which is larger than that and due when a busy machine has taken 20 s.
    code = (
        "import sys; from physgen.sim.app import bake_run, bake_worker; "
        "bake_run.CHECKPOINT_SECONDS = 1e9; sys.exit(bake_worker.main(sys.argv[1:]))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "job.json")],
        capture_output=True,
        preexec_fn=small_files,
        env=own_kernels,
        check=False,
    )
    last = json.loads(result.stdout.splitlines()[-1])
    assert (result.returncode, last["kind"]) == (3, "InputError"), result.stderr[-800:]
    assert "free space" in last["message"]
    manifest = load_manifest(tmp_path / "bake")
    assert (manifest.state, manifest.frames_done) == ("cancelled", 2)
    assert all(len(samples(tmp_path / "bake" / name)) >= 2 for name in manifest.files)
    assert bake(load_scene(folder.root), out=tmp_path / "bake", options=POINTS).manifest.state == "complete"


def test_a_place_that_cannot_be_written_is_named(ball_scene, tmp_path):
    folder = ball_scene(preset="sand")
    out = tmp_path / "bake"
    bake(load_scene(folder.root), out=out, options=dataclasses.replace(POINTS, frames=1))
    (out / "ball0.points.pc2").unlink()
    (out / "ball0.points.pc2").mkdir()
    with pytest.raises(InputError, match=r"bake: cannot be written"):
        bake(load_scene(folder.root), out=out, options=dataclasses.replace(POINTS, frames=2))
    (out / "ball0.points.pc2").rmdir()
    assert (
        bake(load_scene(folder.root), out=out, options=dataclasses.replace(POINTS, frames=2)).manifest.state
        == "complete"
    )


def test_too_little_room_for_the_particles_is_said_before_it_starts(ball_scene, tmp_path, monkeypatch):
    folder = ball_scene(preset="sand")
    many = dataclasses.replace(POINTS, frames=20_000)
    mesh_only = bake_cost(folder, dataclasses.replace(many, points=False)).disk_bytes
    usage = shutil.disk_usage(tmp_path)._replace(free=mesh_only + 2**27)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match="MiB are free"):
        bake(load_scene(folder.root), out=tmp_path / "bake", options=many)


@pytest.mark.long
def test_without_photo_and_floor_a_body_falls_on_for_ever(ball_scene, tmp_path, capsys):
    folder = ball_scene(velocity=(0.0, 0.0, 0.0), photo=None, background=None, ground=None)
    (folder.root / "photo.png").unlink()
    (folder.root / "background.png").unlink()
    out = tmp_path / "bake"
    bake(load_scene(folder.root), out=out, options=dataclasses.replace(QUICK, frames=13))
    fallen = samples(out / "ball0.pc2")
    # The lower edge of the ball stood 2 mm above where the ground would be. 0.5 % of ½gt², as in free fall elsewhere.
    expected = 0.5 * 9.81 * 0.5**2
    assert (fallen[0] - fallen[12]).mean(axis=0)[2] == pytest.approx(expected, rel=0.005)
    metrics = json.loads((out / "metrics.json").read_text())["frames"]
    assert {m["ground_gap_m"] for m in metrics} == {None}

    assert main(["render", str(folder.root), "--bake", str(out), "--out", str(tmp_path / "frames")]) == 3
    assert "no photo to render into" in capsys.readouterr().err
    assert not (tmp_path / "frames").exists()
    assert main(["free", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["bytes"] > 13 * 12 * 642
    assert not out.exists()
    assert main(["free", str(out)]) == 3


def test_space_and_points_are_inputs_only_where_they_are_asked_for(ball_scene):
    folder = ball_scene()
    plain = inputs_hash(folder, QUICK)
    others = [dataclasses.replace(QUICK, space="mesh"), POINTS, dataclasses.replace(QUICK, seed=1)]
    assert len({plain, *(inputs_hash(folder, options) for options in others)}) == 4
    for wrong, match in (({"space": "camera"}, "space"), ({"seed": -1}, "seed")):
        with pytest.raises(InputError, match=match):
            dataclasses.replace(QUICK, **wrong)


def test_a_seed_moves_the_particles_and_nothing_else(ball_scene):
    folder = ball_scene()
    lattice, one, again, two = (
        estimate_bake(folder, dataclasses.replace(QUICK, seed=seed)).setup.bodies[0] for seed in (0, 1, 1, 2)
    )
    spacing = (lattice.volumes.sum() / lattice.count) ** (1 / 3)
    assert np.array_equal(one.positions, again.positions) and np.array_equal(one.volumes, lattice.volumes)
    for body, other in ((one, lattice), (two, lattice), (one, two)):
        moved = np.abs(body.positions - other.positions)
        assert 0.05 * spacing < moved.mean() and moved.max() < 0.5 * spacing
    assert one.positions[:, 2].min() - one.contact_radii[one.positions[:, 2].argmin()] >= 0.0


def test_old_scenes_hash_as_they_did(ball_scene):
    """Bakes of earlier versions with this ENGINE_REVISION (17) stay up to date: the hash of a scene fixed here."""
    folder = ball_scene()
    (folder.root / "meshes" / "ball0.glb").write_bytes(b"stands for a mesh")
    item = dataclasses.replace(folder.model.objects[0], material=Material())
    folder = save_scene(folder.root, dataclasses.replace(folder.model, objects=(item,)))
    assert inputs_hash(folder, QUICK) == "75df5a3e0ad0ca752abae224a83b1834e7feee5cf88d3043d68784c461f3ac79"


def test_blenders_process_can_ask_what_is_out_of_date():
    """Without SciPy and trimesh, which Blender has not, and without Taichi, which must not be there."""
    code = (
        "import sys, physgen.sim.app.bake_options, physgen.sim.cache.bake_folder, physgen.sim.cache.pc2\n"
        "print([n for n in ('scipy', 'trimesh', 'taichi', 'cv2', 'PIL', 'skimage') if n in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
