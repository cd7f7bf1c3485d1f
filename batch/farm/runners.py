# SPDX-License-Identifier: GPL-3.0-or-later
"""Runners and exporters of a plan, one line each, and the options they take.

A runner reports by events: ``{"event": "task", "state": "started", "task", "stage", "worker", "attempt"}`` when a task
begins, ``{"event": "task", **fields of its Outcome}`` when it has ended for good, ``notice`` for a retry, and the
events of the commands themselves, with ``task``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from .planning.plan import RETRIES, Outcome, Plan, Task

MOST_CORES = 1024
_WORD = re.compile(r"[\w.,+@:-]{0,200}", re.ASCII)
_WALLTIME = re.compile(r"|(\d{1,3}-)?\d{1,4}(:\d{1,2}){0,2}", re.ASCII)
_MEMORY = re.compile(r"|[1-9]\d{0,8}[KMGT]?", re.ASCII)
_SBATCH = re.compile(r"--[a-z][a-z-]{1,40}(=[\w.,:+@%/&|*-]{1,500})?", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Machines that run a plan.

    tls_ca, tls_cert, tls_key: PEM files of a Dask farm with TLS: its authority, and this machine's certificate and key.
    trust_network: whether a Dask scheduler on another machine may be used without TLS.
    queue, account: SLURM's partition and account; empty: the cluster's default.
    walltime: time limit of a task in SLURM's format, ``4:00:00`` or ``1-12``; empty: the default.
    memory: per task, such as ``8G``; empty: the default.
    cores: CPU cores per task, 1 to 1024.
    sbatch: further options of sbatch, such as ``--qos=high``.
    python: interpreter with PhysGen on those machines.
    """

    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    trust_network: bool = False
    queue: str = ""
    account: str = ""
    walltime: str = ""
    memory: str = ""
    cores: int = 4
    sbatch: tuple[str, ...] = ()
    python: str = sys.executable

    def __post_init__(self) -> None:
        # These end up in scripts.
        for name, pattern, example in (
            ("queue", _WORD, "short"),
            ("account", _WORD, "lab"),
            ("walltime", _WALLTIME, "4:00:00"),
            ("memory", _MEMORY, "8G"),
        ):
            if not pattern.fullmatch(getattr(self, name)):
                raise InputError(f"--{name} is {getattr(self, name)!r}: write it as {example}")
        for text in self.sbatch:
            if not _SBATCH.fullmatch(text):
                raise InputError(f"--sbatch is {text!r}: write a long option of sbatch, such as --qos=high")
        if not 1 <= self.cores <= MOST_CORES:
            raise InputError(f"--cores is {self.cores}: give 1 to {MOST_CORES}")
        if not self.python or not self.python.isprintable():
            raise InputError(f"--machine-python is {self.python!r}: give the path of an interpreter")


def add_cluster_options(parser: argparse.ArgumentParser) -> None:
    """Add the flags that ``cluster_options`` reads."""
    group = parser.add_argument_group("other machines")
    group.add_argument("--tls-ca", type=Path, metavar="PEM", help="certificate authority of a farm at tls://…")
    group.add_argument("--tls-cert", type=Path, metavar="PEM", help="this machine's certificate there")
    group.add_argument("--tls-key", type=Path, metavar="PEM", help="key of that certificate")
    trust = "use a Dask scheduler on another machine without TLS: anyone who reaches it can run commands as you"
    group.add_argument("--trust-network", action="store_true", help=trust)
    group.add_argument("--queue", default="", help="SLURM: partition")
    group.add_argument("--account", default="", help="SLURM: account")
    group.add_argument("--walltime", default="", metavar="D-H:MM:SS", help="SLURM: time limit of a task")
    group.add_argument("--memory", default="", metavar="SIZE", help="SLURM: memory per task, such as 8G")
    group.add_argument("--cores", type=int, default=4, help="SLURM: CPU cores per task (default %(default)s)")
    further = "SLURM: another sbatch option, such as --sbatch=--qos=high; may be repeated"
    group.add_argument("--sbatch", action="append", default=[], metavar="OPTION", help=further)
    python = "interpreter with PhysGen on the machines of SLURM or Flamenco (default: this one)"
    group.add_argument("--machine-python", default=sys.executable, metavar="PATH", help=python)


