# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``compose`` and ``fit-splats`` (docs/compositional-assets.md)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..sim.app.compose_request import ComposeRequest
from ..sim.events import IsCancelled
from ..sim.gaussians.compose.options import METHODS, ComposeOptions
from ..sim.scene.json_fields import read_json
from .diagnosis import names
from .terminal import Terminal

DEFAULTS = ComposeOptions()
_LAYOUTS = ("syncdreamer", "zero123++1.1", "zero123++1.2")


def add_compose(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen compose``."""
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE2", help="the new scene folder")
    chosen = "from the one that stays to the ones that yield (default: all that touch another, frontmost first)"
    parser.add_argument("--objects", type=names, default=(), metavar="A,B,…", help=chosen)
    method = f"how they are moved (default {DEFAULTS.method}; ppps with --no-picture)"
    parser.add_argument("--method", choices=METHODS, help=method)
    for flag, name, text in (
        ("--steps", "steps", "steps of the optimiser"),
        ("--substeps", "substeps", "of the simulation, in each step"),
        ("--cells", "cells", "grid cells along the longest side of what yields"),
        ("--size", "size", "pixels of the longer side of the picture that is compared"),
        ("--seed", "seed", "of the splats' places and of the noise"),
    ):
        default = getattr(DEFAULTS, name)
        parser.add_argument(flag, type=int, default=default, metavar="N", help=f"{text} (default {default})")
    strain = "share of the strain that lives on from step to step, 0 to 1"
    default = DEFAULTS.keep_strain
    parser.add_argument(
        "--keep-strain", type=float, default=default, metavar="F", help=f"{strain} (default {default:g})"
    )
    splats = "of all objects together that have none of their own (default 20000)"
    parser.add_argument("--splats", type=int, default=20_000, metavar="COUNT", help=splats)
    parser.add_argument("--no-picture", action="store_true", help="leave the photo aside: physics alone (method ppps)")
    guidance = "exact:VIEWS (pictures of what yields, with cameras) or diffusers:FOLDER (a model of yours)"
    parser.add_argument("--guidance", default="", metavar="[OBJECT=]KIND:FOLDER", help=guidance)
    parser.add_argument("--prompt", default="", metavar="TEXT", help="what a diffusers model is told that it sees")
    weight = f"λ3, weight of the guidance, 0 to 1 (default {DEFAULTS.guidance_weight:g})"
    parser.add_argument("--guidance-weight", type=float, default=DEFAULTS.guidance_weight, metavar="W", help=weight)


def run_compose(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen compose``; the exit code."""
    # Late: Taichi takes seconds, and the command has other verbs.
    from ..sim.app.compose import compose_scene

    request = ComposeRequest(
        objects=options.objects,
        options=ComposeOptions(
            method=options.method or ("ppps" if options.no_picture else DEFAULTS.method),
            steps=options.steps,
            substeps=options.substeps,
            cells=options.cells,
            size=options.size,
            seed=options.seed,
            keep_strain=options.keep_strain,
            guidance_weight=options.guidance_weight,
        ),
        splats=options.splats,
        picture=not options.no_picture,
        guidance=options.guidance,
        prompt=options.prompt,
    )
    compose_scene(options.scene, options.out, request, terminal, cancelled)
    record = read_json(options.out / "compose.json")
    terminal({"event": "done", "scene": str(options.out), "pairs": record["pairs"], "groups": record["groups"]})
    terminal.line("\n".join([*_lines(record), f"scene: {options.out}"]))
    return 0


def _lines(record: dict[str, Any]) -> list[str]:
    """The numbers for people."""
    lines = []
    for pair in record["pairs"]:
        before, after = pair["before"], pair["after"]
        lines.append(
            f"{' and '.join(pair['objects'])}: penetration {before['volume_m3'] * 1e6:.4g} → "
            f"{after['volume_m3'] * 1e6:.4g} cm³ ({100 * before['share']:.3g} → {100 * after['share']:.3g} %), deepest "
            f"{before['deepest_m'] * 1e3:.3g} → {after['deepest_m'] * 1e3:.3g} mm"
        )
    for group in record["groups"]:
        if group["likeness"] is not None:
            before, after = group["likeness"]
            lines.append(
                f"{', '.join(group['objects'])}: likeness to the photo {_decibels(before)} → {_decibels(after)} dB, "
                f"SSIM {before['ssim']:.3f} → {after['ssim']:.3f}"
            )
    return lines


def _decibels(likeness: dict[str, Any]) -> str:
    return "∞" if likeness["psnr_db"] is None else f"{likeness['psnr_db']:.2f}"


def add_fit_splats(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen fit-splats``."""
    views = "folder with transforms.json and pictures, or with --layout one picture of views side by side"
    parser.add_argument("views", type=Path, metavar="VIEWS", help=views)
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")
    behind = "the same views without the object in front, what it hid filled in: makes it two objects"
    parser.add_argument("--background-views", type=Path, metavar="VIEWS", help=behind)
    layout = "whose cameras the views have (default transforms: those of transforms.json)"
    parser.add_argument("--layout", default="transforms", metavar="LAYOUT", help=f"{layout}; {', '.join(_LAYOUTS)}")
    parser.add_argument("--objects", type=names, default=(), metavar="BEHIND,FRONT", help="names of the masks' folders")
    for flag, default, text in (
        ("--splats", 20_000, "of all objects together"),
        ("--steps", 600, "of each object's fit"),
        ("--seed", 0, "of the splats' places and the order of the views"),
    ):
        parser.add_argument(flag, type=int, default=default, metavar="N", help=f"{text} (default {default})")
    parser.add_argument(
        "--reference", default="", metavar="NAME", help="view that becomes the photo (default: the first)"
    )


def run_fit_splats(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen fit-splats``; the exit code."""
    # Late: Taichi takes seconds, and the command has other verbs.
    from ..sim.app.fit_splats import FitRequest, fit_splats_scene

    request = FitRequest(
        background_views=options.background_views,
        layout=options.layout,
        objects=options.objects,
        splats=options.splats,
        steps=options.steps,
        reference=options.reference,
        seed=options.seed,
    )
    folder = fit_splats_scene(options.views, options.out, request, terminal, cancelled)
    found = [item.name for item in folder.scene.objects]
    terminal({"event": "done", "scene": str(options.out), "objects": found})
    terminal.line(f"scene: {options.out} ({', '.join(found)})")
    return 0
