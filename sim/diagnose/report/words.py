# SPDX-License-Identifier: MIT
"""Effects, phases and verdicts in plain words, for artists and not only for physicists."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from types import MappingProxyType

from ..diagnosis import NONE, UNKNOWN, Diagnosis, Verdict
from .quantities import NOTHING, percent_text, quantity_text

LABELS = MappingProxyType(
    {
        "air_drag": "air drag",
        "wind": "wind",
        "magnus": "lift from spin",
        "buoyancy": "buoyancy",
        "gravity_tilt": "tilted ground",
        "tether": "a hidden string or spring",
        "friction": "friction",
        "restitution": "bounciness",
        "rolling_resistance": "rolling resistance",
        "adhesion": "stickiness",
        "stiffness": "stiffness",
        "internal_damping": "damping inside the material",
        "plastic_yield": "permanent denting",
        "anisotropy": "stiffness along one axis",
        "stiffness_gradient": "uneven stiffness",
        "sandy": "turning to sand",
        "mass_offset": "an off-centre mass",
        "time_scale": "the recording's clock",
        "camera_pose": "the camera's place",
        NONE: "nothing missing",
        UNKNOWN: "a cause not known here",
    }
)

_MEANING = MappingProxyType(
    {
        "air_drag": "The air slows the real thing down; the simulation moved it as if in a vacuum.",
        "wind": "Moving air pushes the real thing along; the simulation had still air or none.",
        "magnus": "The real thing spins, and the air bends its path sideways, as with a curve ball.",
        "buoyancy": "The real thing falls as if it weighed less: what surrounds it carries part of the weight.",
        "gravity_tilt": "Down is not where the simulation has it: the ground or the camera's level is tilted.",
        "tether": "Something unseen holds or pulls the real thing towards a fixed point.",
        "friction": "The surfaces grip more or less than was assumed.",
        "restitution": "The real thing bounces back more or less than was assumed.",
        "rolling_resistance": "Rolling costs the real thing speed; the simulated one rolls on and on.",
        "adhesion": "The surface holds on to the real thing when it should leave.",
        "stiffness": "The material is stiffer or softer than was assumed.",
        "internal_damping": "The material swallows its own wobbling faster than was assumed.",
        "plastic_yield": "The real thing keeps dents; the simulated one springs back.",
        "anisotropy": "The material is stiffer along one direction, like wood along its grain.",
        "stiffness_gradient": "The material is stiffer on one side than on the other.",
        "sandy": "The material falls apart into grains at some moment.",
        "mass_offset": "The weight does not sit in the middle: something heavy is off-centre.",
        "time_scale": "The recording's clock runs fast or slow; nothing in the scene is wrong.",
        "camera_pose": "The camera was not quite where it was believed to be; nothing in the scene is wrong.",
        NONE: "No effect needs to be added.",
        UNKNOWN: "Something real is going on that none of the known effects describes.",
    }
)

PHASES = MappingProxyType({"flight": "in flight", "impact": "at impacts", "contact": "in contact", "rest": "at rest"})

DIRECTIONS = MappingProxyType(
    {
        "normal": "away from or into the ground",
        "along_velocity": "along the motion",
        "along_gravity": "up or down in flight",
        "other": "elsewhere",
    }
)


def effect_label(name: str) -> str:
    """A name of the vocabulary in words; of two joined by "+" both; any other name as it is, without underscores."""
    parts = [part.strip() for part in name.split("+")]
    return listed([LABELS.get(part, part.replace("_", " ")) for part in parts], "and")


def listed(words: Sequence[str], conjunction: str) -> str:
    """ "a", "a and b", "a, b and c"."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {conjunction} {words[-1]}"


def found_effects(verdict: Verdict) -> tuple[str, ...]:
    """Names of the effects that the verdict adds; () for ``none`` and ``unknown``."""
    if verdict.effect in (NONE, UNKNOWN):
        return ()
    return verdict.effects or (verdict.effect,)


_AFTER = MappingProxyType(
    {
        "friction": "another friction",
        "restitution": "another bounciness",
        "stiffness": "another stiffness",
        "time_scale": "the clock corrected",
        "camera_pose": "the camera corrected",
        "gravity_tilt": "the ground tilted",
    }
)
"""Where the effect changes what is there already, or the recording; others are added."""


