# SPDX-License-Identifier: MIT
"""Cameras of an asset, and its rendered pictures from the cache."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from physgen.sim.gaussians.views.posed_images import View, orbit_camera
from physgen.sim.gaussians.views.view_files import read_views
from physgen.sim.scene.model import Camera

from .asset import Asset, Part
from .catalogue import asset
from .sdf import Array

FIELD_OF_VIEW = 49.1
"""Degrees across and down, SyncDreamer's."""

FILLED = 0.86
"""Of half the frame, how far out anything of the asset gets in any view: room for what starts larger."""

FRONT = -62.0
"""Degrees from +x at which azimuth 0 is: assets look towards -y, and are pictured a little from their left."""

RING = 16
"""Fitting views on SyncDreamer's ring, the first of them."""


@dataclass(frozen=True, kw_only=True)
class ViewPlace:
    """A view by its name; azimuth (counterclockwise from above, from the reference) and elevation in degrees."""

    name: str
    azimuth: float
    elevation: float

    def camera(self, centre: Array, distance: float, size: int) -> Camera:
        """A square camera of ``size`` pixels that looks at ``centre`` (3,) from ``distance`` metres away."""
        focal = 0.5 / math.tan(math.radians(FIELD_OF_VIEW / 2))
        turn = FRONT + self.azimuth
        return orbit_camera(turn, self.elevation, distance, side=size, focal=focal, target=tuple(centre.tolist()))


def _numbered(kind: str, angles: list[tuple[float, float]]) -> tuple[ViewPlace, ...]:
    return tuple(ViewPlace(name=f"{kind}_{i:02}", azimuth=a, elevation=e) for i, (a, e) in enumerate(angles))


REFERENCE = ViewPlace(name="reference", azimuth=0.0, elevation=20.0)
"""The input picture."""

FITTING = _numbered(
    "fit",
    [(360.0 / RING * i, 30.0) for i in range(RING)]
    + [(45.0 + 90.0 * i, -10.0) for i in range(4)]
    + [(90.0 * i, 65.0) for i in range(4)],
)
"""As SyncDreamer places its 16 (elevation 30°), then four from below and four from above."""

HELD_OUT = _numbered(
    "held", [(11.25, 10.0), (78.75, 45.0), (146.25, 20.0), (213.75, 5.0), (281.25, 50.0), (326.25, 35.0)]
)
"""Views that nothing is fitted to."""

PLACES = (REFERENCE, *FITTING, *HELD_OUT)


def cameras(asset: Asset, size: int) -> dict[str, Camera]:
    """Of all ``PLACES``, by name: as near as keeps the asset within ``FILLED``, all from the same distance."""
    points = np.concatenate([part.vertices for part in asset.parts])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    near, far = asset.size / 2, 20.0 * asset.size
    while far - near > 1e-3 * asset.size:
        middle = (near + far) / 2
        fits = all(_reach(place.camera(centre, middle, 2), points) <= FILLED for place in PLACES)
        near, far = (near, middle) if fits else (middle, far)
    return {place.name: place.camera(centre, far, size) for place in PLACES}


def _reach(seen: Camera, points: Array) -> float:
    """Return how far out ``points`` (N, 3) get, 1 at the edge of the frame."""
    pixels = seen.project(points)
    if pixels[:, 2].min() <= 0:
        return math.inf
    return float(np.abs(pixels[:, :2] - seen.cx).max() / seen.cx)


COMPOSITION = "composition"
"""Folder of the pictures of all parts; those of a part alone are in the folder of its name."""

SIZE, QUICK_SIZE = 256, 128


@dataclass(frozen=True, kw_only=True)
class Look:
    """Lighting of the assets. The emitted share knows nothing of neighbours: what O1 looks like alone, it does in
    company.

    samples: light paths a pixel. ambient: share of the colour that comes from a white sky of even brightness, which
    neighbours hide; the rest is emitted, between ``shade`` (where the surface is turned from ``key``) and 1.
    """

    samples: int = 8
    ambient: float = 0.35
    shade: float = 0.45
    key: tuple[float, float, float] = (-0.35, -0.55, 0.76)


