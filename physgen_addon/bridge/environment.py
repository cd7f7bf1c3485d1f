# SPDX-License-Identifier: GPL-3.0-or-later
"""How strongly an environment map lights the ground. Needs no bpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...sim.scene.equirectangular import LUMINANCE, directions

__all__ = ["LUMINANCE", "environment_irradiance"]


def environment_irradiance(radiance: NDArray[np.floating], normal: NDArray[np.floating]) -> NDArray[np.float64]:
    """RGB irradiance (3,) of an equirectangular map (H, W, 3) on open ground with unit ``normal``.

    The map's middle column looks along +X, as Blender has it.
    """
    towards, solid_angle = directions(*radiance.shape[:2])
    cosine = np.clip(towards @ np.asarray(normal, dtype=float), 0.0, None)
    return np.einsum("hwc,hw,hw->c", radiance[..., :3].astype(np.float64), cosine, solid_angle)
