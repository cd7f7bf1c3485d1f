# SPDX-License-Identifier: MIT
"""Sentences on a verdict: headline, meaning, gap closure, controls, and the summary."""

from __future__ import annotations

import math
from collections.abc import Iterable

from ..capture import Capture
from ..diagnosis import NONE, UNKNOWN, Diagnosis, Gap, Verdict
from .effect_words import MEANINGS, alternative_label, effect_label, found_effects, listed
from .number_format import LEAST_LENGTH_M, number_text, percent_text, quantity_text


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict on one line."""
    verdict = diagnosis.verdict
    if verdict.effect == NONE and remains(diagnosis.gap):
        return f"No known effect stands out, and an error of {_length(diagnosis.gap.before_rms_m)} is left"
    if verdict.effect == NONE:
        return "Nothing is missing that this recording could show"
    if verdict.effect == UNKNOWN:
        return "Something is missing, and it is none of the known effects"
    names = [effect_label(name) for name in found_effects(verdict)]
    first = listed(names, "and")
    return f"{first[:1].upper()}{first[1:]}: {_sureness(verdict.probability)}"


def _sureness(probability: float) -> str:
    if not math.isfinite(probability):
        return "probability not known"
    for limit, words in ((0.95, "almost certainly"), (0.8, "very likely"), (0.5, "more likely than not")):
        if probability >= limit:
            return f"{words} the cause"
    return "only the best guess"


def _against_belief(name: str, diagnosis: Diagnosis, capture: Capture) -> str:
    """Return in which direction a contact coefficient was assumed wrong; "" of other effects and unknown beliefs."""
    believed = {"friction": capture.ground.friction, "restitution": capture.ground.restitution}.get(name)
    found = next((i.parameters[name].value for i in diagnosis.effects if i.name == name and name in i.parameters), None)
    if believed is None or found is None or number_text(found) == number_text(believed):
        return ""
    way, label = "higher" if found > believed else "lower", effect_label(name).capitalize()
    return f"{label} is {way} than assumed: {number_text(found)}, not {number_text(believed)}."


def meaning(diagnosis: Diagnosis, capture: Capture) -> str:
    """Return what the verdict means physically, in a sentence or two."""
    verdict = diagnosis.verdict
    if verdict.effect == NONE and remains(diagnosis.gap):
        return (
            "The simulation differs from the recording by more than noise, and no effect describes how: the recording "
            "may be off in a way that is not modelled, such as its scale, its view or a body that is not as assumed."
        )
    names = found_effects(verdict) or (verdict.effect,)
    said = [_against_belief(n, diagnosis, capture) or MEANINGS[n] for n in names if n in MEANINGS]
    if verdict.effect == UNKNOWN:
        why = next((item.reason for item in diagnosis.effects if item.name == NONE), "")
        said += [f"The nominal model is ruled out: {why}."] if why else []
    return " ".join(said)


def alternatives_sentence(verdict: Verdict) -> str | None:
    """Return the sentence on effects that cannot be distinguished from the verdict; None without any."""
    if not verdict.alternatives:
        return None
    others = listed([alternative_label(verdict, name) for name in verdict.alternatives], "or")
    if verdict.effect == NONE:
        return f"Too small for this recording to rule out: {others}."
    if verdict.effect == UNKNOWN:
        return f"Closest known effects, but not good enough: {others}."
    return (
        f"This recording cannot distinguish {'it' if len(found_effects(verdict)) < 2 else 'them'} from {others}. "
        "Treat them as one finding until another recording decides."
    )


def closure_sentence(diagnosis: Diagnosis) -> str:
    """Return the sentence on how much of the gap is closed, or why no number is given."""
    gap = diagnosis.gap
    if diagnosis.verdict.effect == NONE and remains(gap):
        return (
            f"No effect was added. The nominal model's error is {_length(gap.before_rms_m)}, of which noise and the "
            f"simulator's own uncertainty explain {_length(_expected(gap))}; no known effect explains the rest clearly."
            f"{_floor(gap)}"
        )
    if diagnosis.verdict.effect == NONE:
        return f"No effect was added, so there is no gap to close.{_floor(gap)}"
    if not gap.resolvable and diagnosis.verdict.effect == UNKNOWN:
        return (
            "Not resolvable: what is missing shows in the fit of whole trials and hardly in held-out motion. The "
            f"nominal model's error there is {_length(gap.before_rms_m)}, and the noise floor "
            f"{_length(gap.noise_floor_rms_m)}."
        )
    if not gap.resolvable:
        return (
            "Not resolvable: the nominal model is already so close to the noise floor "
            f"({_length(gap.before_rms_m)} against {_length(gap.noise_floor_rms_m)}) that a share of the gap "
            "would be meaningless."
        )
    if not found_effects(diagnosis.verdict):
        return (
            f"The gap on held-out motion is {_length(gap.before_rms_m)}, of which noise explains only "
            f"{_length(gap.noise_floor_rms_m)}. Nothing was added.{_floor(gap)}"
        )
    low, high = gap.closed_fraction_ci95
    spread = f" (95 %: {percent_text(low)} to {percent_text(high)})" if math.isfinite(low + high) else ""
    return (
        f"On held-out motion the error changes from {_length(gap.before_rms_m)} to "
        f"{_length(gap.after_rms_m)}: {_closed(gap)}{spread}.{_rest(gap)}{_floor(gap)}"
    )


def _rest(gap: Gap) -> str:
    """Return a sentence on an error with the cause that is clearly more than noise and grain make, or ""."""
    if not gap.after_rms_m > EXPLAINED * _expected(gap):
        return ""
    return (
        f" What is left is {number_text(gap.after_rms_m / _expected(gap), digits=2)} times what noise and the "
        "simulator's own uncertainty make: this is not the whole cause."
    )


FAR = 3.0
"""Noise floor over tracking noise above which the page says where it comes from."""


def _floor(gap: Gap) -> str:
    """Return a sentence on a noise floor far above the tracking noise, or ""."""
    if not gap.noise_floor_rms_m > FAR * gap.noise_rms_m:
        return ""
    return (
        f" The noise floor, {_length(gap.noise_floor_rms_m)}, is far above the tracking noise of "
        f"{_length(gap.noise_rms_m)} in all coordinates together: it is what that noise, in the first frames, makes of "
        "the prediction."
    )


EXPLAINED = 1.5
"""Error over noise and grain together up to which these explain it."""


def _expected(gap: Gap) -> float:
    """Return the error in m that noise and the simulator's own uncertainty make."""
    return max(math.hypot(gap.noise_floor_rms_m, gap.grain_rms_m), LEAST_LENGTH_M)


