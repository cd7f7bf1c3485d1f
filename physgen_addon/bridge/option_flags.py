# SPDX-License-Identifier: GPL-3.0-or-later
"""``RenderOptions`` as flags of a command line: for those who start ``batch/render.py``. Needs no bpy."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any

from .options import RenderOptions


def flagged_fields() -> Iterator[tuple[dataclasses.Field[Any], str, type]]:
    """Every option that has a flag, with that flag and its type (of ``float | None``, float)."""
    hints = typing.get_type_hints(RenderOptions)
    for item in dataclasses.fields(RenderOptions):
        kind = hints[item.name]
        if isinstance(kind, types.UnionType):
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        if "help" in item.metadata:
            yield item, f"--{item.name.replace('_', '-')}", kind


def render_arguments(options: RenderOptions) -> list[str]:
    """Flags that say ``options``; what is the default is left out."""
    arguments = []
    for item, flag, kind in flagged_fields():
        value = getattr(options, item.name)
        if value == item.default:
            continue
        if kind is bool:
            arguments.append(flag if value else f"--no-{flag[2:]}")
        else:
            # One word, so that a negative number is no flag.
            arguments.append(f"{flag}={value!r}" if kind is not str else f"{flag}={value}")
    return arguments
