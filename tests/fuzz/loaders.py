# SPDX-License-Identifier: MIT
"""Every loader of the project, with small files that it reads as they are: what the fuzzing starts from.

A loader writes its files into an empty folder and reads them; one file at a time is then damaged. The files are made
here, by the project's own writers where it has them, so that none lies in the repository.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gzip
import io
import json
import sys
import tarfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from physgen.batch import demo
from physgen.batch.farm.planning.job_file import load_job
from physgen.batch.farm.planning.plan import load_plan, save_plan
from physgen.batch.farm.planning.task_graph import make_plan
from physgen.batch.farm.run_task import listed_task
from physgen.batch.farm.task_execution import Record, load_record, record_path, save_record
from physgen.blind_check.fit_records import FORMAT as FIT_RECORD
from physgen.blind_check.fit_records import load_records
from physgen.physgen_addon.frames.frame_files import Part, read_layers, read_picture, write_exr, write_png
from physgen.physgen_addon.frames.frame_index import FrameIndex, gather_frames
from physgen.physgen_addon.playback.bake_record import read_record
from physgen.sim.app import bake_checkpoint, bake_worker, propose
from physgen.sim.app.add_effect import found_effects, with_effects
from physgen.sim.app.bake_options import BakeOptions, inputs_hash
from physgen.sim.app.bake_samples import load_object_splats
from physgen.sim.app.preview_server import parse_request, request_id
from physgen.sim.app.reconstruct import _answered, read_stamp
from physgen.sim.app.scene_variant import _with_effects
from physgen.sim.app.stage_process import parse_event
from physgen.sim.cache.bake_folder import (
    BakedObject,
    BakeManifest,
    disk_usage,
    listed_files,
    load_bake,
    save_manifest,
)
from physgen.sim.cache.pc2 import Pc2Reader, Pc2Writer
from physgen.sim.composite.srgb import read_mask as read_scene_mask
from physgen.sim.composite.srgb import read_rgb
from physgen.sim.diagnose.capture import Camera as CaptureCamera
from physgen.sim.diagnose.capture import (
    Capture,
    CaptureObject,
    Ground,
    ObjectBelief,
    Trial,
    load_capture,
    save_capture,
)
from physgen.sim.diagnose.diagnosis import read_diagnosis
from physgen.sim.diagnose.track.track_videos import Video
from physgen.sim.errors import InputError
from physgen.sim.gaussians.guidance.pretrained_models import read_json as read_model_json
from physgen.sim.gaussians.mesh_to_splats import Texture
from physgen.sim.gaussians.splat_ply import read_splat_file, write_splats
from physgen.sim.gaussians.splats import Splats
from physgen.sim.gaussians.views.view_files import read_views
from physgen.sim.importers.coco_masks import masks_from_json
from physgen.sim.importers.image_masks import masks_from_array_file, masks_from_image
from physgen.sim.importers.physgen import read_physgen
from physgen.sim.importers.physgen3d import read_physgen3d
from physgen.sim.reconstruct import stage_cache
from physgen.sim.reconstruct.adapters.adapter_registry import named_adapters, read_toml
from physgen.sim.reconstruct.camera.depth_map import read_depth
from physgen.sim.reconstruct.models.model_archive import ArchiveReader
from physgen.sim.reconstruct.photo import load_photo
from physgen.sim.reconstruct.reasoning.answer_parser import read_answer
from physgen.sim.reconstruct.reasoning.material_names import load_names
from physgen.sim.reconstruct.segmentation.object_masks import read_mask
from physgen.sim.reconstruct.stage_cache import StageCache
from physgen.sim.scene.camera_path import load_camera_path, save_camera_path, swing
from physgen.sim.scene.environment import read_environment
from physgen.sim.scene.folder import load_scene, save_scene, side_files
from physgen.sim.scene.material import load_preset, read_presets
from physgen.sim.scene.meshes import load_vertex_track, read_mesh
from physgen.sim.scene.model import Camera, Effect, SceneModel, SceneObject
from physgen.sim.scene.overrides import apply_overrides
from physgen.sim.scene.textured_mesh import read_textured_mesh, write_moved_mesh
from physgen.sim.version import VERSION
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))

from loaders_evaluate import EVALUATE

RANDOM = np.random.default_rng(0)
BOX = trimesh.creation.box((0.1, 0.06, 0.04))
PIXELS = RANDOM.integers(0, 255, (48, 64, 3), dtype=np.uint8)
MASK = np.zeros((48, 64), np.uint8)
MASK[10:30, 20:50] = 255
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class Loader:
    """write: puts the files into a folder. read: reads them there, raising PhysGenError alone. files: to damage."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    files: tuple[str, ...]


