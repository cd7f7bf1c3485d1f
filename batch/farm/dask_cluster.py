# SPDX-License-Identifier: GPL-3.0-or-later
"""Connect to a Dask cluster: local workers, a scheduler at an address, or SLURM jobs; with TLS.

Dask's messages are pickles: whoever may connect may run any code.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import logging
import shutil
import ssl
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ...sim.app.stage_process import own_command, read_errors, start_process
from ...sim.errors import Cancelled, InputError
from ...sim.events import IsCancelled
from .runners import FarmOptions

NO_PAGES: dict[str, list[str]] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Configuration of Dask without its status pages: they are served without TLS, without a password and to whatever host
name a browser asks for, also where the dashboard is off, and show tasks, their paths and logs to every user of this
machine, and to every page that they have open."""
NO_PAGES_VARIABLES = ("DASK_DISTRIBUTED__WORKER__HTTP__ROUTES=[]",)
"""The same, of workers that Dask starts by itself."""


def file_security(address: str, ca: Path | None, cert: Path | None, key: Path | None) -> Any:
    """Return Dask's ``Security`` for a scheduler at ``address``; None for ``tcp://``.

    Raises InputError for a malformed address, for TLS with missing or unusable files, and for files given with an
    address that does not use them.
    """
    try:
        parts = urlsplit(address)
        scheme, known = parts.scheme, bool(parts.hostname and parts.port)
    except ValueError:
        scheme, known = "", False
    if scheme not in ("tcp", "tls") or not known:
        raise InputError(f"{address!r} is not the address of a scheduler: write tcp://HOST:PORT or tls://HOST:PORT")
    files = {"--tls-ca": ca, "--tls-cert": cert, "--tls-key": key}
    given = [option for option, path in files.items() if path is not None]
    if scheme == "tcp":
        if given:
            raise InputError(f"{given[0]} is unused with {address}: start the scheduler with TLS and write tls://…")
        return None
    missing = [option for option, path in files.items() if path is None]
    if missing:
        raise InputError(f"{missing[0]} is missing: {address} needs --tls-ca, --tls-cert and --tls-key")
    assert ca is not None and cert is not None and key is not None
    for option, path in files.items():
        if path is not None and not path.is_file():
            raise InputError(f"{option} {path}: there is no such file")
    try:
        context = ssl.create_default_context(cafile=str(ca))
        context.load_cert_chain(cert, key)
    except OSError as error:
        raise InputError(
            f"{ca}, {cert}, {key}: cannot be used ({error}); give PEM files that belong together"
        ) from error
    from distributed.security import Security

    return Security(
        require_encryption=True,
        tls_ca_file=str(ca),
        **{f"tls_{role}_cert": str(cert) for role in ("client", "worker")},
        **{f"tls_{role}_key": str(key) for role in ("client", "worker")},
    )


def check_trust(address: str, *, trust_network: bool) -> None:
    """Raise InputError for a scheduler on another machine without TLS, unless ``trust_network``."""
    host = urlsplit(address).hostname or ""
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    if address.startswith("tcp://") and not local and not trust_network:
        raise InputError(
            f"{address} is another machine and uses no TLS, so anyone who reaches it can run commands as you: "
            "use tls://…, or --trust-network if everyone on the network may"
        )


CONNECT_S = 10.0
START_S = 60.0
"""Time for local workers to start."""

LOOK_S = 0.2
MOST_FAILED_STARTS = 3
"""Local workers that may die at start-up before all are considered broken."""


@contextmanager
def dask_client(
    options: FarmOptions, slots: Mapping[str, int], in_all: Mapping[str, int], scratch: Path, cancelled: IsCancelled
) -> Iterator[Any]:
    """Yield a ``distributed.Client`` with at least one worker; everything started for it ends with it.

    slots: by name, enough for a worker to run any task. in_all: total of this machine. scratch: folder that all
    machines share. Raises InputError when Dask is not installed, no scheduler answers, or no worker appears.
    """
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            f"--farm {options.farm} needs Dask.distributed, which cannot be imported ({error}): "
            "pip install 'physgen[farm]'"
        ) from error
    import dask

    with _quiet(), dask.config.set(NO_PAGES):
        if options.farm == "dask":
            with _on_this_machine(distributed, options, slots, in_all, cancelled) as client:
                yield client
        elif options.farm == "slurm":
            with _on_slurm(distributed, options, slots, scratch, cancelled) as client:
                yield client
        else:
            with _at_address(distributed, options, cancelled) as client:
                yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's own log, which prints a stack trace for every worker that leaves."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


