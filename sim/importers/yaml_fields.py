# SPDX-License-Identifier: MIT
"""YAML files of other programs: plain values only, of bounded size; and checked numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import read_bytes

MAX_YAML_BYTES = 64 * 2**10
"""Larger files are refused unread: the settings of a simulation are a few kilobytes, and the parser is slow."""


def read_yaml(path: Path) -> Any:
    """Return the content of the YAML file ``path``: dicts, lists, strings, numbers, booleans, None.

    Aliases are refused, because a few lines of them can expand to billions of values; so are tags of Python objects.
    Raises InputError, also where PyYAML is missing.
    """
    # Late: Blender's own Python, which lists folders with this package, lacks it.
    try:
        import yaml
    except ModuleNotFoundError:
        raise InputError(f"{path}: reading YAML needs the Python package PyYAML; run `make setup`") from None

    class PlainLoader(yaml.SafeLoader):  # type: ignore[misc]
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise InputError(f"{path}: has an alias (*{self.peek_event().anchor}); write out the value")
            return super().compose_node(parent, index)

    try:
        text = read_bytes(path, MAX_YAML_BYTES, what="file of settings").decode("utf-8-sig")
        return yaml.load(text, Loader=PlainLoader)  # noqa: S506 - a SafeLoader
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    # ValueError: impossible dates and numbers such as 2001-99-99; not UTF-8.
    except (yaml.YAMLError, ValueError, OverflowError, TypeError, AttributeError, RecursionError) as error:
        words = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not readable as YAML ({words})") from None


def number(value: Any, where: str, low: float, high: float) -> float:
    """Return ``value`` as a float from ``low`` to ``high``. Raises InputError, naming ``where``, for anything else.

    Numeric strings are accepted, because PyYAML reads ``5.0e4``, whose exponent has no sign, as a string.
    """
    result = math.nan
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            result = float(value)
        except (ValueError, OverflowError):
            result = math.nan
    if not low <= result <= high:
        raise InputError(f"{where} is {_brief(value)}: expected a number from {low:g} to {high:g}")
    return result


def numbers(value: Any, count: int, where: str, limit: float = 1e9) -> tuple[float, ...]:
    """Return ``value`` as ``count`` floats within ±``limit``. Raises InputError for anything else."""
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{where} is {_brief(value)}: expected a list of {count} numbers")
    return tuple(number(entry, f"{where}[{i}]", -limit, limit) for i, entry in enumerate(value))


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