LOADERS: dict[str, Loader] = {}


def _add(
    name: str, files: str | tuple[str, ...], write: Callable[[Path], object], read: Callable[[Path], object]
) -> None:
    LOADERS[name] = Loader(write, read, (files,) if isinstance(files, str) else files)


def _json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value), encoding="utf-8")


def _save(path: Path, pixels: Any = PIXELS, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)


# Scenes


def _scene(folder: Path) -> Any:
    (folder / "meshes").mkdir(exist_ok=True)
    BOX.export(folder / "meshes" / "box.glb")
    _save(folder / "photo.png")
    _save(folder / "masks" / "box.png", MASK)
    item = SceneObject(
        name="box", mesh="meshes/box.glb", size_m=0.1, material=load_preset("soft"), mask="masks/box.png"
    )
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, world_from_camera=POSE)
    wind = Effect(name="wind", parameters=(("wind_x", 2.0), ("wind_y", 0.0), ("wind_z", 0.0), ("drag_per_mass", 0.5)))
    model = SceneModel(photo="photo.png", background="photo.png", camera=camera, objects=(item,), effects=(wind,))
    return save_scene(folder, model)


def _read_scene(folder: Path) -> None:
    scene = load_scene(folder)
    scene.files()
    inputs_hash(scene, BakeOptions())
    apply_overrides(scene.model, ("box.density=300",))


def _physics(folder: Path) -> None:
    _json(folder / "physics.json", {"answers": {"raw": "1. metal, 3000, hard"}, "objects": []})


def _stamp(folder: Path) -> None:
    scene = {"format": "physgen-scene/1"}
    _json(
        folder / "reconstruct.json",
        {
            "inputs_hash": "0" * 64,
            "photo": "photo.png",
            "objects": [{"name": "cup", "box": [1, 2, 30, 40], "velocity": [0, 0, 1]}],
            "options": {"seed": 3},
            "scene": scene,
        },
    )


def _effects_text(folder: Path) -> None:
    _json(folder / "effects.json", [{"name": "gravity_tilt", "parameters": {"angle": 0.1, "azimuth": 0.0}}])
    _scene(folder)


def _read_effects(folder: Path) -> None:
    text = _text_of(folder / "effects.json").decode("utf-8", "replace")
    _with_effects(load_scene(folder).model, text)


_add("scene", "scene.json", _scene, _read_scene)
_add("scene physics", "physics.json", _physics, _answered)
_add("reconstruct record", "reconstruct.json", _stamp, read_stamp)
_add("effects of a variant", "effects.json", _effects_text, _read_effects)
_add(
    "camera path",
    "path.json",
    lambda f: save_camera_path(f / "path.json", swing(first=1, last=24, azimuth_deg=5.0)),
    lambda f: load_camera_path(f / "path.json"),
)


def _proposals(folder: Path) -> None:
    listed = [{"box": [1, 2, 30, 40], "score": 0.9}]
    record = propose.ProposalRecord(
        photo="photo.png",
        photo_hash="0",
        width=64,
        height=48,
        proposals=(propose.Proposal(box=(1, 2, 30, 40), score=0.9),),
    )
    _json(folder / propose.LIST_FILE, {**propose.to_json(record), "proposals": listed})


