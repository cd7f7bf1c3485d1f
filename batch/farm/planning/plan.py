# SPDX-License-Identifier: GPL-3.0-or-later
"""Tasks, plans and outcomes; plans as files for schedulers that start each task alone (docs/file-formats.md)."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ....physgen_addon.render.render_options import flagged_fields
from ....sim.atomic import write_bytes
from ....sim.errors import InputError
from ....sim.scene.folder import inside
from ....sim.validation import MAX_JSON_BYTES, parse, read_json

STAGES = ("reconstruct", "variant", "bake", "render", "encode")
"""In the order of a variant's tasks; all but the first run once per variant."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One run of the ``physgen`` command.

    id: unique within its plan, such as ``cup/soft-1/render-0013-0024``; also names its log.
    stage: one of ``STAGES``.
    argv: arguments of ``physgen``, without the interpreter: ``("bake", "cup/scene", "--out", …)``, with paths relative
        to the plan's root, which is the working folder.
    needs: ids of its dependencies.
    inputs: files and folders, relative to the root, whose content the result depends on.
    produces: files, relative to the root, that exist when it is done.
    slots: resources that it occupies while it runs, by name: ``{"gpu": 1}``.
    farm_folder: folder of its record and log, relative to the root, in the job's results.
    """

    id: str
    stage: str
    argv: tuple[str, ...]
    needs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    produces: tuple[str, ...] = ()
    slots: Mapping[str, int] = field(default_factory=dict)
    farm_folder: str = ".farm"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All tasks of a job file, dependencies first.

    name: of the job. root: absolute folder that all paths are relative to. version: of the program that planned it.
    out: folder of the results, relative to the root.
    meanings: description of each variant by the prefix of its tasks' ids: ``cup/soft-1``.
    """

    name: str
    root: Path
    version: str
    tasks: tuple[Task, ...]
    out: str = "."
    meanings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """End of a task.

    state: ``done``; ``kept``, if it was up to date; ``failed``; ``skipped``, because a dependency failed;
        ``cancelled``.
    exit_code: of the command (docs/cli.md); 0 if none ran.
    message: of the error.
    seconds, cpu_seconds: of its last attempt.
    attempts: number of starts.
    worker: readable name of where it ran.
    """

    task: str
    state: str
    exit_code: int = 0
    message: str = ""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    attempts: int = 0
    worker: str = ""


RETRIES = 2
"""Default number of restarts of a task."""

WRONG_USAGE = 2
PERMANENT_EXIT_CODES = (WRONG_USAGE, InputError.exit_code)
"""Exit codes that would repeat with the same arguments and files."""


def is_worth_retrying(outcome: Outcome, *, attempts: int, retries: int = RETRIES) -> bool:
    """Return whether to restart a task that ended with ``outcome`` after ``attempts`` starts.

    A task that was killed, or failed for another reason than a usage error or bad input, may succeed the next time: it
    ran out of memory, a driver crashed, a machine failed.
    """
    return outcome.state == "failed" and outcome.exit_code not in PERMANENT_EXIT_CODES and attempts <= retries


PLAN_FORMAT = "physgen-plan/1"
MOST_TASKS = 50_000
MOST_ARGUMENTS = 20_000
MOST_SLOTS = 1000
NAME = re.compile(r"[\w .+@-]{1,200}")
"""One part of a task's id, which also names files."""


@dataclass(frozen=True, kw_only=True)
class _Slot:
    name: str
    count: int


@dataclass(frozen=True, kw_only=True)
class _Meaning:
    variant: str
    text: str


@dataclass(frozen=True, kw_only=True)
class _FileTask:
    """``Task`` in the file: mappings are lists."""

    id: str
    stage: str
    argv: tuple[str, ...]
    needs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    produces: tuple[str, ...] = ()
    slots: tuple[_Slot, ...] = ()
    farm_folder: str = ".farm"


@dataclass(frozen=True, kw_only=True)
class _FilePlan:
    name: str
    root: str
    version: str
    tasks: tuple[_FileTask, ...]
    out: str = "."
    meanings: tuple[_Meaning, ...] = ()


