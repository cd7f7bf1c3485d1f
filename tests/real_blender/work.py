"""Inside Blender, with the extension: an artist's work from an empty file to a saved one, and pictures on the way.

More steps: write a generator function and name it in STEPS.
"""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
import screens
import session

TASK = session.task()
OUT, SCREENS = Path(TASK["out"]), Path(TASK["out"]) / "screens"
LAST = 16
"""Frames that are baked."""
SHOWN = 12
"""The frame that is rendered before and after."""


def extension(module: str):
    """A module of the installed extension."""
    return importlib.import_module(f"{TASK['addon']}.{module}")


def preferences():
    return bpy.context.preferences.addons[TASK["addon"]].preferences


def enabled():
    """It is there, with panels, and has loaded nothing that opening Blender should not wait for."""
    assert TASK["addon"] in bpy.context.preferences.addons
    heavy = {"scipy", "trimesh", "cv2", "skimage", "taichi", "PIL"} & set(sys.modules)
    names = screens.open_all()
    assert names, "no panel in the tab PhysGen"
    assert not heavy, f"enabling has loaded {heavy}"
    yield from screens.show_sidebar()
    return {"panels": names}


def empty():
    """Every panel in a file without anything of the extension's."""
    yield from screens.shoot(SCREENS, "1_empty")


def python_missing():
    """The preferences' page before and after a check that fails, with the command that mends it."""
    SCREENS.mkdir(exist_ok=True)
    yield from screens.shoot_preferences(SCREENS, "2_preferences", TASK["addon"])
    preferences().python = str(OUT / "no such python")
    try:
        bpy.ops.physgen.check_python()
    except RuntimeError as error:
        assert "pip install" in str(error), error
    else:
        raise AssertionError("a Python that is not there was found")
    yield from screens.shoot_preferences(SCREENS, "2_preferences_trouble", TASK["addon"])


def python_found():
    """The interpreter that the run was given, in the preferences, checked live."""
    preferences().python = TASK["python"]
    with screens.focus():
        assert bpy.ops.physgen.check_python("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    running = extension("physgen_addon.jobs").running
    yield from session.until(lambda: running() is None, 120, "the check of the interpreter")
    assert preferences().check == "YES", preferences().check_text
    yield from screens.shoot_preferences(SCREENS, "2_preferences_found", TASK["addon"])
    return {"python": preferences().check_text}


def scene_of_two():
    """A jelly cube above the ground, and a wooden ball beside it that flies off; camera and lamp are the file's own."""
    scene = bpy.context.scene
    with screens.focus():
        cube = bpy.data.objects.get("Cube")
        if cube is None:
            bpy.ops.mesh.primitive_cube_add(size=2)
            cube = bpy.context.object
        cube.scale, cube.location = (0.15, 0.15, 0.15), (0.0, 0.0, 0.35)
        bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8, radius=0.12, location=(0.5, 0.0, 0.3))
        ball = bpy.context.object
        bpy.ops.mesh.primitive_plane_add(size=4)
    ball.name = "Bäll 1"
    for item, preset in ((cube, "jelly"), (ball, "wood")):
        item.physgen.enabled = True
        item.physgen.material.preset = preset
    ball.physgen.velocity = (0.5, 0.0, 1.0)
    scene.camera.location = (2.0, -2.0, 1.0)
    scene.camera.rotation_euler = (1.25, 0.0, 0.785)
    simulation = scene.physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = "preview", 1, LAST
    bpy.context.view_layer.objects.active = cube
    cube.select_set(True)
    screens.viewport().spaces.active.region_3d.view_perspective = "CAMERA"
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "saved.blend"))
    yield from screens.shoot(SCREENS, "3_scene")


def baked():
    """Bake live; a picture in the middle. ``blocked_s``: the longest time without an answer, drawing included."""
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    running = extension("physgen_addon.jobs").running
    yield from session.until(lambda: running() is None or (running().fraction or 0) > 0.2, 200, "the bake to begin")
    if running() is not None:
        yield from screens.shoot(SCREENS, "4_baking")
    blocked = yield from session.until(lambda: running() is None, 400, "the bake")
    yield from screens.shoot(SCREENS, "5_baked")
    return {"blocked_s": round(blocked, 3)}


def mean_place(name: str) -> np.ndarray:
    """Mean of the evaluated vertices in world coordinates, (3,)."""
    item = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.mean([item.matrix_world @ vertex.co for vertex in item.data.vertices], axis=0)


def played():
    """Both objects move, and the animation plays. ``fps``: with whatever draws here, often the processor."""
    scene = bpy.context.scene
    scene.frame_set(1)
    before = {name: mean_place(name) for name in ("Cube", "Bäll 1")}
    scene.frame_set(SHOWN)
    moved = {name: float(np.linalg.norm(mean_place(name) - place)) for name, place in before.items()}
    assert min(moved.values()) > 0.02, moved
    shown = []
    bpy.app.handlers.frame_change_post.append(lambda *_: shown.append(1))
    with screens.focus():
        bpy.ops.screen.animation_play()
    began = time.monotonic()
    yield from session.until(lambda: len(shown) > 5, 60, "the animation to play")
    rate = len(shown) / (time.monotonic() - began)
    with screens.focus():
        bpy.ops.screen.animation_cancel(restore_frame=False)
    bpy.app.handlers.frame_change_post.pop()
    return {"moved_m": moved, "fps": round(rate, 1)}


def rendered():
    """One frame by Cycles, as small as will do for a comparison."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = 8, False, 3
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 320, 240, 100
    scene.render.image_settings.file_format = "PNG"
    scene.frame_set(SHOWN)
    scene.render.filepath = str(OUT / "with.png")
    bpy.ops.render.render(write_still=True)
    yield 0.1


def saved():
    """Saved, so that a colleague can open it."""
    bpy.ops.wm.save_mainfile()
    yield 0.1


STEPS = [enabled, empty, python_missing, python_found, scene_of_two, baked, played, rendered, saved]
session.run("work", STEPS)
