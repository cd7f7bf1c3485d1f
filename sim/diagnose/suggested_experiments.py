# SPDX-License-Identifier: MIT
"""The next recording that would separate a verdict from its alternatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .capture import Capture
from .capture_geometry import mean_known
from .diagnosis import NONE, UNKNOWN, Verdict

DROPPED = 0.1
"""Sideways over vertical distance up to which a body counts as dropped."""

NEAR_GROUND = 1.5
"""Height of the lowest point seen, in sizes of the body, up to which it counts as having reached the ground."""


@dataclass(frozen=True, kw_only=True)
class RecordedSetting:
    """Parts of a motion that an experiment can repeat. dropped: nothing moved sideways. lands: the ground was reached.
    turns: the points show how the body turns. lone: one complete trial is all."""

    dropped: bool = False
    lands: bool = True
    turns: bool = True
    lone: bool = False


def recorded_setting(capture: Capture) -> RecordedSetting:
    """Return the setting of ``capture``; of pixels, which leave the depth open, one in which everything is possible."""
    lone = len(capture.fit_trials) == 1
    if any(t.points is None for t in capture.trials):
        return RecordedSetting(lone=lone)
    normal, foot = capture.ground.unit_normal, np.asarray(capture.ground.point)
    size = max(float(np.ptp(item.vertices, axis=0).max()) for item in capture.objects)
    sideways, upright, low = 0.0, 0.0, np.inf
    for trial in capture.trials:
        way = mean_known(trial.observed, axis=1)
        way = way[np.isfinite(way).all(axis=1)]
        heights = (trial.observed - foot) @ normal
        low = min(low, float(heights[np.isfinite(heights)].min(initial=np.inf)))
        if len(way):
            along = (way - way[0]) @ normal
            upright = max(upright, float(np.ptp(along)))
            sideways = max(sideways, float(np.linalg.norm(way - way[0] - along[:, None] * normal, axis=1).max()))
    return RecordedSetting(
        dropped=sideways < DROPPED * upright,
        lands=low < NEAR_GROUND * size,
        turns=all(np.bincount(t.object_index).max() > 1 for t in capture.trials),
        lone=lone,
    )


_PAIRS: Mapping[frozenset[str], str] = {
    frozenset(pair.split("+")): text
    for pair, text in {
        "time_scale+buoyancy": "Film a heavier object of the same shape, or a running stopwatch, in the same way: a "
        "wrong clock changes both alike, buoyancy hardly affects the heavy one.",
        "air_drag+wind": "Throw the object the opposite way at the same speed: drag slows both throws alike, wind does "
        "not.",
        "wind+gravity_tilt": "Throw a heavier object of the same shape the same way: a tilted gravity bends its path "
        "just as much, wind much less.",
        "air_drag+buoyancy": "Drop the object from twice the height: drag grows with speed, buoyancy does not.",
        "air_drag+time_scale": "Drop the object from twice the height: drag grows with speed, a wrong clock does not.",
        "air_drag+magnus": "Throw the object once without spin and once with much: only lift follows the spin.",
        "wind+magnus": "Throw the object once without spin and once with much: only lift follows the spin.",
        "magnus+gravity_tilt": "Throw the object once without spin and once with much: only lift follows the spin.",
        "tether+wind": "Start the object at rest from positions on all sides: a tether pulls towards one point, "
        "wind to one side.",
        "tether+gravity_tilt": "Start the object at rest from positions on all sides: only a tether pulls to a point.",
        "tether+buoyancy": "Drop the object at two positions far apart: a tether also pulls sideways.",
        "friction+rolling_resistance": "Let the object slide without rolling, then roll without sliding.",
        "friction+gravity_tilt": "Slide the object in two opposite directions: friction slows both alike.",
        "friction+restitution": "Slide the object along the ground without a bounce, and drop it straight down.",
        "friction+air_drag": "Slide the object at two speeds: friction slows both alike, drag the fast one more.",
        "friction+mass_offset": "Slide the object without rotation, and film a throw with much spin.",
        "restitution+adhesion": "Drop the object from three heights: adhesion takes the same energy each time, "
        "restitution the same fraction.",
        "restitution+internal_damping": "Film the ringing after the bounce at a higher frame rate: internal "
        "damping stops it.",
        "rolling_resistance+gravity_tilt": "Roll the object in two opposite directions: resistance slows both alike.",
        "rolling_resistance+air_drag": "Roll the object at two speeds: resistance slows both alike.",
        "rolling_resistance+adhesion": "Drop the object straight down, and let it roll: only adhesion changes "
        "the bounce.",
        "stiffness+stiffness_gradient": "Drop the object on each end: a gradient makes them differ.",
        "stiffness+anisotropy": "Drop the object lying and standing: fibres make the two differ.",
        "stiffness+internal_damping": "Film the ringing after the bounce at a higher frame rate: stiffness sets its "
        "pitch, damping its length.",
        "stiffness+plastic_yield": "Drop the object from a low and a high position: yield shows only in the high drop.",
        "plastic_yield+internal_damping": "Film the object at rest afterwards: yield leaves a dent, damping does not.",
        "anisotropy+stiffness_gradient": "Drop the object on each of its six sides.",
        "anisotropy+internal_damping": "Drop the object lying and standing: fibres make the two differ.",
        "mass_offset+magnus": "Throw the object with much spin in two opposite senses: lift changes sign, an offset "
        "centre wobbles in both.",
        "mass_offset+friction": "Throw the object high with much spin: an offset centre shows in free flight.",
        "inertia+friction": "Slide the object flat without rotation: only friction acts there.",
        "inertia+restitution": "Drop the object straight down onto one face, or a ball without spin: its inertia plays "
        "no part there.",
        "inertia+rolling_resistance": "Roll the object up a slope: inertia decides how high it gets, resistance how "
        "long it rolls on the level.",
        "inertia+mass_offset": "Throw the object with much spin: an offset centre shows in free flight, a factor on "
        "the inertia does not.",
        "camera_pose+gravity_tilt": "Film a plumb line in the same view, or a level board.",
        "camera_pose+time_scale": "Film a ruler and a running stopwatch in the same view.",
        "camera_pose+buoyancy": "Film a ruler lying and standing in the same view.",
        "buoyancy+gravity_tilt": "Film a plumb line in the same view, and a heavier object of the same shape.",
    }.items()
}

_DROPPED: Mapping[frozenset[str], str] = {
    frozenset(pair.split("+")): text
    for pair, text in {
        "air_drag+wind": "Repeat the drop where the air is still: drag stays, wind does not.",
        "wind+gravity_tilt": "Drop a heavier object of the same shape: a tilted gravity bends its path just as much, "
        "wind much less.",
        "air_drag+buoyancy": "Drop the object from half the height as well: drag grows with speed, buoyancy does not.",
        "air_drag+time_scale": "Drop the object from half the height as well: drag grows with speed, a wrong clock "
        "does not.",
        "air_drag+magnus": "Drop the object once without spin and once with much: only lift follows the spin.",
    }.items()
}
"""Limits of what a recording of drops can repeat: no throw, and no greater height."""

_SINGLE: Mapping[str, str] = {
    "force": "Repeat the motion with a heavier object of the same shape.",
    "contact": "Repeat the contact once slowly and once fast, over the same ground.",
    "material": "Drop the object from a low and a high position and film the contact at a higher frame rate.",
    "mass": "Let the object fly with much spin, and track several points on it.",
    "observation": "Film a ruler, a plumb line and a running stopwatch in the same view.",
}


def next_experiment(
    verdict: Verdict, kinds: Mapping[str, str], *, resolvable: bool, setting: RecordedSetting | None = None
) -> str | None:
    """Return the suggested experiment in a sentence, or None where nothing is open.

    kinds: kind by effect name. setting: what can be repeated; None for everything.
    """
    setting = RecordedSetting() if setting is None else setting
    pairs = {**_PAIRS, **_DROPPED} if setting.dropped else _PAIRS
    if verdict.effect == NONE:
        return None
    if verdict.effect == UNKNOWN:
        guesses = verdict.alternatives[:2]
        if len(guesses) == 2 and _possible(pairs.get(frozenset(guesses)), setting):
            return pairs[frozenset(guesses)]
        return (
            "Repeat one trial exactly, and one with a heavier object of the same shape: what stays the same belongs to "
            "the environment, what changes with the mass is a force."
        )
    for other in verdict.alternatives:
        text = pairs.get(frozenset((verdict.effect, other)))
        if text is not None and _possible(text, setting):
            return text
    if verdict.alternatives:
        own, other = kinds[verdict.effect], kinds.get(verdict.alternatives[0], "force")
        return _SINGLE[own] if own == other else f"{_SINGLE[own]} {_SINGLE[other]}"
    if not resolvable:
        return "Record longer or faster trials: in these the gap is hardly larger than the noise."
    if setting.lone:
        return (
            "Record the same motion two more times, from another height or at another speed: of a single recording one "
            "half has to judge the other."
        )
    return None


_THROWN = ("Throw", "throw", "opposite", "Roll", "Slide")
_GROUND = ("Slide", "slide", "Roll", "roll", "bounce", "ground")


def _possible(text: str | None, setting: RecordedSetting) -> bool:
    """Return whether ``text`` can be done in ``setting``: what was dropped is not thrown, what never lands not slid."""
    if text is None:
        return False
    if setting.dropped and any(word in text for word in _THROWN):
        return False
    return setting.lands or not any(word in text for word in _GROUND)
