# SPDX-License-Identifier: GPL-3.0-or-later
"""Physical checks of a bake: each figure on motions whose answer is known."""

import dataclasses
import json

import numpy as np
import physgen
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.benchmarks.common import write_bake
from physgen.sim.cache.bake_folder import load_manifest, save_manifest
from physgen.sim.errors import InputError
from physgen.sim.evaluate.bake_physics import depth_in, volume_centre
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.meshes import read_mesh
from physgen.sim.scene.model import Camera, Effect, Ground, SceneModel, SceneObject

POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
CUBE = trimesh.creation.box((0.1, 0.1, 0.1))
FPS = 24.0


def scene_and_bake(root, ways, *, energies=None, fps=FPS, **model):
    """A scene of cubes of 0.1 m and its bake. ways: by name, the centre (T, 3) over time."""
    scene = root / "scene"
    (scene / "meshes").mkdir(parents=True)
    objects = []
    for name in ways:
        CUBE.export(scene / "meshes" / f"{name}.ply")
        objects.append(SceneObject(name=name, mesh=f"meshes/{name}.ply", size_m=0.1, material=load_preset("hard")))
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, world_from_camera=POSE)
    for name in ("photo.png", "background.png"):
        (scene / name).write_bytes(b"any")
    model = {"ground": Ground(), **model}
    if "asleep" in model:
        sleepers = model.pop("asleep")
        objects = [dataclasses.replace(item, asleep=item.name in sleepers) for item in objects]
    save_scene(scene, SceneModel(photo="photo.png", camera=camera, objects=tuple(objects), **model))
    order = np.asarray(read_mesh(scene / objects[0].mesh).vertices)
    write_bake(root / "bake", {name: [order + centre for centre in centres] for name, centres in ways.items()})
    save_manifest(root / "bake", dataclasses.replace(load_manifest(root / "bake"), fps=fps))
    if energies is not None:
        frames = [{"kinetic_j": k, "elastic_j": e, "potential_j": p} for k, e, p in energies]
        (root / "bake" / "metrics.json").write_text(json.dumps({"frames": frames}))
    return root / "bake"


def way(heights, x=0.0):
    heights = np.asarray(heights, dtype=float)
    return np.column_stack([np.broadcast_to(x, heights.shape), np.zeros_like(heights), heights])


def figures(bake, **options):
    found = physgen.evaluate(None, bake=bake, out=bake.with_name("out"), **options)
    return {item.name: item.value for item in found.measures}, found


def test_free_fall_is_free_fall_and_half_of_it_is_not(tmp_path):
    t = np.arange(8) / FPS
    fall, found = figures(scene_and_bake(tmp_path / "a", {"cube": way(1.0 - 0.5 * 9.81 * t**2)}))
    # 32-bit caches: 6e-8 m, over a second difference times rate squared.
    assert fall["flight_error"] < 1e-3 and fall["ground_penetration"] == pytest.approx(0, abs=1e-6)
    assert fall["object_penetration"] is None and fall["contact_slip"] is None
    notes = {item.name: item.note for item in found.measures}
    assert "two closed objects" in notes["object_penetration"] and "metrics.json" in notes["energy_gain"]
    half, _ = figures(scene_and_bake(tmp_path / "b", {"cube": way(1.0 - 0.25 * 9.81 * t**2)}))
    assert half["flight_error"] == pytest.approx(0.5, abs=1e-3)


def test_what_sinks_slips_or_is_pulled_is_seen(tmp_path):
    rest = np.full(12, 0.05)
    sunk, _ = figures(scene_and_bake(tmp_path / "a", {"cube": way(rest - 0.005 * (np.arange(12) == 5), x=0.0)}))
    assert sunk["ground_penetration"] == pytest.approx(0.05, abs=1e-4)
    slow = 0.001 * np.arange(12) / FPS
    slip, _ = figures(scene_and_bake(tmp_path / "b", {"cube": way(rest, x=slow)}))
    assert slip["contact_slip"] == pytest.approx(0.01, rel=0.01) and slip["pull"] == pytest.approx(0.0, abs=1e-3)
    # At 0.5 sizes a second it slides, and does not rest.
    slides, _ = figures(scene_and_bake(tmp_path / "c", {"cube": way(rest, x=0.05 * np.arange(12) / FPS)}))
    assert slides["contact_slip"] is None
    t = np.arange(6) / 240
    pulled = scene_and_bake(tmp_path / "d", {"cube": way(0.0505 - 9.81 * t**2)}, fps=240.0)
    assert figures(pulled)[0]["pull"] == pytest.approx(1.0, abs=0.05)