def found_label(verdict: Verdict) -> str:
    """The verdict's effects in words, for the "after" of pictures; "no effect added" for ``none`` and ``unknown``."""
    names = found_effects(verdict)
    return f"with {listed([_AFTER.get(n, effect_label(n)) for n in names], 'and')}" if names else "no effect added"


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in a line."""
    verdict = diagnosis.verdict
    if verdict.effect == NONE:
        return "Nothing is missing that this recording could show"
    if verdict.effect == UNKNOWN:
        return "Something is missing, and it is none of the known effects"
    names = [effect_label(name) for name in found_effects(verdict)]
    first = listed(names, "and")
    return f"{first[:1].upper()}{first[1:]}: {_sureness(verdict.probability)}"


def _sureness(probability: float) -> str:
    if not math.isfinite(probability):
        return "how likely is not known"
    for limit, words in ((0.95, "almost certainly"), (0.8, "very likely"), (0.5, "more likely than not")):
        if probability >= limit:
            return f"{words} the cause"
    return "the best guess, but only a guess"


def meaning(verdict: Verdict) -> str:
    """What the verdict says about the real thing, in a sentence or two."""
    names = found_effects(verdict) or (verdict.effect,)
    return " ".join(_MEANING[n] for n in names if n in _MEANING)


def alternatives_sentence(verdict: Verdict) -> str | None:
    """What cannot be told from the verdict; None where nothing is named."""
    if not verdict.alternatives:
        return None
    others = listed([effect_label(name) for name in verdict.alternatives], "or")
    if verdict.effect == NONE:
        return f"Too small to be ruled out by this recording: {others}."
    if verdict.effect == UNKNOWN:
        return f"Closest among the known effects, but not good enough: {others}."
    return f"This recording cannot tell it from {others}. Treat them as one finding until another recording decides."


def closure_sentence(diagnosis: Diagnosis) -> str:
    """How far the gap closes, or in honest words why no number is given."""
    gap = diagnosis.gap
    if not gap.resolvable:
        return (
            "Not resolvable: the simulation as believed is already so close to the noise of the recording "
            f"({_length(gap.before_rms_m)} against {_length(gap.noise_floor_rms_m)}) that a share "
            "of the gap would mean nothing."
        )
    if not found_effects(diagnosis.verdict):
        if diagnosis.verdict.effect == NONE:
            return "No effect was added, so there is no gap to close."
        return (
            f"A gap of {_length(gap.before_rms_m)} is there on motion that no fit saw; the noise explains only "
            f"{_length(gap.noise_floor_rms_m)} of it. Nothing was added."
        )
    low, high = gap.closed_fraction_ci95
    spread = f" (95 %: {percent_text(low)} to {percent_text(high)})" if math.isfinite(low + high) else ""
    return (
        f"On motion that no fit saw, the error goes from {_length(gap.before_rms_m)} to "
        f"{_length(gap.after_rms_m)}: {_closed(gap.closed_fraction)}{spread}."
    )


def _length(value: float) -> str:
    return quantity_text(value, "m", digits=2)


def _closed(fraction: float) -> str:
    if not math.isfinite(fraction):
        return "the share of the gap that this closes is not known"
    if fraction < 0:
        return "the gap gets wider, so do not trust this cause"
    return f"{percent_text(min(fraction, 1.0))} of the gap that noise leaves room for is closed"


def control_sentences(diagnosis: Diagnosis) -> list[str]:
    """What the controls say about a found cause; [] where there is nothing to compare."""
    if not found_effects(diagnosis.verdict):
        return []
    after, gap = diagnosis.gap.after_rms_m, diagnosis.gap
    said = []
    rivals = (
        ("wrong_effect_rms_m", "an effect that the evidence rejected"),
        ("last_residual_rms_m", "simply carrying the last seen error on"),
    )
    for key, what in rivals:
        if diagnosis.controls.get(key, math.nan) <= after:
            said.append(
                f"It predicts no better than {what} ({_length(diagnosis.controls[key])}). "
                "A cause that does not beat its controls is not a cause: take this verdict with care."
            )
    if gap.refitted_rms_m <= after:
        said.append(
            "Re-fitting the numbers that the simulation already has does as well "
            f"({_length(gap.refitted_rms_m)}), without any new effect."
        )
    if gap.numerics_rms_m > 0.25 * gap.before_rms_m:
        said.append(
            f"{_length(gap.numerics_rms_m)} of the error comes from the simulator's own resolution: raise the "
            "quality before blaming reality."
        )
    return said


def shares_sentence(shares: Iterable[tuple[str, float]]) -> str | None:
    """ "72 % in flight, 28 % at impacts", largest first, without the negligible; None where there are none."""
    known = sorted(((s, n) for n, s in shares if math.isfinite(s) and s >= 0.005), key=lambda pair: (-pair[0], pair[1]))
    return ", ".join(f"{percent_text(share)} {name}" for share, name in known[:4]) or None


def or_dash(value: str | None) -> str:
    """``value``, or a dash for nothing."""
    return value or NOTHING
