# SPDX-License-Identifier: MIT
"""The verdict in words."""

from __future__ import annotations

import math
from collections.abc import Mapping

from .analysis import CandidateFit
from .diagnosis import NONE, UNKNOWN, Gap, Verdict

NAMES: Mapping[str, str] = {
    "air_drag": "air drag",
    "wind": "wind",
    "magnus": "lift from spin (Magnus)",
    "buoyancy": "buoyancy",
    "gravity_tilt": "a ground that is not level (tilted gravity)",
    "tether": "an unseen spring or string",
    "friction": "a different friction",
    "restitution": "a different bounce (restitution)",
    "rolling_resistance": "rolling resistance",
    "adhesion": "adhesion to the surface",
    "stiffness": "a different stiffness",
    "internal_damping": "damping inside the body",
    "plastic_yield": "lasting deformation (plastic yield)",
    "anisotropy": "fibres: stiffer along one axis",
    "stiffness_gradient": "stiffness that varies across the body",
    "mass_offset": "a centre of mass that is off the middle",
    "time_scale": "a clock that runs wrong",
    "camera_pose": "a camera that is not where it was believed to be",
}


def summary_of(verdict: Verdict, gap: Gap, found: CandidateFit) -> str:
    """One or two sentences for people."""
    if verdict.effect == NONE:
        return f"The nominal model explains the recording to its noise ({_percent(verdict.probability)} sure)."
    if verdict.effect == UNKNOWN:
        text = (
            "Something is missing from the model, and no effect known to this program closes the gap "
            f"({_percent(verdict.probability)} sure)."
        )
        if verdict.alternatives:
            text += f" Nearest comes {_listed(verdict.alternatives, 'or')}."
        return text
    causes = _listed(verdict.effects or (verdict.effect,), "and")
    verb = "are" if len(verdict.effects) > 1 else "is"
    text = f"Missing from the model {verb} {causes} ({_percent(verdict.probability)} sure)"
    if verdict.alternatives:
        text += f"; the data cannot rule out {_listed(verdict.alternatives, 'or')}"
    text += "."
    if not gap.resolvable:
        return text + " The gap is too near the noise to say how much of it this closes."
    if math.isfinite(gap.closed_fraction):
        share = "nothing" if gap.closed_fraction <= 0.005 else _percent(min(gap.closed_fraction, 1.0))
        text += f" It closes {share} of the gap on takes that no fit saw."
    return text


def _percent(value: float) -> str:
    shown = round(100 * value)
    return "over 99 %" if shown >= 100 else "under 1 %" if shown < 1 else f"{shown} %"


def _listed(names: tuple[str, ...], word: str) -> str:
    texts = [NAMES.get(name, name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {word} {texts[-1]}"
