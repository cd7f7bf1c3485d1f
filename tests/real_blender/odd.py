# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender, with the extension: odd things that artists do, in a window, where undo and timers live.

Objects that are no plain meshes, odd placements and units, undo after every operator, and a bake during which objects
are renamed and deleted, settings change, the file is saved and the extension is switched off. Then two panels that few
open: a diagnosis, and Install from a folder of wheels (``run.py --wheels``).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import addon_utils
import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import screens
import session

TASK = session.task()
OUT, SCREENS = Path(TASK["out"]), Path(TASK["out"]) / "odd"


def arranged():
    """One viewport with the sidebar."""
    bpy.context.preferences.addons[TASK["addon"]].preferences.python = TASK["python"]
    SCREENS.mkdir(exist_ok=True)
    yield from screens.arrange((292,))


def home(cube: bool = True):
    """A new file, of a few frames."""
    bpy.ops.wm.read_homefile()
    yield 0.5
    if not cube:
        bpy.data.objects.remove(bpy.data.objects["Cube"])
    simulation = bpy.context.scene.physgen.simulation
    simulation.quality, simulation.frame_end = "preview", 6
    yield from screens.drawn()


def call(name: str, *mode: str, **options):
    """Call an operator as the mouse over the viewport does, with a step of undo before it."""
    with screens.focus():
        return getattr(bpy.ops.physgen, name)(*(mode or ("EXEC_DEFAULT", True)), **options)


def bake(seconds: float = 200):
    """Bake live, to its end."""
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.ended("the bake", seconds)
    yield 0.7


def state():
    """Of the bake of the scene, as the panel shows it."""
    return session.extension("physgen_addon.bake_state").state(bpy.context.scene)


def middle(item: bpy.types.Object) -> Vector:
    """Mean of the evaluated vertices of ``item`` in the world."""
    shown = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return sum((shown.matrix_world @ vertex.co for vertex in shown.data.vertices), Vector()) / len(shown.data.vertices)


def everything():
    """Text, curve, metaball, modifiers, an armature and a collection instance in one bake: each falls."""
    yield from home(cube=False)
    with screens.focus():
        bpy.ops.object.text_add(location=(-3, 0, 1))
        bpy.context.object.data.extrude = 0.2
        bpy.ops.curve.primitive_bezier_circle_add(radius=0.4, location=(-1.5, 0, 1))
        bpy.context.object.data.bevel_depth = 0.12
        bpy.ops.object.metaball_add(radius=0.5, location=(0, 2, 1))
        bpy.ops.mesh.primitive_cube_add(size=0.5, location=(1.5, 0, 1))
        mirror = bpy.context.object.modifiers.new("Mirror", "MIRROR")
        mirror.use_axis = (True, False, False)
        bpy.ops.mesh.primitive_cube_add(size=0.5, location=(3, 0, 1))
        hidden = bpy.context.object
        group = bpy.data.collections.new("Group")
        group.objects.link(hidden)
        bpy.context.scene.collection.children[0].objects.unlink(hidden)
        bpy.ops.object.collection_instance_add(collection="Group", location=(0, -2, 0))
        bpy.ops.object.armature_add(location=(4, 2, 0.5))
        rig = bpy.context.object
        bpy.ops.mesh.primitive_cube_add(size=0.5, location=(4, 2, 1.5))
        rigged = bpy.context.object
        rigged.modifiers.new("Armature", "ARMATURE").object = rig
        bpy.ops.object.select_all(action="SELECT")
    yield from screens.shoot(SCREENS, "01_everything")
    assert call("add_bodies") == {"FINISHED"}
    yield from screens.shoot(SCREENS, "02_added")
    bodies = [item for item in bpy.context.scene.objects if item.physgen.enabled]
    before = {item.name: middle(item) for item in bodies}
    yield from bake(400)
    assert state().status == "baked", state()
    bpy.context.scene.frame_set(6)
    fell = {item.name: round((before[item.name] - middle(item)).z, 3) for item in bodies}
    yield from screens.shoot(SCREENS, "03_everything_baked")
    assert min(fell.values()) > 0.05, fell
    return {"fell_m": fell}


def undone():
    """Every operator of the menus, one step of undo each: the scene is as it was before."""
    yield from home()
    failed = []
    for name, options in (
        ("quick_jelly", {}),
        ("quick_sand", {}),
        ("quick_liquid", {}),
        ("quick_rigid", {}),
        ("add_bodies", {}),
        ("add_colliders", {}),
        ("open_sample", {"sample": "MESHES"}),
        ("open_sample", {"sample": "PHOTO"}),
    ):
        yield from one_undo(failed, name, options)
    assert call("quick_jelly") == {"FINISHED"}
    yield 0.3
    bpy.context.scene.physgen.world.property_unset("ground_point")
    bpy.data.objects["Cube"].physgen.velocity = (1.0, 0.0, 0.0)
    with screens.focus():
        bpy.ops.ed.undo_push(message="moved")
    for name, options in (
        ("clear_motion", {}),
        ("add_pin", {}),
        ("ground_below", {}),
        ("add_stack_effect", {"effect": "wind"}),
        ("remove_body", {}),
        ("select_bodies", {}),
    ):
        yield from one_undo(failed, name, options)
    assert not failed, failed