def save_plan(plan: Plan) -> Path:
    """Write ``plan`` below its root, beside its records, under a name from its content hash; return the file.

    A different plan gets another file, so plans already queued stay unchanged. The root is stored relative to the file:
    a machine that mounts the folder elsewhere reads the same plan. Raises InputError when it cannot be written, or when
    ``load_plan`` would refuse it.
    """
    folder = plan.root / (plan.tasks[0].farm_folder if plan.tasks else ".farm") / "plans"
    data = {"format": PLAN_FORMAT, **_to_json(plan, os.path.relpath(plan.root, folder))}
    content = (json.dumps(data, indent=1, ensure_ascii=False) + "\n").encode()
    path = folder / f"{hashlib.sha256(content).hexdigest()[:16]}.json"
    if len(content) > MAX_JSON_BYTES:
        raise InputError(f"{plan.name}: {len(plan.tasks)} tasks are too many for one plan; split the job")
    _parse_plan(data, path)
    if not path.is_file():
        write_bytes(path, content)
    return path


def load_plan(path: Path) -> Plan:
    """Return the plan at ``path``. Raises InputError with field and value for anything ``save_plan`` would not write.

    Files of a task are inside the root, and the root is a parent folder of the file.
    """
    return _parse_plan(read_json(path), path)


def find_task(plan: Plan, name: str) -> Task:
    """Return the task of ``plan`` with the id ``name``. Raises InputError if there is none."""
    found = next((task for task in plan.tasks if task.id == name), None)
    if found is None:
        raise InputError(f"{plan.name}: has no task {name!r}; it has {plan.tasks[0].id if plan.tasks else 'none'} …")
    return found


def _to_json(plan: Plan, root: str) -> dict[str, Any]:
    tasks = [
        {
            "id": task.id,
            "stage": task.stage,
            "argv": list(task.argv),
            "needs": list(task.needs),
            "inputs": list(task.inputs),
            "produces": list(task.produces),
            "slots": [{"name": name, "count": count} for name, count in sorted(task.slots.items())],
            "farm_folder": task.farm_folder,
        }
        for task in plan.tasks
    ]
    return {
        "name": plan.name,
        "root": Path(root).as_posix(),
        "version": plan.version,
        "out": plan.out,
        "meanings": [{"variant": key, "text": text} for key, text in plan.meanings.items()],
        "tasks": tasks,
    }


def _parse_plan(data: Any, path: Path) -> Plan:
    if not isinstance(data, dict) or data.get("format") != PLAN_FORMAT:
        raise InputError(f"{path}: not a plan of format {PLAN_FORMAT!r}; export it again with this version")
    file = parse(_FilePlan, {key: value for key, value in data.items() if key != "format"}, str(path))
    if len(file.tasks) > MOST_TASKS:
        raise InputError(f"{path}: has {len(file.tasks)} tasks, {MOST_TASKS} is the limit; split the job")
    if not file.name.isprintable() or not 0 < len(file.name) <= 200:
        raise InputError(f"{path}.name: is {file.name[:60]!r}; expected 1 to 200 printable characters")
    _check_inside(file.out, f"{path}.out")
    root = _root(file.root, path)
    seen: set[str] = set()
    for index, task in enumerate(file.tasks):
        _check_task(task, seen, root, f"{path}.tasks[{index}]")
        seen.add(task.id)
    return Plan(
        name=file.name,
        root=root,
        version=file.version,
        tasks=tuple(_from_file(task) for task in file.tasks),
        out=file.out,
        meanings={meaning.variant: meaning.text for meaning in file.meanings},
    )


def _from_file(task: _FileTask) -> Task:
    return Task(
        id=task.id,
        stage=task.stage,
        argv=task.argv,
        needs=task.needs,
        inputs=task.inputs,
        produces=task.produces,
        slots={slot.name: slot.count for slot in task.slots},
        farm_folder=task.farm_folder,
    )


