# SPDX-License-Identifier: GPL-3.0-or-later
"""A job for a farm from the panel: the photo's scene with the panel's physics, run or exported by ``batch``."""

import dataclasses
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy")
from physgen.batch.farm.planning.job_file import load_job
from physgen.batch.farm.planning.task_graph import make_plan
from physgen.physgen_addon.operators import farm_ops
from physgen.physgen_addon.props.render_props import render_options
from physgen.physgen_addon.scene_io import import_scene as bridge
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.sim.app.bake_transfer import transfer_physics
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.model import Ground

from . import checked_layout

NAMES = {"ball": "ball"}


pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def photo(world, tmp_path):
    """The world's scene, imported and saved in a folder whose name is not plain; its floor mirrors."""
    root = tmp_path / "é scene"
    shutil.copytree(world.folder.root, root)
    folder = load_scene(root)
    folder = save_scene(root, dataclasses.replace(folder.model, ground=Ground(reflectivity=0.1)))
    bridge.import_scene(bpy.context.scene, root)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    return folder


def a_body():
    return bpy.context.scene.objects["ball"].physgen


def test_the_job_has_the_physics_of_the_panel_and_the_photo_of_the_folder(photo, tmp_path):
    scene, body = bpy.context.scene, a_body()
    body.material.preset, body.velocity, body.asleep = "jelly", (0.1, 0.0, 0.7), False
    scene.gravity = (0.0, 0.0, -3.7)
    scene.physgen.world.friction = 0.15
    bpy.ops.physgen.add_stack_effect(effect="wind")
    simulation, rendering = scene.physgen.simulation, scene.physgen.rendering
    simulation.frame_end, simulation.slow, simulation.seed = 6, 2.0, 3
    rendering.own_samples, rendering.samples, rendering.size = True, 2, 50.0
    rendering.farm, rendering.farm_chunk, rendering.video = "slurm", 4, "webm"
    assert bpy.ops.physgen.farm() == {"FINISHED"}
    folder = tmp_path / "physgen_farm"
    made = load_scene(folder / "scene")
    (item,) = made.model.objects
    assert (item.material.preset, item.material.youngs_modulus) == ("jelly", 1e4)
    assert item.velocity == pytest.approx((0.1, 0.0, 0.7)) and not item.asleep
    assert made.model.gravity == pytest.approx((0.0, 0.0, -3.7)) and [e.name for e in made.model.effects] == ["wind"]
    assert (made.model.ground.friction, made.model.ground.reflectivity) == (pytest.approx(0.15), 0.1)
    assert (item.mesh, item.mask, made.model.photo) == ("meshes/ball.glb", "masks/ball.png", "photo.png")
    assert made.geometry_hash() == photo.geometry_hash()
    (planned,) = load_job(folder / "job.toml").scenes
    assert (planned.render.chunk, planned.render.video) == (4, ("webm",))
    stages = [task.stage for task in make_plan(load_job(folder / "job.toml")).tasks]
    assert stages.count("render") == 2 and stages[-1] == "encode"
    assert (folder / "slurm" / "submit.sh").is_file()
    # What is shown does the same.
    line = shlex.split(farm_ops.command(scene))
    assert line[0] == "physgen" and line[-4:] == ["--export", "slurm", "--out", str(folder / "slurm")]
    before = {path: path.read_bytes() for path in (folder / "slurm").iterdir()}
    shutil.rmtree(folder / "slurm")
    subprocess.run([sys.executable, "-m", "physgen.batch.cli", *line[1:]], check=True, capture_output=True)
    assert {path: path.read_bytes() for path in (folder / "slurm").iterdir()}.keys() == before.keys()


def test_the_job_file_says_everything(photo, tmp_path, capfd):
    rendering = bpy.context.scene.physgen.rendering
    rendering.farm, rendering.engine, rendering.format, rendering.blurs_depth = "flamenco", "eevee", "exr_layers", True
    rendering.grain = False
    assert bpy.ops.physgen.farm() == {"FINISHED"}
    found = tomllib.loads((tmp_path / "physgen_farm" / "job.toml").read_text(encoding="utf-8"))
    wanted = {"engine": "eevee", "format": "exr-layers", "grain": False, "video": ["mp4"], "chunk": 24}
    assert found["defaults"]["render"].items() >= wanted.items()
    assert found["defaults"]["render"]["f_number"] == pytest.approx(2.8)
    (planned,) = load_job(tmp_path / "physgen_farm" / "job.toml").scenes
    assert planned.options == dataclasses.replace(render_options(rendering), f_number=planned.options.f_number)
    assert (tmp_path / "physgen_farm" / "flamenco" / "job.json").is_file()
    # What there is to do, not a list of a dozen files in one line of the status bar.
    (said,) = [line for line in capfd.readouterr().out.splitlines() if "The job is written" in line]
    assert said.endswith("flamenco. Submit job.json to Flamenco (see docs/farm.md).")
    # It stays in the panel, for that farm alone.
    panel = bpy.types.PHYSGEN_PT_farm
    assert "Submit job.json" in " ".join(checked_layout.draw(panel).words)
    rendering.farm = "slurm"
    assert farm_ops.written(bpy.context.scene) is None and "Submit" not in " ".join(checked_layout.draw(panel).words)


def test_what_a_photos_scene_cannot_say_is_refused_before_anything_is_written(photo, tmp_path):
    scene = bpy.context.scene
    scene.physgen.rendering.farm = "slurm"
    item = scene.objects["ball"]
    item.location.x += 0.2
    with pytest.raises(RuntimeError, match="is not where and as the photo shows it"):
        bpy.ops.physgen.farm()
    item.location.x -= 0.2
    item.physgen.enabled = False
    bpy.ops.mesh.primitive_cube_add(size=0.05, location=(0, 0, 0.3))
    bpy.context.object.name = "stranger"
    bpy.ops.physgen.add_bodies()
    with pytest.raises(RuntimeError, match="not in the photo: stranger"):
        bpy.ops.physgen.farm()
    assert not (tmp_path / "physgen_farm").exists()


def test_an_object_that_is_not_simulated_is_named(photo, tmp_path):
    exported = export_scene(bpy.context.scene, tmp_path / "export")
    (ball,) = photo.model.objects
    two = dataclasses.replace(photo.model, objects=(ball, dataclasses.replace(ball, name="cup")))
    with pytest.raises(InputError, match="'cup': is in the photo and not in the simulation"):
        transfer_physics(photo.with_model(two), exported, NAMES)


def test_no_job_without_a_photo_or_a_place():
    assert not bpy.ops.physgen.farm.poll()
    bpy.context.scene.physgen.folder = "//somewhere"
    assert not bpy.ops.physgen.farm.poll()


@pytest.mark.long
def test_a_job_runs_here_to_its_video(photo, tmp_path):
    scene = bpy.context.scene
    scene.physgen.simulation.frame_end = 4
    a_body().velocity = (0.0, 0.0, 0.6)
    rendering = scene.physgen.rendering
    rendering.own_samples, rendering.samples, rendering.size, rendering.farm_chunk = True, 1, 40.0, 2
    assert bpy.ops.physgen.farm() == {"FINISHED"}
    assert Path(rendering.result) == tmp_path / "physgen_farm/results/clip/base/video.mp4"
    assert Path(rendering.result).stat().st_size > 500
