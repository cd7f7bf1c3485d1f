# SPDX-License-Identifier: MIT
"""The engine's own word: nominal model and verdict, simulated in ``sim.mpm`` and held against the recording.

Candidates are fitted with cheaper models of the same physics. What they propose counts as confirmed when the engine,
started from the same states and given the same effects, comes nearer to the recording too. The nominal model runs at
two resolutions: what changes between them is numerics and no finding.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..effects.registry import apply_effects, effects
from ..errors import Cancelled
from ..events import IsCancelled
from ..mpm.bodies import BodyParticles
from ..mpm.colliders import Surface
from ..mpm.materials import ElasticMaterial, NeoHookeanMaterial, RigidMaterial
from ..mpm.options import Ground, SolverOptions
from ..mpm.placement import fit_similarity
from ..mpm.sampling import sample_interior
from ..mpm.setup import WorldSetup
from ..scene.model import Effect as SceneEffect
from .analysis import CandidateFit
from .capture import Array, Capture, CaptureObject, Trial
from .projection import observed_distance
from .rotation import nearest_pose

HORIZON_S = 1.0
"""How long a rigid body, or one that touches nothing, is followed."""

SOFT_CONTACT_S = 0.08
"""How long after the first touch a deforming body is followed: its first impact."""

SOFT_LEAD_S = 0.02
"""How long before that touch the engine takes over, where the verdict concerns contact or material."""

CELLS_ACROSS = (8.0, 12.0)
"""Cells along a deforming body's longest side: coarse and fine."""

RIGID_STEPS_S = (4e-4, 2e-4)
"""Longest substep of a rigid body: coarse and fine."""


@dataclass(frozen=True, kw_only=True)
class Confirmation:
    """What the engine says of one take, over its first ``seconds_s``; root mean square distances in m.

    before, after: nominal model and verdict against the recording. numerics: nominal, coarse against fine.
    against_model: the verdict in the engine against the model that proposed it.
    """

    trial: str
    seconds_s: float
    before_rms_m: float
    after_rms_m: float
    numerics_rms_m: float
    against_model_rms_m: float

    @property
    def word(self) -> str:
        """ "confirmed" or "contradicted" where verdict and nominal model differ by more than the engine's numerics,
        else "undecided"."""
        if abs(self.before_rms_m - self.after_rms_m) <= self.numerics_rms_m:
            return "undecided"
        return "confirmed" if self.after_rms_m < self.before_rms_m else "contradicted"


def confirm(
    capture: Capture,
    trial: Trial,
    nominal: CandidateFit,
    verdict: CandidateFit,
    nominal_points: Array,
    verdict_points: Array,
    cancelled: IsCancelled,
) -> Confirmation:
    """Run ``trial`` of a capture of one object in the engine.

    nominal_points, verdict_points: (T, K, 3) m, the same take as the proposing models have it; the engine starts from
    their first frames. Raises what the engine raises.
    """
    item = capture.objects[0]
    first, end = _stretch(capture, item, trial, nominal_points, verdict)
    trial = _cut(trial, first, end)
    nominal_points, verdict_points = nominal_points[first:end], verdict_points[first:end]
    rates = verdict.parameters.get("time_scale", {})
    rate = rates["rate"].value if "rate" in rates else 1.0
    runs = [_simulate(capture, item, trial, nominal, nominal_points, 1.0, level) for level in range(2)]
    if cancelled():
        raise Cancelled("cancelled while the engine confirmed the verdict")
    runs.append(_simulate(capture, item, trial, verdict, verdict_points, rate, 1))
    coarse, fine, found = runs
    frames = slice(1, None)
    return Confirmation(
        trial=trial.name,
        seconds_s=float(trial.times[-1] - trial.times[0]),
        before_rms_m=observed_distance(capture, trial, fine, frames),
        after_rms_m=observed_distance(capture, trial, found, frames, verdict),
        numerics_rms_m=_rms(coarse[frames] - fine[frames]),
        against_model_rms_m=_rms(found[frames] - verdict_points[frames]),
    )