@contextmanager
def _at_address(distributed: Any, options: FarmOptions, cancelled: IsCancelled) -> Iterator[Any]:
    cluster = options.cluster
    security = file_security(options.farm, cluster.tls_ca, cluster.tls_cert, cluster.tls_key)
    check_trust(options.farm, trust_network=cluster.trust_network)
    try:
        client = distributed.Client(options.farm, security=security, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"{options.farm}: no scheduler answers ({_first_line(error)}); start one with 'dask scheduler', "
            "check address and certificates"
        ) from error
    with client:
        remedy = f"start some: python -P -m physgen.batch.farm.dask_worker {options.farm}"
        _await_workers(client, 1, CONNECT_S, cancelled, lambda: f"{options.farm} has no workers; {remedy}")
        yield client


@contextmanager
def _on_this_machine(
    distributed: Any,
    options: FarmOptions,
    slots: Mapping[str, int],
    in_all: Mapping[str, int],
    cancelled: IsCancelled,
) -> Iterator[Any]:
    """Yield a client of local workers, with certificates that exist only in the memory of these processes.

    Without them any other user of this machine could connect and run code as this one.
    """
    import dask

    security = distributed.Security.temporary()
    # Worker deaths before Dask gives a task up; the retry rule decides in the end.
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": options.retries}),
        distributed.LocalCluster(
            n_workers=0, host="127.0.0.1", protocol="tls://", security=security, dashboard_address=None
        ) as cluster,
        _LocalWorkers(cluster.scheduler_address, security, worker_shares(slots, in_all, options.workers)) as workers,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        _await_workers(client, options.workers, START_S, cancelled, workers.complaint, workers.have_failed)
        yield client


