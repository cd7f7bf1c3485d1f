# SPDX-License-Identifier: MIT
"""Two objects out of the views of both and of the one behind (PhyCAGE section 4.2), as one call."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...mpm.colliders import Surface
from ...mpm.options import SolverOptions
from ..splats import Splats
from ..views.hull import HullOptions, visual_hull
from ..views.view import FOREGROUND, View
from ..views.votes import VoteOptions, vote
from .fit import Fitted, fit_splats
from .foreground import foreground_body
from .options import FitOptions
from .start import pixel_size, start_on_surface
from .target import target_of


@dataclass(frozen=True, kw_only=True)
class PairOptions:
    """How two objects are fitted. Raises InputError on a value out of range."""

    background_splats: int = 12_000
    """Of the background object; 100 to a million."""

    foreground_splats: int = 8_000
    """Of the foreground object; 100 to a million."""

    background_fit: FitOptions = field(default_factory=FitOptions)
    """Of G₁, to the inpainted views, all of whose parameters are free (equation 15)."""

    foreground_fit: FitOptions = field(default_factory=FitOptions)
    """Of G₂, to its own pixels, with its centres where they are (equation 16); its label and that the centres are
    frozen are set here."""

    hull: HullOptions = field(default_factory=HullOptions)
    votes: VoteOptions = field(default_factory=VoteOptions)

    thickness: float = 0.04
    """Share of the hull's longest side that the foreground is thick at least, also where the background object reaches
    into it; 0.01 to 1."""

    def __post_init__(self) -> None:
        for name in ("background_splats", "foreground_splats"):
            value = getattr(self, name)
            if not (isinstance(value, int) and 100 <= value <= 1_000_000):
                raise InputError(f"pair option {name} is {value!r}: give a whole number from 100 to 1000000")
        if not (math.isfinite(self.thickness) and 0.01 <= self.thickness <= 1):
            raise InputError(f"pair option thickness is {self.thickness!r}: give a share from 0.01 to 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two objects, world metres; they may still penetrate each other."""

    background: Splats
    """G₁."""

    foreground: Splats
    """G₂, whose centres lie on ``foreground_surface``."""

    foreground_surface: Surface
    """Closed, one pixel under the hull of the views."""

    background_surface: Surface
    """Hull of the inpainted views, closed."""

    background_fit: Fitted
    foreground_fit: Fitted

    notes: tuple[str, ...]
    """Sentences for people: views that were left out, and why."""


def fit_pair(
    views: Sequence[View],
    background_views: Sequence[View],
    options: PairOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    label: int = FOREGROUND,
    solver: SolverOptions | None = None,
) -> Pair:
    """Both objects of ``views``, with labels, and of ``background_views``, which show the background object alone.

    The hull of all masks and its labelled vertices take the place of the paper's semantic NeuS (equation 14); the part
    labelled ``label`` is closed to a body, whose surface keeps the foreground's centres. Raises InputError on views
    that do not fit together, Cancelled, and SimulationError when a fit runs away.
    """
    options = options or PairOptions()
    progress = StageProgress(on_event, "fit", 2)

    def enter(done: int, message: str) -> None:
        if cancelled():
            raise Cancelled(f"cancelled before: {message}")
        progress.report(done, message)

    enter(0, "hulls and labels")
    both, alone = visual_hull(views, options.hull), visual_hull(background_views, options.hull)
    votes = vote(both.vertices, both.faces, views, options.votes)
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
    start = start_on_surface(
        behind, options.background_splats, [target_of(view) for view in background_views], inset=inset
    )
    first = fit_splats(background_views, start, options.background_fit, on_event, cancelled, solver=solver)

    enter(1, "foreground object")
    labelled = [view for view in views if view.labels is not None]
    start = start_on_surface(body.seen, options.foreground_splats, [target_of(view, label=label) for view in labelled])
    given = options.foreground_fit
    second = fit_splats(
        labelled,
        start,
        dataclasses.replace(given, frozen=given.frozen | {"centres"}, label=label),
        on_event,
        cancelled,
        company=first.splats,
        solver=solver,
    )
    notes = (*both.notes, *alone.notes, *votes.notes)
    for note in notes:
        progress.notice(note)
    return Pair(
        background=first.splats,
        foreground=second.splats,
        foreground_surface=body.surface,
        background_surface=behind,
        background_fit=first,
        foreground_fit=second,
        notes=notes,
    )
