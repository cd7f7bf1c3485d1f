# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, with the extension: pictures of docs/images in its own layout, into ``docs`` below the results.

Both samples opened, a bake, an arrow dragged while the preview plays, and thrown boxes diagnosed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Quaternion, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import screens
import session

TASK = session.task()
OUT, SCREENS = Path(TASK["out"]), Path(TASK["out"]) / "pictures"


def arranged():
    """The Python that simulates."""
    bpy.context.preferences.addons[TASK["addon"]].preferences.python = TASK["python"]
    for folder in (SCREENS, OUT / "docs"):
        folder.mkdir(exist_ok=True)
    yield 0.1


def home():
    """A new file in Blender's own layout, the sidebar on the tab."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    yield 0.5
    screens.viewport().spaces.active.show_region_ui = True
    yield from screens.drawn()
    screens.region(screens.viewport(), "UI").active_panel_category = screens.TAB
    yield from screens.drawn()


def opened(sample):
    """A new file with that sample."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.open_sample(sample=sample)
    yield 1.0


def page(name, wait=()):
    """Write ``docs/NAME.jpg``; the mouse is out of the way. wait: for what is to be seen, just before the picture."""
    yield from screens.point(640, 990)
    yield from screens.shoot(SCREENS, name)
    if wait:
        yield from wait
        yield from screens.drawn(1)
        screens.picture(screens.window(), SCREENS / f"{name}.png")
    document(name)


def document(name):
    """Write ``docs/NAME.jpg`` of the picture ``NAME.png``."""
    screens.document(SCREENS / f"{name}.png", OUT / "docs" / f"{name}.jpg")


def meshes():
    """The sample of meshes, opened and baked."""
    yield from opened("MESHES")
    yield from page("blender_objects")
    with screens.focus():
        bpy.ops.physgen.bake("INVOKE_DEFAULT")
    yield from session.ended("the bake")
    bpy.context.scene.frame_set(16)
    yield from page("blender_baked")


def preview():
    """The sample of meshes previewed, and an arrow dragged meanwhile."""
    yield from opened("MESHES")
    live = session.extension("physgen_addon.preview.live_preview")
    with screens.focus():
        bpy.ops.physgen.toggle_preview()
    yield from session.until(lambda: live.session().clip is not None, 900, "the preview")
    yield from page("blender_preview", session.until(lambda: live.session().frame in range(8, 20), 300, "a flight"))
    jelly = bpy.data.objects["Jelly"]
    middle = jelly.matrix_world @ (sum(map(Vector, jelly.bound_box), Vector()) / 8)
    # The knob of an arrow that is zero.
    x, y = screens.on_screen(middle, screens.viewport())
    # The preview of the first frame lies exactly on the objects; that of the arrow is another clip.
    first = live.session().clip
    flies = session.until(lambda: live.session().clip is not first and live.session().frame >= 6, 60, "a preview")
    yield from screens.drag((x, y), (x - 150, y - 40), SCREENS / "live_preview.png", flies)
    document("live_preview")
    assert jelly.physgen.velocity.length > 0, "the arrow was not dragged"
    with screens.focus():
        bpy.ops.physgen.toggle_preview()


def photo():
    """The sample photo, opened."""
    yield from opened("PHOTO")
    yield from page("blender_photo")


def throws(folder):
    """Save recordings in ``folder`` of a box of 10 cm thrown three times through air that the model leaves out.

    26 points at 60 Hz with 1 mm of noise; drag slows the centre by 0.35/m times its speed squared.
    """
    rng = np.random.default_rng(1)
    edges = np.stack(np.meshgrid(*[np.linspace(-1, 1, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    marks = 0.05 * edges[np.abs(edges).max(axis=1) == 1]
    times = np.arange(48) / 60.0
    trials = {}
    for name, velocity, turn in (
        ("throw 1", (3.5, 0.6, 3.4), (4.0, 2.0, 1.0)),
        ("throw 2", (4.2, -0.8, 2.6), (-1.0, 3.0, 2.0)),
        ("throw 3", (3.0, 1.4, 3.8), (2.0, -3.0, 1.0)),
    ):
        v, x, path = np.array(velocity), np.array([0.0, 0.0, 0.9]), []
        for _ in times:
            path.append(x)
            for _ in range(20):
                v = v + (np.array([0.0, 0.0, -9.81]) - 0.35 * np.linalg.norm(v) * v) / 1200.0
                x = x + v / 1200.0
        # A cube's inertia is the same about every axis, so it turns evenly.
        turned = [np.array(Quaternion(Vector(turn).normalized(), Vector(turn).length * t).to_matrix()) for t in times]
        points = np.stack([marks @ r.T + x for r, x in zip(turned, path, strict=True)])
        trials[name] = times, points + 0.001 * rng.standard_normal(points.shape)
    session.save_trials(session.extension("sim.diagnose.capture_folder"), folder, trials, marks=marks, density=60.0)


def diagnosis():
    """Thrown boxes, diagnosed: where the model and the recording part, and the model with what it lacked."""
    yield from home()
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    throws(OUT / "throws")
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "throws.blend"))
    state = bpy.context.scene.physgen_diagnose
    state.capture = "//throws"
    with screens.only([f"PHYSGEN_PT_diagnose{part}" for part in ("", "_show", "_causes")]):
        with screens.focus():
            assert bpy.ops.physgen.load_capture() == {"FINISHED"}
            assert bpy.ops.physgen.diagnose("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
        yield from session.ended("the diagnosis")
        assert state.has_report, "there is no diagnosis"
        state.trial = "throw 3"
        state.radius, state.trail_s = 0.006, 0.4
        bpy.context.scene.frame_set(bpy.context.scene.frame_start + 44)
        view = screens.viewport().spaces.active.region_3d
        view.view_location, view.view_distance = (1.35, 0.6, 1.0), 2.1
        view.view_rotation = Euler((1.2, 0.0, -0.35)).to_quaternion()
        yield from page("diagnose_panel")
        for layer in (state.nominal, state.found):
            layer.body, layer.points, layer.trail = True, False, True
        state.colours = False
        yield from page("diagnose_found")


def wanted(step) -> bool:
    """Whether the task asks for it."""
    return not TASK["only"] or step.__name__ in ("arranged", *TASK["only"].split(","))


session.run("pictures", [step for step in (arranged, meshes, preview, photo, diagnosis) if wanted(step)])
