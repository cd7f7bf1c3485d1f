# SPDX-License-Identifier: MIT
"""Verification run: nominal model and verdict, simulated in ``sim.mpm`` and compared with the recording.

Candidates are fitted with cheaper models of the same physics. A verdict counts as confirmed when the engine, started
from the same states with the same effects, comes closer to the recording too. The nominal model runs at two
resolutions: the difference between them is numerical error and no finding.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..constitutive import NeoHookeanMaterial, RigidMaterial
from ..effects.registry import apply_effects, effects
from ..errors import Cancelled
from ..events import IsCancelled
from ..mpm.bodies import BodyParticles
from ..mpm.colliders import Surface
from ..mpm.geometry.interior_sampling import sample_interior
from ..mpm.solver_options import Ground, SolverOptions, fit_similarity
from ..mpm.world_setup import WorldSetup
from ..rigid_alignment import nearest_pose
from ..scene.model import Effect as SceneEffect
from .capture import Array, Capture, CaptureObject, Trial
from .capture_geometry import mean_known, observed_distance
from .fits import CandidateFit

HORIZON_S = 1.0
"""Simulated duration for a rigid body, or one without contact."""

SOFT_CONTACT_S = 0.08
"""Simulated duration for a deformable body after first contact: its first impact."""

SOFT_LEAD_S = 0.02
"""Time before that touch at which the engine takes over, where the verdict concerns contact or material."""

CELLS_ACROSS = (8.0, 12.0)
"""Cells along a deforming body's longest side: coarse and fine."""

RIGID_STEPS_S = (4e-4, 2e-4)
"""Longest substep of a rigid body: coarse and fine."""


@dataclass(frozen=True, kw_only=True)
class VerificationRun:
    """Verification run of one trial over its first ``seconds_s``; RMS distances in m.

    before, after: nominal model and verdict against the recording. numerics: nominal model, coarse against fine.
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
        """Return "confirmed" or "contradicted", or "undecided" where the difference is within numerical error."""
        if abs(self.before_rms_m - self.after_rms_m) <= self.numerics_rms_m:
            return "undecided"
        return "confirmed" if self.after_rms_m < self.before_rms_m else "contradicted"


def run_verification(
    capture: Capture,
    trial: Trial,
    nominal: CandidateFit,
    verdict: CandidateFit,
    nominal_points: Array,
    verdict_points: Array,
    cancelled: IsCancelled,
    *,
    nominal_spin: Array | None = None,
    verdict_spin: Array | None = None,
) -> VerificationRun:
    """Run ``trial`` of a capture of one object in the engine.

    nominal_points, verdict_points: (T, K, 3) m, the trial in the proposing models; the engine starts from their first
    frames. nominal_spin, verdict_spin: (3,) rad/s at the first frame, where no point shows it; None: from the points.
    Raises what the engine raises.
    """
    item = capture.objects[0]
    first, end = _stretch(capture, item, trial, nominal_points, verdict)
    trial = _cut(trial, first, end)
    nominal_points, verdict_points = nominal_points[first:end], verdict_points[first:end]
    rates = verdict.parameters.get("time_scale", {})
    rate = rates["rate"].value if "rate" in rates else 1.0
    start = starting_state(trial, nominal_points, spin=nominal_spin)
    runs = [_simulate(capture, item, trial, nominal, start, 1.0, level) for level in range(2)]
    if cancelled():
        raise Cancelled("cancelled during the verification run")
    start = starting_state(trial, verdict_points, rate, spin=verdict_spin)
    runs.append(_simulate(capture, item, trial, verdict, start, rate, 1))
    coarse, fine, found = runs
    frames = slice(1, None)
    return VerificationRun(
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
    """Return the range [first, end) of simulated frames.

    The material of a deformable body shows in its first impact; the flight before would only cost time.
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
    state: StartingState,
    rate: float,
    level: int,
) -> Array:
    """Return tracked points (T, K, 3) in m at the frames of ``trial``, simulated in the engine."""
    from ..mpm.world import Worlds

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
    """Pose at the first frame (world = rotation · rest + translation), velocity of the point ``about``, and spin."""

    rotation: Array
    translation: Array
    velocity: Array
    spin: Array
    about: Array


def starting_state(trial: Trial, points: Array, rate: float = 1.0, *, spin: Array | None = None) -> StartingState:
    """Return the state at the first frame of noise-free points (T, K, 3) m of a body that is rigid until contact.

    rate: true over recorded time. spin: (3,) rad/s at the first frame; None: from how the points turn, 0 for fewer than
    three.
    """
    count = min(5, len(points))
    times = (trial.times[:count] - trial.times[0]) * rate
    rest = trial.rest_points
    poses = [_pose(rest, points[i]) for i in range(count)]
    centre = rest.mean(axis=0)
    way = np.array([turn @ centre + shift for turn, shift in poses])
    degree = 2 if count > 3 else 1
    velocity = np.polynomial.polynomial.polyfit(times, way, degree)[1]
    if spin is None:
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
    """Return the engine's world of one object with the effects of ``fit``; level 0 is coarse, 1 fine."""
    belief = item.belief
    vertices = item.vertices @ state.rotation.T + state.translation
    extent = float(np.ptp(item.vertices, axis=0).max())
    spacing = extent / ((12.0 if belief.rigid else CELLS_ACROSS[level]) * 2.0)
    sample = sample_interior(vertices, item.faces, spacing)
    material: NeoHookeanMaterial | RigidMaterial
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
    """Return the fit's effects for a body that starts rotated by ``rotation``.

    Fitted directions inside a body are in its rest frame; effects expect world axes at the start.
    """
    result = []
    for name in fit.effects:
        values = {key: estimate.value for key, estimate in fit.parameters.get(name, {}).items()}
        if effects()[name].kind in ("material", "mass"):
            values = rotate_vectors(values, rotation)
        result.append(SceneEffect(name=name, parameters=tuple(values.items())))
    return tuple(result)


def rotate_vectors(values: dict[str, float], rotation: Array) -> dict[str, float]:
    """Return ``values`` with every vector (``NAME_x``, ``NAME_y``, ``NAME_z``) rotated by ``rotation`` (3, 3)."""
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
    return float(np.sqrt(mean_known(squares)))
