# SPDX-License-Identifier: GPL-3.0-or-later
"""Drift of untouched objects in two seconds: every scene, material preset and quality.

    python -m physgen.benchmarks.rest FOLDER … [--preset NAME …] [--quality NAME …] [--awake] [--scenes DIR]

FOLDER is a scene folder, a folder of them, or a folder of photos whose README.md has a table with the boxes of each
(``| `photo.jpg` | … cup 215,960,475,1190 · book 625,450,1240,1200 | …``); photos are reconstructed into ``--scenes``.
All objects get the preset and no velocity, as by the plain command. The drift of a scene is the farthest that any
particle of any object gets from its place in that time, over the object's size; required: below 0.5 %.

``--awake`` forbids sleep: what the same matter does when it has to carry itself from the first moment on. Also printed:
each object's margin, from the foot of its centre of mass to the edge of its base, over its height and in grid cells of
the coarsest quality; required of bodies that are not round: 0.15, and 2. ``--quick`` is two blocks and one preset.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from physgen.benchmarks.common import benchmark_parser
from physgen.sim.app.bake_options import BakeOptions
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.app.scene_to_world import prepare_world
from physgen.sim.app.simulation import start_world
from physgen.sim.errors import PhysGenError
from physgen.sim.importers.mesh_scene import scene_from_meshes
from physgen.sim.reconstruct import ObjectRequest
from physgen.sim.reconstruct.shape.stability import support_of
from physgen.sim.scene.bake_quality import quality_names
from physgen.sim.scene.folder import SCENE_FILE, Scene, load_scene
from physgen.sim.scene.material import load_preset, preset_names
from physgen.sim.scene.meshes import ObjectMesh, load_object_mesh

LOOKS = 12
"""Looks at the drift per second."""
LIMIT = 0.5
"""Largest drift allowed, per cent of the object's size."""
BOX = re.compile(r"([^\W\d][\w -]*?)\s+(\d+),(\d+),(\d+),(\d+)")


def boxes_of(readme: str) -> dict[str, list[tuple[float, ...]]]:
    """Return the boxes (x0, y0, x1, y1 in pixels) by photo that the tables of a README hold."""
    found: dict[str, list[tuple[float, ...]]] = {}
    for line in readme.splitlines():
        photo = re.match(r"\|\s*`([^`]+)`", line)
        boxes = [tuple(map(float, match.groups()[1:])) for match in BOX.finditer(line)]
        if photo and boxes:
            found[photo[1]] = boxes
    return found


def scenes_in(folder: Path, scratch: Path) -> Iterator[tuple[str, Scene]]:
    """Yield the scenes in ``folder`` by name; photos are reconstructed into ``scratch`` first."""
    if (folder / SCENE_FILE).is_file():
        yield folder.name, load_scene(folder)
        return
    readme = folder / "README.md"
    if readme.is_file():
        for photo, boxes in boxes_of(readme.read_text(encoding="utf-8")).items():
            sys.stderr.write(f"reconstructing {photo}\n")
            requests = [ObjectRequest(box=box) for box in boxes]  # type: ignore[arg-type]
            yield Path(photo).stem, reconstruct(folder / photo, requests, out=scratch / Path(photo).stem)
    for file in sorted(folder.rglob(SCENE_FILE)):
        yield file.parent.relative_to(folder).as_posix(), load_scene(file.parent)


def drifts(
    scene: Scene, meshes: Sequence[ObjectMesh], preset: str, quality: str, *, seconds: float, awake: bool
) -> dict[str, float]:
    """Return the drift of each moving object in per cent of its size. Raises PhysGenError when it cannot be run."""
    still = (0.0, 0.0, 0.0)
    objects = tuple(
        dataclasses.replace(item, material=load_preset(preset), velocity=still, spin=still, asleep=not awake)
        for item in scene.model.objects
    )
    frames = round(seconds * LOOKS) + 1
    prepared = prepare_world(
        Scene(root=scene.root, model=dataclasses.replace(scene.model, objects=objects)),
        meshes,
        BakeOptions(frames=frames, fps=LOOKS, quality=quality),
    )
    world = start_world(prepared).world
    bodies = {item.name: body for item, body in zip(objects, prepared.body_of_object, strict=True) if body is not None}
    farthest = dict.fromkeys(bodies, 0.0)
    for _ in range(frames - 1):
        world.advance(1 / LOOKS)
        for name, body in bodies.items():
            rest = world.bodies[body].positions
            way = float(np.linalg.norm(world.positions(body) - rest, axis=1).max())
            size = float(np.ptp(rest, axis=0).max())
            farthest[name] = max(farthest[name], 100.0 * way / size)
    return farthest


