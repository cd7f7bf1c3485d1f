# SPDX-License-Identifier: MIT
"""Material presets: one TOML file each, shipped in ``presets/materials`` or of one's own."""

from __future__ import annotations

import dataclasses
import itertools
import json
import tomllib
import unicodedata
from pathlib import Path

from ..atomic import replacing
from ..errors import InputError
from .json_fields import parse
from .matter import Material
from .names import DEVICES

PRESET_FOLDER = Path(__file__).resolve().parents[2] / "presets" / "materials"
MAX_PRESET_BYTES = 64 * 2**10
MAX_PRESETS = 500
"""More files in a folder of presets are not read."""

_RESERVED = DEVICES | {"custom"}
"""``custom`` stands for no preset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PresetFolder:
    """What a folder of presets holds: ``good`` by name, and what is wrong with each of the ``broken``.

    descriptions: what the good ones say of themselves; may be empty.
    """

    good: dict[str, Material] = dataclasses.field(default_factory=dict)
    descriptions: dict[str, str] = dataclasses.field(default_factory=dict)
    broken: dict[str, str] = dataclasses.field(default_factory=dict)


def preset_names() -> list[str]:
    """Names of all shipped presets, sorted."""
    return sorted(path.stem for path in PRESET_FOLDER.glob("*.toml"))


def load_preset(name: str) -> Material:
    """The shipped preset ``name``. Raises InputError when there is none of that name."""
    if name not in preset_names():
        raise InputError(
            f"material preset {name!r}: there is none of that name; choose one of {', '.join(preset_names())}"
        )
    return _read(PRESET_FOLDER / f"{name}.toml")[0]


def read_presets(folder: Path) -> PresetFolder:
    """All presets in ``folder``, sorted by name; none where there is no such folder.

    A file that cannot be used is named among the broken and spoils nothing else.
    """
    found = PresetFolder()
    try:
        paths = sorted(itertools.islice((p for p in folder.glob("*.toml") if not p.name.startswith(".")), MAX_PRESETS))
    except OSError:
        return found
    for path in paths:
        name = unicodedata.normalize("NFC", path.stem)
        try:
            check_preset_name(name)
            material, description = _read(path)
        except InputError as error:
            found.broken[name] = str(error)
        else:
            found.good[name], found.descriptions[name] = material, description
    return found


def check_preset_name(name: str) -> None:
    """Raise InputError unless a file on any system can be called ``name``."""
    good = 0 < len(name) <= 48 and name == name.strip() and all(c.isalnum() or c in "_- " for c in name)
    if not good:
        raise InputError(f"preset name {name!r}: use up to 48 letters, digits, spaces, '_' and '-'")
    if name.casefold() in _RESERVED:
        raise InputError(f"preset name {name!r}: is taken by the system; choose another")


def save_preset(folder: Path, name: str, material: Material, description: str = "") -> Path:
    """Write ``material`` as a preset of one's own; one of the same name is replaced.

    Raises InputError for a name that no file can have or that is a shipped preset's, and where nothing can be written.
    """
    name = unicodedata.normalize("NFC", name)
    check_preset_name(name)
    if name.casefold() in (shipped.casefold() for shipped in preset_names()):
        raise InputError(f"preset name {name!r}: is a preset that PhysGen brings; choose another")
    values = dataclasses.asdict(material)
    del values["preset"]
    lines = [f"{key} = {_toml(value)}" for key, value in {"description": description, **values}.items()]
    path = folder / f"{name}.toml"
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def delete_preset(folder: Path, name: str) -> None:
    """Delete the preset ``name`` of one's own, which may be broken; InputError when it is not there or stays."""
    for path in folder.glob("*.toml"):
        if unicodedata.normalize("NFC", path.stem) == name:
            try:
                path.unlink()
            except OSError as error:
                raise InputError(f"{path}: cannot be deleted ({error.strerror or error})") from error
            return
    raise InputError(f"{folder}: holds no preset {name!r}; it may be deleted already")


def _read(path: Path) -> tuple[Material, str]:
    try:
        if path.stat().st_size > MAX_PRESET_BYTES:
            raise InputError(f"{path}: larger than {MAX_PRESET_BYTES >> 10} KiB, so this is no material preset")
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from None
    description = data.pop("description", "")
    data.pop("source", None)
    data.pop("preset", None)
    return dataclasses.replace(parse(Material, data, str(path)), preset=path.stem), str(description)[:500]


def _toml(value: float | str | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(number) for number in value)}]"
    # A JSON string is a TOML string but for one character that JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F") if isinstance(value, str) else repr(value)
