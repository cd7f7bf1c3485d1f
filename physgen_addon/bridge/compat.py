# SPDX-License-Identifier: GPL-3.0-or-later
"""Every difference between the Blender lines that PhysGen runs on (4.5 and 5.2), and what a build has or lacks."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from typing import Any

import bpy

from ...sim.errors import RenderError

DENOISER = "OPENIMAGEDENOISE"
OBJECT_INDEX = "Object Index.X" if bpy.app.version >= (5, 0) else "IndexOB.X"
"""Channel of the pass that says which object a pixel shows."""


def enable_cycles() -> None:
    """Cycles is an add-on of Blender; as a Python module or in a factory start-up it may not be enabled.

    Raises RenderError when this build has none.
    """
    if not hasattr(bpy.types.Scene, "cycles"):
        import addon_utils

        addon_utils.enable("cycles")
    if not hasattr(bpy.types.Scene, "cycles"):
        raise RenderError(f"Blender {bpy.app.version_string} was built without Cycles; use an official build")


def cycles_preferences() -> bpy.types.AddonPreferences | None:
    """Where Cycles keeps which devices it uses; None when it is not enabled."""
    addon = bpy.context.preferences.addons.get("cycles")
    return addon.preferences if addon is not None else None


def eevee() -> str:
    """Blender's name of the engine EEVEE; 4.x called the present one after the one before it."""
    return "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"


def denoiser_available() -> bool:
    """Whether this build can denoise on the CPU."""
    try:
        import _cycles
    except ImportError:
        return False
    return bool(getattr(_cycles, "with_openimagedenoise", False))


def node_tree(data: bpy.types.Material | bpy.types.World) -> bpy.types.NodeTree:
    """The emptied node tree of a material or world."""
    with warnings.catch_warnings():
        # Always true from 5.0 on, where setting it warns; needed before.
        warnings.simplefilter("ignore", DeprecationWarning)
        data.use_nodes = True
    data.node_tree.nodes.clear()
    return data.node_tree


def set_exr(image: bpy.types.ImageFormatSettings) -> None:
    """Full-float multilayer OpenEXR."""
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    image.exr_codec = "NONE"


def set_video(image: bpy.types.ImageFormatSettings) -> None:
    """FFmpeg video output."""
    if hasattr(image, "media_type"):
        image.media_type = "VIDEO"
    image.file_format = "FFMPEG"


def strips(scene: bpy.types.Scene) -> bpy.types.bpy_prop_collection:
    """The sequencer's strips, created when there are none (``sequences`` was their name before 4.4)."""
    editor = scene.sequence_editor_create()
    return editor.strips if hasattr(editor, "strips") else editor.sequences


def layer_collection(layer: bpy.types.ViewLayer, name: str) -> bpy.types.LayerCollection:
    """The layer collection ``name``; view layers of new scenes have none before their first update."""
    layer.update()
    return layer.layer_collection.children[name]


@contextlib.contextmanager
def active_scene(scene: bpy.types.Scene) -> Iterator[None]:
    """Make ``scene`` the context's scene, for operators that look for it there."""
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        yield


def new_curves(item: bpy.types.Object) -> bpy.types.bpy_prop_collection:
    """The animation curves of a new action on ``item`` (``action.fcurves`` is gone from 5.0 on)."""
    action = bpy.data.actions.new(item.name)
    slot = action.slots.new(item.id_type, item.name)
    bag = action.layers.new("Layer").strips.new(type="KEYFRAME").channelbag(slot, ensure=True)
    data = item.animation_data_create()
    data.action, data.action_slot = action, slot
    return bag.fcurves


def set_modifier_input(modifier: bpy.types.NodesModifier, identifier: str, value: Any) -> None:
    """Set an input of a geometry nodes modifier; they were custom properties until 5.1."""
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value


def set_resolution(node: bpy.types.Node, mode: str) -> None:
    """How a volume node is given its resolution: ``Grid``, ``Size`` or ``Amount``; a menu input from 5.0 on."""
    if hasattr(node, "resolution_mode"):
        node.resolution_mode = {"Grid": "GRID", "Size": "VOXEL_SIZE", "Amount": "VOXEL_AMOUNT"}[mode]
    else:
        node.inputs["Resolution Mode"].default_value = mode