def margins(scene: Scene, meshes: Sequence[ObjectMesh]) -> dict[str, dict[str, float]]:
    """Return how each object stands: its margin over its height, and in cells of the coarsest quality."""
    found = {}
    for item, mesh in zip(scene.model.objects, meshes, strict=True):
        stands = support_of(mesh.vertices, mesh.faces)
        found[item.name] = {
            "over_height": round(stands.margin / stands.height, 3),
            "cells": round(stands.margin / stands.cell, 2),
        }
    return found


def measure(
    name: str, scene: Scene, presets: Sequence[str], qualities: Sequence[str], *, seconds: float, awake: bool
) -> dict[str, Any]:
    """Return the drifts of one scene, by quality, preset and object, or the error in their place."""
    meshes = [load_object_mesh(scene, item) for item in scene.model.objects]
    found: dict[str, dict[str, Any]] = {}
    for quality in qualities:
        found[quality] = {}
        for preset in presets:
            try:
                found[quality][preset] = drifts(scene, meshes, preset, quality, seconds=seconds, awake=awake)
            except PhysGenError as error:
                found[quality][preset] = str(error)
            sys.stderr.write(f"{name} {quality} {preset}: {found[quality][preset]}\n")
    return {"scene": name, "margins": margins(scene, meshes), "drift_percent": found}


def table(rows: Sequence[dict[str, Any]], presets: Sequence[str]) -> str:
    """Return the largest drift of each scene and quality (lines) for each preset (columns), in per cent."""
    width = max([12, *(len(row["scene"]) for row in rows)])
    lines = [f"{'scene':{width}} {'quality':9}" + "".join(f" {name[:7]:>7}" for name in presets)]
    for row in rows:
        for quality, by_preset in row["drift_percent"].items():
            cells = "".join(
                f" {'refused' if isinstance(found, str) else format(max(found.values()), '.2f'):>7}"
                for found in by_preset.values()
            )
            lines.append(f"{row['scene']:{width}} {quality:9}{cells}")
    lines += [f"\n{'scene':{width}} {'object':14} margin/height   cells"]
    for row in rows:
        for name, margin in row["margins"].items():
            lines.append(f"{row['scene']:{width}} {name:14} {margin['over_height']:13.3f} {margin['cells']:7.2f}")
    return "\n".join(lines)


def two_blocks(root: Path) -> Scene:
    """Return a scene of a block on another, asleep."""
    root.mkdir(parents=True)
    files = {}
    for name, size, height in (("low", 0.1, 0.05), ("high", 0.06, 0.13)):
        mesh = trimesh.creation.box((size, size, size))
        mesh.apply_translation((0.0, 0.0, height))
        mesh.export(root / f"{name}.ply")
        files[name] = str(root / f"{name}.ply")
    return scene_from_meshes(files, out=root / "scene")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 1 if an object drifts by more than the limit or a scene cannot be run."""
    parser = benchmark_parser("rest", __doc__, preset=["soft"], quality=["preview"], seconds=0.25)
    parser.add_argument("folders", type=Path, nargs="*", metavar="FOLDER", help="scenes, or photos with their boxes")
    parser.add_argument("--preset", nargs="+", default=preset_names(), help="default: all")
    parser.add_argument("--quality", nargs="+", default=quality_names(), help="default: all")
    parser.add_argument("--seconds", type=float, default=2.0, help="of motion (default: %(default)g)")
    parser.add_argument("--awake", action="store_true", help="let no object sleep")
    parser.add_argument("--scenes", type=Path, metavar="DIR", help="keep the reconstructed scenes here")
    options = parser.parse_args(arguments)
    if not options.folders and not options.quick:
        parser.error("name a folder of scenes or photos")
    rows = []
    with tempfile.TemporaryDirectory(prefix="physgen-rest-") as scratch:
        place = options.scenes or Path(scratch)
        found = [pair for folder in options.folders for pair in scenes_in(folder, place)]
        if not options.folders:
            found = [("two blocks", two_blocks(Path(scratch) / "quick"))]
        for name, scene in found:
            row = measure(name, scene, options.preset, options.quality, seconds=options.seconds, awake=options.awake)
            rows.append(row)
    every = [found for row in rows for by_preset in row["drift_percent"].values() for found in by_preset.values()]
    ran = [max(found.values()) for found in every if not isinstance(found, str)]
    result = {
        "runs": len(every),
        "refused": len(every) - len(ran),
        "worst_percent": max(ran, default=None),
        "scenes": rows,
    }
    if options.json:
        print(json.dumps(result))
    else:
        print(f"{table(rows, options.preset)}\n\n{len(ran)} runs, worst drift {result['worst_percent']} %")
    good = result["refused"] == 0 and all(drift < LIMIT for drift in ran)
    return 0 if good or options.awake else 1


if __name__ == "__main__":
    sys.exit(main())
