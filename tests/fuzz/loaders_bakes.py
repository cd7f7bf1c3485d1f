# SPDX-License-Identifier: MIT
"""Bakes, packed bakes, torn skins, checkpoints, frames."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from loaders import BOX, PIXELS, RANDOM, add, put_bake, put_json, put_scene
from physgen.physgen_addon.frames.frame_files import Part, read_layers, read_picture, write_exr, write_png
from physgen.physgen_addon.frames.frame_index import FrameIndex, gather_frames
from physgen.physgen_addon.playback.bake_record import read_record
from physgen.sim.app import bake_resume
from physgen.sim.app.bake_resume import find_mendable
from physgen.sim.app.bake_samples import Tears
from physgen.sim.app.pack_bake import pack_bake, unpack_bake
from physgen.sim.cache.bake_check import check_bake
from physgen.sim.cache.bake_folder import (
    MATTER_FILES,
    BakedObject,
    disk_usage,
    listed_files,
    load_bake,
)
from physgen.sim.cache.packed_cache import PackedCache
from physgen.sim.cache.pc2 import Pc2Reader
from physgen.sim.cache.torn_skin_file import TornSkin, read_torn_skin, write_torn_skin
from physgen.sim.reconstruct import stage_cache
from physgen.sim.reconstruct.stage_cache import StageCache
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import ObjectMesh
from physgen.sim.scene.scene_output import SUMS_FILE, check_scene, write_scene_sums


def _splat_bake(folder: Path) -> None:
    put_bake(folder, splats_file="box.splats.pc2", splats_folder="s", splats=2)


def _read_bake(folder: Path) -> None:
    bake = load_bake(folder)
    listed_files(bake.manifest)
    disk_usage(folder)
    assert repr(bake)


def _read_cache(folder: Path) -> None:
    cache = Pc2Reader(folder / "box.pc2")
    for index in range(min(cache.sample_count, 4)):
        cache.sample(index)


def _checkpoint(folder: Path) -> None:
    put_bake(folder)
    (folder / "checkpoints").mkdir(exist_ok=True)
    state = {"times": np.zeros(2), "positions": RANDOM.random((5, 3)), "flags": np.ones(5, bool)}
    found = bake_resume.Checkpoint(frames_done=2, metrics=[{"frame": 1}, {"frame": 2}], state=state)
    bake_resume.save_checkpoint(folder, "0" * 64, found)


class _World:
    """Takes any state; what an engine does with it is not a file's affair."""

    def checkpoint(self) -> dict[str, Any]:
        return {}

    def restore(self, state: Any) -> None:
        return None


def _read_checkpoint(folder: Path) -> None:
    item = BakedObject(name="box", file="box.pc2", vertices=8)
    manifest = dataclasses.replace(load_bake(folder).manifest, objects=(item,))
    bake_resume.resume(folder, manifest, _World())


def _stages(folder: Path) -> None:
    made = {"x": np.arange(5.0), "s": np.array("box")}
    StageCache(folder, folder / "none", lambda said: None).run("fit", {"a": 1}, lambda notice: made)
    next(folder.glob("fit-*.npz")).rename(folder / "s.npz")


def _frames(folder: Path) -> None:
    index = FrameIndex(folder, fps=24.0)
    for number in (1, 2):
        write_png(index.path(number), PIXELS)
        index.record(number, "0" * 64)


def _read_frames(folder: Path) -> None:
    index = FrameIndex(folder)
    index.is_complete(1, "0" * 64)
    index.find("0" * 64)
    index.has_video(folder / "none.mp4", [folder / "0001.png"], 24.0)
    gather_frames([folder])


def _exr(folder: Path) -> None:
    light = RANDOM.random((12, 16, 3)).astype(np.float32)
    parts = [
        Part(name="beauty", channels=("R", "G", "B"), pixels=light),
        Part(name="depth", channels=("depth.Z",), pixels=light[..., :1], bits=32),
    ]
    write_exr(folder / "f.exr", parts, fps=24.0)


