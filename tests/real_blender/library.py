# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, with the extension: what comes from other files, and more than one scene in one.

The asset library (``make assets``): a material dragged by the mouse on an object, and the sample of meshes dropped in
the viewport, added and baked. Then two scenes of one file, and objects that are linked from another file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
import screens
import session

TASK = session.task()
OUT, SCREENS = Path(TASK["out"]), Path(TASK["out"]) / "library"
ASSETS = Path(__file__).resolve().parents[2] / "dist" / "assets"
LAST = 12
"""Frames that are baked."""


def arranged():
    """Blender's own layout with the sidebar, and the asset library registered."""
    bpy.context.preferences.addons[TASK["addon"]].preferences.python = TASK["python"]
    SCREENS.mkdir(exist_ok=True)
    if ASSETS.is_dir():
        bpy.ops.physgen.add_assets(directory=str(ASSETS))
    yield from home()
    bpy.ops.wm.save_homefile()


def home():
    """A new file of a few frames, with the sidebar on the tab."""
    bpy.ops.wm.read_homefile()
    yield 0.5
    simulation = bpy.context.scene.physgen.simulation
    simulation.quality, simulation.frame_end = "preview", LAST
    screens.viewport().spaces.active.show_region_ui = True
    yield from screens.drawn()
    screens.region(screens.viewport(), "UI").active_panel_category = screens.TAB
    yield from screens.drawn()


def bake():
    """Bake live, to its end; the state that the panel shows."""
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.ended("the bake", 400)
    yield 0.7
    return state()


def state():
    """Status and message of the bake of the scene, as the panel shows them."""
    found = session.extension("physgen_addon.bake_state").state(bpy.context.scene)
    return [found.status, found.message]


def fallen(names):
    """How far the middle of each object sinks from the first to the last baked frame, in metres; not of particles."""
    last, heights = bpy.context.scene.physgen.simulation.frame_end, []
    for at in (1, last):
        bpy.context.scene.frame_set(at)
        graph = bpy.context.evaluated_depsgraph_get()
        items = [bpy.data.objects[name].evaluated_get(graph) for name in names]
        heights.append([[(item.matrix_world @ vertex.co).z for vertex in item.data.vertices] for item in items])
    pairs = zip(names, *heights, strict=True)
    return {name: round(sum(a) / len(a) - sum(b) / len(b), 3) for name, a, b in pairs if a and b}


def browse(name):
    """Show an asset browser in a part of the viewport, with the asset ``name`` alone; where it lies on the screen."""
    view = screens.viewport()
    before = set(screens.window().screen.areas)
    with bpy.context.temp_override(window=screens.window(), area=view, region=screens.region(view, "WINDOW")):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.65)
    made = (set(screens.window().screen.areas) - before).pop()
    browser = min((view, made), key=lambda area: area.height)
    browser.ui_type = "ASSETS"
    yield from screens.drawn(4)
    parameters = browser.spaces.active.params
    parameters.asset_library_reference = "PhysGen"
    parameters.filter_search = name
    # Its files are read by a job of Blender's own, which no script can ask for.
    yield 4.0
    yield from screens.drawn(6)
    listed = screens.region(browser, "WINDOW")
    return listed.x + 60, screens.window().height - (listed.y + listed.height - 60)


def dragged_material():
    """A material dragged on the cube, which then has its matter, and keeps it when it is added."""
    if not ASSETS.is_dir():
        return {"skipped": "make assets has not been run"}
    yield from home()
    start = yield from browse("Sand")
    screens.picture(screens.window(), SCREENS / "01_assets.png")
    # What lies below the sidebar cannot be dropped on.
    goal = screens.on_screen(bpy.data.objects["Cube"].location, screens.viewport())
    yield from screens.drag(start, goal, SCREENS / "02_dragging_material.png")
    yield from screens.shoot(SCREENS, "03_dropped_material")
    cube = bpy.data.objects["Cube"]
    assert cube.physgen.material.preset == "sand", cube.physgen.material.preset
    with screens.focus():
        bpy.ops.physgen.add_bodies()
    yield from screens.shoot(SCREENS, "04_added_afterwards")
    assert cube.physgen.material.preset == "sand", cube.physgen.material.preset
    return {"active": cube.active_material.name}


