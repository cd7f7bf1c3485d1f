# SPDX-License-Identifier: MIT
"""Generated cases of soft bodies: a body, its motion under a cause, and what a camera would have seen of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from ..sim.diagnose.diagnosis import NONE, UNKNOWN
from ..sim.errors import SimulationError
from ..sim.events import IsCancelled, never
from .case import BlindCase, TrialTruth, Truth, drop_points
from .finite_elements import (
    Array,
    SoftMotion,
    SoftWorld,
    Solid,
    simulate_soft,
    surface_mesh,
    tetrahedral_box,
    tetrahedral_sphere,
)
from .soft_causes import KNOWN_CAUSES, UNKNOWN_CAUSES, SoftCause

LEAST_OVER_NOISE, MOST_OVER_NOISE = 6.0, 80.0
MEDIUM_FROM_PA = 1e5
"""Young's modulus from which a body is labelled ``medium`` instead of ``soft``."""

_ATTEMPTS = 8


@dataclass(frozen=True, kw_only=True)
class _Shape:
    """A solid at recording resolution, and a coarse one for the search of strengths."""

    name: str
    fine: Solid
    coarse: Solid


@dataclass(frozen=True, kw_only=True)
class _Start:
    """Initial pose and motion of a trial; world axes."""

    style: str
    centre: Array
    turn: Array
    velocity: Array
    spin: Array

    def of(self, solid: Solid) -> tuple[Array, Array]:
        """Return positions and velocities (N, 3) of the solid's nodes."""
        arm = solid.nodes @ self.turn.T
        return self.centre + arm, self.velocity + np.cross(self.spin, arm)


def soft_case(effects: Sequence[str], rng: np.random.Generator, cancelled: IsCancelled = never) -> BlindCase:
    """Return a case with the effect ``effects``, () for none; ``unknown`` draws one outside the vocabulary.

    Raises SimulationError when no draw makes the effect visible.
    """
    names = [str(rng.choice(list(UNKNOWN_CAUSES))) if e == UNKNOWN else e for e in effects]
    for _ in range(_ATTEMPTS):
        shape, world = _draw_shape(names, rng), _draw_world(rng)
        causes = [
            (UNKNOWN_CAUSES[n] if n in UNKNOWN_CAUSES else KNOWN_CAUSES[n])(shape.fine, world, rng) for n in names
        ]
        starts = [_draw_start(shape, rng) for _ in range(int(rng.integers(5, 7)))]
        rate = float(rng.choice([160, 200, 240]))
        times = np.arange(round(float(rng.uniform(0.82, 0.9)) * rate)) / rate
        noise = float(rng.uniform(4e-4, 9e-4))
        cause = causes[0] if causes else None
        try:
            strength = 0.0
            if cause is not None:
                wanted = math.exp(rng.uniform(math.log(10), math.log(40))) * noise
                strength = _strength(shape.coarse, world, cause, starts[:2], times, wanted, cancelled)
            nominal = _run(shape.fine, world, starts, times, cancelled)
            motion = nominal
            if cause is not None:
                motion = _run(shape.fine, cause.change(strength, world), starts, times, cancelled)
        except SimulationError:
            continue
        ratio = _difference(motion, nominal) / noise
        if cause is None or LEAST_OVER_NOISE <= ratio <= MOST_OVER_NOISE:
            return _assembled(shape, world, cause, strength, starts, times, noise, motion, nominal, ratio, rng)
    raise SimulationError(f"no draw of {_ATTEMPTS} made {', '.join(names)} visible; choose another seed")


def _draw_shape(names: Sequence[str], rng: np.random.Generator) -> _Shape:
    name = str(rng.choice(["cube", "sphere", "beam"], p=[0.45, 0.3, 0.25]))
    if "stiffness_gradient" in names and rng.random() < 0.6:
        name = "beam"
    if name == "sphere":
        radius = float(rng.uniform(0.031, 0.045))
        return _Shape(name=name, fine=tetrahedral_sphere(radius, 6), coarse=tetrahedral_sphere(radius, 4))
    if name == "cube":
        side = float(rng.uniform(0.065, 0.09))
        size = (side, side, side)
        return _Shape(name=name, fine=tetrahedral_box(size, (7, 7, 7)), coarse=tetrahedral_box(size, (4, 4, 4)))
    thin = float(rng.uniform(0.042, 0.05))
    size = (thin * float(rng.uniform(2.4, 2.9)), thin, thin)
    return _Shape(name=name, fine=tetrahedral_box(size, (14, 5, 5)), coarse=tetrahedral_box(size, (8, 3, 3)))


