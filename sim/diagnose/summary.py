# SPDX-License-Identifier: MIT
"""The verdict in a sentence or two."""

from __future__ import annotations

import math

from .diagnosis import NONE, UNKNOWN, Gap, Verdict
from .report.words import effect_label, found_effects, listed


def summary_of(verdict: Verdict, gap: Gap) -> str:
    """What was found, how sure that is, what it could be instead, how far it closes the gap."""
    others = listed([effect_label(name) for name in verdict.alternatives], "or")
    if verdict.effect == NONE:
        return f"The nominal model explains the recording to its noise ({_percent(verdict.probability)} sure)."
    if verdict.effect == UNKNOWN:
        text = (
            "Something is missing from the model, and no effect known to this program closes the gap "
            f"({_percent(verdict.probability)} sure)."
        )
        return f"{text} Nearest comes {others}." if others else text
    causes = [effect_label(name) for name in found_effects(verdict)]
    opening = "The cause of the gap is" if len(causes) == 1 else "The causes of the gap are"
    text = f"{opening} {listed(causes, 'and')} ({_percent(verdict.probability)} sure)"
    text += f"; the data cannot rule out {others}." if others else "."
    if not gap.resolvable:
        return text + " The gap is too near the noise to say how much of it this closes."
    if math.isfinite(gap.closed_fraction):
        share = "nothing" if gap.closed_fraction <= 0.005 else _percent(min(gap.closed_fraction, 1.0))
        text += f" It closes {share} of the gap on takes that no fit saw."
    return text


def _percent(value: float) -> str:
    shown = round(100 * value)
    return "over 99 %" if shown >= 100 else "under 1 %" if shown < 1 else f"{shown} %"
