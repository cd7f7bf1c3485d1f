# SPDX-License-Identifier: MIT
"""Photo → scene folder, once: the same photo, boxes and options are not reconstructed twice."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from ..atomic import write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..reconstruct import ObjectRequest, ReconstructOptions, reconstruct
from ..scene.environment import read_environment
from ..scene.folder import SceneFolder, load_scene, save_scene
from ..scene.json_fields import read_json, to_json
from ..scene.materials import load_preset
from ..scene.model import Scene, Vector
from ..scene.overrides import apply_overrides, without_physics
from .bake_inputs import file_hash

STAMP_FILE = "reconstruct.json"
RECONSTRUCT_REVISION = 3
"""Raised with every change of reconstruction that changes what a photo becomes."""


def reconstruct_scene(
    photo: Path,
    objects: Sequence[ObjectRequest],
    out: Path,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Reconstruct ``photo`` into the scene folder ``out``, unless it is there already.

    Physics (preset, velocity, spin) does not count: ``set_physics`` changes it in the finished scene.
    Raises what ``sim.reconstruct.reconstruct`` raises.
    """
    options = options or ReconstructOptions()
    if not photo.is_file():
        raise InputError(f"{photo}: there is no such photo; check its name")
    if options.environment is not None:
        # Before anything is hashed or cut out: nobody should wait for a message about the last step.
        read_environment(options.environment)
    stamp = {"inputs_hash": _inputs_hash(photo, objects, options)}
    if _stamp(out) == stamp:
        try:
            folder = load_scene(out)
        except InputError:
            pass
        else:
            on_event({"event": "notice", "stage": "reconstruct", "message": f"up to date: {out}"})
            return folder
    folder = reconstruct(photo, objects, out, options, on_event, cancelled)
    write_json(out / STAMP_FILE, stamp)
    return folder


def _stamp(out: Path) -> object:
    try:
        return read_json(out / STAMP_FILE)
    except InputError:
        return None


def _inputs_hash(photo: Path, objects: Sequence[ObjectRequest], options: ReconstructOptions) -> str:
    shapes = []
    for item in objects:
        fields = to_json(item)
        for physics in ("preset", "velocity", "spin"):
            fields.pop(physics, None)
        shapes.append(fields)
    content = {
        "revision": RECONSTRUCT_REVISION,
        "photo": file_hash(photo),
        "objects": shapes,
        "options": to_json(dataclasses.replace(options, environment=None)),
        "environment": None if options.environment is None else file_hash(options.environment),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def require_physics(
    objects: int, presets: Sequence[str], velocities: Sequence[Vector], spins: Sequence[Vector]
) -> None:
    """Raise InputError when there are more entries than ``objects``, or an unknown preset."""
    for name, values in (("preset", presets), ("velocity", velocities), ("spin", spins)):
        if len(values) > objects:
            raise InputError(f"{name}: {len(values)} given for {objects} objects; give at most one an object")
    for preset in presets:
        load_preset(preset)


def set_all_physics(
    root: Path,
    *,
    presets: Sequence[str] = (),
    velocities: Sequence[Vector] = (),
    spins: Sequence[Vector] = (),
    overrides: Sequence[str] = (),
    friction: float = ReconstructOptions().friction,
) -> SceneFolder:
    """Like ``set_physics``, but what is not given becomes what it is in a new scene, whatever it was before.

    Objects beyond a list become ``medium`` and are at rest; friction: the ground's. Effects stay.
    """
    folder = load_scene(root)
    count = len(folder.scene.objects)
    if len(presets) != 1:
        presets = [*presets, *["medium"] * (count - len(presets))]
    scene = with_physics(
        without_physics(folder.scene, friction),
        presets=presets,
        velocities=velocities,
        spins=spins,
        overrides=overrides,
    )
    return folder if scene == folder.scene else save_scene(root, scene)


def set_physics(
    root: Path,
    *,
    presets: Sequence[str] = (),
    velocities: Sequence[Vector] = (),
    spins: Sequence[Vector] = (),
    overrides: Sequence[str] = (),
) -> SceneFolder:
    """Change the scene folder as ``with_physics`` does; ``scene.json`` is only written when something changes."""
    folder = load_scene(root)
    scene = with_physics(folder.scene, presets=presets, velocities=velocities, spins=spins, overrides=overrides)
    return folder if scene == folder.scene else save_scene(root, scene)


def with_physics(
    scene: Scene,
    *,
    presets: Sequence[str] = (),
    velocities: Sequence[Vector] = (),
    spins: Sequence[Vector] = (),
    overrides: Sequence[str] = (),
) -> Scene:
    """Give the scene's objects, in order, other materials and motions; objects beyond a list keep what they have.

    A single preset goes to all objects. overrides: ``OBJECT.FIELD=VALUE``, carried out last (``sim/scene/overrides``).
    Raises InputError for an unknown preset, more entries than objects, or an override that cannot be carried out.
    """
    require_physics(len(scene.objects), presets, velocities, spins)
    if len(presets) == 1:
        presets = [presets[0]] * len(scene.objects)
    changed = list(scene.objects)
    for index, preset in enumerate(presets):
        changed[index] = dataclasses.replace(changed[index], material=load_preset(preset))
    for index, velocity in enumerate(velocities):
        changed[index] = dataclasses.replace(changed[index], velocity=velocity)
    for index, spin in enumerate(spins):
        changed[index] = dataclasses.replace(changed[index], spin=spin)
    return apply_overrides(dataclasses.replace(scene, objects=tuple(changed)), overrides)
