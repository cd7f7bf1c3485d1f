# SPDX-License-Identifier: MIT
"""What the nominal model assumes, in sentences."""

from __future__ import annotations

import math

from ...html import shortened
from ..capture import Capture, CaptureObject
from .number_format import number_text, quantity_text

MAX_OBJECTS = 8


def assumptions(capture: Capture) -> list[str]:
    """Return the assumptions of the nominal model, one sentence each."""
    gravity, ground = capture.gravity, capture.ground
    strength = math.hypot(*gravity)
    straight = math.hypot(gravity[0], gravity[1]) < 1e-9 and gravity[2] < 0
    way = "straight down" if straight else f"along ({', '.join(number_text(g) for g in gravity)})"
    bounce = "not known" if ground.restitution is None else number_text(ground.restitution)
    lines = [
        f"Gravity is {number_text(strength)} m/s², {way}.",
        f"The ground is flat, with friction {number_text(ground.friction)} and restitution {bounce}.",
        *(_object(item) for item in capture.objects[:MAX_OBJECTS]),
    ]
    if len(capture.objects) > MAX_OBJECTS:
        lines.append(f"{len(capture.objects) - MAX_OBJECTS} more objects are listed in capture.json.")
    camera = capture.camera
    if camera is not None:
        lines.append(f"The camera is fixed at its given pose, with {camera.width} × {camera.height} pixels.")
    noise = quantity_text(capture.noise_sigma, "m" if camera is None else "px")
    lines.append(f"Tracking noise is {noise} per coordinate (standard deviation), independent for each.")
    lines.append(
        f"{_trials(capture)} The initial state of each trial (position, velocity, spin) was estimated from its first "
        "frames."
    )
    if camera is None and all(len(trial.rest_points) == 1 for trial in capture.trials):
        lines.append(
            "One point is tracked, so that spin shows in the path alone: of Magnus lift only the product of strength "
            "and spin is known."
        )
    return lines


def _trials(capture: Capture) -> str:
    whole, begun = len(capture.fit_trials), len(capture.predict_trials)
    if whole != 1:
        said = f"{whole} complete trials"
    elif all(item.belief.rigid for item in capture.objects):
        said = "One complete trial, whose second half judges what was fitted to the first"
    else:
        said = "One complete trial"
    return f"{said}, and {begun} with only {'its' if begun == 1 else 'their'} first frames." if begun else f"{said}."


def _object(item: CaptureObject) -> str:
    belief = item.belief
    name = shortened(item.name, 60)
    if belief.youngs_modulus_pa is None:
        material = "is rigid"
    else:
        material = (
            f"is {belief.stiffness} (Young’s modulus {quantity_text(belief.youngs_modulus_pa, 'Pa')}, "
            f"Poisson’s ratio {number_text(belief.poisson_ratio)})"
        )
    return f"“{name}” {material} with a density of {number_text(belief.density_kg_m3)} kg/m³."
