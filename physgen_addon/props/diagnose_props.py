# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of a scene's capture and its diagnosis, filled from ``report.json``."""

import math
from collections.abc import Mapping
from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ...sim.app.bake_options import BakeOptions
from ..paths import RELATIVE
from ..playback import capture_view
from ..playback.capture_materials import LAYERS
from ..text import readable
from .generated_properties import from_field, switch

NOT_KNOWN = -1.0
"""Stands for a missing number; Blender's properties have no null."""

_items: list[tuple[str, str, str]] = []
"""Keeps the strings of a dynamic enum alive, which Blender does not."""


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
    capture_view.show_overlay(self.before_root, self.after_root, choice=self.overlay)


def apply_view(state: "PHYSGEN_PG_diagnose") -> None:
    """Apply ``state`` to the loaded capture."""
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
    capture_view.show_layers(state.root, view)


class PHYSGEN_PG_layer(bpy.types.PropertyGroup):
    """Visibility of a layer: the observed, the nominal or the found motion."""

    points: BoolProperty(name="Points", description="Show the tracked points", update=_on_view)
    trail: BoolProperty(name="Trails", description="Show trails of the points", update=_on_view)
    body: BoolProperty(name="Mesh", description="Show the objects, moved by the points", update=_on_view)


class PHYSGEN_PG_trial(bpy.types.PropertyGroup):
    """A trial of the loaded capture."""

    label: StringProperty()


class PHYSGEN_PG_parameter(bpy.types.PropertyGroup):
    """A parameter of an effect with its 95 % interval."""

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


class PHYSGEN_PG_video(bpy.types.PropertyGroup):
    """A video to be explained, and what is known of its body."""

    file: StringProperty(
        name="Video",
        description="Video of one body that moves before a still background",
        subtype="FILE_PATH",
        options=RELATIVE,
    )
    kind: EnumProperty(
        name="Body",
        description="Shape of the body that moves",
        items=[
            ("ball", "Ball", "A ball of any surface"),
            ("cylinder", "Cylinder", "A disc, puck or can that stands upright"),
            ("box", "Box", "A box as it stands"),
            ("mesh", "Mesh", "A body of any shape"),
        ],
    )
    diameter: FloatProperty(name="Diameter", default=0.05, min=1e-4, max=20.0, precision=4, unit="LENGTH")
    height: FloatProperty(name="Height", default=0.05, min=1e-4, max=20.0, precision=4, unit="LENGTH")
    edges: FloatVectorProperty(
        name="Size", default=(0.05, 0.05, 0.05), min=1e-4, max=20.0, precision=4, subtype="XYZ", unit="LENGTH"
    )
    mesh: StringProperty(name="Mesh", description="File in metres, z up", subtype="FILE_PATH", options=RELATIVE)
    fps: FloatProperty(
        name="True Frame Rate",
        description="True frame rate of a slow-motion recording",
        default=0.0,
        min=0.0,
        soft_min=1.0,
        soft_max=1000.0,
    )
    own_fps: switch("fps", "Slow Motion", "The video plays slower than it was recorded; off: as the file says", 120.0)
    start: IntProperty(name="First Frame", description="First frame to use, from 0", default=0, min=0)
    end: IntProperty(name="Last Frame", description="Last frame to use", default=0, min=0, soft_min=2)
    own_end: switch("end", "Stop Early", "Leave out the end of the video; off: up to its last frame", 100)
    comparison: StringProperty(subtype="FILE_PATH", options=RELATIVE)


