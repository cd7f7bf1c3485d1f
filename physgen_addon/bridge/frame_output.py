# SPDX-License-Identifier: GPL-3.0-or-later
"""A rendered frame in the form that was asked for (docs/file-formats.md). Needs no bpy.

beauty = objects + (1 − A)·ground, before what is done to the whole picture; ground already wears the shadow.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...sim.composite.layers import FrameLayers
from .formats import FrameFormat
from .frame_file import Part, encoded, write_exr, write_png


class Data(Protocol):
    """``data_passes.DataLayers``, which needs bpy to be made and not to be written."""

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) metres along the optical axis."""

    @property
    def object_id(self) -> NDArray[np.float32]:
        """(H, W) 0 where no object is, 1 for the first and so on."""

    @property
    def flow(self) -> NDArray[np.float32]:
        """(H, W, 4) pixels to the next frame and to the one before."""


def write_frame(
    path: Path, layers: FrameLayers, data: Data | None, form: FrameFormat, *, fps: float, names: Sequence[str]
) -> None:
    """Write ``layers``, and ``data`` where ``form`` is layered, to ``path``, whole or not at all.

    fps: frames a second of the clip. names: of the objects with the ids 1, 2, ….
    Raises InputError when ``path`` cannot be written.
    """
    if form.kind == "png":
        write_png(path, encoded(layers.beauty, form.depth))
        return
    parts = [_colour("beauty", layers.beauty, form)]
    if data is not None:
        objects = layers.objects
        light = np.dstack([objects.texture * objects.light, objects.alpha])
        ids = json.dumps({name: number for number, name in enumerate(names, start=1)}, ensure_ascii=False)
        parts = [
            _colour("beauty", np.dstack([layers.beauty, np.ones(layers.beauty.shape[:2], np.float32)]), form),
            _colour("objects", light, form),
            _colour("ground", layers.ground, form),
            _colour("shadow", layers.shadow, form),
            _numbers("depth", data.depth[..., None], "Z"),
            _numbers("object_id", data.object_id[..., None], "X", {"physgen:object_ids": ids}),
            _numbers("flow", data.flow, "XYZW"),
        ]
    write_exr(path, parts, fps=fps)


def _colour(name: str, pixels: NDArray[np.float32], form: FrameFormat) -> Part:
    prefix = "" if name == "beauty" else f"{name}."
    channels = tuple(f"{prefix}{c}" for c in "RGBA"[: pixels.shape[2]])
    return Part(name=name, channels=channels, pixels=pixels, bits=form.depth, compression=form.compression)


def _numbers(name: str, pixels: NDArray[np.float32], letters: str, attributes: dict[str, str] | None = None) -> Part:
    """What is measured and no colour: full precision, nothing lost."""
    channels = tuple(f"{name}.{c}" for c in letters)
    return Part(name=name, channels=channels, pixels=pixels, bits=32, attributes=attributes or {})
