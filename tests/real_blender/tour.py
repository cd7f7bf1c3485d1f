# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, with the extension as an artist finds it: nothing is opened beforehand, mouse and keys do the work.

Every state of the panel is pictured at each width of the task, in a window of 1,000 px height; the clicks from the
default cube to a playing bake, and from the sample photo to a still, are counted and timed.
"""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
import screens
import session

TASK = session.task()
OUT, SCREENS = Path(TASK["out"]), Path(TASK["out"]) / "tour"


WIDTHS = (431, 292)
"""Of the sidebar, in pixels: dragged wide, and as it opens."""


def arranged():
    """Two viewports with sidebars of the two widths, in this file and in new ones."""
    preferences = bpy.context.preferences.addons[TASK["addon"]].preferences
    preferences.python = TASK["python"]
    SCREENS.mkdir(exist_ok=True)
    yield from screens.arrange(WIDTHS)


def home():
    """A new file."""
    bpy.ops.wm.read_homefile()
    yield 0.5
    yield from screens.drawn()


def first_bake():
    """Default cube to a playing bake by the pie menu: two clicks, three keys; pictures of the way."""
    yield from home()
    yield from screens.shoot(SCREENS, "01_start")
    x, y = screens.middle()
    yield from screens.point(x, y)
    began = time.monotonic()
    yield from screens.press("shift+p")
    # It unfolds.
    yield from screens.drawn(4)
    screens.picture(screens.window(), SCREENS / "02_pie.png")
    yield from screens.click(x - 130, y)
    assert bpy.data.objects["Cube"].physgen.enabled, "the pie's left entry did not add the cube"
    yield from screens.press("shift+p")
    # The pie opens at the mouse.
    yield from screens.click(x - 130, y - 110)
    assert session.running() is not None, "the pie's upper entry did not bake"
    until_playing = session.until(
        lambda: (session.running() is None) or (session.running().done or 0) > 1, 900, "the first frame"
    )
    yield from until_playing
    first = time.monotonic() - began
    yield from screens.shoot(SCREENS, "04_baking")
    yield from session.ended("the bake")
    whole = time.monotonic() - began
    before = bpy.context.scene.frame_current
    yield from screens.point(x, y)
    yield from screens.press("space")
    yield from session.until(lambda: bpy.context.scene.frame_current not in (before, before + 1), 30, "playing")
    yield from screens.shoot(SCREENS, "05_playing")
    yield from screens.press("Escape")
    return {"clicks": 2, "keys": 3, "first_frame_s": round(first, 1), "baked_s": round(whole, 1)}


def by_panel():
    """One object added by the panel: is Bake in sight? Then changed, so that the bake is out of date; freed."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.add_bodies()
    yield from screens.shoot(SCREENS, "03_one_object")
    scene = bpy.context.scene
    scene.physgen.simulation.quality, scene.physgen.simulation.frame_end = "preview", 12
    with screens.focus():
        bpy.ops.physgen.bake("INVOKE_DEFAULT")
    yield from session.ended("the bake")
    yield from screens.shoot(SCREENS, "06_baked")
    bpy.data.objects["Cube"].physgen.material.density = 321.0
    yield 1.5
    yield from screens.shoot(SCREENS, "07_stale")


