# SPDX-License-Identifier: GPL-3.0-or-later
"""Score a reconstructed scene against a rendered picture's truth."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.scene.folder import Scene, load_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Camera
from physgen.sim.srgb import nearest, read_mask, read_rgb

from .shapes import PLAIN_SOLIDS

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TrueObject:
    """visible, full, shadow: (H, W). box: loose, pixels. volume_m3: None where it means little."""

    name: str
    kind: str
    box: tuple[float, float, float, float]
    size_m: float
    volume_m3: float | None
    occluded_share: float
    visible: Mask
    full: Mask
    shadow: Mask


@dataclass(frozen=True, eq=False)
class Truth:
    """A case. background: (H, W, 3) sRGB; normal: of the ground, in the camera's world."""

    root: Path
    camera: Camera
    normal: tuple[float, float, float]
    exif: bool
    vanishing_points: bool
    objects: tuple[TrueObject, ...]
    order: tuple[str, ...]
    background: NDArray[np.uint8]
    fields: dict[str, Any]

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.root.name

    @property
    def photo(self) -> Path:
        """All that the program is shown, beside the boxes."""
        return self.root / "photo.jpg"


def load_truth(root: Path) -> Truth:
    """The case in ``root``."""
    fields = json.loads((root / "truth.json").read_text())
    lens = fields["camera"]
    pose = tuple(tuple(float(v) for v in row) for row in lens["world_from_camera"])
    camera = Camera(
        width=fields["width"],
        height=fields["height"],
        **{key: lens[key] for key in ("fx", "fy", "cx", "cy")},
        world_from_camera=pose,  # type: ignore[arg-type]
    )
    objects = tuple(
        TrueObject(
            name=item["name"],
            kind=item["kind"],
            box=tuple(item["box"]),
            size_m=item["size_m"],
            volume_m3=item["volume_m3"],
            occluded_share=item["occluded_share"],
            **{sub: read_mask(root / sub / f"{item['name']}.png") for sub in ("visible", "full", "shadow")},
        )
        for item in fields["objects"]
    )
    return Truth(
        root=root,
        camera=camera,
        normal=tuple(fields["ground"]["normal"]),
        exif=fields["exif"],
        vanishing_points=fields["vanishing_points"],
        objects=objects,
        order=tuple(fields["order"]),
        background=read_rgb(root / "background.png"),
        fields=fields,
    )


Pixels = NDArray[np.uint8]

MOST_DB = 60.0
"""Equal pictures count as this: no median is infinite."""
_FINER, _BITS = 8, 4


def iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks (H, W), 0 to 1; 1 for two empty ones."""
    union = int((first | second).sum())
    return 1.0 if union == 0 else int((first & second).sum()) / union


def psnr_within(found: Pixels, true: Pixels, where: Mask) -> float:
    """PSNR in dB of (H, W, 3) pictures among the pixels ``where`` (H, W), at most ``MOST_DB``."""
    return min(MOST_DB, psnr(found, true, where))


def grown(mask: Mask, pixels: int) -> Mask:
    """``mask`` (H, W) and what lies up to so many pixels from it."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def plain_inpainting(photo: Pixels, hole: Mask) -> dict[str, Pixels]:
    """Return OpenCV's inpaintings of ``hole``: Telea's method and Navier-Stokes."""
    filled = hole.astype(np.uint8)
    return {
        "telea": np.asarray(cv2.inpaint(photo, filled, 5, cv2.INPAINT_TELEA), np.uint8),
        "navier_stokes": np.asarray(cv2.inpaint(photo, filled, 5, cv2.INPAINT_NS), np.uint8),
    }


