# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``compose`` and ``fit-splats`` (docs/composition.md)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...sim.events import IsCancelled
from ...sim.gaussians.compose.compose_options import METHODS, ComposeOptions, ComposeRequest
from ...sim.scene.folder import load_scene
from ...sim.scene.scene_output import COMPOSE_FILE
from ...sim.validation import read_json
from ..terminal import Terminal
from .diagnosis_commands import parse_names
from .flags import add_anyway_flag

DEFAULTS = ComposeOptions()
_LAYOUTS = ("syncdreamer", "zero123++1.1", "zero123++1.2")


def add_compose(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen compose``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE2", help="the new scene folder")
    add_anyway_flag(parser)
    chosen = "from the fixed one to the deformable ones (default: all that touch another, frontmost first)"
    parser.add_argument("--objects", type=parse_names, default=(), metavar="A,B,…", help=chosen)
    method = f"what moves the objects (default {DEFAULTS.method}; ppps with --no-picture)"
    parser.add_argument("--method", choices=METHODS, help=method)
    for flag, name, text in (
        ("--steps", "steps", "optimiser steps"),
        ("--substeps", "substeps", "simulation substeps per step"),
        ("--cells", "cells", "grid cells along the longest side of the deformable object"),
        ("--size", "size", "longer side in pixels of the compared image"),
        ("--seed", "seed", "seed of splat positions and noise"),
    ):
        default = getattr(DEFAULTS, name)
        parser.add_argument(flag, type=int, default=default, metavar="N", help=f"{text} (default {default})")
    strain = "fraction of the strain kept from step to step, 0 to 1"
    default = DEFAULTS.keep_strain
    parser.add_argument(
        "--keep-strain", type=float, default=default, metavar="F", help=f"{strain} (default {default:g})"
    )
    seat = "bulge beside contacts, over an object's size, so that objects stand, 0 to 0.02"
    parser.add_argument(
        "--seat", type=float, default=DEFAULTS.seat, metavar="F", help=f"{seat} (default {DEFAULTS.seat:g})"
    )
    splats = "total for all objects without splats of their own (default 20000)"
    parser.add_argument("--splats", type=int, default=20_000, metavar="COUNT", help=splats)
    parser.add_argument("--no-picture", action="store_true", help="ignore the photo: physics only (method ppps)")
    guidance = "exact:VIEWS (views folder of the deformable object) or diffusers:FOLDER (a local model)"
    parser.add_argument("--guidance", default="", metavar="[OBJECT=]KIND:FOLDER", help=guidance)
    parser.add_argument("--prompt", default="", metavar="TEXT", help="prompt for a diffusers model")
    weight = f"weight λ3 of the guidance, 0 to 1 (default {DEFAULTS.guidance_weight:g})"
    parser.add_argument("--guidance-weight", type=float, default=DEFAULTS.guidance_weight, metavar="W", help=weight)


def run_compose(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen compose``; the exit code."""
    # Imported late: Taichi takes seconds, and other verbs do not need it.
    from ...sim.app.compose_scene import compose

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
            seat=options.seat,
            guidance_weight=options.guidance_weight,
        ),
        splats=options.splats,
        picture=not options.no_picture,
        guidance=options.guidance,
        prompt=options.prompt,
    )
    compose(load_scene(options.scene), out=options.out, request=request, on_event=terminal, cancelled=cancelled)
    record = read_json(options.out / COMPOSE_FILE)
    terminal({"event": "done", "scene": str(options.out), "pairs": record["pairs"], "groups": record["groups"]})
    terminal.line("\n".join([*_lines(record), f"scene: {options.out}"]))
    return 0


def _lines(record: dict[str, Any]) -> list[str]:
    """Return the record as lines of text."""
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
                f"{', '.join(group['objects'])}: similarity to the photo {_decibels(before)} → {_decibels(after)} dB, "
                f"SSIM {before['ssim']:.3f} → {after['ssim']:.3f}"
            )
    return lines


def _decibels(likeness: dict[str, Any]) -> str:
    return "∞" if likeness["psnr_db"] is None else f"{likeness['psnr_db']:.2f}"


def add_fit_splats(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen fit-splats``."""
    views = "folder with transforms.json and images, or with --layout one image of views side by side"
    parser.add_argument("views", type=Path, metavar="VIEWS", help=views)
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")
    behind = "the same views with the foreground object removed and inpainted: gives two objects"
    parser.add_argument("--background-views", type=Path, metavar="VIEWS", help=behind)
    layout = "camera layout of the views (default transforms: those of transforms.json)"
    parser.add_argument("--layout", default="transforms", metavar="LAYOUT", help=f"{layout}; {', '.join(_LAYOUTS)}")
    parser.add_argument(
        "--objects", type=parse_names, default=(), metavar="BEHIND,FRONT", help="names of the mask folders"
    )
    for flag, default, text in (
        ("--splats", 20_000, "total for all objects"),
        ("--steps", 600, "steps of each object's fit"),
        ("--seed", 0, "seed of splat positions and view order"),
    ):
        parser.add_argument(flag, type=int, default=default, metavar="N", help=f"{text} (default {default})")
    parser.add_argument("--reference", default="", metavar="NAME", help="view to use as the photo (default: the first)")


def run_fit_splats(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen fit-splats``; the exit code."""
    # Imported late: Taichi takes seconds, and other verbs do not need it.
    from ...sim.app.fit_splats import FitRequest, fit_splats_scene

    request = FitRequest(
        background_views=options.background_views,
        layout=options.layout,
        objects=options.objects,
        splats=options.splats,
        steps=options.steps,
        reference=options.reference,
        seed=options.seed,
    )
    folder = fit_splats_scene(options.views, out=options.out, request=request, on_event=terminal, cancelled=cancelled)
    found = [item.name for item in folder.model.objects]
    terminal({"event": "done", "scene": str(options.out), "objects": found})
    terminal.line(f"scene: {options.out} ({', '.join(found)})")
    return 0
