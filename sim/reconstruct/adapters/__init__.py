# SPDX-License-Identifier: MIT
"""A user's own models in place of stages: Python functions, programs, ONNX files (docs/extending.md)."""

from .command_adapter import object_crop
from .protocols import Depth, DepthEstimator, Inpainter, Mesher, Segmenter
from .resolve import resolve

__all__ = ["Depth", "DepthEstimator", "Inpainter", "Mesher", "Segmenter", "object_crop", "resolve"]
