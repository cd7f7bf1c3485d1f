# SPDX-License-Identifier: MIT
"""Two objects from views of both and of the one behind (PhyCAGE section 4.2), and initial splats on a surface."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..mpm.colliders import Surface
from ..mpm.solver_options import SolverOptions
from ..scene.model import Camera
from .image_loss import Target, view_target
from .mesh_to_splats import splats_on_mesh
from .splat_fit import FitOptions, SplatFit, fit_splats
from .splats import Splats
from .views.hull_segmentation import VoteOptions, foreground_body, vote_labels
from .views.posed_images import FOREGROUND, View
from .views.visual_hull import HullOptions, visual_hull

Array = NDArray[np.float64]

UNSEEN_GREY = 0.5
"""Grey of a splat that no view sees."""
UNSEEN_WEIGHT = 1e-6
"""Weight of that grey where one does see it."""


def initial_splats(
    surface: Surface, count: int, targets: Sequence[Target], *, inset: float = 0.0, seed: int = 0
) -> Splats:
    """Return ``count`` splats spread evenly over ``surface``, flat along it, in the mean colours of ``targets``.

    Views are weighted by the squared cosine of the viewing angle; occlusion is ignored, which the fit corrects. inset:
    metres by which the centres lie under the surface, see ``pixel_size``. Raises InputError on a surface without area.
    """
    grey = np.full((len(surface.vertices), 3), UNSEEN_GREY)
    splats = splats_on_mesh(surface.vertices, surface.faces, grey, count, seed=seed)
    normals = splats.axes()[:, :, 2]
    # Subtracting a zero offset would still move the centres by a rounding error.
    centres = splats.centres - inset * normals if inset else splats.centres
    return splats.changed(centres=centres, colours=_view_colours(splats.centres, normals, targets))


def pixel_size(cameras: Sequence[Camera], surface: Surface) -> float:
    """Return the width in metres of a pixel (median over ``cameras``) at the middle of ``surface``.

    The rasteriser widens every splat by half a pixel, and at an outline many overlap: splats with their centres on a
    surface appear about one pixel beyond it, and match best one pixel under it.
    """
    middle = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    return float(np.median([camera.project(middle)[2] / max(camera.fx, camera.fy) for camera in cameras]))


def _view_colours(points: Array, normals: Array, targets: Sequence[Target]) -> Array:
    total, weight = np.full((len(points), 3), UNSEEN_WEIGHT * UNSEEN_GREY), np.full(len(points), UNSEEN_WEIGHT)
    for target in targets:
        x, y, depth = target.camera.project(points).T
        toward = target.camera.position - points
        facing = np.sum(normals * toward, axis=1) / np.linalg.norm(toward, axis=1)
        places = np.where(depth > 0, [y - 0.5, x - 0.5], -9.0)
        share = np.where(depth > 0, np.clip(facing, 0, 1) ** 2, 0) * _sample_image(places, target.alpha) ** 2
        total += share[:, None] * _sample_image(places, target.pixels)
        weight += share
    return total / weight[:, None]


def _sample_image(places: Array, picture: NDArray[np.floating[Any]]) -> Array:
    """Return ``picture`` (H, W, …) at ``places`` (2, N), rows and columns with pixel centres at integers; 0 outside."""
    channels = picture.reshape(*picture.shape[:2], -1)
    values = [map_coordinates(channels[..., k], places, order=1) for k in range(channels.shape[2])]
    return np.asarray(np.stack(values, axis=-1), dtype=np.float64).reshape(places.shape[1], *picture.shape[2:])


@dataclass(frozen=True, kw_only=True)
class PairFitOptions:
    """Options of ``fit_pair``. Raises InputError on a value out of range."""

    background_splats: int = 12_000
    """Splats of the background object; 100 to 1,000,000."""

    foreground_splats: int = 8_000
    """Splats of the foreground object; 100 to 1,000,000."""

    background_fit: FitOptions = field(default_factory=FitOptions)
    """Fit of G₁ to the inpainted views, with all parameters free (equation 15)."""

    foreground_fit: FitOptions = field(default_factory=FitOptions)
    """Fit of G₂ to its own pixels, with frozen centres (equation 16); label and frozen centres are set by the fit."""

    hull: HullOptions = field(default_factory=HullOptions)
    votes: VoteOptions = field(default_factory=VoteOptions)

    thickness: float = 0.04
    """Least thickness of the foreground as a fraction of the hull's longest side, even where the background object
    reaches into it; 0.01 to 1."""

    def __post_init__(self) -> None:
        for name in ("background_splats", "foreground_splats"):
            value = getattr(self, name)
            if not (isinstance(value, int) and 100 <= value <= 1_000_000):
                raise InputError(f"pair option {name} is {value!r}: give a whole number from 100 to 1000000")
        if not (math.isfinite(self.thickness) and 0.01 <= self.thickness <= 1):
            raise InputError(f"pair option thickness is {self.thickness!r}: give a fraction from 0.01 to 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class PairFit:
    """Two fitted objects in world metres; they may still penetrate each other."""

    background: Splats
    """G₁."""

    foreground: Splats
    """G₂, whose centres lie on ``foreground_surface``."""

    foreground_surface: Surface
    """Closed, one pixel under the hull of the views."""

    background_surface: Surface
    """Hull of the inpainted views, closed."""

    background_fit: SplatFit
    foreground_fit: SplatFit

    notes: tuple[str, ...]
    """Sentences for the user: views that were left out, and why."""


def fit_pair(
    views: Sequence[View],
    background_views: Sequence[View],
    options: PairFitOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    label: int = FOREGROUND,
    solver: SolverOptions | None = None,
) -> PairFit:
    """Return both objects of the labelled ``views``; ``background_views`` show the background object alone.

    The visual hull and its vertex labels replace the paper's semantic NeuS (equation 14); the part labelled ``label``
    is closed to a body, on whose surface the foreground's centres stay. Raises InputError on views that contradict each
    other, Cancelled, and SimulationError when a fit diverges.
    """
    options = options or PairFitOptions()
    progress = StageProgress(on_event, "fit", 2)

    def enter(done: int, message: str) -> None:
        if cancelled():
            raise Cancelled(f"cancelled before: {message}")
        progress.report(done, message)

    enter(0, "hulls and labels")
    both, alone = visual_hull(views, options.hull), visual_hull(background_views, options.hull)
    votes = vote_labels(both.vertices, both.faces, views, options.votes)
    hull = Surface(vertices=both.vertices, faces=both.faces)
    behind = Surface(vertices=alone.vertices, faces=alone.faces)
    size = float(np.ptp(hull.vertices, axis=0).max())
    body = foreground_body(
        hull,
        votes.labels,
        label,
        other=behind,
        thickness=options.thickness * size,
        inset=pixel_size([view.camera for view in views], hull),
        spacing=size / options.hull.resolution,
    )

    enter(0, "background object")
    inset = pixel_size([view.camera for view in background_views], behind)
    start = initial_splats(
        behind, options.background_splats, [view_target(view) for view in background_views], inset=inset
    )
    first = fit_splats(background_views, start, options.background_fit, on_event, cancelled, solver=solver)

    enter(1, "foreground object")
    labelled = [view for view in views if view.labels is not None]
    start = initial_splats(body.seen, options.foreground_splats, [view_target(view, label=label) for view in labelled])
    given = options.foreground_fit
    second = fit_splats(
        labelled,
        start,
        dataclasses.replace(given, frozen=given.frozen | {"centres"}, label=label),
        on_event,
        cancelled,
        fixed=first.splats,
        solver=solver,
    )
    notes = (*both.notes, *alone.notes, *votes.notes)
    for note in notes:
        progress.notice(note)
    return PairFit(
        background=first.splats,
        foreground=second.splats,
        foreground_surface=body.surface,
        background_surface=behind,
        background_fit=first,
        foreground_fit=second,
        notes=notes,
    )
