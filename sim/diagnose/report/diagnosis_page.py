# SPDX-License-Identifier: MIT
"""The diagnosis report: one HTML page, from the template ``diagnosis_page.html``, and its figures as files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...atomic import write_bytes
from ...html import page_head, prose, render, short_number, shortened
from ...page_style import page_style, picture_style
from ...version import VERSION
from ..capture import Capture
from ..diagnosis import NONE, PAGE_FILE, SAME, UNKNOWN, Diagnosis
from .assumptions import assumptions
from .diagnosis_charts import ALWAYS, LEAST, bands, bar_class
from .diagnosis_figures import Pictures, draw_pictures, gap_bars
from .effect_words import DIRECTIONS, PHASES, alternative_label, effect_label, found_effects, listed
from .number_format import counted, estimate_text, finite_or_zero, number_text, percent_text, quantity_text
from .object_heatmaps import VIEWS
from .wording import (
    alternatives_sentence,
    closure_sentence,
    control_sentences,
    headline,
    meaning,
    remains,
    shares_sentence,
)

MAX_ROWS = 80
"""Rows in the table of time intervals; the largest shares are kept."""

_TEMPLATE = Path(__file__).with_name("diagnosis_page.html")
_MARKS = {"found-fill": "verdict", "nominal-fill": "indistinguishable from it"}
VERIFIED = {
    "confirmed": "confirmed: closer to the recording",
    "contradicted": "contradicted: farther from the recording",
    "undecided": "undecided: no difference beyond that of two resolutions",
}
"""Result of a verification run in words."""
_BAR = 110.0
"""Width of a probability bar in CSS pixels, as in the template."""


def scene_effects(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return entries for the ``effects`` list of ``scene.json``, parameters rounded to six digits.

    Empty where nothing was found, where the effect only concerns the recording, or where a parameter is not finite.
    """
    ranked = {item.name: item for item in diagnosis.effects}
    entries = []
    for name in found_effects(diagnosis.verdict):
        if name not in ranked or ranked[name].kind == "observation":
            continue
        values = {key: estimate.value for key, estimate in ranked[name].parameters.items()}
        if not values or not all(math.isfinite(value) for value in values.values()):
            return []
        entries.append({"name": name, "parameters": {key: float(f"{value:.6g}") for key, value in values.items()}})
    return entries


def scene_effects_json(diagnosis: Diagnosis) -> str | None:
    """Return the same entries as JSON text, one effect per line; None where there is nothing to add."""
    entries = scene_effects(diagnosis)
    if not entries:
        return None
    lines = ",\n".join(f"  {json.dumps(entry, ensure_ascii=False)}" for entry in entries)
    return f'"effects": [\n{lines}\n]'


def write_report(diagnosis: Diagnosis, capture: Capture, out: Path) -> None:
    """Write ``report.html`` and its figures into the folder ``out``, created if missing.

    The page is self-contained: style and figures are inline, nothing is loaded, no script runs. The figures are also
    written as ``timeline.svg``, ``object.svg``, ``ranking.svg``, ``gap.svg`` and, if there are trials, ``tracks.svg``.
    The same diagnosis gives the same bytes. NaN, empty trials and missing predictions are shown as unknown.

    Raises InputError, with the remedy, when a file cannot be written.
    """
    pictures = draw_pictures(diagnosis, capture)
    style = picture_style()
    for name, picture in pictures.files().items():
        write_bytes(out / name, picture.file(style).encode())
    write_bytes(out / PAGE_FILE, render_page(diagnosis, capture, pictures).encode())


