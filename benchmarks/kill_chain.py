# SPDX-License-Identifier: GPL-3.0-or-later
"""The chain of commands that ``kills`` stops, and their small inputs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import trimesh
from physgen.sim.evaluate.judge_question import CRITERIA
from physgen.sim.gaussians.views.posed_images import View, orbit_camera
from physgen.sim.gaussians.views.view_files import save_views
from physgen.sim.scene.folder import save_scene
from physgen.sim.scene.model import Camera, SceneModel, SceneObject
from PIL import Image

LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=LOOKING_AWAY)
JOBS = """format = "physgen-jobs/1"
name = "job"
[[scenes]]
name = "ball"
scene = "scene"
[defaults.bake]
frames = 2
quality = "preview"
[defaults.render]
frames = "1"
samples = 1
video = []
[matrix]
presets = ["hard"]
"""

PHYSGEN = """gravity: 980
init_velocity: {1: [0, -100]}
obj_info: {1: {label: ball, mass: 100, friction: 0.5, elasticity: 0.8, primitive: circle}}
edge_list: [[[0, 70], [96, 70]]]
"""


@dataclasses.dataclass(frozen=True)
class Step:
    """A command. line: its words; after: the step before it; share: of the kills, less where it takes long."""

    name: str
    line: str
    after: str = ""
    share: float = 1.0


BODY = "--object ball:diameter=0.05"
STEPS = (
    Step("reconstruct", "reconstruct photo.png --box 30,18,66,58 --name ball --no-sun --out scene", share=0.4),
    Step("variant", "variant pair --preset jelly --out windy"),
    Step("light", "light windy --sun-direction 0.5,0.3,1 --sun-strength 2", "variant"),
    Step("correct", "correct scene --size ball=0.3", "reconstruct", 0.4),
    Step("bake", "bake scene --frames 3 --quality preview --out bake", "reconstruct"),
    Step("pack", "pack bake --out packed", "bake"),
    Step("unpack", "pack packed --unpack --out unpacked", "pack"),
    Step("evaluate", "evaluate bake --scene scene --out evaluated", "bake"),
    Step("render", "render scene --bake bake --frames 1-2 --samples 1 --out frames --video clip.mp4", "bake"),
    Step("encode", "encode frames --out sheet.webp", "render"),
    Step("propose", "propose photo.png --segmenter none --out proposed"),
    Step("capture", "capture import table.csv --diameter 0.1 --mass 0.1 --out captured"),
    Step("diagnose", "diagnose captured --budget 10s --no-confirm --effects wind --out diagnosis", "capture"),
    Step("track", f"track toss.avi {BODY} --out tracked"),
    Step("explain", f"explain toss.avi {BODY} --budget 10s --effects wind --out explained"),
    Step("fit-splats", "fit-splats views --splats 1000 --steps 12 --out fitted_views", share=0.3),
    Step("import", "import fitted_views/splats/object.ply --size 0.3 --up z --out imported", "fit-splats"),
    Step("import-physgen", "import physgen --out imported_physgen", share=0.4),
    Step("export", "export scene --bake bake --usd moving.usda", "bake"),
    Step("compose", "compose pair --no-picture --steps 1 --substeps 1 --cells 8 --out fitted", share=0.3),
    Step("questionnaire", "questionnaire case --out asked"),
    Step("collect", "questionnaire answers.json --collect --key key.json --out results"),
    Step("batch", "batch jobs.toml --workers 2", "reconstruct", 0.3),
)


def draw_inputs(folder: Path) -> None:
    """Write photo, table, video, scene of two balls that touch, case, answers and job into ``folder``."""
    rng = np.random.default_rng(2)
    image = np.full((72, 96, 3), (190.0, 175, 140)) + rng.normal(scale=4, size=(72, 96, 1))
    rows, columns = np.mgrid[:72, :96] + 0.5
    image[(columns - 48) ** 2 + (rows - 38) ** 2 < 15**2] = (200, 50, 40)
    Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / "photo.png")
    (folder / "pair" / "meshes").mkdir(parents=True)
    items = []
    for number, name in enumerate("ab"):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
        mesh.apply_translation((0.09 * number, 0, 0.05))
        mesh.export(folder / "pair" / "meshes" / f"{name}.ply")
        items.append(SceneObject(name=name, mesh=f"meshes/{name}.ply", size_m=0.1, occlusion_order=2 - number))
    save_scene(folder / "pair", SceneModel(camera=CAMERA, objects=tuple(items), photo=None, background=None))
    times = np.arange(24) / 60
    lines = [f"{t:.4f},{1.1 * t:.5f},0,{2 + 1.5 * t - 4.905 * t * t:.5f}" for t in times]
    (folder / "table.csv").write_text("\n".join(["t,x,y,z", *lines]) + "\n")
    wall = cv2.GaussianBlur(rng.integers(90, 200, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
    video = cv2.VideoWriter(str(folder / "toss.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 60.0, (160, 120))
    for t in np.arange(30) / 60:
        frame, place = wall.copy(), (30 + 220 * t, 95 - 200 * (2.4 * t - 4.905 * t * t))
        cv2.circle(frame, tuple(int(16 * v) for v in place), 5 * 16, (30, 30, 210), -1, cv2.LINE_AA, 4)
        video.write(np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8))
    video.release()
    (folder / "case").mkdir()
    Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(folder / "case" / "photo.jpg")
    for name in ("ours", "other"):
        writer = cv2.VideoWriter(str(folder / "case" / f"{name}.webm"), cv2.VideoWriter_fourcc(*"VP80"), 8, (80, 60))
        for level in range(4):
            writer.write(np.full((60, 80, 3), 40 * level, np.uint8))
        writer.release()
    videos = "\n".join(f'{name} = "{name}.webm"' for name in ("ours", "other"))
    (folder / "case" / "case.toml").write_text(f'prompt = "It falls."\nimage = "photo.jpg"\n[videos]\n{videos}\n')
    scores = {token: dict.fromkeys(CRITERIA, 3) for token in ("aa", "bb")}
    sheet = {"format": "physgen questionnaire answers", "version": 1, "questionnaire": "0", "person": "ann"}
    sheet |= {"saved": "2026-01-01T00:00:00Z", "cases": {"case_01": {"order": ["bb", "aa"], "scores": scores}}}
    (folder / "answers.json").write_text(json.dumps(sheet))
    case = {"id": "case_01", "name": "a", "prompt": "It falls.", "videos": {"aa": "ours", "bb": "other"}}
    key = {"format": "physgen questionnaire", "version": 1, "questionnaire": "0", "criteria": list(CRITERIA)}
    (folder / "key.json").write_text(json.dumps({**key, "cases": [case]}))
    (folder / "jobs.toml").write_text(JOBS)
    draw_views(folder / "views")
    (folder / "physgen").mkdir()
    Image.open(folder / "photo.png").save(folder / "physgen" / "original.png")
    mask = (columns - 48) ** 2 + (rows - 38) ** 2 < 15**2
    Image.fromarray(mask.astype(np.uint8)).save(folder / "physgen" / "mask.png")
    (folder / "physgen" / "sim.yaml").write_text(PHYSGEN)


def draw_views(folder: Path) -> None:
    """Write what six cameras around a red ball see as the views folder ``folder``."""
    side, radius, distance, focal = 32, 0.4, 2.5, 1.2
    across = focal * side * radius / np.sqrt(distance**2 - radius**2)
    rows, columns = np.mgrid[:side, :side] + 0.5 - side / 2
    mask = (rows**2 + columns**2 < across**2).astype(np.float32)
    pixels = mask[..., None] * np.float32([0.8, 0.2, 0.1]) + 1 - mask[..., None]
    views = []
    for index in range(6):
        camera = orbit_camera(60.0 * index, (35.0, -20.0, 5.0)[index % 3], distance, side=side, focal=focal)
        views.append(View(name=f"v{index}", camera=camera, pixels=pixels, mask=mask))
    save_views(folder, views)


def with_needed(steps: tuple[Step, ...]) -> list[Step]:
    """Return ``steps`` and those that make what they read, in the order of the chain."""
    wanted = {step.name for step in steps}
    for step in reversed(STEPS):
        if step.name in wanted and step.after:
            wanted.add(step.after)
    return [step for step in STEPS if step.name in wanted]