_add("proposals", propose.LIST_FILE, _proposals, lambda f: propose._earlier(f, "0", "none"))


# Meshes and splats


def _glb(folder: Path) -> None:
    uv = RANDOM.random((len(BOX.vertices), 2))
    image = Image.fromarray(PIXELS[:8, :8])
    visual = trimesh.visual.TextureVisuals(uv=uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=image))
    trimesh.Trimesh(BOX.vertices, BOX.faces, visual=visual, process=False).export(folder / "box.glb")


def _read_glb(folder: Path) -> None:
    Texture.of(read_textured_mesh(folder / "box.glb"))


def _gltf(folder: Path) -> None:
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(BOX)).items():
        (folder / ("box.gltf" if name.endswith(".gltf") else name)).write_bytes(content)


def _read_gltf(folder: Path) -> None:
    side_files(folder / "box.gltf")
    read_mesh(folder / "box.gltf")


def _obj(folder: Path) -> None:
    faces = "".join(f"f {a}/1 {b}/2 {c}/3\n" for a, b, c in BOX.faces + 1)
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in BOX.vertices)
    (folder / "box.obj").write_text(f"mtllib box.mtl\n{rows}vt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n{faces}")
    (folder / "box.mtl").write_text("newmtl a\nKd 1 0.5 0\nmap_Kd box.png\n")
    _save(folder / "box.png", PIXELS[:8, :8])


def _read_obj(folder: Path) -> None:
    side_files(folder / "box.obj")
    read_mesh(folder / "box.obj")


def _moved(folder: Path) -> None:
    mesh = read_mesh(folder / "box.glb")
    write_moved_mesh(folder / "box.glb", folder / "moved.glb", np.asarray(mesh.vertices) + 1.0, np.asarray(mesh.faces))


def _track(folder: Path) -> None:
    np.savez(folder / "track.npz", times=np.arange(3.0), vertices=np.zeros((3, 8, 3)))


def _splats(count: int = 6) -> Splats:
    turns = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    return Splats(
        centres=RANDOM.random((count, 3)),
        scales=np.full((count, 3), 0.01),
        rotations=turns,
        colours=RANDOM.random((count, 3)),
        opacities=np.full(count, 0.5),
    )


def _ascii_splats(folder: Path) -> None:
    write_splats(folder / "b.ply", _splats())
    head, _, body = (folder / "b.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(6, -1)
    text = "\n".join(" ".join(f"{v:g}" for v in row) for row in rows)
    head = head.replace(b"binary_little_endian", b"ascii")
    (folder / "a.ply").write_bytes(head + b"end_header\n" + text.encode() + b"\n")


def _packed_splats(folder: Path) -> None:
    chunk = [f"property float {side}_{axis}" for side in ("min", "max") for axis in "xyz"]
    chunk += [f"property float {side}_scale_{axis}" for side in ("min", "max") for axis in "xyz"]
    packed = [f"property uint packed_{kind}" for kind in ("position", "rotation", "scale", "color")]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "element chunk 1",
        *chunk,
        "element vertex 5",
        *packed,
        "end_header",
        "",
    ]
    ranges = np.array([0, 0, 0, 1, 1, 1, -5, -5, -5, -4, -4, -4], "<f4")
    body = ranges.tobytes() + RANDOM.integers(0, 2**32, 20, dtype=np.uint32).astype("<u4").tobytes()
    (folder / "p.ply").write_bytes("\n".join(head).encode() + body)


def _splat_object(folder: Path) -> None:
    scene = _scene(folder)
    write_splats(folder / "box.ply", dataclasses.replace(_splats(), centres=np.asarray(BOX.vertices)[:6]))
    item = dataclasses.replace(scene.objects[0], splats="box.ply")
    save_scene(folder, dataclasses.replace(scene.model, objects=(item,)))


def _read_splat_object(folder: Path) -> None:
    from physgen.sim.scene.meshes import load_object_mesh

    scene = load_scene(folder)
    load_object_splats(scene, scene.objects[0], load_object_mesh(scene, scene.objects[0]))


