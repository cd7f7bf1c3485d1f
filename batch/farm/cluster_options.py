# SPDX-License-Identifier: GPL-3.0-or-later
"""What there is to say about the machines of a farm: who may connect, and what SLURM is asked for."""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from ...sim.errors import InputError

MOST_CORES = 1024
_WORD = re.compile(r"[\w.,+@:-]{0,200}", re.ASCII)
_WALLTIME = re.compile(r"|(\d{1,3}-)?\d{1,4}(:\d{1,2}){0,2}", re.ASCII)
_MEMORY = re.compile(r"|[1-9]\d{0,8}[KMGT]?", re.ASCII)
_SBATCH = re.compile(r"--[a-z][a-z-]{1,40}(=[\w.,:+@%/&|*-]{1,500})?", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """Machines that carry out a plan.

    tls_ca, tls_cert, tls_key: PEM files of a Dask farm with TLS: its authority, and this machine's certificate and key.
    trust_network: whether a Dask scheduler on another machine may be used without TLS.
    queue, account: SLURM's partition and account; empty: the cluster's default.
    walltime: the longest that a task may take, as SLURM writes it, ``4:00:00`` or ``1-12``; empty: the default.
    memory: of a task, as ``8G``; empty: the default.
    cores: CPU cores of a task, 1 to 1024.
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
        # All of it goes into scripts.
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
    """The arguments that ``cluster_options`` reads."""
    group = parser.add_argument_group("other machines")
    group.add_argument("--tls-ca", type=Path, metavar="PEM", help="authority of a farm at tls://…")
    group.add_argument("--tls-cert", type=Path, metavar="PEM", help="this machine's certificate there")
    group.add_argument("--tls-key", type=Path, metavar="PEM", help="its key")
    trust = "use a Dask scheduler on another machine without TLS: whoever reaches it can run commands as you"
    group.add_argument("--trust-network", action="store_true", help=trust)
    group.add_argument("--queue", default="", help="SLURM: partition")
    group.add_argument("--account", default="", help="SLURM: account")
    group.add_argument("--walltime", default="", metavar="D-H:MM:SS", help="SLURM: the longest that a task may take")
    group.add_argument("--memory", default="", metavar="SIZE", help="SLURM: memory of a task, such as 8G")
    group.add_argument("--cores", type=int, default=4, help="SLURM: CPU cores of a task (%(default)s)")
    further = "SLURM: a further option of sbatch, such as --sbatch=--qos=high; may be repeated"
    group.add_argument("--sbatch", action="append", default=[], metavar="OPTION", help=further)
    python = "interpreter with PhysGen on the machines of SLURM or Flamenco (default: this one)"
    group.add_argument("--machine-python", default=sys.executable, metavar="PATH", help=python)


def cluster_options(options: argparse.Namespace) -> ClusterOptions:
    """What ``add_cluster_options`` was told. Raises InputError for values that cannot be used."""
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
