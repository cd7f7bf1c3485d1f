# SPDX-License-Identifier: MIT
"""The paper's way to a shadow: everything darker than a grey value that hangs together with the object (A.2)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Mask = NDArray[np.bool_]


def threshold_shadows(pixels: NDArray[np.uint8], masks: Sequence[Mask], threshold: float) -> list[Mask]:
    """Shadows (H, W) of the objects in ``masks`` (H, W): per object, the largest connected component of what is dark
    or the object, that holds some of the object; without any object.

    pixels: (H, W, 3) sRGB. threshold: grey value 0 to 255; what is darker counts (PhysGen3D's code takes 50). Where
    several objects' components meet, each pixel belongs to the object that is nearest.
    """
    dark = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY) < threshold
    covered = np.logical_or.reduce(masks)
    found = []
    for mask in masks:
        number, labels = cv2.connectedComponents(((dark & ~covered) | mask).astype(np.uint8), connectivity=8)
        sizes = np.bincount(labels.ravel(), minlength=number)
        own = np.unique(labels[mask])
        largest = own[np.argmax(sizes[own])] if len(own) else -1
        found.append((labels == largest) & ~covered)
    shared = np.sum(found, axis=0) > 1
    if shared.any():
        distances = np.stack(
            [
                np.where(shadow, ndimage.distance_transform_edt(~mask), np.inf)
                for shadow, mask in zip(found, masks, strict=True)
            ]
        )
        nearest = distances.argmin(axis=0)
        found = [shadow & (~shared | (nearest == index)) for index, shadow in enumerate(found)]
    return [np.asarray(shadow) for shadow in found]
