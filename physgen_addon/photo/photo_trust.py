# SPDX-License-Identifier: GPL-3.0-or-later
"""What a .blend file from somebody else would have read beside its own folder: asked about before a reconstruction.

Values that were set in this session are the user's word, and so are files that they saved. Of a file that is opened,
every path that leads out of its folder waits for the answer, unless its content is in the user's list (``sim/trust``).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import bpy

from ...sim.trust import READS, Claim, NotTrusted, remember, trusted_keys

_came: set[Claim] = set()
"""Claims of the open file that nobody has agreed to; stored in no file."""


def _paths(scene: bpy.types.Scene) -> Iterator[tuple[str, str]]:
    state = scene.physgen_photo
    yield "photo", state.path
    yield "depth", state.depth
    yield "scene folder", state.output
    for box in state.boxes:
        yield f"{box.name}: mesh", box.mesh


def _claims(scene: bpy.types.Scene) -> list[Claim]:
    """Return all that the photo panel's settings of ``scene`` name outside the folder of the file."""
    home = Path(bpy.data.filepath).resolve().parent if bpy.data.filepath else None
    found = []
    for where, text in _paths(scene):
        if not text.strip():
            continue
        path = Path(bpy.path.abspath(text.strip())).resolve()
        if home is None or not path.is_relative_to(home):
            found.append(Claim(READS, where, str(path)))
    return found


def _key(claims: list[Claim]) -> str:
    return hashlib.sha256("\n".join(claim.line() for claim in sorted(claims)).encode()).hexdigest()


def note_loaded() -> None:
    """Remember what the file that was just opened asks for; called after every load."""
    _came.clear()
    if not bpy.data.filepath:
        return
    keys = trusted_keys()
    for scene in bpy.data.scenes:
        claims = _claims(scene)
        if claims and _key(claims) not in keys:
            _came.update(claims)


def note_saved() -> None:
    """Count the file that was just saved as the user's own, where nothing in it waits for an answer."""
    for scene in bpy.data.scenes:
        claims = _claims(scene)
        if claims and not _came.intersection(claims):
            remember(_key(claims), Path(bpy.data.filepath))


def pending(scene: bpy.types.Scene) -> list[Claim]:
    """Return what ``scene`` would have read that came with the file, and that the user has not agreed to."""
    return [claim for claim in _claims(scene) if claim in _came]


def agree(scene: bpy.types.Scene) -> None:
    """Take the user's word for all that ``pending`` names, now and the next time."""
    claims = _claims(scene)
    _came.difference_update(claims)
    if bpy.data.filepath:
        remember(_key(claims), Path(bpy.data.filepath))


def require_agreed(scene: bpy.types.Scene) -> None:
    """Raise NotTrusted if anything is pending."""
    claims = pending(scene)
    if claims:
        lines = "; ".join(claim.line() for claim in claims)
        raise NotTrusted(
            f"this file came with settings that read outside its folder, and you have not agreed to them: {lines}; "
            "press Reconstruct in the photo panel to be asked, or choose the files anew",
            claims,
        )
