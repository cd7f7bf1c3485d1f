# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors of the estimated lighting: Cycles renders photos under known suns, which are then reconstructed. Needs bpy.

    python -m physgen.benchmarks.light [--cases 1,5,9] [--keep DIR] [--json]

Each photo shows one object on a textured ground, with interreflections, and is reconstructed from a loose box with
known pitch and field of view. Required: the sun's direction within 10°, the ratio of sun to environment within 15 %.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import bpy
import numpy as np
import trimesh
from mathutils import Vector
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser, blender_output_to_stderr
from physgen.physgen_addon import compat
from physgen.physgen_addon.render import render_engines
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.render_regions import Box
from physgen.physgen_addon.render.render_scene import add_ground
from physgen.physgen_addon.scene_io import photo_view as bridge_camera
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.errors import PhysGenError
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.scene.model import Camera, Ground, Light
from physgen.sim.srgb import linear_to_bytes
from PIL import Image

FOV_DEG = 45.0
WANTED_DEG, WANTED_SHARE = 10.0, 0.15


@dataclass(frozen=True, kw_only=True)
class Case:
    """A photo under known lighting.

    azimuth, elevation: degrees, of the direction towards the sun; azimuth 0 is right of the camera, 90 ahead.
    strength: irradiance of the sun relative to the sky on open ground, 0: no sun. angle: its diameter in degrees.
    shape: ``ball``, ``box``, ``jug`` or ``monkey``. ground: ``grain``, ``planks``, ``tiles`` or ``plain``.
    """

    azimuth: float
    elevation: float
    strength: float
    angle: float = 6.0
    shape: str = "ball"
    ground: str = "grain"
    pitch: float = 32.0


CASES = (
    Case(azimuth=150, elevation=45, strength=1.5, shape="ball", ground="grain"),
    Case(azimuth=25, elevation=30, strength=3.0, shape="ball", ground="planks", angle=2),
    Case(azimuth=100, elevation=35, strength=1.0, shape="ball", ground="grain", angle=12),
    Case(azimuth=-30, elevation=50, strength=2.0, shape="ball", ground="tiles"),
    Case(azimuth=170, elevation=60, strength=0.6, shape="box", ground="grain", angle=10),
    Case(azimuth=60, elevation=40, strength=2.0, shape="box", ground="planks"),
    Case(azimuth=-150, elevation=35, strength=1.0, shape="box", ground="plain", angle=3),
    Case(azimuth=130, elevation=28, strength=4.0, shape="jug", ground="grain", angle=1),
    Case(azimuth=10, elevation=70, strength=2.5, shape="jug", ground="tiles"),
    Case(azimuth=-160, elevation=55, strength=0.5, shape="jug", ground="planks", angle=15),
    Case(azimuth=80, elevation=55, strength=1.2, shape="monkey", ground="grain"),
    Case(azimuth=200, elevation=40, strength=0.8, shape="monkey", ground="plain", angle=8),
    Case(azimuth=-20, elevation=25, strength=1.8, shape="monkey", ground="planks", angle=4),
    Case(azimuth=120, elevation=50, strength=4.0, shape="ball", ground="plain", angle=20, pitch=45),
    Case(azimuth=0, elevation=90, strength=0.0, shape="ball", ground="grain"),
    Case(azimuth=0, elevation=90, strength=0.0, shape="box", ground="tiles"),
    Case(azimuth=170, elevation=60, strength=0.6, shape="box", ground="plain", angle=10),
    Case(azimuth=-160, elevation=55, strength=0.5, shape="jug", ground="plain", angle=15),
    Case(azimuth=30, elevation=50, strength=1.0, shape="box", ground="planks", angle=4, pitch=40),
    Case(azimuth=140, elevation=35, strength=2.0, shape="box", ground="grain", angle=8),
    Case(azimuth=60, elevation=45, strength=1.0, shape="jug", ground="plain", angle=10),
    Case(azimuth=180, elevation=40, strength=2.0, shape="jug", ground="tiles", angle=5),
    Case(azimuth=150, elevation=45, strength=0.8, shape="monkey", ground="grain", angle=6, pitch=25),
    Case(azimuth=20, elevation=35, strength=3.0, shape="monkey", ground="planks", angle=2),
)


