# SPDX-License-Identifier: GPL-3.0-or-later
"""All differences between the supported Blender versions (4.5 and 5.2), and between builds."""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import bpy

from ..sim.errors import RenderError

DENOISER = "OPENIMAGEDENOISE"
PROBE_PIXELS = 8
"""Side of the picture that tells whether the denoiser works."""
OBJECT_INDEX = "Object Index.X" if bpy.app.version >= (5, 0) else "IndexOB.X"
"""Channel of the object index pass."""
HEADLESS = ("--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1")
"""Arguments of every Blender that we start: no window, factory settings, and no scripts from files."""


if TYPE_CHECKING:
    OperatorMixin = bpy.types.Operator
else:
    OperatorMixin = object
"""Base of mixins for operators: an operator to type checkers, but not at run time, when Blender would register it."""


def enable_cycles() -> None:
    """Enable Cycles: it is an add-on, and may be disabled in the Python module or a factory start-up.

    Raises RenderError if this build lacks it.
    """
    if not hasattr(bpy.types.Scene, "cycles"):
        import addon_utils

        addon_utils.enable("cycles")
    if not hasattr(bpy.types.Scene, "cycles"):
        raise RenderError(f"Blender {bpy.app.version_string} was built without Cycles; use an official build")


def cycles_preferences() -> Any:
    """Return Cycles' preferences with its devices; None if it is not enabled."""
    addon = bpy.context.preferences.addons.get("cycles")
    return addon.preferences if addon is not None else None


def eevee() -> str:
    """Return the identifier of EEVEE; in 4.x the current engine is called EEVEE Next."""
    return "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"


@functools.cache
def denoiser_available() -> bool:
    """Return whether this process can denoise on the CPU: the first call denoises a tiny picture.

    OpenImageDenoise loads the library of its CPU device once a process. Where that fails, as on a machine without free
    memory, every later render would end with "Failed to create OIDN CPU device".
    """
    try:
        import _cycles
    except ImportError:
        return False
    if not getattr(_cycles, "with_openimagedenoise", False):
        return False
    enable_cycles()
    scene = bpy.data.scenes.new("PhysGen denoiser")
    camera = bpy.data.objects.new("PhysGen denoiser", bpy.data.cameras.new("PhysGen denoiser"))
    try:
        scene.collection.objects.link(camera)
        scene.camera, scene.render.engine = camera, "CYCLES"
        scene.render.resolution_x = scene.render.resolution_y = PROBE_PIXELS
        scene.render.use_compositing = scene.render.use_sequencer = False
        scene.cycles.device, scene.cycles.samples = "CPU", 1
        scene.cycles.use_denoising, scene.cycles.denoiser, scene.cycles.denoising_use_gpu = True, DENOISER, False
        bpy.ops.render.render(scene=scene.name)
    except RuntimeError:
        return False
    finally:
        bpy.data.cameras.remove(camera.data)
        bpy.data.scenes.remove(scene)
    return True


def node_tree(data: bpy.types.Material | bpy.types.World) -> bpy.types.NodeTree:
    """Return the emptied node tree of a material or world."""
    with warnings.catch_warnings():
        # Always true from 5.0 on, where setting it warns; needed before.
        warnings.simplefilter("ignore", DeprecationWarning)
        data.use_nodes = True
    data.node_tree.nodes.clear()
    return data.node_tree


def set_exr(image: bpy.types.ImageFormatSettings) -> None:
    """Set full-float multilayer OpenEXR output."""
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    image.exr_codec = "NONE"


def set_video(image: bpy.types.ImageFormatSettings) -> None:
    """Set FFmpeg video output."""
    if hasattr(image, "media_type"):
        image.media_type = "VIDEO"
    image.file_format = "FFMPEG"


def strips(scene: bpy.types.Scene) -> bpy.types.bpy_prop_collection:
    """Return the sequencer's strips, created if absent (named ``sequences`` before 4.4)."""
    editor = scene.sequence_editor_create()
    return editor.strips if hasattr(editor, "strips") else editor.sequences


def layer_collection(layer: bpy.types.ViewLayer, name: str) -> bpy.types.LayerCollection:
    """Return the layer collection ``name``; view layers of new scenes have none before their first update."""
    layer.update()
    return layer.layer_collection.children[name]


@contextlib.contextmanager
def active_scene(scene: bpy.types.Scene) -> Iterator[None]:
    """Make ``scene`` the context's scene for operators that require it."""
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        yield


def new_curves(item: bpy.types.Object) -> bpy.types.bpy_prop_collection:
    """Return the animation curves of a new action on ``item`` (``action.fcurves`` was removed in 5.0)."""
    action = bpy.data.actions.new(item.name)
    slot = action.slots.new(item.id_type, item.name)
    bag = action.layers.new("Layer").strips.new(type="KEYFRAME").channelbag(slot, ensure=True)
    data = item.animation_data_create()
    data.action, data.action_slot = action, slot
    return bag.fcurves


def set_modifier_input(modifier: bpy.types.NodesModifier, identifier: str, value: Any) -> None:
    """Set an input of a geometry nodes modifier; inputs were custom properties until 5.1."""
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value


def set_resolution(node: bpy.types.Node, mode: str) -> None:
    """Set the resolution mode of a volume node: ``Grid``, ``Size`` or ``Amount``; a menu input from 5.0 on."""
    if hasattr(node, "resolution_mode"):
        node.resolution_mode = {"Grid": "GRID", "Size": "VOXEL_SIZE", "Amount": "VOXEL_AMOUNT"}[mode]
    else:
        node.inputs["Resolution Mode"].default_value = mode