_add("mesh GLB", "box.glb", _glb, _read_glb)
_add("mesh GLB through trimesh", "box.glb", lambda f: BOX.export(f / "box.glb"), lambda f: read_mesh(f / "box.glb"))
_add("mesh glTF", "box.gltf", _gltf, _read_gltf)
_add("mesh OBJ", ("box.obj", "box.mtl", "box.png"), _obj, _read_obj)
_add("mesh PLY", "box.ply", lambda f: BOX.export(f / "box.ply"), lambda f: read_mesh(f / "box.ply"))
_add("mesh STL", "box.stl", lambda f: BOX.export(f / "box.stl"), lambda f: read_mesh(f / "box.stl"))
_add("mesh moved", "box.glb", lambda f: BOX.export(f / "box.glb"), _moved)
_add("vertex track", "track.npz", _track, lambda f: load_vertex_track(f / "track.npz", 8))
_add("splats binary", "b.ply", lambda f: write_splats(f / "b.ply", _splats()), lambda f: read_splat_file(f / "b.ply"))
_add("splats text", "a.ply", _ascii_splats, lambda f: read_splat_file(f / "a.ply"))
_add("splats packed", "p.ply", _packed_splats, lambda f: read_splat_file(f / "p.ply"))
_add("splats of an object", "box.ply", _splat_object, _read_splat_object)


# Bakes and frames


def _bake(folder: Path) -> None:
    with Pc2Writer(folder / "box.pc2", vertex_count=8) as cache:
        for _ in range(3):
            cache.append(RANDOM.random((8, 3)))
    item = BakedObject(
        name="box", file="box.pc2", vertices=8, splats_file="box.splats.pc2", splats_folder="s", splats=2
    )
    manifest = BakeManifest(
        inputs_hash="0" * 64,
        fps=24.0,
        frame_start=1,
        frames=3,
        frames_done=3,
        state="complete",
        engine="mpm",
        version=VERSION,
        particles=100,
        objects=(item,),
    )
    save_manifest(folder, manifest)


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
    _bake(folder)
    (folder / "checkpoints").mkdir(exist_ok=True)
    state = {"times": np.zeros(2), "positions": RANDOM.random((5, 3)), "flags": np.ones(5, bool)}
    found = bake_checkpoint.Checkpoint(frames_done=2, metrics=[{"frame": 1}, {"frame": 2}], state=state)
    bake_checkpoint.save_checkpoint(folder, "0" * 64, found)


class _World:
    """Takes any state; what an engine does with it is not a file's affair."""

    def checkpoint(self) -> dict[str, Any]:
        return {}

    def restore(self, state: Any) -> None:
        return None


def _read_checkpoint(folder: Path) -> None:
    item = BakedObject(name="box", file="box.pc2", vertices=8)
    manifest = dataclasses.replace(load_bake(folder).manifest, objects=(item,))
    bake_checkpoint.resume(folder, manifest, _World())


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
    _json(
        folder / "b.json",
        {
            "format": "physgen-blender-bake/1",
            "fingerprints": ["x"],
            "frame_start": 1,
            "looks": looks,
            "files": ["a.blend"],
        },
    )


_add("bake manifest", "manifest.json", _bake, _read_bake)
_add("point cache", "box.pc2", _bake, _read_cache)
_add("checkpoint", "checkpoints/state.npz", _checkpoint, _read_checkpoint)
_add("stage cache", "s.npz", _stages, lambda f: stage_cache._read(f / "s.npz"))
_add("frame index", "frames.json", _frames, _read_frames)
_add("frame PNG", "0001.png", _frames, lambda f: read_picture(f / "0001.png"))
_add("frame EXR", "f.exr", _exr, lambda f: read_layers(f / "f.exr"))
_add("Blender's record of a bake", "b.json", _blender_record, lambda f: read_record(f / "b"))


# Photos, masks, light, depth, videos


