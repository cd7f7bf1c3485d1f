# SPDX-License-Identifier: MIT
"""The page: the verdict first, then where, which and how far, what to record next, and how to use what was found."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence

from ...page.markup import Markup, Picture, element, join, shortened
from ...page.style import page_style
from ...version import VERSION
from ..capture import Capture
from ..diagnosis import NONE, UNKNOWN, Diagnosis
from .assumptions import assumptions
from .gap import gap_bars
from .object_picture import VIEWS
from .pictures import Pictures
from .quantities import number_text, percent_text, quantity_text
from .ranking import split, table
from .scene_entry import scene_effects_json
from .timeline import bands
from .words import (
    DIRECTIONS,
    PHASES,
    alternatives_sentence,
    closure_sentence,
    control_sentences,
    effect_label,
    found_effects,
    headline,
    listed,
    meaning,
    or_dash,
    shares_sentence,
)

MAX_ROWS = 80
"""Rows of the table of stretches of time; the largest shares are kept."""


def page(diagnosis: Diagnosis, capture: Capture, pictures: Pictures) -> str:
    """The whole page as text; needs nothing outside itself and may load nothing."""
    style = page_style()
    allowed = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; style-src 'sha256-{allowed}'; img-src data:; base-uri 'none'; form-action 'none'"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="referrer", content="no-referrer"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"Diagnosis: {headline(diagnosis)}"),
        element("style", Markup(style)),
    )
    body = element(
        "body",
        _verdict(diagnosis, capture),
        element(
            "main",
            _where(diagnosis, capture, pictures),
            _which(diagnosis),
            _how_far(diagnosis, pictures),
            _next(diagnosis),
            _use(diagnosis),
            _assumed(diagnosis, capture),
        ),
        _footer(diagnosis),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _verdict(diagnosis: Diagnosis, capture: Capture) -> Markup:
    notes = [*control_sentences(diagnosis), *diagnosis.warnings, *(w for w in capture.warnings)]
    alternatives = alternatives_sentence(diagnosis.verdict)
    return element(
        "header",
        element("p", "Where simulation and recording part, and why", class_="eyebrow"),
        element("h1", headline(diagnosis)),
        element("p", diagnosis.summary, class_="lead") if diagnosis.summary.strip() else None,
        element("p", meaning(diagnosis.verdict)) if meaning(diagnosis.verdict) else None,
        element("p", alternatives) if alternatives else None,
        _facts(diagnosis),
        _notes(list(dict.fromkeys(notes))),
    )


def _facts(diagnosis: Diagnosis) -> Markup:
    verdict, gap = diagnosis.verdict, diagnosis.gap
    sure = {NONE: "Probability that nothing is missing", UNKNOWN: "Probability of an unknown cause"}
    chances = {item.name: item.probability for item in diagnosis.effects}
    facts: list[tuple[str, str, str]] = [
        (
            sure.get(verdict.effect, "Probability of this cause"),
            percent_text(verdict.probability),
            ", ".join(
                f"{effect_label(n)} {percent_text(chances[n])}" for n in verdict.alternatives[:3] if n in chances
            ),
        )
    ]
    if not gap.resolvable:
        facts.append(("Gap closed", "not resolvable", "too near the noise for a share to mean anything"))
    elif found_effects(verdict):
        low, high = gap.closed_fraction_ci95
        spread = f"95 %: {percent_text(low)} to {percent_text(high)}" if math.isfinite(low + high) else ""
        facts.append(("Gap closed, on motion no fit saw", percent_text(gap.closed_fraction), spread))
    before, after = (quantity_text(value, "m", digits=2) for value in (gap.before_rms_m, gap.after_rms_m))
    floor = f"the recording's noise alone: {quantity_text(gap.noise_floor_rms_m, 'm', digits=2)}"
    if found_effects(verdict):
        facts.append(("Error, before → after", f"{before} → {after}", floor))
    else:
        facts.append(("Error as believed", before, floor))
    return element(
        "dl",
        *(
            element("div", element("dt", name), element("dd", value, element("small", more) if more else None))
            for name, value, more in facts
        ),
        class_="facts",
    )


def _notes(notes: Sequence[str]) -> Markup | None:
    if not notes:
        return None
    title = "Worth knowing before you rely on this"
    items = element("ul", *(element("li", note) for note in notes))
    return element("aside", element("h2", title), items, class_="notes", aria_label=title)


def _where(diagnosis: Diagnosis, capture: Capture, pictures: Pictures) -> Markup:
    return element(
        "section",
        element("h2", "Where does it part?"),
        *(element("p", sentence) for sentence in _shares(diagnosis, several=len(capture.objects) > 1)),
        element("h3", "When"),
        element(
            "figure",
            _both(pictures.timeline_wide, pictures.timeline_narrow, "timeline"),
            element(
                "figcaption",
                "What the simulation as believed lacks at each moment, as force per mass: not the error piled up so "
                "far. A dot marks the worst moment of each take."
                + (" The vertical scale is a square root, so that small and large both show." if pictures.root else ""),
            ),
            _moments(diagnosis, capture),
        ),
        element("h3", "On the object"),
        element(
            "figure",
            _objects(pictures),
            element("figcaption", "In the object's rest frame. Between tracked points the colour is interpolated."),
        ),
        element("h3", "In motion"),
        element(
            "figure",
            _tiles([*pictures.tracks, pictures.tracks_key] if pictures.tracks else [], "tracks"),
            element(
                "figcaption",
                f"{pictures.tracks_seen} Small dots and thin outlines are tracked points at a few moments; "
                "of takes to be predicted, what lies beyond the observed dots is the prediction.",
            ),
        )
        if pictures.tracks
        else element("p", "There is no take to show.", class_="quiet"),
        id="where",
    )


def _shares(diagnosis: Diagnosis, *, several: bool) -> list[str]:
    """Where the discrepancy sits, in sentences; where nothing is missing, that there is none to speak of."""
    if diagnosis.verdict.effect == NONE:
        return ["No discrepancy beyond the noise was found: what the pictures below show is mostly noise."]
    phases: dict[str, float] = {}
    for interval in diagnosis.where.intervals:
        phases[interval.phase] = phases.get(interval.phase, 0.0) + _finite(interval.share)
    said = (
        ("Of the discrepancy", ((PHASES.get(phase, phase), share) for phase, share in phases.items())),
        ("The force that is lacking points", ((DIRECTIONS.get(n, n), s) for n, s in diagnosis.where.direction.items())),
        ("By object", ((shortened(o.name, 40), o.share) for o in diagnosis.where.objects if several)),
    )
    sentences = ((words, shares_sentence(shares)) for words, shares in said)
    return [f"{words}: {shares}." for words, shares in sentences if shares]


def _moments(diagnosis: Diagnosis, capture: Capture) -> Markup:
    worst = [
        element(
            "tr",
            element("th", element("bdi", shortened(band.name, 60)), scope="row"),
            element("td", f"{band.worst.time:.3f} s" if band.worst else "–"),
            element("td", f"{number_text(band.worst.score)} m/s²" if band.worst else "–"),
        )
        for band in bands(diagnosis, capture)
    ]
    ordered = sorted(diagnosis.where.intervals, key=lambda i: -_finite(i.share))[:MAX_ROWS]
    stretches = [
        element(
            "tr",
            element("th", element("bdi", shortened(item.trial, 60)), scope="row"),
            element("td", shortened(item.phase, 24)),
            element("td", f"{_seconds(item.start_s)} to {_seconds(item.end_s)} s"),
            element("td", percent_text(item.share)),
        )
        for item in ordered
    ]
    return element(
        "details",
        element("summary", "The same as tables"),
        _table("Worst moment of each take", ("Take", "Recorded time", "Lacking"), worst),
        _table("Stretches of time, largest share first", ("Take", "Phase", "Recorded time", "Share"), stretches),
    )


def _which(diagnosis: Diagnosis) -> Markup:
    shown, folded = split(diagnosis)
    together = sum(_finite(item.probability) for item in folded)
    return element(
        "section",
        element("h2", "Which cause?"),
        element(
            "p",
            "Every candidate was fitted to some of the motion and judged on motion it had not seen. Probabilities, "
            "with “nothing missing” and “a cause not known here” among them, add up to 100 %.",
        ),
        table(diagnosis, shown, caption="Candidates, most probable first")
        if shown
        else element("p", "No candidate was tried.", class_="quiet"),
        element(
            "details",
            element("summary", f"{len(folded)} more candidates, together {percent_text(together)}"),
            table(diagnosis, folded, caption="Less probable candidates"),
            class_="more",
        )
        if folded
        else None,
        id="which",
    )


def _how_far(diagnosis: Diagnosis, pictures: Pictures) -> Markup:
    rows = [
        element("tr", element("th", bar.said, scope="row"), element("td", quantity_text(bar.value, "m")))
        for bar in gap_bars(diagnosis)
    ]
    return element(
        "section",
        element("h2", "How far does the gap close?"),
        element("p", closure_sentence(diagnosis)),
        element(
            "figure",
            element("div", pictures.bars.inline("gap-bars"), pictures.growth.inline("gap-growth"), class_="pair"),
            element(
                "figcaption",
                "Re-fitting the numbers that the simulation already has is shown apart, so that tuning is never taken "
                "for a cause. A cause has to beat the controls, and nothing can be better than the noise: the mark on "
                "each bar, the dotted line.",
            ),
            element("details", element("summary", "The same as a table"), _table("Errors", ("What", "Error"), rows)),
        ),
        id="how-far",
    )


def _next(diagnosis: Diagnosis) -> Markup:
    if diagnosis.next_experiment:
        said = element("p", diagnosis.next_experiment, class_="next")
    elif diagnosis.verdict.effect == UNKNOWN:
        said = element("p", "No recording is known that would narrow it down; vary one thing at a time.", class_="next")
    else:
        said = element("p", "Nothing more needs to be recorded to tell the causes apart.", class_="next")
    return element("section", element("h2", "What to record next"), said, id="next")


def _use(diagnosis: Diagnosis) -> Markup:
    found = found_effects(diagnosis.verdict)
    kinds = {item.name: item.kind for item in diagnosis.effects}
    observed = [name for name in found if kinds.get(name) == "observation"]
    entry = scene_effects_json(diagnosis)
    parts: list[Markup | None] = []
    if observed:
        names = listed([effect_label(name) for name in observed], "and")
        parts.append(
            element(
                "p",
                f"This is about {names}: the recording is to be corrected and the scene stays as it is. "
                "Adding it to a scene moves nothing.",
            )
        )
    if entry:
        parts += [
            element(
                "p",
                "In Blender: PhysGen’s Diagnose panel, ",
                element("kbd", "Add found effect and bake"),
                ". Or by hand, in ",
                element("code", "scene.json"),
                ":",
            ),
            element("pre", element("code", entry), tabindex="0", aria_label="Entry for scene.json"),
            element(
                "p",
                "It acts on every object it can act on; name some in “objects” to limit it. "
                "Numbers are rounded to six digits here; report.json has them in full.",
                class_="quiet",
            ),
        ]
    if not parts:
        said = {
            NONE: "There is nothing to add: keep the scene as it is.",
            UNKNOWN: "There is nothing to add: no known effect would be right. Do not tune one until it fits.",
        }.get(diagnosis.verdict.effect, "The effect’s numbers are not known well enough to add it to a scene.")
        parts.append(element("p", said))
    return element("section", element("h2", "How to use it in your scene"), *parts, id="use")


def _assumed(diagnosis: Diagnosis, capture: Capture) -> Markup:
    return element(
        "section",
        element("h2", "What was assumed"),
        element("ul", *(element("li", line) for line in assumptions(capture)), class_="plain"),
        _confirmation(diagnosis.confirmation),
        id="assumed",
    )


def _confirmation(confirmation: Mapping[str, object]) -> Markup | None:
    rows = [
        element(
            "tr", element("th", shortened(str(key).replace("_", " "), 60), scope="row"), element("td", _value(value))
        )
        for key, value in confirmation.items()
    ]
    if not rows:
        return None
    return element(
        "details",
        element("summary", "What the simulation engine confirmed"),
        _table("Confirmation in the engine", ("What", "Value"), rows),
    )


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return number_text(float(value), digits=4)
    return shortened(value, 200)


def _footer(diagnosis: Diagnosis) -> Markup:
    took = f" It took {diagnosis.seconds:.0f} s." if math.isfinite(diagnosis.seconds) and diagnosis.seconds > 0 else ""
    return element(
        "footer",
        f"PhysGen {VERSION}.{took} The same as data: report.json, where.npz and prediction.npz beside this page; "
        "the pictures are there as .svg files.",
    )


def _table(caption: str, head: Sequence[str], rows: Sequence[Markup]) -> Markup:
    return element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *(element("th", name, scope="col") for name in head))),
        element("tbody", *(rows or [element("tr", element("td", or_dash(None), colspan=str(len(head))))])),
    )


def _both(wide: Picture, narrow: Picture, name: str) -> Markup:
    return join([wide.inline(f"{name}-wide", "wide"), narrow.inline(f"{name}-narrow", "narrow")])


def _tiles(pictures: Sequence[Picture], name: str) -> Markup:
    return element("div", *(p.inline(f"{name}-{i}") for i, p in enumerate(pictures, 1)), class_="tiles")


def _objects(pictures: Pictures) -> Markup:
    """A row for each object: its views, and the scale of the colours beside the first."""
    *views, legend = pictures.objects
    pairs = [views[i : i + len(VIEWS)] for i in range(0, len(views), len(VIEWS))] or [[]]
    pairs[0] = [*pairs[0], legend]
    return join(_tiles(pair, f"object-{row}") for row, pair in enumerate(pairs, 1))


def _seconds(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