def render_page(diagnosis: Diagnosis, capture: Capture, pictures: Pictures) -> str:
    """Return the page as text."""
    verdict, effects = diagnosis.verdict, diagnosis.effects
    title = headline(diagnosis)
    name = "" if diagnosis.provenance is None else shortened(diagnosis.provenance.capture or "", 60)
    alike = [item for item in effects if item.reason == SAME]
    others = [item for item in effects if item.reason != SAME]
    shown = [item for i, item in enumerate(others) if i < ALWAYS or finite_or_zero(item.probability) >= LEAST]
    folded = others[len(shown) :]
    if diagnosis.pair is not None:
        # One line for two causes that were found together.
        shown = [i for i in shown if i.name not in diagnosis.pair.effects]
        folded = [i for i in folded if i.name not in diagnosis.pair.effects]
    intervals = sorted(diagnosis.where.intervals, key=lambda i: -finite_or_zero(i.share))[:MAX_ROWS]
    kinds = {item.name: item.kind for item in effects}
    observed = [effect_label(name) for name in found_effects(verdict) if kinds.get(name) == "observation"]
    notes = [*control_sentences(diagnosis), *diagnosis.warnings, *capture.warnings]
    return render(
        _TEMPLATE,
        head=page_head(f"{name}: {title}" if name else title, page_style()),
        capture=name,
        counted=counted,
        prose=prose,
        diagnosis=diagnosis,
        pictures=pictures,
        version=VERSION,
        headline=title,
        explanation=[s for s in (meaning(diagnosis, capture), alternatives_sentence(verdict)) if s],
        facts=_facts(diagnosis),
        notes=list(dict.fromkeys(notes)),
        shares=_shares(diagnosis, several=len(capture.objects) > 1),
        bands=bands(diagnosis, capture),
        intervals=intervals,
        objects=_object_rows(pictures),
        shown=shown,
        folded=folded,
        folded_probability=sum(finite_or_zero(item.probability) for item in folded),
        alike=listed([effect_label(item.name) for item in alike], "and"),
        alike_probability=sum(finite_or_zero(item.probability) for item in alike),
        pair=diagnosis.pair,
        provenance=diagnosis.provenance,
        closure=closure_sentence(diagnosis),
        gap_bars=gap_bars(diagnosis),
        next_experiment=_next_experiment(diagnosis),
        observed=listed(observed, "and"),
        scene_entry=scene_effects_json(diagnosis),
        nothing_to_add=_nothing_to_add(diagnosis),
        assumptions=assumptions(capture),
        verification=[
            (shortened(str(key).replace("_", " "), 60), _value(value))
            for key, value in diagnosis.confirmation.items()
            if key != "takes"
        ],
        verified=[
            {**take, "word": VERIFIED.get(take["word"], take["word"])}
            for take in diagnosis.confirmation.get("takes") or ()
        ],
        marks=_MARKS,
        bar_class=bar_class,
        bar_width=lambda probability: short_number(max(min(finite_or_zero(probability), 1.0) * _BAR, 1.0)),
        effect_label=effect_label,
        estimate_text=estimate_text,
        length=lambda value: quantity_text(value, "m"),
        number=number_text,
        percent=percent_text,
        seconds=lambda value: f"{value:.3f}" if math.isfinite(value) else "–",
        shortened=shortened,
    )


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Return (name, value, detail) of the numbers at the top."""
    verdict, gap = diagnosis.verdict, diagnosis.gap
    explained = "Probability that no known effect is missing" if remains(gap) else "Probability that nothing is missing"
    probability = {NONE: explained, UNKNOWN: "Probability of an unknown cause"}
    chances = {item.name: item.probability for item in diagnosis.effects}
    alternatives = [n for n in verdict.alternatives[:3] if n in chances]
    others = (f"{alternative_label(verdict, n)} {percent_text(chances[n])}" for n in alternatives)
    name = probability.get(verdict.effect, "Probability of this cause")
    facts = [(name, percent_text(verdict.probability), ", ".join(others))]
    if not gap.resolvable:
        facts.append(("Gap closed", "not resolvable", "too close to the noise floor"))
    elif found_effects(verdict):
        low, high = gap.closed_fraction_ci95
        spread = f"95 %: {percent_text(low)} to {percent_text(high)}" if math.isfinite(low + high) else ""
        facts.append(("Gap closed on held-out motion", percent_text(gap.closed_fraction), spread))
    before, after, floor = (
        quantity_text(value, "m", digits=2) for value in (gap.before_rms_m, gap.after_rms_m, gap.noise_floor_rms_m)
    )
    if found_effects(verdict):
        facts.append(("Error, before → after", f"{before} → {after}", f"noise floor: {floor}"))
    else:
        facts.append(("Error of the nominal model", before, f"noise floor: {floor}"))
    return facts


NO_DISCREPANCY = "No discrepancy above the noise was found"
LEFT = "What is left is above the noise, and no candidate accounts for it."
NOWHERE = (
    "At no single moment does a missing force stand out from the noise, so that it has neither place nor direction."
)


def _shares(diagnosis: Diagnosis, *, several: bool) -> list[str]:
    """Return the localisation of the discrepancy in sentences."""
    if diagnosis.verdict.effect == NONE and not remains(diagnosis.gap):
        return [f"{NO_DISCREPANCY}: the figures below show mostly noise."]
    opening = [LEFT] if diagnosis.verdict.effect == NONE else []
    scores = [trial.frame_score for trial in diagnosis.trials.values()]
    if scores and not any((s > 0).any() for s in scores):
        # Shares of nothing are equal.
        return [*opening, NOWHERE]
    where = diagnosis.where
    phases: dict[str, float] = {}
    for interval in where.intervals:
        phases[interval.phase] = phases.get(interval.phase, 0.0) + finite_or_zero(interval.share)
    groups: tuple[tuple[str, Iterable[tuple[str, float]]], ...] = (
        ("Discrepancy by phase", ((PHASES.get(phase, phase), share) for phase, share in phases.items())),
        ("Direction of the missing force", ((DIRECTIONS.get(n, n), s) for n, s in where.direction.items())),
        ("Discrepancy by object", ((shortened(o.name, 40), o.share) for o in where.objects if several)),
    )
    sentences = ((title, shares_sentence(shares)) for title, shares in groups)
    return [*opening, *(f"{title}: {shares}." for title, shares in sentences if shares)]


def _object_rows(pictures: Pictures) -> list[list[Any]]:
    """Return a row of views for each object, with the colour legend in the first."""
    *views, legend = pictures.objects
    rows = [views[i : i + len(VIEWS)] for i in range(0, len(views), len(VIEWS))] or [[]]
    return [[*rows[0], legend], *rows[1:]]


def _next_experiment(diagnosis: Diagnosis) -> str:
    if diagnosis.next_experiment:
        return diagnosis.next_experiment
    if diagnosis.verdict.effect == UNKNOWN:
        return "No recording is known that would narrow it down; vary one thing at a time."
    if diagnosis.verdict.effect == NONE and remains(diagnosis.gap):
        return "Record the same motion two more times: what is left here does not show its cause."
    return "No further recording is needed to distinguish the causes."


def _nothing_to_add(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict.effect == NONE and remains(diagnosis.gap):
        return "There is nothing to add: no effect stands out. Do not tune one until it fits."
    return {
        NONE: "There is nothing to add: keep the scene as it is.",
        UNKNOWN: "There is nothing to add: no known effect is right. Do not tune one until it fits.",
    }.get(diagnosis.verdict.effect, "The effect’s parameters are not known well enough to add it to a scene.")


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return number_text(float(value), digits=4)
    return shortened(value, 200)