def dropped_sample():
    """The sample of meshes dropped in the viewport, added, baked."""
    if not ASSETS.is_dir():
        return {"skipped": "make assets has not been run"}
    yield from home()
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    start = yield from browse("PhysGen Sample")
    x, y = screens.middle()
    yield from screens.drag(start, (x, y), SCREENS / "10_dragging_sample.png")
    yield from screens.shoot(SCREENS, "11_dropped_sample")
    with screens.focus():
        assert bpy.ops.physgen.add_bodies() == {"FINISHED"}
    yield from screens.shoot(SCREENS, "12_added_sample")
    bodies = {item.name: item.physgen for item in bpy.context.scene.objects if item.physgen.enabled}
    made = {name: body.material.preset for name, body in bodies.items() if body.role == "dynamic"}
    assert made == {"Jelly": "jelly", "Sand": "sand", "Wood": "wood"} and bodies["Ramp"].role == "collider", made
    bpy.context.scene.physgen.simulation.frame_end = 5
    told = yield from bake()
    fell = fallen([*made])
    yield from screens.shoot(SCREENS, "13_baked_sample")
    assert told[0] == "baked" and fell["Jelly"] > 0.05, (told, fell)
    return {"told": told, "fell_m": fell}


def two_scenes():
    """A second scene, new and as a full copy, in one file: each has its own bake, and the first one keeps its own."""
    yield from home()
    with screens.focus():
        bpy.ops.physgen.quick_jelly()
    told = {"first": (yield from bake())}
    with screens.focus():
        bpy.ops.scene.new(type="FULL_COPY")
    yield 1.5
    told["copy"] = state()
    yield from screens.shoot(SCREENS, "20_copied_scene")
    copy = bpy.context.scene
    cube = next(item for item in copy.objects if item.physgen.enabled)
    cube.physgen.velocity = (0.0, 0.0, 3.0)
    yield 1.5
    told["copy, changed"] = state()
    told["copy, baked"] = yield from bake()
    moved = {cube.name: fallen([cube.name])[cube.name]}
    yield from screens.shoot(SCREENS, "21_copied_scene_baked")
    screens.window().scene = bpy.data.scenes[0]
    yield 1.5
    told["first, again"] = state()
    moved |= fallen(["Cube"])
    yield from screens.shoot(SCREENS, "22_first_scene_again")
    with screens.focus():
        bpy.ops.scene.new(type="LINK_COPY")
    yield 1.5
    told["linked copy"] = state()
    yield from screens.shoot(SCREENS, "23_linked_scene")
    with screens.focus():
        bpy.ops.scene.new(type="NEW")
    yield 1.5
    told["new"] = state()
    yield from screens.shoot(SCREENS, "24_new_scene")
    return {"told": told, "fell_m": moved}


def linked():
    """An object of another file: refused as a link and as a library override, simulated when it is local."""
    yield from home()
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "theirs.blend"), copy=True)
    told = {}
    for number, way in enumerate(("linked", "override", "local")):
        yield from home()
        bpy.data.objects.remove(bpy.data.objects["Cube"])
        with bpy.data.libraries.load(str(OUT / "theirs.blend"), link=True) as (_, wanted):
            wanted.objects = ["Cube"]
        cube = wanted.objects[0]
        bpy.context.scene.collection.objects.link(cube)
        if way != "linked":
            cube = cube.override_create(remap_local_usages=True) if way == "override" else cube.make_local()
        bpy.context.view_layer.objects.active = cube
        cube.select_set(True)
        with screens.focus():
            told[way] = sorted(bpy.ops.physgen.add_bodies())
        yield from screens.shoot(SCREENS, f"3{number}_{way}")
        assert cube.physgen.enabled == (way == "local"), told
    told["local"] += yield from bake()
    told["fell_m"] = fallen([cube.name])
    yield from screens.shoot(SCREENS, "33_local_baked")
    return told


def wanted(step) -> bool:
    """Whether the task asks for it; the window is arranged in any case."""
    return not TASK["only"] or step.__name__ in ("arranged", *TASK["only"].split(","))


STEPS = [arranged, dragged_material, dropped_sample, two_scenes, linked]
session.run("library", [step for step in STEPS if wanted(step)])