class PHYSGEN_PG_diagnose(bpy.types.PropertyGroup):
    """State of the Diagnose panel, stored with the scene."""

    capture: StringProperty(
        name="Capture",
        description="Folder of a recording (capture.json with meshes and trials)",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    report: StringProperty(
        name="Diagnosis",
        description="Folder of the diagnosis. Empty: NAME_diagnosis beside the capture",
        subtype="DIR_PATH",
        options=RELATIVE,
    )
    video: PointerProperty(type=PHYSGEN_PG_video)
    root: PointerProperty(type=bpy.types.Collection)
    trials: CollectionProperty(type=PHYSGEN_PG_trial)
    trial: EnumProperty(name="Trial", description="Shown trial", items=_trial_items, update=_on_trial)
    capture_warnings: CollectionProperty(type=PHYSGEN_PG_text)

    observed: PointerProperty(type=PHYSGEN_PG_layer)
    nominal: PointerProperty(type=PHYSGEN_PG_layer)
    found: PointerProperty(type=PHYSGEN_PG_layer)
    has_motion: BoolProperty()
    has_scores: BoolProperty()
    colours: BoolProperty(
        name="Discrepancy as colours",
        description="Colour the meshes by the residual force per mass of the nominal model",
        default=True,
        update=_on_view,
    )
    most: FloatProperty(
        name="Darkest At",
        description="Discrepancy of the last colour, m/s²",
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
        description="Duration of a trail, in seconds of the recording",
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
    frames: IntProperty(
        name="Frames", description="Number of frames to bake", default=BakeOptions.frames, min=1, soft_max=500
    )
    fps: FloatProperty(
        name="Frame Rate", description="Frames per second of the bake", default=BakeOptions.fps, min=1, soft_max=120
    )
    quality: from_field(
        BakeOptions,
        "quality",
        "Quality",
        "Resolution of the simulation",
        items=[
            ("preview", "Preview", "Coarse and quick"),
            ("standard", "Standard", "What most scenes need"),
            ("fine", "Fine", "Slow"),
        ],
    )
    before_root: PointerProperty(type=bpy.types.Collection)
    after_root: PointerProperty(type=bpy.types.Collection)
    overlay: EnumProperty(
        name="Overlay",
        description="Shown bake",
        items=[
            ("BEFORE", "Before", "The bake without the found effect"),
            ("AFTER", "After", "The bake with the found effect"),
            ("BOTH", "Both", "After, with before as a ghost over it"),
        ],
        default="BOTH",
        update=_on_overlay,
    )


def register_diagnose_properties() -> None:
    """Add ``physgen_diagnose`` to scenes."""
    bpy.types.Scene.physgen_diagnose = PointerProperty(type=PHYSGEN_PG_diagnose)


def unregister_diagnose_properties() -> None:
    """Remove it; values stored in files are kept."""
    del bpy.types.Scene.physgen_diagnose


GAP = {
    "before_m": "before_rms_m",
    "refitted_m": "refitted_rms_m",
    "after_m": "after_rms_m",
    "floor_m": "noise_floor_rms_m",
    "numerics_m": "numerics_rms_m",
    "closed": "closed_fraction",
}


def fill_diagnosis(state: PHYSGEN_PG_diagnose, report: Mapping[str, Any]) -> None:
    """Fill ``state`` from ``report``; malformed or absent entries are left out."""
    clear_diagnosis(state)
    verdict = report["verdict"]
    state.verdict = str(verdict.get("effect", "unknown"))
    state.probability = _number(verdict.get("probability"), 0.0)
    others = [name for name in _texts(verdict.get("effects")) if name != state.verdict]
    if others:
        state.verdict = " + ".join([state.verdict, *others])
    state.alternatives = ", ".join(_texts(verdict.get("alternatives")))
    state.summary = str(report.get("summary") or f"{readable(state.verdict)} ({state.probability:.0%})")
    state.next_experiment = str(report.get("next_experiment") or "")
    for item in report["effects"]:
        if isinstance(item, dict):
            _fill_effect(state.effects.add(), item)
    gap = report["gap"]
    for name, key in GAP.items():
        setattr(state, name, _number(gap.get(key), NOT_KNOWN))
    state.resolvable = gap.get("resolvable") is not False
    for text in _texts(report.get("warnings")):
        state.warnings.add().text = text
    state.has_report = True


def clear_diagnosis(state: PHYSGEN_PG_diagnose) -> None:
    """Clear ``state``."""
    state.effects.clear()
    state.warnings.clear()
    state.effect_index = 0
    state.has_report = False


def _fill_effect(line: Any, item: Mapping[str, Any]) -> None:
    line.name, line.kind = str(item.get("name", "")), str(item.get("kind", ""))
    line.probability = _number(item.get("probability"), 0.0)
    line.closed = _number(item.get("closed_fraction"), NOT_KNOWN)
    line.has_closed = item.get("closed_fraction") is not None
    parameters = item.get("parameters")
    for name, entry in parameters.items() if isinstance(parameters, dict) else ():
        if not isinstance(entry, dict):
            continue
        number = line.parameters.add()
        number.name, number.unit = str(name), str(entry.get("unit") or "")
        number.value = _number(entry.get("value"), math.nan)
        interval = entry.get("ci95")
        low, high = interval if isinstance(interval, list) and len(interval) == 2 else (None, None)
        number.low, number.high = _number(low, math.nan), _number(high, math.nan)


def _number(value: Any, otherwise: float) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else otherwise


def _texts(value: Any) -> list[str]:
    return [str(text) for text in value] if isinstance(value, list) else []
