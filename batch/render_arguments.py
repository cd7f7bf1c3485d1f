# SPDX-License-Identifier: GPL-3.0-or-later
"""``RenderOptions`` from flags of a command line: the same for ``physgen render`` and ``batch/render.py``."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..physgen_addon.bridge.option_flags import flagged_fields
from ..physgen_addon.bridge.options import RenderOptions


def add_render_options(parser: argparse.ArgumentParser) -> None:
    """How frames are rendered."""
    for item, flag, kind in flagged_fields():
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
    values = {item.name: getattr(options, item.name) for item, _, _ in flagged_fields()}
    if values["camera"] is not None:
        # The process that renders may have another working folder.
        values["camera"] = str(Path(values["camera"]).absolute())
    return RenderOptions(**values)
