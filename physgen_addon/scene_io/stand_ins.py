# SPDX-License-Identifier: GPL-3.0-or-later
"""Stand-ins: meshes that are simulated in place of what has none of its own, or another shape than it shows.

Text, curves, metaballs, modifiers that change the shape, shape keys, collection instances, and objects that something
else moves: the evaluated mesh becomes an object of its own, and the original is kept, hidden. A collection that was
set up for the simulation, such as the sample of the asset library, is unpacked instead.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...sim.errors import InputError
from .export_animation import channels, clock, rotation_vectors, view_layer, why_it_moves
from .export_meshes import closed, read_triangles, require_sound
from .export_objects import foreign_modifiers, is_smoothing

CONVERTIBLE = ("CURVE", "SURFACE", "META", "FONT", "CURVES")
"""Types of objects that Blender evaluates to meshes."""
VISIBILITY = ("hide_viewport", "hide_render")


def reason(item: bpy.types.Object, role: str) -> str:
    """Return why ``item`` needs a stand-in to take part as ``role``, in words; empty if it needs none.

    A collider is read as it is shown, frame by frame, so only what is no mesh needs one.
    """
    if item.type in CONVERTIBLE:
        return "is no mesh"
    if is_instance(item):
        return "is an instance of a collection"
    if item.type != "MESH" or role == "collider":
        return ""
    changing = [modifier.name for modifier in foreign_modifiers(item) if not is_smoothing(modifier)]
    if changing:
        return f"is changed by {', '.join(changing)}"
    keys = item.data.shape_keys
    if keys is not None and (channels(keys) or any(key.value != 0 and not key.mute for key in keys.key_blocks[1:])):
        return "has shape keys"
    return "is moved by something else" if why_it_moves(item) is not None else ""


def is_instance(item: bpy.types.Object) -> bool:
    """Return whether ``item`` shows a collection."""
    return item.type == "EMPTY" and item.instance_type == "COLLECTION" and item.instance_collection is not None


def is_set_up(item: bpy.types.Object) -> bool:
    """Return whether ``item`` shows a collection some of whose objects take part in a simulation already."""
    return is_instance(item) and any(part.physgen.enabled for part in item.instance_collection.all_objects)


def unpack(scene: bpy.types.Scene, item: bpy.types.Object) -> list[bpy.types.Object]:
    """Replace ``item``, for which ``is_set_up``, by local copies of what it shows; return those that take part.

    They keep role, material, motion and pins, with velocities and spins turned as ``item`` is. What does not take part,
    such as lamps and floors, is copied, too.
    """
    source = item.instance_collection
    shift = item.matrix_world @ Matrix.Translation(-source.instance_offset)
    # One scene of a file has what another has without copying: copies are of this one alone.
    group = bpy.data.collections.new(source.name)
    (item.users_collection or (scene.collection,))[0].children.link(group)
    copies = {part: part.copy() for part in source.all_objects}
    for part, copy in copies.items():
        group.objects.link(copy)
        if part.type == "MESH":
            # Bakes are attached to the object, but weights, materials and edits are the mesh's.
            copy.data = part.data.copy()
        copy.parent = copies.get(part.parent)
        if copy.parent is None:
            copy.matrix_world = shift @ part.matrix_world
        body, turn = copy.physgen, shift.to_quaternion()
        body.velocity, body.spin = turn @ Vector(body.velocity), turn @ Vector(body.spin)
        for push in body.pushes:
            push.velocity = turn @ Vector(push.velocity)
        for pin in body.pins:
            pin.box = copies.get(pin.box, pin.box)
    bpy.data.objects.remove(item)
    return [copy for copy in copies.values() if copy.physgen.enabled]


def make(scene: bpy.types.Scene, item: bpy.types.Object) -> list[bpy.types.Object]:
    """Return stand-ins of ``item``, one a mesh that it shows, and hide it.

    Where something moves the original, they take over at the current frame, or at the first simulated one if that is
    later, with the velocity and spin that it has there; until then the original is shown. Raises InputError, and adds
    nothing, for what cannot be simulated.
    """
    moved = why_it_moves(item) is not None
    now, part = scene.frame_current, scene.frame_subframe
    start = max(now, scene.physgen.simulation.frame_start) if moved else now
    made: list[bpy.types.Object] = []
    try:
        earlier = None
        if moved:
            scene.frame_set(start - 1)
            earlier = _matrices(scene, item)
            scene.frame_set(start)
        for name, mesh, matrix in _shown(scene, item):
            made.append(_new(scene, item, name, mesh, matrix))
            require_sound(closed(read_triangles(mesh)), item.name)
            if moved:
                before = (earlier or {}).get(name, matrix)
                _launch(made[-1], before, matrix, clock(scene).rate)
    except InputError as error:
        for stand_in in made:
            discard(stand_in)
        raise InputError(_remedied(item, str(error))) from None
    finally:
        if moved:
            scene.frame_set(now, subframe=part)
    if not made:
        raise InputError(f"object {item.name!r}: shows no faces that could be simulated")
    for stand_in in made:
        stand_in.physgen.original = item
        if moved:
            stand_in.physgen.start_frame = start
            _switch(stand_in, start, before=True)
    if moved:
        _switch(item, start, before=False)
    else:
        item.hide_viewport = item.hide_render = True
    return made


def _remedied(item: bpy.types.Object, words: str) -> str:
    extrude = item.type in ("FONT", "CURVE") and not item.data.extrude and not item.data.bevel_depth
    return f"{words}; for text and curves, raise Extrude (Properties > Data > Geometry)" if extrude else words


def _shown(scene: bpy.types.Scene, item: bpy.types.Object) -> list[tuple[str, bpy.types.Mesh, Matrix]]:
    """Return name, a new mesh, and the matrix of everything that ``item`` shows at the current frame."""
    layer = view_layer(scene)
    layer.update()
    graph = layer.depsgraph
    if not is_instance(item):
        evaluated = item.evaluated_get(graph)
        mesh = bpy.data.meshes.new_from_object(evaluated, preserve_all_data_layers=True, depsgraph=graph)
        return [(item.name, mesh, evaluated.matrix_world.copy())]
    found = []
    for instance in graph.object_instances:
        if instance.is_instance and instance.parent is not None and instance.parent.original == item:
            if instance.object.type not in ("MESH", *CONVERTIBLE):
                continue
            name, matrix = f"{item.name} {instance.object.original.name}", instance.matrix_world.copy()
            mesh = bpy.data.meshes.new_from_object(instance.object, preserve_all_data_layers=True, depsgraph=graph)
            found.append((name, mesh, matrix))
    return found


def _matrices(scene: bpy.types.Scene, item: bpy.types.Object) -> dict[str, Matrix]:
    """Return the matrices of what ``item`` shows at the current frame, by name."""
    found = {}
    for name, mesh, matrix in _shown(scene, item):
        found[name] = matrix
        bpy.data.meshes.remove(mesh)
    return found


def _new(
    scene: bpy.types.Scene, item: bpy.types.Object, name: str, mesh: bpy.types.Mesh, matrix: Matrix
) -> bpy.types.Object:
    mesh.name = f"{name} simulated"
    stand_in = bpy.data.objects.new(mesh.name, mesh)
    (item.users_collection or (scene.collection,))[0].objects.link(stand_in)
    stand_in.matrix_world = matrix
    return stand_in


def _launch(item: bpy.types.Object, before: Matrix, after: Matrix, rate: float) -> None:
    """Give ``item`` the velocity and spin that take ``before`` to ``after`` in one frame of ``rate`` a second."""
    old, new = (np.array(matrix.to_quaternion().to_matrix(), dtype=np.float64) for matrix in (before, after))
    centre = sum((vertex.co for vertex in item.data.vertices), start=after.translation * 0) / len(item.data.vertices)
    item.physgen.velocity = ((after @ centre) - (before @ centre)) * rate
    item.physgen.spin = rotation_vectors((new @ old.T)[None])[0] * rate


def _switch(item: bpy.types.Object, frame: int, *, before: bool) -> None:
    """Hide ``item`` before ``frame`` (or from it on), for viewport and renders, by keyframes."""
    for name in VISIBILITY:
        for at, hidden in ((frame - 1, before), (frame, not before)):
            setattr(item, name, hidden)
            item.keyframe_insert(name, frame=at)


def discard(item: bpy.types.Object) -> None:
    """Delete the stand-in ``item`` and its mesh; its original is shown again once no other stands in for it."""
    original, mesh = item.physgen.original, item.data
    bpy.data.objects.remove(item)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    if original is None or any(other.physgen.original == original for other in bpy.data.objects):
        return
    for name in VISIBILITY:
        if (name, 0) in channels(original):
            _unkey(original, name)
        setattr(original, name, False)


def _unkey(item: bpy.types.Object, name: str) -> None:
    """Remove the keyframes of the property ``name`` of ``item``."""
    data = item.animation_data
    for layer in data.action.layers if data is not None and data.action is not None else ():
        for strip in layer.strips:
            bag = strip.channelbag(data.action_slot)
            for curve in [curve for curve in bag.fcurves if curve.data_path == name] if bag is not None else ():
                bag.fcurves.remove(curve)
