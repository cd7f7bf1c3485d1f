# SPDX-License-Identifier: GPL-3.0-or-later
"""Physics of an object in terms of the scene format, and errors for what cannot be simulated."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.constitutive import FLUID, RIGID, cohesion_of, model_of
from ...sim.errors import InputError
from ...sim.scene.model import Effect, Key, Keys, Material, MaterialTrack, NumberKey
from ..props.material_props import get_material
from ..text import decimal
from .export_animation import Clock, channels, scaled, why_it_moves

OWN = "PhysGen"
"""Prefix of the names of PhysGen's own modifiers (``point_caches.MODIFIER``)."""

HARMLESS = {
    "BEVEL",
    "COLLISION",
    "CORRECTIVE_SMOOTH",
    "DATA_TRANSFER",
    "EDGE_SPLIT",
    "LAPLACIANSMOOTH",
    "MULTIRES",
    "NORMAL_EDIT",
    "PARTICLE_SYSTEM",
    "SMOOTH",
    "SUBSURF",
    "TRIANGULATE",
    "UV_PROJECT",
    "UV_WARP",
    "VERTEX_WEIGHT_EDIT",
    "VERTEX_WEIGHT_MIX",
    "VERTEX_WEIGHT_PROXIMITY",
    "WEIGHTED_NORMAL",
    "WELD",
}
"""Modifier types that leave an object about where its mesh is."""

SMOOTHING_GROUPS = ("Smooth by Angle", "Auto Smooth")
"""Blender's own geometry nodes that change normals only; copies have a number appended."""

THINNEST = 1e-6
"""Smallest admissible ratio of an object's smallest to its largest scale."""

FARTHEST = 1e9
"""m; at this distance 32-bit coordinates resolve nothing."""


