# SPDX-License-Identifier: GPL-3.0-or-later
"""Cycles takes one picture and everything that is known about it. Runs as a process of its own.

    python -m physgen.benchmarks.reconstruct_pictures.blender_photo SET NUMBER FOLDER [--samples 12] [--threads 0]
                                                                    [--coverage-only]

``FORMAT.md`` says what lies in the folder.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
from pathlib import Path

import bpy
import cv2
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray
from physgen.physgen_addon import compat
from physgen.physgen_addon.render import render_engines
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.render_regions import Box
from physgen.physgen_addon.scene_io import photo_view as bridge_camera
from physgen.sim.srgb import linear_to_bytes
from PIL import Image

from . import blender_materials, scoring
from .cases import Case, Item, Lamp, loose_box
from .picture_sets import draw

FINER = 3
"""Masks are counted on so many times as many pixels along a side."""
SHADOW_RATIO = 0.9
JPEG_QUALITY = 95
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]


class Studio:
    """One case in Blender."""

    def __init__(self, case: Case, samples: int, threads: int, scratch: Path) -> None:
        self._case, self._samples, self._scratch = case, samples, scratch
        bpy.ops.wm.read_factory_settings(use_empty=True)
        compat.enable_cycles()
        scene = self._scene = bpy.data.scenes.new("truth")
        render_engines.set_up_passes(scene)
        render_engines.set_up_cycles(
            scene, RenderOptions(samples=samples, threads=threads, seed=case.seed % 1000), denoise=True
        )
        scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 2, 2, 1
        # Fireflies that no denoiser takes away are no part of a photo.
        scene.cycles.sample_clamp_indirect = 4.0
        scene.render.film_transparent = False
        scene.world = blender_materials.sky(case)
        bridge_camera.add_camera(scene, case.camera, (case.camera.width, case.camera.height))
        for lamp in case.lamps:
            self._add_lamp(lamp)
        self._add_room()
        self._things = {item.name: self._add(item, index) for index, item in enumerate(case.items, start=1)}

    def _add_lamp(self, lamp: Lamp) -> None:
        sine = lamp.towards[2]
        energy = blender_materials.lamp_energy(lamp.strength, sine, lamp.distance)
        towards = Vector(lamp.towards)
        if lamp.distance is None:
            data = bpy.data.lights.new("sun", "SUN")
            data.angle = lamp.width
        else:
            data = bpy.data.lights.new("window", "AREA")
            data.shape, data.size = "RECTANGLE", lamp.distance * lamp.width
            data.size_y = data.size * 1.3
        data.energy, data.color = energy, lamp.colour
        item = bpy.data.objects.new(data.name, data)
        item.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
        item.location = towards * (lamp.distance or 1.0)
        item.visible_camera = False
        self._scene.collection.objects.link(item)

    def _add_room(self) -> None:
        case, far = self._case, 60.0 * self._case.reach
        ground = [(-far, -far, 0.0), (far, -far, 0.0), (far, far, 0.0), (-far, far, 0.0)]
        self._add_plane("ground", ground, blender_materials.floor(case))
        if case.wall is not None:
            turn = math.tan(case.wall_turn)
            left, right = case.wall - far * turn, case.wall + far * turn
            corners = [(-far, left, 0.0), (far, right, 0.0), (far, right, far), (-far, left, far)]
            self._add_plane("wall", corners, blender_materials.wall(case.wall_paint, case.reach))

    def _add_plane(self, name: str, corners: list[tuple[float, float, float]], paint: bpy.types.Material) -> None:
        data = bpy.data.meshes.new(name)
        data.from_pydata(corners, [], [(0, 1, 2, 3)])
        data.materials.append(paint)
        self._scene.collection.objects.link(bpy.data.objects.new(name, data))

    def _add(self, item: Item, index: int) -> bpy.types.Object:
        mesh = item.body.mesh
        data = bpy.data.meshes.new(item.name)
        data.from_pydata(mesh.vertices.tolist(), [], mesh.faces.tolist())
        for which in (0, 1):
            data.materials.append(blender_materials.skin(item, which))
        data.polygons.foreach_set("material_index", item.body.paints.astype(np.int32))
        if item.body.colours is not None:
            painted = data.color_attributes.new(blender_materials.PAINT, "FLOAT_COLOR", "POINT")
            opaque = np.concatenate([item.body.colours, np.ones((len(item.body.colours), 1))], axis=1)
            painted.data.foreach_set("color", opaque.astype(np.float32).ravel())
        if item.body.smooth:
            data.shade_smooth()
            data.set_sharp_from_angle(angle=math.radians(35.0))
        thing = bpy.data.objects.new(item.name, data)
        thing.matrix_world = Matrix(item.world_from_mesh.tolist())
        thing.pass_index = index
        self._scene.collection.objects.link(thing)
        return thing

    def picture(self, names: set[str]) -> Picture:
        """(H, W, 3) linear light with only these things there."""
        for name, thing in self._things.items():
            thing.hide_render = name not in names
        # The photo and the empty place are looked at; the others are for shadows and hidden colours.
        self._scene.cycles.samples = self._samples if len(names) in (0, len(self._things)) else self._samples // 2
        size = Box(0, 0, self._scene.render.resolution_x, self._scene.render.resolution_y)
        return render_engines.stack(render_engines.render_passes(self._scene, 1, size, self._scratch), "Combined")

    def coverage(self) -> dict[str, Picture]:
        """(H, W) the share of each pixel that shows each of the things."""
        scene, layer = self._scene, self._scene.view_layers[0]
        size = (scene.render.resolution_x, scene.render.resolution_y)
        scene.cycles.samples, scene.cycles.max_bounces = 1, 0
        render_engines.set_denoising(scene, False)
        layer.use_pass_object_index, layer.material_override = True, bpy.data.materials.new("index")
        scene.render.resolution_x, scene.render.resolution_y = FINER * size[0], FINER * size[1]
        for thing in self._things.values():
            thing.hide_render = False
        box = Box(0, 0, FINER * size[0], FINER * size[1])
        index = np.rint(render_engines.render_passes(scene, 1, box, self._scratch)[compat.OBJECT_INDEX])
        shares = {}
        for name, thing in self._things.items():
            shown = (index == thing.pass_index).astype(np.float32)
            shares[name] = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
        return shares


def whole_outlines(case: Case, seen: dict[str, Mask]) -> dict[str, Mask]:
    """(H, W) of each thing, also where another stands before it: there alone it is drawn, elsewhere it is ``seen``."""
    whole = {}
    for item in case.items:
        others = np.zeros((case.camera.height, case.camera.width), bool)
        for name, mask in seen.items():
            others |= mask if name != item.name else False
        drawn = scoring.silhouette(case.camera, item.vertices, item.body.mesh.faces)
        whole[item.name] = seen[item.name] | (drawn & scoring.grown(others, 1))
    return whole


def shadow_of(photo: Picture, without: Picture, covered: Picture) -> Mask:
    """Where the photo has less than 0.9 of the light that it has without the thing; (H, W).

    covered: (H, W) share of each pixel on any thing; those pixels do not count. Both are blurred over a pixel first,
    among the pixels that count, and a hundredth of white is added: what is left of the noise is no shadow.
    """
    free = (covered < 0.02).astype(np.float32)

    def even(picture: Picture) -> Picture:
        light = picture.mean(axis=-1) * free
        return (cv2.GaussianBlur(light, (0, 0), 1.2) + 1e-6) / (cv2.GaussianBlur(free, (0, 0), 1.2) + 1e-6)

    ratio = (even(photo) + 0.01) / (even(without) + 0.01)
    dark = ((ratio < SHADOW_RATIO) & (free > 0)).astype(np.uint8)
    # Specks are noise.
    count, labels, stats, _ = cv2.connectedComponentsWithStats(dark, connectivity=8)
    for label in range(1, count):
        if stats[label, cv2.CC_STAT_AREA] < 30:
            dark[labels == label] = 0
    return np.asarray(dark > 0)


def exposed(pictures: dict[frozenset[str], Picture], by: frozenset[str]) -> dict[frozenset[str], Picture]:
    """All as a camera takes them that puts the brightest hundredth of one of them at 0.85 of white."""
    bright = float(np.percentile(pictures[by].max(axis=-1), 99.0))
    return {name: picture * (0.85 / max(bright, 1e-6)) for name, picture in pictures.items()}


def with_grain(picture: NDArray[np.uint8], sigma: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Noise of a sensor of ``sigma`` grey values, a little soft as after demosaicking."""
    noise = rng.normal(0.0, 1.0, picture.shape).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 0.6)
    noise *= sigma / float(noise.std())
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)


