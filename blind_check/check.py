# SPDX-License-Identifier: MIT
"""The blind check: captures are generated, labels sealed, another process diagnoses, then the score is counted."""

from __future__ import annotations

import hashlib
import math
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..sim.app.stage_process import own_command, run_stage
from ..sim.atomic import write_json
from ..sim.diagnose.capture_folder import save_capture
from ..sim.diagnose.diagnosis import UNKNOWN
from ..sim.effects.registry import effect
from ..sim.errors import Cancelled, InputError, PhysGenError, SimulationError
from ..sim.events import IsCancelled, OnEvent, StageProgress
from . import rigid_causes, soft_causes
from .case import BlindCase, Seal, break_seal, keep_memory_private, publish, seal
from .mujoco_world import load_mujoco
from .rigid_cases import rigid_case
from .scoring import Arrays, BlindScore, score_report, total_score
from .soft_cases import soft_case

LEAST_CASES = 4
MOST_CASES = 1000
NONE_SHARE, UNKNOWN_SHARE, TWO_SHARE, SOFT_SHARE = 1 / 5, 1 / 7, 1 / 10, 1 / 4

_SAME_TRACE = ({"air_drag", "wind"}, {"buoyancy", "time_scale"}, {"restitution", "adhesion"})
"""Pairs that no recording of one body can distinguish, so they are no two simultaneous causes."""


@dataclass(frozen=True, kw_only=True)
class PlannedCase:
    """A planned case. matter: ``rigid`` or ``soft``. effects: () for none; ``unknown``: outside the vocabulary."""

    matter: str
    effects: tuple[str, ...]


def plan_cases(count: int, rng: np.random.Generator, *, two_share: float = TWO_SHARE) -> tuple[PlannedCase, ...]:
    """Return ``count`` cases in random order.

    At least a fifth ``none``, a seventh ``unknown``, about ``two_share`` (0 to 0.5) two causes and a quarter soft; the
    rest cycles through all effects. Raises InputError for fewer than ``LEAST_CASES`` or more than ``MOST_CASES``.
    """
    if not LEAST_CASES <= count <= MOST_CASES:
        raise InputError(f"cases is {count}: give {LEAST_CASES} to {MOST_CASES}, so that every kind of case occurs")
    if not 0 <= two_share <= 0.5:
        raise InputError(f"the share of two causes is {two_share}: give 0 to 0.5")
    none, unknown = math.ceil(count * NONE_SHARE), math.ceil(count * UNKNOWN_SHARE)
    two = max(1, math.floor(count * two_share))
    single = count - none - unknown - two
    soft = round(count * SOFT_SHARE)
    # Soft bodies get their share of each kind; cases of two causes are rigid.
    soft_none, soft_unknown = round(none * SOFT_SHARE), round(unknown * SOFT_SHARE)
    soft_single = min(max(soft - soft_none - soft_unknown, 0), single)
    cases = [_case("soft" if i < soft_none else "rigid") for i in range(none)]
    cases += [_case("soft" if i < soft_unknown else "rigid", UNKNOWN) for i in range(unknown)]
    cases += [_case("rigid", *_pair(rng)) for _ in range(two)]
    cases += [_case("soft", e) for e in _round(list(soft_causes.KNOWN_CAUSES), soft_single, rng)]
    cases += [_case("rigid", e) for e in _round(list(rigid_causes.KNOWN_CAUSES), single - soft_single, rng)]
    return tuple(cases[i] for i in rng.permutation(count))


def _case(matter: str, *effects: str) -> PlannedCase:
    return PlannedCase(matter=matter, effects=effects)


def _round(names: list[str], count: int, rng: np.random.Generator) -> list[str]:
    """Return ``count`` of ``names``, each equally often up to one, chosen at random."""
    out: list[str] = []
    while len(out) < count:
        out += [names[i] for i in rng.permutation(len(names))]
    return out[:count]