def test_cubes_in_each_other_and_energy_from_nothing_are_seen(tmp_path):
    ways = {"one": way(np.full(4, 0.3)), "two": way(np.full(4, 0.3), x=np.array([0.3, 0.2, 0.098, 0.2]))}
    energies = [(1.0, 0.0, 5.0), (0.4, 0.2, 5.2), (0.9, 0.2, 5.2), (0.5, 0.2, 5.0)]
    bake = scene_and_bake(tmp_path, ways, energies=energies)
    found, _ = figures(bake)
    # 2 mm of 100 mm.
    assert found["object_penetration"] == pytest.approx(0.02, abs=1e-3)
    # From 5.8 J to 6.3 J, of 1.3 J at most above the lowest place.
    assert found["energy_gain"] == pytest.approx(0.5 / 1.3)
    (bake / "metrics.json").write_text('{"frames": [{"kinetic_j": "many"}]}')
    with pytest.raises(InputError, match="frame 1 has no kinetic_j"):
        figures(bake)


def test_an_object_that_wakes_brings_its_energy_along(tmp_path):
    ways = {"one": way(np.full(6, 0.3)), "two": way([0.3, 0.3, 0.3, 0.29, 0.28, 0.27], x=1.0)}
    energies = [(1.0, 0.0, 1.0)] * 2 + [(1.0, 0.0, 4.0)] * 4
    awake, _ = figures(scene_and_bake(tmp_path / "a", ways, energies=energies))
    asleep, found = figures(scene_and_bake(tmp_path / "b", ways, energies=energies, asleep=("two",)))
    assert awake["energy_gain"] == pytest.approx(3 / 4) and asleep["energy_gain"] == 0
    assert any("asleep at first" in text for text in found.notices)


def test_the_scene_is_found_beside_the_bake_or_its_absence_is_said(tmp_path, capsys):
    bake = scene_and_bake(tmp_path, {"cube": way(np.full(4, 0.05))}, energies=[(0.0, 0.0, 1.0)] * 4)
    assert main(["evaluate", str(bake)]) == 0
    assert "Physics of the bake" in capsys.readouterr().out
    assert (tmp_path / "bake_evaluation" / "report.html").is_file()
    (tmp_path / "scene").rename(tmp_path / "elsewhere")
    found, _ = figures(bake)
    assert found["ground_penetration"] is None and found["energy_gain"] == 0
    assert figures(bake, scene=tmp_path / "elsewhere")[0]["ground_penetration"] == pytest.approx(0, abs=1e-6)
    windy = load_scene(tmp_path / "elsewhere")
    wind = Effect(name="wind", parameters=(("wind_x", 2.0), ("wind_y", 0.0), ("wind_z", 0.0), ("drag_per_mass", 0.5)))
    windy = windy.with_model(dataclasses.replace(windy.model, effects=(wind,)))
    assert any("wind" in text for text in figures(bake, scene=windy)[1].notices)


def test_unusable_bakes_and_scenes_are_refused(tmp_path):
    bake = scene_and_bake(tmp_path / "a", {"cube": way(np.full(2, 0.05))})
    with pytest.raises(InputError, match="has 2 frames"):
        figures(bake)
    bake = scene_and_bake(tmp_path / "b", {"cube": way(np.full(4, 0.05))})
    scene_and_bake(tmp_path / "c", {"ball": way(np.full(4, 0.05))})
    with pytest.raises(InputError, match="has no object cube"):
        figures(bake, scene=tmp_path / "c" / "scene")
    with pytest.raises(InputError, match="nothing to evaluate"):
        physgen.evaluate(None, out=tmp_path / "out")
    with pytest.raises(InputError, match="compare a video"):
        physgen.evaluate(None, bake=bake, against=["take.mp4"], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(0.3, 3.0), st.integers(0, 10**6))
def test_depths_and_centres_follow_motion_and_scale(offset, scale, seed):
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rotation = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))[:3, :3]
    moved = scale * np.asarray(sphere.vertices) @ rotation.T + [offset, 1.0, 2.0]
    assert volume_centre(moved, sphere.faces) == pytest.approx([offset, 1.0, 2.0], abs=1e-9)
    # A point at a distance from the middle: as deep as it is below the facets, which lie within the sphere.
    depth = depth_in(np.array([[offset + 0.05 * scale, 1.0, 2.0]]), moved, np.asarray(sphere.faces))
    assert 0.045 * scale < depth < 0.0501 * scale
    assert depth_in(np.array([[offset + 0.101 * scale, 1.0, 2.0]]), moved, np.asarray(sphere.faces)) == 0
