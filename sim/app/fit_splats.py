# SPDX-License-Identifier: MIT
"""Views of one or two objects from all around → scene folder with mesh and splats of each (PhyCAGE 4.1, 4.2)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from ..atomic import replacing
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..gaussians.image_loss import view_target
from ..gaussians.pair_fit import PairFitOptions, fit_pair, initial_splats, pixel_size
from ..gaussians.splat_fit import FitOptions, fit_splats
from ..gaussians.splat_ply import write_splats
from ..gaussians.splats import Splats
from ..gaussians.views.posed_images import BACKGROUND, FOREGROUND, View, mask_folders
from ..gaussians.views.view_files import LAYOUTS, read_view_grid, read_views
from ..gaussians.views.visual_hull import visual_hull
from ..mpm.colliders import Surface
from ..scene.folder import Scene, save_scene
from ..scene.model import Ground, SceneModel, SceneObject
from ..scene.scene_output import replacing_folder
from ..validation import valid_names

FOLDER_LAYOUT = "transforms"
VIEW_LAYOUTS = (FOLDER_LAYOUT, *LAYOUTS)

DEFAULT_SPLATS = PairFitOptions().background_splats + PairFitOptions().foreground_splats
BACKGROUND_SHARE = PairFitOptions().background_splats / DEFAULT_SPLATS


@dataclass(frozen=True, kw_only=True)
class FitRequest:
    """Options of ``fit_splats_scene``. Raises InputError on a value out of range."""

    background_views: Path | None = None
    """The same views with the object in front removed and inpainted; None: there is one object only."""

    layout: str = FOLDER_LAYOUT
    """``transforms``: folders with transforms.json; else image grids of views, one of ``LAYOUTS``."""

    objects: tuple[str, ...] = ()
    """Names of the mask folders, the object behind first; empty where unambiguous."""

    splats: int = DEFAULT_SPLATS
    """In total, 1000 to 1,000,000."""

    steps: int = FitOptions().steps
    """Optimisation steps of each object's fit."""

    reference: str = ""
    """Name of the view that becomes the scene's photo; empty: the first."""

    seed: int = 0

    def __post_init__(self) -> None:
        if self.layout not in VIEW_LAYOUTS:
            raise InputError(f"layout is {self.layout!r}: choose one of {', '.join(VIEW_LAYOUTS)}")
        if not 1000 <= self.splats <= 1_000_000:
            raise InputError(f"splats is {self.splats!r}: give 1000 to 1000000")


@dataclass(frozen=True, kw_only=True, eq=False)
class _FittedObject:
    """An object with its label in the views."""

    name: str
    label: int
    surface: Surface
    splats: Splats


