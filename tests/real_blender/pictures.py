# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, with the extension: pictures of docs/images in its own layout, into ``docs`` below the results.

Both samples opened, a bake, and an arrow dragged while the preview plays.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
from mathutils import Vector

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


def wanted(step) -> bool:
    """Whether the task asks for it."""
    return not TASK["only"] or step.__name__ in ("arranged", *TASK["only"].split(","))


session.run("pictures", [step for step in (arranged, meshes, preview, photo) if wanted(step)])