def _stretch(
    capture: Capture, item: CaptureObject, trial: Trial, points: Array, verdict: CandidateFit
) -> tuple[int, int]:
    """Frames from first to before end that are simulated.

    What a deforming body is made of shows in its first impact; its flight before would cost seconds and tell nothing.
    """
    times = trial.times - trial.times[0]
    if item.belief.rigid:
        return 0, max(3, int(np.searchsorted(times, HORIZON_S, side="right")))
    heights = (points - np.asarray(capture.ground.point)) @ capture.ground.unit_normal
    touching = np.flatnonzero(np.nanmin(heights, axis=1) < 0.1 * float(np.ptp(item.vertices, axis=0).max()))
    touch = times[touching[0]] if len(touching) else HORIZON_S
    end = min(len(times), max(3, int(np.searchsorted(times, touch + SOFT_CONTACT_S, side="right"))))
    in_contact = all(effects()[name].kind in ("material", "contact") for name in verdict.effects)
    first = int(np.searchsorted(times, touch - SOFT_LEAD_S)) if in_contact and len(touching) else 0
    return min(first, end - 3), end


def _cut(trial: Trial, first: int, end: int) -> Trial:
    frames = {name: value[first:end] for name in ("points", "pixels") if (value := getattr(trial, name)) is not None}
    return dataclasses.replace(trial, times=trial.times[first:end], **frames)


def _simulate(
    capture: Capture,
    item: CaptureObject,
    trial: Trial,
    fit: CandidateFit,
    points: Array,
    rate: float,
    level: int,
) -> Array:
    """Tracked points (T, K, 3) in m at the frames of ``trial``, in the engine."""
    from ..mpm.worlds import Worlds

    state = starting_state(trial, points, rate)
    setup, options = world_setup(capture, item, fit, state, level)
    body = setup.bodies[0]
    start = body.positions
    across = max(CELLS_ACROSS) if body.rigid else CELLS_ACROSS[level]
    worlds = Worlds([setup], options=options, similarity=fit_similarity([start], cells_across=across, options=options))
    world = worlds[0]
    rest = trial.rest_points @ state.rotation.T + state.translation
    _, near = cKDTree(start).query(rest, k=min(8, len(start)))
    out = np.empty((len(trial.times), len(rest), 3))
    clock = (trial.times - trial.times[0]) * rate
    for frame in range(len(out)):
        if frame:
            worlds.advance(float(clock[frame] - clock[frame - 1]))
        if body.rigid:
            pose = world.pose(body.name)
            out[frame] = rest @ pose.rotation.T + pose.translation
        else:
            now, turned = world.positions(0), world.deformation_gradients(0)
            offsets = rest[:, None] - start[near]
            weight = 1.0 / (np.linalg.norm(offsets, axis=2) + 1e-9) ** 2
            weight /= weight.sum(axis=1, keepdims=True)
            carried = now[near] + np.einsum("knij,knj->kni", turned[near], offsets)
            out[frame] = (carried * weight[..., None]).sum(axis=1)
    return out


@dataclass(frozen=True, kw_only=True)
class StartingState:
    """Pose at the first frame (world = rotation rest + translation), velocity of the point at ``about`` and spin."""

    rotation: Array
    translation: Array
    velocity: Array
    spin: Array
    about: Array


def starting_state(trial: Trial, points: Array, rate: float = 1.0) -> StartingState:
    """State at the first frame of motion without noise: points (T, K, 3) m of a body that is rigid until it touches.

    rate: true over recorded time.
    """
    count = min(5, len(points))
    times = (trial.times[:count] - trial.times[0]) * rate
    rest = trial.rest_points
    poses = [_pose(rest, points[i]) for i in range(count)]
    centre = rest.mean(axis=0)
    way = np.array([turn @ centre + shift for turn, shift in poses])
    degree = 2 if count > 3 else 1
    velocity = np.polynomial.polynomial.polyfit(times, way, degree)[1]
    first = Rotation.from_matrix(poses[0][0])
    turns = np.array([(Rotation.from_matrix(turn) * first.inv()).as_rotvec() for turn, _ in poses])
    spin = np.polynomial.polynomial.polyfit(times, turns, degree)[1]
    return StartingState(rotation=poses[0][0], translation=poses[0][1], velocity=velocity, spin=spin, about=way[0])


