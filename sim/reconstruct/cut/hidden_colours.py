# SPDX-License-Identifier: MIT
"""Colours for the part of an object that something in front hides, taken from the part that is seen."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...errors import InputError

Mask = NDArray[np.bool_]

SIDE = 200.0
"""Pixels: larger objects are filled at a scale that makes them this large, and the filling is enlarged."""
ENOUGH = 400
"""Visible pixels at that scale, below which patches tell nothing and the nearest colour is taken."""
SEAM = 2
"""Pixels along the visible part's edge that hold some of the neighbour's colour, and are no source."""


def complete_colours(
    pixels: NDArray[np.uint8], mask: Mask, full: Mask, *, radius: int = 3, seed: int = 0
) -> NDArray[np.uint8]:
    """``pixels`` (H, W, 3) in which the hidden part, ``full`` without ``mask``, shows the object's own colours.

    mask: (H, W) what is seen of the object; full: (H, W) its whole outline. All sources are pixels of ``mask``: nothing
    of what hides it or surrounds it comes along. PatchMatch (Barnes et al., SIGGRAPH 2009) with patches of
    (2 radius + 1)² pixels; where too little is seen, the nearest colour. Elsewhere the picture is left as it is. Raises
    InputError for an empty mask, or when the native library is missing.
    """
    hidden = full & ~mask
    if not hidden.any():
        return pixels.copy()
    if not mask.any():
        raise InputError("complete_colours: nothing is seen of the object; give its visible pixels as mask")
    rows, columns = (np.flatnonzero((mask | hidden).any(axis=axis)) for axis in (1, 0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    crop, own, missing = pixels[window], mask[window], hidden[window]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SEAM + 1, 2 * SEAM + 1))
    core = cv2.erode(own.astype(np.uint8), disc, borderValue=0) > 0
    source = core if core.sum() > 0.3 * own.sum() else own
    filled = _filled(crop, source, radius, seed)
    result = pixels.copy()
    result[window] = np.where(missing[..., None], filled, crop)
    return result


def _filled(crop: NDArray[np.uint8], source: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    """``crop`` (h, w, 3) with everything but ``source`` filled from ``source``."""
    height, width = source.shape
    scale = min(1.0, SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    weight = cv2.resize(source.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # Averages over source pixels alone, or the neighbours' colours would come in with the smaller copy.
    total = cv2.resize(crop * source[..., None].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    small = np.clip(total / np.maximum(weight, 1e-6)[..., None] + 0.5, 0, 255).astype(np.uint8)
    known = weight > 0.5
    if not known.any():
        known = weight > 0.0
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    plain = small[nearest[0], nearest[1]]
    if known.sum() < ENOUGH or known.mean() < 0.05 or min(size) < 4 * radius:
        filled = np.where(known[..., None], plain, cv2.GaussianBlur(plain, (0, 0), 2.0))
    else:
        filled = _patch_match(plain, ~known, radius, seed)
    return np.asarray(cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def _patch_match(pixels: NDArray[np.uint8], hole: Mask, radius: int, seed: int) -> NDArray[np.uint8]:
    if not hole.any():
        return pixels
    # Imported late: loading a native library must not be the price of importing the package.
    from patchmatch import patch_match

    if not getattr(patch_match, "patchmatch_available", False):
        raise InputError("the inpainting library pypatchmatch cannot be loaded; install it again for this Python")
    patch_match.set_random_seed(seed)
    try:
        return np.asarray(patch_match.inpaint(np.ascontiguousarray(pixels), hole.astype(np.uint8), patch_size=radius))
    except RuntimeError:
        # Too little to match: the nearest colours are there already.
        return pixels
