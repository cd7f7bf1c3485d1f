# SPDX-License-Identifier: MIT
"""What a diagnosis found, put into a scene: its effects into ``scene.json``, and the scene baked before and after."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..effects.registry import effect
from ..errors import Cancelled, InputError, PhysGenError
from ..events import Event, IsCancelled, OnEvent
from ..scene.folder import Scene, load_scene, save_scene
from ..scene.model import Effect, SceneModel

FoundEffects = Mapping[str, Mapping[str, float]]
"""Effect → parameter → value, in the order in which the diagnosis found them."""

RunBake = Callable[[Path, Path, OnEvent, IsCancelled], Event]
"""Bakes a scene folder into a bake folder, in a process of its own, and gives its final event."""


def found_effects(report: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The verdict's effects with their parameters, from the content of ``report.json``.

    Raises InputError where the verdict is ``none`` or ``unknown``, or its parameters are missing or no numbers.
    """
    verdict = report.get("verdict")
    verdict = verdict if isinstance(verdict, dict) else {}
    first = verdict.get("effect")
    if first in ("none", "unknown", None):
        raise InputError(f"the verdict is {first!r}: there is no effect to add to a scene")
    names = verdict.get("effects") or [first]
    listed = report.get("effects")
    ranked = {item.get("name"): item for item in listed or [] if isinstance(item, dict)}
    found = {}
    for name in names:
        parameters = ranked.get(name, {}).get("parameters")
        if not isinstance(parameters, dict):
            raise InputError(f"report.json: effects: {name!r} has no parameters; run `physgen diagnose` again")
        found[str(name)] = {str(key): _number(name, key, entry) for key, entry in parameters.items()}
    return found


def _number(name: str, key: str, entry: Any) -> float:
    value = entry.get("value") if isinstance(entry, dict) else entry
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise InputError(f"report.json: effects: {name}.{key} is {value!r}: expected a number; diagnose again")
    return float(value)


def with_effects(scene: SceneModel, found: FoundEffects) -> SceneModel:
    """``scene`` with the ``found`` effects; one of the same name is replaced in its place and keeps its objects.

    Raises InputError for an unknown effect, a parameter out of its range, and where all that was found concerns the
    recording (its clock, its camera) and would leave the scene's motion as it is.
    """
    new = {}
    for name, values in found.items():
        kind = effect(name)
        if kind.kind == "observation":
            continue
        try:
            new[name] = tuple(kind.checked(values).items())
        except InputError as error:
            raise InputError(f"effect {name!r}: {error}") from None
    if not new:
        names = ", ".join(found) or "nothing"
        raise InputError(f"{names}: concerns how the recording was made; correct the capture, the scene stays as it is")
    effects = [
        dataclasses.replace(item, parameters=new.pop(item.name)) if item.name in new else item
        for item in scene.effects
        if item.name not in found or item.name in new
    ]
    effects += [Effect(name=name, parameters=parameters) for name, parameters in new.items()]
    return dataclasses.replace(scene, effects=tuple(effects))


def without_effects(scene: SceneModel, names: Collection[str]) -> SceneModel:
    """``scene`` without the effects called ``names``."""
    return dataclasses.replace(scene, effects=tuple(item for item in scene.effects if item.name not in names))


def add_effects(scene: Scene, found: FoundEffects) -> Scene:
    """Return ``scene`` with the effects ``found`` added, saved in its folder (whole or not at all).

    Raises InputError as ``with_effects`` does.
    """
    return save_scene(scene.root, with_effects(scene.model, found))


@dataclass(frozen=True, kw_only=True)
class AddRequest:
    """What is added where. scene: its folder; after: the new bake folder; before: the bake without the effects.

    bake_before: whether ``before`` is baked first; otherwise it is there already.
    """

    scene: Path
    found: FoundEffects
    before: Path
    after: Path
    bake_before: bool


def add_and_bake(request: AddRequest, run_bake: RunBake, on_event: OnEvent, cancelled: IsCancelled) -> Event:
    """Bake the scene without the found effects if asked to, add them, and bake it with them.

    A bake that fails leaves ``scene.json`` as it was before; one that is cancelled in the second bake leaves the
    effects in, so that the same call goes on from there. Returns ``{"event": "done", "scene", "before", "after"}``.
    """
    original = load_scene(request.scene).model
    changed = with_effects(original, request.found)
    try:
        if request.bake_before:
            save_scene(request.scene, without_effects(original, request.found))
            run_bake(request.scene, request.before, _named(on_event, "before"), cancelled)
    except BaseException:
        save_scene(request.scene, original)
        raise
    save_scene(request.scene, changed)
    try:
        run_bake(request.scene, request.after, _named(on_event, "after"), cancelled)
    except Cancelled:
        raise
    except PhysGenError:
        save_scene(request.scene, original)
        raise
    folders = {"scene": request.scene, "before": request.before, "after": request.after}
    return {"event": "done", **{name: str(path) for name, path in folders.items()}}


def _named(on_event: OnEvent, which: str) -> OnEvent:
    """Events say which of the two bakes they are of."""
    return lambda event: on_event({**event, "stage": f"bake {which}"} if "stage" in event else event)
