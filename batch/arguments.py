# SPDX-License-Identifier: GPL-3.0-or-later
"""Arguments that several verbs of ``physgen`` share, and what is made of them."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

from ..sim.app.bake_inputs import BakeOptions
from ..sim.app.light import LightRequest
from ..sim.cache.manifest import SPACES
from ..sim.errors import InputError
from ..sim.scene.materials import preset_names
from .photo_arguments import vector


def add_sun(parser: argparse.ArgumentParser) -> None:
    """A sun as told, or as the photo tells."""
    direction = "towards the sun: right, away, up, of any length"
    parser.add_argument("--sun-direction", type=vector, metavar="x,y,z", help=direction)
    strength = "light of the sun on open ground over that of everything else, 0 to 20"
    parser.add_argument("--sun-strength", type=float, metavar="S", help=strength)
    angle = "its apparent diameter; 0.5 is the real sun, more is softer"
    parser.add_argument("--sun-angle", type=float, metavar="DEGREES", help=angle)
    parser.add_argument("--estimate", action="store_true", help="look for the sun in the photo's shadows again")


def light_request(options: argparse.Namespace) -> LightRequest:
    """The light of ``physgen light``. Raises InputError when nothing is asked for, or what contradicts itself."""
    request = LightRequest(
        environment=options.environment,
        frame=options.environment_frame,
        sun=not options.no_sun,
        sun_direction=options.sun_direction,
        sun_strength=options.sun_strength,
        sun_angle_deg=options.sun_angle,
        estimate=options.estimate,
    )
    if dataclasses.replace(request, frame="ahead") == LightRequest():
        raise InputError("nothing to do: give --environment FILE, --sun-direction x,y,z, --no-sun or --estimate")
    return request


def add_physics(parser: argparse.ArgumentParser) -> None:
    """Materials, velocities and any other field of the scene."""
    names = preset_names()
    parser.add_argument(
        "--preset", nargs="+", action="extend", default=[], choices=names, help="material, one for all or one an object"
    )
    velocity = "initial velocity x,y,z in m/s: right, away from the camera, up; one an object"
    parser.add_argument("--velocity", type=vector, nargs="+", action="extend", default=[], metavar="V", help=velocity)
    parser.add_argument(
        "--spin", type=vector, nargs="+", action="extend", default=[], metavar="W", help="initial spin x,y,z in rad/s"
    )
    change = "change a field of an object, its material, 'ground' or 'scene', such as cup.density=300"
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], dest="overrides", metavar="OBJECT.FIELD=VALUE", help=change
    )


def add_bake_options(parser: argparse.ArgumentParser) -> None:
    """How a scene is simulated."""
    defaults = BakeOptions()
    parser.add_argument("--frames", type=int, default=defaults.frames, help=f"how many (default {defaults.frames})")
    parser.add_argument("--fps", type=float, default=defaults.fps, help=f"frames a second (default {defaults.fps:g})")
    parser.add_argument("--quality", default=defaults.quality, help="preset in presets/qualities (default standard)")
    parser.add_argument(
        "--arch", default=defaults.arch, choices=["cpu", "cuda", "vulkan", "metal"], help="where to simulate"
    )
    parser.add_argument("--seed", type=int, default=defaults.seed, metavar="N", help="of the particles' places")


def add_sample_options(parser: argparse.ArgumentParser) -> None:
    """What a bake writes of it."""
    defaults = BakeOptions()
    space = "what the samples are in: world metres, or the coordinates of each object's mesh file"
    parser.add_argument("--space", default=defaults.space, choices=SPACES, help=f"{space} (default {defaults.space})")
    points = "keep the particles of what is sand, fluid or snow, or turns to sand (default: on)"
    parser.add_argument("--points", action=argparse.BooleanOptionalAction, default=defaults.points, help=points)


def physics(options: argparse.Namespace) -> dict[str, Any]:
    """Keyword arguments of ``sim.app.reconstruct.set_physics``."""
    return {
        "presets": options.preset,
        "velocities": options.velocity,
        "spins": options.spin,
        "overrides": options.overrides,
    }


def bake_options(options: argparse.Namespace) -> BakeOptions:
    """Options of the bake; a verb that does not ask for some of them takes the defaults."""
    names = ("frames", "fps", "quality", "arch", "seed", "space", "points")
    return BakeOptions(**{name: getattr(options, name) for name in names if hasattr(options, name)})
