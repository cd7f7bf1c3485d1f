# SPDX-License-Identifier: MIT
"""A correction of a scene that was reconstructed: the same photo again, with something told that was guessed wrong.

What the correction does not touch is not computed again (``sim/reconstruct/stage_store``). What has been changed in the
scene since, matter, motion, effects, light, stays.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Collection, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..reconstruct import ObjectRequest, ReconstructOptions
from ..reconstruct.output import PHYSICS_FILE
from ..scene.folder import SceneFolder, load_scene, parse_scene, save_scene
from ..scene.json_fields import read_json
from ..scene.model import Scene
from ..scene.overrides import PHYSICS_FIELDS
from .reconstruct import STAMP_FILE, Stamp, read_stamp, reconstruct_scene

MATTER_FIELDS = ("material", "fill", "roughness")
"""What follows from what a thing is."""


def require_stamp(root: Path) -> Stamp:
    """What the scene folder ``root`` was reconstructed from. Raises InputError when it does not say."""
    load_scene(root)
    stamp = read_stamp(root)
    if stamp is None:
        raise InputError(
            f"{root}: does not say what it was reconstructed from ({STAMP_FILE} is missing or of another version); "
            "reconstruct it from the photo again"
        )
    return stamp


def correct_scene(
    root: Path,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Reconstruct the scene folder ``root`` again with other ``objects`` or ``options``, from the same photo.

    An object keeps its physics by its name. Raises what ``reconstruct_scene`` raises, and InputError when the photo is
    no longer where it was.
    """
    stamp = require_stamp(root)
    if not stamp.photo.is_file():
        raise InputError(f"{stamp.photo}: the photo of this scene is no longer there; put it back, or reconstruct anew")
    before, first = load_scene(root).scene, parse_scene(stamp.scene, STAMP_FILE)
    lights = ("environment", "environment_frame", "sun")
    told_light = any(getattr(options, name) != getattr(stamp.options, name) for name in lights)
    keeps_light = before.light != first.light and not told_light
    with TemporaryDirectory(dir=root.resolve().parent, prefix=f".{root.name}.light-") as place:
        light = None
        if keeps_light and before.light.environment is not None:
            light = Path(place) / "environment.exr"
            shutil.copyfile(SceneFolder(root, before).file(before.light.environment), light)
        folder = reconstruct_scene(stamp.photo, objects, root, options, on_event, cancelled, answered=_answered(root))
        if light is not None and before.light.environment is not None:
            target = folder.file(before.light.environment)
            target.parent.mkdir(exist_ok=True)
            shutil.copyfile(light, target)
    told = {item.name: (item.kind, item.preset) for item in stamp.objects}
    changed = {item.name for item in objects if told.get(item.name) != (item.kind, item.preset)}
    scene = _as_before(folder.scene, before, changed)
    if keeps_light:
        scene = dataclasses.replace(scene, light=before.light)
    return folder if scene == folder.scene else save_scene(root, scene)


def _answered(root: Path) -> str | None:
    """What a model once answered about the scene; it is not asked again for a correction."""
    try:
        record = read_json(root / PHYSICS_FILE)
    except InputError:
        return None
    answers = record.get("answers") if isinstance(record, dict) else None
    raw = answers.get("raw") if isinstance(answers, dict) else None
    return raw if isinstance(raw, str) and raw else None


def _as_before(scene: Scene, before: Scene, changed: Collection[str | None]) -> Scene:
    """``scene`` with the physics of ``before``, but the matter of the objects ``changed``, which are something else."""
    known = {item.name: item for item in before.objects}
    names = {item.name for item in scene.objects}
    return dataclasses.replace(
        scene,
        objects=tuple(
            dataclasses.replace(
                item,
                **{
                    name: getattr(known[item.name], name)
                    for name in PHYSICS_FIELDS
                    if item.name not in changed or name not in MATTER_FIELDS
                },
            )
            if item.name in known
            else item
            for item in scene.objects
        ),
        ground=scene.ground
        and before.ground
        and dataclasses.replace(before.ground, point=scene.ground.point, normal=scene.ground.normal),
        gravity=before.gravity,
        gravity_track=before.gravity_track,
        effects=tuple(effect for effect in before.effects if set(effect.objects) <= names),
        contacts=tuple(pair for pair in before.contacts if set(pair.between) <= names | {"ground"}),
    )
