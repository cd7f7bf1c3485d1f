# SPDX-License-Identifier: GPL-3.0-or-later
"""A .blend from somebody else reads, writes and deletes nothing outside its folder before the user agreed; one's own
needs no word."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon import bake_state, blend_trust, compat, paths
from physgen.physgen_addon.operators.photo_ops import add_box, set_photo
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, save_manifest
from physgen.sim.errors import InputError
from physgen.sim.trust import NotTrusted
from physgen.sim.version import VERSION

from . import checked_layout
from .export_scenes import add, exported

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture(autouse=True)
def own_config(tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "config"))


@pytest.fixture
def blend(tmp_path):
    """A file in a folder of its own that names a photo and a mesh elsewhere, saved by its maker."""
    secret = tmp_path / "elsewhere" / "private.png"
    secret.parent.mkdir()
    Image.fromarray(np.full((60, 80, 3), 90, np.uint8)).save(secret)
    (secret.parent / "private.obj").write_text("v 0 0 0\n")
    set_photo(bpy.context.scene, secret)
    box = add_box(bpy.context.scene, (10, 10, 50, 50), "ball")
    box.mesh = str(secret.parent / "private.obj")
    return saved(tmp_path)


def saved(tmp_path):
    path = tmp_path / "downloaded" / "toy.blend"
    path.parent.mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def wheres(scene):
    return [claim.where for claim in blend_trust.pending(scene)]


def test_ones_own_file_needs_no_word(blend):
    assert blend_trust.pending(bpy.context.scene) == []
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert blend_trust.pending(bpy.context.scene) == []


def test_somebody_elses_reads_nothing_outside_its_folder_before_the_word(blend, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    lines = [claim.line() for claim in blend_trust.pending(scene)]
    assert sorted(line.split(" = ")[0] for line in lines) == ["reads Photo", "reads ball: Mesh"]
    with pytest.raises(RuntimeError, match=r"you have not agreed to them: reads .*private\.(png|obj)"):
        bpy.ops.physgen.reconstruct()
    with pytest.raises(NotTrusted):
        blend_trust.require_agreed(scene)
    # Saving it is no word, choosing a file is one for that file.
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    assert len(blend_trust.pending(scene)) == 2
    scene.physgen_photo.boxes[0].mesh = str(tmp_path / "my own.obj")
    assert wheres(scene) == ["Photo"]
    # The question's yes.
    assert bpy.ops.physgen.trust_file() == {"FINISHED"}
    blend_trust.require_agreed(scene)


@pytest.mark.parametrize("link", [False, True])
def test_a_scene_from_somebody_elses_file_waits_for_the_word(blend, tmp_path, monkeypatch, link):
    """Appended or linked, it brings its settings with it, and they are not those of this session."""
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    name = bpy.context.scene.name
    bpy.ops.wm.read_homefile(use_empty=True)
    own = bpy.context.scene
    own.physgen_photo.depth = str(tmp_path / "my own.exr")
    before = set(bpy.data.scenes)
    bpy.ops.wm.link(directory=f"{blend}/Scene/", filename=name) if link else bpy.ops.wm.append(
        directory=f"{blend}/Scene/", filename=name
    )
    [scene] = set(bpy.data.scenes) - before
    assert sorted(wheres(scene)) == ["Photo", "ball: Mesh"]
    with pytest.raises(NotTrusted):
        blend_trust.require_agreed(scene)
    assert wheres(own) == []


def test_a_scene_from_ones_own_file_needs_no_word(blend):
    name = bpy.context.scene.name
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.append(directory=f"{blend}/Scene/", filename=name)
    assert [wheres(scene) for scene in bpy.data.scenes] == [[], []]


def test_a_yes_is_remembered_until_the_file_asks_for_something_else(blend, tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    bpy.ops.physgen.trust_file()
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert blend_trust.pending(bpy.context.scene) == []
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "maker"))
    bpy.context.scene.physgen_photo.depth = str(tmp_path / "elsewhere" / "more.exr")
    bpy.ops.wm.save_mainfile()
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert "Depth Map" in wheres(bpy.context.scene)


def path_properties(group):
    """Identifiers of all properties in ``group`` that name a file or folder."""
    found = set()
    for prop in group.bl_rna.properties:
        if prop.identifier == "rna_type":
            continue
        if prop.type == "STRING" and prop.subtype in blend_trust.PATHS:
            found.add(prop.identifier)
        elif prop.type == "POINTER" and issubclass(type(getattr(group, prop.identifier)), bpy.types.PropertyGroup):
            found |= path_properties(getattr(group, prop.identifier))
    return found


def test_every_property_with_a_path_waits_for_the_word(tmp_path, monkeypatch):
    """Not a list that somebody has to remember: what has a path's subtype is found, and refused where it is used."""
    scene = bpy.context.scene
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    named = {
        "physgen": ("folder",),
        "physgen.simulation": ("cache", "bake"),
        "physgen.rendering": ("output", "farm_folder", "result"),
        "physgen_photo": ("path", "depth", "output"),
        "physgen_diagnose": ("capture", "report", "scene_folder", "before", "after"),
    }
    for owner, names in named.items():
        for name in names:
            group = scene.path_resolve(owner)
            assert group.bl_rna.properties[name].subtype in blend_trust.PATHS, (owner, name)
            setattr(group, name, str(outside / name))
    scene.physgen_diagnose.video.file = str(outside / "v.mp4")
    scene.physgen_diagnose.video.mesh = str(outside / "v.obj")
    known = {identifier for owner in blend_trust.GROUPS for identifier in path_properties(getattr(scene, owner))}
    covered = {name for names in named.values() for name in names} | {"file", "mesh", "comparison"}
    assert known <= covered, known - covered
    # Bodies name no files at all.
    bpy.ops.mesh.primitive_cube_add()
    assert not path_properties(bpy.context.object.physgen)
    path = saved(tmp_path)
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    scene = bpy.context.scene
    assert len(blend_trust.pending(scene)) == sum(map(len, named.values())) + 2
    for text in (scene.physgen.folder, scene.physgen.rendering.output, scene.physgen_diagnose.capture):
        with pytest.raises(NotTrusted, match="came with paths outside its folder"):
            paths.require_folder(text, "Folder")
    with pytest.raises(NotTrusted):
        paths.require_file(scene.physgen_diagnose.video.file, "Video")
    with pytest.raises(NotTrusted):
        paths.scene_cache(scene)
    assert paths.shown_bake(scene) is None and bake_state.caches_of(scene) == []


