# SPDX-License-Identifier: GPL-3.0-or-later
"""State of a scene's bake: none, running, current, stale or damaged."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import bpy

from ..sim.cache.bake_folder import MANIFEST_FILE, load_manifest
from ..sim.errors import InputError
from ..sim.folder_lock import LOCK_FILE, is_locked
from . import background_jobs, blend_trust, paths
from .playback import bake_record, show_bake
from .playback.bake_record import BakeRecord
from .props.body_props import bodies
from .scene_io.export_meshes import mesh_trouble
from .scene_io.motion_fingerprint import fingerprint

BAKE_OPERATOR = "physgen.bake"
MESSAGES = {
    "none": "Nothing is baked yet",
    "baked": "",
    "paused": "Incomplete. Resume continues it",
    "stale": "Out of date: something has changed since. Bake again, or undo the change",
    "missing": "The bake was moved. Find its folder, or bake again",
    "asks": "This file came with a bake outside its folder, which is left alone until you agree (see Scene)",
    "damaged": "Files of the bake are missing or damaged. Bake again to recompute them, or find a good copy",
}


@dataclass(frozen=True)
class BakeState:
    """State of a scene's bake.

    status: ``none``, ``baking``, ``paused`` (incomplete), ``baked``, ``stale`` (of an earlier state of the scene) or
    ``missing`` (files deleted or damaged). frames_done of frames can be played. disk_bytes: of all bakes of the scene.
    trouble: the last error; advice: state and remedy in words. estimate_text: estimated cost of baking; empty if
    unknown. frame_start: of the bake that is shown, or would be made. bakes: all that are on the disk, newest first.
    unfit: the objects whose meshes cannot be simulated, by name, and why.
    """

    status: str = "none"
    frames_done: int = 0
    frames: int = 0
    disk_bytes: int = 0
    trouble: str = ""
    advice: str = ""
    estimate_text: str = ""
    frame_start: int = 1
    bakes: tuple[bake_record.BakeOnDisk, ...] = ()
    unfit: Mapping[str, str] = field(default_factory=dict)

    @property
    def message(self) -> str:
        """Return all messages to show to the user."""
        return _sentences(self.trouble, self.advice)


def _sentences(*parts: str) -> str:
    return ". ".join(part.rstrip(" .") for part in parts if part)


_known: dict[int, BakeState] = {}
"""State by the scene's session_uid, which survives undo."""
_dirty: set[int] = set()
_fingerprints: dict[int, tuple[str, str]] = {}
"""Fingerprint and problem of scenes that have not changed since, by session_uid."""
_changed_at = [0.0]
_troubles: dict[int, str] = {}
"""Error that stopped the last bake of a scene; cleared when the next bake starts."""


def state(scene: bpy.types.Scene) -> BakeState:
    """Return the state. Takes microseconds in Blender's interface, where a timer keeps it up to date."""
    known = _known.get(scene.session_uid)
    # Timers never fire in background mode, where latency does not matter.
    if known is not None and not bpy.app.background:
        return known
    waits = is_dirty(scene)
    found = observe(scene)
    if waits:
        # The first draw of a panel must not prevent the timer from showing a matching bake.
        _dirty.add(scene.session_uid)
    return found


UNBAKED = "Press Bake: nothing moves yet"


def unbaked(scene: bpy.types.Scene) -> str:
    """Return in words that ``scene``, which has moving objects, is still to be baked, and when they start; or that
    none of them will move.
    """
    moving = [item for item in bodies(scene) if item.physgen.role == "dynamic"]
    is_alone = len(moving) == len(bodies(scene)) and not scene.physgen.world.effects
    if is_alone and all(_stays(item) for item in moving):
        return "Everything is at rest: give an object a velocity (see Motion), then Bake"
    starts = [words for item in moving if not _stays(item) and (words := _starts(item))]
    return f"{UNBAKED}. Start: {', '.join(starts)}" if starts else UNBAKED


def _starts(item: bpy.types.Object) -> str:
    """Return in words at which frames ``item`` starts and is pushed again; empty if it just starts with the others."""
    body = item.physgen
    frames = [push.frame for push in body.pushes]
    if not (frames or body.waits):
        return ""
    first = [body.start_frame] if body.waits or any(body.velocity) or any(body.spin) else []
    numbers = [str(frame) for frame in sorted(first + frames)]
    told = numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"
    return f"{item.name} at frame{'s' if len(numbers) > 1 else ''} {told}"


def _stays(item: bpy.types.Object) -> bool:
    body = item.physgen
    return body.asleep and not (any(body.velocity) or any(body.spin) or body.pushes or body.pins)


def last_seen(scene: bpy.types.Scene) -> BakeState | None:
    """Return the last observed state, or None."""
    return _known.get(scene.session_uid)


def mark_dirty(scene: bpy.types.Scene | None = None) -> None:
    """Mark ``scene``, or all scenes, as possibly changed."""
    _changed_at[0] = time.monotonic()
    for item in [scene] if scene is not None else bpy.data.scenes:
        _dirty.add(item.session_uid)
        _fingerprints.pop(item.session_uid, None)


