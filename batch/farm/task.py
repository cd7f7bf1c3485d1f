# SPDX-License-Identifier: GPL-3.0-or-later
"""What a farm carries out: tasks, which are plain argument vectors with the files that they must leave behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

STAGES = ("reconstruct", "variant", "bake", "render", "encode")
"""In the order in which a variant goes through them; all but the first exist once a variant."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One run of the ``physgen`` command.

    id: unique within its plan, such as ``cup/soft-1/render-0013-0024``; also names its log.
    stage: one of ``STAGES``.
    argv: arguments of ``physgen``, without the interpreter: ``("bake", "cup/scene", "--out", …)``. Paths in it are
        relative to the plan's root, which is the folder that the task runs in.
    needs: ids of tasks that have to be done before.
    inputs: files and folders, relative to the root, whose content its result depends on.
    produces: files, relative to the root, that exist when it is done.
    slots: resources that it takes while it runs, by name: ``{"gpu": 1}``.
    farm_folder: where its record and its log are kept, relative to the root; that of the job's results.
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
    """All tasks of a job file, those that others need first.

    name: of the job. root: absolute folder that all paths are relative to. version: of the program that planned it.
    out: folder of the results, relative to the root.
    meanings: what each variant is, for people, by the beginning of its tasks' ids: ``cup/soft-1``.
    """

    name: str
    root: Path
    version: str
    tasks: tuple[Task, ...]
    out: str = "."
    meanings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a task ended.

    state: ``done``; ``kept``, when it was done before with the same content; ``failed``; ``skipped``, because a task
        that it needs has failed; ``cancelled``.
    exit_code: of the command (docs/cli.md); 0 where none ran.
    message: of the error, for people.
    seconds, cpu_seconds: that it took, of its last attempt.
    attempts: how often it was started.
    worker: where it ran, for people.
    """

    task: str
    state: str
    exit_code: int = 0
    message: str = ""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    attempts: int = 0
    worker: str = ""
