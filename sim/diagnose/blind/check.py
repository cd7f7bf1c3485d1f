# SPDX-License-Identifier: MIT
"""The check: captures are made, labels sealed, another process diagnoses, the seal is broken and the score counted."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...app.process import own_command, run_stage
from ...atomic import write_json
from ...errors import Cancelled, InputError, PhysGenError, SimulationError
from ...events import IsCancelled, OnEvent, StageProgress
from ..capture import save_capture
from .case import BlindCase
from .plan import PlannedCase, plan_cases
from .rigid_cases import rigid_case
from .rigid_world import load_mujoco
from .score import Arrays, BlindScore, score_report, total
from .seal import Seal, break_seal, keep_memory_private, publish, seal
from .soft_cases import soft_case

Diagnose = Callable[[Path, Path], Sequence[str]]
"""(capture folder, report folder) → command that diagnoses."""

MakeCase = Callable[[PlannedCase, np.random.Generator, IsCancelled], BlindCase]

SEED_BITS = 63
LABELS_FILE, SEALED_FILE, SCORE_FILE = "labels.json", "labels.sealed", "score.json"
_SAME_TIME = 946684800
"""Every file of every capture gets this time, 2000-01-01: nothing tells in which order they were made."""


@dataclass(frozen=True, kw_only=True)
class BlindCheckOptions:
    """cases: 4 to 1000. seed: 0 to 2**63 - 1, None for a fresh one.

    budget: passed on to ``diagnose``, such as ``5min``.
    out: a new folder that keeps captures, reports, labels and score; None keeps nothing. diagnose: None for this
    program's own ``physgen diagnose``.
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
            raise InputError(f"{self.out}: is there already; choose another folder")


def own_diagnosis(budget: str | None) -> Diagnose:
    """The command line of ``physgen diagnose``, started in the folder of the captures."""

    def command(capture: Path, report: Path) -> list[str]:
        words = ["diagnose", str(capture), "--out", str(report), "--json", *(["--budget", budget] if budget else [])]
        # Where its captures lie, and nowhere near the labels.
        return own_command("batch.cli", *words, folder=capture.parent)

    return command


def make_case(planned: PlannedCase, rng: np.random.Generator, cancelled: IsCancelled) -> BlindCase:
    """The planned case, drawn with ``rng``. Raises what the generators raise."""
    maker = rigid_case if planned.matter == "rigid" else soft_case
    return maker(planned.effects, rng, cancelled)


def blind_check(
    options: BlindCheckOptions, on_event: OnEvent, cancelled: IsCancelled, *, make: MakeCase = make_case
) -> BlindScore:
    """Make ``options.cases`` captures, have them diagnosed by another process without their labels, and score it.

    A diagnosis that fails counts as a case without a report. Raises InputError without MuJoCo or for a bad option,
    SimulationError when a case cannot be made, Cancelled.
    """
    if make is make_case:
        load_mujoco()
    keep_memory_private()
    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    diagnose = options.diagnose or own_diagnosis(options.budget)
    # Two folders that have nothing in common: what the diagnosis is told of, and where the labels wait.
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
                raise InputError(f"{name}: its true motion is not the one that was sealed")
            rows.append(score_report(name, place / "reports" / name, labels[name], arrays, seconds, note))
        score = total(rows, seed=seed, digest=sealed.digest)
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
    """Write the captures below ``place`` and seal their labels; the true arrays stay in memory."""
    planned = plan_cases(options.cases, np.random.default_rng([seed, 0]))
    progress = StageProgress(on_event, "generate", len(planned))
    truths: dict[str, Arrays] = {}
    labels = {}
    for index, item in enumerate(planned):
        if cancelled():
            raise Cancelled("cancelled while the captures were made")
        case = _made(item, seed, index, cancelled, make)
        name = f"case-{index + 1:03d}"
        truths[name] = case.truth.arrays()
        labels[name] = {**case.truth.label(), "arrays": _arrays_digest(truths[name])}
        save_capture(case.capture, place / "captures" / name)
        progress.report(index + 1)
    for path in sorted((place / "captures").rglob("*")):
        os.utime(path, (_SAME_TIME, _SAME_TIME))
    return truths, seal(labels, sealed_path)


def _made(
    item: PlannedCase, seed: int, index: int, cancelled: IsCancelled, make: MakeCase, attempts: int = 4
) -> BlindCase:
    for attempt in range(attempts):
        try:
            return make(item, np.random.default_rng([seed, 1, index, attempt]), cancelled)
        except SimulationError:
            if attempt == attempts - 1:
                raise
    raise AssertionError


def _diagnose_all(
    place: Path, diagnose: Diagnose, on_event: OnEvent, cancelled: IsCancelled
) -> dict[str, tuple[float, str]]:
    """Seconds and what went wrong, by case."""
    names = sorted(p.name for p in (place / "captures").iterdir())
    (place / "reports").mkdir()
    progress = StageProgress(on_event, "diagnose", len(names))
    outcomes = {}
    for index, name in enumerate(names):
        if cancelled():
            raise Cancelled("cancelled while diagnosing; the labels stay sealed")
        started, note = time.perf_counter(), ""
        try:
            # Its events say nothing about the labels, but would bury the check's own progress.
            run_stage(diagnose(place / "captures" / name, place / "reports" / name), lambda event: None, cancelled)
        except Cancelled:
            raise
        except PhysGenError as error:
            note = f"diagnosis failed: {str(error).strip().splitlines()[-1] if str(error).strip() else error!r}"
        outcomes[name] = (time.perf_counter() - started, note)
        progress.report(index + 1, name)
    return outcomes


def _arrays_digest(arrays: Arrays) -> str:
    """Hex SHA-256 of names, shapes, types and bytes, in the order of the names."""
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
    """Everything into the new folder ``out``, with the truth as development captures have it."""
    out.mkdir(parents=True)
    for part in ("captures", "reports"):
        shutil.copytree(place / part, out / part)
    publish(sealed, labels, out / LABELS_FILE)
    (out / "truth").mkdir()
    for name, arrays in truths.items():
        write_json(out / "truth" / f"{name}.json", labels[name])
        np.savez_compressed(out / "truth" / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    write_json(out / SCORE_FILE, score.to_json())
