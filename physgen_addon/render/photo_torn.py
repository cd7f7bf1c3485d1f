# SPDX-License-Identifier: GPL-3.0-or-later
"""The torn skin that replaces an object's mesh in the photo once its matter parts: the photo's colours outside, walls
in the colours of the seam."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.cache.torn_skins import TornSkin, read_torn_skin
from ...sim.composite.srgb import srgb_to_linear
from ..playback import particles, point_caches
from ..playback.torn_skins import corner_values, new_mesh
from .photo_grains import COLOUR, coloured_material
from .render_scene import REST_LIGHT, UV, RenderObject, get_rest_light, texture_colours, texture_coordinates

EVEN = 12
"""Smoothing steps of the seam's colours along the walls."""


def add_torn_skin(target: RenderObject, tear: point_caches.Tear, first_frame: int) -> bpy.types.Object:
    """Add the torn skin beside ``target``, which has reference lighting, and hide the mesh from its first crack on.

    Raises InputError for a damaged file.
    """
    skin = read_torn_skin(tear.file, len(target.mesh.vertices), len(target.mesh.faces))
    mesh = new_mesh(f"{target.item.name} torn", tear.cache.sample(0), skin.faces)
    uv = texture_coordinates(target)
    layer = mesh.uv_layers.new(name=UV)
    layer.data.foreach_set("uv", corner_values(skin, uv[target.mesh.faces]).astype(np.float32).ravel())
    material = target.item.data.materials[0]
    mesh.materials.append(material)
    mesh.materials.append(coloured_material(material))
    mesh.polygons.foreach_set("material_index", skin.inside.astype(np.int32))
    light = np.einsum("vk,vkc->vc", skin.weights, get_rest_light(target)[skin.parents])
    colours = srgb_to_linear(texture_colours(target, uv).astype(np.float32) / 255.0)[skin.parents[:, 0]]
    walls = np.setdiff1d(skin.faces[skin.inside], skin.faces[~skin.inside])
    # What has no light at rest has that of the whole object.
    light[walls] = get_rest_light(target)[target.mesh.faces].mean(axis=(0, 1))
    for name, values in ((REST_LIGHT, light), (COLOUR, _even(colours, skin))):
        attribute = mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(values, dtype=np.float32).ravel())
    item = bpy.data.objects.new(mesh.name, mesh)
    for collection in target.item.users_collection:
        collection.objects.link(item)
    point_caches.attach(item, tear.cache, first_frame)
    particles.begin(item, first_frame + tear.from_sample)
    particles.cover(target.item, first_frame + tear.from_sample)
    return item


def _even(colours: NDArray[np.floating], skin: TornSkin) -> NDArray[np.floating]:
    """Return ``colours`` (V, 3), smoothed along the walls."""
    faces = skin.faces[skin.inside]
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = np.maximum(np.bincount(pairs[:, 0], minlength=len(colours)), 1)
    inner = np.flatnonzero(np.bincount(pairs[:, 0], minlength=len(colours)))
    found = np.array(colours, dtype=np.float64)
    for _ in range(EVEN):
        sums = np.stack([np.bincount(pairs[:, 0], channel[pairs[:, 1]], len(found)) for channel in found.T], axis=1)
        found[inner] = 0.5 * found[inner] + 0.5 * (sums / count[:, None])[inner]
    return found
