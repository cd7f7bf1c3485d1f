# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blender side of PhysGen. ``bridge`` is bpy without any user interface.

This version brings no panels yet: enabling the extension adds nothing to Blender's interface, and the stages run from
the ``physgen`` command and ``batch/render.py``.
"""


def register() -> None:
    """Called by Blender when the extension is enabled; there is nothing to register yet."""


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
