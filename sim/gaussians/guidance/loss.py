# SPDX-License-Identifier: MIT
"""The guidance's part of the loss that an optimisation goes down (PhyCAGE eq. 19)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera
from .protocol import Array, Guidance, Seen
from .schedule import FIRST_TIMESTEP, LAST_TIMESTEP, timestep


def guidance_loss_gradient(
    picture: NDArray[Any],
    camera: Camera,
    subject: str,
    *,
    step: int,
    steps: int,
    guidance: Guidance,
    random: np.random.Generator,
    weight: float = 1e-5,
    first: int = FIRST_TIMESTEP,
    last: int = LAST_TIMESTEP,
) -> Array:
    """λ3 ∂L_SDS/∂picture (H, W, 3), to be added to the image loss's gradient for the same picture.

    picture: (H, W, 3) sRGB 0 to 1, rendered from ``camera``. step: 0 to ``steps`` - 1; the timestep goes from ``first``
    to ``last`` meanwhile. weight: λ3, 0 or more. The guidance's gradient is a sum over the picture and the image loss a
    mean: 1e-5 is of the size of 1 / (3 · 256²), so that both weigh alike in pictures of 256²; in others,
    1e-5 · 256² / (H W) keeps it so. Raises InputError, and what ``guidance`` raises; with a weight of 0 it is not
    asked.
    """
    if not (math.isfinite(weight) and weight >= 0):
        raise InputError(f"weight of the guidance is {weight!r}: give 0 or more; 1e-5 is usual")
    seen = Seen(picture=picture, camera=camera, subject=subject)
    moment = timestep(step, steps, first=first, last=last)
    if weight == 0:
        return np.zeros(seen.picture.shape)
    return weight * guidance.gradient(seen, moment, random)
