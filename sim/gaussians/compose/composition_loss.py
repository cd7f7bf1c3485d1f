# SPDX-License-Identifier: MIT
"""The loss of a composition and its gradients by the splats of the deformable part.

The loss is equation 19 of PhyCAGE, L = L_Image + λ3 L_SDS. The image loss (equation 18) is of the composition seen by
the reference's camera; the distillation (equation 17) is of the deformable part alone, one camera a step, over white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...composite.image_metrics import psnr
from ...scene.model import Camera
from ..guidance.score_distillation import Guidance, guidance_loss_gradient
from ..image_loss import image_loss
from ..raster.rasteriser import Rasteriser, SplatGradients
from ..splats import Splats, joined
from .compose_options import ComposeOptions
from .composition_parts import Reference

GUIDANCE_PIXELS = 256**2
"""Pixels of the images that λ3 is meant for: the image loss is a mean over pixels, the distillation a sum."""

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class LossGradients:
    """Gradients of L by the deformable part's splats, and measures."""

    gradients: SplatGradients
    loss: float
    """Image loss; NaN without a reference."""
    psnr: float
    """dB; NaN without a reference."""


class CompositionLoss:
    """L of one deformable part beside fixed parts."""

    def __init__(
        self,
        *,
        rasteriser: Rasteriser,
        fixed: Sequence[Splats],
        subject: str,
        reference: Reference | None,
        guidance: Guidance | None,
        cameras: Sequence[Camera],
        options: ComposeOptions,
    ) -> None:
        """fixed: splats of all other visible parts; subject: name of the deformable part; cameras: for the guidance."""
        self._rasteriser = rasteriser
        self._fixed = tuple(fixed)
        self._subject = subject
        self._reference = reference
        self._guidance = guidance
        self._cameras = tuple(cameras)
        self._options = options
        self._random = np.random.default_rng(options.seed)

    def picture(self, moving: Splats) -> NDArray[np.float64]:
        """Return (H, W, 3) the composition seen by the reference's camera. Raises ValueError without a reference."""
        if self._reference is None:
            raise ValueError("there is no reference camera")
        seen = self._rasteriser.render(joined([moving, *self._fixed]), self._reference.camera, background=BLACK)
        clear = 1.0 - seen.alpha.astype(np.float64)
        return np.asarray(seen.colour + clear[..., None] * self._reference.backdrop)

    def evaluate(self, moving: Splats, step: int) -> LossGradients:
        """Return gradients at ``moving`` in ``step`` (from 0), which determines the guidance's noise level."""
        loss = quality = float("nan")
        parts: list[SplatGradients] = []
        if self._reference is not None:
            picture = self.picture(moving)
            loss, slope = image_loss(picture, self._reference.pixels, ssim_share=self._options.ssim_share)
            quality = psnr(np.clip(picture, 0.0, 1.0), self._reference.pixels, peak=1.0)
            found = self._rasteriser.gradients(slope, -(slope * self._reference.backdrop).sum(axis=-1))
            parts.append(_first_gradients(found, len(moving)))
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
                weight=self._options.guidance_weight * GUIDANCE_PIXELS / (camera.width * camera.height),
                guidance=self._guidance,
                random=self._random,
            )
            parts.append(self._rasteriser.gradients(slope))
        return LossGradients(gradients=_summed_gradients(parts, len(moving)), loss=loss, psnr=quality)


def _first_gradients(gradients: SplatGradients, count: int) -> SplatGradients:
    """Return the gradients of the first ``count`` splats."""
    return SplatGradients(
        centres=gradients.centres[:count],
        scales=gradients.scales[:count],
        rotations=gradients.rotations[:count],
        opacities=gradients.opacities[:count],
        colours=gradients.colours[:count],
    )


def _summed_gradients(parts: Sequence[SplatGradients], count: int) -> SplatGradients:
    """Return the sum of ``parts``, each of ``count`` splats; zeros when there are none."""
    return SplatGradients(
        centres=sum((p.centres for p in parts), np.zeros((count, 3))),
        scales=sum((p.scales for p in parts), np.zeros((count, 3))),
        rotations=sum((p.rotations for p in parts), np.zeros((count, 4))),
        opacities=sum((p.opacities for p in parts), np.zeros(count)),
        colours=sum((p.colours for p in parts), np.zeros((count, 3))),
    )
