# SPDX-License-Identifier: MIT
"""Photo → scene folder, once: the same photo, boxes and options are not reconstructed twice."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..atomic import write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..reconstruct import ObjectRequest, ReconstructOptions, reconstruct
from ..reconstruct.adapters.names import spec_files
from ..reconstruct.adapters.protocols import STAGES
from ..reconstruct.physics.chat import ChatRequest
from ..scene.environment import read_environment
from ..scene.folder import SceneFolder, load_scene, parse_scene, save_scene, scene_to_json
from ..scene.json_fields import parse, read_json, to_json
from ..scene.materials import load_preset
from ..scene.model import Ground, Scene, Vector
from ..scene.overrides import PHYSICS_FIELDS, apply_overrides, without_physics
from .bake_inputs import file_hash

T = TypeVar("T")

STAMP_FILE = "reconstruct.json"
RECONSTRUCT_REVISION = 4
"""Raised with every change of reconstruction that changes what a photo becomes."""


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """What a scene folder was reconstructed from (``reconstruct.json``).

    inputs_hash: of all that the scene depends on. photo, objects, options: the request, paths absolute.
    scene: ``scene.json`` as it was then, before anybody changed its physics or light.
    """

    inputs_hash: str
    photo: Path
    objects: tuple[ObjectRequest, ...]
    options: ReconstructOptions
    scene: Any


def reconstruct_scene(
    photo: Path,
    objects: Sequence[ObjectRequest],
    out: Path,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    ask: ChatRequest | None = None,
    answered: str | None = None,
) -> SceneFolder:
    """Reconstruct ``photo`` into the scene folder ``out``, unless it is there already.

    ask: a model to ask what things are; answered: what one answered before, in its place. Physics (preset, velocity,
    spin) does not count: ``set_physics`` changes it in the finished scene. Raises what ``sim.reconstruct.reconstruct``
    raises.
    """
    options = options or ReconstructOptions()
    if not photo.is_file():
        raise InputError(f"{photo}: there is no such photo; check its name")
    if options.environment is not None:
        # Before anything is hashed or cut out: nobody should wait for a message about the last step.
        read_environment(options.environment)
    inputs_hash = _inputs_hash(photo, objects, options, ask, answered)
    stamp = read_stamp(out)
    if stamp is not None and stamp.inputs_hash == inputs_hash:
        try:
            folder = load_scene(out)
        except InputError:
            pass
        else:
            on_event({"event": "notice", "stage": "reconstruct", "message": f"up to date: {out}"})
            return folder
    folder = reconstruct(photo, objects, out, options, on_event, cancelled, ask=ask, answered=answered)
    stamp = Stamp(
        inputs_hash=inputs_hash,
        photo=photo.resolve(),
        objects=tuple(_resolved(item, ("mask", "mesh")) for item in objects),
        options=_resolved(options, ("environment", "depth")),
        scene=scene_to_json(folder.scene),
    )
    write_json(out / STAMP_FILE, to_json(stamp))
    return folder


def read_stamp(root: Path) -> Stamp | None:
    """What the folder ``root`` was reconstructed from; None when it does not say, or in a way that is not known."""
    try:
        return parse(Stamp, read_json(root / STAMP_FILE), STAMP_FILE)
    except InputError:
        return None


def _resolved(value: T, names: Sequence[str]) -> T:
    """The dataclass ``value`` with the paths in its fields ``names`` absolute."""
    paths = {name: path.resolve() for name in names if (path := getattr(value, name)) is not None}
    return dataclasses.replace(value, **paths)  # type: ignore[type-var]


def _inputs_hash(
    photo: Path,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    ask: ChatRequest | None,
    answered: str | None,
) -> str:
    shapes = []
    for item in objects:
        fields = to_json(item)
        for physics in ("preset", "velocity", "spin"):
            fields.pop(physics, None)
        shapes.append(fields | _file_hashes(item, ("mask", "mesh")))
    content = {
        "revision": RECONSTRUCT_REVISION,
        "photo": file_hash(photo),
        "objects": shapes,
        "options": to_json(options) | _file_hashes(options, ("environment", "depth")),
        "adapters": [
            [stage, file_hash(path)]
            for stage in STAGES
            if (spec := getattr(options, stage)) is not None
            for path in spec_files(stage, spec)
        ],
        "asked": answered if ask is None else [ask.url, ask.model],
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _file_hashes(value: object, names: Sequence[str]) -> dict[str, str]:
    """Hashes of the files that the fields ``names`` of ``value`` name. Raises InputError when one is not there."""
    found = {}
    for name in names:
        path = getattr(value, name)
        if path is not None:
            if not path.is_file():
                raise InputError(f"{name}: there is no file {path}; check its name")
            found[name] = file_hash(path)
    return found


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
    friction: float | None = None,
) -> SceneFolder:
    """Like ``set_physics``, but what is not given becomes what it is in a new scene, whatever it was before.

    A new scene is as it was reconstructed, at rest; where the folder does not tell, its objects are ``medium``.
    friction: the ground's; None takes that of the new scene. Effects stay.
    """
    folder = load_scene(root)
    scene = with_physics(
        _as_reconstructed(folder, friction),
        presets=presets,
        velocities=velocities,
        spins=spins,
        overrides=overrides,
    )
    return folder if scene == folder.scene else save_scene(root, scene)


def _as_reconstructed(folder: SceneFolder, friction: float | None) -> Scene:
    bare = without_physics(folder.scene, Ground().friction if friction is None else friction)
    stamp = read_stamp(folder.root)
    if stamp is None:
        return bare
    try:
        first = parse_scene(stamp.scene, STAMP_FILE)
    except InputError:
        return bare
    physics = {item.name: {name: getattr(item, name) for name in PHYSICS_FIELDS} for item in first.objects}
    return dataclasses.replace(
        bare,
        objects=tuple(
            dataclasses.replace(
                item, **{**physics.get(item.name, {}), "velocity": (0.0, 0.0, 0.0), "spin": (0.0, 0.0, 0.0)}
            )
            for item in bare.objects
        ),
        ground=first.ground if friction is None else bare.ground,
    )


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