def _root(text: str, path: Path) -> Path:
    """Return the folder ``text`` relative to the file at ``path``; upwards only."""
    parts = text.split("/")
    if len(parts) > 32 or (set(parts) != {".."} and parts != ["."]):
        raise InputError(
            f"{path}.root: is {text[:60]!r}; expected '../..', one for each folder between the file and the root"
        )
    return Path(os.path.normpath(path.absolute().parent / text))


def _check_task(task: _FileTask, seen: set[str], root: Path, where: str) -> None:
    if task.stage not in STAGES:
        raise InputError(f"{where}.stage: is {task.stage[:60]!r}; known are {', '.join(STAGES)}")
    for part in task.id.split("/"):
        _check_name(part, f"{where}.id")
    if task.id in seen:
        raise InputError(f"{where}.id: {task.id!r} is used twice; every task needs a unique id")
    missing = [name for name in task.needs if name not in seen]
    if missing:
        raise InputError(f"{where}.needs: {missing[0][:60]!r} is not an earlier task; dependencies come first")
    if not task.argv or len(task.argv) > MOST_ARGUMENTS or any("\0" in word for word in task.argv):
        raise InputError(f"{where}.argv: expected 1 to {MOST_ARGUMENTS} arguments without zero bytes")
    _check_command(task, root, f"{where}.argv")
    for names in ("inputs", "produces"):
        for name in getattr(task, names):
            _check_inside(name, f"{where}.{names}")
    _check_inside(task.farm_folder, f"{where}.farm_folder")
    for slot in task.slots:
        _check_name(slot.name, f"{where}.slots")
        if not 0 < slot.count <= MOST_SLOTS:
            raise InputError(f"{where}.slots: {slot.name} is {slot.count}; expected 1 to {MOST_SLOTS}")


_RENDER_FLAGS = [word for _, flag, _ in flagged_fields() for word in (flag, f"--no-{flag[2:]}")]
FLAGS: Mapping[str, frozenset[str]] = {
    "reconstruct": frozenset(("--out", "--box", "--name", "--size", "--horizon", "--pitch", "--fov")),
    "variant": frozenset(("--out", "--preset", "--velocity", "--spin", "--set", "--effects-json")),
    "bake": frozenset(
        ("--out", "--frames", "--fps", "--quality", "--arch", "--seed", "--slow", "--no-points", "--no-implicit")
    ),
    "render": frozenset(("--out", "--bake", "--frames", *_RENDER_FLAGS)),
    "encode": frozenset(("--out", "--fps")),
    "effects": frozenset(),
}
"""Flags of a plan's commands, by verb: those that ``make_plan`` writes. None starts a program or contacts a host."""


def _check_command(task: _FileTask, root: Path, where: str) -> None:
    """Raise InputError unless the command is one that a plan of ours may have, on files below ``root``.

    A plan is a file, and may be a stranger's: with any flag of ``physgen`` it could run adapters or send photos.
    """
    verb, *words = task.argv
    if verb not in (task.stage, "effects"):
        raise InputError(f"{where}: runs {verb[:60]!r} as {task.stage}; export the plan again with this version")
    for word in words:
        flag, equals, value = word.partition("=")
        if word.startswith("-") and not re.fullmatch(r"-[\d.,eE+-]+", word):
            if flag not in FLAGS[verb]:
                raise InputError(f"{where}: {flag[:60]!r} is no flag of a plan's {verb}; export the plan again")
            if flag not in ("--out", "--bake", "--camera") or not equals:
                continue
            word = value
        try:
            inside(root, word)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None


def _check_name(text: str, where: str) -> None:
    if not NAME.fullmatch(text) or text in (".", "..") or text != text.strip():
        raise InputError(f"{where}: {text[:60]!r} is not a valid name; use letters, digits, spaces and . _ - + @")


def _check_inside(text: str, where: str) -> None:
    """Raise InputError unless ``text`` is a relative path that stays inside the root, on every system."""
    parts = text.split("/")
    if not text or "\\" in text or ":" in parts[0] or "\0" in text or text.startswith("/") or ".." in parts:
        raise InputError(f"{where}: {text[:60]!r} leads out of the job's folder; give it relative to that, with /")
