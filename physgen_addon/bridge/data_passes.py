# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth, object ids and optical flow of a frame: numbers at the pixels' centres, never averaged over a pixel.

One more render, with one sample a pixel: how far away the nearest surface is, whose it is, and how far that point of
the surface moves to the neighbouring frames, which hangs on the mesh as a vector at each vertex. The flow follows by
projection and is exact, also where a thing turns or is squeezed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.scene.model import Camera, Scene
from . import compat, cycles, passes
from .regions import Box, ground_depth
from .scene import BlenderScene

FAR_M = 1e10
"""Depth where nothing is, neither object nor ground; Blender writes the same."""
STEPS = ("physgen_step_next", "physgen_step_previous")
"""Vector at each vertex, and pass, that holds how far it moves to the next frame and to the one before, in metres."""
NUMBER = "physgen_number"
"""Pass that holds the object's number for EEVEE, which has no pass of its own for it."""
CENTRE_FILTER_PX = 0.01
"""Width of the pixel filter, the least that Cycles knows: rays go through the pixels' centres."""

Vectors = NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class DataLayers:
    """What is at each pixel's centre.

    depth: (H, W) metres along the optical axis to the nearest object or the ground, ``FAR_M`` where neither is.
    object_id: (H, W) 0 where no object is, 1 for the first object of the scene and so on.
    flow: (H, W, 4) pixels, x right and y down, from here to where the same point is in the next frame, and to where it
        was in the one before.
    """

    depth: NDArray[np.float32]
    object_id: NDArray[np.float32]
    flow: NDArray[np.float32]


class DataScene:
    """A fourth Blender scene beside those of ``built``, with the objects and camera of the first."""

    def __init__(self, built: BlenderScene) -> None:
        """To be made before anything copies the objects' materials, so that the copies say where they go, too."""
        self._followers: list[bpy.types.Mesh] = []
        self.scene = built.colour_scene.copy()
        self.scene.name = "PhysGen data"
        built.own.append(self.scene)
        layer = self.scene.view_layers[0]
        self._traced = built.options.engine == "cycles"
        if self._traced:
            self.scene.cycles.samples = 1
            # A filter of the kind BOX has one width only.
            self.scene.cycles.pixel_filter_type, self.scene.cycles.filter_width = "GAUSSIAN", CENTRE_FILTER_PX
            cycles.set_denoising(self.scene, False)
        else:
            # The colours' own settings look through the middle of each of their subpixels.
            self.scene.render.resolution_x, self.scene.render.resolution_y = built.size
        layer.use_pass_z = layer.use_pass_object_index = True
        for name in (*STEPS, NUMBER):
            layer.aovs.add().name = name
        for number, target in enumerate(built.objects, start=1):
            self.follow(target.item, number)
            for name in STEPS:
                _show_attribute(target.item.data.materials[0], name)
            _show_number(target.item.data.materials[0])

    def follow(self, item: bpy.types.Object, number: int) -> None:
        """Count ``item`` as (part of) the object ``number``; its vertices' steps are the next of ``render``'s."""
        item.pass_index = number
        for name in STEPS:
            item.data.attributes.new(name, "FLOAT_VECTOR", "POINT")
        self._followers.append(item.data)

    def render(
        self,
        frame: int,
        box: Box | None,
        folder: Path,
        *,
        scene: Scene,
        cameras: tuple[Camera, Camera, Camera],
        steps: Sequence[tuple[Vectors, Vectors]],
    ) -> DataLayers:
        """The layers of ``frame``.

        box: pixels that objects can cover, None for none. folder: for the temporary file. cameras: of this frame, the
        next and the one before. steps: (V, 3) for each mesh that is followed, how far its vertices move to the next
        frame, and to the one before, in world metres. Raises RenderError when Blender fails.
        """
        size = (self.scene.render.resolution_x, self.scene.render.resolution_y)
        depth = ground_depth(dataclasses.replace(scene, camera=cameras[0]), size)
        depth = np.minimum(depth, FAR_M).astype(np.float32)
        object_id = np.zeros_like(depth)
        moved = np.zeros((2, *depth.shape, 3), np.float32)
        if box is not None:
            for mesh, pair in zip(self._followers, steps, strict=True):
                _set_vectors(mesh, pair)
            channels = passes.render(self.scene, frame, box, folder)
            number = np.rint(channels[compat.OBJECT_INDEX] if self._traced else channels[f"{NUMBER}.R"])
            seen = number > 0
            # What has sunk into the ground is seen all the same in the picture, so it is here too.
            depth[box.slices] = np.where(seen, channels["Depth.Z"], depth[box.slices])
            object_id[box.slices] = number
            for index, name in enumerate(STEPS):
                moved[index][box.slices] = np.where(seen[..., None], passes.stack(channels, name), 0.0)
        flow = [optical_flow(depth, step, cameras[0], camera) for step, camera in zip(moved, cameras[1:], strict=True)]
        return DataLayers(depth=depth, object_id=object_id, flow=np.concatenate(flow, axis=-1))


def optical_flow(
    depth: NDArray[np.floating], step: NDArray[np.floating], camera: Camera, other: Camera
) -> NDArray[np.float32]:
    """Pixels (H, W, 2), x right and y down, from each pixel's centre to where its point is seen by ``other``.

    depth: (H, W) metres along the optical axis of ``camera``. step: (H, W, 3) how far the point moves, world metres.
    Where the point comes to lie behind ``other`` there is no such place, and the flow is 0.
    """
    height, width = depth.shape
    scale = np.array([width / camera.width, height / camera.height])
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x, y], axis=-1)
    points = camera.position + camera.rays(pixels / scale) * depth[..., None] + step
    seen = other.project(points)
    flow = np.where(seen[..., 2:] > 0, seen[..., :2] * scale - pixels, 0.0)
    # Exactly nothing where nothing moves, and not the rounding of the way there and back.
    still = (step == 0).all(axis=-1) & (camera == other)
    return np.where(still[..., None], 0.0, flow).astype(np.float32)


def _show_attribute(material: bpy.types.Material, name: str) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    attribute, output = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeOutputAOV")
    attribute.attribute_name, output.aov_name = name, name
    links.new(attribute.outputs["Vector"], output.inputs["Color"])


def _show_number(material: bpy.types.Material) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    info, output = nodes.new("ShaderNodeObjectInfo"), nodes.new("ShaderNodeOutputAOV")
    output.aov_name = NUMBER
    links.new(info.outputs["Object Index"], output.inputs["Color"])


def _set_vectors(mesh: bpy.types.Mesh, pair: tuple[Vectors, Vectors]) -> None:
    for name, values in zip(STEPS, pair, strict=True):
        mesh.attributes[name].data.foreach_set("vector", np.ascontiguousarray(values, dtype=np.float32).ravel())
    mesh.update_tag()
