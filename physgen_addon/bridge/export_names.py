# SPDX-License-Identifier: GPL-3.0-or-later
"""Names that Blender allows and a scene folder does not: dots, slashes, 255 bytes, names that a file may not have."""

from __future__ import annotations

import bpy

from ...sim.errors import InputError
from ...sim.scene.names import fitting_names
from ..props.body import bodies


def export_names(scene: bpy.types.Scene) -> dict[str, str]:
    """The name in the scene folder of every body of ``scene``, by its name in Blender.

    An object whose name can stay keeps it, whatever the others are called. Raises InputError where two bodies share a
    name, which only objects of linked files can.
    """
    found = [item.name for item in bodies(scene)]
    for name in found:
        if found.count(name) > 1:
            raise InputError(f"two objects are called {name!r}, one of them is of a linked file: rename the other")
    return dict(zip(found, fitting_names(found), strict=True))
