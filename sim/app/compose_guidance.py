# SPDX-License-Identifier: MIT
"""The guidance that a user names: a set of pictures, or a diffusion model. PyTorch only where it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import InputError
from ..gaussians.guidance.ideal import IdealDenoiser
from ..gaussians.guidance.protocol import Guidance
from ..gaussians.views.transforms import read_views
from ..scene.model import Camera
from .compose_picture import smaller

KINDS = ("exact", "diffusers")


@dataclass(frozen=True, kw_only=True, eq=False)
class Named:
    """A guidance. subject: the object that it is for, empty: all that yield; cameras: whence it looks, () anywhere."""

    guidance: Guidance
    subject: str
    cameras: tuple[Camera, ...] = ()

    def by_object(self, yielding: Sequence[str]) -> dict[str, Guidance]:
        """It, for those of the ``yielding`` objects that it is for."""
        return {name: self.guidance for name in yielding if self.subject in ("", name)}


def guidance_of(text: str, prompt: str, *, size: int) -> Named | None:
    """The guidance ``KIND:FOLDER`` or ``OBJECT=KIND:FOLDER``; None where ``text`` is empty.

    ``exact`` is the ideal denoiser of the pictures in a views folder, each seen from its own camera, their longer side
    ``size`` pixels or less. ``diffusers`` is told ``prompt``. Raises InputError for another kind, a folder that is not
    there or that cannot be used, and for pictures of different sizes.
    """
    if not text:
        return None
    subject, mark, rest = text.partition("=")
    if not mark or ":" in subject:
        subject, rest = "", text
    kind, _, name = rest.partition(":")
    if kind not in KINDS or not name:
        raise InputError(
            f"guidance is {text!r}: write exact:FOLDER or diffusers:FOLDER, with OBJECT= before it for one object"
        )
    folder = Path(name).expanduser()
    if not folder.exists():
        raise InputError(f"guidance {text!r}: there is no {folder}; name a folder of yours, nothing is downloaded")
    if kind == "diffusers":
        from ..gaussians.guidance.diffusers_folder import DiffusersGuidance, DiffusersOptions

        return Named(guidance=DiffusersGuidance(folder, DiffusersOptions(prompt=prompt)), subject=subject)
    views = read_views(folder)
    cameras = tuple(smaller(view.camera, size) for view in views)
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        raise InputError(f"guidance {text!r}: its pictures have different sizes ({found}): make them the same")
    ((width, height),) = sizes
    pictures = np.stack([cv2.resize(view.pixels, (width, height), interpolation=cv2.INTER_AREA) for view in views])
    return Named(guidance=IdealDenoiser(pictures, cameras=cameras), subject=subject, cameras=cameras)
