# SPDX-License-Identifier: MIT
"""Pictures of one or two objects from all around → scene folder with mesh and splats of each (PhyCAGE 4.1, 4.2)."""

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
from ..gaussians.fit.fit import fit_splats
from ..gaussians.fit.options import FitOptions
from ..gaussians.fit.pair import PairOptions, fit_pair
from ..gaussians.fit.start import pixel_size, start_on_surface
from ..gaussians.fit.target import target_of
from ..gaussians.ply.write import write_splats
from ..gaussians.splats import Splats
from ..gaussians.views.hull import visual_hull
from ..gaussians.views.multiview import LAYOUTS, read_multiview
from ..gaussians.views.outside import objects_in
from ..gaussians.views.transforms import read_views
from ..gaussians.views.view import BACKGROUND, FOREGROUND, View
from ..mpm.colliders import Surface
from ..reconstruct.output import replacing_folder
from ..scene.folder import SceneFolder, save_scene
from ..scene.model import Ground, Scene, SceneObject
from ..scene.names import fitting_names

FOLDER_LAYOUT = "transforms"
VIEW_LAYOUTS = (FOLDER_LAYOUT, *LAYOUTS)

SPLATS = PairOptions().background_splats + PairOptions().foreground_splats
BACKGROUND_SHARE = PairOptions().background_splats / SPLATS


@dataclass(frozen=True, kw_only=True)
class FitRequest:
    """What is fitted to what. Raises InputError on a value out of range."""

    background_views: Path | None = None
    """The same views with the object in front removed and what it hid filled in; None: there is one object only."""

    layout: str = FOLDER_LAYOUT
    """``transforms``: folders with transforms.json; else pictures of views side by side, one of ``LAYOUTS``."""

    objects: tuple[str, ...] = ()
    """Names of the folders of masks, the object behind first; empty where it is clear."""

    splats: int = SPLATS
    """Of all objects together, 1000 to 1,000,000."""

    steps: int = FitOptions().steps
    """Of each object's fit."""

    reference: str = ""
    """Name of the view that becomes the scene's photo; empty: the first."""

    seed: int = 0

    def __post_init__(self) -> None:
        if self.layout not in VIEW_LAYOUTS:
            raise InputError(f"layout is {self.layout!r}: choose one of {', '.join(VIEW_LAYOUTS)}")
        if not 1000 <= self.splats <= 1_000_000:
            raise InputError(f"splats is {self.splats!r}: give 1000 to 1000000")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Made:
    """An object with its label in the views."""

    name: str
    label: int
    surface: Surface
    splats: Splats


