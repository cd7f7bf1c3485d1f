# SPDX-License-Identifier: GPL-3.0-or-later
"""Arguments that several verbs of ``physgen`` share, and what is made of them."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path
from typing import Any

from ..sim.app.bake_inputs import BakeOptions
from ..sim.app.light import LightRequest
from ..sim.cache.manifest import SPACES
from ..sim.errors import InputError
from ..sim.reconstruct import ObjectRequest, ReconstructOptions
from ..sim.scene.equirectangular import FRAMES
from ..sim.scene.materials import preset_names
from ..sim.scene.model import Vector


def _numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(n) for n in numbers):
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is not {what}")
    return numbers


def _box(text: str) -> tuple[float, float, float, float]:
    a, b, c, d = _numbers(text, 4, "a box x0,y0,x1,y1 in pixels")
    return a, b, c, d


def _vector(text: str) -> Vector:
    x, y, z = _numbers(text, 3, "a vector x,y,z")
    return x, y, z


def add_photo(parser: argparse.ArgumentParser) -> None:
    """The photo, what is cut out of it, and its camera."""
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    box = "x0,y0,x1,y1 in pixels of the upright photo, one an object"
    parser.add_argument("--box", type=_box, nargs="+", action="extend", required=True, metavar="BOX", help=box)
    parser.add_argument(
        "--name", nargs="+", action="extend", default=[], help="names of the objects, in the order of the boxes"
    )
    size = "largest extent in metres, one an object; the first sets the scale of the scene"
    parser.add_argument("--size", type=float, nargs="+", action="extend", default=[], metavar="METRES", help=size)
    horizon = (
        "height of the horizon as a fraction of the photo's, 0 top, 1 bottom; may lie outside (default: estimated)"
    )
    parser.add_argument("--horizon", type=float, metavar="Y", help=horizon)
    pitch = "angle of the view below the horizontal, instead of --horizon; about 50 for a look down at a table"
    parser.add_argument("--pitch", type=float, metavar="DEGREES", help=pitch)
    parser.add_argument(
        "--fov", type=float, metavar="DEGREES", help="field of view of the longer side (default: EXIF, else 50)"
    )


def add_environment(parser: argparse.ArgumentParser) -> None:
    """Light from a file in place of what the photo tells."""
    text = ".hdr or .exr that replaces the light estimated from the photo; of DiffusionLight hdr/NAME.exr"
    parser.add_argument("--environment", type=Path, metavar="FILE", help=text)
    frame = "where the file's middle looks: ahead, level (default); along the camera's axis, as DiffusionLight's; or +X"
    parser.add_argument("--environment-frame", choices=FRAMES, default="ahead", help=frame)
    parser.add_argument("--no-sun", action="store_true", help="no sun beside the environment")


def add_sun(parser: argparse.ArgumentParser) -> None:
    """A sun as told, or as the photo tells."""
    direction = "towards the sun: right, away, up, of any length"
    parser.add_argument("--sun-direction", type=_vector, metavar="x,y,z", help=direction)
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
    parser.add_argument("--velocity", type=_vector, nargs="+", action="extend", default=[], metavar="V", help=velocity)
    parser.add_argument(
        "--spin", type=_vector, nargs="+", action="extend", default=[], metavar="W", help="initial spin x,y,z in rad/s"
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


def object_requests(options: argparse.Namespace) -> tuple[ObjectRequest, ...]:
    """What to cut out of the photo. Raises InputError for more names or sizes than boxes."""
    boxes = options.box
    for flag in ("name", "size"):
        if len(getattr(options, flag)) > len(boxes):
            raise InputError(
                f"--{flag}: {len(getattr(options, flag))} given for {len(boxes)} boxes; give at most one a box"
            )
    return tuple(
        ObjectRequest(
            box=box,
            name=options.name[i] if i < len(options.name) else None,
            size_m=options.size[i] if i < len(options.size) else None,
        )
        for i, box in enumerate(boxes)
    )


def physics(options: argparse.Namespace) -> dict[str, Any]:
    """Keyword arguments of ``sim.app.reconstruct.set_physics``."""
    return {
        "presets": options.preset,
        "velocities": options.velocity,
        "spins": options.spin,
        "overrides": options.overrides,
    }


def reconstruct_options(options: argparse.Namespace) -> ReconstructOptions:
    """Options of the reconstruction; what was not given is the default."""
    changes = {
        "horizon_y": options.horizon,
        "pitch_deg": options.pitch,
        "fov_deg": options.fov,
        "environment": options.environment,
        "environment_frame": options.environment_frame,
        "sun": not options.no_sun,
    }
    return dataclasses.replace(ReconstructOptions(), **{k: v for k, v in changes.items() if v is not None})


def bake_options(options: argparse.Namespace) -> BakeOptions:
    """Options of the bake; a verb that does not ask for some of them takes the defaults."""
    names = ("frames", "fps", "quality", "arch", "seed", "space", "points")
    return BakeOptions(**{name: getattr(options, name) for name in names if hasattr(options, name)})
