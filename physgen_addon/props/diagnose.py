# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene's capture and its diagnosis: where they are, what was concluded, and what of them is shown.

Blender reads the classes' annotations as properties, so they must not be postponed to strings.
"""

from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..bridge import capture_view, overlay
from ..bridge.capture_materials import LAYERS
from ..paths import RELATIVE

NOT_KNOWN = -1.0
"""Stands for a number that the report does not have; Blender's properties have no null."""

_items: list[tuple[str, str, str]] = []
"""Blender does not keep the strings of a dynamic enum alive; this does."""


def _trial_items(self: "PHYSGEN_PG_diagnose", context: bpy.types.Context | None) -> list[tuple[str, str, str]]:
    _items[:] = [(t.name, t.name, t.label) for t in self.trials] or [("-", "No trial", "Load a capture first")]
    return _items


def _on_trial(self: "PHYSGEN_PG_diagnose", context: bpy.types.Context) -> None:
    if self.root is not None:
        apply_view(self)
        capture_view.play_range(self.id_data, self.root, self.trial)
        capture_view.follow(self.root, self.trial)


def _on_view(self: Any, context: bpy.types.Context) -> None:
    apply_view(self.id_data.physgen_diagnose)


def _on_overlay(self: "PHYSGEN_PG_diagnose", context: bpy.types.Context) -> None:
    overlay.show(self.before_root, self.after_root, choice=self.overlay)


def apply_view(state: "PHYSGEN_PG_diagnose") -> None:
    """Let the loaded capture look as ``state`` says."""
    if state.root is None:
        return
    layers = {
        name: capture_view.LayerView(points=layer.points, trail=layer.trail, body=layer.body)
        for name, layer in ((name, getattr(state, name)) for name in LAYERS)
    }
    view = capture_view.CaptureView(
        trial=state.trial,
        layers=layers,
        colours=state.colours and state.has_scores,
        most=state.most,
        radius=state.radius,
        trail_s=state.trail_s,
    )
    capture_view.show(state.root, view)


class PHYSGEN_PG_layer(bpy.types.PropertyGroup):
    """What is shown of a layer: the observed, the nominal or the found motion."""

    points: BoolProperty(name="Points", description="Its tracked points", update=_on_view)
    trail: BoolProperty(name="Trails", description="Where its points have just been", update=_on_view)
    body: BoolProperty(name="Mesh", description="The objects, moved as its points move", update=_on_view)


class PHYSGEN_PG_trial(bpy.types.PropertyGroup):
    """A trial of the loaded capture."""

    label: StringProperty()


class PHYSGEN_PG_parameter(bpy.types.PropertyGroup):
    """A number of an effect with its 95 % interval."""

    value: FloatProperty()
    low: FloatProperty()
    high: FloatProperty()
    unit: StringProperty()


class PHYSGEN_PG_effect(bpy.types.PropertyGroup):
    """One line of the ranking."""

    kind: StringProperty()
    probability: FloatProperty(name="Probability", subtype="FACTOR", min=0, max=1)
    closed: FloatProperty(default=NOT_KNOWN)
    has_closed: BoolProperty()
    parameters: CollectionProperty(type=PHYSGEN_PG_parameter)


class PHYSGEN_PG_text(bpy.types.PropertyGroup):
    """A sentence, such as a warning."""

    text: StringProperty()


