# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blender side of PhysGen. ``bridge`` is bpy without any user interface; the rest is the interface.

``props`` is what Blender remembers, ``operators`` what it can do, ``panels`` what people see, ``jobs`` long work.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

MODULES = (
    "props.preferences",
    "props.body",
    "props.rendering",
    "props.scene",
    "props.photo",
    "props.diagnose",
    "props.together",
    "jobs",
    "operators.check_python",
    "operators.import_scene",
    "operators.import_splats",
    "operators.photo",
    "operators.draw_box",
    "operators.paint_mask",
    "operators.set_horizon",
    "operators.reconstruct",
    "operators.body",
    "operators.material",
    "operators.effect_stack",
    "operators.world",
    "operators.bake",
    "operators.cache",
    "operators.render",
    "operators.share",
    "operators.capture",
    "operators.diagnose",
    "operators.effect",
    "operators.together",
    "preview.live",
    "operators.preview",
    "gizmos",
    "handlers",
    "panels.photo",
    "panels.scene",
    "panels.correct",
    "panels.objects",
    "panels.together",
    "panels.motion",
    "panels.world",
    "panels.simulate",
    "panels.render",
    "panels.diagnose",
)
"""All that Blender must know, in the order in which it must learn it; each has CLASSES, some a ``register`` too."""


def _modules() -> list[ModuleType]:
    """Imported late, because this package is also there without bpy."""
    return [import_module(f".{name}", __package__) for name in MODULES]


def register() -> None:
    """Called by Blender when the extension is enabled."""
    import bpy

    for module in _modules():
        for kind in module.CLASSES:
            bpy.utils.register_class(kind)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled; running jobs are cancelled."""
    import bpy

    for module in reversed(_modules()):
        if hasattr(module, "unregister"):
            module.unregister()
        for kind in reversed(module.CLASSES):
            bpy.utils.unregister_class(kind)
