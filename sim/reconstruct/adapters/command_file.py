# SPDX-License-Identifier: MIT
"""Command files: TOML files that say how a user's own program is run in place of a stage (docs/extending.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import read_toml as bounded_toml
from ...scene.meshes import MESH_SUFFIXES
from .protocols import MEANINGS, STAGES

MAX_BYTES = 64 * 2**10
MOST_SECONDS = 86_400.0
PLACEHOLDERS = {
    "segmenter": ("input", "boxes", "output"),
    "inpainter": ("input", "mask", "output"),
    "depth_estimator": ("input", "output"),
    "mesher": ("input", "photo", "mask", "output"),
}
ALWAYS = ("here", "python", "program", "program_python")
OUTPUTS = {
    "segmenter": ("masks.npy", (".npy", ".npz", "")),
    "inpainter": ("filled.png", (".png",)),
    "depth_estimator": ("depth.npy", (".npy", ".npz")),
    "mesher": ("mesh.glb", (".glb", ".gltf", ".obj", ".ply", ".stl", "")),
}
"""Default file name of ``{output}``, and its allowed extensions; "": a folder of PNGs."""
_KEYS = ("stage", "command", "output", "folder", "time_limit_s", "environment", "meaning", "description", "results")
_PATTERN = re.compile(r"(?:[A-Za-z0-9_*-][A-Za-z0-9_.*-]*/){0,4}[A-Za-z0-9_*-][A-Za-z0-9_.*-]*")
_PLACEHOLDER = re.compile(r"\{([a-z_]+)\}")


@dataclass(frozen=True, kw_only=True)
class CommandFile:
    """A user's program for one ``stage``.

    command: arguments with placeholders such as ``{input}``. output: file name of ``{output}``. folder: working
    directory; None is the temporary folder of its files. time_limit_s: after which it is killed. environment:
    additional variables. meaning: of a depth, one of ``MEANINGS``.
    results: of a mesher that writes a folder, names or patterns of its mesh; the first that is there counts. program:
    folder of the program, for a file that serves any place.
    """

    path: Path
    stage: str
    command: tuple[str, ...]
    output: str
    folder: Path | None
    time_limit_s: float
    environment: tuple[tuple[str, str], ...]
    meaning: str
    results: tuple[str, ...] = ()
    program: Path | None = None

    def arguments(self, places: dict[str, Path | str]) -> list[str]:
        """Return the command with every placeholder replaced by its value in ``places``."""
        return [_PLACEHOLDER.sub(lambda match: str(places[match[1]]), part) for part in self.command]


def read_command_file(path: Path, stage: str, program: Path | None = None) -> CommandFile:
    """Read and validate the file ``path`` for ``stage`` without running anything. Raises InputError.

    program: folder of the program that it is for, which is then its working folder.
    """
    data = read_toml(path)
    unknown = sorted(set(data) - set(_KEYS))
    if unknown:
        raise InputError(f"{path}: {unknown[0]}: unknown key; known are {', '.join(_KEYS)}")
    if data.get("stage") not in STAGES:
        raise InputError(f"{path}: stage is {_brief(data.get('stage'))}; choose one of {', '.join(STAGES)}")
    if data["stage"] != stage:
        raise InputError(f"{path}: is for the stage {data['stage']}, not for {stage}")
    limit = data.get("time_limit_s", 600)
    if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 < limit <= MOST_SECONDS:
        raise InputError(f"{path}: time_limit_s is {_brief(limit)}; give seconds up to {MOST_SECONDS:g}")
    meaning = data.get("meaning", "relative")
    if meaning not in MEANINGS:
        raise InputError(f"{path}: meaning is {_brief(meaning)}; choose one of {', '.join(MEANINGS)}")
    command, output = _command(data.get("command"), stage, path), _output(data.get("output"), stage, path)
    if program is None and any("{program" in part for part in command):
        raise InputError(f"{path}: command has {{program}}: it is one of the shipped files; name yours by its place")
    return CommandFile(
        path=path,
        stage=stage,
        command=command,
        output=output,
        results=_results(data.get("results"), stage, output, path),
        program=program,
        folder=program or _folder(data.get("folder"), path),
        time_limit_s=float(limit),
        environment=_environment(data.get("environment", {}), path),
        meaning=meaning,
    )


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of the small TOML file ``path``. Raises InputError."""
    try:
        return bounded_toml(path, MAX_BYTES, what="adapter file")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; its contents are described in docs/extending.md") from None


def _command(value: Any, stage: str, path: Path) -> tuple[str, ...]:
    good = isinstance(value, list) and value and all(isinstance(p, str) and "\0" not in p for p in value)
    if not good:
        raise InputError(f"{path}: command: expected a list of arguments, as ['/usr/bin/python3', '{{here}}/fill.py']")
    allowed = PLACEHOLDERS[stage] + ALWAYS
    used = {name for part in value for name in _PLACEHOLDER.findall(part)}
    wrong = sorted(used - set(allowed))
    if wrong:
        raise InputError(f"{path}: command has {{{wrong[0]}}}; of a {stage} there are {{{'}, {'.join(allowed)}}}")
    if "output" not in used or ("input" not in used and "photo" not in used):
        raise InputError(f"{path}: command: has no {{input}} or no {{output}}; it must contain both")
    return tuple(value)


def _output(value: Any, stage: str, path: Path) -> str:
    usual, endings = OUTPUTS[stage]
    if value is None:
        return usual
    good = isinstance(value, str) and re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9]+)?", value)
    if not good or Path(value).suffix.lower() not in endings:
        shown = ", ".join(ending or "none (a folder)" for ending in endings)
        raise InputError(f"{path}: output is {_brief(value)}; give a file name with one of the endings {shown}")
    return str(value)


def _results(value: Any, stage: str, output: str, path: Path) -> tuple[str, ...]:
    wanted = stage == "mesher" and not Path(output).suffix
    if value is None and not wanted:
        return ()
    good = isinstance(value, list) and value and all(isinstance(p, str) and _PATTERN.fullmatch(p) for p in value)
    if not wanted or not good or any(Path(p).suffix.lower() not in MESH_SUFFIXES for p in value):
        raise InputError(
            f"{path}: results is {_brief(value)}; a mesher whose output is a folder has patterns of mesh files in it, "
            "as ['mesh.glb', '*/*_textured.glb'], and nothing else has them"
        )
    return tuple(value)


def _folder(value: Any, path: Path) -> Path | None:
    if value is None:
        return None
    if not isinstance(value, str) or "\0" in value or not (path.resolve().parent / value).is_dir():
        raise InputError(
            f"{path}: folder is {_brief(value)}: there is no such folder; leave it out for a temporary one"
        )
    return path.resolve().parent / value


def _environment(value: Any, path: Path) -> tuple[tuple[str, str], ...]:
    good = isinstance(value, dict) and all(
        isinstance(text, str) and name and not set("=\0") & set(name) and "\0" not in text
        for name, text in value.items()
    )
    if not good:
        raise InputError(f"{path}: environment: expected texts by the names of variables")
    return tuple(sorted(value.items()))


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