def cluster_options(options: argparse.Namespace) -> ClusterOptions:
    """Return the options given. Raises InputError for unusable values."""
    return ClusterOptions(
        tls_ca=options.tls_ca,
        tls_cert=options.tls_cert,
        tls_key=options.tls_key,
        trust_network=options.trust_network,
        queue=options.queue,
        account=options.account,
        walltime=options.walltime,
        memory=options.memory,
        cores=options.cores,
        sbatch=tuple(options.sbatch),
        python=options.machine_python,
    )


MOST_WORKERS = 1024
MOST_RETRIES = 100


@dataclass(frozen=True, kw_only=True)
class FarmOptions:
    """Options of running a plan.

    farm: ``local``, ``dask`` (on this machine), ``slurm`` (Dask workers as SLURM's jobs), or the address of a Dask
        scheduler, ``tcp://…`` or ``tls://…``.
    workers: concurrent tasks, 1 to 1024; 0: half the cores, or all that the cluster has.
    threads: CPU threads per render, 0 (all) to 1024; no effect on the results.
    retries: restarts of a task after a failure that may be temporary, 0 to 100.
    fail_fast: start nothing new after the first failure; otherwise continue with all that does not depend on it.
    slots: available slots by name, such as ``{"gpu": 2}``; one of each by default.
    out: folder for an exporter's files.
    cluster: options about other machines.
    """

    farm: str = "local"
    workers: int = 0
    threads: int = 0
    retries: int = RETRIES
    fail_fast: bool = False
    slots: Mapping[str, int] = field(default_factory=dict)
    out: Path | None = None
    cluster: ClusterOptions = field(default_factory=ClusterOptions)

    def __post_init__(self) -> None:
        for name, most in (("workers", MOST_WORKERS), ("threads", 1024), ("retries", MOST_RETRIES)):
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"--{name} is {getattr(self, name)}: give 0 to {most}")


Runner = Callable[[Plan, FarmOptions, OnEvent, IsCancelled], list[Outcome]]
"""Runs a plan; returns an outcome for each of its tasks, in order. Raises InputError when it cannot start."""

Exporter = Callable[[Plan, FarmOptions], list[Path]]
"""Writes a plan for another program into the options' ``out``; returns the files."""


def _local() -> Runner:
    from .local_runner import run_local

    return run_local


def _dask() -> Runner:
    from .dask_runner import run_dask

    return run_dask


def _flamenco() -> Exporter:
    from .flamenco_export import export_flamenco

    return export_flamenco


def _slurm() -> Exporter:
    from .slurm_export import export_slurm

    return export_slurm


RUNNERS: dict[str, Callable[[], Runner]] = {"local": _local, "dask": _dask, "tcp": _dask, "tls": _dask, "slurm": _dask}
"""Name, or scheme of an address → what imports the runner."""

EXPORTERS: dict[str, Callable[[], Exporter]] = {"flamenco": _flamenco, "slurm": _slurm}


def find_runner(farm: str) -> Runner:
    """Return the runner for ``--farm``. Raises InputError for an unknown one."""
    name, colon, rest = farm.partition("://")
    if name not in RUNNERS or bool(colon) != (name in ("tcp", "tls")) or (colon and not rest):
        raise InputError(
            f"--farm is {farm!r}: choose local, dask, slurm, or the address of a scheduler, tcp://HOST:PORT"
        )
    return RUNNERS[name]()


def find_exporter(name: str) -> Exporter:
    """Return the exporter for ``--export``. Raises InputError for an unknown one."""
    if name not in EXPORTERS:
        raise InputError(f"--export is {name!r}: choose one of {', '.join(EXPORTERS)}")
    return EXPORTERS[name]()


def started_event(task: Task, worker: str, attempt: int) -> Event:
    """Return the event that ``task`` starts."""
    return {
        "event": "task",
        "state": "started",
        "task": task.id,
        "stage": task.stage,
        "worker": worker,
        "attempt": attempt,
    }


def ended_event(outcome: Outcome) -> Event:
    """Return the event that a task has ended for good."""
    return {"event": "task", **asdict(outcome)}
