# SPDX-License-Identifier: MIT
"""Generated captures of a rigid body with no, one or two hidden causes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing

from ..sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from ..sim.diagnose.diagnosis import NONE, UNKNOWN
from ..sim.errors import SimulationError
from ..sim.events import IsCancelled, never
from .case import BlindCase, Lens, TrialTruth, Truth, draw_camera, drop_points, project
from .mujoco_world import (
    STEP_S,
    Array,
    Body,
    Motion,
    RigidWorld,
    State,
    draw_state,
    facing,
    load_mujoco,
    rigid_mesh,
    simulate_rigid,
    surface_points,
)
from .rigid_causes import KNOWN_CAUSES, NONE_STYLES, Cause
from .rigid_unknown_causes import UNKNOWN_CAUSES

LEAST_OVER_NOISE = 8.0
"""Least size of an effect in noise standard deviations; smaller ones are drawn again."""

LEAST_AFTER_STATE = 3.5
"""The same after the initial state has absorbed what it can."""

MOST_ORACLE_M = 0.008
"""Largest error of the true model on withheld frames; worse cases are drawn again."""

BOUNCE_UNDERRATED = 0.016
"""Largest underestimate of the nominal restitution, as if measured from frames that miss the apex."""

SEARCH_STEP_S = 4e-4
"""Longest step while strengths are chosen and draws rejected, a fifth of a contact; captures have ``STEP_S``."""

_ATTEMPTS = 20
_AIRY = ("air_drag", "wind", "magnus")
_FILMED = ("camera_pose", "lens_distortion")
_ROUND_ONLY = ("rolling_resistance", "magnus", "adhesion")


@dataclass(frozen=True, kw_only=True)
class _Throw:
    name: str
    style: str
    state: State
    start: float
    shown: int | None


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """Everything of a case except its causes."""

    world: RigidWorld
    trials: tuple[_Throw, ...]
    times: Array
    noise: float
    camera: Camera | None
    target: Array
    rest: Array
    normals: Array
    believed_bounce: float


@dataclass(frozen=True, kw_only=True)
class _Hidden:
    cause: Cause
    strength: float


def rigid_case(effects: Sequence[str], rng: np.random.Generator, cancelled: IsCancelled = never) -> BlindCase:
    """Return a case with the causes ``effects``, () for none; ``unknown`` draws one outside the vocabulary.

    Raises InputError without MuJoCo, SimulationError when no draw makes the effects visible.
    """
    load_mujoco()
    names = [str(rng.choice(list(UNKNOWN_CAUSES))) if e == UNKNOWN else e for e in effects]
    for _ in range(_ATTEMPTS):
        world = _draw_world(names, rng)
        causes = [(UNKNOWN_CAUSES[n] if n in UNKNOWN_CAUSES else KNOWN_CAUSES[n])(world, rng) for n in names]
        stage = _draw_stage(world, names, causes, rng)
        nominal = _observe(stage, ())
        hidden, ratios = [], []
        for cause in causes:
            strength, over_noise = _scaled(
                stage, cause, nominal, math.exp(rng.uniform(math.log(14), math.log(55))), rng
            )
            hidden.append(_Hidden(cause=cause, strength=strength))
            ratios.append(over_noise)
            if cancelled():
                break
        if all(LEAST_OVER_NOISE <= r <= 120 for r in ratios):
            seen = _observe(stage, hidden)
            notes, oracle = _notes(stage, seen, nominal), _oracle(stage, hidden, seen, rng)
            if _predictable(hidden, oracle, notes["true_nominal_rms_withheld_m"]):
                return _assembled(stage, hidden, ratios, oracle, notes, rng)
    raise SimulationError(f"no draw of {_ATTEMPTS} made {', '.join(names)} visible; choose another seed")


def _predictable(hidden: Sequence[_Hidden], oracle: float, gap: float) -> bool:
    """Return whether knowing the causes helps on withheld frames: tumbling on edges is chaotic.

    oracle, gap: RMS errors there in m, of the true model from the shown frames and of the nominal one from the truth.
    """
    if oracle > MOST_ORACLE_M:
        return False
    if not hidden or any(h.cause.camera is not None or h.cause.lens is not None for h in hidden):
        return True
    return gap > 2 * oracle


def _draw_world(names: Sequence[str], rng: np.random.Generator) -> RigidWorld:
    airy = any(n in _AIRY for n in names)
    # Sliding bodies show friction for longer than rolling ones.
    odds = (0.15, 0.5, 0.35) if "friction" in names else (0.5, 0.33, 0.17)
    round_ = any(n in _ROUND_ONLY for n in names)
    shape = "sphere" if round_ else str(rng.choice(["sphere", "cube", "box"], p=odds))
    if shape == "sphere":
        half = (float(rng.uniform(0.024, 0.05)),) * 3
    elif shape == "cube":
        half = (float(rng.uniform(0.028, 0.05)),) * 3
    else:
        sides = np.sort(rng.uniform(0.02, 0.06, 3))
        half = (float(sides[0]), float(sides[1]), float(sides[2]))
    density = math.exp(rng.uniform(math.log(130), math.log(500 if airy else 1200)))
    return RigidWorld(
        body=Body(shape=shape, half=half, density=float(density)),
        friction=float(rng.uniform(0.2, 0.58)),
        restitution=float(rng.uniform(0.2, 0.72) if shape == "sphere" else rng.uniform(0.2, 0.45)),
    )


def _draw_stage(world: RigidWorld, names: Sequence[str], causes: Sequence[Cause], rng: np.random.Generator) -> _Stage:
    body = world.body
    rate = float(rng.choice([120, 150, 200, 240]))
    duration = float(rng.uniform(0.9, 1.45))
    filmed = any(n in _FILMED for n in names) or bool(rng.random() < 0.18)
    styles = [s for c in causes for s in c.styles] or list(rng.choice(NONE_STYLES, size=2))
    if body.shape != "sphere":
        styles = ["slide" if s == "roll" else s for s in styles]
    withheld = int(rng.integers(2, 4))
    count = withheld + int(rng.integers(3, 6))
    trials = []
    for index in range(count):
        style = styles[index % len(styles)] if index < len(styles) else str(rng.choice(styles))
        state = draw_state(body, style, duration, rng, close=filmed)
        shown = round(float(rng.uniform(0.125, 0.2)) * rate) if index >= count - withheld else None
        start = round(float(rng.uniform(0, 0.4)), 3)
        trials.append(_Throw(name=f"take{index + 1:02d}", style=style, state=state, start=start, shown=shown))
    target = np.array([0.0, 0.0, float(rng.uniform(0.15, 0.35))])
    rest, normals = surface_points(body, int(rng.integers(18, 49)), rng)
    return _Stage(
        world=world,
        trials=tuple(trials),
        times=np.arange(round(duration * rate)) / rate,
        noise=0.5 if filmed else float(rng.uniform(3e-4, 1e-3)),
        camera=draw_camera(target, float(rng.uniform(1.9, 2.6)), rng) if filmed else None,
        target=target,
        rest=rest,
        normals=normals,
        believed_bounce=world.restitution - float(rng.uniform(0.0, BOUNCE_UNDERRATED)),
    )


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """Observed points (T, K, 3) of a trial, and pixels (T, K, 2) with a camera."""

    points: Array
    pixels: Array | None
    motion: Motion
    normals: Array


def _observe(
    stage: _Stage,
    hidden: Sequence[_Hidden],
    states: Sequence[State] | None = None,
    step: float = SEARCH_STEP_S,
) -> list[_Seen]:
    """Return noise-free observations of every trial; ``states`` replace the trials' own. step: the longest, s."""
    world, times, camera, lens = stage.world, stage.times, stage.camera, Lens()
    for item in hidden:
        cause, strength = item.cause, item.strength
        world = cause.change(strength, world)
        if cause.clock is not None:
            times = cause.clock(strength, times)
        if cause.camera is not None and camera is not None:
            camera = cause.camera(strength, camera, stage.target)
        if cause.lens is not None:
            lens = cause.lens(strength)
    seen = []
    for index, trial in enumerate(stage.trials):
        motion = simulate_rigid(world, trial.state if states is None else states[index], times, step=step)
        points = motion.points(stage.rest)
        pixels = None if camera is None else project(points, camera, lens)
        normals = np.einsum("tij,kj->tki", motion.rotation, stage.normals)
        seen.append(_Seen(points=points, pixels=pixels, motion=motion, normals=normals))
    return seen


