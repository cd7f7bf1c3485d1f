# SPDX-License-Identifier: MIT
"""Adds the effects that a diagnosis found to a scene, and bakes the scene before and after."""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..atomic import scratch_prefix
from ..effects.registry import effect
from ..errors import Cancelled, InputError
from ..events import Event, IsCancelled, OnEvent, ignore, never
from ..folder_lock import lock_beside
from ..scene.folder import Scene, load_scene
from ..scene.model import Effect, SceneModel
from .scene_variant import save_variant

FoundEffects = Mapping[str, Mapping[str, float]]
"""Effect → parameter → value, in the order in which the diagnosis found them."""

RunBake = Callable[[Scene, Path, OnEvent, IsCancelled], Event]
"""Bakes a scene into a folder, in a process of its own, and returns the final event."""


def found_effects(report: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the verdict's effects with their parameters, from the content of ``report.json``.

    Raises InputError where the verdict is ``none`` or ``unknown``, or its parameters are missing or no numbers.
    """
    verdict = report.get("verdict")
    verdict = verdict if isinstance(verdict, dict) else {}
    first = verdict.get("effect")
    if first in ("none", "unknown", None):
        raise InputError(f"the verdict is {first!r}: there is no effect to add to a scene")
    names, listed = verdict.get("effects") or [first], report.get("effects")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"report.json: verdict.effects is {str(names)[:80]}: expected names; diagnose again")
    items = [item for item in listed if isinstance(item, dict)] if isinstance(listed, list) else []
    ranked = {str(item.get("name")): item for item in items}
    found = {}
    for name in names:
        parameters = ranked.get(name, {}).get("parameters")
        if not isinstance(parameters, dict):
            raise InputError(f"report.json: effects: {name!r} has no parameters; run `physgen diagnose` again")
        found[str(name)] = {str(key): _number(name, key, entry) for key, entry in parameters.items()}
    return found


def _number(name: str, key: str, entry: Any) -> float:
    value = entry.get("value") if isinstance(entry, dict) else entry
    # math.isfinite fails on a whole number that no float can hold.
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= sys.float_info.max:
        raise InputError(f"report.json: effects: {name}.{key} is {value!r}: expected a number; diagnose again")
    return float(value)


def with_effects(scene: SceneModel, found: FoundEffects) -> SceneModel:
    """Return ``scene`` with the ``found`` effects; one of the same name is replaced in its place and keeps its objects.

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
    """Return ``scene`` without the effects called ``names``."""
    return dataclasses.replace(scene, effects=tuple(item for item in scene.effects if item.name not in names))


@dataclass(frozen=True, kw_only=True)
class AddRequest:
    """Effects to add, and folders of the bakes without and with them.

    bake_before: whether ``before`` is baked first; otherwise it exists already.
    """

    found: FoundEffects
    before: Path
    after: Path
    bake_before: bool


def add_and_bake(
    scene: Scene,
    *,
    request: AddRequest,
    run_bake: RunBake,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Event:
    """Bake ``scene`` without the found effects if requested, then with them, and add them to it.

    Returns ``{"event": "done", "scene", "before", "after"}``. Both are variants in a temporary folder: the scene
    changes once, at the end, whatever ends this call. A bake that fails leaves it as it was; cancelling the second adds
    the effects, and the same call resumes there. What others changed in the scene meanwhile stays.
    """
    changed, bare = with_effects(scene.model, request.found), without_effects(scene.model, request.found)
    with tempfile.TemporaryDirectory(prefix=scratch_prefix(), ignore_cleanup_errors=True) as place:
        if request.bake_before:
            before = save_variant(scene, bare, out=Path(place) / "before")
            run_bake(before, request.before, _named(on_event, "before"), cancelled)
        after = save_variant(scene, changed, out=Path(place) / "after")
        try:
            run_bake(after, request.after, _named(on_event, "after"), cancelled)
        except Cancelled:
            _add(scene.root, request.found)
            raise
    _add(scene.root, request.found)
    folders = {"scene": scene.root, "before": request.before, "after": request.after}
    return {"event": "done", **{name: str(path) for name, path in folders.items()}}


def _add(root: Path, found: FoundEffects) -> None:
    with lock_beside(root):
        scene = load_scene(root)
        scene.with_model(with_effects(scene.model, found)).save()


def _named(on_event: OnEvent, which: str) -> OnEvent:
    """Return ``on_event`` with the stage of each event naming one of the two bakes."""
    return lambda event: on_event({**event, "stage": f"bake {which}"} if "stage" in event else event)