def _pair(rng: np.random.Generator) -> tuple[str, str]:
    names = [n for n in rigid_causes.KNOWN_CAUSES if n != "camera_pose"]
    while True:
        first, second = (names[i] for i in rng.permutation(len(names))[:2])
        if effect(first).kind != effect(second).kind and {first, second} not in _SAME_TRACE:
            return first, second


Diagnose = Callable[[Path, Path], Sequence[str]]
"""(capture folder, report folder) → diagnosis command."""

MakeCase = Callable[[PlannedCase, np.random.Generator, IsCancelled], BlindCase]

SEED_BITS = 63
LABELS_FILE, SEALED_FILE, SCORE_FILE = "labels.json", "labels.sealed", "score.json"
_SAME_TIME = 946684800
"""Modification time of every capture file, 2000-01-01, so that it does not reveal their order."""


@dataclass(frozen=True, kw_only=True)
class BlindCheckOptions:
    """Options of a blind check. cases: 4 to 1000. seed: 0 to 2**63 - 1, None for a fresh one.

    budget: passed to ``diagnose``, such as ``5min``. out: new folder for captures, reports, labels and score; None:
    nothing is kept. diagnose: None for this program's own ``physgen diagnose``.
    """

    cases: int = 30
    seed: int | None = None
    budget: str | None = None
    out: Path | None = None
    diagnose: Diagnose | None = None

    def __post_init__(self) -> None:
        if self.seed is not None and not 0 <= self.seed < 2**SEED_BITS:
            raise InputError(f"seed is {self.seed}: give 0 to {2**SEED_BITS - 1}, or leave it out for a fresh one")
        if self.out is not None and self.out.exists():
            raise InputError(f"{self.out}: already exists; choose another folder")


def own_diagnosis(budget: str | None) -> Diagnose:
    """Return the command line of ``physgen diagnose``, started in the folder of the captures."""

    def command(capture: Path, report: Path) -> list[str]:
        words = ["diagnose", str(capture), "--out", str(report), "--json", *(["--budget", budget] if budget else [])]
        # Where its captures are, away from the labels.
        return own_command("batch.cli", *words, folder=capture.parent)

    return command


def make_case(planned: PlannedCase, rng: np.random.Generator, cancelled: IsCancelled) -> BlindCase:
    """Return the planned case, drawn with ``rng``. Raises what the generators raise."""
    maker = rigid_case if planned.matter == "rigid" else soft_case
    return maker(planned.effects, rng, cancelled)


def make_any(
    item: PlannedCase, seed: Sequence[int], cancelled: IsCancelled, make: MakeCase = make_case, attempts: int = 4
) -> BlindCase:
    """Return the planned case from the first of ``attempts`` draws that makes its effects visible.

    Raises SimulationError where none does.
    """
    for attempt in range(attempts):
        try:
            return make(item, np.random.default_rng([*seed, attempt]), cancelled)
        except SimulationError:
            if attempt == attempts - 1:
                raise
    raise AssertionError


def blind_check(
    options: BlindCheckOptions, on_event: OnEvent, cancelled: IsCancelled, *, make: MakeCase = make_case
) -> BlindScore:
    """Generate ``options.cases`` captures, have another process diagnose them without their labels; return the score.

    A diagnosis that fails counts as a case without a report. Raises InputError without MuJoCo or for a bad option,
    SimulationError when a case cannot be made, Cancelled.
    """
    if make is make_case:
        load_mujoco()
    keep_memory_private()
    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    diagnose = options.diagnose or own_diagnosis(options.budget)
    # Two unrelated folders: the one that the diagnosis sees, and the one with the labels.
    with tempfile.TemporaryDirectory() as shown, tempfile.TemporaryDirectory() as hidden:
        place = Path(shown).resolve()
        truths, sealed = _prepare(options, seed, place, Path(hidden) / SEALED_FILE, on_event, cancelled, make)
        on_event({"event": "notice", "stage": "seal", "message": f"SHA-256 of salt and labels: {sealed.digest}"})
        outcomes = _diagnose_all(place, diagnose, on_event, cancelled)
        labels = break_seal(sealed)
        rows = []
        for name, (seconds, note) in outcomes.items():
            arrays = truths[name]
            if _arrays_digest(arrays) != labels[name]["arrays"]:
                raise InputError(f"{name}: its true motion differs from the sealed one")
            rows.append(score_report(name, place / "reports" / name, labels[name], arrays, seconds, note))
        score = total_score(rows, seed=seed, digest=sealed.digest)
        if options.out is not None:
            _keep(options.out, place, sealed, labels, truths, score)
    return score


