# SPDX-License-Identifier: MIT
"""Words for effects, phases and directions, and the labels of what a verdict names."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

from ..diagnosis import NONE, UNKNOWN, Verdict

LABELS = MappingProxyType(
    {
        "air_drag": "air drag",
        "wind": "wind",
        "magnus": "Magnus lift",
        "buoyancy": "buoyancy",
        "gravity_tilt": "tilted ground",
        "tether": "a hidden tether",
        "friction": "friction",
        "restitution": "restitution",
        "rolling_resistance": "rolling resistance",
        "adhesion": "adhesion",
        "stiffness": "stiffness",
        "internal_damping": "internal damping",
        "plastic_yield": "plastic yield",
        "anisotropy": "anisotropic stiffness",
        "stiffness_gradient": "a stiffness gradient",
        "sandy": "granular breakup",
        "mass_offset": "an off-centre mass",
        "inertia": "the moment of inertia",
        "time_scale": "the recording's clock rate",
        "camera_pose": "the camera pose",
        NONE: "nothing missing",
        UNKNOWN: "unknown cause",
    }
)

MEANINGS = MappingProxyType(
    {
        "air_drag": "Air resistance slows the real object; the simulation had none.",
        "wind": "Moving air pushes the real object; the simulation had still air or none.",
        "magnus": "The real object spins, and the air deflects it sideways like a curve ball.",
        "buoyancy": "The real object falls as if it were lighter: the surrounding medium carries part of its weight.",
        "gravity_tilt": "Gravity is not along the simulated vertical: the ground or the camera's level is tilted.",
        "tether": "Something unmodelled holds or pulls the real object towards a fixed point.",
        "friction": "Friction is higher or lower than assumed.",
        "restitution": "The real object bounces more or less than assumed.",
        "rolling_resistance": "The real object loses speed while rolling; the simulated one does not.",
        "adhesion": "The surface holds the real object back as it separates.",
        "stiffness": "The material is stiffer or softer than assumed.",
        "internal_damping": "The material damps its own vibration faster than assumed.",
        "plastic_yield": "The real object keeps dents; the simulated one springs back.",
        "anisotropy": "The material is stiffer along one direction, like wood along the grain.",
        "stiffness_gradient": "The material is stiffer on one side than on the other.",
        "sandy": "The material breaks up into grains at some point.",
        "mass_offset": "The centre of mass is not in the middle: something heavy sits to one side.",
        "inertia": "The mass is not spread evenly: a hollow object is harder to turn, one with a heavy core easier.",
        "time_scale": "The recording's clock runs fast or slow; the scene itself is right.",
        "camera_pose": "The camera was not quite where it was assumed to be; the scene itself is right.",
        NONE: "No effect needs to be added.",
        UNKNOWN: "Something acts that none of the known effects describes.",
    }
)

PHASES = MappingProxyType({"flight": "in flight", "impact": "at impacts", "contact": "in contact", "rest": "at rest"})

DIRECTIONS = MappingProxyType(
    {
        "normal": "along the ground normal",
        "along_velocity": "along the motion",
        "along_gravity": "vertical, off the ground",
        "other": "in other directions",
    }
)


def effect_label(name: str) -> str:
    """Return the label of an effect, or of several joined by "+"; unknown names without underscores."""
    parts = [part.strip() for part in name.split("+")]
    return listed([LABELS.get(part, part.replace("_", " ")) for part in parts], "and")


def listed(words: Sequence[str], conjunction: str) -> str:
    """Return "a", "a and b" or "a, b and c"."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {conjunction} {words[-1]}"


def found_effects(verdict: Verdict) -> tuple[str, ...]:
    """Return the names of the effects that the verdict adds; () for ``none`` and ``unknown``."""
    if verdict.effect in (NONE, UNKNOWN):
        return ()
    return verdict.effects or (verdict.effect,)


_AFTER = MappingProxyType(
    {
        "friction": "corrected friction",
        "restitution": "corrected restitution",
        "stiffness": "corrected stiffness",
        "time_scale": "corrected clock rate",
        "camera_pose": "corrected camera pose",
        "gravity_tilt": "tilted ground",
    }
)
"""Effects that change an existing property or the recording; all others are added."""


def found_label(verdict: Verdict) -> str:
    """Return the label of the model with the verdict's effects, such as "with air drag"."""
    names = found_effects(verdict)
    return f"with {listed([_AFTER.get(n, effect_label(n)) for n in names], 'and')}" if names else "no effect added"


def alternative_label(verdict: Verdict, name: str) -> str:
    """Return the label of the alternative ``name``; one of several causes that the verdict names is one "alone"."""
    several = found_effects(verdict)
    return f"{effect_label(name)} alone" if len(several) > 1 and name in several else effect_label(name)
