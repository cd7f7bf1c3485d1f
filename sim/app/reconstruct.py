# SPDX-License-Identifier: MIT
"""Photo → scene folder; the same photo, boxes and options are not reconstructed twice.

``correct`` repeats it with values that the user overrides. Stages whose inputs have not changed are not computed again
(``sim/reconstruct/stage_cache``); materials, motion, effects and light that were edited since are kept.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..atomic import recover, write_json
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..folder_lock import lock_beside
from ..memory import freed_memory_kept
from ..reconstruct import ObjectRequest, ReconstructOptions
from ..reconstruct.adapters.adapter_registry import chosen_segmenter, spec_files
from ..reconstruct.adapters.protocols import STAGES
from ..reconstruct.reasoning.chat_client import ChatRequest
from ..scene.environment import read_environment
from ..scene.folder import Scene, file_hash, load_scene, parse_scene, save_scene, scene_to_json
from ..scene.material import load_preset
from ..scene.model import Ground, SceneModel, Vector
from ..scene.overrides import PHYSICS_FIELDS, apply_overrides, without_physics
from ..scene.scene_output import PHYSICS_FILE, STAMP_FILE
from ..trust import trusted_spec
from ..validation import read_json, to_json
from .reconstruct_record import Request, read_stamp, require_stamp, stamp_to_json

RECONSTRUCT_REVISION = 86
"""Raised with every change of reconstruction that changes what a photo becomes."""


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Materials and motion of a scene's objects, in their order; objects beyond a list keep their defaults.

    presets: material presets (``presets/materials``); a single one goes to all objects. velocities: m/s, spins: rad/s,
    at time 0 in the world frame. overrides: ``OBJECT.FIELD=VALUE``, applied last (``sim/scene/overrides``).
    """

    presets: tuple[str, ...] = ()
    velocities: tuple[Vector, ...] = ()
    spins: tuple[Vector, ...] = ()
    overrides: tuple[str, ...] = ()


