# SPDX-License-Identifier: GPL-3.0-or-later
"""Matter that shows in the photo once a body parts: grains of sand or snow, and torn skins.

Grains are computed for each frame (``sim/grains.py``), in the photo's colours. Light falls on a smooth hull around
them: balls would be half as bright as the skin was from which they come, and their shades belong to their colours,
which are rendered at full resolution and are not denoised. A torn skin replaces the object's mesh: the photo's colours
outside, walls in the colours of the seam.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...sim.cache.torn_skin_file import TornSkin, read_torn_skin
from ...sim.grains import CloudState, GrainCloud, ShownGrains, grain_size
from ...sim.scene.model import Camera, Ground
from ...sim.srgb import srgb_to_linear
from ..playback import particles, point_caches
from ..playback.bake_record import spacing
from ..playback.geometry_nodes import Tree, set_input
from ..playback.particles import corner_values, new_mesh
from .object_material import COLOUR_LAYER, REST_LIGHT
from .render_scene import UV, RenderObject, get_rest_light, texture_colours, texture_coordinates

GRAINS = "PhysGen photo grains"
COLOUR, BEFORE, RADIUS = "grain_colour", "grain_before", "grain_radius"
"""Attributes of grains: linear colour; position one frame earlier, m; radius, m."""
FRAME, MATERIAL = "Frame", "Material"
GRAIN_PX, GRAIN_M, FINEST = 2.0, 0.5e-3, 40
"""Diameter wanted of a grain: so many pixels, and at least so many metres, and at most the object's size over so many.
Smaller grains would be averaged to an even colour; real grains of sand are 0.06 to 2 mm [ISO 14688-1]."""
HULL, HULL_PARTICLES = 0.45, 6
"""Density at which the hull lies, and particles that tell a vertex's reference lighting."""
SKIN_SAMPLES, FEW_SAMPLES, SHALLOW, NEARLY = 150_000, 2_000, 3.0, 0.25
"""Points of the skin that tell colours; a few of them, which do so for what is deeper than so many of their distances;
and how much farther than the nearest, in shares, the one taken may be."""
KEPT_STATES = 3
GROWN_S, FADING_S = 0.25, (0.17, 0.5)
"""Seconds of the clip after the skin tears at which the last grain has come, and in which the skin goes where nothing
tears it: grains break through one by one before it does, so that no single frame changes everything."""
PARTED = 1.3
"""Stretch between neighbouring particles above which their grains do not wait. The skin there is about to tear."""
GROWING = 0.35
"""Share of the time until the last has come in which one grain grows."""

Positions = NDArray[np.float64]


