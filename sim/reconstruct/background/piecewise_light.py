# SPDX-License-Identifier: MIT
"""A field that is smooth but for a few steps, as light on the ground with shadows is.

Total variation (Rudin, Osher & Fatemi, Physica D 60, 1992): u is the field of least Σ w |u − f|² / 2 + λ Σ |∇u|, by
the primal-dual method of Chambolle & Pock (J. Math. Imaging Vis. 40, 2011). A region of contrast c and radius r loses
2 λ / r of c, and vanishes below r = 2 λ / c: so do grain and joints, while shadows stay, edges and all. One step of
Bregman's iteration (Osher et al., Multiscale Model. Simul. 4, 2005) gives the contrast back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

ROUNDS = 250
STEP = 0.35
"""Of both variables: its square times 8, the largest eigenvalue of the Laplacian, is below 1."""


def piecewise_smooth(values: Picture, weight: Picture, penalty: float) -> Picture:
    """Return ``values`` (h, w, c) without detail, with steps common to all channels, in their own unit.

    weight: (h, w) of each pixel's value; 0: unknown, continued from around. penalty: λ, in the unit of values times
    pixels.
    """
    first = _least_variation(values, weight, penalty)
    return _least_variation(np.where(weight[..., None] > 0.0, 2.0 * values - first, first), weight, penalty)


def _least_variation(values: Picture, weight: Picture, penalty: float) -> Picture:
    result = np.asarray(values, dtype=np.float32).copy()
    ahead = result.copy()
    down, across = np.zeros_like(result), np.zeros_like(result)
    pull = np.float32(STEP) * weight[..., None].astype(np.float32)
    pulled, share = np.asarray(pull * values, dtype=np.float32), np.float32(1.0) / (np.float32(1.0) + pull)
    for _ in range(ROUNDS):
        down[:-1] += STEP * (ahead[1:] - ahead[:-1])
        across[:, :-1] += STEP * (ahead[:, 1:] - ahead[:, :-1])
        length = np.sqrt((down * down + across * across).sum(axis=-1, keepdims=True))
        within = 1.0 / np.maximum(1.0, length / np.float32(penalty))
        down *= within
        across *= within
        new = result + pulled
        new[:-1] += STEP * down[:-1]
        new[1:] -= STEP * down[:-1]
        new[:, :-1] += STEP * across[:, :-1]
        new[:, 1:] -= STEP * across[:, :-1]
        new *= share
        ahead = np.asarray(np.float32(2.0) * new - result, dtype=np.float32)
        result = new
    return result