def direction(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Return the unit vector (3,) for angles in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


def camera(case: Case, size: tuple[int, int]) -> Camera:
    """Return a camera 0.55 m from a point slightly above the origin."""
    pitch = math.radians(case.pitch)
    s, c = math.sin(pitch), math.cos(pitch)
    focal = max(size) / 2 / math.tan(math.radians(FOV_DEG) / 2)
    pose = ((1, 0, 0, 0), (0, -s, c, -0.55 * c), (0, -c, -s, 0.55 * s + 0.03), (0, 0, 0, 1))
    return Camera(
        width=size[0],
        height=size[1],
        fx=focal,
        fy=focal,
        cx=size[0] / 2,
        cy=size[1] / 2,
        world_from_camera=tuple(tuple(float(v) for v in row) for row in pose),
    )


def shape(name: str) -> trimesh.Trimesh:
    """Return the object, 6 to 12 cm large, standing on the origin."""
    if name == "ball":
        mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    elif name == "box":
        mesh = trimesh.creation.box((0.09, 0.05, 0.08))
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.35, (0, 0, 1)))
    elif name == "jug":
        profile = np.array([[0, 0], [0.028, 0], [0.036, 0.03], [0.03, 0.06], [0.018, 0.085], [0.022, 0.1], [0, 0.1]])
        mesh = trimesh.creation.revolve(profile, sections=64)
    else:
        bpy.ops.mesh.primitive_monkey_add(size=0.09)
        item = bpy.context.object
        item.data.calc_loop_triangles()
        vertices = np.array([v.co for v in item.data.vertices])
        faces = np.array([t.vertices for t in item.data.loop_triangles])
        bpy.data.objects.remove(item)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.3, (0, 0, 1)))
    mesh.apply_translation((0, 0, -mesh.bounds[0, 2]))
    return mesh


