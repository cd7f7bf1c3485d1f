# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blender side of PhysGen.

Without user interface: ``scene_io``, ``playback``, ``photo``, ``render``, ``frames``. With it: ``props`` (stored in
.blend files), ``operators``, ``panels``, ``preview``, ``background_jobs``, ``handlers``, ``gizmos``.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import FunctionType, ModuleType

MODULES = (
    "props.preferences",
    "props.material_props",
    "props.body_props",
    "props.render_props",
    "props.scene_props",
    "props.photo_props",
    "props.diagnose_props",
    "background_jobs",
    "operators.install_ops",
    "operators.import_ops",
    "operators.photo_ops",
    "operators.reconstruct_ops",
    "operators.mask_horizon_ops",
    "operators.photo_object_ops",
    "operators.body_ops",
    "operators.world_ops",
    "operators.bake_ops",
    "operators.bake_cache_ops",
    "operators.render_ops",
    "operators.export_ops",
    "operators.farm_ops",
    "operators.diagnose_ops",
    "operators.effect_ops",
    "operators.compose_ops",
    "preview.live_preview",
    "operators.asset_ops",
    "operators.quick_ops",
    "gizmos",
    "overlays",
    "handlers",
    "panels.photo_panel",
    "panels.scene_panel",
    "panels.objects_panel",
    "panels.motion_panel",
    "panels.physics_panel",
    "panels.world_panel",
    "panels.simulate_panel",
    "panels.render_panel",
    "panels.diagnose_panel",
)
"""Modules that register something with Blender, in order of registration."""


def _modules() -> list[ModuleType]:
    """Return the modules, imported late: this package is also importable without bpy."""
    return [import_module(f".{name}", __package__) for name in MODULES]


def registered_classes(module: ModuleType) -> list[type]:
    """Return the Blender classes of ``module`` (named ``PHYSGEN_…``), in order of definition."""
    return [
        item
        for name, item in vars(module).items()
        if name.startswith("PHYSGEN_") and isinstance(item, type) and item.__module__ == module.__name__
    ]


def _tell_in_one_line(kind: type) -> None:
    """Join the lines of the docstring of ``kind``, which Blender shows in tooltips with all its breaks and blanks."""
    if kind.__doc__ and "\n" in kind.__doc__:
        kind.__doc__ = " ".join(kind.__doc__.split())


def _hooks(module: ModuleType, prefix: str) -> list[Callable[[], None]]:
    """Return the functions of ``module`` whose names begin with ``prefix``, in order of definition."""
    return [
        item
        for name, item in vars(module).items()
        if name.startswith(prefix) and isinstance(item, FunctionType) and item.__module__ == module.__name__
    ]


def register() -> None:
    """Register classes, then properties, menus and handlers (``register_*``) of every module. Called by Blender."""
    import bpy

    for module in _modules():
        for kind in registered_classes(module):
            _tell_in_one_line(kind)
            bpy.utils.register_class(kind)
        for hook in _hooks(module, "register_"):
            hook()


def unregister() -> None:
    """Undo ``register`` in reverse order; running jobs are cancelled. Called by Blender."""
    import bpy

    for module in reversed(_modules()):
        for hook in reversed(_hooks(module, "unregister_")):
            hook()
        for kind in reversed(registered_classes(module)):
            bpy.utils.unregister_class(kind)
