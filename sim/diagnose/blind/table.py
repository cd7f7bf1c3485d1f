# SPDX-License-Identifier: MIT
"""A blind check's score for people."""

from __future__ import annotations

from .score import BlindScore


def score_table(score: BlindScore) -> str:
    """Case by case, the confusion matrix, and the numbers."""
    lines = [f"{'case':9} {'truth':38} {'verdict':19} {'p':>5} right where closed seconds"]
    for r in score.rows:
        truth = " + ".join(r.effects) if len(r.effects) > 1 else r.effect
        if r.effect == "unknown":
            truth = f"unknown ({r.mechanism})"
        right = "first" if r.right_first else "among" if r.right else "-"
        numbers = f"{_number(r.frame_auc, 5)} {_number(r.closed, 6)} {_number(r.seconds, 7, 1)}"
        note = f"  {r.note[:60]}" if r.note else ""
        lines.append(
            f"{r.case:9} {truth:38} {r.verdict or 'no report':19} {r.probability:5.2f} {right:5} {numbers}{note}"
        )
    lines += ["", "truth → verdicts"]
    for truth in sorted(score.confusion):
        counts = sorted(score.confusion[truth].items(), key=lambda item: (-item[1], item[0]))
        lines.append(f"  {truth:38} " + ", ".join(f"{name} {n}" for name, n in counts))
    pairs = [
        ("right first", _share(score.right_first), "right or among alternatives", _share(score.right)),
        ("false alarms on none", _share(score.false_alarms), "abstains on unknown", _share(score.abstentions)),
        ("calibration error", _number(score.calibration_error, 5), "where (AUC)", _number(score.frame_auc, 5)),
        ("closed, median", _number(score.closed_median, 5), "two causes, recall", _share(score.two_cause_recall)),
        ("seconds per case", _number(score.seconds_per_case, 5, 1), "cases", f"{score.cases:5d}"),
    ]
    lines += ["", *(f"{a:22} {b:6}   {c:28} {d}" for a, b, c, d in pairs)]
    lines.append(f"seed {score.seed}, SHA-256 of salt and labels {score.digest}")
    return "\n".join(lines)


def _number(value: float | None, width: int, digits: int = 2) -> str:
    return f"{'-':>{width}}" if value is None else f"{value:{width}.{digits}f}"


def _share(value: float | None) -> str:
    return "    -" if value is None else f"{100 * value:3.0f} %"
