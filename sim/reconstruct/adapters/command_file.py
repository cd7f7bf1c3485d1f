# SPDX-License-Identifier: MIT
"""The TOML file that says how a user's own program is run in place of a stage (docs/adapters.md)."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from .protocols import MEANINGS, STAGES

MAX_BYTES = 64 * 2**10
MOST_SECONDS = 86_400.0
PLACEHOLDERS = {
    "segmenter": ("input", "boxes", "output"),
    "inpainter": ("input", "mask", "output"),
    "depth_estimator": ("input", "output"),
    "mesher": ("input", "photo", "mask", "output"),
}
ALWAYS = ("here", "python")
OUTPUTS = {
    "segmenter": ("masks.npy", (".npy", ".npz", "")),
    "inpainter": ("filled.png", (".png",)),
    "depth_estimator": ("depth.npy", (".npy", ".npz")),
    "mesher": ("mesh.glb", (".glb", ".gltf", ".obj", ".ply", ".stl")),
}
"""What ``{output}`` is called where the file does not say, and the endings it may have; none: a folder of PNGs."""
_KEYS = ("stage", "command", "output", "folder", "time_limit_s", "environment", "meaning", "description")
_PLACEHOLDER = re.compile(r"\{([a-z_]+)\}")


@dataclass(frozen=True, kw_only=True)
class CommandFile:
    """A user's program for one ``stage``.

    command: arguments with placeholders such as ``{input}``. output: file name of ``{output}``. folder: where it runs;
    None is the temporary folder that its files are in. time_limit_s: after which it is killed. environment: variables
    beside ours. meaning: of a depth, one of ``MEANINGS``.
    """

    path: Path
    stage: str
    command: tuple[str, ...]
    output: str
    folder: Path | None
    time_limit_s: float
    environment: tuple[tuple[str, str], ...]
    meaning: str

    def arguments(self, places: dict[str, Path | str]) -> list[str]:
        """The command with every placeholder replaced by its place in ``places``."""
        return [_PLACEHOLDER.sub(lambda match: str(places[match[1]]), part) for part in self.command]


def read_command_file(path: Path, stage: str) -> CommandFile:
    """Read and check the file ``path`` for ``stage``; nothing is run. Raises InputError."""
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
    return CommandFile(
        path=path,
        stage=stage,
        command=_command(data.get("command"), stage, path),
        output=_output(data.get("output"), stage, path),
        folder=_folder(data.get("folder"), path),
        time_limit_s=float(limit),
        environment=_environment(data.get("environment", {}), path),
        meaning=meaning,
    )


def read_toml(path: Path) -> dict[str, Any]:
    """The content of the small TOML file ``path``. Raises InputError."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES >> 10} KiB, so this describes no adapter")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; docs/adapters.md says what to write into it") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from None


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
        raise InputError(f"{path}: command: has no {{input}} or no {{output}}; it must be told where both are")
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
