# SPDX-License-Identifier: GPL-3.0-or-later
"""``make assets``: the asset library of materials and the sample scene, with previews.

    python setup/assets.py [--out dist/assets] [--pixels 128] [--samples 24]

Needs bpy. Each material preset becomes a Blender material that looks like it and has its name as a custom property:
dropped on an object, it makes the object's matter that preset (``physgen_addon/operators/asset_ops.py``). The sample of
meshes is a collection. Looks are chosen, and have no effect on the simulation.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import uuid
from pathlib import Path

import bpy
import physgen
from mathutils import Vector
from physgen.physgen_addon import compat
from physgen.physgen_addon.operators.asset_ops import FILE, PRESET
from physgen.physgen_addon.props.material_props import shipped_items
from physgen.physgen_addon.scene_io.sample_scene import add_sample

LOOKS = {
    "clay": ((0.42, 0.16, 0.09), 0.8, 0.0, 0.0),
    "foam": ((0.75, 0.66, 0.25), 0.95, 0.0, 0.0),
    "hard": ((0.05, 0.2, 0.6), 0.25, 0.0, 0.0),
    "honey": ((0.85, 0.4, 0.03), 0.08, 0.0, 0.7),
    "jelly": ((0.75, 0.04, 0.06), 0.1, 0.0, 0.5),
    "medium": ((0.1, 0.4, 0.12), 0.6, 0.0, 0.0),
    "metal": ((0.7, 0.7, 0.72), 0.25, 1.0, 0.0),
    "plush": ((0.5, 0.25, 0.14), 1.0, 0.0, 0.0),
    "rubber": ((0.03, 0.03, 0.035), 0.55, 0.0, 0.0),
    "sand": ((0.62, 0.42, 0.2), 0.95, 0.0, 0.0),
    "snow": ((0.9, 0.92, 0.95), 0.7, 0.0, 0.0),
    "soft": ((0.35, 0.3, 0.55), 1.0, 0.0, 0.0),
    "water": ((0.75, 0.88, 0.95), 0.03, 0.0, 0.95),
    "wood": ((0.35, 0.16, 0.05), 0.5, 0.0, 0.0),
}
"""Preset → colour, roughness, metallic, transmission; all chosen."""
USUAL = ((0.5, 0.5, 0.5), 0.5, 0.0, 0.0)
"""Look of a preset that is not in the table."""
CATALOGS = {name: str(uuid.uuid5(uuid.NAMESPACE_URL, f"physgen/assets/{name}")) for name in ("Materials", "Samples")}
"""Catalog → its id, the same in every build."""


def materials() -> list[bpy.types.Material]:
    """Return a material asset for each preset."""
    made = []
    for name, title, words in shipped_items():
        material = bpy.data.materials.new(title)
        tree = compat.node_tree(material)
        shader, output = tree.nodes.new("ShaderNodeBsdfPrincipled"), tree.nodes.new("ShaderNodeOutputMaterial")
        colour, rough, metal, clear = LOOKS.get(name, USUAL)
        for socket, value in (
            ("Base Color", (*colour, 1.0)),
            ("Roughness", rough),
            ("Metallic", metal),
            ("Transmission Weight", clear),
        ):
            shader.inputs[socket].default_value = value
        tree.links.new(shader.outputs[0], output.inputs[0])
        material.diffuse_color, material[PRESET] = (*colour, 1.0), name
        mark(material, words, "Materials")
        made.append(material)
    return made


def mark(data: bpy.types.ID, words: str, catalog: str) -> None:
    """Make ``data`` an asset."""
    data.asset_mark()
    data.asset_data.description, data.asset_data.author = words, "PhysGen"
    data.asset_data.catalog_id = CATALOGS[catalog]
    data.asset_data.tags.new("physgen", skip_if_exists=True)


def ball_scene(pixels: int, samples: int) -> tuple[bpy.types.Scene, bpy.types.Object]:
    """Return a scene that shows a ball on a floor before a bright sky, and the ball."""
    scene = bpy.data.scenes.new("preview")
    set_up(scene, pixels, samples)
    for name, size, place in (("floor", 8.0, (0, 0, -0.5)), ("ball", 1.0, (0, 0, 0))):
        if name == "ball":
            bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=size / 2, location=place)
            bpy.ops.object.shade_smooth()
        else:
            bpy.ops.mesh.primitive_plane_add(size=size, location=place)
        item = bpy.context.object
        item.name = name
        bpy.context.collection.objects.unlink(item)
        scene.collection.objects.link(item)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 1.4, 0.2, (0.7, -0.2, 0.6)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens, camera.location = 60.0, (0.0, -2.3, 0.7)
    camera.rotation_euler = (Vector((0, 0, -0.02)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    for item in (sun, camera):
        scene.collection.objects.link(item)
    scene.camera = camera
    return scene, scene.objects["ball"]


def set_up(scene: bpy.types.Scene, pixels: int, samples: int) -> None:
    """Let ``scene`` render square pictures of ``pixels`` by Cycles."""
    compat.enable_cycles()
    render = scene.render
    render.engine, render.resolution_x, render.resolution_y, render.resolution_percentage = (
        "CYCLES",
        pixels,
        pixels,
        100,
    )
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.device = samples, compat.denoiser_available(), "CPU"
    scene.view_settings.view_transform = "Standard"
    render.image_settings.file_format = "PNG"
    world = bpy.data.worlds.new("preview")
    tree = compat.node_tree(world)
    sky, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    sky.inputs["Color"].default_value, sky.inputs["Strength"].default_value = (0.75, 0.85, 1.0, 1.0), 0.35
    tree.links.new(sky.outputs[0], output.inputs[0])
    scene.world = world


def give_preview(data: bpy.types.ID, scene: bpy.types.Scene, folder: Path) -> None:
    """Render ``scene`` and make the picture the preview of ``data``."""
    picture = folder / "preview.png"
    scene.render.filepath = str(picture)
    bpy.ops.render.render(write_still=True, scene=scene.name)
    with bpy.context.temp_override(id=data):
        bpy.ops.ed.lib_id_load_custom_preview(filepath=str(picture))


def build(out: Path, *, pixels: int, samples: int) -> Path:
    """Write the library into the folder ``out``; return its file. No previews with ``pixels`` of 0."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    registered = not hasattr(bpy.types.Scene, "physgen")
    if registered:
        physgen.register()
    made = materials()
    main = bpy.context.scene
    add_sample(main)
    sample = main.collection.children[0]
    mark(sample, "Jelly, sand, wood and a ramp, ready to bake", "Samples")
    if pixels:
        with tempfile.TemporaryDirectory() as scratch:
            set_up(main, pixels, samples)
            # A small square picture shows the middle alone.
            lens = main.camera.data.lens
            main.camera.data.lens = 1.3 * lens
            give_preview(sample, main, Path(scratch))
            main.camera.data.lens = lens
            scene, ball = ball_scene(pixels, samples)
            for material in made:
                ball.data.materials.clear()
                ball.data.materials.append(material)
                give_preview(material, scene, Path(scratch))
            bpy.data.scenes.remove(scene)
    out.mkdir(parents=True, exist_ok=True)
    lines = [f"{number}:{name}:{name}" for name, number in CATALOGS.items()]
    (out / "blender_assets.cats.txt").write_text("VERSION 1\n\n" + "\n".join(lines) + "\n", encoding="utf-8")
    path = out / FILE
    for material in made:
        material.use_fake_user = True
    bpy.data.orphans_purge(do_recursive=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True, check_existing=False)
    if registered:
        physgen.unregister()
    return path


def main() -> int:
    """Entry of the script."""
    parser = argparse.ArgumentParser(prog="assets.py", description="The asset library.")
    parser.add_argument("--out", type=Path, default=Path("dist/assets"), help="folder of the library")
    parser.add_argument("--pixels", type=int, default=128, help="side of a preview; 0: none")
    parser.add_argument("--samples", type=int, default=24, help="rays a pixel of a preview")
    options = parser.parse_args()
    path = build(options.out.resolve(), pixels=options.pixels, samples=options.samples)
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
