# SPDX-License-Identifier: MIT
"""What the modeller believed before the diagnosis, in words; the verdict holds under these beliefs."""

from __future__ import annotations

import math

from ...page.markup import shortened
from ..capture import Capture, CaptureObject
from .quantities import number_text, quantity_text

MAX_OBJECTS = 8


def assumptions(capture: Capture) -> list[str]:
    """One sentence each."""
    gravity, ground = capture.gravity, capture.ground
    strength = math.hypot(*gravity)
    straight = math.hypot(gravity[0], gravity[1]) < 1e-9 and gravity[2] < 0
    way = "straight down" if straight else f"along ({', '.join(number_text(g) for g in gravity)})"
    bounce = "not known" if ground.restitution is None else number_text(ground.restitution)
    lines = [
        f"Gravity is {number_text(strength)} m/s², {way}.",
        f"The ground is flat, with friction {number_text(ground.friction)} and bounce (restitution) {bounce}.",
        *(_object(item) for item in capture.objects[:MAX_OBJECTS]),
    ]
    if len(capture.objects) > MAX_OBJECTS:
        lines.append(f"{len(capture.objects) - MAX_OBJECTS} more objects, as capture.json says.")
    camera = capture.camera
    if camera is not None:
        lines.append(
            f"The camera stands still where it is said to be, and sees {camera.width} × {camera.height} pixels."
        )
    noise = quantity_text(capture.noise_sigma, "m" if camera is None else "px")
    lines.append(f"A tracked coordinate is off by {noise} (standard deviation), each on its own.")
    lines.append(
        f"{len(capture.fit_trials)} complete takes, and {len(capture.predict_trials)} of which only the first frames "
        "are given. How each take starts (place, speed, spin) was estimated from its first frames."
    )
    return lines


def _object(item: CaptureObject) -> str:
    belief = item.belief
    name = shortened(item.name, 60)
    if belief.youngs_modulus_pa is None:
        matter = "does not deform"
    else:
        matter = (
            f"is {belief.stiffness} (Young’s modulus {quantity_text(belief.youngs_modulus_pa, 'Pa')}, "
            f"Poisson’s ratio {number_text(belief.poisson_ratio)})"
        )
    return f"“{name}” {matter} and weighs {number_text(belief.density_kg_m3)} kg/m³."
