# SPDX-License-Identifier: MIT
"""Several objects brought to fit each other, one after another (PhyCAGE §4.3, Algorithm 1)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...mpm.colliders import Collider
from ...mpm.distance import DistanceLattice
from ...mpm.options import SolverOptions
from ...scene.model import Camera
from ..guidance.protocol import Guidance
from ..guidance.watched import Watched
from ..physics.options import StepOptions
from ..raster.rasteriser import Rasteriser
from .asset import Composed, Piece, Reference, StepRecord
from .inside import lattice_of, share_inside
from .matter import Matter
from .objective import Objective
from .options import ComposeOptions
from .orbit import orbit
from .yielding import Walk

NO_GUIDANCE: Mapping[str, Guidance] = MappingProxyType({})


def compose(
    pieces: Sequence[Piece],
    *,
    reference: Reference | None,
    guidance: Mapping[str, Guidance] = NO_GUIDANCE,
    cameras: Sequence[Camera] = (),
    options: ComposeOptions | None = None,
    solver: SolverOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Composed:
    """Bring ``pieces`` to fit each other and ``reference``.

    pieces: from the one that stays to those that yield: each is the background of all before it, which by then stay
        (what the authors propose for more than two objects, §6). None of them is changed.
    guidance: for score distillation of yielding pieces, by their names; each is seen alone, from one of ``cameras`` a
        step; none given: 16 around it as SyncDreamer has them.
    solver: where to compute; its grid is not used.

    Raises InputError when there are fewer than two pieces, when a method that looks at pictures has neither reference
    nor guidance, and on open surfaces; SimulationError when the run goes wrong; Cancelled.
    """
    options, solver = options or ComposeOptions(), solver or SolverOptions()
    if len(pieces) < 2:
        raise InputError(f"composition: {len(pieces)} object given: choose at least two that have to fit each other")
    if options.sees and reference is None and not guidance:
        raise InputError(
            f"compose option method is {options.method!r} without a picture: give a reference, or use 'ppps'"
        )
    if reference is not None:
        reference = scaled(reference, options.size)
    rasteriser = Rasteriser(solver=solver)
    watched = {name: Watched(given) for name, given in guidance.items()}
    strange = sorted(set(watched) - {piece.name for piece in pieces[1:]})
    if strange:
        raise InputError(f"guidance is given for {strange[0]!r}: no piece of that name yields")
    staying: list[Piece] = [pieces[0]]
    lattices: list[DistanceLattice] = []
    history: list[StepRecord] = []
    progress = StageProgress(on_event, "composing", options.steps * (len(pieces) - 1))
    for index, piece in enumerate(pieces[1:]):
        later = pieces[index + 2 :]
        objective = Objective(
            rasteriser=rasteriser,
            staying=[other.splats for other in (*staying, *later)],
            subject=piece.name,
            reference=reference,
            guidance=watched.get(piece.name),
            cameras=cameras or orbit(piece.splats.centres, options.size),
            options=options,
        )
        boundaries = [Collider(name=f"{other.name} (stays)", surface=other.surface) for other in staying]
        lattices.append(lattice_of(staying[-1]))
        matter = Matter(
            piece,
            boundaries,
            StepOptions(
                substeps=options.substeps, cells_across=options.cells, keep_strain=options.keep_strain, solver=solver
            ),
            seed=options.seed,
        )
        walk = Walk(splats=piece.splats, matter=matter, options=options)
        for step in walk.steps(objective.descent):
            if cancelled():
                raise Cancelled("composition cancelled")
            found = step.descent
            history.append(
                StepRecord(
                    piece=piece.name,
                    step=step.number,
                    loss=math.nan if found is None else found.loss,
                    psnr=math.nan if found is None else found.psnr,
                    inside=share_inside(step.splats, lattices),
                )
            )
            progress.report(index * options.steps + step.number + 1)
        surface = matter.cleared_surface() if options.simulates else matter.surface()
        staying.append(dataclasses.replace(piece, splats=walk.splats, surface=surface))
    notes = tuple(note for one in watched.values() for note in one.notes)
    return Composed(pieces=tuple(staying), history=tuple(history), notes=notes)


def scaled(reference: Reference, size: int) -> Reference:
    """``reference`` made smaller so that its longer side has ``size`` pixels; smaller ones stay as they are."""
    camera = reference.camera
    share = size / max(camera.width, camera.height)
    if share >= 1:
        return reference
    width, height = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    x, y = width / camera.width, height / camera.height
    small = dataclasses.replace(
        camera, width=width, height=height, fx=camera.fx * x, cx=camera.cx * x, fy=camera.fy * y, cy=camera.cy * y
    )

    def resized(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float64)

    return Reference(camera=small, pixels=resized(reference.pixels), backdrop=resized(reference.backdrop))
