# SPDX-License-Identifier: GPL-3.0-or-later
"""OpenEXR files as arrays. Needs no bpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.openimageio import last_error


def read_layers(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels (H, W) of the data window, by name without the view layer: ``R``, ``Combined.R``, ``texture.A``.

    Blender 4.5 writes one part with all channels, 5.x a part for each pass. Raises InputError when not readable.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"{path}: not a readable image ({last_error(oiio.geterror)}); restore it or make it again")
    channels: dict[str, NDArray[np.float32]] = {}
    try:
        part = 0
        while source.seek_subimage(part, 0):
            spec = source.spec()
            pixels = source.read_image(part, 0, 0, spec.nchannels, oiio.FLOAT)
            if pixels is None:
                raise InputError(f"{path}: cut off or damaged ({last_error(source.geterror)}); make it again")
            for index, name in enumerate(spec.channelnames):
                channels[".".join(name.split(".")[-2:])] = np.asarray(pixels[..., index], dtype=np.float32)
            part += 1
    except (UnicodeDecodeError, MemoryError) as error:
        # Damaged bytes reach the channels' names, or ask for an enormous picture.
        raise InputError(f"{path}: damaged; restore it or make it again") from error
    finally:
        source.close()
    return channels