def foreign_modifiers(item: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Return modifiers of ``item`` that are active in the viewport and not PhysGen's."""
    return [modifier for modifier in item.modifiers if modifier.show_viewport and not modifier.name.startswith(OWN)]


def is_smoothing(modifier: bpy.types.Modifier) -> bool:
    """Return whether ``modifier`` leaves the shape about unchanged."""
    if modifier.type == "NODES":
        return modifier.node_group is None or modifier.node_group.name.startswith(SMOOTHING_GROUPS)
    return modifier.type in HARMLESS


def require_simulable(item: bpy.types.Object) -> None:
    """Raise InputError if the mesh of dynamic ``item`` differs from its visible shape, or something else moves it."""
    where = f"object {item.name!r}"
    if item.library is not None:
        raise InputError(
            f"{where}: is linked from {item.library.filepath}, so its cache could not be attached: make a library "
            "override (Object > Library Override > Make) or make it local, or let it be a collider"
        )
    for modifier in foreign_modifiers(item):
        if not is_smoothing(modifier):
            kind = modifier.bl_rna.name.removesuffix(" Modifier")
            raise InputError(
                f"{where}: modifier {modifier.name!r} ({kind}) changes its shape, but the simulation uses the mesh "
                "before it: apply it or hide it in the viewport"
            )
    keys = item.data.shape_keys
    if keys is not None and (channels(keys) or any(key.value != 0 and not key.mute for key in keys.key_blocks[1:])):
        raise InputError(
            f"{where}: has active shape keys, but the simulation uses the mesh without them: set their values to "
            "0, or apply or remove them (Properties > Data > Shape Keys)"
        )
    reason = why_it_moves(item)
    if reason is not None:
        raise InputError(
            f"{where}: {reason}, but the simulation decides where it goes: let it be a collider, or end that by the "
            "menu named here, after Object > Apply > Visual Transform if it is to stay where it is now"
        )


MATERIAL = "physgen.material."
"""Beginning of the path of a material's numbers in animation curves."""


def animated_numbers(item: bpy.types.Object) -> list[str]:
    """Return the numbers of the material of ``item`` that are animated and that its law reads, but the density."""
    law = item.physgen.material.law
    read = () if law == RIGID else model_of(law).reads
    found = {path.removeprefix(MATERIAL) for path, _ in channels(item) if path.startswith(MATERIAL)}
    return [name for name in read if name in found and name != "fibre_axis"]


class MaterialTracks:
    """Animated numbers of an object's material, read frame by frame."""

    def __init__(self, item: bpy.types.Object, clock: Clock) -> None:
        self.names = animated_numbers(item) if item.physgen.role == "dynamic" else []
        self.moves = bool(self.names)
        self._item, self._clock = item, clock
        self._values: list[list[float]] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Read the evaluated frame ``graph``."""
        material = self._item.evaluated_get(graph).physgen.material
        self._values.append([decimal(getattr(material, name)) for name in self.names])

    def tracks(self) -> tuple[MaterialTrack, ...]:
        """Return a keyframe at every frame, without those inside stretches that are constant."""
        found = []
        for name, values in zip(self.names, zip(*self._values, strict=True), strict=True):
            kept = [
                i for i, v in enumerate(values) if i in (0, len(values) - 1) or not values[i - 1] == v == values[i + 1]
            ]
            times = [self._clock.seconds(self._clock.start + i) for i in kept]
            keys = tuple(NumberKey(time_s=t, value=values[i]) for t, i in zip(times, kept, strict=True))
            found.append(MaterialTrack(field=name, keys=keys))
        return tuple(found)


PAINTED = (("stiffness_map", "stiffness_group", "stiffness_factor"), ("density_map", "density_group", "density_factor"))
"""Maps of a scene's object, and the properties that name the weights and the factor where these are 1."""


def painted_weights(item: bpy.types.Object, name: str) -> NDArray[np.float32]:
    """Return the weights (V,), 0 to 1, of the vertex group or attribute ``name`` of the mesh of ``item``.

    Vertices outside of the group have 0. Raises InputError if there is neither, or for weights out of range.
    """
    mesh, group = item.data, item.vertex_groups.get(name)
    weights = np.zeros(len(mesh.vertices), dtype=np.float32)
    attribute = mesh.attributes.get(name)
    if group is not None:
        number = group.index
        for vertex in mesh.vertices:
            for part in vertex.groups:
                if part.group == number:
                    weights[vertex.index] = part.weight
    elif attribute is not None and attribute.domain == "POINT" and attribute.data_type == "FLOAT":
        attribute.data.foreach_get("value", weights)
    else:
        known = ", ".join(group.name for group in item.vertex_groups) or "none"
        raise InputError(
            f"object {item.name!r}: has no vertex group or attribute of numbers {name!r} of its vertices (groups: "
            f"{known}): paint one of that name, or clear it under Material"
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and (weights <= 1).all()):
        raise InputError(f"object {item.name!r}: {name!r} holds numbers outside 0 to 1: normalise it")
    return weights


def require_still_settings(owner: bpy.types.ID, where: str) -> None:
    """Raise InputError if a PhysGen setting on ``owner`` is animated but for a material's numbers."""
    moving = {MATERIAL + name for name in animated_numbers(owner)} if isinstance(owner, bpy.types.Object) else set()
    for path, _ in sorted(channels(owner)):
        if path.startswith("physgen") and path not in moving:
            raise InputError(
                f"{where}: {path} is animated, but the simulation takes one value of it: clear its keyframes or driver"
            )


def require_evaluated(item: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Raise InputError if ``item`` is not evaluated because it is disabled; a stand-in may be, until it takes over."""
    if item.physgen.original is None and not item.evaluated_get(depsgraph).is_evaluated:
        raise InputError(
            f"object {item.name!r}: is disabled in viewports or excluded from the view layer: enable it in the "
            "outliner (the eye may stay closed), or take it out of the simulation"
        )


def require_placed(matrix: np.ndarray, name: str) -> None:
    """Raise InputError if ``matrix`` (4, 4) of object ``name`` is flat or not finite."""
    if not np.isfinite(matrix).all():
        raise InputError(f"object {name!r}: its transform is not finite: reset its location, rotation and scale")
    away = float(np.abs(matrix[:3, 3]).max())
    if away > FARTHEST:
        raise InputError(f"object {name!r}: is {away:.3g} m away from the origin: move it nearer")
    sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not sizes[-1] > THINNEST * sizes[0]:
        raise InputError(f"object {name!r}: its scale makes it flat or vanish: give it a scale above 0 on every axis")


def physics(item: bpy.types.Object, unit: float, clock: Clock) -> dict[str, Any]:
    """Return fields of ``sim.scene.scene_object.SceneObject`` by name: all but name, mesh, pose, motion and pins.

    unit: Blender unit in metres. Raises InputError, with the object's name, for invalid values.
    """
    body = item.physgen
    fields: dict[str, Any] = {"role": body.role, **_surface(body)}
    if body.role != "dynamic":
        return fields
    fields["material"] = _material(item)
    fields["fill"] = body.fill
    if not body.fill and body.shell_thickness > 0:
        fields["shell_thickness"] = decimal(body.shell_thickness * unit)
    fields["velocity"] = scaled(body.velocity, unit)
    fields["spin"] = scaled(body.spin)
    for name in ("asleep", "held"):
        if getattr(body, name):
            fields[name] = True
    fields["start_time"] = clock.from_frame(body.start_frame)
    if body.pushes:
        fields["velocity_keys"] = _pushes(item, unit, clock)
    fields["goal_stiffness"] = decimal(body.goal_stiffness)
    fields["goal_damping"] = decimal(body.goal_damping)
    return fields


def _pushes(item: bpy.types.Object, unit: float, clock: Clock) -> Keys:
    """Return the later pushes of ``item`` in the order of their frames; velocities in m/s, ``unit`` in metres."""
    body = item.physgen
    last, what = max(body.start_frame, clock.start), "it starts"
    found = []
    for push in sorted(body.pushes, key=lambda push: push.frame):
        if push.frame <= last:
            raise InputError(
                f"object {item.name!r}: is pushed at frame {push.frame}, but {what} at frame {last}: push it later "
                "(Motion > Later Pushes), or remove that push"
            )
        found.append(Key(time_s=clock.seconds(push.frame), value=scaled(push.velocity, unit)))
        last, what = push.frame, "is already pushed"
    return tuple(found)


def sand(item: bpy.types.Object, name: str, clock: Clock) -> list[Effect]:
    """Return the effect by which ``item``, called ``name`` in the folder, turns to sand; empty if it does not."""
    body = item.physgen
    if body.role != "dynamic" or not body.sandy:
        return []
    if cohesion_of(body.material.law) in (RIGID, FLUID):
        raise InputError(
            f"object {item.name!r}: turns to sand, which {body.material.law} material cannot: give it an elastic or "
            "plastic behaviour, or switch Turns to Sand off"
        )
    start = clock.from_frame(body.sandy_frame)
    angle = decimal(body.material.friction_angle)
    return [Effect(name="sandy", parameters=(("friction_angle", angle), ("start", start)), objects=(name,))]


def _surface(body: Any) -> dict[str, Any]:
    """Return the surface properties: its own, or by default the ground's."""
    if not body.own_surface:
        return {}
    friction = decimal(body.friction)
    return {
        "friction": friction,
        "static_friction": max(friction, decimal(body.static_friction)),
        "restitution": decimal(body.restitution),
        "contact_mode": body.contact_mode,
    }


def _material(item: bpy.types.Object) -> Material:
    body = item.physgen
    try:
        material = get_material(body.material)
    except InputError as error:
        raise InputError(f"object {item.name!r}: {error}") from None
    if material.law == "rigid" and (len(body.pins) or body.goal_stiffness > 0):
        raise InputError(
            f"object {item.name!r}: is rigid, and rigid objects are neither pinned nor held in shape: choose another "
            "behaviour, remove its pins and Hold Shape, or let it be a collider"
        )
    return material
