# SPDX-License-Identifier: MIT
"""One asset through the whole of it: splats fitted to its pictures, the start distorted, composed, judged.

The composition gets the input picture, the distorted splats and surfaces, and a guidance that knows pictures of O1 from
the fitting views. The truth's shape and the held-out views are seen by the judging functions alone.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from physgen.sim.composite.metrics import psnr
from physgen.sim.composite.ssim import ssim
from physgen.sim.gaussians.compose.asset import Composed, Piece, Reference
from physgen.sim.gaussians.compose.compose import compose
from physgen.sim.gaussians.compose.inside import lattice_of, share_inside
from physgen.sim.gaussians.compose.options import ComposeOptions
from physgen.sim.gaussians.fit.fit import fit_splats
from physgen.sim.gaussians.fit.options import FitOptions
from physgen.sim.gaussians.fit.start import pixel_size, start_on_surface
from physgen.sim.gaussians.fit.target import target_of
from physgen.sim.gaussians.guidance.clip import ClipScores
from physgen.sim.gaussians.guidance.ideal import IdealDenoiser
from physgen.sim.gaussians.moving import from_half_axes, half_axes
from physgen.sim.gaussians.physics.penetration import Penetration, penetration_of_meshes
from physgen.sim.gaussians.physics.together import HoldOptions, stays_together
from physgen.sim.gaussians.ply.read import read_splats
from physgen.sim.gaussians.ply.write import write_splats
from physgen.sim.gaussians.raster.rasteriser import Rasteriser
from physgen.sim.gaussians.splats import Splats, joined
from physgen.sim.gaussians.views.view import View
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.triangles import face_normals

from .asset import Asset, Part
from .pictures import AssetPictures, kept_as
from .table import Row

Picture = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How a part's splats are fitted: ``count`` of them."""

    count: int
    options: FitOptions


@dataclass(frozen=True, kw_only=True)
class Budget:
    """What a trial may take; the defaults are the issue's: 500 steps, 20,000 splats, 256²."""

    size: int = 256
    splats: int = 20_000
    fit_steps: int = 400
    steps: int = 500

    def fit(self, count: int, *, free: bool) -> Fit:
        """A foreground's centres stay on its surface (eq. 16); those of O1 are ``free``."""
        frozen = frozenset[str]() if free else frozenset({"centres"})
        return Fit(count=count, options=FitOptions(steps=self.fit_steps, frozen=frozen))


QUICK = Budget(size=128, splats=5_000, fit_steps=300, steps=80)
"""Minutes for all assets."""


def start(asset: Asset, pictures: AssetPictures, budget: Budget, cache: Path) -> tuple[Piece, ...]:
    """What every method is given: the foregrounds, which stay, then O1.

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
        Piece(name=part.name, splats=splats, surface=_surface(part))
        for part, splats in zip(asset.parts, fitted, strict=True)
    ]
    centres = fitted[0].centres
    bent = from_half_axes(fitted[0], asset.warp(centres), asset.warp.jacobian(centres) @ half_axes(fitted[0]))
    background = dataclasses.replace(true[0], splats=bent, surface=_surface(asset.start))
    return (*true[1:], background)


def composed(
    asset: Asset,
    pictures: AssetPictures,
    begin: tuple[Piece, ...],
    method: str,
    budget: Budget,
    options: ComposeOptions | None,
) -> tuple[Composed, float]:
    """What ``method`` makes of the start, and the CPU seconds of it."""
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


def judged(
    asset: Asset,
    pictures: AssetPictures,
    begin: tuple[Piece, ...],
    result: Composed,
    method: str,
    cpu_s: float,
    clip: ClipScores | None,
) -> Row:
    """The row of the table."""
    quality = [_quality(result.pieces, view) for view in (pictures.reference, *pictures.held_out)]
    before, after = penetrations(begin), penetrations(result.pieces)
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
        penetrating_after=points_inside(result.pieces),
        stays_together=stay_together(result.pieces),
        cpu_s=cpu_s,
        clip=None if clip is None else _clip(clip, result.pieces, pictures),
    )


def stay_together(pieces: tuple[Piece, ...]) -> bool:
    """Whether every foreground stays on O1 for a second of gravity; O1 is held, as a finger is by its hand."""
    held = HoldOptions(background_fixed=True)
    answers = [stays_together(pieces[-1].surface, other.surface, options=held) for other in pieces[:-1]]
    return all(answer.stays for answer in answers)


def _clip(scores: ClipScores, pieces: tuple[Piece, ...], pictures: AssetPictures) -> float:
    """CLIP_mv of the paper: the mean over held-out views of their likeness to the input picture, %."""
    wanted = _over_white(pictures.reference)
    return float(np.mean([scores.image(picture_of(pieces, view), wanted) for view in pictures.held_out]))


def penetrations(pieces: tuple[Piece, ...]) -> list[Penetration]:
    """Of O1, the last of the pieces, in each of the others."""
    return [penetration_of_meshes(pieces[-1].surface, other.surface) for other in pieces[:-1]]


def points_inside(pieces: tuple[Piece, ...]) -> float:
    """Share of O1's splats whose centres lie in one of the others."""
    return share_inside(pieces[-1].splats, [lattice_of(piece) for piece in pieces[:-1]])


def picture_of(pieces: tuple[Piece, ...], view: View) -> Picture:
    """(H, W, 3) all pieces before white, from the view's camera."""
    seen = Rasteriser().render(joined([piece.splats for piece in pieces]), view.camera)
    return np.clip(seen.colour.astype(np.float64), 0.0, 1.0)


def _quality(pieces: tuple[Piece, ...], view: View) -> tuple[float, float]:
    """PSNR in dB and SSIM against ``view``, the whole picture."""
    seen, wanted = picture_of(pieces, view), _over_white(view)
    return psnr(seen, wanted, peak=1.0), ssim(seen, wanted)


def _fitted(asset: Asset, part: Part, views: tuple[View, ...], fit: Fit, cache: Path) -> Splats:
    """The part's splats, from ``cache`` if they were fitted before."""
    name = f"{part.name}-{fit.count}-{fit.options.steps}{'-held' * bool(fit.options.frozen)}.ply"
    file = cache / f"{kept_as(asset, views[0].camera.width)}-{name}"
    if not file.is_file():
        surface = _surface(part)
        inset = pixel_size([view.camera for view in views], surface)
        begin = start_on_surface(surface, fit.count, [target_of(view) for view in views], inset=inset)
        write_splats(file, fit_splats(views, begin, fit.options).splats)
    # Also the first time: a file keeps 32 bits, and a second run should find what the first did.
    return read_splats(file)


def _over_white(view: View) -> Picture:
    return np.asarray(view.pixels, dtype=np.float64)


def _surface(part: Part) -> Surface:
    return Surface(vertices=part.vertices, faces=part.faces)


def _area(part: Part) -> float:
    return float(face_normals(part.vertices[part.faces])[1].sum())
