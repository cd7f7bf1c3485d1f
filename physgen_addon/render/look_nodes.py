# SPDX-License-Identifier: GPL-3.0-or-later
"""Compositor nodes of a rendered photo scene: its layers apart, to be graded by hand, and together again (Blender 5.0).

    frame = plate · shadow · (1 − A) + objects + grain

``PhysGen Layers`` takes the frames of several layers apart; ``PhysGen Look`` puts them together. Between the two lie
nodes that change nothing until they are touched, and anything may be put there. Grain is whatever the finished frame
has beside its layers, so that untouched nodes give the frame itself, whatever was matched to the photo.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import bpy

from ...sim.errors import InputError
from ...sim.files import MOST_HASHED, open_file
from ...sim.picture_header import require_picture
from ..paths import load_image

LAYERS, LOOK, TREE = "PhysGen Layers", "PhysGen Look", "PhysGen Compositing"
OURS = "physgen_look"
"""Custom property of our groups."""
LEAST_SHADOW = 0.05
"""Darkest shadow that the ground is divided by, as in ``sim.composite.compositing``."""
PASSES = ("beauty", "ground", "shadow", "objects", "object_id")
"""Parts of a frame's file that are used."""
MOST_HEADER = 2**16
"""Bytes of a file in which its size is looked for."""
WIDE = 220
"""Distance between columns of nodes."""


def available() -> bool:
    """Return whether this Blender has compositor node groups of scenes."""
    return "compositing_node_group" in bpy.types.Scene.bl_rna.properties


def add_look_nodes(scene: bpy.types.Scene, frames: list[Path], *, first_frame: int) -> bpy.types.NodeTree:
    """Make ``scene`` show ``frames`` through look nodes; return its compositor's node group.

    frames: files ``NNNN.exr`` with layers, consecutive numbers; the first is shown at ``first_frame``. Nodes that were
    added to ours before are kept, another compositor's tree stays in the file.

    Raises InputError for files without layers, or of another size than the scene renders; nothing has changed then.
    """
    render = scene.render
    wide, high = (
        round(size * render.resolution_percentage / 100) for size in (render.resolution_x, render.resolution_y)
    )
    head = _header(frames[0])
    shown = _size(head)
    if shown != (wide, high):
        raise InputError(
            f"{frames[0]}: has {shown[0]}x{shown[1]} pixels and the scene renders {wide}x{high}; render the frames at "
            f"a Size of {render.resolution_percentage} %"
        )
    image = _sequence(frames)
    _require_passes(image)
    layers = _layers_group(image, _names(head), len(frames), int(frames[0].stem), first_frame)
    tree = scene.compositing_node_group
    if tree is None or OURS not in tree:
        if tree is not None:
            tree.use_fake_user = True
        tree = _whole_tree(layers, _look_group())
        scene.compositing_node_group = tree
    render.use_compositing, render.dither_intensity = True, 0.0
    return tree


def _header(path: Path) -> bytes:
    """Return the beginning of an EXR file. Raises InputError for a file that is none."""
    try:
        with open_file(path, MOST_HASHED, what="frame") as stream:
            head = stream.read(MOST_HEADER)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); render the frames again") from error
    if not head.startswith(b"\x76\x2f\x31\x01") or _attribute(head, b"dataWindow", b"box2i") is None:
        raise InputError(f"{path}: is no EXR file; render the frames again")
    return head


def _attribute(head: bytes, name: bytes, kind: bytes) -> bytes | None:
    """Return the value of an attribute: after name and type follow its size, in little endian, and itself."""
    place = head.find(name + b"\0" + kind + b"\0")
    start = place + len(name) + len(kind) + 6
    if place < 0 or len(head) < start:
        return None
    value = head[start : start + int.from_bytes(head[start - 4 : start], "little")]
    return value if len(value) == int.from_bytes(head[start - 4 : start], "little") else None


