# SPDX-License-Identifier: GPL-3.0-or-later
"""The content of ``report.json`` into a scene's properties; what is malformed or absent is left out, not guessed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..text import readable
from .diagnose import NOT_KNOWN

if TYPE_CHECKING:
    from .diagnose import PHYSGEN_PG_diagnose

GAP = {
    "before_m": "before_rms_m",
    "refitted_m": "refitted_rms_m",
    "after_m": "after_rms_m",
    "floor_m": "noise_floor_rms_m",
    "numerics_m": "numerics_rms_m",
    "closed": "closed_fraction",
}


def fill(state: PHYSGEN_PG_diagnose, report: Mapping[str, Any]) -> None:
    """Let ``state`` show ``report``."""
    clear(state)
    verdict = report["verdict"]
    state.verdict = str(verdict.get("effect", "unknown"))
    state.probability = _number(verdict.get("probability"), 0.0)
    others = [name for name in _texts(verdict.get("effects")) if name != state.verdict]
    if others:
        state.verdict = " + ".join([state.verdict, *others])
    state.alternatives = ", ".join(_texts(verdict.get("alternatives")))
    state.summary = str(report.get("summary") or f"{readable(state.verdict)} ({state.probability:.0%})")
    state.next_experiment = str(report.get("next_experiment") or "")
    for item in report["effects"]:
        if isinstance(item, dict):
            _fill_effect(state.effects.add(), item)
    gap = report["gap"]
    for name, key in GAP.items():
        setattr(state, name, _number(gap.get(key), NOT_KNOWN))
    state.resolvable = gap.get("resolvable") is not False
    for text in _texts(report.get("warnings")):
        state.warnings.add().text = text
    state.has_report = True


def clear(state: PHYSGEN_PG_diagnose) -> None:
    """Let ``state`` show no report."""
    state.effects.clear()
    state.warnings.clear()
    state.effect_index = 0
    state.has_report = False


def _fill_effect(line: Any, item: Mapping[str, Any]) -> None:
    line.name, line.kind = str(item.get("name", "")), str(item.get("kind", ""))
    line.probability = _number(item.get("probability"), 0.0)
    line.closed = _number(item.get("closed_fraction"), NOT_KNOWN)
    line.has_closed = item.get("closed_fraction") is not None
    parameters = item.get("parameters")
    for name, entry in parameters.items() if isinstance(parameters, dict) else ():
        if not isinstance(entry, dict):
            continue
        number = line.parameters.add()
        number.name, number.unit = str(name), str(entry.get("unit") or "")
        number.value = _number(entry.get("value"), math.nan)
        interval = entry.get("ci95")
        low, high = interval if isinstance(interval, list) and len(interval) == 2 else (None, None)
        number.low, number.high = _number(low, math.nan), _number(high, math.nan)


def _number(value: Any, otherwise: float) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else otherwise


def _texts(value: Any) -> list[str]:
    return [str(text) for text in value] if isinstance(value, list) else []
