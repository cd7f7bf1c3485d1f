# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene folder against the truth: the numbers of one case, and the medians of many."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from physgen.sim.composite.transfer import nearest, read_mask, read_rgb
from physgen.sim.scene.folder import SceneFolder, load_scene
from physgen.sim.scene.meshes import load_object_mesh

from . import scoring
from .shapes import PLAIN_SOLIDS
from .truth import TrueObject, Truth

MIN_SHADOW_PX = 150
MIN_HIDDEN_SHARE = 0.05
HOLE_MARGIN_PX = 3
FAILED_DEG = 90.0

Row = dict[str, Any]
Mask = NDArray[np.bool_]


def alias(truth: Truth) -> dict[str, str]:
    """The names that the program is given, by the true ones, which would tell it what things are."""
    return {item.name: f"object_{number}" for number, item in enumerate(truth.objects, start=1)}


def judge(truth: Truth, scene_root: Path, said: Row) -> Row:
    """All numbers of a case; a case without a scene counts as 0, its errors as a whole."""
    row: Row = {
        "case": truth.name,
        "ground": truth.fields["ground"]["kind"],
        "light": truth.fields["light"]["kind"],
        "exif": truth.exif,
        "vanishing_points": truth.vanishing_points,
        "error": said["error"],
        "cpu_s": said["cpu_s"],
        "stages": said["stages"],
        "notices": said["notices"],
    }
    if said["error"] is not None:
        return {**row, **_failed(truth)}
    folder = load_scene(scene_root)
    camera = folder.scene.camera
    names = alias(truth)
    row["objects"] = {item.name: _judge_object(truth, item, folder, names[item.name]) for item in truth.objects}
    row |= _judge_background(truth, folder)
    true_fov = scoring.fov_deg(truth.camera)
    row["fov_deg"], row["true_fov_deg"] = scoring.fov_deg(camera), true_fov
    row["fov_error"] = abs(row["fov_deg"] - true_fov) / true_fov
    ground = folder.scene.ground
    row["normal_deg"] = FAILED_DEG
    if ground is not None:
        found = scoring.up_in_camera(camera, ground.normal)
        row["normal_deg"] = scoring.angle_deg(found, scoring.up_in_camera(truth.camera, truth.normal))
    places = {item.name: item.occlusion_order for item in folder.scene.objects}
    covers = {item.name: item.full for item in truth.objects}
    row["pairs_in_order"] = scoring.pairs_in_order(covers, truth.order, {n: places[names[n]] for n in covers})
    return row


def found_masks(folder: SceneFolder, name: str, size: tuple[int, int]) -> dict[str, Mask]:
    """visible, full, shadow, hole of the scene's object ``name``; ``size``: width, height of the truth."""
    visible = _mask(folder.root / "masks" / f"{name}.png", size)
    full = folder.root / "full" / f"{name}.png"
    return {
        "visible": visible,
        "full": _mask(full, size) if full.is_file() else visible,
        "shadow": _mask(folder.root / "shadows" / f"{name}.png", size),
        "hole": _mask(folder.root / "holes" / f"{name}.png", size),
    }


def mesh_silhouette(folder: SceneFolder, name: str, size: tuple[int, int]) -> Mask:
    """(H, W) what the scene's camera sees of the mesh of ``name``."""
    item = next(o for o in folder.scene.objects if o.name == name)
    mesh = load_object_mesh(folder, item)
    return _sized(scoring.silhouette(folder.scene.camera, mesh.vertices, mesh.faces), size)


def true_hole(truth: Truth) -> Mask:
    """(H, W) where the background cannot be seen as it is."""
    hole = np.zeros((truth.camera.height, truth.camera.width), bool)
    for item in truth.objects:
        hole |= item.visible | item.shadow
    return scoring.grown(hole, HOLE_MARGIN_PX)


def _judge_object(truth: Truth, true: TrueObject, folder: SceneFolder, name: str) -> Row:
    size = (truth.camera.width, truth.camera.height)
    found = found_masks(folder, name, size)
    outline = mesh_silhouette(folder, name, size)
    row: Row = {
        "kind": true.kind,
        "mask_iou": scoring.iou(found["visible"], true.visible),
        "silhouette_iou": scoring.iou(outline, found["full"]),
        "silhouette_true_iou": scoring.iou(outline, true.full),
    }
    if int(true.shadow.sum()) >= MIN_SHADOW_PX:
        row["shadow_iou"] = scoring.iou(found["shadow"], true.shadow)
    if true.occluded_share >= MIN_HIDDEN_SHARE:
        row["hidden_iou"] = scoring.iou(found["full"] & ~found["visible"], true.full & ~true.visible)
    if true.volume_m3 is not None:
        mesh = load_object_mesh(folder, next(o for o in folder.scene.objects if o.name == name))
        row["volume_error"] = abs(scoring.volume(mesh.vertices, mesh.faces) / true.volume_m3 - 1.0)
    return row


def _judge_background(truth: Truth, folder: SceneFolder) -> Row:
    size = (truth.camera.width, truth.camera.height)
    photo, background = read_rgb(folder.root / "photo.png"), read_rgb(folder.root / "background.png")
    hole = np.zeros(size[::-1], bool)
    for item in folder.scene.objects:
        hole |= found_masks(folder, item.name, size)["hole"]
    where = true_hole(truth)
    plain = scoring.plain_inpainting(photo, hole)
    best = max(scoring.psnr_within(filled, truth.background, where) for filled in plain.values())
    own = scoring.psnr_within(background, truth.background, where)
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
    pairs = scoring.pairs_in_order(covers, truth.order, dict.fromkeys(covers, 0))
    nothing = {"background_db": 0.0, "opencv_db": 0.0, "background_gain_db": 0.0}
    return {"objects": objects, **nothing, "fov_error": 1.0, "normal_deg": FAILED_DEG, "pairs_in_order": pairs}


def _sized(mask: Mask, size: tuple[int, int]) -> Mask:
    return np.asarray(nearest(mask.astype(np.float32), *size) > 0.5)


def _mask(path: Path, size: tuple[int, int]) -> Mask:
    return _sized(read_mask(path), size)


GROUPS = ("exif", "vanishing_points", "neither")


def group(row: Row) -> str:
    """What tells the camera's lens: ``exif``, where there is none ``vanishing_points``, or ``neither``."""
    return "exif" if row["exif"] else "vanishing_points" if row["vanishing_points"] else "neither"


def medians(rows: Sequence[Row]) -> Row:
    """Over objects or cases, whichever a number belongs to; with how many they are."""
    objects = [item for row in rows for item in row["objects"].values()]

    def of(key: str, kinds: Sequence[str] | None = None) -> Row:
        values = [o[key] for o in objects if key in o and (kinds is None or o["kind"] in kinds)]
        return {"median": scoring.median(values), "of": len(values)}

    def cases(key: str, some: Sequence[Row]) -> Row:
        return {"median": scoring.median([row[key] for row in some]), "of": len(some)}

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
        summary[f"cpu_s_{step}"] = {"median": scoring.median(seconds), "of": len(seconds)}
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
)
"""What issue 7 asks of the medians."""
