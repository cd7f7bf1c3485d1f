# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, with the extension: an artist's work from an empty file to a saved one, and pictures on the way.

More steps: write a generator function and name it in STEPS.
"""

from __future__ import annotations

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
        # Blender breaks long reports into lines.
        assert "no Python" in " ".join(str(error).split()), error
        assert "pip install" in preferences().check_command, preferences().check_command
    else:
        raise AssertionError("a Python that is not there was found")
    yield from screens.shoot_preferences(SCREENS, "2_preferences_trouble", TASK["addon"])


def python_found():
    """The interpreter that the run was given, in the preferences, checked live."""
    preferences().python = TASK["python"]
    with screens.focus():
        assert bpy.ops.physgen.check_python("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    running = session.extension("physgen_addon.background_jobs").running
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


def bake(name: str) -> session.Step:
    """Bake live, with a picture in the middle and one at the end; the longest time without an answer, in seconds."""
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    running = session.extension("physgen_addon.background_jobs").running
    job = running()
    yield from session.until(lambda: running() is None or (job.fraction or 0) > 0.2, 200, "the bake to begin")
    if running() is not None:
        yield from screens.shoot(SCREENS, f"{name}_baking")
    blocked = yield from session.until(lambda: running() is None, 400, "the bake")
    yield from screens.shoot(SCREENS, f"{name}_baked")
    job.result()
    # Nothing was measured where the bake ended while its picture was taken.
    return {"longest_without_answer_s": round(blocked, 3)} if blocked else {}


def baked():
    """The two objects, baked."""
    return (yield from bake("4_mesh"))


def mean_place(name: str) -> np.ndarray:
    """Mean of the evaluated vertices in world coordinates, (3,)."""
    item = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.mean([item.matrix_world @ vertex.co for vertex in item.data.vertices], axis=0)


def moved(names: list[str]) -> dict[str, float]:
    """How far each object is in frame SHOWN from where it is in frame 1, in metres; all have moved."""
    scene = bpy.context.scene
    scene.frame_set(1)
    before = {name: mean_place(name) for name in names}
    scene.frame_set(SHOWN)
    far = {name: float(np.linalg.norm(mean_place(name) - place)) for name, place in before.items()}
    assert min(far.values()) > 0.005, far
    return far


def played():
    """Both objects move, and the animation plays. ``fps``: with whatever draws here, often the processor."""
    far = moved(["Cube", "Bäll 1"])
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
    return {"moved_m": far, "fps": round(rate, 1)}


def render(path: Path) -> None:
    """Write the current frame by Cycles, as small as will do for a comparison."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = 8, False, 3
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def saved():
    """Frame SHOWN rendered, and the file saved, so that a colleague can open it."""
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    scene.frame_set(SHOWN)
    render(OUT / "saved_with.png")
    bpy.ops.wm.save_mainfile()
    yield 0.1


def photographed():
    """A photo of a cube on a table, by Cycles, and a scene folder reconstructed from it by the worker."""
    bpy.ops.wm.read_homefile()
    yield 1.0
    scene = bpy.context.scene
    cube = bpy.data.objects["Cube"]
    cube.scale, cube.location, cube.rotation_euler = (0.1, 0.1, 0.1), (0.0, 0.0, 0.1), (0.0, 0.0, 0.5)
    for name, colour in (("red", (0.7, 0.05, 0.03, 1.0)), ("grey", (0.6, 0.6, 0.55, 1.0))):
        material = bpy.data.materials.new(name)
        session.extension("physgen_addon.compat").node_tree(material)
        material.node_tree.nodes.clear()
        shader = material.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
        shader.inputs["Color"].default_value = colour
        output = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
        material.node_tree.links.new(shader.outputs[0], output.inputs[0])
    cube.data.materials.clear()
    cube.data.materials.append(bpy.data.materials["red"])
    with screens.focus():
        bpy.ops.mesh.primitive_plane_add(size=6)
        bpy.context.object.data.materials.append(bpy.data.materials["grey"])
    scene.camera.location, scene.camera.rotation_euler = (0.0, -1.0, 0.7), (1.0, 0.0, 0.0)
    scene.camera.data.lens = 50
    scene.render.resolution_x, scene.render.resolution_y = 480, 360
    render(OUT / "photo.png")
    bpy.ops.wm.read_homefile()
    jobs, interpreter = (
        session.extension("physgen_addon.background_jobs"),
        session.extension("physgen_addon.interpreter"),
    )
    python, stage = preferences().python, session.extension("sim.app.stage_process").run_stage
    words = ["reconstruct", str(OUT / "photo.png"), "--box", "150,60,330,260", "--size", "0.3"]

    def work(on_event, cancelled):
        command = interpreter.cli_command(interpreter.find_python(python), *words, "--out", str(OUT / "scene"))
        return stage(command, on_event, cancelled)

    job = jobs.Job("Reconstruct", work)
    job.start()
    yield from session.until(job.step, 200, "the reconstruction")
    job.result()


