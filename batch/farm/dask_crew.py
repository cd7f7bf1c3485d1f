# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the workers of a Dask farm are fit for a plan: same version, same folder, what it takes up."""

from __future__ import annotations

import pydoc
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...sim.atomic import write_bytes
from ...sim.errors import InputError
from .dask_cluster import worker_addresses
from .dask_tasks import read_token
from .task import Plan

VERSION_NAME = "physgen.sim.version.VERSION"


def slots_of_a_worker(plan: Plan) -> dict[str, int]:
    """What a worker needs that can carry out any task, by name."""
    slots: dict[str, int] = {}
    for task in plan.tasks:
        for name, count in task.slots.items():
            slots[name] = max(count, slots.get(name, 0))
    return slots


def _resources(dask_worker: Any) -> dict[str, float]:
    return dict(dask_worker.state.total_resources)


def check_slots(plan: Plan, client: Any) -> None:
    """Raise InputError when no worker has what a task of ``plan`` takes up: it would wait for ever."""
    present: Mapping[str, Mapping[str, float]] = client.run(_resources)
    for task in plan.tasks:
        if not any(all(has.get(name, 0) >= count for name, count in task.slots.items()) for has in present.values()):
            wanted = ", ".join(f"{name}={count}" for name, count in task.slots.items())
            raise InputError(
                f"{task.id}: takes {wanted}, and no worker has that; start workers with --slot {wanted} "
                f"(dask worker: --resources '{wanted}'), or leave it out of the job"
            )


@contextmanager
def token_file(folder: Path) -> Iterator[Path]:
    """A file with a random text, by which workers show that they see the same folder."""
    path = folder / "token"
    write_bytes(path, secrets.token_hex(16).encode())
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


class Crew:
    """The workers, and which of them are fit for the plan."""

    def __init__(self, client: Any, plan: Plan, token: Path) -> None:
        self._client = client
        self._plan = plan
        self._token = token
        self._asked: set[str] = set()
        self.refused: set[str] = set()

    def refuse_strangers(self) -> None:
        """Ask the scheduler and all workers. Raises InputError when one of them is not fit."""
        # The scheduler unpacks what it passes on.
        complaints = self._wrong_versions({"scheduler": self._client.run_on_scheduler(pydoc.locate, VERSION_NAME)})
        complaints += self.ask_new()
        if complaints:
            raise InputError("; ".join(complaints))

    def ask_new(self) -> list[str]:
        """Ask those that have come since; what is wrong, for people. Those get no more tasks."""
        new = [address for address in worker_addresses(self._client) if address not in self._asked]
        if not new:
            return []
        self._asked.update(new)
        # ``locate`` is Python's own: a worker without PhysGen can still answer.
        versions = self._client.run(pydoc.locate, VERSION_NAME, workers=new, on_error="return")
        complaints = self._wrong_versions({f"worker {address}": version for address, version in versions.items()})
        self.refused.update(address for address, version in versions.items() if version != self._plan.version)
        fit = [address for address in new if address not in self.refused]
        expected = self._token.read_text(encoding="utf-8")
        tokens = self._client.run(read_token, str(self._token), workers=fit, on_error="return") if fit else {}
        for address, text in tokens.items():
            if text != expected:
                complaints.append(
                    f"worker {address} does not see {self._plan.root}; mount the same folder at the same place there"
                )
                self.refused.add(address)
        return complaints

    def _wrong_versions(self, found: Mapping[str, object]) -> list[str]:
        """Complaints about those that have another version than the plan; values that are no text: none at all."""
        return [
            f"{who} has {f'PhysGen {version}' if isinstance(version, str) else 'no PhysGen that can be imported'}, "
            f"this is PhysGen {self._plan.version}; install the same version there"
            for who, version in found.items()
            if version != self._plan.version
        ]

    def fit(self) -> list[str] | None:
        """Addresses that may be given work; None for all, as long as none had to be refused."""
        if not self.refused:
            return None
        return [address for address in worker_addresses(self._client) if address not in self.refused]
