# SPDX-License-Identifier: GPL-3.0-or-later
"""Preferences: the Python interpreter for simulations, and the result of its check."""

import bpy

from .. import text
from ..context import redraw
from ..interpreter import TERMINAL, home_folder, is_set_up
from ..paths import ADDON


def _forget(self: "PHYSGEN_AP_preferences", context: bpy.types.Context) -> None:
    self.check = self.check_text = self.check_command = ""


class PHYSGEN_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of PhysGen."""

    bl_idname = ADDON

    python: bpy.props.StringProperty(
        name="Python",
        description=(
            "Python interpreter for simulation and diagnosis, or the folder of its virtual environment. It needs the "
            "packages listed by Check, not PhysGen itself. Empty: the environment variable "
            "PHYSGEN_PYTHON, else Blender's own, else the folder physgen-python in your home folder"
        ),
        subtype="FILE_PATH",
        update=_forget,
    )
    progress: bpy.props.FloatProperty(options={"SKIP_SAVE", "HIDDEN"})
    progress_text: bpy.props.StringProperty(options={"SKIP_SAVE", "HIDDEN"})
    check: bpy.props.StringProperty(options={"SKIP_SAVE", "HIDDEN"})
    check_text: bpy.props.StringProperty(options={"SKIP_SAVE", "HIDDEN"})
    check_command: bpy.props.StringProperty(options={"SKIP_SAVE", "HIDDEN"})

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the preferences."""
        layout = self.layout
        layout.label(text="Simulations run in a Python of their own, outside Blender.")
        split = layout.split(factor=0.85, align=True)
        split.prop(self, "python", placeholder="Automatic")
        split.operator("physgen.check_python")
        if not self.progress_text and (self.check == "NO" or not is_set_up(self.python)):
            layout.operator("physgen.install_python", text="Install…", icon="IMPORT")
        if self.progress_text:
            row = layout.row(align=True)
            row.progress(factor=self.progress, text=self.progress_text)
            row.operator("physgen.cancel_job", text="", icon="X")
        _draw_check(self, context)
        row = layout.row(align=True)
        row.label(text="Materials to drag onto objects (built by make assets):")
        row.operator("physgen.add_assets", icon="ASSET_MANAGER")
        _draw_key(layout, context)


def _draw_check(self: PHYSGEN_AP_preferences, context: bpy.types.Context) -> None:
    if self.check:
        box = self.layout.box()
        text.sentences(box, context, self.check_text, icon="CHECKMARK" if self.check == "YES" else "ERROR")
        if self.check_command:
            emptied = "empty the field above and " if self.python and str(home_folder()) in self.check_command else ""
            box.label(text=f"Or run this in {TERMINAL}; when it has ended, {emptied}press Check again:")
            row = box.row(align=True)
            row.prop(self, "check_command", text="")
            row.operator("physgen.copy_command", text="", icon="COPYDOWN").command = self.check_command


PIE = "PHYSGEN_MT_pie"
"""The pie menu, which its key opens."""


def _draw_key(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the pie menu's key, to be changed here as in Preferences > Keymap."""
    import rna_keymap_ui

    user = context.window_manager.keyconfigs.user
    keymap = user.keymaps.get("Object Mode") if user is not None else None
    for item in keymap.keymap_items if keymap is not None else ():
        if item.idname == "wm.call_menu_pie" and item.properties.name == PIE:
            layout.label(text="Pie menu in the 3D viewport:")
            rna_keymap_ui.draw_kmi([], user, keymap, item, layout, 0)


def _own(context: bpy.types.Context) -> PHYSGEN_AP_preferences | None:
    addon = context.preferences.addons.get(ADDON)
    return addon.preferences if addon else None


def python(context: bpy.types.Context) -> str:
    """Return the interpreter set in the preferences; empty if none, or if registered by a script."""
    own = _own(context)
    return bpy.path.abspath(own.python) if own and own.python else ""


def show_progress(context: bpy.types.Context, share: float, words: str) -> None:
    """Show how far an installation is, from 0 to 1, in the preferences; no words when it has ended."""
    own = _own(context)
    if own is not None:
        own.progress, own.progress_text = share, words
    redraw("PREFERENCES")


def use_python(context: bpy.types.Context, path: str) -> None:
    """Set the interpreter in the preferences."""
    own = _own(context)
    if own is not None:
        own.python = path


def show_check(context: bpy.types.Context, answer: str, sentence: str, command: str) -> None:
    """Show the result of a check in the preferences. answer: YES, NO, or empty for none."""
    own = _own(context)
    if own is None:
        return
    own.check, own.check_text, own.check_command = answer, sentence, command
    redraw("PREFERENCES")
