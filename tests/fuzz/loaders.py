# SPDX-License-Identifier: MIT
"""What a loader is, and what those of all kinds of files share; every ``loaders_*.py`` adds its own to ``LOADERS``.

A loader writes its files into an empty folder and reads them; one file at a time is then damaged. The files are made
here, by the project's own writers where it has them, so that none lies in the repository.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.checksums import span_for
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.model import Camera, Effect, SceneModel, SceneObject
from physgen.sim.version import VERSION
from PIL import Image

RANDOM = np.random.default_rng(0)
BOX = trimesh.creation.box((0.1, 0.06, 0.04))
PIXELS = RANDOM.integers(0, 255, (48, 64, 3), dtype=np.uint8)
MASK = np.zeros((48, 64), np.uint8)
MASK[10:30, 20:50] = 255
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
SAMPLES = 3


@dataclasses.dataclass(frozen=True)
class Loader:
    """write: puts the files into a folder. read: reads them there, raising PhysGenError alone. files: to damage. share:
    of the inputs that others get: what starts a process for each takes a hundred times as long."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    files: tuple[str, ...]
    share: float = 1.0


LOADERS: dict[str, Loader] = {}


def add(
    name: str,
    files: str | tuple[str, ...],
    write: Callable[[Path], object],
    read: Callable[[Path], object],
    share: float = 1.0,
) -> None:
    """Add a loader."""
    LOADERS[name] = Loader(write, read, (files,) if isinstance(files, str) else files, share)


def put_json(path: Path, value: object) -> None:
    """Write ``value`` as JSON."""
    path.write_text(json.dumps(value), encoding="utf-8")


def put_picture(path: Path, pixels: Any = PIXELS, **options: Any) -> None:
    """Write ``pixels`` in the format of the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)


def put_video(path: Path, frames: Any, *, codec: str = "mp4v", fps: float = 24.0) -> None:
    """Write ``frames``, each (H, W, 3), as a video."""
    path.parent.mkdir(parents=True, exist_ok=True)
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, frames[0].shape[1::-1])
    for frame in frames:
        out.write(frame)
    out.release()


def put_scene(folder: Path) -> Scene:
    """Write the scene of a box in a wind; return it."""
    (folder / "meshes").mkdir(exist_ok=True)
    BOX.export(folder / "meshes" / "box.glb")
    put_picture(folder / "photo.png")
    put_picture(folder / "masks" / "box.png", MASK)
    item = SceneObject(
        name="box", mesh="meshes/box.glb", size_m=0.1, material=load_preset("soft"), mask="masks/box.png"
    )
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, world_from_camera=POSE)
    wind = Effect(name="wind", parameters=(("wind_x", 2.0), ("wind_y", 0.0), ("wind_z", 0.0), ("drag_per_mass", 0.5)))
    model = SceneModel(photo="photo.png", background="photo.png", camera=camera, objects=(item,), effects=(wind,))
    return save_scene(folder, model)


def put_bake(folder: Path, **changes: Any) -> BakeManifest:
    """Write the complete bake of a box, with checksums; return its manifest. changes: of its object."""
    with Pc2Writer(folder / "box.pc2", vertex_count=8, start_frame=1, span=span_for(SAMPLES)) as cache:
        for _ in range(SAMPLES):
            cache.append(RANDOM.random((8, 3)))
        checksum = cache.checksum("box.pc2", ended=True)
    manifest = BakeManifest(
        inputs_hash="0" * 64,
        fps=24.0,
        frame_start=1,
        frames=SAMPLES,
        frames_done=SAMPLES,
        state="complete",
        engine="mpm",
        version=VERSION,
        particles=100,
        objects=(dataclasses.replace(BakedObject(name="box", file="box.pc2", vertices=8), **changes),),
        checksums=(checksum,),
    )
    save_manifest(folder, manifest)
    return manifest


def text_of(path: Path) -> bytes:
    """Return what comes through a pipe or a command line, so that no file is opened."""
    return path.read_bytes() if path.is_file() and path.stat().st_size < 2**22 else b""
