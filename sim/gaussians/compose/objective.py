# SPDX-License-Identifier: MIT
"""What the optimiser descends: the image loss of the whole asset, and score distillation of the piece that yields.

Eq. 19 of PhyCAGE, L = L_Image + λ3 L_SDS. The image loss (eq. 18) is of the composition seen by the reference's camera;
the distillation (eq. 17) is of the yielding piece alone, one camera a step, over white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...composite.metrics import psnr
from ...scene.model import Camera
from ..fit.losses import image_loss
from ..guidance.loss import guidance_loss_gradient
from ..guidance.protocol import Guidance
from ..raster.rasteriser import Rasteriser, SplatGradients
from ..splats import Splats, joined
from .asset import Reference
from .options import ComposeOptions

PIXELS = 256**2
"""Of the pictures for which λ3 is meant: the image loss is a mean over pixels, the distillation a sum."""

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Descent:
    """Gradients of L with respect to the yielding piece's splats, and what was found on the way."""

    gradients: SplatGradients
    loss: float
    """Image loss; NaN without a reference."""
    psnr: float
    """dB; NaN without a reference."""


class Objective:
    """L of one yielding piece, beside pieces that stay."""

    def __init__(
        self,
        *,
        rasteriser: Rasteriser,
        staying: Sequence[Splats],
        subject: str,
        reference: Reference | None,
        guidance: Guidance | None,
        cameras: Sequence[Camera],
        options: ComposeOptions,
    ) -> None:
        """staying: splats of all that is seen beside the yielding piece ``subject``; cameras: for the guidance."""
        self._rasteriser = rasteriser
        self._staying = tuple(staying)
        self._subject = subject
        self._reference = reference
        self._guidance = guidance
        self._cameras = tuple(cameras)
        self._options = options
        self._random = np.random.default_rng(options.seed)

    def picture(self, moving: Splats) -> NDArray[np.float64]:
        """(H, W, 3) the composition as the reference's camera sees it. Raises ValueError without a reference."""
        if self._reference is None:
            raise ValueError("there is no reference to look from")
        seen = self._rasteriser.render(joined([moving, *self._staying]), self._reference.camera, background=BLACK)
        clear = 1.0 - seen.alpha.astype(np.float64)
        return np.asarray(seen.colour + clear[..., None] * self._reference.backdrop)

    def descent(self, moving: Splats, step: int) -> Descent:
        """Gradients at ``moving`` in step ``step`` (from 0), which chooses the guidance's camera and noise level."""
        loss = quality = float("nan")
        parts: list[SplatGradients] = []
        if self._reference is not None:
            picture = self.picture(moving)
            loss, slope = image_loss(picture, self._reference.pixels, ssim_share=self._options.ssim_share)
            quality = psnr(np.clip(picture, 0.0, 1.0), self._reference.pixels, peak=1.0)
            found = self._rasteriser.gradients(slope, -(slope * self._reference.backdrop).sum(axis=-1))
            parts.append(_first(found, len(moving)))
        if self._guidance is not None and self._options.guidance_weight > 0:
            camera = self._cameras[int(self._random.integers(len(self._cameras)))]
            seen = self._rasteriser.render(moving, camera, background=WHITE)
            slope = guidance_loss_gradient(
                np.clip(seen.colour.astype(np.float64), 0.0, 1.0),
                camera,
                self._subject,
                step=step,
                steps=self._options.steps,
                first=self._options.first_timestep,
                last=self._options.last_timestep,
                weight=self._options.guidance_weight * PIXELS / (camera.width * camera.height),
                guidance=self._guidance,
                random=self._random,
            )
            parts.append(self._rasteriser.gradients(slope))
        return Descent(gradients=_sum(parts, len(moving)), loss=loss, psnr=quality)


def _first(gradients: SplatGradients, count: int) -> SplatGradients:
    """The gradients of the first ``count`` splats."""
    return SplatGradients(
        centres=gradients.centres[:count],
        scales=gradients.scales[:count],
        rotations=gradients.rotations[:count],
        opacities=gradients.opacities[:count],
        colours=gradients.colours[:count],
    )


def _sum(parts: Sequence[SplatGradients], count: int) -> SplatGradients:
    """Their sum; zeros when there is none."""
    return SplatGradients(
        centres=sum((p.centres for p in parts), np.zeros((count, 3))),
        scales=sum((p.scales for p in parts), np.zeros((count, 3))),
        rotations=sum((p.rotations for p in parts), np.zeros((count, 4))),
        opacities=sum((p.opacities for p in parts), np.zeros(count)),
        colours=sum((p.colours for p in parts), np.zeros((count, 3))),
    )
