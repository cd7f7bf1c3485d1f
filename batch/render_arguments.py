# SPDX-License-Identifier: GPL-3.0-or-later
"""``RenderOptions`` as flags of a command line, and back: the same for ``physgen render`` and ``batch/render.py``."""

from __future__ import annotations

import argparse
import dataclasses
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..physgen_addon.bridge.options import RenderOptions


def _fields() -> Iterator[tuple[dataclasses.Field[Any], str, type]]:
    """Every option that has a flag, with that flag and its type (of ``float | None``, float)."""
    hints = typing.get_type_hints(RenderOptions)
    for item in dataclasses.fields(RenderOptions):
        kind = hints[item.name]
        if isinstance(kind, types.UnionType):
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        if "help" in item.metadata:
            yield item, f"--{item.name.replace('_', '-')}", kind


def add_render_options(parser: argparse.ArgumentParser) -> None:
    """How frames are rendered."""
    for item, flag, kind in _fields():
        text, default = item.metadata["help"], item.default
        if kind is bool:
            text += f" (default: {'on' if default else 'off'})"
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=default, help=text)
            continue
        if default is not None:
            text += f" (default {default:g})" if isinstance(default, float) else f" (default {default})"
        choices, metavar = item.metadata["choices"], item.metadata["metavar"]
        parser.add_argument(flag, type=kind, default=default, choices=choices, metavar=metavar, help=text)


def render_options(options: argparse.Namespace) -> RenderOptions:
    """The options that were given. Raises InputError for a value out of its range."""
    values = {item.name: getattr(options, item.name) for item, _, _ in _fields()}
    if values["camera"] is not None:
        # The process that renders may have another working folder.
        values["camera"] = str(Path(values["camera"]).absolute())
    return RenderOptions(**values)


def render_arguments(options: RenderOptions) -> list[str]:
    """Flags that say ``options``; what is the default is left out."""
    arguments = []
    for item, flag, kind in _fields():
        value = getattr(options, item.name)
        if value == item.default:
            continue
        if kind is bool:
            arguments.append(flag if value else f"--no-{flag[2:]}")
        else:
            # One word, so that a negative number is no flag.
            arguments.append(f"{flag}={value!r}" if kind is not str else f"{flag}={value}")
    return arguments
