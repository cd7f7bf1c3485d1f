# SPDX-License-Identifier: GPL-3.0-or-later
"""Flags of physics, bake and samples that verbs of ``physgen`` share, and the options made from them."""

from __future__ import annotations

import argparse

from ...sim.app.bake_options import BakeOptions
from ...sim.app.reconstruct import Physics
from ...sim.cache.bake_folder import SPACES
from ...sim.scene.material import preset_names
from .flags import parse_vector


def add_physics_flags(parser: argparse.ArgumentParser) -> None:
    """Add materials, velocities and overrides of any field."""
    group = parser.add_argument_group("material and motion")
    names = preset_names()
    group.add_argument(
        "--preset",
        nargs="+",
        action="extend",
        default=[],
        choices=names,
        help="material: one for all objects, or one per object",
    )
    velocity = "initial velocity x,y,z in m/s: right, away from the camera, up; one per object"
    group.add_argument(
        "--velocity", type=parse_vector, nargs="+", action="extend", default=[], metavar="V", help=velocity
    )
    group.add_argument(
        "--spin",
        type=parse_vector,
        nargs="+",
        action="extend",
        default=[],
        metavar="W",
        help="initial angular velocity x,y,z in rad/s; one per object",
    )
    change = "override a field of an object, its material, 'ground' or 'scene', such as cup.density=300"
    group.add_argument(
        "--set", nargs="+", action="extend", default=[], dest="overrides", metavar="OBJECT.FIELD=VALUE", help=change
    )


def add_bake_flags(parser: argparse.ArgumentParser) -> None:
    """Add the options of a simulation."""
    group = parser.add_argument_group("simulation")
    defaults = BakeOptions()
    group.add_argument(
        "--frames", type=int, default=defaults.frames, help=f"number of frames (default {defaults.frames})"
    )
    group.add_argument("--fps", type=float, default=defaults.fps, help=f"frames per second (default {defaults.fps:g})")
    text = "slow motion: how many times slower than real the video shows the motion"
    group.add_argument("--slow", type=float, default=defaults.slow, metavar="N", help=f"{text} (default 1)")
    group.add_argument(
        "--quality",
        default=defaults.quality,
        help=f"preview, standard, fine or papers (docs/simulation.md; default {defaults.quality})",
    )
    group.add_argument(
        "--arch",
        default=defaults.arch,
        choices=["cpu", "cuda", "vulkan", "metal"],
        help=f"backend of the simulation; falls back to cpu (default {defaults.arch})",
    )
    group.add_argument(
        "--seed",
        type=int,
        default=defaults.seed,
        metavar="N",
        help=f"jitter of the particle positions; 0: regular lattice (default {defaults.seed})",
    )
    group.add_argument(
        "--implicit",
        action=argparse.BooleanOptionalAction,
        default=defaults.implicit,
        help="let stiff objects take long, implicit time steps while they fly, slide or rest "
        f"(docs/simulation.md; default {'on' if defaults.implicit else 'off'})",
    )


def add_sample_flags(parser: argparse.ArgumentParser) -> None:
    """Add the options of what a bake writes."""
    defaults = BakeOptions()
    space = "coordinates of the samples: world metres, or those of each object's mesh file"
    parser.add_argument("--space", default=defaults.space, choices=SPACES, help=f"{space} (default {defaults.space})")
    points = "write the particles of granular and fluid objects: sand, snow, fluid, sandy effect (default: on)"
    parser.add_argument("--points", action=argparse.BooleanOptionalAction, default=defaults.points, help=points)


def physics_options(options: argparse.Namespace) -> Physics:
    """Return the physics that the flags give."""
    return Physics(
        presets=tuple(options.preset),
        velocities=tuple(options.velocity),
        spins=tuple(options.spin),
        overrides=tuple(options.overrides),
    )


def bake_options(options: argparse.Namespace) -> BakeOptions:
    """Return the options of the bake; defaults for flags that the verb does not have."""
    names = ("frames", "fps", "slow", "quality", "arch", "seed", "space", "points", "implicit")
    return BakeOptions(**{name: value for name in names if (value := getattr(options, name, None)) is not None})