def _draw_world(rng: np.random.Generator) -> SoftWorld:
    return SoftWorld(
        density=float(np.exp(rng.uniform(math.log(220), math.log(950)))),
        youngs_modulus=float(np.exp(rng.uniform(math.log(4e4), math.log(2.3e5)))),
        poisson_ratio=float(rng.uniform(0.26, 0.37)),
        friction=float(rng.uniform(0.35, 0.6)),
    )


def _draw_start(shape: _Shape, rng: np.random.Generator) -> _Start:
    style = str(rng.choice(["drop", "throw"]))
    turn = Rotation.random(rng=rng).as_matrix()
    low = float(-(shape.fine.nodes @ turn.T)[:, 2].min())
    if style == "drop":
        velocity = np.array([*rng.uniform(-0.1, 0.1, 2), 0.0])
        spin, height = rng.uniform(-1, 1, 3), rng.uniform(0.12, 0.4)
    else:
        velocity = np.array([*rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.5, 1.6)])
        spin, height = rng.uniform(-5, 5, 3), rng.uniform(0.1, 0.3)
    centre = np.array([*rng.uniform(-0.15, 0.15, 2), low + height])
    return _Start(style=style, centre=centre, turn=turn, velocity=velocity, spin=spin)


def _run(solid: Solid, world: SoftWorld, starts: Sequence[_Start], times: Array, cancelled: IsCancelled) -> SoftMotion:
    position, velocity = zip(*(s.of(solid) for s in starts), strict=True)
    return simulate_soft(solid, world, np.stack(position), np.stack(velocity), times, cancelled)


def _difference(motion: SoftMotion, nominal: SoftMotion) -> float:
    return float(np.sqrt(np.mean(np.sum((motion.nodes - nominal.nodes) ** 2, axis=3))))


def _strength(
    solid: Solid,
    world: SoftWorld,
    cause: SoftCause,
    starts: Sequence[_Start],
    times: Array,
    wanted: float,
    cancelled: IsCancelled,
) -> float:
    """Return the strength at which the coarse body is about ``wanted`` m off, within the limits."""
    nominal = _run(solid, world, starts, times, cancelled)
    strength = math.sqrt(cause.low * cause.high)
    for _ in range(4):
        size = _difference(_run(solid, cause.change(strength, world), starts, times, cancelled), nominal)
        if 0.75 < size / wanted < 1.33:
            break
        factor = min(max(wanted / max(size, 1e-7), 0.3), 3.5)
        strength = min(max(strength * (1 / factor if cause.weaker else factor), cause.low), cause.high)
    return strength


def _assembled(
    shape: _Shape,
    world: SoftWorld,
    cause: SoftCause | None,
    strength: float,
    starts: Sequence[_Start],
    times: Array,
    noise: float,
    motion: SoftMotion,
    nominal: SoftMotion,
    ratio: float,
    rng: np.random.Generator,
) -> BlindCase:
    corners, weights = _marks(shape.fine, int(rng.integers(18, 46)), rng)
    rest = (shape.fine.nodes[corners] * weights[..., None]).sum(axis=1)
    frames, withheld, share = len(times), 2, float(rng.uniform(0.03, 0.1))
    interval = float(times[1] - times[0])
    trials, truths, notes, gaps = [], {}, {}, []
    for index, start in enumerate(starts):
        name = f"take{index + 1:02d}"
        clean, plain = ((m.nodes[index][:, corners] * weights[None, :, :, None]).sum(axis=2) for m in (motion, nominal))
        shown = frames if index < len(starts) - withheld else round(float(rng.uniform(0.13, 0.2)) / interval)
        trials.append(_take(name, clean, rest, times, shown, share, noise, rng))
        active = _active(cause, motion, index)
        truths[name] = TrialTruth(
            points=clean[:shown],
            active=active[:shown],
            withheld=None if shown == frames else clean[shown:],
            withheld_active=None if shown == frames else active[shown:],
            point_mask=_mask(shape.fine, cause, motion, index, rest),
        )
        gap = np.sum((clean - plain) ** 2, axis=2)
        notes[name] = {"style": start.style, "effect_rms_m": float(np.sqrt(gap.mean()))}
        if shown < frames:
            gaps.append(gap[shown:].mean())
    capture = _capture(shape, world, noise, trials)
    extra: Mapping[str, Any] = {
        "shape": shape.name,
        "observation": "points",
        "noise_sigma": noise,
        "true_nominal_rms_withheld_m": float(np.sqrt(np.mean(gaps))),
        "believed": {
            "friction": world.friction,
            "youngs_modulus_pa": world.youngs_modulus,
            "poisson_ratio": world.poisson_ratio,
            "density": world.density,
        },
        "trials": notes,
    }
    known = () if cause is None or cause.effect == UNKNOWN else (cause.effect,)
    truth = Truth(
        effect=NONE if cause is None else cause.effect,
        effects=known,
        mechanism=NONE if cause is None else cause.mechanism,
        simulator="fem-soft",
        parameters={} if cause is None else cause.parameters(strength),
        # Not measured: running the true model from estimated states would double the cost. Noise is a lower bound.
        oracle_rms_m=2 * noise,
        effect_rms_over_noise=ratio,
        trials=truths,
        notes=extra,
    )
    return BlindCase(capture=capture, truth=truth)


