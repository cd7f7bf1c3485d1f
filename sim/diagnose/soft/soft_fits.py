# SPDX-License-Identifier: MIT
"""``Fits`` of a soft capture: estimates, predictions and localisation from what the searches found."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...events import IsCancelled, OnEvent
from ..capture import Capture
from ..comparison_settings import ComparisonSettings
from ..fits import DIRECTIONS, CandidateFit, Discrepancy, Estimate, PhaseInterval
from ..work import Work
from .candidate_survey import FoundFit, Survey
from .contact_search import LOST, ContactFit
from .flight_fits import Flights, SoftTrial
from .soft_candidates import NAMES, WorldParameters
from .soft_simulator import SimulationJob, SoftWorlds, is_plausible

Array = NDArray[np.float64]

TOUCHING = 2e-3
"""Height in m of the lowest point below which a body counts as in contact."""

IMPACT_S = 0.03
"""Duration of an impact after first contact; what lasts longer is contact."""

STILL = 0.05
"""Speed in m/s below which it is at rest."""


def discrepancy_of(
    flights: Flights, worlds: SoftWorlds, world: WorldParameters, base: WorldParameters, nominal: dict[str, Array]
) -> dict[str, Discrepancy]:
    """Return by trial the internal and external forces that ``world`` have beyond ``base``, at their own states."""
    out = {}
    for index, trial in enumerate(flights.trials):
        frames, count = len(trial.times), len(trial.rest)
        forces = np.zeros((frames, count, 3))
        air = flights.in_air(index, world, trial.times)
        whole = air.copy()
        low = np.full(frames, np.inf)
        start, history = flights.start(index, world), None
        true = flights.true_times(index, world, trial.times)
        if start is not None and true[-1] > start.time:
            after = true > start.time + 1e-9
            times = np.append(true[after], true[-1] + 1e-4)
            points, (history,) = worlds.run([SimulationJob(start=start, world=world, times=times)], keep=True)
        if history is not None and is_plausible(points[0]):
            places = history.places[:-1]
            lacking = history.accelerations[:-1] - worlds.inner_accelerations(places, base)
            lacking += worlds.contact_difference(places, history.places, times, world, base)
            lacking = worlds.smoothed(lacking)
            forces[after] = np.einsum("kj,tkji->tki", worlds.weights, lacking[:, worlds.holders])
            whole[after] = points[0][:-1]
            low[after] = places[:, :, 2].min(axis=1)
        forces += _outside(trial, whole, low, world, base)[:, None]
        out[trial.name] = _discrepancy(trial, forces, whole, nominal[trial.name], low)
    return out


def raw_discrepancy(
    trial: SoftTrial, nominal: Array, flights: Flights, index: int, base: WorldParameters
) -> Discrepancy:
    """Return the discrepancy from the tracks alone: second differences of the residual, less the noise contribution."""
    residual = trial.points - nominal
    frames = len(trial.times)
    forces = np.full(residual.shape, np.nan)
    half = 2 if frames >= 5 else 1
    if frames >= 2 * half + 1:
        step = np.median(np.diff(trial.times)) * half
        second = (residual[2 * half :] - 2 * residual[half:-half] + residual[: -2 * half]) / step**2
        forces[half:-half] = second
        noise = np.sqrt(6) * flights.sigma / step**2
        size = np.linalg.norm(second, axis=2, keepdims=True)
        forces[half:-half] *= np.sqrt(np.maximum(0.0, 1 - 3 * noise**2 / np.maximum(size, 1e-12) ** 2))
    turn_low = np.where(trial.seen, np.nan_to_num(trial.points[:, :, 2], nan=np.inf), np.inf).min(axis=1)
    return _discrepancy(trial, np.nan_to_num(forces), nominal, nominal, turn_low)


def _outside(trial: SoftTrial, whole: Array, low: Array, world: WorldParameters, base: WorldParameters) -> Array:
    """Return (T, 3) m/s² on the whole body that ``world`` have beyond ``base``."""
    centre = whole.mean(axis=1)
    velocity = np.gradient(centre, trial.times, axis=0) if len(trial.times) > 2 else np.zeros_like(centre)
    force = np.tile(np.asarray(world.gravity) - np.asarray(base.gravity), (len(centre), 1))
    past = velocity - np.asarray(world.wind)
    force -= world.drag * np.linalg.norm(past, axis=1, keepdims=True) * past
    if world.tether_stiffness:
        away = np.asarray(world.tether_anchor) - centre
        length = np.linalg.norm(away, axis=1, keepdims=True)
        pull = world.tether_stiffness * (length - world.tether_length)
        force += (np.maximum(pull, 0.0) if world.tether_string else pull) * away / np.maximum(length, 1e-9)
    if world.lift:
        force += world.lift * np.cross(_spin(trial, whole), past)
    if world.adhesion:
        force[low < world.reach, 2] -= world.adhesion
    if world.rate != 1:
        force += (world.rate**2 - 1) * np.asarray(base.gravity)
    if world.fraction:
        arm = world.fraction * float(np.linalg.norm(world.offset))
        force[:, 2] += arm * (_spin(trial, whole) ** 2).sum(axis=1)
    return force


def _spin(trial: SoftTrial, whole: Array) -> Array:
    """Return the spin (T, 3) rad/s of the points as a whole."""
    r = whole - whole.mean(axis=1, keepdims=True)
    v = np.gradient(r, trial.times, axis=0) if len(trial.times) > 2 else np.zeros_like(r)
    momentum = np.cross(r, v).sum(axis=1)
    inertia = np.einsum("tki,tki->t", r, r)[:, None, None] * np.eye(3) - np.einsum("tki,tkj->tij", r, r)
    return np.asarray(np.linalg.solve(inertia, momentum[:, :, None])[:, :, 0])


def _discrepancy(trial: SoftTrial, forces: Array, motion: Array, nominal: Array, low: Array) -> Discrepancy:
    point = np.linalg.norm(forces, axis=2)
    frame = np.sqrt((point**2).mean(axis=1))
    velocity = (
        np.gradient(motion.mean(axis=1), trial.times, axis=0) if len(trial.times) > 2 else np.zeros((len(low), 3))
    )
    return Discrepancy(
        frame_score=frame,
        point_score=point,
        residual=trial.points - nominal,
        intervals=_intervals(trial.times, low < TOUCHING, np.linalg.norm(velocity, axis=1)),
        directions=_directions(forces, velocity),
    )


def _directions(forces: Array, velocity: Array) -> dict[str, float]:
    """Return direction shares of forces (T, K, 3): along the ground normal (and gravity), the velocity, or neither."""
    total = float((forces**2).sum())
    if total <= 0:
        return {"normal": 0.0, "along_velocity": 0.0, "along_gravity": 0.0, "other": 1.0}
    upright = float((forces[:, :, 2] ** 2).sum()) / total
    level = velocity * np.array([1.0, 1.0, 0.0])
    way = level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    along = float((np.einsum("tki,ti->tk", forces, way) ** 2).sum()) / total
    shares = {"normal": upright, "along_velocity": along, "along_gravity": 0.0}
    return {name: shares.get(name, max(0.0, 1 - upright - along)) for name in DIRECTIONS}


def _intervals(times: Array, touching: NDArray[np.bool_], speed: Array) -> tuple[PhaseInterval, ...]:
    phases: list[str] = []
    since = -np.inf
    for i, time in enumerate(times):
        if not touching[i]:
            phases.append("flight")
            since = -np.inf
            continue
        since = time if since == -np.inf else since
        phases.append("impact" if time - since < IMPACT_S else "rest" if speed[i] < STILL else "contact")
    out: list[PhaseInterval] = []
    begin = 0
    for i in range(1, len(times) + 1):
        if i == len(times) or phases[i] != phases[begin]:
            end = times[min(i, len(times) - 1)]
            out.append(PhaseInterval(start_s=float(times[begin]), end_s=float(end), phase=phases[begin]))
            begin = i
    return tuple(out)


DRAWS = 400


class SoftFits:
    """``Fits`` of one soft capture (sim/diagnose/diagnosis.py)."""

    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    grain_rms_m: float

    def __init__(self, survey: Survey) -> None:
        self._survey = survey
        self._trials, self._fit_trials, self._flights = survey.trials, survey.fit_trials, survey.flights
        self._laws: dict[int, WorldParameters] = {}
        self._found: dict[int, FoundFit] = {}
        self._summarize(survey.plain, survey.believed, survey.found)

    # Predictions and localisation

    def _summarize(self, plain: FoundFit, believed: ContactFit, found: list[FoundFit]) -> None:
        ranked = sorted(found, key=self._survey.evidence, reverse=True)
        chosen: dict[tuple[str, ...], FoundFit] = {}
        for entry in ranked:
            chosen.setdefault(entry.effects, entry)
        trials = [self._trials[i] for i in self._fit_trials]
        whole = self._whole_trials([believed.world, plain.fit.world, *(f.fit.world for f in list(chosen.values())[:2])])
        self._windows_nominal = self._window_rms(plain.search.judge(believed.free, believed.motions).residuals)
        self._whole_nominal = self._rms(trials, whole[0])
        nominal = FoundFit(search=plain.search, fit=dataclasses.replace(believed, jacobians=None), in_flight=None)
        self.nominal = self._candidate_fit(nominal, self._whole_nominal, believed=True)
        self.refitted = self._candidate_fit(plain, self._rms(trials, whole[1]))
        fits = []
        for i, entry in enumerate(chosen.values()):
            rms = self._rms(trials, whole[2 + i]) if i < 2 and len(whole) > 2 + i else None
            fits.append(self._candidate_fit(entry, rms))
        self.candidates = tuple(fits)
        self.floor_rms_m = math.sqrt(3) * self._flights.sigma
        self.grain_rms_m = self._rms(trials, self._survey.rough_motions(believed.world), whole[0])

    def numerics_rms_m(self, fit: CandidateFit) -> float:
        """See ``Fits``: both lattices of the nominal model in the fitted window; other models are as near."""
        return self._survey.numerics_rms_m

    def _candidate_fit(self, found: FoundFit, rms: float | None, *, believed: bool = False) -> CandidateFit:
        search, fit = found.search, found.fit
        scores, residuals = search.held_out(fit)
        flights = self._survey.flight_part(found)
        by_trial = -0.5 * flights
        for window, score in zip(self._survey.problem.windows, scores, strict=True):
            by_trial[self._fit_trials.index(window.trial)] += score
        covariance = search.covariance(fit, found.moved)
        draws = np.random.default_rng(0).multivariate_normal(fit.free, covariance, size=DRAWS, method="eigh")
        parameters = {name: _estimates(name, [values], values) for name, values, _ in found.before}
        if search.candidate is not None:
            c = search.candidate
            inside = [c.values(np.clip(d[: search.own], c.low, c.high)) for d in draws]
            parameters[c.name] = _estimates(c.name, inside, c.values(fit.free[: search.own]))
        spread = math.sqrt(max(covariance[search.own, search.own], 0.0)) if search.moves[search.own] else 0.0
        beliefs = {}
        if not believed and search.moves[search.own]:
            f = fit.world.friction
            beliefs["friction"] = Estimate(
                value=f, unit="1", low=f * math.exp(-1.96 * spread), high=f * math.exp(1.96 * spread)
            )
        if rms is None and fit.cost >= LOST:
            trials = [self._trials[i] for i in self._fit_trials]
            rms = self._rms(trials, self._whole_trials([fit.world])[0])
        if rms is None:
            rms = self._whole_nominal * self._window_rms(residuals) / max(self._windows_nominal, 1e-12)
        landed, flying = self._survey.contact_misfit(found), self._survey.flight_misfit(found)
        result = CandidateFit(
            effects=found.effects,
            parameters=parameters,
            beliefs=beliefs,
            log_evidence=self._survey.evidence(found),
            heldout_log_score=by_trial,
            heldout_rms_m=rms,
            misfit=max(landed, flying),
            limit=self._survey.limit * max(1.0, flying) if landed > flying else ComparisonSettings.enough,
        )
        self._found[id(result)], self._laws[id(result)] = found, fit.world
        return result

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """See ``Fits``."""
        return self._motion(self.world(fit), [t.times for t in self._trials])

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """See ``Fits``."""
        asked = [t.predict_times for t in self._trials]
        return self._motion(self.world(fit), asked)

    def world(self, fit: CandidateFit) -> WorldParameters:
        """Return the world parameters of ``fit``, which must be one of this object's fits."""
        return self._laws[id(fit)]

    def hidden_spins(self, fit: CandidateFit) -> dict[str, Array]:
        """See ``Fits``: points of a deformable body show its spin."""
        return {}

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """See ``Fits``."""
        nominal = {t.name: p for t, p in zip(self._trials, self._in_ground(self._survey.base), strict=True)}
        if fit is None or not fit.effects:
            return {
                t.name: raw_discrepancy(t, nominal[t.name], self._flights, i, self._survey.base)
                for i, t in enumerate(self._trials)
            }
        world = self.world(fit)
        return discrepancy_of(self._flights, self._survey.worlds, world, self._survey.base, nominal)

    def _motion(self, world: WorldParameters, times: Sequence[Array | None]) -> dict[str, Array]:
        wanted = [(i, t) for i, t in enumerate(times) if t is not None and len(t)]
        found = self._flights.lasting_motion([i for i, _ in wanted], [world] * len(wanted), [t for _, t in wanted])
        return {self._trials[i].name: self._survey.frame.back(p) for (i, _), p in zip(wanted, found, strict=True)}

    def _in_ground(self, world: WorldParameters) -> list[Array]:
        n = len(self._trials)
        return self._flights.lasting_motion(list(range(n)), [world] * n, [t.times for t in self._trials])

    def _whole_trials(self, world: list[WorldParameters]) -> list[list[Array]]:
        n = len(self._fit_trials)
        pairs = list(itertools.product(world, self._fit_trials))
        found = self._flights.lasting_motion(
            [i for _, i in pairs], [a for a, _ in pairs], [self._trials[i].times for _, i in pairs]
        )
        return [found[k * n : (k + 1) * n] for k in range(len(world))]

    # Scores

    @staticmethod
    def _rms(trials: list[SoftTrial], motions: list[Array], others: list[Array] | None = None) -> float:
        """Return the RMS distance in m from first contact on to the tracks (or ``others``), from the flight alone."""
        squares = []
        for trial, motion, other in zip(trials, motions, others or [t.points for t in trials], strict=True):
            d = (other - motion)[trial.flying :]
            squares.append((d[trial.seen[trial.flying :]] ** 2).sum(axis=1))
        found = np.concatenate(squares) if squares else np.zeros(1)
        return float(np.sqrt(found.mean())) if len(found) else 0.0

    @staticmethod
    def _window_rms(residuals: list[Array]) -> float:
        every = np.concatenate(residuals) if residuals else np.zeros(3)
        every = every[np.isfinite(every)]
        return math.sqrt(3 * float((every**2).mean())) if len(every) else 0.0


