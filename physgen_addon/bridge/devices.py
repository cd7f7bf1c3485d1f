# SPDX-License-Identifier: GPL-3.0-or-later
"""Where Cycles renders: the processor, or graphics cards of one kind."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from . import compat

BACKENDS = {"optix": "OPTIX", "cuda": "CUDA", "hip": "HIP", "oneapi": "ONEAPI", "metal": "METAL"}
"""Cycles' names of the kinds of graphics cards; ``auto`` takes the first that is there. OptiX uses an NVIDIA card's
hardware for rays, so it comes before CUDA."""


def graphics_cards(kind: str) -> list[str]:
    """Names of this machine's graphics cards that Cycles can use as ``kind``; none where build or driver lacks it."""
    return [device.name for device in _devices(kind)]


def choose(wanted: str, notice: Callable[[str], None]) -> str:
    """The device that is rendered on, of those in ``options.DEVICES`` but ``auto``; ``notice`` is told which and why.

    wanted: one of ``options.DEVICES``. What is not there is replaced by ``cpu``.
    """
    for kind in BACKENDS if wanted == "auto" else (wanted,):
        names = graphics_cards(kind) if kind in BACKENDS else []
        if names:
            notice(f"renders on {', '.join(names)} ({kind})")
            return kind
    if wanted in BACKENDS:
        notice(f"{wanted} is not available here; renders on the CPU")
    else:
        notice("renders on the CPU")
    return "cpu"


def use(scene: bpy.types.Scene, kind: str) -> None:
    """Let Cycles render ``scene`` on all graphics cards of ``kind``; on the CPU if there are none, or kind is none."""
    chosen = _devices(kind) if kind in BACKENDS else []
    if chosen:
        preferences = compat.cycles_preferences()
        preferences.compute_device_type = BACKENDS[kind]
        # The processor beside the cards would only slow down renders as small as these.
        for device in preferences.devices:
            device.use = any(device.id == other.id for other in chosen)
    scene.cycles.device = "GPU" if chosen else "CPU"


def _devices(kind: str) -> list[bpy.types.PropertyGroup]:
    preferences = compat.cycles_preferences()
    backend = BACKENDS[kind]
    if preferences is None or backend not in {item[0] for item in preferences.get_device_types(bpy.context)}:
        return []
    try:
        return [device for device in preferences.get_devices_for_type(backend) if device.type == backend]
    except (RuntimeError, ValueError):
        # A driver that cannot be asked is a driver that cannot be used.
        return []