def remains(gap: Gap) -> bool:
    """Return whether the nominal model leaves clearly more than noise and the simulator's own uncertainty do."""
    return gap.before_rms_m > EXPLAINED * _expected(gap)


def _length(value: float) -> str:
    return quantity_text(value, "m", digits=2)


def _chaotic(gap: Gap) -> bool:
    """Return whether the simulator's own uncertainty moves the prediction by more than the gap."""
    return gap.before_rms_m < gap.grain_rms_m


def _closed(gap: Gap) -> str:
    fraction = gap.closed_fraction
    if not math.isfinite(fraction):
        return "how much of the gap this closes is not known"
    if fraction < 0 and _chaotic(gap):
        return "the gap widens, but by less than the simulator's own uncertainty"
    if fraction < 0:
        return "the gap widens, so do not trust this cause"
    return f"{percent_text(min(fraction, 1.0))} of the gap above the noise floor is closed"


CLEARLY_BETTER = 0.9
"""Fraction of an error below which another one is better, not as good."""


def _better_alternatives(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on alternatives that predict held-out motion clearly better than the verdict; [] for none."""
    after = diagnosis.gap.after_rms_m
    better = [
        f"{effect_label(item.name)} ({_length(item.heldout_rms_m)})"
        for item in diagnosis.effects
        if item.name in diagnosis.verdict.alternatives and item.heldout_rms_m < CLEARLY_BETTER * after
    ]
    if not better:
        return []
    return [
        f"Closer on held-out motion than its {_length(after)}: {listed(better, 'and')}. The probabilities also weigh "
        "how well the fitted motion is explained, and how common a cause is."
    ]


def control_sentences(diagnosis: Diagnosis) -> list[str]:
    """Return warnings from the controls about the found cause; [] without a cause."""
    if not found_effects(diagnosis.verdict):
        return []
    after, gap = diagnosis.gap.after_rms_m, diagnosis.gap
    said = []
    if gap.resolvable and _chaotic(gap):
        said.append(
            f"Contacts make the held-out motion chaotic: what a simulator cannot know there moves it by "
            f"{_length(gap.grain_rms_m)}, more than the gap of {_length(gap.before_rms_m)}. The share of the gap "
            "judges little here; the verdict rests on the fit."
        )
    rivals = (
        ("wrong_effect_rms_m", "an effect that the evidence rejected"),
        ("last_residual_rms_m", "carrying the last observed error forward"),
    )
    for key, what in rivals:
        if diagnosis.controls.get(key, math.nan) <= after:
            said.append(
                f"It predicts no better than {what} ({_length(diagnosis.controls[key])}). "
                "A cause that does not beat its controls is not a cause: treat this verdict with caution."
            )
    if gap.refitted_rms_m <= after:
        how = "better" if gap.refitted_rms_m < CLEARLY_BETTER * after else "as well"
        # A cause that corrects a parameter of the nominal model is among what was re-fitted.
        own = set(found_effects(diagnosis.verdict)) & {"friction", "restitution", "stiffness"}
        those = "the nominal model's own parameters, without any new effect,"
        if own:
            those = f"all of the nominal model's own parameters, {effect_label(min(own))} among them,"
        said.append(f"Re-fitting {those} does {how} ({_length(gap.refitted_rms_m)}).")
    said += _better_alternatives(diagnosis)
    if gap.numerics_rms_m > max(0.25 * gap.before_rms_m, after):
        said.append(
            f"A finer simulation moves this prediction by {_length(gap.numerics_rms_m)}, more than the "
            f"{_length(after)} that remain: part of the agreement is with one resolution."
        )
    elif gap.numerics_rms_m > 0.25 * gap.before_rms_m:
        said.append(
            f"Up to {_length(gap.numerics_rms_m)} of the remaining {_length(after)} may be the simulator's own "
            "numerical error."
        )
    return said


def shares_sentence(shares: Iterable[tuple[str, float]]) -> str | None:
    """Return "72 % in flight, 28 % at impacts", largest first, without negligible ones; None if none is left."""
    known = sorted(((s, n) for n, s in shares if math.isfinite(s) and s >= 0.005), key=lambda pair: (-pair[0], pair[1]))
    return ", ".join(f"{percent_text(share)} {name}" for share, name in known[:4]) or None


def verdict_summary(verdict: Verdict, gap: Gap) -> str:
    """Return the verdict in a sentence or two: cause, confidence, alternatives, gap closure."""
    others = listed([alternative_label(verdict, name) for name in verdict.alternatives], "or")
    if verdict.effect == NONE:
        if remains(gap):
            return (
                f"No known effect explains the recording clearly better than the nominal model ({_confidence(verdict)})"
                f", although its error is {number_text(gap.before_rms_m / _expected(gap), digits=2)} times what noise "
                "and the simulator's own uncertainty make."
            )
        own = " and the simulator's own uncertainty" if gap.resolvable else ""
        return f"The nominal model explains the recording down to its noise{own} ({_confidence(verdict)})."
    if verdict.effect == UNKNOWN:
        text = f"Something is missing from the model, and no known effect explains it ({_confidence(verdict)})."
        return f"{text} Closest: {others}." if others else text
    causes = [effect_label(name) for name in found_effects(verdict)]
    opening = "The cause of the gap is" if len(causes) == 1 else "The causes of the gap are"
    text = f"{opening} {listed(causes, 'and')} ({_confidence(verdict)})"
    text += f"; the data cannot rule out {others}." if others else "."
    if not gap.resolvable:
        return text + " The gap is too close to the noise floor to say how much of it this closes."
    if math.isfinite(gap.closed_fraction):
        share = "nothing" if gap.closed_fraction <= 0.005 else _share(min(gap.closed_fraction, 1.0))
        text += f" It closes {share} of the gap on held-out motion."
    return text


def _confidence(verdict: Verdict) -> str:
    return f"{_share(verdict.probability)} confidence"


def _share(value: float) -> str:
    """Return a share as the page shows it, for terminals too."""
    return percent_text(value).replace("\u00a0", " ")