def _take(
    name: str, clean: Array, rest: Array, times: Array, shown: int, share: float, noise: float, rng: np.random.Generator
) -> Trial:
    """The trial of points at ``clean`` (F, K, 3), with noise and a ``share`` of them lost.

    rest: (K, 3) the points at rest. times: (F,) of which the first ``shown`` are recorded, the others to be predicted.
    """
    frames = len(times)
    begins = round(float(rng.uniform(0, 0.4)), 3)
    observed = clean + rng.normal(scale=noise, size=clean.shape)
    observed[np.asarray(drop_points(frames, len(rest), share, rng), dtype=bool)] = np.nan
    return Trial(
        name=name,
        role="fit" if shown == frames else "predict",
        times=begins + times[:shown],
        points=observed[:shown].astype(np.float32).astype(np.float64),
        pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64),
        rest_points=rest,
        predict_times=None if shown == frames else begins + times[shown:],
    )


def _capture(shape: _Shape, world: SoftWorld, noise: float, trials: Sequence[Trial]) -> Capture:
    """The capture of ``trials``, with what is believed of the body."""
    vertices, faces = surface_mesh(shape.fine)
    belief = ObjectBelief(
        name="body",
        mesh="body.obj",
        density_kg_m3=round(world.density, 3),
        stiffness="medium" if world.youngs_modulus >= MEDIUM_FROM_PA else "soft",
        youngs_modulus_pa=round(world.youngs_modulus, 3),
        poisson_ratio=round(world.poisson_ratio, 6),
    )
    return Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=round(world.friction, 6), restitution=None),
        objects=(CaptureObject(belief=belief, vertices=vertices, faces=faces),),
        noise_sigma=noise,
        camera=None,
        trials=tuple(trials),
    )


def _marks(solid: Solid, count: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], Array]:
    """Return ``count`` points on the surface: their nodes (K, 3) and weights (K, 3)."""
    a, b, c = (solid.nodes[solid.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(area), size=count, p=area / area.sum())
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    return solid.faces[chosen], np.column_stack([1 - u, u * (1 - v), u * v])


def _active(cause: SoftCause | None, motion: SoftMotion, trial: int) -> NDArray[np.bool_]:
    frames = motion.energy.shape[1]
    if cause is None:
        return np.zeros(frames, dtype=bool)
    if cause.active == "always":
        return np.ones(frames, dtype=bool)
    size = motion.loss[trial] if cause.active == "losing" else motion.energy[trial]
    return np.asarray(size > 0.15 * max(float(size.max()), 1e-12))


def _mask(
    solid: Solid, cause: SoftCause | None, motion: SoftMotion, trial: int, rest: Array
) -> NDArray[np.bool_] | None:
    """Return a mask (K,) of points whose nearest element is affected; None if all are."""
    if cause is None:
        return None
    where = cause.where
    if cause.effect == "plastic_yield":
        where = motion.flow[trial] > 0.2 * max(float(motion.flow[trial].max()), 1e-9)
    if where is None:
        return None
    _, nearest = cKDTree(solid.centres).query(rest)
    mask = np.asarray(where)[nearest]
    return np.asarray(mask) if 0 < mask.sum() < len(mask) else None