class PhotoGrains:
    """The grains that one object shows from the sample on in which its skin tears."""

    def __init__(
        self,
        target: RenderObject,
        flow: point_caches.Flow,
        first_frame: int,
        *,
        camera: Camera,
        scale: float,
        ground: Ground,
        growing: float = 0.0,
    ) -> None:
        """Add them, still without any, beside ``target``, which has reference lighting. scale: of the frames over the
        photo. growing: frames after the skin tears until all grains are there.
        """
        assert flow.from_sample is not None
        self._flow, self._first_frame, self._growing = flow, first_frame, growing
        rest = flow.cache.sample(0)
        apart = spacing(rest)
        depth = float(np.median(camera.project(rest)[:, 2]))
        pixel = max(depth, 1e-9) / (max(camera.fx, camera.fy) * scale)
        extent = float(np.ptp(target.mesh.vertices, axis=0).max())
        wanted = min(max(GRAIN_PX * pixel, GRAIN_M), max(extent / FINEST, GRAIN_PX * pixel))
        self._cloud = GrainCloud(
            rest,
            spacing=apart,
            size=grain_size(particles=len(rest), spacing=apart, wanted=wanted),
            ground=(np.asarray(ground.point, dtype=float), ground.unit_normal),
        )
        self._skin = _Skin(target)
        light = self._skin.light[self._skin.nearest(self._cloud.rest)]
        self._light = np.ascontiguousarray(light, dtype=np.float32)
        children = self._cloud.size.children + 1
        self._colours = np.zeros((len(rest), children, 3), dtype=np.uint8)
        self._coloured = np.zeros((len(rest), children), dtype=np.bool_)
        self._states: dict[int, CloudState] = {}
        self._shown: tuple[tuple[int, int], ShownGrains] | None = None
        self.mesh = bpy.data.meshes.new(f"{target.item.name} grains")
        self.mesh.materials.append(coloured_material(target.item.data.materials[0]))
        self._item = bpy.data.objects.new(self.mesh.name, self.mesh)
        for collection in target.item.users_collection:
            collection.objects.link(self._item)
        self._hull = bpy.data.meshes.new(f"{target.item.name} hull")
        self._hull.materials.append(target.item.data.materials[0])
        self._hull_item = bpy.data.objects.new(self._hull.name, self._hull)
        for collection in target.item.users_collection:
            collection.objects.link(self._hull_item)
        self._look = self._item.modifiers.new(GRAINS, "NODES")
        self._look.node_group = _group()
        set_input(self._look, MATERIAL, self.mesh.materials[0])
        self.reach = self._cloud.reach

    @property
    def item(self) -> bpy.types.Object:
        """The object in Blender."""
        return self._item

    @property
    def visible(self) -> bool:
        """Whether there are any grains now."""
        return self._shown is not None

    def let_see(self, *, grains: bool, hull: bool) -> None:
        """Show in the next renders the ``grains``, and the smooth ``hull`` around them, on which the light falls."""
        self._item.hide_render, self._hull_item.hide_render = not grains, not hull

    def show(self, sample: int, before: int, eye: Positions) -> None:
        """Show the grains of ``sample``, on their way from where they were in the sample ``before``, as seen from
        ``eye`` (3,); none while the skin is whole.
        """
        self.let_see(grains=True, hull=True)
        if not self._flow.shown_at(sample):
            for mesh, item in ((self.mesh, self._item), (self._hull, self._hull_item)):
                if len(mesh.vertices):
                    mesh.clear_geometry()
                    item.update_tag()
            self._shown = None
            return
        if self._shown is not None and self._shown[0] == (sample, before):
            return
        grains = self._grown(self._cloud.shown(self._state(sample), eye), sample)
        self._shown = (sample, before), grains
        came = grains.positions if before == sample else self._places(before)
        self.mesh.clear_geometry()
        self.mesh.vertices.add(len(grains.parents))
        self.mesh.attributes["position"].data.foreach_set("vector", np.asarray(grains.positions, np.float32).ravel())
        self._store(BEFORE, came)
        self._store(COLOUR, self._colour(grains))
        self._store(REST_LIGHT, self._light[grains.parents])
        radius = self.mesh.attributes.new(RADIUS, "FLOAT", "POINT")
        radius.data.foreach_set("value", np.asarray(grains.radii, np.float32))
        set_input(self._look, FRAME, self._first_frame + sample)
        self._item.update_tag()
        self._enclose(self._state(sample))

    def steps(self, after: int, before: int) -> tuple[Positions, Positions]:
        """Return the motion (G, 3) of the shown grains to the sample ``after``, and to ``before``, m."""
        if self._shown is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        now = self._shown[1].positions
        return self._places(after) - now, self._places(before) - now

    def _grown(self, grains: ShownGrains, sample: int) -> ShownGrains:
        """Return the part of ``grains`` that has come at ``sample``, the last ones still small.

        The core and grains where matter has come apart are there at once: nothing else covers that.
        """
        assert self._flow.from_sample is not None
        share = (sample - self._flow.from_sample + 1.0) / max(self._growing, 1e-9)
        if share >= 1.0:
            return grains
        loose = (self._cloud.parted(self._state(sample)) > PARTED)[grains.parents]
        size = np.clip((share - self._cloud.turns(grains) * (1.0 - GROWING)) / GROWING, 0.0, 1.0)
        size[(grains.children < 0) | loose] = 1.0
        there = np.flatnonzero(size > 0.0)
        return ShownGrains(
            parents=grains.parents[there],
            children=grains.children[there],
            positions=grains.positions[there],
            radii=(grains.radii * size)[there],
            shades=grains.shades[there],
        )

    def _enclose(self, state: CloudState) -> None:
        """Make the hull that of ``state``, with the reference lighting of the particles nearest to it."""
        vertices, faces = state.field.surface(HULL)
        self._hull.clear_geometry()
        self._hull_item.update_tag()
        if not len(vertices):
            return
        self._hull.from_pydata(vertices, [], faces)
        self._hull.shade_smooth()
        count = min(HULL_PARTICLES, len(state.positions))
        distance, near = KDTree(state.positions).query(vertices, k=[*range(1, count + 1)])
        weights = 1.0 / np.maximum(distance, 1e-9)
        light = np.einsum("vk,vkc->vc", weights / weights.sum(axis=1, keepdims=True), self._light[near])
        attribute = self._hull.attributes.new(REST_LIGHT, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(light, dtype=np.float32).ravel())

    def _state(self, sample: int) -> CloudState:
        if sample not in self._states:
            while len(self._states) >= KEPT_STATES:
                del self._states[next(iter(self._states))]
            self._states[sample] = self._cloud.state(self._flow.cache.sample(sample))
        return self._states[sample]

    def _places(self, sample: int) -> Positions:
        assert self._shown is not None
        grains = self._shown[1]
        return self._cloud.places(self._state(sample), grains.parents, grains.children)

    def _store(self, name: str, values: NDArray[np.floating]) -> None:
        attribute = self.mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(values, dtype=np.float32).ravel())

    def _colour(self, grains: ShownGrains) -> NDArray[np.float64]:
        """Return linear colours (G, 3): the texture's at rest, in shades of each grain's own."""
        at = grains.parents, grains.children
        new = np.flatnonzero(~self._coloured[at])
        parents, children = grains.parents[new], grains.children[new]
        found = self._skin.nearest(self._cloud.at_rest(parents, children))
        self._colours[parents, children] = self._skin.colours[found]
        self._coloured[parents, children] = True
        return np.asarray(srgb_to_linear(self._colours[at].astype(np.float32) / 255.0) * grains.shades[:, None])


