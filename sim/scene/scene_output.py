# SPDX-License-Identifier: MIT
"""Write a scene folder atomically: it appears whole or not at all, with the checksums of its files.

``checksums.json`` is written when the folder is made. ``scene.json`` is for people to edit and has none; what is added
later has none either. A file that differs is damaged, or was edited on purpose: the two look the same, so it is
reported and nothing is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..atomic import recover, replacing_tree, write_json
from ..checksums import DAMAGED, MISSING, OK, UNKNOWN, FileState, file_sum
from ..errors import InputError
from ..files import is_file
from ..folder_lock import lock_beside
from ..validation import read_json
from .folder import SCENE_FILE, Scene, inside

SUMS_FILE = "checksums.json"
SUMS_FORMAT = "physgen-checksums/1"
MOST_FILES = 100_000
_WITHOUT = (SCENE_FILE, SUMS_FILE)
_CACHED = "stages"


def write_scene_sums(folder: Path) -> None:
    """Write the checksums of all files in the scene ``folder``, but for cached stages, which have their own."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    names = [path.relative_to(folder).as_posix() for path in files]
    kept = [name for name in names if name not in _WITHOUT and not name.startswith((".", f"{_CACHED}/"))]
    sums = {name: file_sum(folder / name) for name in kept}
    write_json(folder / SUMS_FILE, {"format": SUMS_FORMAT, "files": sums})


def scene_sums(root: Path) -> dict[str, str]:
    """Return the checksums of the scene folder ``root`` by file; none where it has none, or they are unreadable."""
    try:
        data = read_json(root / SUMS_FILE, folder=root)
    except InputError:
        return {}
    files = data.get("files") if isinstance(data, dict) and data.get("format") == SUMS_FORMAT else None
    if not isinstance(files, dict) or len(files) > MOST_FILES:
        return {}
    return {str(name): str(found) for name, found in files.items()}


def check_scene(scene: Scene, names: Iterable[str] | None = None) -> list[FileState]:
    """Return the state of the files ``names`` of ``scene``; None: of all that it has a checksum for, or needs."""
    known = scene_sums(scene.root)
    wanted = list(dict.fromkeys([*known, *scene.files()])) if names is None else list(names)
    return [_state(scene.root, name, known.get(name)) for name in wanted]


def changed_files(scene: Scene, names: Iterable[str]) -> list[str]:
    """Return those of ``names`` that are not what was written when the scene was made."""
    return [state.file for state in check_scene(scene, names) if state.state == DAMAGED]


def _state(root: Path, name: str, known: str | None) -> FileState:
    try:
        path = inside(root, name)
        if not is_file(path):
            return FileState(file=name, state=MISSING)
        if known is None:
            return FileState(file=name, state=UNKNOWN)
        same = file_sum(path) == known
    except (InputError, OSError) as error:
        return FileState(file=name[:200], state=DAMAGED, text=str(error)[:200])
    return (
        FileState(file=name, state=OK)
        if same
        else FileState(
            file=name, state=DAMAGED, text="is not what was written when the scene was made: damaged, or edited"
        )
    )


STAMP_FILE, COMPOSE_FILE, PHYSICS_FILE = "reconstruct.json", "compose.json", "physics.json"
"""Records in a scene folder: of its reconstruction, of its composition, of where each object's material comes from."""
FOLDER_KINDS = {
    STAMP_FILE: "a reconstruction",
    COMPOSE_FILE: "a composition",
    SCENE_FILE: "a scene",
    "manifest.json": "a bake",
    "capture.json": "a capture",
}
"""Kind of a folder that holds a file of this name."""


def folder_kind(folder: Path, files: Iterable[str] = tuple(FOLDER_KINDS)) -> str | None:
    """Return what ``folder`` is ("a bake"), by the first of ``files`` in it; None without any."""
    return next((FOLDER_KINDS[name] for name in files if (folder / name).is_file()), None)


OWN_ENTRIES = frozenset(
    (
        SCENE_FILE,
        STAMP_FILE,
        PHYSICS_FILE,
        "photo.png",
        "background.png",
        "masks",
        "full",
        "shadows",
        "holes",
        "meshes",
        "splats",
        "albedo",
        "shading",
        COMPOSE_FILE,
        SUMS_FILE,
        "light",
        "stages",
        "report.html",
    )
)
"""Entries of a scene folder; any other file is foreign, and the folder is then not replaced."""


def _require_own(out: Path) -> None:
    names = {path.name for path in out.iterdir()}
    foreign = sorted(names - OWN_ENTRIES)
    if foreign:
        raise InputError(
            f"{out}: contains files that are not part of a scene folder ({foreign[0]}); choose an empty or new folder"
        )
    if names:
        try:
            data = read_json(out / SCENE_FILE)
        except InputError:
            data = None
        if not isinstance(data, dict) or not str(data.get("format", "")).startswith("physgen-scene/"):
            raise InputError(
                f"{out}: contains files that are not part of a scene folder ({SCENE_FILE}); choose an empty one"
            )


@contextmanager
def replacing_folder(out: Path) -> Iterator[Path]:
    """Yield a fresh temporary folder beside ``out``; on success it becomes ``out``, on failure it is removed.

    ``out`` is held by this thread meanwhile (``lock_beside``), and exchanged at the end (``replacing_tree``). An
    existing ``out`` is only replaced when it is empty or a scene folder, so that a mistyped path cannot destroy files.
    Raises InputError otherwise, or when the location cannot be written.
    """
    out = out.resolve()
    try:
        with lock_beside(out):
            recover(out)
            if out.is_dir():
                _require_own(out)
            elif out.exists() or out.is_symlink():
                raise InputError(f"{out}: is a file; choose a folder")
            with replacing_tree(out) as partial:
                yield partial
                write_scene_sums(partial)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
