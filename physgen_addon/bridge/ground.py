# SPDX-License-Identifier: GPL-3.0-or-later
"""The ground: a plane that catches shadows and is otherwise not there."""

from __future__ import annotations

import bpy
import numpy as np

from ...sim.scene.model import Camera, Ground
from . import compat
from .regions import plane_axes

ALBEDO = 0.8
REACH = 200.0
"""Half the plane's width over the camera's height: the rest is beyond where a shadow could be told."""


def add_ground(scene: bpy.types.Scene, ground: Ground, camera: Camera) -> bpy.types.Object:
    """Add the plane to ``scene``. It receives light but neither blocks it nor is seen by other surfaces.

    Light from below the horizon, which stands for the photo's ground, thus reaches the objects as if bounced.
    """
    point, normal = np.asarray(ground.point, dtype=float), np.asarray(ground.normal, dtype=float)
    first, second = plane_axes(normal)
    height = abs(float((camera.position - point) @ normal))
    half = REACH * max(height, 0.1)
    centre = camera.position - ((camera.position - point) @ normal) * normal
    corners = [centre + half * (a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh = bpy.data.meshes.new("ground")
    mesh.from_pydata([tuple(corner) for corner in corners], [], [(0, 1, 2, 3)])
    mesh.materials.append(_material())
    item = bpy.data.objects.new("ground", mesh)
    item.visible_diffuse = item.visible_glossy = item.visible_transmission = item.visible_shadow = False
    scene.collection.objects.link(item)
    return item


def _material() -> bpy.types.Material:
    material = bpy.data.materials.new("ground")
    tree = compat.node_tree(material)
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (ALBEDO, ALBEDO, ALBEDO, 1.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    return material
