# SPDX-License-Identifier: MIT
"""What a guidance is: it says in which direction a rendered picture becomes likelier."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.model import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What is shown to a guidance. Raises InputError on a picture that is none, or not of the camera's size."""

    picture: NDArray[Any]
    """(H, W, 3) sRGB 0 to 1, the rendered picture."""

    camera: Camera
    """From where it was rendered."""

    subject: str
    """Name of the object or objects in it, for those that are told in words what to expect."""

    def __post_init__(self) -> None:
        picture = np.asarray(self.picture)
        wanted = (self.camera.height, self.camera.width, 3)
        if picture.shape != wanted or picture.dtype.kind != "f":
            raise InputError(
                f"picture of {self.subject!r} has shape {picture.shape} {picture.dtype}: give floats {wanted}, as its "
                "camera says"
            )
        if not np.isfinite(picture).all():
            raise InputError(f"picture of {self.subject!r} has numbers that are not finite: look at what is rendered")


class Guidance(Protocol):
    """Whoever knows which pictures are likely: a diffusion model, or a set of pictures (``ideal.IdealDenoiser``)."""

    def gradient(self, seen: Seen, timestep: int, random: np.random.Generator) -> Array:
        """(H, W, 3): w(t) (ε̂ - ε) ∂z/∂picture, the picture's part of ∇L_SDS (PhyCAGE eq. 17, DreamFusion eq. 3).

        z is what the model adds noise to: the picture scaled to -1 to 1, or latents made of it. ε is drawn from
        ``random`` and nowhere else, so that runs can be repeated. It is a sum over z, not a mean. Descent goes against
        it. The caller multiplies by λ3 and carries it through the rasteriser.
        """
        ...
