# SPDX-License-Identifier: MIT
"""Answers of a questionnaire: read, checked, and turned into means, intervals, preferences and agreement."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing_tree, write_bytes, write_json
from ..errors import InputError
from ..files import shown, without_folder
from ..folder_lock import lock_beside
from ..validation import finite_or_none, quantity, read_json, require_quantities
from ..version import VERSION
from .evaluation import no_formula
from .judge_question import CRITERIA, TITLES
from .questionnaire import ANSWERS_FORMAT, load_key
from .questionnaire_report import PAGE_FILE, result_page

Array = NDArray[np.float64]

RESULT_FILE, TABLE_FILE = "questionnaire.json", "scores.csv"
MOST_PEOPLE = 2000
_PERSON = re.compile(r"[A-Za-z0-9_-]{1,40}\Z")


@dataclass(frozen=True, kw_only=True)
class CollectOptions:
    """Options of evaluating answers. resamples, seed: of the bootstrap, 100 to 100000. confidence: 0.5 to 0.999."""

    resamples: int = quantity(2000, 100, 100_000, "a whole number")
    confidence: float = quantity(0.95, 0.5, 0.999)
    seed: int = quantity(0, 0, 2**31 - 1, "a whole number")

    def __post_init__(self) -> None:
        require_quantities(self, "questionnaire option ")


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One person's answers: case → video's token → criterion → 1 to 5. saved: when, as the browser wrote it."""

    person: str
    saved: str
    scores: dict[str, dict[str, dict[str, int]]]
    problems: tuple[str, ...] = ()


def read_answers(path: Path, key: dict[str, Any]) -> Sheet:
    """Return the answers of the file ``path`` to the questionnaire of ``key``.

    What is outside of the scale or of the questionnaire is left out and named in ``problems``. Raises InputError for a
    file that holds no answers to this questionnaire.
    """
    found = read_json(path)
    if not isinstance(found, dict) or found.get("format") != ANSWERS_FORMAT or not isinstance(found.get("cases"), dict):
        raise InputError(f"{shown(path)}: holds no answers of a questionnaire; give the files that its pages save")
    if found.get("questionnaire") != key["questionnaire"]:
        raise InputError(
            f"{shown(path)}: answers another questionnaire than this key; give the key made with its pages"
        )
    person = found.get("person")
    if not (isinstance(person, str) and _PERSON.match(person)):
        raise InputError(f"{shown(path)}: person is {shown(str(person))!r}; give a file as the page saved it")
    problems: list[str] = []
    cases = {case["id"]: case for case in key["cases"]}
    problems += [
        f"case {shown(str(name))!r} is not of this questionnaire" for name in sorted(set(found["cases"]) - set(cases))
    ]
    scores: dict[str, dict[str, dict[str, int]]] = {}
    for name, case in cases.items():
        given = found["cases"].get(name)
        given = given.get("scores") if isinstance(given, dict) else None
        given = given if isinstance(given, dict) else {}
        problems += [f"{name}: there is no video {shown(str(v))!r}" for v in sorted(set(given) - set(case["videos"]))]
        scores[name] = {}
        for token, video in case["videos"].items():
            of = given.get(token)
            of = of if isinstance(of, dict) else {}
            kept = {}
            for criterion in CRITERIA:
                value = of.get(criterion)
                where = f"{case['name']}, {video}, {TITLES[criterion].lower()}"
                if value is None:
                    problems.append(f"{where}: no answer")
                elif isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 5:
                    kept[criterion] = value
                else:
                    problems.append(f"{where}: {shown(str(value))!r} is not on the scale of 1 to 5; left out")
            scores[name][token] = kept
    saved = found.get("saved")
    return Sheet(
        person=person, saved=saved[:40] if isinstance(saved, str) else "", scores=scores, problems=tuple(problems)
    )


def krippendorff_alpha(ratings: Array, level: str = "ordinal") -> float:
    """Return Krippendorff's α of ``ratings`` (coders, units), NaN where a coder did not rate a unit.

    1 is full agreement, 0 that of chance. level: ``nominal``, ``ordinal`` or ``interval``, the differences δ² of
    Krippendorff (2011), *Computing Krippendorff's Alpha-Reliability*. NaN where nothing was rated twice, or all ratings
    are alike, so that chance is undefined.
    """
    values = np.unique(ratings[np.isfinite(ratings)])
    together = np.zeros((len(values), len(values)))
    for unit in ratings.T:
        rated = unit[np.isfinite(unit)]
        if len(rated) < 2:
            continue
        counts = (rated[:, None] == values[None]).sum(axis=0).astype(float)
        together += (np.outer(counts, counts) - np.diag(counts)) / (len(rated) - 1)
    totals = together.sum(axis=1)
    if level == "ordinal":
        upto = np.cumsum(totals)
        low, high = np.minimum.outer(*(2 * [np.arange(len(values))])), np.maximum.outer(*(2 * [np.arange(len(values))]))
        between = upto[high] - upto[low] + totals[low] if len(values) else together
        difference = (between - (totals[low] + totals[high]) / 2) ** 2 if len(values) else together
    elif level == "interval":
        difference = np.subtract.outer(values, values) ** 2
    elif level == "nominal":
        difference = 1.0 - np.eye(len(values))
    else:
        raise InputError(f"level is {level!r}: give nominal, ordinal or interval")
    expected = float((np.outer(totals, totals) * difference).sum())
    if expected <= 0:
        return math.nan
    return 1.0 - (float(totals.sum()) - 1.0) * float((together * difference).sum()) / expected