def opened():
    """A photo in the image editor: its objects found, a stroke over the first, and the panel that goes with them."""
    bpy.ops.wm.read_homefile()
    yield 1.0
    with screens.focus():
        assert bpy.ops.physgen.open_photo(filepath=TASK["photo"] or str(OUT / "photo.png")) == {"FINISHED"}
    yield 1.5
    yield from screens.shoot(SCREENS, "5_photo_opened")
    running = session.extension("physgen_addon.background_jobs").running
    with screens.focus():
        assert bpy.ops.physgen.find_objects("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    job = running()
    yield from session.until(lambda: running() is None, 200, "the objects")
    job.result()
    state = bpy.context.scene.physgen_photo
    assert len(state.boxes) > 0, "nothing was found"
    box = state.boxes[0]
    x, y, width, height = box.x0, box.y0, box.x1 - box.x0, box.y1 - box.y0
    box.keep = ",".join(f"{x + width * u:.0f},{y + height * v:.0f}" for u, v in ((0.3, 0.4), (0.5, 0.6), (0.7, 0.5)))
    box.drop = f"{x + 0.02 * width:.0f},{y + 0.05 * height:.0f},{x + 0.1 * width:.0f},{y + 0.05 * height:.0f}"
    yield from screens.shoot(SCREENS, "5_photo_found")
    return {"boxes": [item.name for item in state.boxes]}


def imported():
    """The scene folder, imported, looked at, baked, rendered and saved."""
    yield from screens.show_sidebar()
    assert bpy.ops.physgen.import_scene(filepath=str(OUT / "scene" / "scene.json")) == {"FINISHED"}
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "imported.blend"))
    scene = bpy.context.scene
    simulation = scene.physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = "preview", 1, LAST
    names = [item.name for item in scene.objects if item.physgen.enabled]
    assert names, "nothing to simulate was imported"
    bpy.data.objects[names[0]].physgen.velocity = (0.3, 0.0, 1.5)
    yield from screens.shoot(SCREENS, "5_imported")
    measured = yield from bake("6_photo")
    far = moved(names)
    render(OUT / "imported_with.png")
    bpy.ops.wm.save_mainfile()
    return {"moved_m": far, **measured}


def rendered():
    """A frame of it rendered into the photo, with all layers, as the panel does it; shown in a window of its own."""
    rendering = bpy.context.scene.physgen.rendering
    rendering.format, rendering.samples, rendering.f_number = "exr_layers", 4, 2.8
    windows = set(bpy.context.window_manager.windows)
    with screens.focus():
        assert bpy.ops.physgen.render_still("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    running = session.extension("physgen_addon.background_jobs").running
    job = running()
    yield from session.until(lambda: running() is None, 300, "the still")
    job.result()
    assert rendering.result.endswith(f"{SHOWN:04d}.exr") and Path(rendering.result).is_file(), rendering.result
    shown = next(item for item in bpy.context.window_manager.windows if item not in windows)
    yield 1.0
    screens.picture(shown, SCREENS / "7_rendered_shown.png")
    with bpy.context.temp_override(window=shown):
        bpy.ops.wm.window_close()
    yield 0.5
    yield from screens.shoot(SCREENS, "7_rendered")


def capture_loaded():
    """A recording in the Diagnose panel."""
    bpy.ops.wm.read_homefile()
    yield from screens.show_sidebar()
    session.a_capture(session.extension("sim.diagnose.capture_folder"), OUT / "capture")
    bpy.context.scene.physgen_diagnose.capture = str(OUT / "capture")
    with screens.focus():
        assert bpy.ops.physgen.load_capture() == {"FINISHED"}
    yield from screens.shoot(SCREENS, "8_capture")


STEPS = [
    enabled,
    empty,
    python_missing,
    python_found,
    scene_of_two,
    baked,
    played,
    saved,
    photographed,
    opened,
    imported,
    rendered,
    capture_loaded,
]
session.run("work", [step for step in STEPS if not TASK["only"] or step.__name__ in TASK["only"].split(",")])