def fit_splats_scene(
    source: Path,
    *,
    out: Path,
    request: FitRequest | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return the scene folder ``out`` with the object in the views ``source``, or two if there are background views.

    The reference view becomes the scene's photo, over white; the ground lies under the lowest object, horizontal in the
    world of the views. An existing scene folder at ``out`` is replaced, anything else is refused.

    Raises InputError on views that are unusable or contradict each other, SimulationError when a fit diverges,
    Cancelled; then nothing is written.
    """
    request = request or FitRequest()
    views = _read_views(source, request, request.objects)
    photo = _reference(views, request.reference)
    with replacing_folder(out) as partial:
        if request.background_views is None:
            made = [_fit_single(views, request, on_event, cancelled)]
        else:
            behind = _read_views(request.background_views, request, ())
            made = _fit_two(views, behind, _names(source, request), request, on_event, cancelled)
        if cancelled():
            raise Cancelled("the fit was cancelled; nothing was written")
        folder = _write(partial, made, photo)
    return Scene(root=out, model=folder.model)


def _read_views(source: Path, request: FitRequest, objects: Sequence[str]) -> tuple[View, ...]:
    if request.layout == FOLDER_LAYOUT:
        return read_views(source, objects=objects)
    return read_view_grid(source, request.layout)


def _reference(views: Sequence[View], name: str) -> View:
    for view in views:
        if name in ("", view.name):
            return view
    known = ", ".join(view.name for view in views[:8])
    raise InputError(f"reference is {name!r}: no view is called that; choose one of {known}")


def _names(source: Path, request: FitRequest) -> tuple[str, str]:
    """Return names of the object behind and of the one in front, after their mask folders."""
    found = mask_folders(source, request.objects) if request.layout == FOLDER_LAYOUT and source.is_dir() else ()
    behind, front = valid_names(found[:2]) if len(found) >= 2 else ("behind", "front")
    return behind, front


def _fit_single(views: Sequence[View], request: FitRequest, on_event: OnEvent, cancelled: IsCancelled) -> _FittedObject:
    hull = visual_hull(views)
    for note in hull.notes:
        on_event({"event": "notice", "stage": "fit", "message": note})
    surface = Surface(vertices=hull.vertices, faces=hull.faces)
    inset = pixel_size([view.camera for view in views], surface)
    targets = [view_target(view) for view in views]
    start = initial_splats(surface, request.splats, targets, inset=inset, seed=request.seed)
    fitted = fit_splats(views, start, FitOptions(steps=request.steps, seed=request.seed), on_event, cancelled)
    return _FittedObject(name="object", label=0, surface=surface, splats=fitted.splats)


def _fit_two(
    views: Sequence[View],
    behind: Sequence[View],
    names: tuple[str, str],
    request: FitRequest,
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> list[_FittedObject]:
    fit = FitOptions(steps=request.steps, seed=request.seed)
    first = round(BACKGROUND_SHARE * request.splats)
    options = PairFitOptions(
        background_splats=first, foreground_splats=request.splats - first, background_fit=fit, foreground_fit=fit
    )
    pair = fit_pair(views, behind, options, on_event, cancelled)
    return [
        _FittedObject(name=names[1], label=FOREGROUND, surface=pair.foreground_surface, splats=pair.foreground),
        _FittedObject(name=names[0], label=BACKGROUND, surface=pair.background_surface, splats=pair.background),
    ]


def _write(root: Path, made: Sequence[_FittedObject], photo: View) -> Scene:
    """Write the scene of ``made``, ordered front to back; return its folder."""
    for sub in ("meshes", "splats", "masks"):
        (root / sub).mkdir()
    objects = []
    for order, item in enumerate(made):
        mesh = trimesh.Trimesh(item.surface.vertices, item.surface.faces, process=False)
        with replacing(root / f"meshes/{item.name}.ply") as partial:
            mesh.export(partial)
        write_splats(root / f"splats/{item.name}.ply", item.splats)
        scene_object = SceneObject(
            name=item.name,
            mesh=f"meshes/{item.name}.ply",
            splats=f"splats/{item.name}.ply",
            size_m=float(np.ptp(item.surface.vertices, axis=0).max()),
            occlusion_order=order,
        )
        mask = _mask(photo, item.label)
        if mask is not None:
            Image.fromarray(mask.astype(np.uint8) * 255).save(root / f"masks/{item.name}.png")
            scene_object = dataclasses.replace(scene_object, mask=f"masks/{item.name}.png")
        objects.append(scene_object)
    pixels = np.rint(255 * photo.pixels).astype(np.uint8)
    Image.fromarray(pixels).save(root / "photo.png")
    Image.fromarray(np.full_like(pixels, 255)).save(root / "background.png")
    lowest = min(float(item.surface.vertices[:, 2].min()) for item in made)
    # One step of floating point lower, so that an object exactly on it does not start inside.
    ground = Ground(point=(0.0, 0.0, math.nextafter(lowest, -math.inf)))
    return save_scene(root, SceneModel(camera=photo.camera, objects=tuple(objects), ground=ground))


def _mask(photo: View, label: int) -> NDArray[np.bool_] | None:
    """Return (H, W) where the photo shows the object; None where the view has neither mask nor labels."""
    if label and photo.labels is not None:
        return np.asarray(photo.labels == label)
    return None if label or photo.mask is None else np.asarray(photo.mask > 0.5)
