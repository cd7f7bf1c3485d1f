# SPDX-License-Identifier: MIT
"""Optical flow between two frames: DIS (Kroeger et al., ECCV 2016) by OpenCV, or a user's network as an ONNX file.

A network takes two pictures (1, 3, H, W), red, green, blue from 0 to 255 as 32-bit floats, and its last output is the
flow (1, 2, H, W) in pixels: the form of the RAFT that OpenCV's model zoo has. VBench's own weights are PyTorch files
of its own programs; exported to this form they can be used, as they are they cannot.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..reconstruct.adapters.onnx_adapter import open_session
from .footage import Frame

Flow = NDArray[np.float32]
"""(H, W, 2): how far, in pixels, what is at a pixel of the first frame has moved in the second, right and down."""

FlowEstimator = Callable[[Frame, Frame], Flow]

LEAST_SIDE = 32
"""DIS matches patches on pyramids; smaller frames are enlarged for it."""


def dis_flow() -> FlowEstimator:
    """Return DIS flow with OpenCV's medium preset; deterministic."""
    estimator = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def flow(a: Frame, b: Frame) -> Flow:
        grey = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in (a, b)]
        height, width = grey[0].shape
        wide, high = max(width, LEAST_SIDE), max(height, LEAST_SIDE)
        if (wide, high) != (width, height):
            grey = [cv2.resize(g, (wide, high), interpolation=cv2.INTER_LINEAR) for g in grey]
        found = estimator.calc(grey[0], grey[1], np.zeros((high, wide, 2), np.float32))
        return _scaled(np.asarray(found, dtype=np.float32), width, height)

    return flow


def network_flow(path: Path) -> FlowEstimator:
    """Return the flow of the network in the ONNX file ``path``.

    Raises InputError where it cannot be read or has another form; so does the estimator for an output of another form.
    """
    where = f"--flow {path}"
    session = open_session(path, where)
    inputs = session.get_inputs()
    if len(inputs) != 2 or any(len(item.shape) != 4 or item.shape[1] != 3 for item in inputs):
        raise InputError(
            f"{where}: takes {[item.shape for item in inputs]}; give a network of two pictures (1, 3, height, width)"
        )
    fixed = [side if isinstance(side, int) and side > 0 else None for side in inputs[0].shape[2:]]

    def flow(a: Frame, b: Frame) -> Flow:
        height, width = a.shape[:2]
        # Pyramids of such networks need sides that eight divides.
        high, wide = (side or max(64, 8 * round(own / 8)) for side, own in zip(fixed, (height, width), strict=True))
        given = {
            item.name: cv2.resize(frame, (wide, high))[None, ..., ::-1].transpose(0, 3, 1, 2).astype(np.float32)
            for item, frame in zip(inputs, (a, b), strict=True)
        }
        try:
            found = np.asarray(session.run(None, given)[-1], dtype=np.float32)
        # onnxruntime raises its own exceptions, depending on the operator.
        except Exception as error:
            raise InputError(f"{where}: failed on a picture of {wide}x{high} ({str(error)[:200]})") from error
        if found.shape != (1, 2, high, wide) or not np.isfinite(found).all():
            raise InputError(f"{where}: gave {found.shape}; its last output has to be a finite (1, 2, {high}, {wide})")
        return _scaled(np.ascontiguousarray(found[0].transpose(1, 2, 0)), width, height)

    return flow


def _scaled(flow: Flow, width: int, height: int) -> Flow:
    """Return ``flow`` at another size, in pixels of that size."""
    high, wide = flow.shape[:2]
    if (wide, high) == (width, height):
        return flow
    moved = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(moved * np.array([width / wide, height / high], np.float32), dtype=np.float32)


def between(a: Frame, b: Frame, flow: FlowEstimator) -> Frame:
    """Return the frame midway between ``a`` and ``b``, by the flow between the two.

    With the flows F from ``a`` to ``b`` and B back, those from the middle are (B - F)/4 to ``a`` and (F - B)/4 to
    ``b`` (Jiang et al., *Super SloMo*, CVPR 2018, equation 4 at t = 1/2); both frames are sampled there and averaged.
    """
    towards = (flow(a, b) - flow(b, a)) / 4
    height, width = a.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    parts = [
        cv2.remap(
            frame, x + s * towards[..., 0], y + s * towards[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        for frame, s in ((a, -1), (b, 1))
    ]
    return np.asarray(np.rint((parts[0].astype(np.float32) + parts[1]) / 2), dtype=np.uint8)