def shoot(case: Case, folder: Path, samples: int, threads: int = 0) -> None:
    """Render ``case`` into ``folder``, which appears whole or not at all."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    for sub in ("visible", "full", "shadow", "alone", "meshes"):
        (partial / sub).mkdir(parents=True)
    names = [item.name for item in case.items]
    with tempfile.TemporaryDirectory(prefix="physgen-pictures-") as scratch:
        studio = Studio(case, samples, threads, Path(scratch))
        taken = {some: studio.picture(set(some)) for some in _wanted(names)}
        shares = studio.coverage()
    seen = {name: share > 0.5 for name, share in shares.items()}
    whole = whole_outlines(case, seen)
    everything = frozenset(names)
    taken = exposed(taken, everything)
    photo = taken[everything]
    covered = np.sum(list(shares.values()), axis=0)
    rng = np.random.default_rng(case.seed + 1)
    _save_photo(case, with_grain(linear_to_bytes(photo), case.noise, rng), partial / "photo.jpg")
    _save(linear_to_bytes(taken[frozenset()]), partial / "background.png")
    shadows = {}
    for name in names:
        _save_mask(seen[name], partial / "visible" / f"{name}.png")
        _save_mask(whole[name], partial / "full" / f"{name}.png")
        shadows[name] = shadow_of(photo, taken[everything - {name}], covered)
        _save_mask(shadows[name], partial / "shadow" / f"{name}.png")
        _save(linear_to_bytes(taken[frozenset({name})]), partial / "alone" / f"{name}.png")
    for item in case.items:
        item.body.mesh.export(partial / "meshes" / f"{item.name}.obj")
    truth = _truth(case, seen, whole)
    (partial / "truth.json").write_text(json.dumps(truth, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def shoot_coverage(case: Case, folder: Path, samples: int, threads: int = 0) -> None:
    """Render only the photo and the true coverage of each thing into ``folder``, which appears whole or not at all:
    ``photo.jpg``, ``alpha/NAME.png`` (0 to 255) and ``boxes.json`` (name, kind, box, tight)."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "alpha").mkdir(parents=True)
    everything = frozenset(item.name for item in case.items)
    with tempfile.TemporaryDirectory(prefix="physgen-pictures-") as scratch:
        studio = Studio(case, samples, threads, Path(scratch))
        taken = {everything: studio.picture(set(everything))}
        shares = studio.coverage()
    photo = exposed(taken, everything)[everything]
    rng = np.random.default_rng(case.seed + 1)
    _save_photo(case, with_grain(linear_to_bytes(photo), case.noise, rng), partial / "photo.jpg")
    for name, share in shares.items():
        _save(np.rint(share * 255.0).astype(np.uint8), partial / "alpha" / f"{name}.png")
    boxes = []
    rng = np.random.default_rng(case.seed + 2)
    for item in case.items:
        ys, xs = np.nonzero(shares[item.name] > 0.5)
        tight = (float(xs.min()), float(ys.min()), float(xs.max() + 1), float(ys.max() + 1))
        box = loose_box(tight, (case.camera.width, case.camera.height), rng)
        boxes.append({"name": item.name, "kind": item.kind, "box": box, "tight": tight})
    (partial / "boxes.json").write_text(json.dumps(boxes, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def _wanted(names: list[str]) -> list[frozenset[str]]:
    everything = frozenset(names)
    some = [everything, frozenset[str](), *(frozenset({n}) for n in names), *(everything - {n} for n in names)]
    return list(dict.fromkeys(some))


def _save(pixels: NDArray[np.uint8], path: Path) -> None:
    Image.fromarray(pixels).save(path, compress_level=4)


def _save_mask(mask: Mask, path: Path) -> None:
    _save(mask.astype(np.uint8) * 255, path)


def _save_photo(case: Case, pixels: NDArray[np.uint8], path: Path) -> None:
    exif = Image.Exif()
    if case.exif:
        camera = case.camera
        equivalent = camera.fx * FULL_FRAME_DIAGONAL_MM / math.hypot(camera.width, camera.height)
        exif.get_ifd(0x8769)[0xA405] = round(equivalent)
        exif[0x010F] = "Benchmark"
    Image.fromarray(pixels).save(path, quality=JPEG_QUALITY, subsampling=0, exif=exif)


def _truth(case: Case, seen: dict[str, Mask], whole: dict[str, Mask]) -> dict[str, object]:
    camera = case.camera
    size = (camera.width, camera.height)
    rng = np.random.default_rng(case.seed + 2)
    objects = []
    for item in case.items:
        ys, xs = np.nonzero(seen[item.name])
        tight = (float(xs.min()), float(ys.min()), float(xs.max() + 1), float(ys.max() + 1))
        hidden = whole[item.name] & ~seen[item.name]
        objects.append(
            {
                "name": item.name,
                "kind": item.kind,
                "box": loose_box(tight, size, rng),
                "tight": tight,
                "size_m": float(np.ptp(item.vertices, axis=0).max()),
                "volume_m3": item.body.volume,
                "mesh": f"meshes/{item.name}.obj",
                "world_from_mesh": item.world_from_mesh.tolist(),
                "occluded_share": float(hidden.sum() / max(1, whole[item.name].sum())),
            }
        )
    sun = next((lamp for lamp in case.lamps if lamp.distance is None), None)
    return {
        "width": camera.width,
        "height": camera.height,
        "exif": case.exif,
        "vanishing_points": case.vanishing_points,
        "camera": {
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "world_from_camera": camera.world_from_camera,
        },
        "ground": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "kind": case.ground},
        "wall": case.wall is not None,
        "light": {
            "kind": case.light,
            "sun_direction": None if sun is None else sun.towards,
            "sun_strength": 0.0 if sun is None else sun.strength,
            "sun_angle": None if sun is None else sun.width,
        },
        "objects": objects,
        "order": case.order,
        "seed": case.seed,
    }


def main() -> int:
    """Entry; 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set")
    parser.add_argument("number", type=int)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=12)
    parser.add_argument("--threads", type=int, default=0, help="of the processor; 0 takes all")
    parser.add_argument("--coverage-only", action="store_true", help="only the photo and the true coverage")
    options = parser.parse_args()
    (shoot_coverage if options.coverage_only else shoot)(
        draw(options.set, options.number), options.folder, options.samples, options.threads
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
