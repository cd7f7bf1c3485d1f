# SPDX-License-Identifier: GPL-3.0-or-later
"""What an object must not have for the simulation to show what the artist sees; every refusal says the way out.

The cache becomes the first modifier of an object, on the mesh without modifiers. What comes after it is a matter of
looks, as long as it only smooths; a mirrored or hollowed shape is not what the simulation would know of.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...sim.errors import InputError
from .animation import channels, why_it_moves

OWN = "PhysGen"
"""What the names of all modifiers that PhysGen itself adds begin with (``caches.MODIFIER``)."""

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
"""Kinds of modifiers after which an object is still about where its mesh is."""

SMOOTHING_GROUPS = ("Smooth by Angle", "Auto Smooth")
"""Blender's own geometry nodes that change normals alone; copies have a number behind the name."""

THINNEST = 1e-6
"""Smallest scale of an object over its largest."""

FARTHEST = 1e9
"""m; nothing of a size is left there in 32 bits."""


def foreign_modifiers(item: bpy.types.Object) -> list[bpy.types.Modifier]:
    """The modifiers of ``item`` that act in the viewport and are not PhysGen's own."""
    return [modifier for modifier in item.modifiers if modifier.show_viewport and not modifier.name.startswith(OWN)]


def is_smoothing(modifier: bpy.types.Modifier) -> bool:
    """Whether ``modifier`` leaves the shape about as it is."""
    if modifier.type == "NODES":
        return modifier.node_group is None or modifier.node_group.name.startswith(SMOOTHING_GROUPS)
    return modifier.type in HARMLESS


def require_simulable(item: bpy.types.Object) -> None:
    """Raise InputError where the mesh of dynamic ``item`` is not what is seen of it, or something else moves it."""
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
                f"{where}: modifier {modifier.name!r} ({kind}) changes its shape, and what is simulated is the mesh "
                "before it: apply it or hide it in the viewport"
            )
    keys = item.data.shape_keys
    if keys is not None and (channels(keys) or any(key.value != 0 and not key.mute for key in keys.key_blocks[1:])):
        raise InputError(
            f"{where}: has shape keys in effect, and what is simulated is the mesh without them: set their values to "
            "0, or apply or remove them (Properties > Data > Shape Keys)"
        )
    reason = why_it_moves(item)
    if reason is not None:
        raise InputError(
            f"{where}: {reason}, but the simulation decides where it goes: let it be a collider, or bake and clear "
            "that (Object > Apply > Visual Transform, Object > Animation > Clear Keyframes)"
        )


def require_still_settings(owner: bpy.types.ID, where: str) -> None:
    """Raise InputError where a setting of PhysGen on ``owner`` is animated: the simulation takes one value of each."""
    for path, _ in sorted(channels(owner)):
        if path.startswith("physgen"):
            raise InputError(
                f"{where}: {path} is animated, but the simulation takes one value of it: clear its keyframes or driver"
            )


def require_evaluated(item: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Raise InputError where Blender does not know the place of ``item``, because it is switched off."""
    if not item.evaluated_get(depsgraph).is_evaluated:
        raise InputError(
            f"object {item.name!r}: is disabled in viewports or excluded from the view layer: enable it in the "
            "outliner (the eye may stay closed), or take it out of the simulation"
        )


def require_placed(matrix: np.ndarray, name: str) -> None:
    """Raise InputError where ``matrix`` (4, 4) flattens object ``name`` or is not finite."""
    if not np.isfinite(matrix).all():
        raise InputError(f"object {name!r}: its place is not finite: reset its location, rotation and scale")
    away = float(np.abs(matrix[:3, 3]).max())
    if away > FARTHEST:
        raise InputError(f"object {name!r}: is {away:.3g} m away from the origin: move it nearer")
    sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not sizes[-1] > THINNEST * sizes[0]:
        raise InputError(f"object {name!r}: its scale makes it flat or vanish: give it a scale above 0 on every axis")
