# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences."""

import bpy

ADDON = __package__.removesuffix(".physgen_addon.props")
"""Name of the extension's root package: ``physgen``, or ``bl_ext.<repository>.physgen`` where it is installed."""


class PHYSGEN_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of PhysGen."""

    bl_idname = ADDON

    python: bpy.props.StringProperty(
        name="Python",
        description=(
            "Interpreter with physgen installed that runs simulations and diagnoses. "
            "Empty: the one in the environment variable PHYSGEN_PYTHON, else Blender's own"
        ),
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        """The preferences' page."""
        self.layout.prop(self, "python")


def python(context: bpy.types.Context) -> str:
    """The interpreter named in the preferences; empty where none is, or the add-on was registered by a script."""
    addon = context.preferences.addons.get(ADDON)
    return (
        bpy.path.abspath(addon.preferences.python) if addon and addon.preferences and addon.preferences.python else ""
    )


CLASSES = (PHYSGEN_AP_preferences,)
