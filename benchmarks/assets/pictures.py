# SPDX-License-Identifier: MIT
"""Pictures of assets, rendered once and kept by what they show. No bpy: Cycles runs in a process of its own."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from physgen.sim.gaussians.views.transforms import read_views
from physgen.sim.gaussians.views.view import View

from .asset import Asset, Part
from .cameras import FITTING, HELD_OUT, PLACES, REFERENCE
from .catalogue import asset

TOGETHER = "composition"
"""Folder of the pictures of all parts; those of a part alone are in the folder of its name."""

SIZE, QUICK_SIZE = 256, 128


@dataclass(frozen=True, kw_only=True)
class Look:
    """How assets are lit. The emitted share knows nothing of neighbours: what O1 looks like alone, it does in company.

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


def kept_as(item: Asset, size: int, look: Look = LOOK) -> str:
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


def shown(item: Asset) -> list[tuple[str, tuple[Part, ...], tuple[str, ...]]]:
    """What is rendered: the folder, the parts that are there, the names of the views."""
    fitting = tuple(place.name for place in FITTING)
    held_out = tuple(place.name for place in HELD_OUT)
    together = (TOGETHER, item.parts, (REFERENCE.name, *fitting, *held_out))
    background = (item.background.name, (item.background,), (REFERENCE.name, *fitting))
    return [together, background, *((part.name, (part,), fitting) for part in item.foregrounds)]


def rendered(names: Sequence[str], size: int, cache: Path) -> dict[str, AssetPictures]:
    """Pictures of the assets ``names``, ``size`` pixels square; what ``cache`` lacks is rendered into it first.

    Blender is started once for all that is missing; its messages go to standard error.
    """
    missing = [name for name in names if not (cache / kept_as(asset(name), size)).is_dir()]
    if missing:
        command = [sys.executable, "-m", "physgen.benchmarks.assets.render", "--out", str(cache), "--size", str(size)]
        subprocess.run([*command, "--only", *missing], check=True, stdout=sys.stderr)
    return {name: load(asset(name), cache / kept_as(asset(name), size)) for name in names}


def load(item: Asset, folder: Path) -> AssetPictures:
    """The pictures of ``item`` that ``render.py`` has left in ``folder``."""
    fitting, held_out = [place.name for place in FITTING], [place.name for place in HELD_OUT]
    seen = {sub: {view.name: view for view in read_views(folder / sub)} for sub, _, _ in shown(item)}
    together, background = seen[TOGETHER], seen[item.background.name]
    return AssetPictures(
        reference=together[REFERENCE.name],
        views=tuple(together[name] for name in fitting),
        held_out=tuple(together[name] for name in held_out),
        background_reference=background[REFERENCE.name],
        background_views=tuple(background[name] for name in fitting),
        foreground_views=tuple(tuple(seen[part.name][name] for name in fitting) for part in item.foregrounds),
    )