def a_bake(folder):
    folder.mkdir(parents=True)
    item = BakedObject(name="ball", file="ball.pc2", vertices=8)
    values = {"inputs_hash": "0" * 64, "fps": 24.0, "frame_start": 1, "frames": 3, "frames_done": 3}
    manifest = BakeManifest(**values, state="complete", engine="mpm", version=VERSION, particles=8, objects=(item,))
    (folder / "ball.pc2").write_bytes(b"precious")
    save_manifest(folder, manifest)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_free_in_somebody_elses_file_deletes_nothing_of_ours(tmp_path, monkeypatch):
    """Both the cache and the bake are the file's to name, so that being inside its cache proves nothing."""
    scene = bpy.context.scene
    victim = tmp_path / "home" / "project" / scene.name / "bakes" / "mine"
    before = a_bake(victim)
    (victim.parent / "mine.json").write_text(json.dumps({"format": "physgen-blender-bake/1", "fingerprints": ["x"]}))
    scene.physgen.simulation.cache = str(tmp_path / "home" / "project")
    scene.physgen.simulation.bake = str(victim)
    scene.physgen.rendering.output = str(tmp_path / "home" / "project")
    bpy.ops.mesh.primitive_cube_add()
    path = saved(tmp_path)
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    untouched = sorted((tmp_path / "home").rglob("*"))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    scene = bpy.context.scene
    with pytest.raises(RuntimeError, match="have not agreed"):
        bpy.ops.physgen.free_bake()
    bpy.ops.physgen.free_old_bakes()
    with pytest.raises(RuntimeError, match="no bake of this scene"):
        bpy.ops.physgen.free_one_bake(folder=str(victim))
    bpy.ops.wm.save_mainfile()
    assert {item.name: item.read_bytes() for item in victim.iterdir()} == before
    assert sorted((tmp_path / "home").rglob("*")) == untouched
    assert "until you agree" in bake_state.observe(scene).advice or not bake_state.concerns(scene)
    # With the user's word it is what it says.
    bpy.ops.physgen.trust_file()
    assert paths.shown_bake(scene) == victim and paths.scene_cache(scene) == victim.parents[1]
    assert bpy.ops.physgen.free_bake() == {"FINISHED"} and not (victim / "ball.pc2").exists()


def test_a_link_that_leads_out_of_the_folder_counts_as_outside(tmp_path, monkeypatch):
    scene = bpy.context.scene
    (tmp_path / "secret").mkdir()
    (tmp_path / "downloaded").mkdir()
    (tmp_path / "downloaded" / "cache").symlink_to(tmp_path / "secret")
    scene.physgen.simulation.cache = "//cache"
    path = saved(tmp_path)
    monkeypatch.setenv("PHYSGEN_CONFIG", str(tmp_path / "another user"))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    with pytest.raises(InputError, match="outside its folder"):
        paths.scene_cache(bpy.context.scene)
    assert [claim.text for claim in blend_trust.pending(bpy.context.scene)] == [str(tmp_path / "secret")]


def buttons(panel):
    """How many buttons of ``panel`` hand something to the operating system."""
    return checked_layout.draw(panel).names.count("wm.path_open")


