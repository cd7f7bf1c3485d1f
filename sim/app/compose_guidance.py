# SPDX-License-Identifier: MIT
"""The guidance that a user names: a set of pictures, or a diffusion model. PyTorch only where it is asked for."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from ..gaussians.guidance.protocol import Guidance

KINDS = ("exact", "diffusers")


def guidance_of(text: str, prompt: str) -> Guidance | None:
    """The guidance ``KIND:FOLDER``; None where ``text`` is empty. Raises InputError for another kind or folder."""
    if not text:
        return None
    kind, _, name = text.partition(":")
    folder = Path(name).expanduser()
    if kind not in KINDS or not name:
        raise InputError(f"guidance is {text!r}: write exact:FOLDER or diffusers:FOLDER")
    if not folder.exists():
        raise InputError(f"guidance {text!r}: there is no {folder}; name a folder of yours, nothing is downloaded")
    if kind == "diffusers":
        from ..gaussians.guidance.diffusers_folder import DiffusersGuidance, DiffusersOptions

        return DiffusersGuidance(folder, DiffusersOptions(prompt=prompt))
    raise NotImplementedError
