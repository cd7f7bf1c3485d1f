# SPDX-License-Identifier: MIT
"""What the scene folder keeps of the reasoning (``physics.json``), so that it can be checked and never asked twice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...scene.json_fields import to_json
from .answer import Answers
from .apply import ObjectPhysics
from .chat import ChatRequest

FORMAT = "physgen-physics/1"


def physics_record(
    names: Sequence[str], decided: Sequence[ObjectPhysics], answers: Answers | None, request: ChatRequest | None
) -> dict[str, Any]:
    """The content of ``physics.json``: what was decided about each name, who was asked, and what was answered.

    Holds neither the key nor the name of its variable, nor a URL's query.
    """
    return {
        "format": FORMAT,
        "objects": {name: to_json(physics) for name, physics in zip(names, decided, strict=True)},
        "asked": None if request is None else {"address": str(request.address), "model": request.model},
        "answers": None if answers is None else to_json(answers),
    }