def mark_progress(scene: bpy.types.Scene) -> None:
    """Mark that the bake of ``scene`` has progressed; the scene itself has not changed."""
    _dirty.add(scene.session_uid)


def forget() -> None:
    """Forget all states: another file was opened."""
    _known.clear()
    _dirty.clear()
    _fingerprints.clear()
    _troubles.clear()
    _unfit_of.clear()


def set_trouble(scene: bpy.types.Scene, message: str) -> None:
    """Set the error that stopped the bake of ``scene``; empty when a new bake starts."""
    _troubles[scene.session_uid] = message
    mark_dirty(scene)


def clear_troubles() -> None:
    """Forget the errors that stopped bakes, because their cause may be gone."""
    for scene in bpy.data.scenes:
        if _troubles.pop(scene.session_uid, ""):
            mark_dirty(scene)


def rest_s() -> float:
    """Return seconds since the last change: nothing is evaluated while the user drags or sculpts."""
    return time.monotonic() - _changed_at[0]


def is_dirty(scene: bpy.types.Scene) -> bool:
    """Return whether ``scene`` may have changed since it was last observed."""
    return scene.session_uid in _dirty or scene.session_uid not in _known


def bake_job(scene: bpy.types.Scene) -> background_jobs.Job | None:
    """Return the running bake job of ``scene`` in this Blender, or None."""
    job = background_jobs.running()
    return job if job is not None and (job.operator, job.scene) == (BAKE_OPERATOR, scene.session_uid) else None


def is_stopping(scene: bpy.types.Scene) -> bool:
    """Return whether a bake of ``scene`` was stopped and its worker is still cleaning up."""
    return any((job.operator, job.scene) == (BAKE_OPERATOR, scene.session_uid) for job in background_jobs.stopping())


def shown_record(scene: bpy.types.Scene) -> BakeRecord | None:
    """Return the record of the bake that ``scene`` shows; None without one or if its files are gone."""
    folder = paths.shown_bake(scene)
    return None if folder is None or bake_record.manifest_of(folder) is None else record_of(scene, folder)


def record_of(scene: bpy.types.Scene, folder: Path) -> BakeRecord:
    """Return the record of the bake ``folder``; if that is gone, of another bake that matches ``scene``."""
    return bake_record.read_record(folder) or BakeRecord(
        folder=str(folder), frame_start=scene.physgen.simulation.frame_start
    )


def caches_of(scene: bpy.types.Scene) -> list[Path]:
    """Return folders that may hold bakes of ``scene``: its cache folder, and the folder of the bake it shows."""
    found = _own_cache(scene)
    folder = paths.shown_bake(scene)
    if folder is not None and folder.parent.name == bake_record.BAKES and folder.parent.parent not in found:
        found.append(folder.parent.parent)
    return found


def concerns(scene: bpy.types.Scene) -> bool:
    """Return whether ``scene`` has bodies or a bake, so that files that do not use PhysGen cost nothing."""
    return bool(scene.physgen.simulation.bake) or bool(bodies(scene)) or bake_job(scene) is not None


def refresh(scene: bpy.types.Scene) -> BakeState:
    """Show the bake that matches the scene, if there is one, and return the state. May modify the scene."""
    if concerns(scene) and bake_job(scene) is None:
        try:
            _show_matching(scene)
        except InputError as error:
            set_trouble(scene, str(error))
    return observe(scene)


def observe(scene: bpy.types.Scene) -> BakeState:
    """Evaluate, remember and return the state; modifies nothing."""
    found = _look(scene) if concerns(scene) else BakeState(advice=MESSAGES["none"])
    trouble = _troubles.get(scene.session_uid, "")
    if trouble and found.status != "baking":
        found = replace(found, trouble=_sentences(trouble, found.trouble))
    simulation = scene.physgen.simulation
    found = replace(
        found,
        disk_bytes=sum(bake_record.disk_bytes(cache) for cache in caches_of(scene)),
        frame_start=_first_frame(scene),
        unfit=_unfit(scene),
        bakes=tuple(bake for cache in caches_of(scene) for bake in bake_record.bakes_on_disk(cache)),
        estimate_text=simulation.estimate
        if simulation.estimate and simulation.estimate_of == _fingerprint(scene)[0]
        else "",
    )
    _known[scene.session_uid] = found
    _dirty.discard(scene.session_uid)
    if found.status == "baking":
        # Changes without further notice: a killed worker leaves a child process that ends a moment later.
        mark_progress(scene)
    return found


MOST_VERTICES = 50_000
"""Of a mesh that is looked at after every change; a larger one is checked when it is added, and when it is baked."""
_unfit_of: dict[int, tuple[str, dict[str, str]]] = {}
"""Fingerprint, and what was found for it, by session_uid."""


