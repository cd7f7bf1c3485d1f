# SPDX-License-Identifier: MIT
"""Material presets: TOML files in ``presets/materials``, one a preset, overridable field by field."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path

from ..errors import InputError
from .json_fields import parse
from .model import Material

PRESET_FOLDER = Path(__file__).resolve().parents[2] / "presets" / "materials"


def preset_names() -> list[str]:
    """Names of all shipped presets, sorted."""
    return sorted(path.stem for path in PRESET_FOLDER.glob("*.toml"))


def load_preset(name: str) -> Material:
    """The preset ``name``. Raises InputError when there is none of that name."""
    if name not in preset_names():
        raise InputError(
            f"material preset {name!r}: there is none of that name; choose one of {', '.join(preset_names())}"
        )
    path = PRESET_FOLDER / f"{name}.toml"
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not readable as TOML ({error})") from None
    data.pop("description", None)
    data.pop("source", None)
    return dataclasses.replace(parse(Material, data, str(path)), preset=name)
