# SPDX-License-Identifier: MIT
"""One photo and a box around each object → a scene folder, without learned weights (docs/reconstruction.md)."""

from .options import ObjectRequest, ReconstructOptions
from .pipeline import reconstruct

__all__ = ["ObjectRequest", "ReconstructOptions", "reconstruct"]
