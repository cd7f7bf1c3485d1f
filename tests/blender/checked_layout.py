# SPDX-License-Identifier: GPL-3.0-or-later
"""A layout for panels without a window: keeps what is drawn, and has Blender say whether it could be.

Blender's module draws nothing, and its own ``UILayout`` cannot be made by a script. This one answers every call by the
description that Blender gives of its own: functions, arguments and choices of ``UILayout``, properties of the data that
is drawn, operators, menus and lists that are registered.
"""

from __future__ import annotations

import re
from types import FunctionType, SimpleNamespace
from typing import Any

import bpy

FUNCTIONS = bpy.types.UILayout.bl_rna.functions
ATTRIBUTES = bpy.types.UILayout.bl_rna.properties
NOT_WORDS = re.compile(r"(?<=.)\b(None|True|False)\b|\b(None|True|False)\b(?=.)|\b(nan|inf)\b|[<{]\w*object|\s{2,}")
"""What a person should never read on a panel."""


class OperatorSettings:
    """Takes what a panel sets of an operator's button, and asks Blender whether it has such a property."""

    def __init__(self, kind: Any) -> None:
        object.__setattr__(self, "_kind", kind)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self._kind.properties, f"{self._kind.identifier} has no property {name}"


class CheckedLayout:
    """Stands where a panel has its ``UILayout``.

    names: properties and operators in the order drawn; words: text of labels and buttons, in the same order; grey:
    operators whose buttons the layout itself disables.
    """

    def __init__(self, whole: CheckedLayout | None = None) -> None:
        self.__dict__["names"] = [] if whole is None else whole.names
        self.__dict__["words"] = [] if whole is None else whole.words
        self.__dict__["grey"] = [] if whole is None else whole.grey

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in ATTRIBUTES and not ATTRIBUTES[name].is_readonly, f"a layout has no {name} to set"
        choices = getattr(ATTRIBUTES[name], "enum_items", ())
        assert not choices or value in choices, f"{name} cannot be {value!r}"
        self.__dict__[name] = value

    def __getattr__(self, name: str) -> Any:
        if name in ATTRIBUTES:
            return getattr(ATTRIBUTES[name], "default", None)
        assert name in FUNCTIONS, f"a layout has no function {name}"
        return lambda *args, **options: self._drawn(name, args, options)

    def _drawn(self, function: str, args: tuple[Any, ...], options: dict[str, Any]) -> Any:
        parameters = FUNCTIONS[function].parameters
        required = [item for item in parameters if item.is_required and not item.is_output]
        assert len(args) <= len(required), f"{function} takes arguments after the first {len(required)} by name only"
        for name, value in options.items():
            assert name in parameters, f"{function} takes no {name}"
            choices = getattr(parameters[name], "enum_items", ())
            assert not choices or value in choices, f"{name} of {function} cannot be {value!r}"
        words = options.get("text", "")
        assert isinstance(words, str) and not NOT_WORDS.search(words), f"{function} reads {words!r}"
        if words:
            self.words.append(words)
        check = getattr(CheckedLayout, f"_{function}", None)
        if check is not None:
            return check(self, *args, **options)
        parts = [CheckedLayout(self) for item in parameters if item.is_output]
        return parts[0] if len(parts) == 1 else tuple(parts) or None

    def _prop(self, data: Any, name: str, **_: Any) -> None:
        assert name in data.bl_rna.properties, f"{data.bl_rna.identifier} has no property {name}"
        self.names.append(name)

    def _prop_search(self, data: Any, name: str, search_data: Any, search_property: str, **_: Any) -> None:
        assert search_property in search_data.bl_rna.properties, f"nothing to search: {search_property}"
        self._prop(data, name)

    def _operator(self, name: str, **options: Any) -> OperatorSettings:
        group, _, operator = name.partition(".")
        kind = getattr(getattr(bpy.ops, group), operator).get_rna_type()
        self.names.append(name)
        if not self.__dict__.get("enabled", True):
            self.grey.append(name)
        if "text" not in options:
            self.words.append(kind.name)
        return OperatorSettings(kind)

    def _menu(self, menu: str, **_: Any) -> None:
        assert hasattr(bpy.types, menu), f"no menu {menu}"
        self.names.append(menu)

    def _progress(self, *, factor: float = 0.0, **_: Any) -> None:
        assert 0 <= factor <= 1, f"progress {factor}"

    def _template_list(self, kind: str, _name: str, data: Any, items: str, active: Any, index: str, **_: Any) -> None:
        assert items in data.bl_rna.properties and index in active.bl_rna.properties, f"{kind}: {items}, {index}"
        self.names.append(kind)
        drawn = getattr(bpy.types, kind)
        for number, item in enumerate(getattr(data, items)):
            row = CheckedLayout(self)
            drawn.draw_item(
                Drawn(drawn, row), Context(), row, data, item, 0, active, index, *[number, 0][: _extras(drawn)]
            )

    def _template_ID(self, data: Any, name: str, **_: Any) -> None:
        assert data.bl_rna.properties[name].type == "POINTER"
        self.names.append(name)


def _extras(drawn: type) -> int:
    """Return how many of ``index`` and ``flt_flag`` the list takes: as Blender does, by what its function declares."""
    return max(drawn.draw_item.__code__.co_argcount - 8, 0)


class Drawn:
    """Stands for an instance of a panel, list or operator, which only Blender can make.

    An operator's properties have their defaults.
    """

    def __init__(self, kind: type, layout: CheckedLayout) -> None:
        self._kind, self.layout = kind, layout
        if issubclass(kind, bpy.types.Operator):
            group, _, name = kind.bl_idname.partition(".")
            self.bl_rna = getattr(getattr(bpy.ops, group), name).get_rna_type()
            for item in self.bl_rna.properties:
                if not item.is_readonly:
                    setattr(self, item.identifier, getattr(item, "default", None))

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._kind, name)
        return found.__get__(self) if isinstance(found, FunctionType) else found


class Context:
    """Blender's context as a sidebar of 292 px in a window has it, with ``changes``.

    In background mode there is no region, and Blender's own scale is 0.
    """

    def __init__(self, **changes: Any) -> None:
        self.preferences = SimpleNamespace(
            addons=bpy.context.preferences.addons,
            system=SimpleNamespace(ui_scale=1.0),
            view=SimpleNamespace(ui_scale=1.0),
        )
        self.region = SimpleNamespace(width=292, height=1000)
        self.space_data = SimpleNamespace(type="VIEW_3D", image=None)
        self.__dict__.update(changes)

    def __getattr__(self, name: str) -> Any:
        return getattr(bpy.context, name)


def draw(panel: type, **changes: Any) -> CheckedLayout | None:
    """Return what ``panel`` draws in a sidebar now; None where it is hidden."""
    context = Context(**changes)
    poll = getattr(panel, "poll", None)
    if poll is not None and "poll" in {name for base in panel.__mro__ for name in vars(base)} and not poll(context):
        return None
    layout = CheckedLayout()
    drawn = Drawn(panel, layout)
    for header in ("draw_header", "draw_header_preset"):
        if any(header in vars(base) for base in panel.__mro__):
            getattr(panel, header)(drawn, context)
    panel.draw(drawn, context)
    return layout
