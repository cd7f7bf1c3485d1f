# SPDX-License-Identifier: MIT
"""The public API: what ``import physgen`` gives, what it costs, and the examples that use it."""

import csv
import doctest
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import physgen
import pytest
from scipy.integrate import solve_ivp

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
DOCUMENTED = [n for n in physgen.__all__ if inspect.isfunction(getattr(physgen, n))]
DOCUMENTED += ["Bake", "Capture", "Diagnosis", "PhysGenError", "Scene", "World"]


def example(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_importing_costs_nothing_and_every_name_is_there():
    code = """
import sys, physgen
heavy = {"taichi", "bpy", "scipy", "cv2", "numpy", "trimesh"} & set(sys.modules)
assert not heavy, heavy
for name in ("PhysGenError", "Scene", "load_scene", "Bake", "bake", "reconstruct", "render", "track", "Capture"):
    getattr(physgen, name)
assert not {"taichi", "bpy"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert set(physgen.__all__) <= set(dir(physgen))
    assert physgen.World.__module__.endswith("mpm.world")
    with pytest.raises(AttributeError, match="has no attribute 'simulate'"):
        _ = physgen.simulate


@pytest.mark.parametrize("name", DOCUMENTED)
def test_public_names_are_typed_and_their_examples_run(name, tmp_path, monkeypatch):
    value = getattr(physgen, name)
    examples = doctest.DocTestParser().get_doctest(inspect.getdoc(value), {}, name, None, None)
    assert examples.examples, f"physgen.{name} has no example"
    compile("\n".join(line.source for line in examples.examples), name, "exec")
    # What needs files is marked +SKIP; examples/ runs that.
    monkeypatch.chdir(tmp_path)
    assert doctest.DocTestRunner().run(examples).failed == 0
    if inspect.isfunction(value):
        assert all(p.annotation is not p.empty for p in inspect.signature(value).parameters.values())


def test_a_request_with_other_physics_is_honoured_where_the_scene_is_cached(first_fill, tmp_path):
    from PIL import Image, ImageDraw

    picture = Image.new("RGB", (160, 120), (180, 170, 150))
    ImageDraw.Draw(picture).ellipse((60, 40, 100, 80), fill=(200, 60, 30))
    picture.save(tmp_path / "photo.png")
    quick = {"max_size": 160, "report": False, "sun": False, "mesh_vertices": 500, "patch_radius": 3}
    box, options = (55, 35, 105, 85), physgen.ReconstructOptions(**quick)

    def velocity_of(**physics):
        request = physgen.ObjectRequest(box=box, shape="inflated", **physics.pop("request", {}))
        scene = physgen.reconstruct(
            tmp_path / "photo.png", [request], out=tmp_path / "scene", options=options, **physics
        )
        assert physgen.load_scene(tmp_path / "scene") == scene
        return scene.objects[0].velocity, scene.objects[0].material.preset

    assert velocity_of(request={"velocity": (0.0, 0.0, 1.0), "preset": "soft"}) == ((0.0, 0.0, 1.0), "soft")
    assert velocity_of(request={"velocity": (0.5, 0.0, 0.0), "preset": "soft"}) == ((0.5, 0.0, 0.0), "soft")
    assert velocity_of(request={"preset": "hard"}) == ((0.0, 0.0, 0.0), "hard")
    given = physgen.Physics(presets=("jelly",), velocities=((0.0, 1.0, 0.0),))
    assert velocity_of(request={"velocity": (9.0, 0.0, 0.0)}, physics=given) == ((0.0, 1.0, 0.0), "jelly")


def test_example_drop_a_mesh(tmp_path):
    heights = example("drop_a_mesh").main(None, tmp_path, frames=6)
    assert len(heights) == 6 and heights[0] == pytest.approx(0.3, abs=0.005)
    # Free fall: half a g t².
    assert heights[4] == pytest.approx(0.3 - 4.905 * (4 / 24) ** 2, abs=0.01)


def test_example_scene_to_usd(tmp_path):
    pytest.importorskip("pxr")
    stage = example("scene_to_usd").main(tmp_path, frames=4)
    from pxr import UsdGeom, UsdPhysics

    crate = stage.GetPrimAtPath("/World/crate")
    density = UsdPhysics.MaterialAPI(stage.GetPrimAtPath("/World/Materials/crate")).GetDensityAttr().Get()
    assert UsdPhysics.MassAPI(crate).GetMassAttr().Get() == pytest.approx(density * 0.2 * 0.2 * 0.1, rel=1e-5)
    # Free fall over three frames of a 24th of a second.
    height = UsdGeom.Xformable(crate).GetLocalTransformation(4).ExtractTranslation()[2]
    assert height == pytest.approx(0.4 - 4.905 * (3 / 24) ** 2, abs=2e-3)


@pytest.mark.long
def test_example_mujoco_to_scene(tmp_path):
    heights = example("mujoco_to_scene").main(None, tmp_path, frames=4)
    # Free fall over three frames of a 24th of a second.
    assert heights["can"] == pytest.approx(0.3 - 4.905 * (3 / 24) ** 2, abs=2e-3)
    assert set(heights) == {"hammer", "can"}


@pytest.mark.long
def test_example_sand_and_honey(tmp_path):
    reach = example("sand_and_honey").main(tmp_path, materials=("sand", "water"), frames=6)
    assert 0.0707 < reach["sand"] < reach["water"]


def test_example_parameter_sweep(tmp_path):
    flattening = example("parameter_sweep").main(tmp_path, moduli=(2e4, 5e5), frames=8)
    assert flattening[2e4] > 2 * flattening[5e5] > 0


def test_example_recordings_to_captures(tmp_path):
    pytest.importorskip("ezc3d")
    c3d, mcap, bag = example("recordings_to_captures").main(tmp_path)
    assert np.isnan(c3d.trials[0].points[20]).all() and np.isfinite(mcap.trials[0].points).all()
    np.testing.assert_array_equal(mcap.trials[0].points, bag.trials[0].points)
    seen = np.isfinite(c3d.trials[0].points)
    np.testing.assert_allclose(c3d.trials[0].points[seen], bag.trials[0].points[seen], atol=1e-6)


@pytest.mark.long
def test_example_csv_to_verdict(tmp_path):
    def slope(_, state):
        v = state[3:]
        return np.concatenate([v, (0.0, 0.0, -9.81) - 0.35 * np.linalg.norm(v) * v])

    generator = np.random.default_rng(0)
    with (tmp_path / "toss.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["trial", "time", "x", "y", "z"])
        for trial, velocity in enumerate([(3, 0, 3), (-4, 1, 2), (0, 5, 1), (6, 0, 2), (-2, -4, 3), (4, 2, 3)]):
            times = np.linspace(0, 0.5, 51)
            way = solve_ivp(slope, (0, 0.5), [0, 0, 1.5, *velocity], t_eval=times, rtol=1e-8).y[:3].T
            for time, place in zip(times, way + generator.normal(0, 0.001, way.shape), strict=True):
                writer.writerow([f"t{trial}", time, *place])
    found = example("csv_to_verdict").main(tmp_path / "toss.csv", tmp_path / "work", radius=0.1, density=20.0)
    assert found.verdict.effect == "air_drag"
    assert re.fullmatch(r"Diagnosis\(air_drag, probability [01]\.\d\d\)", repr(found))
    assert repr(physgen.load_capture(tmp_path / "work" / "capture")).count("\n") == 0
    assert (tmp_path / "work" / "diagnosis" / "report.html").is_file()


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="renders with bpy")
def test_example_photo_to_video(first_fill, tmp_path):
    from PIL import Image, ImageDraw

    picture = Image.new("RGB", (160, 120), (180, 170, 150))
    ImageDraw.Draw(picture).ellipse((60, 40, 100, 80), fill=(200, 60, 30))
    picture.save(tmp_path / "photo.png")
    quick = {"frames": 2, "samples": 1, "max_size": 120}
    video = example("photo_to_video").main(tmp_path / "photo.png", [(55, 35, 105, 85)], tmp_path / "work", **quick)
    assert video.stat().st_size > 0
    assert len(list((tmp_path / "work" / "frames").glob("*.png"))) == 2