def unbaked():
    """Played before a bake: status bar and panel say why nothing moves, until it stops."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.add_bodies()
    told = session.extension("physgen_addon.handlers")._told
    yield from screens.point(*screens.middle())
    yield from screens.press("space")
    yield from session.until(lambda: told[0], 30, "the status bar")
    yield from screens.shoot(SCREENS, "06_unbaked")
    yield from screens.press("Escape")
    yield from session.until(lambda: not told[0], 30, "the status bar to be free again")


def refused():
    """What cannot be baked, and a worker that cannot simulate: the popup and the panel."""
    yield from home()
    with screens.focus():
        bpy.ops.mesh.primitive_plane_add(size=1)
        bpy.ops.object.select_all(action="SELECT")
        bpy.ops.physgen.add_bodies("INVOKE_DEFAULT")
    yield from screens.shoot(SCREENS, "08_refused_added")
    try:
        with screens.focus():
            bpy.ops.physgen.bake("INVOKE_DEFAULT")
    except RuntimeError as error:
        # Scripts get as an exception what pops up for artists, whose turn is next.
        assert "is flat" in str(error), error
    else:
        raise AssertionError("a flat object was baked")
    yield from screens.drawn()
    yield from screens.shoot(SCREENS, "09_refused_bake")
    yield from home()
    preferences = bpy.context.preferences.addons[TASK["addon"]].preferences
    preferences.python = "/usr/bin/python3"
    with screens.focus():
        bpy.ops.physgen.add_bodies()
        bpy.ops.physgen.bake("INVOKE_DEFAULT")
    yield from session.ended("the failure")
    yield 0.5
    yield from screens.shoot(SCREENS, "10_failed")
    screens.aim()
    with screens.focus():
        bpy.ops.physgen.install_python("INVOKE_DEFAULT")
    yield 0.7
    screens.picture(screens.window(), SCREENS / "11_install.png")
    yield from screens.press("Escape")
    preferences.python = TASK["python"]


def menus():
    """Quick Effects, Object > PhysGen, the pie menu and Properties > Physics, with one object."""
    yield from home()
    for number, name in enumerate(("VIEW3D_MT_object_quick_effects", "PHYSGEN_MT_object")):
        yield from screens.point(*screens.middle())
        with screens.focus():
            bpy.ops.wm.call_menu(name=name)
        yield 0.6
        screens.picture(screens.window(), SCREENS / f"12_menu_{number + 1}.png")
        yield from screens.press("Escape")
    with screens.focus():
        bpy.ops.physgen.quick_jelly()
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    yield 1.0
    with screens.focus():
        bpy.ops.physgen.quick_jelly()
        bpy.ops.physgen.bake("INVOKE_DEFAULT")
    area = next(area for area in screens.window().screen.areas if area.type == "PROPERTIES")
    area.spaces.active.context = "PHYSICS"
    yield from session.ended("the bake")
    yield from screens.drawn(4)
    screens.picture(screens.window(), SCREENS / "13_physics_tab_and_timeline.png")


def sample_meshes():
    """The sample of meshes, as opened, baking and baked."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.open_sample(sample="MESHES")
    yield from screens.shoot(SCREENS, "14_sample_meshes")
    with screens.focus():
        bpy.ops.physgen.bake("INVOKE_DEFAULT")
    yield from session.until(lambda: session.running() is None or (session.running().done or 0) > 6, 900, "some frames")
    yield from screens.shoot(SCREENS, "15_sample_baking")
    yield from session.ended("the bake")
    bpy.context.scene.frame_set(14)
    yield from screens.shoot(SCREENS, "16_sample_baked")


