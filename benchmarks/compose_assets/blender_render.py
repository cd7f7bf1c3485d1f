# SPDX-License-Identifier: GPL-3.0-or-later
"""Cycles takes the pictures of the assets. Runs as a process of its own.

    python -m physgen.benchmarks.compose_assets.blender_render --out DIR [--size 256] [--only NAME …] [--threads 0]

Each asset gets a folder in DIR (``pictures.kept_as``), which appears whole or not at all: a views folder
(docs/file-formats.md) of the composition and one of each part alone.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from physgen.physgen_addon import compat
from physgen.physgen_addon.render import render_engines
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.render_regions import Box
from physgen.physgen_addon.scene_io import photo_view as bridge_camera
from physgen.sim.atomic import replacing
from physgen.sim.gaussians.views.posed_images import View, over_white
from physgen.sim.gaussians.views.view_files import save_views
from physgen.sim.scene.model import Camera
from physgen.sim.srgb import linear_to_srgb, srgb_to_linear

from .asset import Asset, Part
from .catalogue import NAMES, asset
from .pictures import LOOK, SIZE, Look, cache_name, cameras, renderings

OWNER = "owner"
"""Pass in which each part is of one channel: which share of a pixel it covers."""

CHANNELS = "RGB"


class Studio:
    """Parts before nothing, in a white sky."""

    def __init__(self, parts: Sequence[Part], look: Look, scratch: Path, *, threads: int = 0) -> None:
        self._scratch, self._order = scratch, [part.name for part in parts]
        bpy.ops.wm.read_factory_settings(use_empty=True)
        compat.enable_cycles()
        scene = self._scene = bpy.data.scenes.new("asset")
        render_engines.set_up_passes(scene)
        render_engines.set_up_cycles(scene, RenderOptions(samples=look.samples, threads=threads, seed=1), denoise=False)
        scene.view_layers[0].aovs.add().name = OWNER
        scene.world = _sky()
        self._things = {part.name: self._add(part, channel, look) for channel, part in enumerate(parts)}

    def _add(self, part: Part, channel: int, look: Look) -> bpy.types.Object:
        data = bpy.data.meshes.new(part.name)
        data.from_pydata(part.vertices.tolist(), [], part.faces.tolist())
        colours = data.color_attributes.new("paint", "FLOAT_COLOR", "POINT")
        linear = np.concatenate([srgb_to_linear(part.colours), np.ones((len(part.colours), 1))], axis=1)
        colours.data.foreach_set("color", linear.astype(np.float32).ravel())
        data.materials.append(_paint(part.name, channel, look))
        data.shade_smooth()
        thing = bpy.data.objects.new(part.name, data)
        self._scene.collection.objects.link(thing)
        return thing

    def views(self, names: Sequence[str], seen: dict[str, Camera]) -> list[View]:
        """The parts ``names`` from every camera of ``seen``, a view of each."""
        for name, thing in self._things.items():
            thing.hide_render = name not in names
        return [self._view(name, camera) for name, camera in seen.items()]

    def _view(self, name: str, camera: Camera) -> View:
        size = (camera.width, camera.height)
        if self._scene.camera is None:
            bridge_camera.add_camera(self._scene, camera, size)
            self._scene.camera.data.clip_start = 1e-3
        bridge_camera.aim_camera(self._scene, camera)
        channels = render_engines.render_passes(self._scene, 1, Box(0, 0, *size), self._scratch)
        mask = np.clip(channels["Combined.A"], 0.0, 1.0)
        light = render_engines.stack(channels, "Combined") / np.maximum(mask, 1e-6)[..., None]
        shares = np.stack([channels[f"{OWNER}.{c}"] for c in CHANNELS[: len(self._order)]])
        return View(
            name=name,
            camera=camera,
            pixels=over_white(linear_to_srgb(light), mask),
            mask=mask,
            labels=np.where(mask > 0.5, shares.argmax(axis=0) + 1, -1).astype(np.int8),
        )


def _sky() -> bpy.types.World:
    world = bpy.data.worlds.new("sky")
    tree = compat.node_tree(world)
    background, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    tree.links.new(background.outputs[0], output.inputs[0])
    # Looked for along the surface's own directions, an even sky has no noise where nothing hides it.
    world.cycles.sampling_method = "NONE"
    return world


def _paint(name: str, channel: int, look: Look) -> bpy.types.Material:
    """The vertices' colours, in part lit by the sky, in part shining by how the surface is turned."""
    material = bpy.data.materials.new(name)
    tree = compat.node_tree(material)
    new, link = tree.nodes.new, tree.links.new
    colour, place = new("ShaderNodeVertexColor"), new("ShaderNodeNewGeometry")
    colour.layer_name = "paint"
    turned = new("ShaderNodeVectorMath")
    turned.operation = "DOT_PRODUCT"
    link(place.outputs["Normal"], turned.inputs[0])
    turned.inputs[1].default_value = tuple(np.array(look.key) / np.linalg.norm(look.key))
    strength = new("ShaderNodeMapRange")
    strength.inputs["From Min"].default_value, strength.inputs["From Max"].default_value = -1.0, 1.0
    strength.inputs["To Min"].default_value, strength.inputs["To Max"].default_value = look.shade, 1.0
    link(turned.outputs["Value"], strength.inputs["Value"])
    shining, matte, mixed = new("ShaderNodeEmission"), new("ShaderNodeBsdfDiffuse"), new("ShaderNodeMixShader")
    link(colour.outputs["Color"], shining.inputs["Color"])
    link(strength.outputs["Result"], shining.inputs["Strength"])
    link(colour.outputs["Color"], matte.inputs["Color"])
    mixed.inputs[0].default_value = look.ambient
    link(shining.outputs[0], mixed.inputs[1])
    link(matte.outputs[0], mixed.inputs[2])
    output, owner = new("ShaderNodeOutputMaterial"), new("ShaderNodeOutputAOV")
    link(mixed.outputs[0], output.inputs[0])
    owner.aov_name = OWNER
    owner.inputs["Color"].default_value = (*np.eye(3)[channel].tolist(), 1.0)
    return material


def shoot(item: Asset, size: int, folder: Path, *, look: Look = LOOK, threads: int = 0) -> None:
    """Render all pictures of ``item`` into the new ``folder``."""
    seen = cameras(item, size)
    with replacing(folder) as partial, tempfile.TemporaryDirectory(prefix="physgen-assets-") as scratch:
        studio = Studio(item.parts, look, Path(scratch), threads=threads)
        partial.mkdir(parents=True)
        for sub, parts, places in renderings(item):
            views = studio.views([part.name for part in parts], {name: seen[name] for name in places})
            save_views(partial / sub, views)


def main() -> int:
    """Entry; 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="keeps what is rendered")
    parser.add_argument("--size", type=int, default=SIZE, help="pixels along a side")
    parser.add_argument(
        "--only", nargs="+", choices=NAMES, default=NAMES, metavar="NAME", help="of " + ", ".join(NAMES)
    )
    parser.add_argument("--threads", type=int, default=0, help="of the processor; 0 takes all")
    options = parser.parse_args()
    for name in options.only:
        item = asset(name)
        folder = options.out / cache_name(item, options.size)
        if not folder.is_dir():
            begun = time.process_time()
            shoot(item, options.size, folder, threads=options.threads)
            sys.stderr.write(f"{folder.name}: {time.process_time() - begun:.1f} CPU s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
