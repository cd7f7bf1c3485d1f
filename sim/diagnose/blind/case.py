# SPDX-License-Identifier: MIT
"""A generated case: the capture that a diagnosis gets, and apart from it what is true."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...atomic import replacing
from ..capture import Capture, save_capture
from ..diagnosis import NONE

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TrialTruth:
    """One take without noise. T frames shown, P withheld, K points.

    points: (T, K, 3) m; active: (T,) whether the cause acts; withheld: (P, K, 3) m and withheld_active: (P,), of a
    predict take. point_mask: (K,) the points on which it acts, where it acts on some only.
    """

    points: Array
    active: NDArray[np.bool_]
    withheld: Array | None = None
    withheld_active: NDArray[np.bool_] | None = None
    point_mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, kw_only=True)
class Truth:
    """effects: the causes, the strongest first; () for ``none`` and ``unknown``. mechanism: what acted, in words.

    oracle_rms_m: distance left on the withheld frames by the true model started from the shown frames.
    effect_rms_over_noise: size of the effect. ambiguous_with: effects that no data of this kind tell from it → why.
    """

    effect: str
    effects: tuple[str, ...]
    mechanism: str
    simulator: str
    parameters: Mapping[str, Any]
    oracle_rms_m: float
    effect_rms_over_noise: float
    trials: Mapping[str, TrialTruth]
    ambiguous_with: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def label(self) -> dict[str, Any]:
        """What is sealed of it, as plain JSON values: everything but the arrays."""
        return {
            "effect": self.effect,
            "effects": list(self.effects),
            "mechanism": self.mechanism,
            "simulator": self.simulator,
            "parameters": dict(self.parameters),
            "ambiguous_with": dict(self.ambiguous_with),
            "oracle_rms_m": self.oracle_rms_m,
            "effect_rms_over_noise": self.effect_rms_over_noise,
            **self.notes,
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """``TAKE.points``, ``TAKE.effect_active`` and, where there, ``points_predict``, ``point_mask``."""
        out: dict[str, NDArray[Any]] = {}
        for name, trial in self.trials.items():
            out[f"{name}.points"] = trial.points.astype(np.float32)
            out[f"{name}.effect_active"] = trial.active
            if trial.withheld is not None and trial.withheld_active is not None:
                out[f"{name}.points_predict"] = trial.withheld.astype(np.float32)
                out[f"{name}.effect_active_predict"] = trial.withheld_active
            if trial.point_mask is not None and self.effect != NONE:
                out[f"{name}.point_mask"] = trial.point_mask
        return out


@dataclass(frozen=True, kw_only=True)
class BlindCase:
    """What the diagnosis sees and what it must not see."""

    capture: Capture
    truth: Truth


def write_case(case: BlindCase, capture_root: Path, truth_root: Path, name: str) -> None:
    """Capture folder ``capture_root/name`` and ``truth_root/name.json`` and ``.npz``; the truth first."""
    truth_root.mkdir(parents=True, exist_ok=True)
    with replacing(truth_root / f"{name}.npz") as partial:
        np.savez_compressed(partial, **case.truth.arrays())  # type: ignore[arg-type]
    with replacing(truth_root / f"{name}.json") as partial:
        partial.write_text(json.dumps(case.truth.label(), indent=1), encoding="utf-8")
    save_capture(case.capture, capture_root / name)
