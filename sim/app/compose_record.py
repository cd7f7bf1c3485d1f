# SPDX-License-Identifier: MIT
"""``compose.json``: what was done to a composition, and how far its objects are in each other."""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from ..gaussians.compose.asset import Composed
from ..gaussians.physics.penetration import Penetration
from ..scene.model import Scene
from ..version import VERSION
from .compose_objects import Group
from .compose_picture import Likeness
from .compose_request import ComposeRequest

FORMAT = "physgen-compose/1"


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A group that was brought to fit. likeness: before and after, None without a picture; pairs: as in the file."""

    group: Group
    composed: Composed
    likeness: tuple[Likeness, Likeness] | None
    pairs: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]


def record_of(scene: Scene, request: ComposeRequest, fits: Sequence[Fit]) -> dict[str, Any]:
    """The content of ``compose.json`` (docs/file-formats.md)."""
    return {
        "format": FORMAT,
        "method": request.options.method,
        "seed": request.options.seed,
        "options": {
            **dataclasses.asdict(request.options),
            "splats": request.splats,
            "guidance": request.guidance,
            "prompt": request.prompt,
        },
        "picture": scene.photo if request.picture else None,
        "groups": [
            {
                "objects": [body.name for body in fit.group.bodies],
                "likeness": None if fit.likeness is None else [_likeness_json(item) for item in fit.likeness],
                "moved": _ways(fit),
            }
            for fit in fits
        ],
        "pairs": [pair for fit in fits for pair in fit.pairs],
        "notes": [note for fit in fits for note in fit.notes],
        "versions": _versions(),
    }


def _likeness_json(found: Likeness) -> dict[str, float | None]:
    return {"psnr_db": found.psnr if math.isfinite(found.psnr) else None, "ssim": found.ssim}


def _ways(fit: Fit) -> dict[str, dict[str, float]]:
    """How far vertices went, by the name of who yielded."""
    result = {}
    for body, piece in zip(fit.group.bodies[1:], fit.composed.pieces[1:], strict=True):
        way = np.linalg.norm(piece.surface.vertices - body.surface.vertices, axis=1)
        result[body.name] = {"mean_m": float(way.mean()), "farthest_m": float(way.max())}
    return result


def _versions() -> Mapping[str, str]:
    return {
        "physgen": VERSION,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "taichi": version("taichi"),
    }


def penetration_json(found: Penetration) -> dict[str, float]:
    """One state of a pair."""
    return {"volume_m3": found.volume, "share": found.share, "deepest_m": found.deepest}
