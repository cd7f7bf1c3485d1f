# SPDX-License-Identifier: MIT
"""Photos, masks, light, depth, videos, and the folders of other programs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from loaders import BOX, MASK, PIXELS, RANDOM, add, put_json, put_picture
from physgen.physgen_addon.frames.frame_files import Part, write_exr
from physgen.sim.diagnose.track.video_file import Video
from physgen.sim.gaussians.views.view_files import read_views
from physgen.sim.importers.coco_masks import masks_from_json
from physgen.sim.importers.image_masks import masks_from_array_file, masks_from_image
from physgen.sim.importers.physgen import read_physgen
from physgen.sim.importers.physgen3d import read_physgen3d
from physgen.sim.picture_header import require_picture
from physgen.sim.reconstruct.camera.depth_map import read_depth
from physgen.sim.reconstruct.photo import load_photo
from physgen.sim.reconstruct.segmentation.object_masks import read_mask
from physgen.sim.scene.environment import read_environment
from physgen.sim.srgb import read_mask as read_scene_mask
from physgen.sim.srgb import read_rgb
from PIL import Image

PICTURES = (".png", ".jpg", ".webp", ".tif", ".bmp", ".exr", ".hdr")


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
    put_json(folder / "coco.json", {"images": [image], "annotations": shapes, "categories": [{"id": 1, "name": "cup"}]})


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
    add(
        f"photo {_suffix}",
        f"photo{_suffix}",
        lambda f, s=_suffix: put_picture(f / f"photo{s}"),
        lambda f, s=_suffix: load_photo(f / f"photo{s}", 64),
    )
add("mask", "m.png", lambda f: put_picture(f / "m.png", MASK), lambda f: read_mask(f / "m.png", 64, 48))
add(
    "picture of a scene",
    "p.png",
    lambda f: put_picture(f / "p.png"),
    lambda f: (read_rgb(f / "p.png"), read_scene_mask(f / "p.png")),
)
add(
    "masks in a picture",
    "m.png",
    lambda f: put_picture(f / "m.png", MASK // 200),
    lambda f: masks_from_image(f / "m.png"),
)
add("masks NPY", "m.npy", lambda f: np.save(f / "m.npy", MASK[None] > 0), lambda f: masks_from_array_file(f / "m.npy"))
add(
    "masks NPZ",
    "m.npz",
    lambda f: np.savez_compressed(f / "m.npz", masks=MASK[None] > 0),
    lambda f: masks_from_array_file(f / "m.npz"),
)
add(
    "header of a picture",
    ("p.png", "p.jpg", "p.webp", "p.tif", "p.bmp", "p.exr", "p.hdr"),
    lambda f: [_environment(f / f"p{s}") if s in (".exr", ".hdr") else put_picture(f / f"p{s}") for s in PICTURES],
    lambda f: [require_picture(f / f"p{s}", folder=f) for s in PICTURES],
)
add("masks COCO", "coco.json", _coco, lambda f: masks_from_json(f / "coco.json", 64, 48, "photo.png"))
for _suffix in (".exr", ".hdr"):
    add(
        f"environment {_suffix}",
        f"e{_suffix}",
        lambda f, s=_suffix: _environment(f / f"e{s}"),
        lambda f, s=_suffix: read_environment(f / f"e{s}"),
    )
for _suffix in (".npy", ".npz", ".png", ".pfm", ".exr"):
    add(
        f"depth {_suffix}",
        f"d{_suffix}",
        lambda f, s=_suffix: _depth(f / f"d{s}"),
        lambda f, s=_suffix: read_depth(f / f"d{s}", 64, 48),
    )
add("video", "v.avi", _video, _read_video)


def _views(folder: Path) -> None:
    pose = np.eye(4)
    frames = [{"file_path": f"images/{i}", "transform_matrix": pose.tolist()} for i in range(2)]
    for i in range(2):
        put_picture(folder / "images" / f"{i}.png", np.dstack([PIXELS, MASK]))
        put_picture(folder / "labels" / f"{i}.png", MASK // 200)
    put_json(folder / "transforms.json", {"camera_angle_x": 0.8, "w": 64, "h": 48, "frames": frames})


def _physgen(folder: Path) -> None:
    put_picture(folder / "original.png")
    put_picture(folder / "mask.png", MASK // 255)
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
    put_picture(folder / "raw_image.jpg")
    (folder / "meshes").mkdir(exist_ok=True)
    (folder / "mask").mkdir(exist_ok=True)
    BOX.export(folder / "meshes" / "box1.obj")
    put_json(folder / "mask" / "mask.json", [{"value": 0, "label": "background"}, {"value": 1, "label": "box"}])
    content = {
        "object_names": ["box1"],
        "plane_model": [0.0, 0.8, 0.6, -0.5],
        "fov": [-0.4, -0.3, 0.4, 0.3],
        "matrices": [np.diag([0.1, 0.1, 0.1, 1.0]).tolist()],
        "E": [1e5],
        "density": [300.0],
    }
    put_json(folder / "transform.json", content)


add("views", ("transforms.json", "images/0.png", "labels/1.png"), _views, read_views)
add("PhysGen folder", ("sim.yaml", "mask.png"), _physgen, read_physgen)
add("PhysGen3D folder", ("transform.json", "mask/mask.json"), _physgen3d, read_physgen3d)
