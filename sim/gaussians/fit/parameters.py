# SPDX-License-Identifier: MIT
"""Splats as numbers without bounds, in which descent is free to move, and the chain rule from splats to them.

The groups bear the names of the fields of ``Splats``: centres as they are, log s, quaternions of any length, the logit
of opacities, colours as they are (Kerbl et al. 2023, section 5.1: logarithm and sigmoid keep scales and opacities in
range).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..splats import LARGEST_SCALE, LEAST_SCALE, Splats

if TYPE_CHECKING:  # The rest needs no Taichi.
    from ..raster.rasteriser import SplatGradients

Array = NDArray[np.float64]
Groups = Mapping[str, Array]
"""One array for each of GROUPS, N splats long."""

GROUPS = ("centres", "scales", "rotations", "opacities", "colours")

LEAST_OPACITY = 1e-5
"""Opacities are kept this far from 0 and 1, where the logit would be infinite."""


def free_values(splats: Splats) -> dict[str, Array]:
    """The numbers without bounds that stand for ``splats``."""
    opacities = np.clip(splats.opacities, LEAST_OPACITY, 1 - LEAST_OPACITY)
    return {
        "centres": splats.centres,
        "scales": np.log(splats.scales),
        "rotations": splats.rotations,
        "opacities": np.log(opacities / (1 - opacities)),
        "colours": splats.colours,
    }


def splats_of(values: Groups) -> Splats:
    """The splats that ``values`` stand for; scales are kept within what ``Splats`` takes."""
    return Splats(
        centres=values["centres"],
        scales=np.exp(np.clip(values["scales"], np.log(LEAST_SCALE * 1.001), np.log(LARGEST_SCALE * 0.999))),
        rotations=values["rotations"],
        opacities=_sigmoid(values["opacities"]),
        colours=values["colours"],
    )


def free_gradients(values: Groups, gradients: SplatGradients) -> dict[str, Array]:
    """Derivatives by ``values`` out of those by the splats that ``values`` stand for.

    d/d log s = s d/ds; d/d logit α = α (1 - α) d/dα; a quaternion counts by its direction alone, so what pulls along
    it is left out (the rasteriser's has nothing there) and the rest is divided by its length.
    """
    raw = values["rotations"]
    lengths = np.linalg.norm(raw, axis=1, keepdims=True)
    unit = raw / lengths
    turning = np.asarray(gradients.rotations, dtype=np.float64)
    opacities = _sigmoid(values["opacities"])
    return {
        "centres": np.asarray(gradients.centres, dtype=np.float64),
        "scales": np.exp(values["scales"]) * gradients.scales,
        "rotations": (turning - unit * np.sum(unit * turning, axis=1, keepdims=True)) / lengths,
        "opacities": opacities * (1 - opacities) * gradients.opacities,
        "colours": np.asarray(gradients.colours, dtype=np.float64),
    }


def _sigmoid(logits: Array) -> Array:
    return np.asarray(0.5 * (1 + np.tanh(0.5 * logits)))
