# SPDX-License-Identifier: MIT
"""The loaders of ``physgen evaluate``: videos, folders of pictures, a bake with its energies, a benchmark's folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from physgen.sim.cache.bake_folder import BakedObject, BakeManifest, load_bake, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.errors import InputError
from physgen.sim.evaluate.against import against
from physgen.sim.evaluate.bake_physics import bake_physics
from physgen.sim.evaluate.footage import open_footage
from physgen.sim.evaluate.physics_iq_folder import read_benchmark, read_submission
from physgen.sim.version import VERSION

RANDOM = np.random.default_rng(0)
PIXELS = RANDOM.integers(0, 255, (4, 24, 32, 3), dtype=np.uint8)
GENERATED = "0001_perspective-left_trimmed-ball.mp4"


def _video(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 8, (32, 24))
    for frame in PIXELS:
        out.write(frame)
    out.release()


def _read_video(folder: Path) -> None:
    footage = open_footage(folder / "v.mp4")
    against(footage, [footage], 6)


def _pictures(folder: Path) -> None:
    (folder / "f").mkdir(exist_ok=True)
    for i, frame in enumerate(PIXELS, 1):
        cv2.imwrite(str(folder / "f" / f"{i:04d}.png"), frame)


def _read_pictures(folder: Path) -> None:
    for _ in open_footage(folder / "f").frames(8):
        pass


def _bake(folder: Path) -> None:
    with Pc2Writer(folder / "box.pc2", vertex_count=8) as cache:
        for _ in range(3):
            cache.append(RANDOM.random((8, 3)))
    manifest = BakeManifest(
        inputs_hash="0" * 64,
        fps=24.0,
        frame_start=1,
        frames=3,
        frames_done=3,
        state="complete",
        engine="mpm",
        version=VERSION,
        particles=8,
        objects=(BakedObject(name="box", file="box.pc2", vertices=8),),
    )
    save_manifest(folder, manifest)
    frames = [{"kinetic_j": 1.0, "elastic_j": 0.5, "potential_j": 2.0, "frame": i} for i in range(3)]
    (folder / "metrics.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")


def _read_bake(folder: Path) -> None:
    bake_physics(load_bake(folder), None, cancelled=lambda: False)


def _submission(folder: Path) -> None:
    _video(folder / GENERATED)


def _read_submission(folder: Path) -> None:
    read_submission(folder)
    # No benchmark lies there.
    try:
        read_benchmark(folder, 8.0)
    except InputError as error:
        assert "split-videos" in str(error)


EVALUATE: dict[str, tuple[tuple[str, ...], Callable[[Path], object], Callable[[Path], object]]] = {
    "video to evaluate": (("v.mp4",), lambda f: _video(f / "v.mp4"), _read_video),
    "pictures to evaluate": (("f/0001.png", "f/0003.png"), _pictures, _read_pictures),
    "energies of a bake": (("metrics.json", "manifest.json"), _bake, _read_bake),
    "videos for Physics-IQ": ((GENERATED,), _submission, _read_submission),
}
"""By name: files to damage, what writes them into a folder, what reads them there."""