class PHYSGEN_PG_diagnose(bpy.types.PropertyGroup):
    """All that the Diagnose panel knows, kept with the scene."""

    capture: StringProperty(
        name="Capture",
        description="Folder of a recording (capture.json with its meshes and takes)",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    report: StringProperty(
        name="Diagnosis",
        description="Folder of the diagnosis. Empty: beside the capture, with _diagnosis behind its name",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    root: PointerProperty(type=bpy.types.Collection)
    trials: CollectionProperty(type=PHYSGEN_PG_trial)
    trial: EnumProperty(name="Trial", description="The take that is shown", items=_trial_items, update=_on_trial)
    capture_warnings: CollectionProperty(type=PHYSGEN_PG_text)

    observed: PointerProperty(type=PHYSGEN_PG_layer)
    nominal: PointerProperty(type=PHYSGEN_PG_layer)
    found: PointerProperty(type=PHYSGEN_PG_layer)
    has_motion: BoolProperty()
    has_scores: BoolProperty()
    colours: BoolProperty(
        name="Discrepancy as colours",
        description="Colour the meshes by the force per mass that the nominal model lacks there and then",
        default=True,
        update=_on_view,
    )
    most: FloatProperty(
        name="Darkest At",
        description="Discrepancy that the last colour stands for, m/s²",
        default=1.0,
        min=1e-6,
        soft_max=100.0,
        precision=3,
        update=_on_view,
    )
    radius: FloatProperty(
        name="Point Radius",
        description="Size of the tracked points",
        default=0.003,
        min=1e-6,
        soft_max=0.05,
        precision=4,
        unit="LENGTH",
        update=_on_view,
    )
    trail_s: FloatProperty(
        name="Trail Length",
        description="How much of the past a trail shows, in seconds of the recording",
        default=0.25,
        min=0.0,
        soft_max=5.0,
        unit="TIME_ABSOLUTE",
        update=_on_view,
    )

    has_report: BoolProperty()
    verdict: StringProperty()
    probability: FloatProperty()
    summary: StringProperty()
    alternatives: StringProperty()
    next_experiment: StringProperty()
    effects: CollectionProperty(type=PHYSGEN_PG_effect)
    effect_index: IntProperty(name="Effect")
    resolvable: BoolProperty()
    before_m: FloatProperty(default=NOT_KNOWN)
    refitted_m: FloatProperty(default=NOT_KNOWN)
    after_m: FloatProperty(default=NOT_KNOWN)
    floor_m: FloatProperty(default=NOT_KNOWN)
    numerics_m: FloatProperty(default=NOT_KNOWN)
    closed: FloatProperty(default=NOT_KNOWN)
    warnings: CollectionProperty(type=PHYSGEN_PG_text)

    scene_folder: StringProperty(
        name="Scene",
        description="PhysGen scene folder that the found effect is added to",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    before: StringProperty(
        name="Bake Before",
        description="Bake of that scene without the effect. Empty: it is baked first",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    after: StringProperty(
        name="Bake After",
        description="Bake with the effect. A new folder each time",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    frames: IntProperty(name="Frames", description="How many frames to bake", default=48, min=1, soft_max=500)
    fps: FloatProperty(name="Frame Rate", description="Frames a second of the bake", default=24, min=1, soft_max=120)
    quality: EnumProperty(
        name="Quality",
        description="How finely the scene is simulated",
        items=[
            ("preview", "Preview", "Coarse and quick"),
            ("standard", "Standard", "What most scenes need"),
            ("fine", "Fine", "Slow"),
        ],
        default="standard",
    )
    before_root: PointerProperty(type=bpy.types.Collection)
    after_root: PointerProperty(type=bpy.types.Collection)
    overlay: EnumProperty(
        name="Overlay",
        description="Which of the two bakes is shown",
        items=[
            ("BEFORE", "Before", "The bake without the found effect"),
            ("AFTER", "After", "The bake with the found effect"),
            ("BOTH", "Both", "After, with before as a ghost over it"),
        ],
        default="BOTH",
        update=_on_overlay,
    )


CLASSES = (
    PHYSGEN_PG_layer,
    PHYSGEN_PG_trial,
    PHYSGEN_PG_parameter,
    PHYSGEN_PG_effect,
    PHYSGEN_PG_text,
    PHYSGEN_PG_diagnose,
)


def register() -> None:
    """Let every scene have a ``physgen_diagnose``."""
    bpy.types.Scene.physgen_diagnose = PointerProperty(type=PHYSGEN_PG_diagnose)


def unregister() -> None:
    """Take it away again; what a file has stored stays stored."""
    del bpy.types.Scene.physgen_diagnose