def test_no_button_opens_what_the_system_would_run(tmp_path):
    """On macOS a folder may be a program; elsewhere a missing file may be found with the ending of one."""
    scene = bpy.context.scene
    rendering, video = scene.physgen.rendering, scene.physgen_diagnose.video
    for folder, expected in (("frames", 2), ("Frames.APP", 1), ("frames.workflow", 1), ("shot.v2", 2)):
        frame = tmp_path / folder / "0001.png"
        frame.parent.mkdir()
        frame.write_bytes(b"a picture")
        rendering.result = str(frame)
        scene.physgen.folder = str(frame.parent)
        assert buttons(bpy.types.PHYSGEN_PT_render) == expected, folder
        assert buttons(bpy.types.PHYSGEN_PT_scene) == expected - 1, folder
    (tmp_path / "linked").symlink_to(tmp_path / "Frames.APP")
    scene.physgen.folder = str(tmp_path / "linked")
    assert buttons(bpy.types.PHYSGEN_PT_scene) == 0
    for name, there, expected in (("a.mp4", True, 1), ("b.mp4", False, 0), ("c.exe", True, 0)):
        if there:
            (tmp_path / name).write_bytes(b"a video")
        video.comparison = str(tmp_path / name)
        assert buttons(bpy.types.PHYSGEN_PT_diagnose_video) == expected, name


REGISTERED = """
import bpy, pathlib

@bpy.app.handlers.persistent
def ran(*_):
    pathlib.Path({marker!r}).open("a").write("handler ")

for handlers in (bpy.app.handlers.frame_change_post, bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.save_pre):
    handlers.append(ran)
pathlib.Path({marker!r}).open("a").write("text ")
"""


@pytest.fixture
def scripted(tmp_path):
    """A file of somebody else with a registered text, a driver in Python and a property that looks like code, and the
    file that each of them would write."""
    marker = tmp_path / "ran"
    ball = add("ball")
    text = bpy.data.texts.new("setup.py")
    text.write(REGISTERED.format(marker=str(marker)))
    text.use_module = True
    curve = ball.driver_add("hide_render")
    curve.driver.expression = f"bool(open({str(marker)!r}, 'a').write('driver '))"
    ball["physgen_run"] = f"__import__('pathlib').Path({str(marker)!r}).touch()"
    path = saved(tmp_path)
    bpy.ops.wm.read_homefile(use_empty=True)
    marker.unlink(missing_ok=True)
    yield path, marker
    # No test after this one may have its handlers, or Blender's leave to run them.
    for name in ("frame_change_post", "depsgraph_update_post", "save_pre"):
        handlers = getattr(bpy.app.handlers, name)
        for handler in [h for h in handlers if h.__name__ == "ran"]:
            handlers.remove(handler)
    bpy.ops.wm.open_mainfile(filepath=str(path), use_scripts=False)


def test_no_script_of_a_file_runs_while_we_work_on_it(scripted, tmp_path):
    path, marker = scripted
    bpy.ops.wm.open_mainfile(filepath=str(path), use_scripts=False)
    scene = bpy.context.scene
    before = fingerprint(scene)
    exported(scene, tmp_path)
    scene.frame_set(5)
    bpy.context.view_layer.update()
    assert fingerprint(scene) == before and blend_trust.pending(scene) == []
    bpy.ops.wm.save_mainfile()
    for link in (False, True):
        bpy.ops.wm.read_homefile(use_empty=True)
        (bpy.ops.wm.link if link else bpy.ops.wm.append)(directory=f"{path}/Scene/", filename=scene_name(path))
        [found] = [scene for scene in bpy.data.scenes if scene.objects]
        bpy.context.window.scene = found
        found.frame_set(3)
        if not link:
            exported(found, tmp_path, "appended")
    assert not marker.exists()
    # Where the user lets Blender run a file's scripts, it runs them: the file is as hostile as it has to be.
    bpy.ops.wm.open_mainfile(filepath=str(path), use_scripts=True)
    bpy.context.scene.frame_set(7)
    assert set(marker.read_text().split()) == {"text", "handler", "driver"}


def scene_name(path):
    with bpy.data.libraries.load(str(path)) as (found, _):
        return found.scenes[0]


OPENS = {"open_mainfile", "revert_mainfile", "recover_last_session", "recover_auto_save", "append", "link", "libraries"}


def test_we_open_no_blend_ourselves_and_start_blender_without_scripts():
    """Another file's content comes only by Blender's own menus, which ask its user's preference."""
    root = Path(compat.__file__).parents[1]
    found = []
    for path in (path for part in ("sim", "batch", "physgen_addon", "presets") for path in (root / part).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in OPENS:
                owner = ast.unparse(node.value)
                if owner.endswith(("ops.wm", "bpy.data")):
                    found.append(f"{path.name}: {owner}.{node.attr}")
            elif isinstance(node, ast.Constant) and node.value in ("--background", "-b", "--enable-autoexec"):
                found.append(f"{path.name}: {node.value}")
            elif isinstance(node, ast.Attribute) and node.attr == "use_scripts_auto_execute":
                found.append(f"{path.name}: {node.attr}")
    assert found == ["compat.py: --background"]
    assert "--disable-autoexec" in compat.HEADLESS
