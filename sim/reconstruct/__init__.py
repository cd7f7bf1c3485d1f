# SPDX-License-Identifier: MIT
"""One photo and a box around each object → a scene folder, without learned weights (docs/reconstruction.md)."""

from .reconstruct_options import ObjectRequest, ReconstructOptions
from .reconstruct_pipeline import reconstruct_photo

__all__ = ["ObjectRequest", "ReconstructOptions", "reconstruct_photo"]