def fit_splats_scene(
    source: Path,
    out: Path,
    request: FitRequest | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Make ``out`` a scene folder of what the views ``source`` show; in two objects where there are background views.

    The reference view is the scene's photo, white what is behind; the ground lies under the lowest object, level in the
    world of the views. An existing scene folder at ``out`` is replaced, anything else refused.

    Raises InputError on views that cannot be used or contradict each other, SimulationError when a fit runs away,
    Cancelled; then nothing is left behind.
    """
    request = request or FitRequest()
    views = _read(source, request, request.objects)
    photo = _reference(views, request.reference)
    with replacing_folder(out) as partial:
        if request.background_views is None:
            made = [_single(views, request, on_event, cancelled)]
        else:
            behind = _read(request.background_views, request, ())
            made = _pair(views, behind, _names(source, request), request, on_event, cancelled)
        if cancelled():
            raise Cancelled("the fit was cancelled; nothing was written")
        folder = _write(partial, made, photo)
    return SceneFolder(root=out, scene=folder.scene)


def _read(source: Path, request: FitRequest, objects: Sequence[str]) -> tuple[View, ...]:
    if request.layout == FOLDER_LAYOUT:
        return read_views(source, objects=objects)
    return read_multiview(source, request.layout)


def _reference(views: Sequence[View], name: str) -> View:
    for view in views:
        if name in ("", view.name):
            return view
    known = ", ".join(view.name for view in views[:8])
    raise InputError(f"reference is {name!r}: no view is called that; choose one of {known}")


def _names(source: Path, request: FitRequest) -> tuple[str, str]:
    """Of the object behind and of the one in front, as the folders of their masks are called."""
    found = objects_in(source, request.objects) if request.layout == FOLDER_LAYOUT and source.is_dir() else ()
    behind, front = fitting_names(found[:2]) if len(found) >= 2 else ("behind", "front")
    return behind, front


def _single(views: Sequence[View], request: FitRequest, on_event: OnEvent, cancelled: IsCancelled) -> _Made:
    hull = visual_hull(views)
    for note in hull.notes:
        on_event({"event": "notice", "stage": "fit", "message": note})
    surface = Surface(vertices=hull.vertices, faces=hull.faces)
    inset = pixel_size([view.camera for view in views], surface)
    targets = [target_of(view) for view in views]
    start = start_on_surface(surface, request.splats, targets, inset=inset, seed=request.seed)
    fitted = fit_splats(views, start, FitOptions(steps=request.steps, seed=request.seed), on_event, cancelled)
    return _Made(name="object", label=0, surface=surface, splats=fitted.splats)


def _pair(
    views: Sequence[View],
    behind: Sequence[View],
    names: tuple[str, str],
    request: FitRequest,
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> list[_Made]:
    fit = FitOptions(steps=request.steps, seed=request.seed)
    first = round(BACKGROUND_SHARE * request.splats)
    options = PairOptions(
        background_splats=first, foreground_splats=request.splats - first, background_fit=fit, foreground_fit=fit
    )
    pair = fit_pair(views, behind, options, on_event, cancelled)
    return [
        _Made(name=names[1], label=FOREGROUND, surface=pair.foreground_surface, splats=pair.foreground),
        _Made(name=names[0], label=BACKGROUND, surface=pair.background_surface, splats=pair.background),
    ]


def _write(root: Path, made: Sequence[_Made], photo: View) -> SceneFolder:
    """The scene of ``made``, from the front to the back."""
    for sub in ("meshes", "splats", "masks"):
        (root / sub).mkdir()
    objects = []
    for order, item in enumerate(made):
        mesh = trimesh.Trimesh(item.surface.vertices, item.surface.faces, process=False)
        with replacing(root / f"meshes/{item.name}.ply") as partial:
            mesh.export(partial)
        write_splats(root / f"splats/{item.name}.ply", item.splats)
        thing = SceneObject(
            name=item.name,
            mesh=f"meshes/{item.name}.ply",
            splats=f"splats/{item.name}.ply",
            size_m=float(np.ptp(item.surface.vertices, axis=0).max()),
            occlusion_order=order,
        )
        mask = _mask(photo, item.label)
        if mask is not None:
            Image.fromarray(mask.astype(np.uint8) * 255).save(root / f"masks/{item.name}.png")
            thing = dataclasses.replace(thing, mask=f"masks/{item.name}.png")
        objects.append(thing)
    pixels = np.rint(255 * photo.pixels).astype(np.uint8)
    Image.fromarray(pixels).save(root / "photo.png")
    Image.fromarray(np.full_like(pixels, 255)).save(root / "background.png")
    lowest = min(float(item.surface.vertices[:, 2].min()) for item in made)
    # Down by a hair, so that what is exactly on it does not begin in it.
    ground = Ground(point=(0.0, 0.0, math.nextafter(lowest, -math.inf)))
    return save_scene(root, Scene(camera=photo.camera, objects=tuple(objects), ground=ground))


def _mask(photo: View, label: int) -> NDArray[np.bool_] | None:
    """(H, W) where the photo shows the object; None where the view does not say."""
    if label and photo.labels is not None:
        return np.asarray(photo.labels == label)
    return None if label or photo.mask is None else np.asarray(photo.mask > 0.5)
