# SPDX-License-Identifier: MIT
"""Views → a folder that NeRF, instant-ngp and nerfstudio read, and that ``read_views`` reads again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...atomic import replacing
from ...errors import InputError
from ...scene.names import fitting_names
from .frames import FROM_OPENGL
from .transforms import TRANSFORMS
from .view import View

PICTURES, LABELS = "images", "labels"


def save_views(folder: Path, views: Sequence[View]) -> None:
    """Write ``views`` to the new folder ``folder``, whole or not at all: transforms.json, images/, labels/.

    Pictures are 8-bit PNGs with the mask as their opacity. Raises InputError when there are no views, two have the same
    name or one that no file can have, or the folder holds something already.
    """
    names = [view.name for view in views]
    if not names:
        raise InputError(f"{folder}: no views to write: give at least one")
    if fitting_names(names) != names:
        wrong = next(name for name, fit in zip(names, fitting_names(names), strict=True) if name != fit)
        raise InputError(
            f"{folder}: a view cannot be called {wrong[:60]!r}: give different names of letters and digits"
        )
    with replacing(folder) as partial:
        (partial / PICTURES).mkdir(parents=True)
        for view in views:
            _picture(view).save(partial / PICTURES / f"{view.name}.png")
            if view.labels is not None:
                (partial / LABELS).mkdir(exist_ok=True)
                numbers = np.maximum(view.labels, 0).astype(np.uint8)
                Image.fromarray(numbers).save(partial / LABELS / f"{view.name}.png")
        document = {"camera_model": "PINHOLE", "frames": [_frame(view) for view in views]}
        (partial / TRANSFORMS).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        if folder.is_dir():
            if any(folder.iterdir()):
                raise InputError(f"{folder}: holds files already: choose another folder, or empty it")
            # Windows replaces no folder, not even an empty one.
            folder.rmdir()


def _frame(view: View) -> dict[str, Any]:
    camera = view.camera
    pose = np.asarray(camera.world_from_camera, dtype=np.float64) @ FROM_OPENGL
    return {
        "file_path": f"{PICTURES}/{view.name}.png",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "transform_matrix": pose.tolist(),
    }


def _picture(view: View) -> Image.Image:
    if view.mask is None:
        return Image.fromarray(_bytes(view.pixels))
    share = view.mask[..., None]
    # Before white, the object's own colour is what remains without the white's share.
    own = np.where(share > 0, (view.pixels - (1 - share)) / np.maximum(share, 1e-6), 1.0)
    return Image.fromarray(_bytes(np.concatenate([np.clip(own, 0, 1), share], axis=2)))


def _bytes(values: Any) -> Any:
    return np.rint(values * 255).astype(np.uint8)
