# SPDX-License-Identifier: MIT
"""What a scene gets to have the found effect: the entries of its ``effects`` list."""

from __future__ import annotations

import json
import math
from typing import Any

from ..diagnosis import Diagnosis
from .words import found_effects


def scene_effects(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Entries of the ``effects`` list of ``scene.json``, parameters to six digits.

    [] where nothing was found, where it concerns the recording alone, or where a number does not exist.
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
    """The same as it stands in the file, one effect a line; None where there is nothing to add."""
    entries = scene_effects(diagnosis)
    if not entries:
        return None
    lines = ",\n".join(f"  {json.dumps(entry, ensure_ascii=False)}" for entry in entries)
    return f'"effects": [\n{lines}\n]'