def _size(head: bytes) -> tuple[int, int]:
    """Return width and height: Blender knows those of a file with layers only once it draws it."""
    left, top, right, bottom = struct.unpack("<4i", (_attribute(head, b"dataWindow", b"box2i") or b"")[:16])
    return right - left + 1, bottom - top + 1


def _names(head: bytes) -> dict[str, int]:
    """Return the number of each object in the file, by name; none where the file does not say."""
    try:
        found = json.loads(_attribute(head, b"physgen:object_ids", b"string") or b"{}")
    except (ValueError, RecursionError):
        return {}
    return {str(name): n for name, n in found.items() if type(n) is int and n > 0} if isinstance(found, dict) else {}


def _sequence(frames: list[Path]) -> bpy.types.Image:
    for path in frames[1:]:
        require_picture(path)
    image = load_image(frames[0], check_existing=True)
    image.source = "SEQUENCE"
    image.reload()
    return image


def _require_passes(image: bpy.types.Image) -> None:
    """Raise InputError if the frames lack a layer, asked in a group that is gone afterwards."""
    probe = bpy.data.node_groups.new("PhysGen probe", "CompositorNodeTree")
    try:
        node = probe.nodes.new("CompositorNodeImage")
        node.image = image
        missing = [name for name in PASSES if name not in node.outputs]
    finally:
        bpy.data.node_groups.remove(probe)
    if missing:
        raise InputError(
            f"{bpy.path.abspath(image.filepath)}: has no {', '.join(missing)}; render with the format EXR Layers"
        )


def _group(name: str) -> bpy.types.NodeTree:
    """Return our group of that name, emptied if it exists: users keep their links where sockets keep their names."""
    found = next((tree for tree in bpy.data.node_groups if OURS in tree and tree[OURS] == name), None)
    tree = found or bpy.data.node_groups.new(name, "CompositorNodeTree")
    tree[OURS] = name
    tree.nodes.clear()
    return tree


def _sockets(tree: bpy.types.NodeTree, wanted: list[tuple[str, str, str]]) -> None:
    """Give ``tree`` the sockets ``wanted`` (name, in or out, type) and no others; those that are there are kept."""
    kept = {(item.name, item.in_out): item for item in tree.interface.items_tree if item.item_type == "SOCKET"}
    names = {(name, way) for name, way, _ in wanted}
    for key, item in kept.items():
        if key not in names:
            tree.interface.remove(item)
    for name, way, kind in wanted:
        if (name, way) not in kept:
            tree.interface.new_socket(name, in_out=way, socket_type=kind)


def _maths(tree: bpy.types.NodeTree, operation: str, *given: Any, place: tuple[float, float]) -> Any:
    """Return the vector that ``operation`` makes of ``given``: sockets, or numbers for all three components."""
    node = tree.nodes.new("ShaderNodeVectorMath")
    node.operation, node.location = operation, place
    inputs = [socket for socket in node.inputs if socket.enabled]
    for socket, value in zip(inputs, given, strict=True):
        if isinstance(value, float):
            socket.default_value = (value, value, value)
        else:
            tree.links.new(value, socket)
    return node.outputs["Vector"]


def _joined(tree: bpy.types.NodeTree, ground: Any, objects: Any, place: tuple[float, float]) -> Any:
    """Return premultiplied ``objects`` over ``ground``."""
    x, y = place
    alpha = tree.nodes.new("CompositorNodeSeparateColor")
    alpha.location = (x, y - 160)
    tree.links.new(objects, alpha.inputs[0])
    seen = _maths(tree, "MULTIPLY", ground, alpha.outputs["Alpha"], place=(x + WIDE, y - 80))
    return _maths(
        tree, "ADD", _maths(tree, "SUBTRACT", ground, seen, place=(x + 2 * WIDE, y)), objects, place=(x + 3 * WIDE, y)
    )


