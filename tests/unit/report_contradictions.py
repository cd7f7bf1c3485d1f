# SPDX-License-Identifier: MIT
"""What no report may say beside something else that it says."""

import math
import re

from physgen.sim.effects.registry import effects

TOLERANCE = 1e-6


def contradictions(report, page, *, dropped=False, lands=True):
    """Return sentences on what contradicts itself in ``report`` (report.json) and ``page`` (its text); [] if nothing.

    dropped, lands: whether nothing in the capture moved sideways, and whether anything reached the ground.
    """
    return [
        *_probabilities(report),
        *_gap(report, page),
        *_rows(report),
        *_pair(report, page),
        *_words(report, page, dropped, lands),
    ]


def _probabilities(report):
    verdict, rows = report["verdict"], report["effects"]
    by_name = {row["name"]: row for row in rows}
    if abs(sum(row["probability"] for row in rows) - 1) > TOLERANCE:
        yield "probabilities do not sum to 1"
    if verdict["probability"] < max(row["probability"] for row in rows) - TOLERANCE:
        yield "the verdict is not the most probable row"
    for name in (verdict["effect"], *verdict["alternatives"], *verdict["effects"]):
        if name not in by_name:
            yield f"{name} is named and not listed"
    if verdict["effect"] in verdict["alternatives"]:
        yield "the verdict is its own alternative"


def _gap(report, page):
    gap, verdict = report["gap"], report["verdict"]["effect"]
    before, after, floor = gap["before_rms_m"], gap["after_rms_m"], gap["noise_floor_rms_m"]
    closed, (low, high) = gap["closed_fraction"], gap["closed_fraction_ci95"]
    if floor > min(before, after) + TOLERANCE:
        yield f"an error below the noise floor of {floor}"
    high_floor = (verdict == "none" or gap["resolvable"]) and floor > 3 * gap["noise_rms_m"]
    if high_floor and "far above the tracking noise" not in page:
        yield "a noise floor far above the noise, unexplained"
    if verdict == "none" and (closed is not None or low is not None):
        yield "nothing is missing, and a share of the gap is closed"
    if (closed is not None) != gap["resolvable"] and verdict != "none":
        yield "a share of a gap that is not resolvable, or none of one that is"
    if closed is not None:
        if not -1 <= closed <= 1:
            yield f"{closed:.0%} of a gap closed"
        if before > floor and closed > -1 and abs(closed - (before - after) / (before - floor)) > 1e-6:
            yield "a closed fraction that its errors do not give"
    if low is not None and (closed is None or not -1 <= low <= closed <= high <= 1):
        yield f"an interval {low} to {high} that is not around {closed}"
    grain = math.hypot(floor, gap["grain_rms_m"])
    if verdict == "none" and before > 3.0001 * grain:
        yield f"nothing is missing, with an error of {before} beside noise and grain of {grain}"
    if verdict == "none" and before > 1.50001 * grain:
        if "down to its noise" in report["summary"]:
            yield f"explained down to its noise, with an error of {before} beside noise and grain of {grain}"
        if "no gap to close" in page or "No discrepancy above the noise" in page:
            yield f"no gap, with an error of {before} beside noise and grain of {grain}"
        for words in ("Nothing is missing", "that nothing is missing", "No effect needs", "keep the scene as it is"):
            if words in page:
                yield f"“{words}”, with an error of {before} beside noise and grain of {grain}"
    found = verdict not in ("none", "unknown") and gap["resolvable"]
    if found and after > 1.50001 * grain and "not the whole cause" not in page:
        yield f"a cause with an error of {after} left, beside noise and grain of {grain}, unsaid"
    errors = [before, after, gap["refitted_rms_m"], *report["controls"].values()]
    errors += [row["heldout_rms_m"] for row in report["effects"]]
    if any(e is not None and e < floor - TOLERANCE for e in errors) and "below it is so by chance" not in page:
        yield "an error below the noise floor, unexplained"
    if gap["numerics_rms_m"] > after and "own numerical error" in page:
        yield "more numerical error than error"


