# SPDX-License-Identifier: MIT
"""Depth of parts in each other, by counting: for judging the assets themselves.

One asset through the whole of it: splats fitted to its pictures, the start distorted, composed, judged.

The composition gets the input picture, the distorted splats and surfaces, and a guidance that knows pictures of O1 from
the fitting views. The truth's shape and the held-out views are seen by the judging functions alone."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from physgen.sim.composite.image_metrics import psnr, ssim
from physgen.sim.gaussians.compose.compose_options import METHODS, ComposeOptions
from physgen.sim.gaussians.compose.composition import compose
from physgen.sim.gaussians.compose.composition_parts import (
    Composition,
    CompositionPart,
    Reference,
    fraction_inside,
    part_distances,
)
from physgen.sim.gaussians.compose.pair_stability import StabilityOptions, check_stability
from physgen.sim.gaussians.compose.penetration import Penetration, penetration_of_meshes
from physgen.sim.gaussians.guidance.ideal_denoiser import IdealDenoiser
from physgen.sim.gaussians.guidance.pretrained_models import ClipScores
from physgen.sim.gaussians.image_loss import view_target
from physgen.sim.gaussians.pair_fit import initial_splats, pixel_size
from physgen.sim.gaussians.raster.rasteriser import Rasteriser
from physgen.sim.gaussians.splat_fit import FitOptions, fit_splats
from physgen.sim.gaussians.splat_ply import read_splats, write_splats
from physgen.sim.gaussians.splats import Splats, from_half_axes, half_axes, joined
from physgen.sim.gaussians.views.posed_images import View
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry.inside_test import inside_lattice
from physgen.sim.mpm.geometry.signed_distance import signed_distance
from physgen.sim.mpm.geometry.triangles import face_normals

from .asset import Asset, Part
from .pictures import AssetPictures, cache_name, rendered
from .results import Row
from .sdf import Array


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """Overlap of two parts."""

    volume: float
    """Cubic metres that both fill."""

    volumes: tuple[float, float]
    """Cubic metres of each."""

    depth: float
    """Metres: how deep the first's vertices lie in the second at most."""

    gap: float
    """Metres between them where they are nearest; 0 where they overlap."""


def volume(part: Part) -> float:
    """Cubic metres that a closed mesh holds."""
    corners = part.vertices[part.faces]
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)


def common_volume(a: Part, b: Part, *, cells: int = 96) -> float:
    """Cubic metres that both fill.

    cells: along the longest side of the box that holds what they share; the middle of each tells for all of it.
    """
    low = np.maximum(a.vertices.min(axis=0), b.vertices.min(axis=0))
    high = np.minimum(a.vertices.max(axis=0), b.vertices.max(axis=0))
    if not (high > low).all():
        return 0.0
    step = float((high - low).max()) / cells
    counts = np.ceil((high - low) / step).astype(np.int64)
    return float((_filled_cells(a, low, step, counts) & _filled_cells(b, low, step, counts)).sum()) * step**3


def overlap(a: Part, b: Part) -> Overlap:
    """Return the overlap of ``a`` and ``b``. The distances take some seconds."""
    lattice = signed_distance(
        Surface(vertices=b.vertices, faces=b.faces), float(np.ptp(b.vertices, axis=0).max()) / 80, margin=0.0
    )
    nearest = float(lattice.at(a.vertices)[0].min())
    return Overlap(
        volume=common_volume(a, b), volumes=(volume(a), volume(b)), depth=max(0.0, -nearest), gap=max(0.0, nearest)
    )


def at_truth(asset: Asset) -> list[Overlap]:
    """Of every two parts of the truth, O1 with each foreground first."""
    parts = asset.parts
    return [overlap(a, b) for i, a in enumerate(parts) for b in parts[i + 1 :]]


def at_start(asset: Asset) -> list[Overlap]:
    """Of the distorted O1 with each foreground."""
    start = asset.start
    return [overlap(start, other) for other in asset.foregrounds]