def _environment(path: Path) -> None:
    light = RANDOM.random((16, 32, 3)).astype(np.float32)
    if path.suffix == ".hdr":
        cv2.imwrite(str(path), light)
    else:
        write_exr(path, [Part(name="light", channels=("R", "G", "B"), pixels=light)], fps=24.0)


def _depth(path: Path) -> None:
    depth = 1.0 + RANDOM.random((48, 64)).astype(np.float32)
    if path.suffix == ".npy":
        np.save(path, depth)
    elif path.suffix == ".npz":
        np.savez(path, depth=depth, intrinsics=np.eye(3), mask=np.ones((48, 64), bool))
    elif path.suffix == ".png":
        Image.fromarray((depth * 1000).astype(np.uint16)).save(path)
    elif path.suffix == ".pfm":
        path.write_bytes(b"Pf\n64 48\n-1.0\n" + depth.astype("<f4").tobytes())
    else:
        write_exr(path, [Part(name="depth", channels=("Z",), pixels=depth[..., None], bits=32)], fps=24.0)


def _coco(folder: Path) -> None:
    runs = {"size": [48, 64], "counts": [100, 50, 2922]}
    shapes = [
        {"id": 1, "image_id": 1, "category_id": 1, "segmentation": runs, "score": 0.5},
        {"id": 2, "image_id": 1, "category_id": 1, "segmentation": [[1, 1, 20, 1, 20, 20]]},
        {"id": 3, "image_id": 1, "segmentation": {"size": [48, 64], "counts": [0, 3072]}},
    ]
    image = {"id": 1, "file_name": "photo.png", "width": 64, "height": 48}
    _json(folder / "coco.json", {"images": [image], "annotations": shapes, "categories": [{"id": 1, "name": "cup"}]})


