# SPDX-License-Identifier: GPL-3.0-or-later
"""What a person is told when an operator cannot do what it was asked."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import bpy

from ..sim.errors import PhysGenError

Execute = Callable[[Any, bpy.types.Context], set[str]]


def reports_errors(execute: Execute) -> Execute:
    """Let an operator's ``execute`` report a PhysGenError as its message and be cancelled."""

    # Blender counts the arguments, so they are named.
    @functools.wraps(execute)
    def guarded(self: bpy.types.Operator, context: bpy.types.Context) -> set[str]:
        try:
            return execute(self, context)
        except PhysGenError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    return guarded