def reconstruct(
    photo: str | Path,
    objects: Sequence[ObjectRequest],
    *,
    out: str | Path,
    options: ReconstructOptions | None = None,
    physics: Physics | None = None,
    ask: ChatRequest | None = None,
    answered: str | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return the scene reconstructed from ``photo`` as the folder ``out``; what is already there is not done again.

    objects: one request per object: a box (x0, y0, x1, y1 in pixels) or a mask, and what is known of it.
    physics: overrides the requests' presets, velocities and spins. The physics asked for is always applied, to a
    cached scene as well; effects that were added to the scene since stay.
    ask: a chat model to query for what the objects are; answered: an earlier reply of one, in its place.

    >>> import physgen
    >>> cup = physgen.ObjectRequest(box=(215, 960, 475, 1190), velocity=(0, 0, 1.5))
    >>> scene = physgen.reconstruct("photo.jpg", [cup], out="scene")  # doctest: +SKIP
    >>> [item.name for item in scene.objects]  # doctest: +SKIP
    ['object_1']

    Raises InputError for an unreadable photo, mask or option, Cancelled when cancelled; ``out`` is then unchanged.
    """
    photo, out, options, physics = Path(photo), Path(out), options or ReconstructOptions(), physics or Physics()
    require_physics(len(objects), physics)
    # The stamp has the choice itself, so that a correction keeps it, whatever is installed by then.
    options = dataclasses.replace(options, segmenter=chosen_segmenter(options.segmenter))
    velocities = (*physics.velocities, *(item.velocity for item in objects[len(physics.velocities) :]))
    spins = (*physics.spins, *(item.spin for item in objects[len(physics.spins) :]))
    asked = dataclasses.replace(physics, velocities=velocities, spins=spins)
    request = Request(photo=photo, objects=tuple(objects), options=options)
    with lock_beside(out):
        return _reconstruct_cached(
            request,
            out,
            lambda scene: with_all_physics(scene, asked, friction=options.friction),
            on_event,
            cancelled,
            ask=ask,
            answered=answered,
        )


def _up_to_date(out: Path, inputs_hash: str, objects: Sequence[ObjectRequest]) -> Scene | None:
    """Return the scene in ``out`` if it is of these inputs and its ``objects`` of the same materials; else None."""
    stamp = read_stamp(out)
    # What an object is made of is decided with its shape; motion is not, and is set afterwards.
    if stamp is None or stamp.inputs_hash != inputs_hash or stamp.presets != tuple(item.preset for item in objects):
        return None
    try:
        return load_scene(out)
    except InputError:
        return None


def _reconstruct_cached(
    request: Request,
    out: Path,
    settle: Callable[[Scene], SceneModel],
    on_event: OnEvent,
    cancelled: IsCancelled,
    *,
    ask: ChatRequest | None = None,
    answered: str | None = None,
) -> Scene:
    """Return the scene folder ``out``, reconstructed unless cached; the caller holds its lock.

    settle: returns what to save of the scene as reconstructed, or as it was found; of a new one before it takes the
    place of an earlier one, so that at every moment one of the two is there, with all that was set in it.
    """
    photo, objects, options = request.photo, request.objects, request.options
    if not photo.is_file():
        raise InputError(f"{photo}: there is no such photo; check its name")
    if options.environment is not None:
        # Before anything is hashed or segmented: a bad file should not be reported only after the last stage.
        read_environment(options.environment)
    for sentence in recover(out):
        on_event({"event": "notice", "stage": "reconstruct", "message": sentence})
    inputs_hash = _inputs_hash(photo, objects, options, ask, answered)
    folder = _up_to_date(out, inputs_hash, objects)
    if folder is not None:
        on_event({"event": "notice", "stage": "reconstruct", "message": f"up to date: {out}"})
        model = settle(folder)
        return folder if model == folder.model else save_scene(out, model)
    from ..reconstruct import reconstruct_photo

    # Imported here, because planning a farm's jobs must not pay for the engine's geometry.
    from .bake_estimate import at_rest

    def stamped(folder: Scene) -> SceneModel:
        record = stamp_to_json(inputs_hash, request, scene_to_json(folder.model))
        write_json(folder.root / STAMP_FILE, record)
        return settle(folder)

    with freed_memory_kept():
        folder = reconstruct_photo(
            photo,
            objects,
            out,
            options,
            on_event,
            cancelled,
            ask=ask,
            answered=answered,
            at_rest=at_rest,
            settle=stamped,
        )
    made = read_stamp(out)
    if made is not None:
        # What this user's own command wrote needs no further word of theirs.
        made.request.remember()
    return folder


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
            for path in spec_files(stage, trusted_spec(spec))
        ],
        "asked": answered if ask is None else [ask.url, ask.model],
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _file_hashes(value: object, names: Sequence[str]) -> dict[str, str]:
    """Return hashes of the files in the fields ``names`` of ``value``. Raises InputError when one is missing."""
    found = {}
    for name in names:
        path = getattr(value, name)
        if path is not None:
            if not path.is_file():
                raise InputError(f"{name}: there is no file {path}; check its name")
            found[name] = file_hash(path)
    return found


def require_physics(objects: int, physics: Physics) -> None:
    """Raise InputError when ``physics`` has more entries than there are ``objects``, or names an unknown preset."""
    for name, values in (("preset", physics.presets), ("velocity", physics.velocities), ("spin", physics.spins)):
        if len(values) > objects:
            raise InputError(f"{name}: {len(values)} given for {objects} objects; give at most one an object")
    for preset in physics.presets:
        load_preset(preset)


def set_all_physics(scene: Scene, physics: Physics, *, friction: float | None = None) -> Scene:
    """Return ``scene`` changed as ``with_all_physics`` does, saved."""
    model = with_all_physics(scene, physics, friction=friction)
    return scene if model == scene.model else scene.with_model(model).save()


def with_all_physics(scene: Scene, physics: Physics, *, friction: float | None = None) -> SceneModel:
    """Return the content of ``scene`` with ``physics``; what that leaves open gets the default of a new scene.

    A new scene is as it was reconstructed, at rest; objects without a recorded material are ``medium``.
    friction: Coulomb coefficient of the ground; None: the new scene's. Effects stay.
    """
    return with_physics(_as_reconstructed(scene, friction), physics)


def _as_reconstructed(folder: Scene, friction: float | None) -> SceneModel:
    bare = without_physics(folder.model, Ground().friction if friction is None else friction)
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


def set_physics(scene: Scene, physics: Physics) -> Scene:
    """Return ``scene`` changed as ``with_physics`` does; ``scene.json`` is only written when something changes."""
    model = with_physics(scene.model, physics)
    return scene if model == scene.model else scene.with_model(model).save()


def with_physics(scene: SceneModel, physics: Physics) -> SceneModel:
    """Return ``scene`` with the materials and motions of ``physics``; what it leaves open stays.

    Raises InputError for an unknown preset, more entries than objects, or an override that cannot be applied.
    """
    require_physics(len(scene.objects), physics)
    presets = physics.presets * len(scene.objects) if len(physics.presets) == 1 else physics.presets
    changed = list(scene.objects)
    for index, preset in enumerate(presets):
        changed[index] = dataclasses.replace(changed[index], material=load_preset(preset))
    for index, velocity in enumerate(physics.velocities):
        changed[index] = dataclasses.replace(changed[index], velocity=velocity)
    for index, spin in enumerate(physics.spins):
        changed[index] = dataclasses.replace(changed[index], spin=spin)
    return apply_overrides(dataclasses.replace(scene, objects=tuple(changed)), physics.overrides)


MATTER_FIELDS = ("material", "fill", "roughness")
"""Fields that follow from an object's kind."""


def correct(
    scene: Scene,
    *,
    earlier: Request,
    objects: Sequence[ObjectRequest],
    options: ReconstructOptions,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return ``scene`` reconstructed again, in place, with other ``objects`` or ``options``, from the same photo.

    earlier: what it was reconstructed from (``require_request``). Objects keep their physics by name. What was set in
    the scene since is never lost: killed at any moment, this leaves the scene as it was, or the corrected one with it.
    Raises what ``reconstruct`` raises, and InputError when the photo has moved.
    """
    root = scene.root
    if options.segmenter is not None:
        options = dataclasses.replace(options, segmenter=chosen_segmenter(options.segmenter))
    if not earlier.photo.is_file():
        raise InputError(
            f"{earlier.photo}: the photo of this scene is no longer there; put it back, or reconstruct anew"
        )
    with lock_beside(root):
        # Not as it was when the command began to wait.
        scene = load_scene(root)
        before, first = scene.model, parse_scene(require_stamp(scene).scene, STAMP_FILE)
        lights = ("environment", "environment_frame", "sun")
        light_changed = any(getattr(options, name) != getattr(earlier.options, name) for name in lights)
        keeps_light = before.light != first.light and not light_changed
        previous = {item.name: (item.kind, item.preset) for item in earlier.objects}
        changed = {item.name for item in objects if previous.get(item.name) != (item.kind, item.preset)}
        made = {item.name: item.held for item in first.objects}
        edited = {item.name for item in before.objects if item.held != made.get(item.name)}

        def settle(folder: Scene) -> SceneModel:
            model = _as_before(folder.model, before, changed, edited)
            if not keeps_light:
                return model
            name = before.light.environment
            if name is not None and folder.root != root:
                target = folder.file(name)
                target.parent.mkdir(exist_ok=True)
                shutil.copyfile(scene.file(name), target)
            return dataclasses.replace(model, light=before.light)

        request = Request(photo=earlier.photo, objects=tuple(objects), options=options)
        return _reconstruct_cached(request, root, settle, on_event, cancelled, answered=_answered(root))


def _answered(root: Path) -> str | None:
    """Return the earlier reply of a chat model about the scene; a correction does not query it again."""
    try:
        record = read_json(root / PHYSICS_FILE)
    except InputError:
        return None
    answers = record.get("answers") if isinstance(record, dict) else None
    raw = answers.get("raw") if isinstance(answers, dict) else None
    return raw if isinstance(raw, str) and raw else None


def _as_before(
    scene: SceneModel, before: SceneModel, changed: Collection[str | None], edited: Collection[str]
) -> SceneModel:
    """Return ``scene`` with the physics of ``before``, but the new material of the objects ``changed``; whether one is
    held follows from its new shape, but for the objects ``edited``.
    """
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
                    if (item.name not in changed or name not in MATTER_FIELDS)
                    and (item.name in edited or name != "held")
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
