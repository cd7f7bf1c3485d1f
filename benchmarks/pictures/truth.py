# SPDX-License-Identifier: GPL-3.0-or-later
"""A rendered picture with all that is known about it, as read from its folder (FORMAT.md)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from physgen.sim.composite.transfer import read_mask, read_rgb
from physgen.sim.scene.model import Camera

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TrueObject:
    """visible, full, shadow: (H, W). box: loose, pixels. volume_m3: None where it means little."""

    name: str
    kind: str
    box: tuple[float, float, float, float]
    size_m: float
    volume_m3: float | None
    occluded_share: float
    visible: Mask
    full: Mask
    shadow: Mask


@dataclass(frozen=True, eq=False)
class Truth:
    """A case. background: (H, W, 3) sRGB; normal: of the ground, in the camera's world."""

    root: Path
    camera: Camera
    normal: tuple[float, float, float]
    exif: bool
    vanishing_points: bool
    objects: tuple[TrueObject, ...]
    order: tuple[str, ...]
    background: NDArray[np.uint8]
    fields: dict[str, Any]

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.root.name

    @property
    def photo(self) -> Path:
        """All that the program is shown, beside the boxes."""
        return self.root / "photo.jpg"


def load_truth(root: Path) -> Truth:
    """The case in ``root``."""
    fields = json.loads((root / "truth.json").read_text())
    lens = fields["camera"]
    pose = tuple(tuple(float(v) for v in row) for row in lens["world_from_camera"])
    camera = Camera(
        width=fields["width"],
        height=fields["height"],
        **{key: lens[key] for key in ("fx", "fy", "cx", "cy")},
        world_from_camera=pose,  # type: ignore[arg-type]
    )
    objects = tuple(
        TrueObject(
            name=item["name"],
            kind=item["kind"],
            box=tuple(item["box"]),
            size_m=item["size_m"],
            volume_m3=item["volume_m3"],
            occluded_share=item["occluded_share"],
            **{sub: read_mask(root / sub / f"{item['name']}.png") for sub in ("visible", "full", "shadow")},
        )
        for item in fields["objects"]
    )
    return Truth(
        root=root,
        camera=camera,
        normal=tuple(fields["ground"]["normal"]),
        exif=fields["exif"],
        vanishing_points=fields["vanishing_points"],
        objects=objects,
        order=tuple(fields["order"]),
        background=read_rgb(root / "background.png"),
        fields=fields,
    )
