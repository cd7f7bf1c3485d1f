# SPDX-License-Identifier: GPL-3.0-or-later
"""Operator: compose objects: selected objects that intersect are moved and deformed until they no longer do."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...sim.app.stage_process import run_stage
from ...sim.errors import InputError, PhysGenError
from ...sim.events import Event, IsCancelled, OnEvent
from ...sim.scene.folder import Scene, load_scene
from ...sim.scene.scene_output import COMPOSE_FILE
from ...sim.validation import read_json
from ..background_jobs import JobOperator, Work
from ..context import active, selected
from ..interpreter import cli_command, find_python
from ..props.preferences import python
from ..scene_io.export_compose import ORIGINAL, ComposedObject, export_composition, photo_scene, read_composed
from ..text import count, decimal, length, volume

LEAST_MOVE = 1e-6
"""Motion below this share of an object's size is ignored."""


def chosen_meshes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected meshes: the active one, which stays fixed, then the others by name."""
    found = sorted((item for item in selected(context) if item.type == "MESH"), key=lambda item: item.name)
    first = active(context)
    return sorted(found, key=lambda item: item != first)


def composing_method(scene: bpy.types.Scene) -> str:
    """Return the method that was chosen; Physics where there is no photo and nothing was chosen."""
    settings = scene.physgen_compose
    by_itself = not scene.physgen.folder and not settings.is_property_set("method")
    return "ppps" if by_itself else str(settings.method)


class Compose(JobOperator):
    """A composition of the selected objects: ``begin``, then ``tick`` until it returns a result."""

    bl_idname = "physgen.compose_objects"
    job_title = "Compose Objects"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled with two meshes, in Object Mode."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Leave Edit Mode first")
            return False
        if len(chosen_meshes(context)) < 2:
            cls.poll_message_set("Select two or more meshes; the active one stays")
            return False
        return super().poll(context)

    def request(self, context: bpy.types.Context) -> Work:
        """Export the objects and return the composition as a child process."""
        scene, items = context.scene, chosen_meshes(context)
        if len(items) < 2:
            raise InputError(f"{count(len(items), 'mesh')} selected: select two or more meshes; the active one stays")
        settings = scene.physgen_compose
        method = composing_method(scene)
        photo = photo_scene(scene) if method != "ppps" else None
        if photo is None and method != "ppps":
            raise InputError(
                "there is no photo of the objects: choose the method Physics, or import the scene of a photo"
            )
        self._folder = Path(tempfile.mkdtemp(prefix="compose-", dir=bpy.app.tempdir or None))
        try:
            self._fitted = export_composition(scene, items, self._folder / "scene", photo=photo)
        except PhysGenError:
            _remove(self._folder)
            raise
        source, out, preferred = self._folder / "scene", self._folder / "fitted", python(context)
        arguments = ["--objects", ",".join(item.name for item in self._fitted), "--method", method]
        arguments += ["--steps", str(settings.steps), "--keep-strain", repr(decimal(settings.keep_strain))]
        arguments += [] if photo is not None else ["--no-picture"]

        def work(on_event: OnEvent, cancelled: IsCancelled) -> Event:
            try:
                command = cli_command(find_python(preferred), "compose", str(source), "--out", str(out), *arguments)
                return run_stage(command, on_event, cancelled)
            except PhysGenError:
                _remove(source.parent)
                raise

        return work

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Apply the new shapes; show the results in the panel."""
        try:
            folder = load_scene(self._folder / "fitted")
            pairs = _pairs(folder, self._fitted)
            # All objects are looked up before any is changed.
            changes = [(_found(scene, item), read_composed(folder, item.name)) for item in self._fitted]
            for item, vertices in changes:
                if len(item.data.vertices) != len(vertices):
                    raise InputError(f"object {item.name!r}: its mesh was changed meanwhile; fit again")
            moved = [item.name for item, vertices in changes if _reshape(scene, item, vertices)]
        finally:
            _remove(self._folder)
        _show(scene, pairs)
        for item, _ in changes:
            item.update_tag(refresh={"DATA"})
        if not moved:
            return "Nothing had to move"
        before, after = (sum(float(pair[f"volume_{when}"]) for pair in pairs) for when in ("before", "after"))
        deepest = max(float(pair["deepest_after"]) for pair in pairs)
        return (
            f"{', '.join(moved)} moved: penetration {volume(before)} before, {volume(after)} after, "
            f"deepest {length(deepest)}"
        )