def _estimates(name: str, draws: list[dict[str, float]], values: dict[str, float]) -> dict[str, Estimate]:
    from ...effects.registry import effect

    out = {}
    for parameter in effect(name).parameters:
        found = np.array([d[parameter.name] for d in draws])
        value = float(np.clip(values[parameter.name], parameter.low, parameter.high))
        low, high = (float(np.clip(q, parameter.low, parameter.high)) for q in np.quantile(found, [0.025, 0.975]))
        out[parameter.name] = Estimate(value=value, unit=parameter.unit, low=min(low, value), high=max(high, value))
    return out


def fit_soft(
    capture: Capture,
    names: Sequence[str] | None,
    *,
    on_event: OnEvent,
    cancelled: IsCancelled,
    work: Work | None = None,
) -> SoftFits:
    """Return the effects ``names`` (None: all that apply) fitted to a capture of one deformable object.

    work: budget of the search, None for no limit; the most promising candidates are refined first. Body directions
    among the parameters are in the mesh's rest frame, those of the environment (wind, anchor, tilt) in the ground's.
    Raises InputError for captures of pixels, of several objects or of a rigid one, ``Cancelled`` on request.
    """
    if len(capture.objects) != 1:
        raise InputError(f"there are {len(capture.objects)} objects: a soft diagnosis handles one")
    if capture.objects[0].belief.youngs_modulus_pa is None:
        raise InputError("youngs_modulus_pa is null: diagnose the object as a rigid one, or give its modulus")
    if any(t.points is None for t in capture.trials):
        name = capture.objects[0].belief.name
        raise InputError(
            f"object {name!r} deforms and its trials are pixels: give it a rigid material (wood, metal) before "
            "tracking, or record 3D points"
        )
    wanted = NAMES if names is None else tuple(n for n in NAMES if n in set(names))
    survey = Survey(capture, on_event=on_event, cancelled=cancelled, work=Work() if work is None else work)
    survey.run(wanted)
    return SoftFits(survey)
