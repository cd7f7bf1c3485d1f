# SPDX-License-Identifier: MIT
"""The rest of a hard shadow whose light was found a little wrong: it goes on in the same colour up to its own border.

Only where that is plain to see: the ground beside the shadow is even, the shadow is deep, and what goes on has its
darkness and its tint. A print is left out unless it touches the shadow and is as dark as the shadow itself.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.transfer import bytes_to_linear

Mask = NDArray[np.bool_]

DEEPEST_KEPT = 0.65
"""Share of the light that a shadow must keep at most, to be told from the ground's unevenness."""
EVEN = 0.4
"""Spread of the ground's log brightness over the depth of the shadow, above which the ground is too uneven."""
ALIKE, TINT = 0.3, 0.12
"""How far what goes on may differ from the shadow: share of its depth in log brightness, and log chroma."""
MOST = 2.0
"""Area that may be added over that of the shadow; more is another thing."""


def with_rest(pixels: NDArray[np.uint8], shadow: Mask, closed: Mask) -> Mask:
    """``shadow`` (H, W) and what goes on from it in ``pixels`` (H, W, 3) sRGB, outside of ``closed`` (H, W).

    Gives ``shadow`` back unchanged where nothing is plain.
    """
    area = int(shadow.sum())
    if area < 60:
        return shadow
    reach = max(4, round(0.8 * np.sqrt(area)))
    rows, columns = np.flatnonzero(shadow.any(axis=1)), np.flatnonzero(shadow.any(axis=0))
    window = (
        slice(max(0, rows[0] - 2 * reach), rows[-1] + 1 + 2 * reach),
        slice(max(0, columns[0] - 2 * reach), columns[-1] + 1 + 2 * reach),
    )
    own, barred = shadow[window], closed[window]
    logs = np.log(bytes_to_linear(np.ascontiguousarray(cv2.blur(pixels[window], (3, 3)))) + 0.01)
    core = cv2.erode(own.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    near = cv2.dilate(own.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)) > 0
    lit = near & ~(cv2.dilate(own.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & ~barred
    if core.sum() < 40 or lit.sum() < 40:
        return shadow
    inside = np.median(logs[core], axis=0)
    brightness = logs.mean(axis=-1)
    depth = float(np.median(brightness[lit]) - inside.mean())
    spread = 1.48 * float(np.median(np.abs(brightness[lit] - np.median(brightness[lit]))))
    if depth < -np.log(DEEPEST_KEPT) or spread > EVEN * depth:
        return shadow
    difference = logs - inside
    level = difference.mean(axis=-1)
    tint = np.abs(difference - level[..., None]).max(axis=-1)
    alike = (np.abs(level) < ALIKE * depth) & (tint < TINT) & ~barred
    _, labels = cv2.connectedComponents((alike | own).astype(np.uint8), connectivity=4)
    grown = np.isin(labels, np.unique(labels[own])) & alike & ~own
    added = int(grown.sum())
    edge = np.zeros_like(grown)
    edge[[0, -1]] = edge[:, [0, -1]] = True
    if added > MOST * area or (grown & edge).any():
        return shadow
    result = shadow.copy()
    result[window] |= cv2.morphologyEx((own | grown).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    return result & (~closed | shadow)