def _prepare(
    options: BlindCheckOptions,
    seed: int,
    place: Path,
    sealed_path: Path,
    on_event: OnEvent,
    cancelled: IsCancelled,
    make: MakeCase,
) -> tuple[dict[str, Arrays], Seal]:
    """Write the captures below ``place`` and seal their labels; return the true arrays, kept in memory only."""
    planned = plan_cases(options.cases, np.random.default_rng([seed, 0]))
    progress = StageProgress(on_event, "generate", len(planned))
    truths: dict[str, Arrays] = {}
    labels = {}
    for index, item in enumerate(planned):
        if cancelled():
            raise Cancelled("cancelled while the captures were made")
        case = make_any(item, [seed, 1, index], cancelled, make)
        name = f"case-{index + 1:03d}"
        truths[name] = case.truth.arrays()
        labels[name] = {**case.truth.label(), "arrays": _arrays_digest(truths[name])}
        save_capture(case.capture, place / "captures" / name)
        progress.report(index + 1)
    for path in sorted((place / "captures").rglob("*")):
        os.utime(path, (_SAME_TIME, _SAME_TIME))
    return truths, seal(labels, sealed_path)


def _diagnose_all(
    place: Path, diagnose: Diagnose, on_event: OnEvent, cancelled: IsCancelled
) -> dict[str, tuple[float, str]]:
    """Return seconds and error note by case."""
    names = sorted(p.name for p in (place / "captures").iterdir())
    (place / "reports").mkdir()
    progress = StageProgress(on_event, "diagnose", len(names))
    outcomes = {}
    for index, name in enumerate(names):
        if cancelled():
            raise Cancelled("cancelled while diagnosing; the labels stay sealed")
        started, note = time.perf_counter(), ""
        try:
            # Its events would bury the check's own progress.
            run_stage(diagnose(place / "captures" / name, place / "reports" / name), lambda event: None, cancelled)
        except Cancelled:
            raise
        except PhysGenError as error:
            note = f"diagnosis failed: {str(error).strip().splitlines()[-1] if str(error).strip() else error!r}"
        outcomes[name] = (time.perf_counter() - started, note)
        progress.report(index + 1, name)
    return outcomes


def _arrays_digest(arrays: Arrays) -> str:
    """Return the hex SHA-256 of names, shapes, types and bytes, sorted by name."""
    sha = hashlib.sha256()
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        sha.update(f"{key} {array.dtype.str} {array.shape}\n".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()


def _keep(
    out: Path,
    place: Path,
    sealed: Seal,
    labels: dict[str, dict[str, object]],
    truths: dict[str, Arrays],
    score: BlindScore,
) -> None:
    """Write everything to the new folder ``out``, with ground truth in the format of development captures."""
    out.mkdir(parents=True)
    for part in ("captures", "reports"):
        shutil.copytree(place / part, out / part)
    publish(sealed, labels, out / LABELS_FILE)
    (out / "truth").mkdir()
    for name, arrays in truths.items():
        write_json(out / "truth" / f"{name}.json", labels[name])
        np.savez_compressed(out / "truth" / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    write_json(out / SCORE_FILE, score.to_json())