LOOK = Look()


@dataclass(frozen=True, kw_only=True, eq=False)
class AssetPictures:
    """Views of one asset before white, each with its mask and labels (-1 nothing, 1 O1, 2 O2, 3 the next)."""

    reference: View
    """The input picture I."""

    views: tuple[View, ...]
    """Of the composition from ``cameras.FITTING``: the first 16 as SyncDreamer places them, then eight more."""

    held_out: tuple[View, ...]
    """Of the composition, for judging alone."""

    background_reference: View
    """O1 alone from the reference: the inpainted picture Î."""

    background_views: tuple[View, ...]
    """O1 alone from ``cameras.FITTING``."""

    foreground_views: tuple[tuple[View, ...], ...]
    """Each foreground alone from ``cameras.FITTING``."""


def cache_name(item: Asset, size: int, look: Look = LOOK) -> str:
    """The folder's name: it changes with the shapes, the colours, the places, the light and Blender."""
    content = hashlib.sha256()
    settings = [asdict(look), size, [asdict(place) for place in PLACES], importlib.metadata.version("bpy")]
    content.update(json.dumps(settings, sort_keys=True).encode())
    for part in item.parts:
        # Rounded: libraries differ in the last digits, pictures do not.
        content.update(np.rint(part.vertices / (1e-6 * item.size)).astype(np.int64).tobytes())
        content.update(part.faces.tobytes())
        content.update(np.rint(part.colours * 4095).astype(np.int64).tobytes())
    return f"{item.name}-{size}-{content.hexdigest()[:12]}"


def renderings(item: Asset) -> list[tuple[str, tuple[Part, ...], tuple[str, ...]]]:
    """Return what to render: folder, visible parts, names of the views."""
    fitting = tuple(place.name for place in FITTING)
    held_out = tuple(place.name for place in HELD_OUT)
    together = (COMPOSITION, item.parts, (REFERENCE.name, *fitting, *held_out))
    background = (item.background.name, (item.background,), (REFERENCE.name, *fitting))
    return [together, background, *((part.name, (part,), fitting) for part in item.foregrounds)]


def rendered(names: Sequence[str], size: int, cache: Path) -> dict[str, AssetPictures]:
    """Pictures of the assets ``names``, ``size`` pixels square; what ``cache`` lacks is rendered into it first.

    Blender is started once for all that is missing; its messages go to standard error.
    """
    missing = [name for name in names if not (cache / cache_name(asset(name), size)).is_dir()]
    if missing:
        command = [
            sys.executable,
            "-m",
            "physgen.benchmarks.compose_assets.blender_render",
            "--out",
            str(cache),
            "--size",
            str(size),
        ]
        subprocess.run([*command, "--only", *missing], check=True, stdout=sys.stderr)
    return {name: load(asset(name), cache / cache_name(asset(name), size)) for name in names}


def load(item: Asset, folder: Path) -> AssetPictures:
    """The pictures of ``item`` that ``render.py`` has left in ``folder``."""
    fitting, held_out = [place.name for place in FITTING], [place.name for place in HELD_OUT]
    seen = {sub: {view.name: view for view in read_views(folder / sub)} for sub, _, _ in renderings(item)}
    together, background = seen[COMPOSITION], seen[item.background.name]
    return AssetPictures(
        reference=together[REFERENCE.name],
        views=tuple(together[name] for name in fitting),
        held_out=tuple(together[name] for name in held_out),
        background_reference=background[REFERENCE.name],
        background_views=tuple(background[name] for name in fitting),
        foreground_views=tuple(tuple(seen[part.name][name] for name in fitting) for part in item.foregrounds),
    )
