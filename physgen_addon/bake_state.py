# SPDX-License-Identifier: GPL-3.0-or-later
"""How it stands with a scene's bake, told from what is on disk and what the scene is now.

A bake is found by the scene's fingerprint, so undo, redo, a crash or another file never lose one: whichever bake is of
the scene as it is now gets shown.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

from ..sim.cache.lock import LOCK_FILE, is_written
from ..sim.cache.manifest import MANIFEST_FILE, load_manifest
from ..sim.errors import InputError
from . import bake_record, jobs, paths
from .bake_record import BakeRecord
from .bridge import playback
from .bridge.fingerprint import fingerprint
from .props.body import bodies

BAKE_OPERATOR = "physgen.bake"
MESSAGES = {
    "none": "Nothing is baked yet",
    "baked": "",
    "paused": "Stopped before the end. Resume goes on from there",
    "stale": "Out of date: something has changed since. Bake again, or undo the change",
    "missing": "The bake is not where it was. Find its folder, or bake again",
    "damaged": "Files of the bake are gone or damaged. Bake again, or find an undamaged copy",
}


@dataclass(frozen=True)
class BakeState:
    """How it stands with a scene's bake.

    status: ``none``, ``baking``, ``paused`` (there is more to bake), ``baked``, ``stale`` (of the scene as it was) or
    ``missing`` (its files are gone or damaged). frames_done of frames can be played. disk_bytes: of all bakes of the
    scene. trouble: what went wrong; advice: how it stands and what to do. estimate_text: what baking will cost; empty
    when that is not known.
    """

    status: str = "none"
    frames_done: int = 0
    frames: int = 0
    disk_bytes: int = 0
    trouble: str = ""
    advice: str = ""
    estimate_text: str = ""

    @property
    def message(self) -> str:
        """All that a person should know."""
        return _sentences(self.trouble, self.advice)


def _sentences(*parts: str) -> str:
    return ". ".join(part.rstrip(" .") for part in parts if part)


_known: dict[int, BakeState] = {}
"""By the scene's session_uid, which undo keeps."""
_dirty: set[int] = set()
_fingerprints: dict[int, tuple[str, str]] = {}
"""Of scenes that have not changed since."""
_changed_at = [0.0]
_troubles: dict[int, str] = {}
"""Why the last bake of a scene stopped; until the next one begins."""


def state(scene: bpy.types.Scene) -> BakeState:
    """How it stands. Costs microseconds in Blender's interface, where a timer keeps it up to date."""
    known = _known.get(scene.session_uid)
    # Timers never fire in the background, and without an interface nobody is in a hurry.
    if known is not None and not bpy.app.background:
        return known
    waits = is_dirty(scene)
    found = observe(scene)
    if waits:
        # A panel that is drawn first must not keep the timer from showing the bake that it will find.
        _dirty.add(scene.session_uid)
    return found


def last_seen(scene: bpy.types.Scene) -> BakeState | None:
    """How it stood when it was last looked at; None when it never was."""
    return _known.get(scene.session_uid)


def mark_dirty(scene: bpy.types.Scene | None = None) -> None:
    """Something may have changed, in ``scene`` or anywhere."""
    _changed_at[0] = time.monotonic()
    for item in [scene] if scene is not None else bpy.data.scenes:
        _dirty.add(item.session_uid)
        _fingerprints.pop(item.session_uid, None)


def mark_progress(scene: bpy.types.Scene) -> None:
    """The bake of ``scene`` has got further; the scene is as it was."""
    _dirty.add(scene.session_uid)


def forget() -> None:
    """Another file is open."""
    _known.clear()
    _dirty.clear()
    _fingerprints.clear()
    _troubles.clear()


def set_trouble(scene: bpy.types.Scene, message: str) -> None:
    """Remember why the bake of ``scene`` stopped; empty when a new one begins."""
    _troubles[scene.session_uid] = message
    mark_dirty(scene)


def rest_s() -> float:
    """Seconds since anything changed: while somebody drags or sculpts, nothing is looked at."""
    return time.monotonic() - _changed_at[0]


def is_dirty(scene: bpy.types.Scene) -> bool:
    """Whether ``scene`` may have changed since it was last looked at."""
    return scene.session_uid in _dirty or scene.session_uid not in _known


def bake_job(scene: bpy.types.Scene) -> jobs.Job | None:
    """The bake of ``scene`` that is under way in this Blender."""
    job = jobs.running()
    return job if job is not None and (job.operator, job.scene) == (BAKE_OPERATOR, scene.session_uid) else None


def is_stopping(scene: bpy.types.Scene) -> bool:
    """Whether a bake of ``scene`` was stopped and its worker still puts things in order."""
    return any((job.operator, job.scene) == (BAKE_OPERATOR, scene.session_uid) for job in jobs.stopping())