def sample_photo():
    """The sample photo to a still: opened, reconstructed, baked, rendered."""
    yield from home()
    began = time.monotonic()
    with screens.focus():
        bpy.ops.physgen.open_sample(sample="PHOTO")
    yield 1.0
    yield from screens.shoot(SCREENS, "17_photo_opened")
    with screens.focus():
        assert bpy.ops.physgen.reconstruct("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield 2.0
    yield from screens.shoot(SCREENS, "18_reconstructing")
    yield from session.ended("the reconstruction")
    yield from screens.shoot(SCREENS, "19_reconstructed")
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.ended("the bake")
    bpy.context.scene.frame_set(9)
    yield from screens.shoot(SCREENS, "20_photo_baked")
    windows = set(bpy.context.window_manager.windows)
    with screens.focus():
        assert bpy.ops.physgen.render_still("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield 2.0
    yield from screens.shoot(SCREENS, "21_rendering")
    yield from session.ended("the still")
    took = time.monotonic() - began
    result = bpy.context.scene.physgen.rendering.result
    assert result.endswith("0009.png") and Path(result).is_file(), f"no still: {result!r}"
    yield 1.0
    for shown in set(bpy.context.window_manager.windows) - windows:
        screens.picture(shown, SCREENS / "22_still.png")
        with bpy.context.temp_override(window=shown):
            bpy.ops.wm.window_close()
    yield 0.5
    yield from screens.shoot(SCREENS, "23_rendered")
    return {"sample_photo_to_still_s": round(took, 1), "of_it": "pictures of the panel are taken on the way"}


def fitted():
    """The photo's editor closes, and the viewport that grows is drawn with the whole photo from the first time on."""
    yield from home()
    context = session.extension("physgen_addon.context")
    with screens.focus():
        bpy.ops.physgen.open_sample(sample="PHOTO")
    yield 1.0
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = scene.physgen_photo.image.size
    scene.camera.data.sensor_fit = "HORIZONTAL"
    drawn = []

    def note():
        region, view = bpy.context.region, bpy.context.region_data
        drawn.append((bpy.context.area.as_pointer(), region.width, round(view.view_camera_zoom, 2)))

    with screens.focus():
        context.show_photo(bpy.context, scene)
    yield from screens.drawn()
    noting = bpy.types.SpaceView3D.draw_handler_add(note, (), "WINDOW", "POST_PIXEL")
    before = {area.as_pointer(): area.width for area in bpy.context.window.screen.areas if area.type == "VIEW_3D"}
    context.close_beside(scene)
    yield 1.0
    yield from screens.drawn()
    with screens.focus():
        context.show_photo(bpy.context, scene)
    yield from screens.drawn()
    bpy.types.SpaceView3D.draw_handler_remove(noting, "WINDOW")
    grown = [(width, zoom) for area, width, zoom in drawn if width > before[area]]
    assert grown and len(set(grown)) == 1, f"width and zoom of the drawn viewport: {grown}"
    yield from screens.shoot(SCREENS, "24_fitted")


def a_photo():
    """The scene folder of the task and a short bake of it, unless the sample photo was reconstructed before."""
    if bpy.context.scene.physgen.folder:
        return
    assert TASK["scene"], "neither sample_photo nor --scene"
    yield from home()
    assert bpy.ops.physgen.import_scene(filepath=TASK["scene"]) == {"FINISHED"}
    bpy.context.scene.physgen.simulation.quality, bpy.context.scene.physgen.simulation.frame_end = "preview", 3
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.ended("the bake")
    bpy.context.scene.frame_set(2)


def farm():
    """The panels Render, Look and Farm, open, with a photo; a job is written."""
    yield from a_photo()
    rendering = bpy.context.scene.physgen.rendering
    with screens.only(("PHYSGEN_PT_render", "PHYSGEN_PT_look", "PHYSGEN_PT_farm", "PHYSGEN_PT_out")):
        yield 0.5
        yield from screens.shoot(SCREENS, "32_farm")
        folder = OUT / "a farm"
        rendering.farm, rendering.farm_folder = "slurm", str(folder)
        with screens.focus():
            assert bpy.ops.physgen.farm("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
        yield from session.ended("the job to be written")
        yield from screens.shoot(SCREENS, "32_farm_written")
    assert (folder / "slurm").is_dir(), "no job was written"


def nodes():
    """A still with layers of a photo, and its nodes in the compositor."""
    yield from a_photo()
    rendering = bpy.context.scene.physgen.rendering
    rendering.format, rendering.own_samples, rendering.samples, rendering.size = "exr_layers", True, 2, 100
    windows = set(bpy.context.window_manager.windows)
    with screens.focus():
        assert bpy.ops.physgen.render_still("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.ended("the layers")
    yield 1.0
    for shown in set(bpy.context.window_manager.windows) - windows:
        with bpy.context.temp_override(window=shown):
            bpy.ops.wm.window_close()
    assert rendering.result.endswith(".exr"), f"no layers: {rendering.result!r}"
    with screens.focus():
        assert bpy.ops.physgen.look_nodes() == {"FINISHED"}
    with screens.only(("PHYSGEN_PT_render", "PHYSGEN_PT_look")):
        yield from screens.shoot(SCREENS, "33_look_nodes_panel")
    area = min((a for a in screens.window().screen.areas if a.type == "VIEW_3D"), key=lambda a: a.x)
    area.ui_type = "CompositorNodeTree"
    area.spaces.active.show_backdrop = False
    yield from screens.drawn(3)
    with bpy.context.temp_override(window=screens.window(), area=area, region=screens.region(area, "WINDOW")):
        bpy.ops.node.view_all()
    yield from screens.drawn(4)
    yield 1.0
    screens.picture(screens.window(), SCREENS / "34_nodes.png")


def material():
    """The panels of the material and of what few need, open: with units, in metric and imperial, and recognised."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.add_bodies()
    opened = ("PHYSGEN_PT_material", "PHYSGEN_PT_advanced", "PHYSGEN_PT_pins")
    screens.open_all(opened)
    numbers = bpy.data.objects["Cube"].physgen.material
    numbers.has_fibres, bpy.data.objects["Cube"].physgen.holds_shape = True, True
    yield from screens.shoot(SCREENS, "24_material")
    numbers.likeness, numbers.preset, numbers.law = "hard", "custom", "fluid"
    bpy.context.scene.unit_settings.system = "IMPERIAL"
    yield from screens.shoot(SCREENS, "25_material_imperial")


def strange():
    """A file of somebody else that names folders outside its own: the box that asks, and what it shows."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.add_bodies()
    bpy.context.scene.physgen.rendering.output = "//../frames of somebody else"
    mine, theirs = OUT / "mine" / "scene" / "a.blend", OUT / "theirs" / "scene" / "a.blend"
    for path in (mine, theirs):
        path.parent.mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(mine))
    shutil.copyfile(mine, theirs)
    bpy.ops.wm.open_mainfile(filepath=str(theirs))
    yield from screens.drawn()
    assert session.extension("physgen_addon.blend_trust").pending(bpy.context.scene), "a stranger's path does not wait"
    yield from screens.shoot(SCREENS, "26_strange_file")
    screens.aim()
    with screens.focus():
        bpy.ops.physgen.trust_file("INVOKE_DEFAULT", go_on=False)
    yield 0.7
    screens.picture(screens.window(), SCREENS / "27_trust.png")
    yield from screens.press("Escape")


def dropped():
    """A photo dragged by the mouse from Blender's file browser and dropped on the sidebar, and on the viewport."""
    yield from home()
    folder = OUT / "to drop"
    folder.mkdir()
    samples = Path(session.extension("physgen_addon.operators.asset_ops").DEMO)
    shutil.copyfile(samples / "coffee.jpg", folder / "coffee.jpg")
    before = set(screens.window().screen.areas)
    view = screens.viewport()
    with bpy.context.temp_override(window=screens.window(), area=view, region=screens.region(view, "WINDOW")):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.7)
    browser = min(set(screens.window().screen.areas) - before, key=lambda area: area.height)
    browser.ui_type = "FILES"
    yield from screens.drawn(4)
    parameters = browser.spaces.active.params
    parameters.directory, parameters.display_type = str(folder).encode(), "LIST_VERTICAL"
    parameters.filter_glob = "*.jpg"
    browser.tag_redraw()
    yield from screens.drawn(6)
    yield 1.0
    for number, kind in ((28, "UI"), (30, "WINDOW")):
        yield from drop(browser, screens.region(screens.viewport(), kind), number)
        found = bpy.context.scene.physgen_photo.path
        assert Path(found) == folder / "coffee.jpg", f"dropped on {kind}, the photo was not opened: {found!r}"
        bpy.context.scene.physgen_photo.image, bpy.context.scene.physgen_photo.path = None, ""


def drop(browser, onto, number):
    """Drag the first file that ``browser`` lists and drop it on the region ``onto``; Blender asks what is meant."""
    listed = screens.region(browser, "WINDOW")
    high = screens.window().height
    x, y = listed.x + 60, high - (listed.y + listed.height - 30)
    goal = (onto.x + onto.width // 2, high - (onto.y + onto.height // 3))
    yield from screens.drag((x, y), goal, SCREENS / f"{number}_dragging.png")
    screens.picture(screens.window(), SCREENS / f"{number + 1}_dropped.png")
    # The letter that the menu underlines in Start from a Photo.
    yield from screens.press("s")
    yield 1.5
    yield from screens.drawn()


def wanted(step) -> bool:
    """Whether the task asks for it; the window is arranged in any case."""
    return not TASK["only"] or step.__name__ in ("arranged", *TASK["only"].split(","))


STEPS = [arranged, first_bake, by_panel, unbaked, refused, menus, sample_meshes, fitted, sample_photo, farm, nodes]
STEPS += [dropped, material, strange]
session.run("tour", [step for step in STEPS if wanted(step)])