def _scaled(
    stage: _Stage, cause: Cause, nominal: Sequence[_Seen], wanted: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the strength at which the effect is about ``wanted`` times the noise, within its limits, and its size."""
    strength = math.sqrt(cause.low * cause.high)
    some = dataclasses.replace(stage, trials=stage.trials[:3])
    size = 0.0
    for _ in range(5):
        size, left = _size(some, _observe(some, [_Hidden(cause=cause, strength=strength)]), nominal)
        if left < LEAST_AFTER_STATE and strength >= cause.high:
            return strength, 0.0
        if 0.75 < size / wanted < 1.33:
            break
        factor = min(max(wanted / max(size, 1e-6), 0.2), 5.0)
        following = min(max(strength * factor, cause.low), cause.high)
        if following == strength:
            break
        strength = following
    size, left = _size(stage, _observe(stage, [_Hidden(cause=cause, strength=strength)]), nominal)
    return strength, size if left >= LEAST_AFTER_STATE else 0.0


def _size(stage: _Stage, seen: Sequence[_Seen], nominal: Sequence[_Seen]) -> tuple[float, float]:
    """Return the RMS difference over the noise, and the part beyond an offset and a drift of each trial."""
    plain, left = [], []
    noise = stage.noise
    for a, b in zip(seen, nominal, strict=False):
        filmed = a.pixels is not None and b.pixels is not None
        difference = a.pixels - b.pixels if filmed else a.points - b.points  # type: ignore[operator]
        plain.append(np.mean(np.sum(difference**2, axis=2)))
        mean = difference.mean(axis=1)
        basis = np.column_stack([np.ones(len(stage.times)), stage.times])
        rest = mean - basis @ np.linalg.lstsq(basis, mean, rcond=None)[0]
        left.append(np.mean(np.sum(rest**2, axis=1)))
    return float(np.sqrt(np.mean(plain))) / noise, float(np.sqrt(np.mean(left))) / noise


def _assembled(
    stage: _Stage,
    hidden: Sequence[_Hidden],
    ratios: Sequence[float],
    oracle: float,
    notes: Mapping[str, Any],
    rng: np.random.Generator,
) -> BlindCase:
    """Return the case as recorded, simulated with ``STEP_S``. oracle, notes: of ``_oracle`` and ``_notes``."""
    seen = _observe(stage, hidden, step=STEP_S)
    order = np.argsort(ratios)[::-1]
    hidden = [hidden[i] for i in order]
    effects = tuple(h.cause.effect for h in hidden if h.cause.effect != UNKNOWN)
    effect = hidden[0].cause.effect if hidden else NONE
    share = float(rng.uniform(0.02, 0.11))
    trials, truths = [], {}
    for trial, view in zip(stage.trials, seen, strict=True):
        trials.append(_trial(stage, trial, view, share, rng))
        truths[trial.name] = _trial_truth(stage, trial, view, hidden)
    body = stage.world.body
    vertices, faces = rigid_mesh(body)
    density = round(body.density, 3)
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=density, stiffness="hard")
    capture = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(friction=round(stage.world.friction, 6), restitution=round(stage.believed_bounce, 6)),
        objects=(CaptureObject(belief=belief, vertices=vertices, faces=faces),),
        noise_sigma=stage.noise,
        camera=stage.camera,
        trials=tuple(trials),
    )
    ambiguous: dict[str, str] = dict(hidden[0].cause.ambiguous_with) if len(hidden) == 1 else {}
    parameters: dict[str, Any] = {h.cause.mechanism: dict(h.cause.parameters(h.strength)) for h in hidden}
    truth = Truth(
        effect=effect,
        effects=effects,
        mechanism=" + ".join(h.cause.mechanism for h in hidden) or NONE,
        simulator="mujoco-rigid",
        parameters=parameters[hidden[0].cause.mechanism] if len(hidden) == 1 else parameters,
        oracle_rms_m=oracle,
        effect_rms_over_noise=float(max(ratios, default=0.0)),
        trials=truths,
        ambiguous_with=ambiguous,
        notes=notes,
    )
    return BlindCase(capture=capture, truth=truth)


def _notes(stage: _Stage, seen: Sequence[_Seen], nominal: Sequence[_Seen]) -> Mapping[str, Any]:
    world = stage.world
    trials: dict[str, Any] = {}
    withheld = []
    for trial, view, plain in zip(stage.trials, seen, nominal, strict=True):
        gap = np.sum((view.points - plain.points) ** 2, axis=2)
        s = trial.state
        trials[trial.name] = {
            "style": trial.style,
            "effect_rms_m": float(np.sqrt(gap.mean())),
            "initial": {
                "pos": s.position.tolist(),
                "quat": s.quaternion.tolist(),
                "vel": s.velocity.tolist(),
                "omega": s.spin.tolist(),
            },
        }
        if trial.shown is not None:
            withheld.append(gap[trial.shown :].mean())
    return {
        "shape": world.body.shape,
        "observation": "points" if stage.camera is None else "pixels",
        "noise_sigma": stage.noise,
        "true_nominal_rms_withheld_m": float(np.sqrt(np.mean(withheld))),
        "believed": {
            "friction": world.friction,
            "restitution": stage.believed_bounce,
            "density": world.body.density,
        },
        "trials": trials,
    }


def _trial(stage: _Stage, trial: _Throw, view: _Seen, share: float, rng: np.random.Generator) -> Trial:
    clean = view.points if view.pixels is None else view.pixels
    frames, count = clean.shape[:2]
    gone = np.asarray(drop_points(frames, count, share, rng), dtype=bool)
    if stage.camera is not None:
        cosine = facing(view.points, view.normals, stage.camera.matrix[:3, 3])
        gone |= cosine < rng.normal(0.12, 0.03, size=cosine.shape)
    observed = clean + rng.normal(scale=stage.noise, size=clean.shape)
    observed[gone] = np.nan
    shown = frames if trial.shown is None else trial.shown
    kept = observed[:shown].astype(np.float32).astype(np.float64)
    times = trial.start + stage.times
    return Trial(
        name=trial.name,
        role="fit" if trial.shown is None else "predict",
        times=times[:shown],
        points=kept if stage.camera is None else None,
        pixels=None if stage.camera is None else kept,
        object_index=np.zeros(count, dtype=np.int64),
        rest_points=stage.rest,
        predict_times=None if trial.shown is None else times[shown:],
    )


def _trial_truth(stage: _Stage, trial: _Throw, view: _Seen, hidden: Sequence[_Hidden]) -> TrialTruth:
    active = np.zeros(len(stage.times), dtype=bool)
    for item in hidden:
        active |= _active(item.cause, view.motion, stage.times)
    if trial.shown is None:
        return TrialTruth(points=view.points, active=active)
    shown = trial.shown
    return TrialTruth(
        points=view.points[:shown],
        active=active[:shown],
        withheld=view.points[shown:],
        withheld_active=active[shown:],
    )


def _active(cause: Cause, motion: Motion, times: Array) -> NDArray[np.bool_]:
    frames = len(times)
    if cause.active == "always":
        return np.ones(frames, dtype=bool)
    if cause.active == "window":
        half = (times[1] - times[0]) / 2
        return np.asarray((times + half >= cause.window[0]) & (times - half <= cause.window[1]))
    if cause.active == "push":
        size = np.linalg.norm(motion.push, axis=1)
        return np.asarray(size > 0.1 * max(float(size.max()), 1e-12))
    if cause.active == "rolling":
        moved = np.linalg.norm(np.gradient(motion.position[:, :2], times, axis=0), axis=1) > 0.02
        return _closed(motion.touched & moved)
    if cause.active in ("slid", "turned"):
        return _closed(motion.slid if cause.active == "slid" else motion.turned)
    return {"touched": motion.touched, "struck": motion.struck, "pulled": motion.pulled}[cause.active]


def _closed(flags: NDArray[np.bool_], gap: int = 2) -> NDArray[np.bool_]:
    """Return ``flags`` with gaps of up to ``gap`` frames closed: a body on its edges briefly leaves the ground."""
    return binary_closing(np.pad(flags, gap), np.ones(gap + 1, dtype=bool))[gap:-gap]


def _oracle(stage: _Stage, hidden: Sequence[_Hidden], seen: Sequence[_Seen], rng: np.random.Generator) -> float:
    """Return the error on withheld frames caused by the uncertainty of the state from the shown ones."""
    body, count = stage.world.body, max(4, len(stage.rest))
    noise = stage.noise if stage.camera is None else stage.noise * 2.3 / stage.camera.fx
    some = [i for i, trial in enumerate(stage.trials) if trial.shown is not None]
    errors = []
    for _ in range(2):
        states = []
        for trial in stage.trials:
            shown = trial.shown or 30
            span = stage.times[shown]
            place = 2 * noise / math.sqrt(count * shown)
            speed = noise * math.sqrt(12 / (count * shown)) / span
            s = trial.state
            spin = rng.normal(scale=speed / (0.7 * body.size), size=3)
            states.append(
                dataclasses.replace(
                    s,
                    position=s.position + _above(s, rng.normal(scale=place, size=3)),
                    velocity=s.velocity + rng.normal(scale=speed, size=3) * (1, 1, 0 if s.velocity[2] == 0 else 1),
                    spin=s.spin + spin,
                )
            )
        part = dataclasses.replace(stage, trials=tuple(stage.trials[i] for i in some))
        for i, view in zip(some, _observe(part, hidden, [states[j] for j in some]), strict=True):
            shown = stage.trials[i].shown or 0
            errors.append(np.mean(np.sum((view.points - seen[i].points)[shown:] ** 2, axis=2)))
    return float(np.sqrt(np.mean(errors)))


def _above(state: State, shift: Array) -> Array:
    """Return ``shift`` without its vertical part for a body at rest on the ground."""
    return shift * (1, 1, 0) if state.velocity[2] == 0 and state.position[2] < 0.1 else shift
