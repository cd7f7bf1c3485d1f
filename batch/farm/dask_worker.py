# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m physgen.batch.farm.dask_worker ADDRESS``: a Dask worker configured for our tasks.

``dask worker ADDRESS --nthreads 1`` works as well. This one also reads certificates from standard input, so that those
of a farm that exists for one command are never on disk.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...sim.atomic import scratch_prefix
from ...sim.errors import PhysGenError
from .dask_cluster import NO_PAGES, check_trust, file_security
from .dask_tasks import ending


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of a worker: run until the scheduler or a signal ends it; return the exit code."""
    parser = argparse.ArgumentParser(prog="physgen.batch.farm.dask_worker", description=__doc__, allow_abbrev=False)
    parser.add_argument("address", help="of the scheduler: tcp://HOST:PORT or tls://HOST:PORT")
    slots = "slots that this machine offers to tasks, such as gpu=1"
    parser.add_argument("--slot", action="append", default=[], metavar="NAME=COUNT", help=slots)
    parser.add_argument("--host", help="address of this machine for the others (default: the one facing ADDRESS)")
    parser.add_argument("--tls-ca", type=Path, metavar="PEM")
    parser.add_argument("--tls-cert", type=Path, metavar="PEM")
    parser.add_argument("--tls-key", type=Path, metavar="PEM")
    trust = "accept a scheduler on another machine without TLS: anyone who reaches this one can run commands as you"
    parser.add_argument("--trust-network", action="store_true", help=trust)
    parser.add_argument("--security-on-stdin", action="store_true", help="certificates come as JSON on standard input")
    options = parser.parse_args(arguments)
    try:
        resources = {name: float(count) for name, _, count in (slot.partition("=") for slot in options.slot)}
    except ValueError:
        parser.error("--slot: write NAME=COUNT, such as gpu=1")
    try:
        if options.security_on_stdin:
            from distributed.security import Security

            security: Any = Security(**json.load(sys.stdin))
        else:
            security = file_security(options.address, options.tls_ca, options.tls_cert, options.tls_key)
            check_trust(options.address, trust_network=options.trust_network)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    asyncio.run(_work(options.address, options.host, resources, security))
    return 0


async def _work(address: str, host: str | None, resources: dict[str, float], security: Any) -> None:
    import dask
    from distributed import Worker
    from distributed.comm.addressing import get_address_host
    from distributed.utils import get_ip

    logging.getLogger("distributed").setLevel(logging.ERROR)
    dask.config.set(NO_PAGES)
    with tempfile.TemporaryDirectory(prefix=scratch_prefix("worker"), ignore_cleanup_errors=True) as scratch:
        # Tasks run in child processes, so its own memory is meaningless.
        worker = Worker(
            address,
            # By default a worker listens on all interfaces.
            host=host or get_ip(get_address_host(address)),
            nthreads=1,
            resources=resources,
            security=security,
            local_directory=scratch,
            memory_limit=0,
            dashboard=False,
            # Its status pages are served even without a dashboard.
            dashboard_address="127.0.0.1:0",
        )

        def end() -> None:
            ending.set()
            asyncio.ensure_future(worker.close(reason="signal"))  # noqa: RUF006 - it lives as long as the loop

        loop = asyncio.get_running_loop()
        if os.name != "nt":
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, end)
        try:
            async with worker:
                await worker.finished()
        finally:
            # The scheduler may be gone.
            ending.set()


if __name__ == "__main__":
    sys.exit(main())