def one_undo(failed: list[str], name: str, options: dict):
    """Call, undo, and compare what was there before with what is there then."""
    before = summary()
    call(name, **options)
    yield from screens.drawn(1)
    during = summary()
    with screens.focus():
        bpy.ops.ed.undo()
    yield 0.2
    if summary() != before:
        failed.append(f"{name}: {before} became {summary()}")
    if during == before and name not in ("select_bodies",):
        failed.append(f"{name}: did nothing")


def summary() -> tuple:
    """What operators change, without what the timer keeps."""
    scene = bpy.context.scene
    items = sorted((o.name, o.physgen.enabled, o.physgen.role, o.hide_viewport, o.hide_get()) for o in scene.objects)
    bodies = [(tuple(o.physgen.velocity), len(o.physgen.pins), o.physgen.material.preset_name) for o in scene.objects]
    world, photo = scene.physgen.world, scene.physgen_photo
    return items, bodies, tuple(world.ground_point), len(world.effects), len(photo.boxes), photo.image is None


def meanwhile():
    """During a bake an object is renamed, another deleted, the frame rate changes, and the file is saved and undone."""
    yield from home()
    bpy.context.scene.physgen.simulation.frame_end = 24
    cube = bpy.data.objects["Cube"]
    with screens.focus():
        bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, radius=0.5, location=(3, 0, 1))
        bpy.context.object.name = "Ball"
        bpy.ops.object.select_all(action="SELECT")
    assert call("quick_jelly") == {"FINISHED"}
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.until(
        lambda: session.running() is None or (session.running().done or 0) > 1, 200, "the first frame"
    )
    assert session.running() is not None, "the bake was too short for this"
    cube = bpy.data.objects["Cube"]
    cube.name = "Würfel"
    with screens.focus():
        bpy.ops.ed.undo_push(message="renamed")
    yield 1.0
    bpy.data.objects.remove(bpy.data.objects["Ball"])
    with screens.focus():
        bpy.ops.ed.undo_push(message="deleted")
    yield 1.0
    yield from screens.shoot(SCREENS, "10_renamed_and_deleted_while_baking")
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "meanwhile.blend"))
    yield from session.ended("the bake")
    yield 1.2
    yield from screens.shoot(SCREENS, "11_baked_without_one")
    first = state()
    assert any(m.name.startswith("PhysGen") for m in bpy.data.objects["Würfel"].modifiers), "the renamed one lost it"
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(OUT / "meanwhile.blend"))
    yield 1.5
    yield from screens.shoot(SCREENS, "12_opened_again")
    again = state()
    bpy.context.scene.render.fps = 30
    yield 1.5
    yield from screens.shoot(SCREENS, "13_other_frame_rate")
    rate = state()
    bpy.context.scene.render.fps = 24
    bpy.context.scene.unit_settings.scale_length = 0.01
    yield 1.5
    yield from screens.shoot(SCREENS, "14_other_unit")
    unit = state()
    assert {found.status for found in (first, again, rate, unit)} == {"stale"}, "a change was not noticed"
    return {
        name: [s.status, s.message]
        for name, s in (("deleted", first), ("opened", again), ("fps", rate), ("unit", unit))
    }


def switched_off():
    """The extension is disabled during a bake and enabled again: no job is left, nothing falls over."""
    yield from home()
    assert call("quick_jelly") == {"FINISHED"}
    bpy.context.scene.physgen.simulation.frame_end = 24
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.until(
        lambda: session.running() is None or (session.running().done or 0) > 1, 200, "the first frame"
    )
    addon_utils.disable(TASK["addon"])
    yield 1.5
    addon_utils.enable(TASK["addon"])
    yield 1.5
    bpy.context.preferences.addons[TASK["addon"]].preferences.python = TASK["python"]
    yield from screens.shoot(SCREENS, "20_enabled_again")
    return {"after": state().status, "message": state().message}