def _filled_cells(part: Part, low: Array, step: float, counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    return inside_lattice(part.vertices, part.faces, low, np.full(3, step), counts, True)


Picture = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Options of fitting a part's splats: ``count`` of them."""

    count: int
    options: FitOptions


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Size of a trial; by default 500 steps, 20,000 splats, 256²."""

    size: int = 256
    splats: int = 20_000
    fit_steps: int = 400
    steps: int = 500
    table_steps: int = 20
    """Of each thing of a scene without pictures: none is inside another after ten."""

    def fit(self, count: int, *, free: bool) -> Fit:
        """A foreground's centres stay on its surface (eq. 16); those of O1 are ``free``."""
        frozen = frozenset[str]() if free else frozenset({"centres"})
        return Fit(count=count, options=FitOptions(steps=self.fit_steps, frozen=frozen))


SMALL = Budget(size=128, splats=5_000, fit_steps=300, steps=80)
"""Minutes for all assets."""

TINY = Budget(size=48, splats=1_000, fit_steps=5, steps=2, table_steps=1)
"""Checks that everything runs; the results are meaningless."""


def start(asset: Asset, pictures: AssetPictures, budget: Budget, cache: Path) -> tuple[CompositionPart, ...]:
    """Return the start of every method: the fixed foregrounds, then O1.

    Splats of each part are fitted to the pictures of it alone; O1's are then distorted with its surface.
    """
    area = [_area(part) for part in asset.parts]
    counts = [max(500, round(budget.splats * own / sum(area))) for own in area]
    views = (pictures.background_views, *pictures.foreground_views)
    fitted = [
        _fitted(asset, part, seen, budget.fit(count, free=part is asset.background), cache)
        for part, seen, count in zip(asset.parts, views, counts, strict=True)
    ]
    true = [
        CompositionPart(name=part.name, splats=splats, surface=_surface(part))
        for part, splats in zip(asset.parts, fitted, strict=True)
    ]
    centres = fitted[0].centres
    bent = from_half_axes(fitted[0], asset.warp(centres), asset.warp.jacobian(centres) @ half_axes(fitted[0]))
    background = dataclasses.replace(true[0], splats=bent, surface=_surface(asset.start))
    return (*true[1:], background)


def composed(
    asset: Asset,
    pictures: AssetPictures,
    begin: tuple[CompositionPart, ...],
    method: str,
    budget: Budget,
    options: ComposeOptions | None,
) -> tuple[Composition, float]:
    """Return the composition by ``method``, and its CPU seconds."""
    view = pictures.reference
    reference = Reference(camera=view.camera, pixels=_over_white(view), backdrop=np.ones_like(view.pixels))
    views = pictures.background_views
    # The one that is conditioned on the view: SyncDreamer and Zero123 are.
    guidance = IdealDenoiser(
        np.stack([_over_white(view) for view in views]), cameras=tuple(view.camera for view in views)
    )
    chosen = dataclasses.replace(options or ComposeOptions(), method=method, steps=budget.steps, size=budget.size)
    before = time.process_time()
    result = compose(
        begin,
        reference=reference,
        guidance={asset.background.name: guidance},
        cameras=tuple(view.camera for view in views),
        options=chosen,
    )
    return result, time.process_time() - before


def kept_composition(item: Asset, budget: Budget, seed: int, cache: Path) -> tuple[CompositionPart, ...]:
    """Return the composition of an asset by PSE-SDS, without seats, from ``cache`` if it was composed before."""
    stem = f"{budget.splats}-{budget.fit_steps}-{budget.steps}-{seed}"
    file = cache / f"{cache_name(item, budget.size)}-composed-{stem}.npz"
    names = [part.name for part in (*item.foregrounds, item.background)]
    if not file.is_file():
        seen = rendered([item.name], budget.size, cache)[item.name]
        result, _ = composed(
            item, seen, start(item, seen, budget, cache), METHODS[0], budget, ComposeOptions(seed=seed)
        )
        for part in result.parts:
            write_splats(file.with_suffix(f".{part.name}.ply"), part.splats)
        surfaces = {part.name: part.surface for part in result.parts}
        arrays = {f"vertices_{name}": surface.vertices for name, surface in surfaces.items()}
        np.savez_compressed(file, **arrays, **{f"faces_{name}": surface.faces for name, surface in surfaces.items()})
    with np.load(file, allow_pickle=False) as kept:
        surfaces = {n: Surface(vertices=kept[f"vertices_{n}"], faces=kept[f"faces_{n}"]) for n in names}
    splats = {name: read_splats(file.with_suffix(f".{name}.ply")) for name in names}
    return tuple(CompositionPart(name=name, splats=splats[name], surface=surfaces[name]) for name in names)


def likeness(pieces: tuple[CompositionPart, ...], pictures: AssetPictures) -> tuple[float, float]:
    """PSNR in dB against the input picture, and the mean of that against the held-out views."""
    held = [_quality(pieces, view)[0] for view in pictures.held_out]
    return _quality(pieces, pictures.reference)[0], float(np.mean(held))


def judged(
    asset: Asset,
    pictures: AssetPictures,
    begin: tuple[CompositionPart, ...],
    result: Composition,
    method: str,
    cpu_s: float,
    clip: ClipScores | None,
) -> Row:
    """The row of the table."""
    quality = [_quality(result.parts, view) for view in (pictures.reference, *pictures.held_out)]
    before, after = penetrations(begin), penetrations(result.parts)
    held = np.mean(quality[1:], axis=0)
    return Row(
        asset=asset.name,
        method=method,
        psnr_reference=quality[0][0],
        ssim_reference=quality[0][1],
        psnr_held_out=float(held[0]),
        ssim_held_out=float(held[1]),
        penetration_before=sum(p.volume for p in before),
        penetration_after=sum(p.volume for p in after),
        penetrating_before=points_inside(begin),
        penetrating_after=points_inside(result.parts),
        stays_together=stay_together(result.parts),
        cpu_s=cpu_s,
        clip=None if clip is None else _clip(clip, result.parts, pictures),
    )


def stay_together(pieces: tuple[CompositionPart, ...]) -> bool:
    """Whether every foreground stays on O1 for a second of gravity; O1 is held, as a finger is by its hand."""
    held = StabilityOptions(background_fixed=True)
    answers = [check_stability(pieces[-1].surface, other.surface, options=held) for other in pieces[:-1]]
    return all(answer.stays for answer in answers)


def _clip(scores: ClipScores, pieces: tuple[CompositionPart, ...], pictures: AssetPictures) -> float:
    """CLIP_mv of the paper: the mean over held-out views of their likeness to the input picture, %."""
    wanted = _over_white(pictures.reference)
    return float(np.mean([scores.image(picture_of(pieces, view), wanted) for view in pictures.held_out]))


def penetrations(pieces: tuple[CompositionPart, ...]) -> list[Penetration]:
    """Of O1, the last of the pieces, in each of the others."""
    return [penetration_of_meshes(pieces[-1].surface, other.surface) for other in pieces[:-1]]


def points_inside(pieces: tuple[CompositionPart, ...]) -> float:
    """Share of O1's splats whose centres lie in one of the others."""
    return fraction_inside(pieces[-1].splats, [part_distances(piece) for piece in pieces[:-1]])


def picture_of(pieces: tuple[CompositionPart, ...], view: View) -> Picture:
    """(H, W, 3) all pieces before white, from the view's camera."""
    seen = Rasteriser().render(joined([piece.splats for piece in pieces]), view.camera)
    return np.clip(seen.colour.astype(np.float64), 0.0, 1.0)


def _quality(pieces: tuple[CompositionPart, ...], view: View) -> tuple[float, float]:
    """PSNR in dB and SSIM against ``view``, the whole picture."""
    seen, wanted = picture_of(pieces, view), _over_white(view)
    return psnr(seen, wanted, peak=1.0), ssim(seen, wanted)


def _fitted(asset: Asset, part: Part, views: tuple[View, ...], fit: Fit, cache: Path) -> Splats:
    """The part's splats, from ``cache`` if they were fitted before."""
    name = f"{part.name}-{fit.count}-{fit.options.steps}{'-held' * bool(fit.options.frozen)}.ply"
    file = cache / f"{cache_name(asset, views[0].camera.width)}-{name}"
    if not file.is_file():
        surface = _surface(part)
        inset = pixel_size([view.camera for view in views], surface)
        begin = initial_splats(surface, fit.count, [view_target(view) for view in views], inset=inset)
        write_splats(file, fit_splats(views, begin, fit.options).splats)
    # Also the first time: a file keeps 32 bits, and a second run should find what the first did.
    return read_splats(file)


def _over_white(view: View) -> Picture:
    return np.asarray(view.pixels, dtype=np.float64)


def _surface(part: Part) -> Surface:
    return Surface(vertices=part.vertices, faces=part.faces)


def _area(part: Part) -> float:
    return float(face_normals(part.vertices[part.faces])[1].sum())