def _rows(report):
    verdict, schemas = report["verdict"], effects()
    named = {verdict["effect"], *verdict["effects"], *verdict["alternatives"]}
    for row in report["effects"]:
        name, closed = row["name"], row["closed_fraction"]
        if closed is not None and not -1 <= closed <= 1:
            yield f"{name} closes {closed:.0%}"
        if closed is not None and verdict["effect"] == "none":
            yield f"{name} closes a gap that is not there"
        if closed is not None and closed >= 0.98 and verdict["effect"] == "unknown":
            yield f"no known effect, and {name} closes {closed:.0%}"
        if name not in named and name != "unknown" and not row["reason"]:
            yield f"{name} is rejected without a reason"
        if name == verdict["effect"] and row["reason"]:
            yield f"{name} is the verdict and rejected: {row['reason']}"
        if name == "none" and row["heldout_rms_m"] > report["gap"]["before_rms_m"] + TOLERANCE:
            yield "two errors of the nominal model"
        for key, estimate in row["parameters"].items():
            low, high = estimate["ci95"]
            schema = next(p for p in schemas[name].parameters if p.name == key)
            if not schema.low - TOLERANCE <= low <= estimate["value"] <= high <= schema.high + TOLERANCE:
                yield f"{name}.{key}: {estimate['value']} in {low} to {high}, allowed {schema.low} to {schema.high}"


def _pair(report, page):
    pair, names = report.get("pair"), report["verdict"]["effects"]
    if (pair is None) != (len(names) < 2):
        yield "two causes without their line, or a line without two causes"
    if pair is None:
        return
    if pair["effects"] != names or pair["probability"] != report["verdict"]["probability"]:
        yield "the pair is not the verdict"
    if [a["effect"] for a in pair["adds"]] != names:
        yield "what each of two causes adds is not told"
    if abs(pair["heldout_rms_m"] - report["gap"]["after_rms_m"]) > TOLERANCE:
        yield "two errors of the pair"
    for one in pair["adds"]:
        if one["nats"] <= 0:
            yield f"{one['effect']} adds nothing to the other cause"
        for key, estimate in one["parameters"].items():
            if not estimate["ci95"][0] <= estimate["value"] <= estimate["ci95"][1]:
                yield f"{one['effect']}.{key}: outside its interval"
            if key.replace("_", " ") not in page:
                yield f"{one['effect']}.{key} is not on the page"


def _words(report, page, dropped, lands):
    gap, verdict, advice = report["gap"], report["verdict"], report["next_experiment"] or ""
    if dropped and any(word in advice.lower() for word in ("throw", "opposite", "roll ", "slide", "twice the height")):
        yield f"a drop cannot be repeated so: {advice}"
    if not lands and any(word in advice.lower() for word in ("slide", "roll ", "bounce", "ground")):
        yield f"nothing lands there: {advice}"
    if "closes" in report["summary"] and verdict["effect"] in ("none", "unknown"):
        yield f"closes without a cause: {report['summary']}"
    if "do not trust this cause" in page and verdict["probability"] >= 0.95:
        yield "almost certainly the cause, and not to be trusted"
    if verdict["effect"] not in ("none", "unknown"):
        if gap["resolvable"] and gap["before_rms_m"] < gap["grain_rms_m"] and "chaotic" not in page:
            yield "a share of a gap within the simulator's own uncertainty, unsaid"
        if gap["refitted_rms_m"] <= gap["after_rms_m"]:
            how = "better" if gap["refitted_rms_m"] < 0.9 * gap["after_rms_m"] else "as well"
            if not re.search(rf"own parameters\b[^.]*? does {how}", page):
                yield "re-fitting does as well or better, unsaid"
        beaten = [v for v in report["controls"].values() if v is not None and v <= gap["after_rms_m"]]
        if beaten and "not a cause" not in page:
            yield "a control does as well, unsaid"
    for words in re.findall(r"(?<![\d.,])1 (?:trials|tracked points|effects|causes)\b", page):
        yield f"one of several: {words}"
    for words in re.findall(r"10⁻[\d⁰¹²³⁴-⁹]+\s*[µn]m", page):
        yield f"a length smaller than an atom: {words}"
    made = report["provenance"]
    for words in (made["content_sha256"], made["version"], made["command"]):
        if words not in page:
            yield f"{words} is not on the page"
    for name, what in report["work"]["skipped"].items():
        if name not in page:
            yield f"{name} was not {what}, unsaid"
