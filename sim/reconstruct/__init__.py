# SPDX-License-Identifier: MIT
"""One photo and a box around each object → a scene folder, without learned weights (docs/reconstruction.md).

The pipeline is loaded on first use: Blender's panels need the options alone, and its Python lacks SciPy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .reconstruct_options import ObjectRequest, ReconstructOptions

if TYPE_CHECKING:
    from .reconstruct_pipeline import reconstruct_photo

__all__ = ["ObjectRequest", "ReconstructOptions", "reconstruct_photo"]


def __getattr__(name: str) -> Any:
    if name != "reconstruct_photo":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .reconstruct_pipeline import reconstruct_photo

    return reconstruct_photo