def _pose(rest: Array, points: Array) -> tuple[Array, Array]:
    if len(rest) < 3:
        return np.eye(3), points.mean(axis=0) - rest.mean(axis=0)
    return nearest_pose(rest, points)


def world_setup(
    capture: Capture, item: CaptureObject, fit: CandidateFit, state: StartingState, level: int
) -> tuple[WorldSetup, SolverOptions]:
    """The engine's world of one object with the effects of ``fit``; level 0 is coarse, 1 fine."""
    belief = item.belief
    vertices = item.vertices @ state.rotation.T + state.translation
    extent = float(np.ptp(item.vertices, axis=0).max())
    spacing = extent / ((12.0 if belief.rigid else CELLS_ACROSS[level]) * 2.0)
    sample = sample_interior(vertices, item.faces, spacing)
    material: ElasticMaterial | RigidMaterial
    if belief.rigid:
        material = RigidMaterial(density=belief.density_kg_m3)
    else:
        assert belief.youngs_modulus_pa is not None
        material = NeoHookeanMaterial(
            density=belief.density_kg_m3,
            youngs_modulus=_belief(fit, "youngs_modulus_pa", belief.youngs_modulus_pa),
            poisson_ratio=belief.poisson_ratio,
        )
    body = BodyParticles(
        name=item.name,
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        material=material,
        surface=Surface(vertices=vertices, faces=item.faces),
    )
    restitution = _belief(fit, "restitution", capture.ground.restitution or 0.0)
    ground = Ground(
        point=capture.ground.point,
        normal=capture.ground.normal,
        friction=_belief(fit, "friction", capture.ground.friction),
        restitution=restitution if belief.rigid else 0.0,
    )
    setup = WorldSetup(bodies=(body,), ground=ground, gravity=capture.gravity)
    setup = apply_effects(setup, scene_effects(fit, state.rotation))
    body = setup.bodies[0]
    masses = body.masses
    centre = (masses[:, None] * body.positions).sum(axis=0) / masses.sum()
    velocity = state.velocity + np.cross(state.spin, centre - state.about)
    moving = dataclasses.replace(body, velocity=_vector(velocity), spin=_vector(state.spin))
    options = SolverOptions(max_step=RIGID_STEPS_S[level] if belief.rigid else 5e-4)
    return dataclasses.replace(setup, bodies=(moving,)), options


def scene_effects(fit: CandidateFit, rotation: Array) -> tuple[SceneEffect, ...]:
    """The fit's effects for a body that starts turned by ``rotation``.

    Fitted directions inside a body are in its rest frame; effects want them in world axes at the start.
    """
    result = []
    for name in fit.effects:
        values = {key: estimate.value for key, estimate in fit.parameters.get(name, {}).items()}
        if effects()[name].kind in ("material", "mass"):
            values = turned(values, rotation)
        result.append(SceneEffect(name=name, parameters=tuple(values.items())))
    return tuple(result)


def turned(values: dict[str, float], rotation: Array) -> dict[str, float]:
    """``values`` with every vector (``NAME_x``, ``NAME_y``, ``NAME_z``) turned by ``rotation`` (3, 3)."""
    result = dict(values)
    for stem in {key[:-2] for key in values if key.endswith("_x")}:
        names = [f"{stem}_{axis}" for axis in "xyz"]
        if all(name in values for name in names):
            result |= dict(zip(names, (float(v) for v in rotation @ [values[n] for n in names]), strict=True))
    return result


def _belief(fit: CandidateFit, name: str, believed: float) -> float:
    return fit.beliefs[name].value if name in fit.beliefs else believed


def _vector(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _rms(difference: Array) -> float:
    squares = np.square(difference).sum(axis=-1)
    return float(math.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else math.nan