def photograph(case: Case, path: Path, size: tuple[int, int] = (480, 360), samples: int = 48) -> tuple[float, ...]:
    """Write the photo of ``case`` as PNG; return a loose box around its object in pixels."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    compat.enable_cycles()
    mesh = shape(case.shape)
    scene = bpy.data.scenes.new("truth")
    render_engines.set_up_passes(scene)
    render_engines.set_up_cycles(scene, RenderOptions(samples=samples, seed=3), denoise=True)
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces = 6, 6
    scene.render.use_persistent_data = False
    view = camera(case, size)
    bridge_camera.add_camera(scene, view, size)
    # As a camera exposes: white ground in the light would just be white.
    sky = 1.0 / (1.0 + case.strength)
    scene.world = bpy.data.worlds.new("sky")
    tree = compat.node_tree(scene.world)
    shader, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    shader.inputs["Color"].default_value, shader.inputs["Strength"].default_value = (1, 1, 1, 1), sky
    tree.links.new(shader.outputs[0], output.inputs[0])
    if case.strength > 0:
        towards = direction(case.azimuth, case.elevation)
        sun = bpy.data.lights.new("sun", "SUN")
        sun.energy = sky * math.pi * case.strength / towards[2]
        sun.angle = math.radians(case.angle)
        lamp = bpy.data.objects.new("sun", sun)
        lamp.rotation_euler = Vector(towards.tolist()).to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(lamp)
    floor = add_ground(scene, Ground(), view)
    floor.visible_diffuse = True
    floor.data.materials[0] = _floor(case.ground)
    data = bpy.data.meshes.new("object")
    data.from_pydata(mesh.vertices.tolist(), [], mesh.faces.tolist())
    if case.shape != "box":
        data.shade_smooth()
    data.materials.append(_paint((0.5, 0.13, 0.06) if case.shape != "box" else (0.06, 0.13, 0.42)))
    scene.collection.objects.link(bpy.data.objects.new("object", data))
    scene.render.film_transparent = False
    with tempfile.TemporaryDirectory() as scratch:
        picture = render_engines.stack(
            render_engines.render_passes(scene, 1, Box(0, 0, *size), Path(scratch)), "Combined"
        )
    Image.fromarray(linear_to_bytes(picture)).save(path)
    pixels = view.project(mesh.vertices)[:, :2]
    low, high = pixels.min(axis=0) - 7, pixels.max(axis=0) + 7
    return (*(float(v) for v in low), *(float(v) for v in high))


def _paint(colour: tuple[float, float, float]) -> bpy.types.Material:
    material = bpy.data.materials.new("paint")
    tree = compat.node_tree(material)
    shader, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Color"].default_value = (*colour, 1)
    tree.links.new(shader.outputs[0], output.inputs[0])
    return material


def _floor(kind: str) -> bpy.types.Material:
    material = bpy.data.materials.new("floor")
    tree = compat.node_tree(material)
    place = tree.nodes.new("ShaderNodeNewGeometry").outputs["Position"]
    shader, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs[0], output.inputs[0])
    if kind == "plain":
        shader.inputs["Color"].default_value = (0.6, 0.55, 0.5, 1)
        return material
    if kind == "tiles":
        texture = tree.nodes.new("ShaderNodeTexChecker")
        texture.inputs["Scale"].default_value = 28.0
        value = texture.outputs[1]
        dark, bright = (0.42, 0.4, 0.36, 1), (0.62, 0.6, 0.56, 1)
    else:
        texture = tree.nodes.new("ShaderNodeTexNoise")
        texture.inputs["Scale"].default_value = 60.0
        value = texture.outputs[0]
        dark, bright = ((0.3, 0.2, 0.12, 1), (0.75, 0.66, 0.5, 1))
    if kind == "planks":
        stretch = tree.nodes.new("ShaderNodeVectorMath")
        stretch.operation = "MULTIPLY"
        stretch.inputs[1].default_value = (0.12, 1.6, 1.0)
        tree.links.new(place, stretch.inputs[0])
        place = stretch.outputs[0]
    tree.links.new(place, texture.inputs["Vector"])
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = dark, bright
    tree.links.new(value, ramp.inputs[0])
    tree.links.new(ramp.outputs[0], shader.inputs["Color"])
    return material


def judge(case: Case, light: Light) -> dict[str, object]:
    """Return the errors ``direction_deg`` and ``ratio_share`` (estimate over truth, minus 1), and ``angle_deg``."""
    found: dict[str, object] = {"direction_deg": None, "ratio_share": None, "angle_deg": None}
    if light.sun_direction is not None:
        found["angle_deg"] = math.degrees(light.sun_angle)
        if case.strength > 0:
            cosine = float(np.asarray(light.sun_direction) @ direction(case.azimuth, case.elevation))
            found["direction_deg"] = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
            found["ratio_share"] = light.sun_strength / case.strength - 1.0
    if case.strength == 0:
        found["good"] = light.sun_direction is None
    else:
        found["good"] = (
            light.sun_direction is not None
            and float(found["direction_deg"]) <= WANTED_DEG
            and abs(float(found["ratio_share"])) <= WANTED_SHARE
        )
    return found


def measure(case: Case, root: Path, size: tuple[int, int], samples: int) -> dict[str, object]:
    """Render ``case`` unless ``root`` has the photo, reconstruct it, return the errors."""
    root.mkdir(parents=True, exist_ok=True)
    photo, box_file = root / "photo.png", root / "box.json"
    if not (photo.is_file() and box_file.is_file()):
        box_file.write_text(json.dumps(photograph(case, photo, size, samples)))
    box = tuple(json.loads(box_file.read_text()))
    notices: list[str] = []
    started = time.process_time()
    scene = reconstruct(
        photo,
        [ObjectRequest(box=box, name=case.shape)],  # type: ignore[arg-type]
        out=root / "scene",
        options=ReconstructOptions(pitch_deg=case.pitch, fov_deg=FOV_DEG, mesh_vertices=4000),
        on_event=lambda event: notices.append(str(event.get("message", ""))) if event["event"] == "notice" else None,
    )
    seconds = time.process_time() - started
    light = scene.model.light
    row = {**asdict(case), **judge(case, light), "light": asdict(light)}
    return row | {"notices": notices, "cpu_s": round(seconds, 2)}


def _line(number: int, row: dict[str, object]) -> str:
    def text(key: str, form: str) -> str:
        value = row[key]
        return "-" if value is None else format(float(value), form)  # type: ignore[arg-type]

    return (
        f"{number:3} {row['shape']:>7} {row['ground']:>7} {row['azimuth']:5.0f} {row['elevation']:5.0f} "
        f"{row['strength']:6.1f} {row['angle']:6.0f} | {text('direction_deg', '.1f'):>6} "
        f"{text('ratio_share', '+.0%'):>7} {text('angle_deg', '.1f'):>7}  {'good' if row['good'] else 'BAD'}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0, or the exit code of the error."""
    parser = benchmark_parser("light", __doc__, cases="1", size=160, samples=4)
    parser.add_argument("--cases", help="numbers from 1, comma-separated (default: all)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep photos and scenes")
    parser.add_argument("--size", type=int, default=480, help="width of the photos in pixels (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=48, help="samples per pixel (default: %(default)s)")
    options = parser.parse_args(arguments)
    chosen = [int(n) for n in options.cases.split(",")] if options.cases else range(1, len(CASES) + 1)
    rows = {}
    try:
        with blender_output_to_stderr(), tempfile.TemporaryDirectory(prefix="physgen-light-") as scratch:
            root = options.keep or Path(scratch)
            for number in chosen:
                size = (options.size, options.size * 3 // 4)
                rows[number] = measure(CASES[number - 1], root / f"{number:02}", size, options.samples)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    with contextlib.suppress(BrokenPipeError):
        if options.json:
            print(json.dumps({"cases": rows, "good": sum(bool(r["good"]) for r in rows.values()), "of": len(rows)}))
        else:
            print("  #   shape  ground  azim  elev  ratio  angle |  error   ratio   angle")
            print("\n".join(_line(number, row) for number, row in rows.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