def _layers_group(
    image: bpy.types.Image, names: dict[str, int], count: int, number: int, first_frame: int
) -> bpy.types.NodeTree:
    """Return the group that takes the frames of ``image`` apart, with a mask for each of ``names``, by
    their numbers in the file.
    """
    tree = _group(LAYERS)
    source = tree.nodes.new("CompositorNodeImage")
    source.image = image
    source.frame_start, source.frame_duration, source.frame_offset = first_frame, count, number - 1
    passes = {output.name: output for output in source.outputs}
    colours = [(name, "OUTPUT", "NodeSocketColor") for name in ("Plate", "Shadow", "Objects", "Grain")]
    masks = [(f"Mask {name}", "OUTPUT", "NodeSocketFloat") for name in names]
    _sockets(tree, [*colours, *masks])
    out = tree.nodes.new("NodeGroupOutput")
    out.location = (6 * WIDE, 0)
    least = _maths(tree, "MAXIMUM", passes["shadow"], LEAST_SHADOW, place=(WIDE, -200))
    plate = _maths(tree, "DIVIDE", passes["ground"], least, place=(2 * WIDE, -100))
    together = _joined(tree, passes["ground"], passes["objects"], (WIDE, -500))
    grain = _maths(tree, "SUBTRACT", passes["beauty"], together, place=(5 * WIDE, -400))
    for name, socket in (("Plate", plate), ("Shadow", least), ("Objects", passes["objects"]), ("Grain", grain)):
        tree.links.new(socket, out.inputs[name])
    for row, (name, index) in enumerate(names.items(), start=1):
        mask = tree.nodes.new("CompositorNodeIDMask")
        mask.inputs["Index"].default_value, mask.location = index, (4 * WIDE, -600 - 160 * row)
        tree.links.new(passes["object_id"], mask.inputs[0])
        tree.links.new(mask.outputs[0], out.inputs[f"Mask {name}"])
    return tree


def _look_group() -> bpy.types.NodeTree:
    """Return the group that puts layers together."""
    tree = _group(LOOK)
    wanted = [(name, "INPUT", "NodeSocketColor") for name in ("Plate", "Shadow", "Objects", "Grain")]
    _sockets(tree, [*wanted, ("Image", "OUTPUT", "NodeSocketColor")])
    source, out = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    out.location = (6 * WIDE, 0)
    ground = _maths(tree, "MULTIPLY", source.outputs["Plate"], source.outputs["Shadow"], place=(WIDE, 0))
    joined = _joined(tree, ground, source.outputs["Objects"], (WIDE, -100))
    tree.links.new(_maths(tree, "ADD", joined, source.outputs["Grain"], place=(5 * WIDE, 0)), out.inputs["Image"])
    return tree


def _whole_tree(layers: bpy.types.NodeTree, look: bpy.types.NodeTree) -> bpy.types.NodeTree:
    """Return a compositor's tree: ``layers``, a node for each to be touched, ``look``."""
    tree = bpy.data.node_groups.new(TREE, "CompositorNodeTree")
    tree[OURS] = TREE
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    first, last = (tree.nodes.new("CompositorNodeGroup") for _ in range(2))
    first.node_tree, last.node_tree = layers, look
    out = tree.nodes.new("NodeGroupOutput")
    last.location, out.location = (3 * WIDE, 0), (4 * WIDE, 0)
    touched = (
        ("Plate", "CompositorNodeExposure", "Plate Exposure"),
        ("Shadow", "ShaderNodeGamma", "Shadow Strength"),
        ("Objects", "CompositorNodeExposure", "Objects Exposure"),
    )
    for row, (name, kind, label) in enumerate(touched):
        node = tree.nodes.new(kind)
        node.label, node.location = label, (1.5 * WIDE, 220 - 200 * row)
        tree.links.new(first.outputs[name], node.inputs[0])
        tree.links.new(node.outputs[0], last.inputs[name])
    tree.links.new(first.outputs["Grain"], last.inputs["Grain"])
    tree.links.new(last.outputs["Image"], out.inputs["Image"])
    return tree