class _Skin:
    """Points spread over an object's skin at rest, with their sRGB colours (S, 3) of 255 and light (S, 3)."""

    def __init__(self, target: RenderObject) -> None:
        vertices, faces = target.mesh.vertices, target.mesh.faces
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        table = np.random.default_rng(0)
        which = np.searchsorted(np.cumsum(area), table.uniform(0.0, area.sum(), SKIN_SAMPLES))
        which = np.minimum(which, len(faces) - 1)
        u, v = table.uniform(size=(2, SKIN_SAMPLES))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        weights = np.stack([1 - u - v, u, v], axis=1)

        def spread(values: NDArray[np.floating]) -> Positions:
            return np.asarray(np.einsum("sk,skc->sc", weights, values[faces[which]]))

        places = spread(vertices)
        self._tree, self._few = KDTree(places), KDTree(places[:FEW_SAMPLES])
        self._shallow = SHALLOW * float(np.sqrt(area.sum() / FEW_SAMPLES))
        self.colours = texture_colours(target, spread(texture_coordinates(target)))
        self.light = spread(get_rest_light(target))

    def nearest(self, points: Positions) -> NDArray[np.int64]:
        """Return the index of about the nearest point to each of ``points`` (N, 3).

        Of few for what lies deep: from the middle of a ball all its skin is equally far, and an exact search would go
        through all of it.
        """
        distance, found = self._few.query(points, eps=NEARLY)
        near = np.flatnonzero(distance < self._shallow)
        found[near] = self._tree.query(points[near], eps=NEARLY)[1]
        return np.asarray(found)


def coloured_material(skin: bpy.types.Material) -> bpy.types.Material:
    """Return the material of the ``skin`` in the colours of the attribute ``COLOUR``."""
    material = skin.copy()
    tree = material.node_tree
    layer = next(node for node in tree.nodes if node.type == "OUTPUT_AOV" and node.aov_name == COLOUR_LAYER)
    colour = tree.nodes.new("ShaderNodeAttribute")
    colour.attribute_name = COLOUR
    tree.links.new(colour.outputs["Vector"], layer.inputs["Color"])
    return material


def _group() -> bpy.types.NodeTree:
    """Return a group: vertices → a point cloud of balls, which moves straight from ``BEFORE`` in the frame before."""
    tree = Tree(GRAINS, {FRAME: ("Int", 1), MATERIAL: ("Material", None)})
    frame = tree.node("GeometryNodeInputSceneTime").outputs["Frame"]
    late = tree.math("SUBTRACT", tree.inputs[FRAME], frame)
    share = tree.math("MINIMUM", tree.math("MAXIMUM", late, 0.0), 1.0)
    now, before = tree.out("GeometryNodeInputPosition"), tree.attribute(BEFORE, "FLOAT_VECTOR")
    back = tree.node("ShaderNodeVectorMath", operation="SCALE")
    tree.group.links.new(tree.out("ShaderNodeVectorMath", before, now, operation="SUBTRACT"), back.inputs[0])
    tree.group.links.new(share, back.inputs["Scale"])
    place = tree.out("ShaderNodeVectorMath", now, back.outputs[0], operation="ADD")
    grains = tree.out("GeometryNodeMeshToPoints", tree.inputs["Geometry"], None, place, tree.attribute(RADIUS, "FLOAT"))
    return tree.finish(tree.out("GeometryNodeSetMaterial", grains, None, tree.inputs[MATERIAL]))


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
