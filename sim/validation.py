# SPDX-License-Identifier: MIT
"""Field checks, JSON to dataclasses and back, plain YAML, names, with errors that name the field, value and remedy.

Only the types that the project's own formats use are supported: nested dataclasses, tuples, optional values, strings,
paths, numbers and booleans. Unknown keys are rejected, so that a misspelt field is never silently ignored. YAML is that
of other programs: plain values only, of bounded size. Names are those that scenes and every file system accept.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import types
import typing
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from .errors import InputError
from .files import read_bytes
from .trust import UntrustedSpec


def require(condition: bool, field_name: str, value: object, remedy: str) -> None:
    """Raise InputError, "FIELD is VALUE: REMEDY", unless ``condition`` holds."""
    if not condition:
        raise InputError(f"{field_name} is {_brief(value)}: {remedy}")


def finite(*numbers: float) -> bool:
    """Return whether all ``numbers`` are finite, as 64-bit floats."""
    try:
        return all(math.isfinite(n) for n in numbers)
    except OverflowError:
        return False


def require_range(field_name: str, value: float | None, low: float, high: float, unit: str = "a number") -> None:
    """Raise InputError unless ``value`` is None or lies from ``low`` to ``high``."""
    good = value is None or (finite(value) and low <= value <= high)
    require(good, field_name, value, f"give {unit} from {low:g} to {high:g}")


def quantity(default: Any, low: float, high: float, unit: str = "a number") -> Any:
    """Return a dataclass field with range and unit as metadata, for checks and Blender's properties."""
    return dataclasses.field(default=default, metadata={"range": (low, high), "unit": unit})


def range_of(kind: type, name: str) -> tuple[float, float]:
    """Return the range of the field ``name``, a ``quantity`` of the dataclass ``kind``."""
    low, high = kind.__dataclass_fields__[name].metadata["range"]  # type: ignore[attr-defined]
    return low, high


def require_quantities(item: Any, where: str) -> None:
    """Raise InputError unless every ``quantity`` of ``item`` is None or in range; ``where`` precedes its name."""
    for spec in dataclasses.fields(item):
        if "range" in spec.metadata:
            low, high = spec.metadata["range"]
            require_range(f"{where}{spec.name}", getattr(item, spec.name), low, high, spec.metadata["unit"])


T = TypeVar("T")

MAX_JSON_BYTES = 16 * 2**20
"""Larger files are refused unread; scenes, manifests and jobs are far smaller."""


MOST_WHOLE = 2**63 - 1
"""Whole numbers beyond do not fit the arrays and programs that they go on to."""


def read_json(path: Path, *, folder: Path | None = None) -> Any:
    """Return the parsed JSON file ``path``.

    folder: where the file must lie, links followed. Raises InputError when it is missing, no regular file, too large,
    not UTF-8 or not JSON.
    """
    try:
        content = read_bytes(path, MAX_JSON_BYTES, folder=folder)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    return json_value(content, str(path))


def json_value(content: bytes | str, where: str) -> Any:
    """Return the JSON value in ``content``, UTF-8 or text. Raises InputError, naming ``where``, when it is none."""
    try:
        text = content if isinstance(content, str) else content.decode("utf-8")
        return json.loads(text)
    # Texts of 16 MiB of brackets end in either of the last two.
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{where}: not readable as JSON ({str(error)[:200] or type(error).__name__})") from None


def parse(kind: type[T], value: Any, path: str) -> T:
    """Return the dataclass ``kind`` built from parsed JSON ``value``; ``path`` names it in messages."""
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected an object with fields, found {_brief(value)}")
    hints, fields = _fields_of(typing.cast(typing.Hashable, kind))
    unknown = sorted(set(value) - set(fields))
    if unknown:
        raise InputError(
            f"{path}.{str(unknown[0])[:60]}: unknown field; known are {', '.join(fields)}; "
            "remove it, or update PhysGen if a newer version wrote it"
        )
    arguments = {}
    for name, spec in fields.items():
        if name in value:
            arguments[name] = _convert(hints[name], value[name], f"{path}.{name}")
        elif spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING:
            raise InputError(f"{path}.{name}: missing")
    try:
        return kind(**arguments)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


@functools.cache
def _fields_of(kind: Any) -> tuple[dict[str, Any], dict[str, dataclasses.Field[Any]]]:
    """Return types and fields of a dataclass by name; finding them takes longer than reading a file of a thousand."""
    return typing.get_type_hints(kind), {f.name: f for f in dataclasses.fields(kind)}


def _convert(hint: Any, value: Any, path: str) -> Any:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(next(a for a in arguments if a is not type(None)), value, path)
    if origin is tuple:
        return _convert_tuple(arguments, value, path)
    if dataclasses.is_dataclass(hint):
        return parse(typing.cast(type, hint), value, path)
    if hint is Any:
        return value
    return _convert_scalar(hint, value, path)