def _video(folder: Path) -> None:
    out = cv2.VideoWriter(str(folder / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 24, (64, 48))
    for _ in range(3):
        out.write(PIXELS)
    out.release()


def _read_video(folder: Path) -> None:
    with Video(folder / "v.avi") as video:
        for _ in video.frames(0, 5):
            pass


for _suffix, _options in ((".jpg", {}), (".png", {}), (".webp", {}), (".tif", {})):
    _add(
        f"photo {_suffix}",
        f"photo{_suffix}",
        lambda f, s=_suffix: _save(f / f"photo{s}"),
        lambda f, s=_suffix: load_photo(f / f"photo{s}", 64),
    )
_add("mask", "m.png", lambda f: _save(f / "m.png", MASK), lambda f: read_mask(f / "m.png", 64, 48))
_add(
    "picture of a scene",
    "p.png",
    lambda f: _save(f / "p.png"),
    lambda f: (read_rgb(f / "p.png"), read_scene_mask(f / "p.png")),
)
_add("masks in a picture", "m.png", lambda f: _save(f / "m.png", MASK // 200), lambda f: masks_from_image(f / "m.png"))
_add("masks NPY", "m.npy", lambda f: np.save(f / "m.npy", MASK[None] > 0), lambda f: masks_from_array_file(f / "m.npy"))
_add(
    "masks NPZ",
    "m.npz",
    lambda f: np.savez_compressed(f / "m.npz", masks=MASK[None] > 0),
    lambda f: masks_from_array_file(f / "m.npz"),
)
_add("masks COCO", "coco.json", _coco, lambda f: masks_from_json(f / "coco.json", 64, 48, "photo.png"))
for _suffix in (".exr", ".hdr"):
    _add(
        f"environment {_suffix}",
        f"e{_suffix}",
        lambda f, s=_suffix: _environment(f / f"e{s}"),
        lambda f, s=_suffix: read_environment(f / f"e{s}"),
    )
for _suffix in (".npy", ".npz", ".png", ".pfm", ".exr"):
    _add(
        f"depth {_suffix}",
        f"d{_suffix}",
        lambda f, s=_suffix: _depth(f / f"d{s}"),
        lambda f, s=_suffix: read_depth(f / f"d{s}", 64, 48),
    )
_add("video", "v.avi", _video, _read_video)


def _views(folder: Path) -> None:
    pose = np.eye(4)
    frames = [{"file_path": f"images/{i}", "transform_matrix": pose.tolist()} for i in range(2)]
    for i in range(2):
        _save(folder / "images" / f"{i}.png", np.dstack([PIXELS, MASK]))
        _save(folder / "labels" / f"{i}.png", MASK // 200)
    _json(folder / "transforms.json", {"camera_angle_x": 0.8, "w": 64, "h": 48, "frames": frames})


def _physgen(folder: Path) -> None:
    _save(folder / "original.png")
    _save(folder / "mask.png", MASK // 255)
    lines = [
        "gravity: 980",
        "init_velocity:",
        "  1: [98, -196.2]",
        "obj_info:",
        "  1:",
        "    label: ball",
        "    mass: 100",
    ]
    lines += ["    friction: 0.5", "    elasticity: 0.8", "    primitive: circle", "edge_list: [[[0, 40], [64, 40]]]"]
    (folder / "sim.yaml").write_text("\n".join(lines))


def _physgen3d(folder: Path) -> None:
    _save(folder / "raw_image.jpg")
    (folder / "meshes").mkdir(exist_ok=True)
    (folder / "mask").mkdir(exist_ok=True)
    BOX.export(folder / "meshes" / "box1.obj")
    _json(folder / "mask" / "mask.json", [{"value": 0, "label": "background"}, {"value": 1, "label": "box"}])
    content = {
        "object_names": ["box1"],
        "plane_model": [0.0, 0.8, 0.6, -0.5],
        "fov": [-0.4, -0.3, 0.4, 0.3],
        "matrices": [np.diag([0.1, 0.1, 0.1, 1.0]).tolist()],
        "E": [1e5],
        "density": [300.0],
    }
    _json(folder / "transform.json", content)


_add("views", ("transforms.json", "images/0.png", "labels/1.png"), _views, read_views)
_add("PhysGen folder", ("sim.yaml", "mask.png"), _physgen, read_physgen)
_add("PhysGen3D folder", ("transform.json", "mask/mask.json"), _physgen3d, read_physgen3d)


# Captures and diagnoses


def _capture(folder: Path, *, pixels: bool = False) -> None:
    times = 0.1 + 0.01 * np.arange(12)
    rest = np.asarray(BOX.vertices) * 0.9
    points = np.stack([0.5 * times, 0 * times, 1 + 2 * times], axis=1)[:, None] + rest
    trial = Trial(
        name="t",
        role="fit",
        times=times,
        points=None if pixels else points,
        pixels=points[..., :2] if pixels else None,
        object_index=np.zeros(8, np.int64),
        rest_points=rest,
    )
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=400.0, stiffness="hard")
    item = CaptureObject(belief=belief, vertices=np.asarray(BOX.vertices), faces=np.asarray(BOX.faces))
    camera = CaptureCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, world_from_camera=POSE)
    made = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=0.4, restitution=0.3),
        objects=(item,),
        noise_sigma=0.0005,
        camera=camera if pixels else None,
        trials=(trial,),
    )
    save_capture(made, folder / "c")


WIND = {
    name: {"value": value}
    for name, value in (("wind_x", 2.0), ("wind_y", 0.0), ("wind_z", 0.0), ("drag_per_mass", 0.5))
}


def _diagnosis(folder: Path) -> None:
    effect = {
        "name": "wind",
        "kind": "force",
        "probability": 0.9,
        "parameters": WIND,
    }
    report = {
        "format": "physgen-diagnosis/1",
        "verdict": {"effect": "wind", "probability": 0.9, "alternatives": [], "effects": ["wind"]},
        "effects": [effect],
        "gap": {},
        "where": {},
    }
    _json(folder / "report.json", report)
    for name in ("where", "prediction"):
        np.savez(folder / f"{name}.npz", **{"t.times": np.arange(4.0), "t.found": np.zeros((4, 8, 3))})
    (folder / "scene").mkdir(exist_ok=True)
    _scene(folder / "scene")


def _read_diagnosis(folder: Path) -> None:
    report, _, _ = read_diagnosis(folder)
    with_effects(load_scene(folder / "scene").model, found_effects(report))


_add("capture", ("c/capture.json", "c/t.npz", "c/body.obj"), _capture, lambda f: load_capture(f / "c"))
_add(
    "capture of pixels",
    ("c/capture.json", "c/t.npz"),
    lambda f: _capture(f, pixels=True),
    lambda f: load_capture(f / "c"),
)
_add("diagnosis", ("report.json", "where.npz"), _diagnosis, _read_diagnosis)


def _fit_record(folder: Path) -> None:
    fit = {"effects": ["wind"], "log_evidence": 3.0, "heldout_rms_m": 0.01, "misfit": 1.0, "heldout_log_score": [1.0]}
    fit["parameters"] = {"wind": {"wind_x": [2.0, 1.5, 2.5, "m/s"]}}
    nominal = {**fit, "effects": [], "parameters": {}}
    models = {"nominal": nominal, "refitted": nominal, "candidates": [fit], "withheld_rms_m": {"": 0.1, "wind": 0.01}}
    truth = {"effect": "wind", "effects": ["wind"], "parameters": {}}
    sizes = {"floor_rms_m": 0.001, "grain_rms_m": 0.001}
    _json(folder / "case-0000.json", {"format": FIT_RECORD, "matter": "rigid", "truth": truth, **models, **sizes})


_add("fit record", "case-0000.json", _fit_record, load_records)


# Jobs, plans, records


def _job(folder: Path) -> None:
    lines = ['format = "physgen-jobs/1"', 'name = "job"', "[matrix]", 'presets = ["soft", ["hard"]]', "seeds = [0, 3]"]
    lines += ["velocities = [[0, 0, 1]]", '"cup.density" = [300, 0.5]', "[defaults.bake]", "frames = 12", "fps = 24"]
    lines += ["[[scenes]]", 'name = "cup"', 'photo = "cup.png"', "boxes = [[1, 2, 30, 40]]", 'names = ["cup"]']
    (folder / "jobs.toml").write_text("\n".join(lines))
    (folder / "cup.png").write_bytes(b"any")


def _plan(folder: Path) -> None:
    _job(folder)
    save_plan(make_plan(load_job(folder / "jobs.toml"))).rename(folder / "plan.json")
    plan = json.loads((folder / "plan.json").read_text())
    _json(folder / "plan.json", {**plan, "root": ".", "tasks": plan["tasks"][:3]})


def _record(folder: Path) -> None:
    _plan(folder)
    task = load_plan(folder / "plan.json").tasks[0]
    made = Record(
        task=task.id,
        version=VERSION,
        argv=task.argv,
        inputs=(("a", "0"),),
        produced=(),
        seconds=1.0,
        cpu_seconds=1.0,
        worker="w",
    )
    save_record(task, folder, made)
    record_path(task, folder).rename(folder / "record.json")


def _read_record(folder: Path) -> None:
    task = load_plan(folder / "plan.json").tasks[0]
    record_path(task, folder).parent.mkdir(parents=True, exist_ok=True)
    record_path(task, folder).unlink(missing_ok=True)
    with contextlib.suppress(FileNotFoundError):
        (folder / "record.json").rename(record_path(task, folder))
    load_record(task, folder)


def _worker_job(folder: Path) -> None:
    options = {"frames": 48, "fps": 24.0, "quality": "standard", "arch": "cpu", "seed": 0}
    _json(
        folder / "job.json",
        {
            "format": "physgen-job/1",
            "use_case": "bake",
            "scene": str(folder),
            "out": str(folder / "b"),
            "options": options,
        },
    )


def _run_job(folder: Path) -> None:
    """The job is read; its scene is not there."""
    with contextlib.suppress(InputError):
        bake_worker.run_job(folder / "job.json", lambda event: None, lambda: False)


def _text_of(path: Path) -> bytes:
    """What comes through a pipe or a command line, so that no file is opened."""
    return path.read_bytes() if path.is_file() and path.stat().st_size < 2**22 else b""


_add("job file", "jobs.toml", _job, lambda f: load_job(f / "jobs.toml"))
_add("plan", "plan.json", _plan, lambda f: load_plan(f / "plan.json"))
_add("task record", "record.json", _record, _read_record)
_add(
    "worker's job",
    "job.json",
    _worker_job,
    _run_job,
)
_add(
    "list of tasks",
    "list.txt",
    lambda f: (f / "list.txt").write_text("a/b\nc/d\n"),
    lambda f: listed_task(f / "list.txt", "1"),
)
_add(
    "preview request",
    "r.json",
    lambda f: _json(
        f / "r.json", {"id": 1, "scene": "s", "overrides": ["a.density=3"], "frames": 10, "fps": 24, "particles": 500}
    ),
    lambda f: (request_id(_text_of(f / "r.json")), parse_request(_text_of(f / "r.json"))),
)
_add(
    "event",
    "e.json",
    lambda f: _json(f / "e.json", {"event": "progress", "stage": "bake", "done": 1, "total": 2}),
    lambda f: parse_event(_text_of(f / "e.json")),
)


# Configuration, models, answers


def _archive(folder: Path) -> None:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, content in (("model/a.bin", b"x" * 700), ("model/b.bin", b"y" * 300)):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    (folder / "m.tgz").write_bytes(gzip.compress(packed.getvalue(), mtime=0))


def _read_archive(folder: Path) -> None:
    with ArchiveReader(folder / "m.tgz", 2**20) as reader:
        for _ in reader.members():
            for _ in reader.content():
                pass


def _adapters(folder: Path) -> None:
    (folder / "a.toml").write_text(
        '[segmenter]\nmine = "python:stages.py:segment"\n[depth_estimator]\nother = "command:d.toml"\n'
    )


def _preset(folder: Path) -> None:
    (folder / "jelly.toml").write_text(
        'description = "jelly"\ndensity = 1000\nyoungs_modulus = 1e4\npoisson_ratio = 0.4\n'
    )


def _names_table(folder: Path) -> None:
    source = Path(demo.__file__).parents[1] / "presets" / "names.toml"
    (folder / "n.toml").write_bytes(source.read_bytes())


def _demo(folder: Path) -> None:
    (folder / "d.toml").write_bytes(demo.CONFIG.read_bytes())
    assert tomllib.loads((folder / "d.toml").read_text())


ANSWER = """| object | material | density | E |
|---|---|---|---|
| 1 | wood | 700 kg/m3 | 1e9 Pa |
2. rubber, 1100, soft
roughness 0.4
"""

_add("model archive", "m.tgz", _archive, _read_archive)
_add("adapters", "a.toml", _adapters, lambda f: (read_toml(f / "a.toml"), named_adapters(f / "a.toml")))
_add("material preset", "jelly.toml", _preset, read_presets)
_add("names of objects", "n.toml", _names_table, lambda f: load_names(f / "n.toml"))
_add("demo", "d.toml", _demo, lambda f: demo.load_config(f / "d.toml"))
_add(
    "configuration of a model",
    "config.json",
    lambda f: _json(f / "config.json", {"model_type": "sam", "vision_config": {"size": 3}}),
    lambda f: read_model_json(f / "config.json", "model", "give another"),
)
_add(
    "answer of a model",
    "a.txt",
    lambda f: (f / "a.txt").write_text(ANSWER),
    lambda f: read_answer(_text_of(f / "a.txt").decode("utf-8", "replace"), 2),
)

for _name, (_files, _writes, _reads) in EVALUATE.items():
    _add(_name, _files, _writes, _reads)