class PHYSGEN_OT_compose_objects(Compose, bpy.types.Operator):
    """Resolve intersections of the selected objects. The active object stays fixed, the others yield"""

    bl_idname = Compose.bl_idname
    bl_label = "Compose Objects"
    bl_options = {"UNDO"}  # noqa: RUF012


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


def _found(scene: bpy.types.Scene, fitted: ComposedObject) -> bpy.types.Object:
    """Return the exported object; its ``session_uid`` survives undo and renaming."""
    for item in scene.objects:
        if item.session_uid == fitted.uid:
            return item
    raise InputError(f"object {fitted.name!r} is no longer in the scene; nothing was changed")


def _reshape(scene: bpy.types.Scene, item: bpy.types.Object, vertices: np.ndarray) -> bool:
    """Set the ``vertices`` (V, 3) of ``item``; return whether anything moved."""
    before = np.empty(3 * len(vertices), dtype=np.float32)
    item.data.vertices.foreach_get("co", before)
    size = float(np.ptp(before.reshape(-1, 3), axis=0).max())
    if float(np.abs(vertices.ravel() - before).max()) <= LEAST_MOVE * size:
        return False
    if item.data.users > 1:
        # Other users of the mesh are elsewhere.
        item.data = item.data.copy()
    mesh = item.data
    if scene.physgen_compose.keep_original and mesh.shape_keys is None:
        item.shape_key_add(name="Composed", from_mix=False)
        item.shape_key_add(name=ORIGINAL, from_mix=False).value = 0.0
        # Edit Mode edits the active one.
        item.active_shape_key_index = 0
    new = vertices.astype(np.float32).ravel()
    mesh.vertices.foreach_set("co", new)
    if mesh.shape_keys is not None:
        mesh.shape_keys.key_blocks[0].data.foreach_set("co", new)
    mesh.update()
    return True


def _pairs(folder: Scene, fitted: tuple[ComposedObject, ...]) -> list[dict[str, Any]]:
    """Return the penetration of each pair from ``compose.json``, by Blender's names."""
    record = read_json(folder.root / COMPOSE_FILE)
    names = {item.name: item.label for item in fitted}
    found = []
    with contextlib.suppress(KeyError, TypeError):
        for pair in record["pairs"]:
            entry: dict[str, Any] = {"name": " – ".join(names.get(name, name) for name in pair["objects"])}
            for when in ("before", "after"):
                entry |= _numbers(pair[when], when)
            found.append(entry)
    return found


def _numbers(state: Mapping[str, Any], when: str) -> dict[str, float]:
    return {
        f"volume_{when}": float(state["volume_m3"]),
        f"share_{when}": float(state["share"]),
        f"deepest_{when}": float(state["deepest_m"]),
    }


def _show(scene: bpy.types.Scene, pairs: list[dict[str, Any]]) -> None:
    shown = scene.physgen_compose.pairs
    shown.clear()
    for pair in pairs:
        entry = shown.add()
        for name, value in pair.items():
            setattr(entry, name, value)


def _draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.separator()
    self.layout.operator(PHYSGEN_OT_compose_objects.bl_idname)


def register_compose_menu() -> None:
    """Add to the Object menu, hence to the search (F3)."""
    bpy.types.VIEW3D_MT_object.append(_draw_menu)


def unregister_compose_menu() -> None:
    """Remove from the Object menu."""
    bpy.types.VIEW3D_MT_object.remove(_draw_menu)