def _convert_tuple(arguments: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise InputError(f"{path}: expected a list, found {_brief(value)}")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return tuple(_convert(arguments[0], item, f"{path}[{i}]") for i, item in enumerate(value))
    if len(value) != len(arguments):
        raise InputError(f"{path}: expected {len(arguments)} entries, found {len(value)}")
    return tuple(_convert(a, item, f"{path}[{i}]") for i, (a, item) in enumerate(zip(arguments, value, strict=True)))


def _convert_scalar(hint: Any, value: Any, path: str) -> Any:
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
        raise InputError(f"{path}: expected a finite number, found {_brief(value)}")
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        if abs(value) <= MOST_WHOLE:
            return value
        raise InputError(f"{path}: expected a whole number up to {MOST_WHOLE}, found {_brief(value)}")
    if hint is UntrustedSpec and isinstance(value, str):
        return UntrustedSpec(value)
    if hint in (str, bool) and isinstance(value, hint):
        return value
    if hint is Path and isinstance(value, str) and value and "\0" not in value:
        return Path(value)
    names = {
        UntrustedSpec: "a text",
        float: "a number",
        int: "a whole number",
        str: "a text",
        Path: "the path of a file",
        bool: "true or false",
    }
    raise InputError(f"{path}: expected {names.get(hint, hint)}, found {_brief(value)}")


def _brief(value: Any) -> str:
    try:
        text = repr(value)
    # Python prints no integer of more than 4300 digits, and nothing nested too deeply.
    except (ValueError, RecursionError):
        text = f"a {type(value).__name__} too long to print"
    return text if len(text) <= 60 else text[:57] + "..."


def finite_or_none(value: float) -> float | None:
    """Return ``value``, None where it is not finite, which JSON has no number for."""
    return value if math.isfinite(value) else None


def to_json(value: Any) -> Any:
    """Return the JSON form of a dataclass; ``parse`` returns the equal object."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    return value.as_posix() if isinstance(value, Path) else value


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


def checked_number(value: Any, where: str, low: float, high: float) -> float:
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


def checked_numbers(value: Any, count: int, where: str, limit: float = 1e9) -> tuple[float, ...]:
    """Return ``value`` as ``count`` floats within ±``limit``. Raises InputError for anything else."""
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{where} is {_brief(value)}: expected a list of {count} numbers")
    return tuple(checked_number(entry, f"{where}[{i}]", -limit, limit) for i, entry in enumerate(value))


GROUND = "ground"
"""Name of the ground in ``contacts`` and overrides; no object may have it."""

MAX_NAME_CHARACTERS = 64
MAX_NAME_BYTES = 120
"""In UTF-8; file names have at most 255 bytes, and suffixes are added."""

DEVICES = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))})
"""File names, in lower case, that Windows reserves for devices."""


def valid_names(wanted: Sequence[str]) -> list[str]:
    """Return unique valid object names in the order of ``wanted``, changed as little as possible.

    A name that is valid and not taken by an earlier equal one stays unchanged.
    """
    cleaned = [_cleaned(name) for name in wanted]
    order = sorted(range(len(wanted)), key=lambda i: (cleaned[i] != wanted[i], wanted[i]))
    found = list(cleaned)
    taken: set[str] = set()
    for index in order:
        found[index] = _unique(cleaned[index], taken)
        taken.add(found[index].casefold())
    return found


def may_be_named(name: str) -> bool:
    """Return whether all of ``name`` may be in the name of an object or preset: letters of any script with the marks
    that belong to them (vowels of Hindi, accents that are not composed), digits, spaces, ``_`` and ``-``."""
    return all(c.isalnum() or c in "_- " or unicodedata.category(c).startswith("M") for c in name)


def _cleaned(name: str) -> str:
    composed = unicodedata.normalize("NFC", name)
    allowed = "".join(c if may_be_named(c) else "_" for c in composed).strip()
    cut = _cut(allowed, 0) or "object"
    return f"{cut}_" if cut.casefold() in DEVICES | {GROUND} else cut


def _cut(name: str, reserve: int) -> str:
    """Return the longest prefix of ``name`` within the limits, with ``reserve`` characters to spare."""
    name = name[: MAX_NAME_CHARACTERS - reserve]
    while len(name.encode()) > MAX_NAME_BYTES - reserve:
        name = name[:-1]
    return name.strip()


def _unique(name: str, taken: set[str]) -> str:
    result, number = name, 2
    while result.casefold() in taken:
        ending = f"_{number}"
        result, number = _cut(name, len(ending)) + ending, number + 1
    return result