def sign_test(wins: int, losses: int) -> float:
    """Return the two-sided p-value of the exact sign test; 1 without any difference."""
    count, least = wins + losses, min(wins, losses)
    return min(1.0, 2 * sum(math.comb(count, k) for k in range(least + 1)) / 2**count) if count else 1.0


def bootstrap_interval(scores: Array, options: CollectOptions) -> tuple[float, float]:
    """Return the percentile interval of the mean of ``scores`` (people, cases), NaN where there is none.

    People and cases are drawn anew, independently of each other, since both are samples.
    """
    random = np.random.default_rng(options.seed)
    people, cases = scores.shape
    given = np.isfinite(scores)
    of_people = random.multinomial(people, np.full(people, 1 / people), options.resamples).astype(float)
    of_cases = random.multinomial(cases, np.full(cases, 1 / cases), options.resamples).astype(float)
    weight = np.einsum("bp,pc,bc->b", of_people, given.astype(float), of_cases, optimize=True)
    total = np.einsum("bp,pc,bc->b", of_people, np.where(given, scores, 0.0), of_cases, optimize=True)
    means = total[weight > 0] / weight[weight > 0]
    if not len(means):
        return math.nan, math.nan
    tail = (1 - options.confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def _sheets(paths: Sequence[Path], key: dict[str, Any]) -> tuple[list[Sheet], list[str]]:
    """All answers, one sheet for each person, and what is wrong with them."""
    files: list[Path] = []
    for path in paths:
        files += sorted(path.glob("*.json")) if path.is_dir() else [path]
    notes: list[str] = []
    kept: dict[str, tuple[Path, Sheet]] = {}
    for path in files:
        try:
            sheet = read_answers(path, key)
        except InputError as error:
            notes.append(f"left out: {without_folder(error, path.parent)}")
            continue
        if not any(values for of in sheet.scores.values() for values in of.values()):
            notes.append(
                f"left out: {_problems_text(path, sheet)}; nothing is left of {sheet.person}, who is not counted"
            )
            continue
        before = kept.get(sheet.person)
        if before is not None and before[1].scores == sheet.scores:
            notes.append(f"{path.name}: holds the same answers of {sheet.person} as {before[0].name}; counted once")
            continue
        if before is not None:
            newer = sheet.saved >= before[1].saved
            used, other = (path, before[0]) if newer else (before[0], path)
            notes.append(f"{sheet.person} answered twice: {used.name}, saved last, counts, and {other.name} does not")
            if not newer:
                continue
        kept[sheet.person] = (path, sheet)
    if not kept:
        raise InputError(f"questionnaire: no usable answers in {len(files)} files" + (f"; {notes[0]}" if notes else ""))
    if len(kept) > MOST_PEOPLE:
        raise InputError(f"questionnaire: answers of {len(kept)} people; give up to {MOST_PEOPLE}")
    for (_, a), (_, b) in itertools.combinations(kept.values(), 2):
        if a.scores == b.scores:
            notes.append(f"{a.person} and {b.person} gave the same answers throughout; both are counted")
    for path, sheet in kept.values():
        if sheet.problems:
            notes.append(_problems_text(path, sheet))
    return [sheet for _, sheet in kept.values()], notes


def _problems_text(path: Path, sheet: Sheet) -> str:
    count = len(sheet.problems)
    first = "; ".join(sheet.problems[:5]) + ("; …" if count > 5 else "")
    return f"{path.name}: {count} answer{'s' * (count != 1)} missing or unusable: {first}"


def collect_questionnaire(
    answers: Sequence[str | Path],
    *,
    key: str | Path,
    out: str | Path,
    options: CollectOptions | None = None,
) -> dict[str, Any]:
    """Return what people answered, and write it to the folder ``out``: report.html, questionnaire.json, scores.csv.

    answers: files that the pages saved, or folders of them. key: ``key.json`` of the questionnaire. The result has
    ``means`` (with bootstrap intervals), ``preferences`` (with sign tests), ``agreement`` (Krippendorff's α) and
    ``notes``, in which everything incomplete, repeated or left out is said.

    Raises InputError without any usable answers, for a damaged key, and an ``out`` that holds something else.

    >>> import physgen
    >>> found = physgen.collect_questionnaire(["answers"], key="questionnaire/key.json", out="result")  # doctest: +SKIP
    >>> found["means"][0]  # doctest: +SKIP
    {'video': 'ours', 'criterion': 'physical_realism', 'mean': 4.1, 'low': 3.8, 'high': 4.4, 'count': 93}
    """
    options, out = options or CollectOptions(), Path(out)
    if out.is_dir() and any(out.iterdir()) and not (out / RESULT_FILE).is_file():
        raise InputError(f"{shown(out)}: holds something other than results; choose an empty or new folder")
    known = load_key(Path(key))
    sheets, notes = _sheets([Path(path) for path in answers], known)
    cases = known["cases"]
    videos = list(dict.fromkeys(name for case in cases for name in case["videos"].values()))
    table = _score_table(sheets, cases, videos)
    for many, what in ((len(sheets), "person"), (len(cases), "case")):
        if many == 1:
            notes.append(f"only one {what}: the intervals say nothing of how another {what} would differ")
    found = {
        "format": "physgen questionnaire result",
        "version": 1,
        "made_by": VERSION,
        "questionnaire": known["questionnaire"],
        "people": len(sheets),
        "cases": len(cases),
        "resamples": options.resamples,
        "confidence": options.confidence,
        "means": _means(table, videos, options),
        "preferences": _preferences(table, videos),
        "agreement": [
            {
                "criterion": name,
                **{level: finite_or_none(krippendorff_alpha(_units(table, k), level)) for level in LEVELS},
            }
            for k, name in enumerate(CRITERIA)
        ],
        "notes": notes,
    }
    with lock_beside(out), replacing_tree(out) as folder:
        write_json(folder / RESULT_FILE, found)
        write_bytes(folder / TABLE_FILE, _csv(sheets, cases))
        write_bytes(folder / PAGE_FILE, result_page(found).encode())
    return found


LEVELS = ("ordinal", "interval")


def _score_table(sheets: Sequence[Sheet], cases: Sequence[dict[str, Any]], videos: Sequence[str]) -> Array:
    """Return the scores by person, case, video and criterion; NaN where there is none."""
    table = np.full((len(sheets), len(cases), len(videos), len(CRITERIA)), np.nan)
    for i, sheet in enumerate(sheets):
        for j, case in enumerate(cases):
            for token, video in case["videos"].items():
                for criterion, value in sheet.scores[case["id"]][token].items():
                    table[i, j, videos.index(video), CRITERIA.index(criterion)] = value
    return table


def _units(table: Array, criterion: int) -> Array:
    """(people, cases and videos): every video of a case is a unit."""
    return table[..., criterion].reshape(len(table), -1)


def _means(table: Array, videos: list[str], options: CollectOptions) -> list[dict[str, Any]]:
    rows = []
    for v, video in enumerate(videos):
        for k, criterion in enumerate(CRITERIA):
            scores = table[:, :, v, k]
            count = int(np.isfinite(scores).sum())
            low, high = bootstrap_interval(scores, options) if count else (math.nan, math.nan)
            mean = float(np.nanmean(scores)) if count else math.nan
            values = {
                "mean": finite_or_none(mean),
                "low": finite_or_none(low),
                "high": finite_or_none(high),
                "count": count,
            }
            rows.append({"video": video, "criterion": criterion, **values})
    return rows


def _preferences(table: Array, videos: list[str]) -> list[dict[str, Any]]:
    rows = []
    for (a, first), (b, second) in itertools.combinations(enumerate(videos), 2):
        for k, criterion in enumerate(CRITERIA):
            gap = table[:, :, a, k] - table[:, :, b, k]
            wins, losses, ties = int((gap > 0).sum()), int((gap < 0).sum()), int((gap == 0).sum())
            people = [float(np.nansum(row)) for row in gap if np.isfinite(row).any()]
            for_first, for_second = sum(total > 0 for total in people), sum(total < 0 for total in people)
            rows.append(
                {
                    "first": first,
                    "second": second,
                    "criterion": criterion,
                    "wins": wins,
                    "ties": ties,
                    "losses": losses,
                    "p": sign_test(wins, losses),
                    "people_for_first": for_first,
                    "people_for_second": for_second,
                    "p_people": sign_test(for_first, for_second),
                }
            )
    return rows


def _csv(sheets: list[Sheet], cases: list[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["person", "case", "video", "criterion", "score"])
    for sheet in sheets:
        for case in cases:
            for token, video in case["videos"].items():
                for criterion in CRITERIA:
                    score = sheet.scores[case["id"]][token].get(criterion, "")
                    row = [sheet.person, case["name"], video, criterion, score]
                    writer.writerow([no_formula(cell) for cell in row])
    return text.getvalue().encode()
