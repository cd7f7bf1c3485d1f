# SPDX-License-Identifier: MIT
"""Photo and outlines → a model's answers about the physics (PhysGen3D, supplement A.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...events import IsCancelled, never
from .answer import Answers, read_answer
from .chat import ChatRequest, complete
from .marks import jpeg_bytes, marked_picture
from .prompt import prompt


def ask(
    pixels: NDArray[np.uint8],
    masks: Sequence[NDArray[np.bool_]],
    names: Sequence[str | None],
    request: ChatRequest,
    notice: Callable[[str], None],
    cancelled: IsCancelled = never,
) -> Answers:
    """Ask ``request.model`` about the objects that ``masks`` (H, W) show in ``pixels`` (H, W, 3) uint8 sRGB.

    Sent are the photo, scaled down to 1024 pixels, with numbered outlines, and a question that mentions the ``names``
    that the user gave. ``notice`` is told to whom, and of everything that could not be read in the answer. Raises
    InputError where no answer comes, and Cancelled.
    """
    if not masks or len(masks) != len(names):
        raise InputError(f"masks: {len(masks)} for {len(names)} names; give one for each object, at least one")
    picture = marked_picture(pixels, masks)
    jpeg = jpeg_bytes(picture)
    height, width = picture.shape[:2]
    notice(
        f"photo goes to {request.address} (model {request.model}): {width}x{height} pixels, {len(jpeg) >> 10} KiB, "
        f"with {len(masks)} outlines"
    )
    answers = read_answer(complete(request, prompt(names), jpeg, notice, cancelled), len(masks))
    for complaint in answers.unread:
        notice(f"answer of {request.model}: {complaint}")
    if not any(item.readable for item in answers.objects) and answers.roughness is None:
        start = " ".join("".join(c if c.isprintable() else " " for c in answers.raw[:400]).split())[:160]
        notice(f"answer of {request.model}: nothing of it can be used; it begins {start!r}")
    return answers