def _unfit(scene: bpy.types.Scene) -> dict[str, str]:
    current = _fingerprint(scene)[0]
    known = _unfit_of.get(scene.session_uid)
    if known is None or known[0] != current:
        found = ((item.name, _trouble(item)) for item in bodies(scene) if item.physgen.role == "dynamic")
        known = _unfit_of[scene.session_uid] = current, {name: why for name, why in found if why}
    return known[1]


def _trouble(item: bpy.types.Object) -> str:
    return mesh_trouble(item) if item.mode == "OBJECT" and len(item.data.vertices) <= MOST_VERTICES else ""


def _first_frame(scene: bpy.types.Scene) -> int:
    shown = None if bake_job(scene) is not None else shown_record(scene)
    return scene.physgen.simulation.frame_start if shown is None else shown.frame_start


def _fingerprint(scene: bpy.types.Scene) -> tuple[str, str]:
    """Return the scene's fingerprint, or an empty one and the reason why there is none."""
    known = _fingerprints.get(scene.session_uid)
    # Background mode has no depsgraph notifications to rely on.
    if known is None or bpy.app.background:
        try:
            known = fingerprint(scene), ""
        except InputError as error:
            known = "", str(error)
        _fingerprints[scene.session_uid] = known
    return known


def matches(scene: bpy.types.Scene, record: BakeRecord) -> bool:
    """Return whether the bake of ``record`` is one of ``scene`` as it is now."""
    return _fingerprint(scene)[0] in record.fingerprints


def _show_matching(scene: bpy.types.Scene) -> None:
    current, _ = _fingerprint(scene)
    shown = shown_record(scene)
    if shown is not None and current in shown.fingerprints:
        show_bake.detach_misfits(scene, shown)
        return
    for cache in caches_of(scene):
        found = bake_record.matching(cache, current)
        if found is not None and bake_record.playable(found.path):
            show_bake.show(scene, found)
            return
    if shown is not None:
        show_bake.detach_misfits(scene, shown)


def _look(scene: bpy.types.Scene) -> BakeState:
    simulation = scene.physgen.simulation
    current, obstacle = _fingerprint(scene)
    shown = shown_record(scene)
    manifest = bake_record.manifest_of(shown.path) if shown is not None else None
    frames = max(simulation.frame_end - simulation.frame_start + 1, 0)
    job = bake_job(scene)
    if job is not None:
        changed = job.details.get("fingerprint") not in (None, current)
        words = "Changed since the bake began; bake again afterwards" if changed else job.message
        return BakeState("baking", job.done or 0, job.total or frames, advice=words)
    if manifest is None or shown is None:
        status = "missing" if simulation.bake else "none"
        advice = MESSAGES["asks" if blend_trust.is_pending(simulation.bake) else status]
        return BakeState(status, 0, frames, trouble=obstacle or _unreadable(scene), advice=advice)
    done = bake_record.playable(shown.path)
    damage = bake_record.damage(shown.path, manifest, wait=bpy.app.background)
    troubles = show_bake.misfits(scene, shown)
    if damage:
        return BakeState("missing", 0, manifest.frames, trouble=damage, advice=MESSAGES["damaged"])
    advice = ""
    if current not in shown.fingerprints:
        status, owner = "stale", _owner(scene, shown.path)
        if owner is not None:
            advice = f"This bake belongs to the scene {owner.name}. Bake again, and this scene has its own"
    elif is_locked(shown.path) and not is_stopping(scene):
        words = f"Another process is baking this scene. If none is, delete {shown.path / LOCK_FILE}"
        return BakeState("baking", done, manifest.frames, advice=words)
    else:
        status = "baked" if manifest.state == "complete" and done == manifest.frames else "paused"
    return BakeState(
        status, done, manifest.frames, trouble=_sentences(*troubles, obstacle), advice=advice or MESSAGES[status]
    )


def _owner(scene: bpy.types.Scene, folder: Path) -> bpy.types.Scene | None:
    """Return the other scene of which ``scene``, as a copy, shows the bake ``folder``; None if it is its own."""
    if any(folder.is_relative_to(cache) for cache in _own_cache(scene)):
        return None
    others = [other for other in bpy.data.scenes if other != scene]
    return next((o for o in others if shows(o, folder) or any(map(folder.is_relative_to, _own_cache(o)))), None)


def _own_cache(scene: bpy.types.Scene) -> list[Path]:
    """Return the folder of the scene's bakes; none where it has no usable one."""
    with contextlib.suppress(InputError):
        return [paths.scene_cache(scene)]
    return []


def _unreadable(scene: bpy.types.Scene) -> str:
    """Return why the bake that ``scene`` shows cannot be read, or None if it is readable or gone."""
    folder = paths.shown_bake(scene)
    if folder is None or not (folder / MANIFEST_FILE).exists():
        return ""
    try:
        load_manifest(folder)
    except InputError as error:
        return str(error)
    return ""


def shows(scene: bpy.types.Scene, folder: Path) -> bool:
    """Return whether ``scene`` plays the bake ``folder``."""
    return paths.shown_bake(scene) == folder