def worker_shares(slots: Mapping[str, int], in_all: Mapping[str, int], workers: int) -> list[dict[str, int]]:
    """Return the slots of each of ``workers`` workers: ``in_all``, distributed in portions of ``slots``."""
    result: list[dict[str, int]] = [{} for _ in range(workers)]
    for name, portion in sorted(slots.items()):
        for index in range(in_all[name] // portion):
            share = result[index % workers]
            share[name] = share.get(name, 0) + portion
    return result


class _LocalWorkers:
    """Local worker processes; one that dies is restarted while this object is open."""

    def __init__(self, address: str, security: Any, shares: list[dict[str, int]]) -> None:
        self._address = address
        self._credentials = json.dumps(
            {"require_encryption": True, **{k: getattr(security, k) for k in credential_fields(security)}}
        ).encode()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._shares = shares
        self._words: deque[str] = deque(maxlen=20)
        self._closing = threading.Event()
        self._failed_starts = 0
        self._keeper = threading.Thread(target=self._keep, daemon=True)

    def __enter__(self) -> _LocalWorkers:
        try:
            self._processes.extend(self._start(share) for share in self._shares)
        except BaseException:
            self._end()
            raise
        self._keeper.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._keeper.join()
        self._end()

    def have_failed(self) -> bool:
        """Return whether the workers cannot start."""
        return self._failed_starts >= MOST_FAILED_STARTS

    def complaint(self) -> str:
        """Return why no worker has started."""
        return "workers of this machine do not start: " + ("\n".join(self._words).strip() or "no output")

    def _start(self, share: Mapping[str, int]) -> subprocess.Popen[bytes]:
        slots = [word for name, count in share.items() for word in ("--slot", f"{name}={count}")]
        arguments = [self._address, "--host", "127.0.0.1", "--security-on-stdin", *slots]
        command = own_command("batch.farm.dask_worker", *arguments, ends_with_us=True)
        process = start_process(command, stdin=subprocess.PIPE)
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(BrokenPipeError), process.stdin:
            process.stdin.write(self._credentials)
        threading.Thread(target=read_errors, args=(process, self._words), daemon=True).start()
        threading.Thread(target=_drain, args=(process,), daemon=True).start()
        return process

    def _keep(self) -> None:
        while not self._closing.wait(LOOK_S):
            for index, process in enumerate(self._processes):
                if process.poll() is None or self.have_failed():
                    continue
                if process.returncode > 0:
                    self._failed_starts += 1
                with contextlib.suppress(InputError):
                    self._processes[index] = self._start(self._shares[index])

    def _end(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.terminate()
        for process in self._processes:
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def credential_fields(security: Any) -> list[str]:
    """Return the names of the fields of ``security`` that a worker needs."""
    return [name for name in ("tls_ca_file", "tls_worker_cert", "tls_worker_key") if getattr(security, name)]


def _drain(process: subprocess.Popen[bytes]) -> None:
    assert process.stdout is not None
    while process.stdout.read(65536):
        pass


@contextmanager
def _on_slurm(
    distributed: Any, options: FarmOptions, slots: Mapping[str, int], scratch: Path, cancelled: IsCancelled
) -> Iterator[Any]:
    """Yield a client with one worker per SLURM job; the scheduler is in this process and uses TLS."""
    if shutil.which("sbatch") is None:
        raise InputError("--farm slurm: this machine has no sbatch; run it on a login node of the cluster")
    with (
        slurm_cluster(options, slots, scratch) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        cluster.scale(jobs=options.workers or 1)
        _await_workers(client, 1, None, cancelled, lambda: "")
        yield client


def slurm_cluster(options: FarmOptions, slots: Mapping[str, int], scratch: Path) -> Any:
    """Return dask-jobqueue's ``SLURMCluster`` for ``options``, without jobs yet.

    slots: of each worker, by name. scratch: folder that all nodes share; certificates are written there, readable by
    this user only. Raises InputError when dask-jobqueue is not installed.
    """
    try:
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError as error:
        raise InputError(
            f"--farm slurm needs dask-jobqueue, which is not installed ({error}): pip install 'physgen[farm]'"
        ) from error
    wanted = options.cluster
    resources = ["--resources", ",".join(f"{name}={count}" for name, count in sorted(slots.items()))] if slots else []
    scratch.mkdir(parents=True, exist_ok=True)
    return SLURMCluster(
        queue=wanted.queue or None,
        account=wanted.account or None,
        walltime=wanted.walltime or "1-00:00:00",
        # Dask's threads and memory are those of the worker process itself: one task at a time, without a limit.
        cores=1,
        processes=1,
        memory="1GB",
        job_cpu=wanted.cores,
        job_mem=wanted.memory or None,
        job_directives_skip=[] if wanted.memory else ["--mem"],
        job_extra_directives=[*(f"--gres={name}:{count}" for name, count in sorted(slots.items())), *wanted.sbatch],
        worker_extra_args=[*resources, "--memory-limit", "0", "--no-dashboard"],
        python=wanted.python,
        # No modules from the working folder: a job may come from anybody.
        job_script_prologue=[f"export {words}" for words in ("PYTHONSAFEPATH=1", *NO_PAGES_VARIABLES)],
        log_directory=str(scratch),
        shared_temp_directory=str(scratch),
        security=True,
        protocol="tls://",
        # Its status pages are served even without a dashboard.
        scheduler_options={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
    )


def _await_workers(
    client: Any,
    count: int,
    seconds: float | None,
    cancelled: IsCancelled,
    complaint: Callable[[], str],
    hopeless: Callable[[], bool] = lambda: False,
) -> None:
    """Wait for ``count`` workers; after ``seconds`` at least one is enough. None waits indefinitely."""
    waited = 0.0
    pause = threading.Event()
    while (present := len(worker_addresses(client))) < count:
        if cancelled():
            raise Cancelled("cancelled while waiting for workers; run it again to continue")
        if hopeless() or (seconds is not None and waited >= seconds):
            if present and not hopeless():
                return
            raise InputError(complaint())
        pause.wait(LOOK_S)
        waited += LOOK_S


def worker_addresses(client: Any) -> list[str]:
    """Return the addresses of the scheduler's current workers."""
    return sorted(client.nthreads())


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]