def _blender_record(folder: Path) -> None:
    (folder / "b").mkdir(exist_ok=True)
    looks = [{"name": "box", "shape": "mesh", "from_frame": 1, "spacing": 0.1}]
    put_json(
        folder / "b.json",
        {
            "format": "physgen-blender-bake/1",
            "fingerprints": ["x"],
            "frame_start": 1,
            "looks": looks,
            "files": ["a.blend"],
        },
    )


add("bake manifest", "manifest.json", _splat_bake, _read_bake)
add("point cache", "box.pc2", put_bake, _read_cache)
add("checkpoint", "checkpoints/state.npz", _checkpoint, _read_checkpoint)
add("stage cache", "s.npz", _stages, lambda f: stage_cache._read(f / "s.npz"))
add("frame index", "frames.json", _frames, _read_frames)
add("frame PNG", "0001.png", _frames, lambda f: read_picture(f / "0001.png"))
add("frame EXR", "f.exr", _exr, lambda f: read_layers(f / "f.exr"))
add("Blender's record of a bake", "b.json", _blender_record, lambda f: read_record(f / "b"))


# Checked, mended, packed and torn bakes


def _check(folder: Path) -> None:
    bake = load_bake(folder)
    check_bake(bake)
    plain = dataclasses.replace(bake.manifest, checksums=(), state="running", frames_done=0)
    find_mendable(folder, plain)


def _packed(folder: Path) -> None:
    (folder / "whole").mkdir(exist_ok=True)
    put_bake(folder / "whole")
    pack_bake(load_bake(folder / "whole"), out=folder / "packed")


def _unpack(folder: Path) -> None:
    shutil.rmtree(folder / "whole")
    unpack_bake(folder / "packed", out=folder / "again")


def _read_packed(folder: Path) -> None:
    for _ in PackedCache(folder / "packed" / "box.pc2.packed").samples():
        pass


def _torn(folder: Path) -> None:
    walls = np.zeros(12, bool)
    walls[-2:] = True
    skin = TornSkin(
        faces=np.asarray(BOX.faces, np.int32),
        inside=walls,
        source=np.arange(12, dtype=np.int32),
        corners=np.tile(np.eye(3, dtype=np.float32), (12, 1, 1)),
        parents=np.tile(np.arange(8, dtype=np.int32)[:, None], (1, 3)),
        weights=np.full((8, 3), 1 / 3, np.float32),
        first=1,
    )
    write_torn_skin(folder / "box.torn.npz", skin)


def _summed(folder: Path) -> None:
    put_scene(folder)
    write_scene_sums(folder)


class _Body:
    """What ``Tears`` asks of a simulation: a body of eight particles that parts in pieces."""

    def __init__(self) -> None:
        self.world, self.bodies = self, [self]
        self.rigid, self.materials, self.material = False, (), None
        self.positions, self.volumes = np.asarray(BOX.vertices), np.full(8, 1e-5)


def _matter(folder: Path) -> None:
    (folder / "checkpoints").mkdir(exist_ok=True)
    np.save(folder / MATTER_FILES.format(name="box", sample=1), np.zeros((8, 12), "<f4"))


def _read_matter(folder: Path) -> None:
    corners = np.asarray(BOX.vertices)
    mesh = ObjectMesh(vertices=corners, faces=np.asarray(BOX.faces), in_file=corners)
    Tears(_Body(), 0, "box", mesh, None)._matter(folder, 1)


add("bake that is checked", ("box.pc2", "manifest.json"), put_bake, _check)
add("packed bake", ("packed/packed.json", "packed/box.pc2.packed"), _packed, _unpack)
add("packed cache", "packed/box.pc2.packed", _packed, _read_packed)
add("torn skin", "box.torn.npz", _torn, lambda f: read_torn_skin(f / "box.torn.npz", 8, 12))
add("particles of a tear", MATTER_FILES.format(name="box", sample=1), _matter, _read_matter)
add("checksums of a scene", SUMS_FILE, _summed, lambda f: check_scene(load_scene(f)))
add("frames that are checked", ("frames.json", "0001.png"), _frames, lambda f: FrameIndex.of(f).check())