def shown_record(scene: bpy.types.Scene) -> BakeRecord | None:
    """The record of the bake that ``scene`` shows; None when there is none, or its files are gone."""
    folder = paths.shown_bake(scene)
    return None if folder is None or bake_record.manifest_of(folder) is None else record_of(scene, folder)


def record_of(scene: bpy.types.Scene, folder: Path) -> BakeRecord:
    """The record of the bake ``folder``; where it is gone, what would do for ``scene``."""
    return bake_record.read_record(folder) or BakeRecord(
        folder=str(folder), frame_start=scene.physgen.simulation.frame_start
    )


def caches_of(scene: bpy.types.Scene) -> list[Path]:
    """Folders in which bakes of ``scene`` may be: where it would bake now, and beside the bake it shows."""
    found = []
    with contextlib.suppress(InputError):
        found.append(paths.scene_cache(scene))
    folder = paths.shown_bake(scene)
    if folder is not None and folder.parent.name == bake_record.BAKES and folder.parent.parent not in found:
        found.append(folder.parent.parent)
    return found


def concerns(scene: bpy.types.Scene) -> bool:
    """Whether there is anything to bake in ``scene``, or a bake; other people's files cost nothing."""
    return bool(scene.physgen.simulation.bake) or bool(bodies(scene))


def refresh(scene: bpy.types.Scene) -> BakeState:
    """Show the bake of the scene as it is now, if there is one, and say how it stands. May change the scene."""
    if concerns(scene) and bake_job(scene) is None:
        try:
            _show_matching(scene)
        except InputError as error:
            set_trouble(scene, str(error))
    return observe(scene)


def observe(scene: bpy.types.Scene) -> BakeState:
    """Say how it stands, and remember it; changes nothing."""
    found = _look(scene) if concerns(scene) else BakeState(advice=MESSAGES["none"])
    trouble = _troubles.get(scene.session_uid, "")
    if trouble and found.status != "baking":
        found = replace(found, trouble=_sentences(trouble, found.trouble))
    simulation = scene.physgen.simulation
    found = replace(
        found,
        disk_bytes=sum(bake_record.disk_bytes(cache) for cache in caches_of(scene)),
        estimate_text=simulation.estimate
        if simulation.estimate and simulation.estimate_of == _fingerprint(scene)[0]
        else "",
    )
    _known[scene.session_uid] = found
    _dirty.discard(scene.session_uid)
    if found.status == "baking":
        # It will change by itself: a worker that was killed leaves a child, which ends a moment later.
        mark_progress(scene)
    return found


def _fingerprint(scene: bpy.types.Scene) -> tuple[str, str]:
    """Of the scene as it is; empty, and why, when that cannot be told."""
    known = _fingerprints.get(scene.session_uid)
    # Nobody tells of changes in the background.
    if known is None or bpy.app.background:
        try:
            known = fingerprint(scene), ""
        except InputError as error:
            known = "", str(error)
        _fingerprints[scene.session_uid] = known
    return known


def _show_matching(scene: bpy.types.Scene) -> None:
    current, _ = _fingerprint(scene)
    shown = shown_record(scene)
    if shown is not None and current in shown.fingerprints:
        playback.detach_misfits(scene, shown)
        return
    for cache in caches_of(scene):
        found = bake_record.matching(cache, current)
        if found is not None and bake_record.playable(found.path):
            playback.show(scene, found)
            return
    if shown is not None:
        playback.detach_misfits(scene, shown)


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
        return BakeState(status, 0, frames, trouble=obstacle or _unreadable(scene), advice=MESSAGES[status])
    done = bake_record.playable(shown.path)
    damage = bake_record.damage(shown.path, manifest)
    troubles = playback.misfits(scene, shown)
    if damage:
        return BakeState("missing", 0, manifest.frames, trouble=damage, advice=MESSAGES["damaged"])
    if current not in shown.fingerprints:
        status = "stale"
    elif is_written(shown.path) and not is_stopping(scene):
        words = f"Another process is baking this. If none is, delete {shown.path / LOCK_FILE}"
        return BakeState("baking", done, manifest.frames, advice=words)
    else:
        status = "baked" if manifest.state == "complete" and done == manifest.frames else "paused"
    return BakeState(status, done, manifest.frames, trouble=_sentences(*troubles, obstacle), advice=MESSAGES[status])


def _unreadable(scene: bpy.types.Scene) -> str:
    """Why the bake that ``scene`` shows cannot be read, where it is still there."""
    folder = paths.shown_bake(scene)
    if folder is None or not (folder / MANIFEST_FILE).exists():
        return ""
    try:
        load_manifest(folder)
    except InputError as error:
        return str(error)
    return ""


def shows(scene: bpy.types.Scene, folder: Path) -> bool:
    """Whether ``scene`` plays the bake ``folder``."""
    return paths.shown_bake(scene) == folder