def placed():
    """A parent, non-uniform and negative scale, a shared mesh, a hidden object, and one that is scaled later."""
    yield from home()
    scene = bpy.context.scene
    cube = bpy.data.objects["Cube"]
    cube.scale, cube.rotation_euler, cube.location = (0.5, 1.0, -0.25), (0.3, 0.2, 0.5), (0, 0, 3)
    with screens.focus():
        bpy.ops.object.empty_add(location=(2, 0, 1))
        parent = bpy.context.object
        parent.scale = (0.5, 0.5, 2)
        bpy.ops.mesh.primitive_cube_add(size=1)
        child = bpy.context.object
        child.name, child.parent = "Child", parent
        twin = bpy.data.objects.new("Twin", cube.data)
        twin.location = (-3, 0, 2)
        scene.collection.objects.link(twin)
        bpy.ops.object.select_all(action="DESELECT")
    for item in (cube, child, twin):
        item.select_set(True)
    assert call("quick_jelly") == {"FINISHED"}
    yield from screens.shoot(SCREENS, "30_placed")
    bodies = [cube, child, twin]
    before = {item.name: middle(item) for item in bodies}
    twin.hide_set(True)
    yield from bake()
    scene.frame_set(6)
    twin.hide_set(False)
    fell = {item.name: round((before[item.name] - middle(item)).z, 3) for item in bodies}
    yield from screens.shoot(SCREENS, "31_placed_baked")
    told = {}
    told["baked"] = [state().status, state().message]
    twin.hide_viewport = True
    yield 1.2
    told["disabled"] = [state().status, state().message]
    yield from screens.shoot(SCREENS, "32_one_disabled")
    twin.hide_viewport = False
    cube.scale.x = 1.5
    yield from session.until(lambda: state().status == "stale", 20, "the scaled object to be noticed")
    told["scaled"] = [state().status, state().message]
    yield from screens.shoot(SCREENS, "33_scaled")
    return {"fell_m": fell, **told}


def diagnose():
    """A recording that is loaded and diagnosed, and the panel for a video, which is refused without one."""
    yield from home()
    session.a_capture(session.extension("sim.diagnose.capture_folder"), OUT / "capture")
    bpy.context.scene.physgen_diagnose.capture = str(OUT / "capture")
    names = tuple(f"PHYSGEN_PT_diagnose{part}" for part in ("", "_show", "_causes", "_add"))
    with screens.only(names):
        with screens.focus():
            assert bpy.ops.physgen.load_capture() == {"FINISHED"}
        yield from screens.shoot(SCREENS, "40_capture")
        with screens.focus():
            assert bpy.ops.physgen.diagnose("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
        yield 4.0
        yield from screens.shoot(SCREENS, "41_diagnosing")
        yield from session.ended("the diagnosis")
        yield from screens.shoot(SCREENS, "42_diagnosed")
        assert bpy.context.scene.physgen_diagnose.has_report, "there is no diagnosis"
    with screens.only(("PHYSGEN_PT_diagnose", "PHYSGEN_PT_diagnose_video")):
        yield from screens.shoot(SCREENS, "43_video")
        try:
            with screens.focus():
                bpy.ops.physgen.explain_video("INVOKE_DEFAULT")
        except RuntimeError as error:
            assert "Video" in str(error), error
        else:
            raise AssertionError("no video was explained")


def installed():
    """What simulates, installed from a folder of wheels to the end, found again, and a bake by it."""
    wheels = Path(TASK["wheels"]) if TASK["wheels"] else None
    if wheels is None:
        return {"skipped": "no --wheels"}
    yield from home()
    preferences = bpy.context.preferences.addons[TASK["addon"]].preferences
    preferences.python = ""
    with screens.focus():
        bpy.ops.physgen.add_bodies()
        bpy.ops.physgen.bake("INVOKE_DEFAULT")
    yield from session.ended("the refusal")
    yield 0.5
    yield from screens.shoot(SCREENS, "50_no_python")
    began = time.monotonic()
    with screens.focus():
        bpy.ops.physgen.install_python("EXEC_DEFAULT", agreed=True, wheels=str(wheels))
    yield 6.0
    yield from screens.shoot(SCREENS, "51_installing")
    yield from screens.shoot_preferences(SCREENS, "52_installing_preferences", TASK["addon"])
    yield from session.ended("the installation")
    took = time.monotonic() - began
    yield from screens.shoot(SCREENS, "53_installed")
    yield from screens.shoot_preferences(SCREENS, "54_installed_preferences", TASK["addon"])
    assert "physgen-python" in preferences.python, preferences.check_text
    bpy.context.scene.physgen.simulation.frame_end = 6
    with screens.focus():
        assert bpy.ops.physgen.bake("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from session.ended("the bake")
    yield from screens.shoot(SCREENS, "55_baked_by_it")
    assert session.extension("physgen_addon.bake_state").state(bpy.context.scene).status == "baked"
    return {"installed_s": round(took, 1)}


def wanted(step) -> bool:
    """Whether the task asks for it; the window is arranged in any case."""
    return not TASK["only"] or step.__name__ in ("arranged", *TASK["only"].split(","))


STEPS = [arranged, everything, undone, meanwhile, switched_off, placed, diagnose, installed]
session.run("odd", [step for step in STEPS if wanted(step)])