def silhouette(camera: Camera, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> Mask:
    """(H, W) the pixels that a mesh covers by more than half. vertices: (V, 3) world metres; faces: (T, 3).

    Triangles that reach behind the camera are left out.
    """
    seen = camera.project(vertices)
    ahead = seen[:, 2] > 1e-6
    canvas = np.zeros((camera.height * _FINER, camera.width * _FINER), np.uint8)
    # OpenCV counts from the middle of the top left pixel, cameras from its corner.
    reach = 1 << 26
    fine = np.clip((seen[:, :2] * _FINER - 0.5) * (1 << _BITS), -reach, reach)
    points = np.rint(np.where(np.isfinite(fine), fine, 0.0)).astype(np.int32)
    for triangle in np.asarray(faces)[ahead[faces].all(axis=1)]:
        cv2.fillConvexPoly(canvas, points[triangle], 255, lineType=cv2.LINE_8, shift=_BITS)
    return np.asarray(cv2.resize(canvas, (camera.width, camera.height), interpolation=cv2.INTER_AREA) > 127)


def fov_deg(camera: Camera) -> float:
    """Angle of view along the longer side."""
    along = (camera.width, camera.fx) if camera.width >= camera.height else (camera.height, camera.fy)
    return math.degrees(2.0 * math.atan(along[0] / 2.0 / along[1]))


def up_in_camera(camera: Camera, normal: Sequence[float]) -> NDArray[np.float64]:
    """The ground's unit normal (3,) in the camera's axes: right, down, ahead."""
    turned = np.asarray(camera.world_from_camera)[:3, :3].T @ np.asarray(normal, dtype=np.float64)
    return np.asarray(turned / np.linalg.norm(turned))


def angle_deg(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Between two vectors (3,)."""
    cross = float(np.linalg.norm(np.cross(first, second)))
    return math.degrees(math.atan2(cross, float(np.dot(first, second))))


def volume(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> float:
    """Inside a closed mesh, cubic units; by the divergence theorem."""
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]
    corners = corners - corners.reshape(-1, 3).mean(axis=0)
    return abs(float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))) / 6.0


def pairs_in_order(covers: dict[str, Mask], order: Sequence[str], found: dict[str, int]) -> list[bool]:
    """For each pair of which one hides more than a hundredth of the other, whether ``found`` says so too.

    covers: whole outlines (H, W); order: names from the front to the back; found: places, 0 in front.
    """
    result = []
    for i, front in enumerate(order):
        for back in order[i + 1 :]:
            shared = int((covers[front] & covers[back]).sum())
            if shared > 0.01 * int(covers[back].sum()):
                result.append(found[front] < found[back])
    return result


def median(values: Sequence[float]) -> float | None:
    """None of nothing."""
    return float(np.median(values)) if values else None


MIN_SHADOW_PX = 150
MIN_HIDDEN_SHARE = 0.05
HOLE_MARGIN_PX = 3
FAILED_DEG = 90.0

Row = dict[str, Any]


def alias(truth: Truth) -> dict[str, str]:
    """The names that the program is given, by the true ones, which would tell it what things are."""
    return {item.name: f"object_{number}" for number, item in enumerate(truth.objects, start=1)}


def judge(truth: Truth, scene_root: Path, result: Row) -> Row:
    """All numbers of a case; a case without a scene counts as 0, its errors as a whole."""
    row: Row = {
        "case": truth.name,
        "ground": truth.fields["ground"]["kind"],
        "light": truth.fields["light"]["kind"],
        "exif": truth.exif,
        "vanishing_points": truth.vanishing_points,
        "error": result["error"],
        "cpu_s": result["cpu_s"],
        "stages": result["stages"],
        "notices": result["notices"],
    }
    if result["error"] is not None:
        return {**row, **_failed(truth)}
    folder = load_scene(scene_root)
    camera = folder.model.camera
    names = alias(truth)
    row["objects"] = {item.name: _judge_object(truth, item, folder, names[item.name]) for item in truth.objects}
    row |= _judge_background(truth, folder)
    true_fov = fov_deg(truth.camera)
    row["fov_deg"], row["true_fov_deg"] = fov_deg(camera), true_fov
    row["fov_error"] = abs(row["fov_deg"] - true_fov) / true_fov
    ground = folder.model.ground
    row["normal_deg"] = FAILED_DEG
    if ground is not None:
        found = up_in_camera(camera, ground.normal)
        row["normal_deg"] = angle_deg(found, up_in_camera(truth.camera, truth.normal))
    places = {item.name: item.occlusion_order for item in folder.model.objects}
    covers = {item.name: item.full for item in truth.objects}
    row["pairs_in_order"] = pairs_in_order(covers, truth.order, {n: places[names[n]] for n in covers})
    return row


def found_masks(folder: Scene, name: str, size: tuple[int, int]) -> dict[str, Mask]:
    """visible, full, shadow, hole of the scene's object ``name``; ``size``: width, height of the truth."""
    visible = _mask(folder.root / "masks" / f"{name}.png", size)
    full = folder.root / "full" / f"{name}.png"
    return {
        "visible": visible,
        "full": _mask(full, size) if full.is_file() else visible,
        "shadow": _mask(folder.root / "shadows" / f"{name}.png", size),
        "hole": _mask(folder.root / "holes" / f"{name}.png", size),
    }


def mesh_silhouette(folder: Scene, name: str, size: tuple[int, int]) -> Mask:
    """(H, W) what the scene's camera sees of the mesh of ``name``."""
    item = next(o for o in folder.model.objects if o.name == name)
    mesh = load_object_mesh(folder, item)
    return _sized(silhouette(folder.model.camera, mesh.vertices, mesh.faces), size)


def true_hole(truth: Truth) -> Mask:
    """(H, W) where the background cannot be seen as it is."""
    hole = np.zeros((truth.camera.height, truth.camera.width), bool)
    for item in truth.objects:
        hole |= item.visible | item.shadow
    return grown(hole, HOLE_MARGIN_PX)


def _judge_object(truth: Truth, true: TrueObject, folder: Scene, name: str) -> Row:
    size = (truth.camera.width, truth.camera.height)
    found = found_masks(folder, name, size)
    outline = mesh_silhouette(folder, name, size)
    row: Row = {
        "kind": true.kind,
        "mask_iou": iou(found["visible"], true.visible),
        "silhouette_iou": iou(outline, found["full"]),
        "silhouette_true_iou": iou(outline, true.full),
    }
    if int(true.shadow.sum()) >= MIN_SHADOW_PX:
        row["shadow_iou"] = iou(found["shadow"], true.shadow)
    if true.occluded_share >= MIN_HIDDEN_SHARE:
        row["hidden_iou"] = iou(found["full"] & ~found["visible"], true.full & ~true.visible)
    if true.volume_m3 is not None:
        mesh = load_object_mesh(folder, next(o for o in folder.model.objects if o.name == name))
        row["volume_error"] = abs(volume(mesh.vertices, mesh.faces) / true.volume_m3 - 1.0)
    return row


def _judge_background(truth: Truth, folder: Scene) -> Row:
    size = (truth.camera.width, truth.camera.height)
    photo, background = read_rgb(folder.root / "photo.png"), read_rgb(folder.root / "background.png")
    hole = np.zeros(size[::-1], bool)
    for item in folder.model.objects:
        hole |= found_masks(folder, item.name, size)["hole"]
    where = true_hole(truth)
    plain = plain_inpainting(photo, hole)
    best = max(psnr_within(filled, truth.background, where) for filled in plain.values())
    own = psnr_within(background, truth.background, where)
    return {"background_db": own, "opencv_db": best, "background_gain_db": own - best}


def _failed(truth: Truth) -> Row:
    objects = {}
    for item in truth.objects:
        row: Row = {"kind": item.kind, "mask_iou": 0.0, "silhouette_iou": 0.0, "silhouette_true_iou": 0.0}
        if int(item.shadow.sum()) >= MIN_SHADOW_PX:
            row["shadow_iou"] = 0.0
        if item.occluded_share >= MIN_HIDDEN_SHARE:
            row["hidden_iou"] = 0.0
        if item.volume_m3 is not None:
            row["volume_error"] = 1.0
        objects[item.name] = row
    covers = {item.name: item.full for item in truth.objects}
    pairs = pairs_in_order(covers, truth.order, dict.fromkeys(covers, 0))
    nothing = {"background_db": 0.0, "opencv_db": 0.0, "background_gain_db": 0.0}
    return {"objects": objects, **nothing, "fov_error": 1.0, "normal_deg": FAILED_DEG, "pairs_in_order": pairs}


def _sized(mask: Mask, size: tuple[int, int]) -> Mask:
    return np.asarray(nearest(mask.astype(np.float32), *size) > 0.5)


def _mask(path: Path, size: tuple[int, int]) -> Mask:
    return _sized(read_mask(path), size)


GROUPS = ("exif", "vanishing_points", "neither")


def group(row: Row) -> str:
    """Return the source of the field of view: ``exif``, else ``vanishing_points``, else ``neither``."""
    return "exif" if row["exif"] else "vanishing_points" if row["vanishing_points"] else "neither"


def medians(rows: Sequence[Row]) -> Row:
    """Over objects or cases, whichever a number belongs to; with how many they are."""
    objects = [item for row in rows for item in row["objects"].values()]

    def of(key: str, kinds: Sequence[str] | None = None) -> Row:
        values = [o[key] for o in objects if key in o and (kinds is None or o["kind"] in kinds)]
        return {"median": median(values), "of": len(values)}

    def cases(key: str, some: Sequence[Row]) -> Row:
        return {"median": median([row[key] for row in some]), "of": len(some)}

    pairs = [right for row in rows for right in row["pairs_in_order"]]
    summary: Row = {
        "mask_iou": of("mask_iou"),
        "shadow_iou": of("shadow_iou"),
        "background_gain_db": cases("background_gain_db", rows),
        "background_db": cases("background_db", rows),
        "hidden_iou": of("hidden_iou"),
        "silhouette_iou": of("silhouette_iou"),
        "silhouette_true_iou": of("silhouette_true_iou"),
        "volume_error": of("volume_error", PLAIN_SOLIDS),
        "volume_error_all": of("volume_error"),
        "order_right": {"share": sum(pairs) / len(pairs) if pairs else None, "of": len(pairs)},
        "cpu_s": cases("cpu_s", rows),
        "failed": sum(row["error"] is not None for row in rows),
        "cases": len(rows),
    }
    for name in GROUPS:
        some = [row for row in rows if group(row) == name]
        summary[f"fov_error_{name}"] = cases("fov_error", some)
        summary[f"normal_deg_{name}"] = cases("normal_deg", some)
    summary["normal_deg_lines"] = cases("normal_deg", [row for row in rows if row["vanishing_points"]])
    for step in sorted({step for row in rows for step in row["stages"]}):
        seconds = [row["stages"][step] for row in rows if step in row["stages"]]
        summary[f"cpu_s_{step}"] = {"median": median(seconds), "of": len(seconds)}
    return summary


WANTED: tuple[tuple[str, str, float], ...] = (
    ("mask_iou", ">=", 0.93),
    ("shadow_iou", ">=", 0.75),
    ("background_gain_db", ">=", 4.0),
    ("hidden_iou", ">=", 0.7),
    ("silhouette_iou", ">=", 0.97),
    ("volume_error", "<=", 0.25),
    ("fov_error_exif", "<=", 0.1),
    ("fov_error_vanishing_points", "<=", 0.1),
    ("normal_deg_lines", "<=", 3.0),
    ("marks_behind", "<=", 0.0),
)
"""Requirements on the medians, and on the sum of marks."""
