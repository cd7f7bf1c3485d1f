# SPDX-License-Identifier: GPL-3.0-or-later
"""A plan on Dask: workers that die, fail, are strangers or speak TLS, all of them real, on the loopback."""

import contextlib
import shutil
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import distributed
import psutil
import pytest
from physgen.batch.farm import dask_cluster, dask_worker
from physgen.batch.farm.dask_cluster import check_trust, slurm_cluster, worker_shares
from physgen.batch.farm.dask_runner import run_dask
from physgen.batch.farm.planning.plan import Plan, Task
from physgen.batch.farm.runners import ClusterOptions, FarmOptions
from physgen.sim.app.stage_process import own_command
from physgen.sim.errors import InputError
from physgen.sim.events import ignore, never
from physgen.sim.version import VERSION

ROOT = Path(__file__).resolve().parents[2]


def a_task(name, *argv, needs=(), slots=None, produces=()):
    return Task(id=name, stage="bake", argv=argv, needs=needs, slots=slots or {}, produces=produces)


def a_bake(name, *, frames, needs=()):
    argv = ("bake", "scene", "--out", name, "--frames", str(frames), "--quality", "preview")
    return a_task(f"{name}/bake", *argv, needs=needs, produces=(f"{name}/manifest.json", f"{name}/ball0.pc2"))


def a_plan(root, *tasks):
    return Plan(name="test", root=root, version=VERSION, tasks=tasks)


@contextlib.contextmanager
def a_scheduler(**options):
    with distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=None, **options) as cluster:
        yield cluster.scheduler_address


@contextlib.contextmanager
def a_worker(address, *arguments, command=None, cwd=None):
    command = command or own_command("batch.farm.dask_worker")
    process = subprocess.Popen([*command, address, *arguments], cwd=cwd, stderr=subprocess.DEVNULL)
    try:
        with pytest.MonkeyPatch.context() as patch:
            # On a busy machine it takes longer to start than a farm is waited for.
            patch.setattr(dask_cluster, "CONNECT_S", 120.0)
            yield process
    finally:
        process.terminate()
        process.wait()


class Killer:
    """Kills with SIGKILL, once each: the worker of one task mid-way, the command of another when it has begun."""

    def __init__(self, *, worker_of, command_of):
        self.worker_of = worker_of
        self.command_of = command_of
        self.events = []
        self._pids = {}

    def __call__(self, event):
        self.events.append(event)
        name = event.get("task")
        if event.get("state") == "started":
            self._pids[name] = int(event["worker"].partition(":")[2])
            if name == self.command_of:
                self.command_of = None
                worker = psutil.Process(self._pids[name])
                while not worker.children():
                    time.sleep(0.01)
                worker.children()[0].kill()
        if event["event"] == "progress" and name == self.worker_of:
            self.worker_of = None
            psutil.Process(self._pids[name]).kill()


@pytest.mark.long
def test_a_killed_worker_and_a_killed_command_cost_a_retry_and_nothing_else(ball_scene, tmp_path):
    ball_scene()
    plan = a_plan(
        tmp_path,
        a_bake("a", frames=6),
        a_task("b", "effects", "wind", slots={"gpu": 1}),
        a_task("c", "effects", "nothing"),
        a_task("d", "effects", "wind", needs=("c", "a/bake")),
    )
    killer = Killer(worker_of="a/bake", command_of="b")
    outcomes = run_dask(plan, FarmOptions(farm="dask", workers=2), killer, never)
    assert killer.worker_of is killer.command_of is None
    assert [(o.task, o.state, o.attempts) for o in outcomes] == [
        ("a/bake", "done", 2),
        ("b", "done", 2),
        ("c", "failed", 1),
        ("d", "skipped", 0),
    ]
    assert "nothing" in outcomes[2].message and outcomes[2].exit_code == 3
    ends = [e["task"] for e in killer.events if e["event"] == "task" and e["state"] != "started"]
    assert sorted(ends) == ["a/bake", "b", "c", "d"]


def test_strangers_are_refused(tmp_path):
    copy = tmp_path / "copy" / "physgen"
    copy.mkdir(parents=True)
    shutil.copy(ROOT / "__init__.py", copy)
    for name in ("batch", "sim", "presets"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    version_file = copy / "sim/version.py"
    version_file.write_text(version_file.read_text().replace(VERSION, "0.0.7"))
    other = [sys.executable, str(copy / "sim/app/launch.py"), "batch.farm.dask_worker"]
    plan = a_plan(tmp_path, a_task("x", "effects", "wind"))
    with a_scheduler() as address:
        with a_worker(address) as worker:
            greedy = a_plan(tmp_path, a_task("y", "effects", slots={"gpu": 1}))
            with pytest.raises(InputError, match="needs gpu=1, and no worker has that"):
                run_dask(greedy, FarmOptions(farm=address), ignore, never)
            open_ports = [c.laddr for c in psutil.Process(worker.pid).net_connections() if c.status == "LISTEN"]
            assert open_ports and {place.ip for place in open_ports} == {"127.0.0.1"}
        with a_worker(address, command=other), pytest.raises(InputError, match=rf"PhysGen 0\.0\.7.*PhysGen {VERSION}"):
            run_dask(plan, FarmOptions(farm=address), ignore, never)
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        # A folder that is another one for every process, as an unmounted share is.
        plan = a_plan(Path("/proc/self/cwd"), *plan.tasks)
        with (
            contextlib.chdir(tmp_path),
            a_worker(address, cwd=elsewhere),
            pytest.raises(InputError, match="does not see /proc/self/cwd"),
        ):
            run_dask(plan, FarmOptions(farm=address), ignore, never)
    with pytest.raises(InputError, match="no scheduler answers"):
        run_dask(plan, FarmOptions(farm="tcp://127.0.0.1:9"), ignore, never)


@pytest.mark.parametrize("page", ["health", "info/main/workers.html", "json/identity.json", "metrics"])
def test_no_page_tells_other_users_of_this_machine_what_runs(ports, page):
    """Nor a page in a browser, by a host name of its own that leads to the loopback."""
    assert ports
    for port in ports:
        asked = urllib.request.Request(f"http://127.0.0.1:{port}/{page}", headers={"Host": "example.org"})
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(asked, timeout=60)


@pytest.fixture(scope="module")
def ports():
    """Where scheduler and worker of ``--farm dask`` answer browsers."""
    options = FarmOptions(farm="dask", workers=1)
    with dask_cluster.dask_client(options, {}, {}, Path(), never) as client:
        found = client.scheduler_info()
        served = [found["services"], *(worker["services"] for worker in found["workers"].values())]
        yield [port for services in served for port in services.values()]


@pytest.mark.long
def test_tls_and_a_wish_to_stop(ball_scene, tmp_path):
    ball_scene()
    security = distributed.Security.temporary()
    files = {"ca": "tls_ca_file", "cert": "tls_client_cert", "key": "tls_client_key"}
    for name, field in files.items():
        (tmp_path / f"{name}.pem").write_text(getattr(security, field))
    pems = {f"tls_{name}": tmp_path / f"{name}.pem" for name in files}
    arguments = [word for name in files for word in (f"--tls-{name}", str(tmp_path / f"{name}.pem"))]
    stop = threading.Event()
    heard = []

    def stop_when_it_moves(event):
        heard.append(event)
        if event["event"] == "progress":
            stop.set()

    with a_scheduler(security=security, protocol="tls://") as address:
        with a_worker(address, *arguments) as worker:
            options = FarmOptions(farm=address, cluster=ClusterOptions(**pems))
            plan = a_plan(
                tmp_path,
                a_bake("a", frames=2000),
                a_task("b", "effects", "wind"),
                a_task("c", "effects", "wind", needs=("a/bake",)),
            )
            outcomes = run_dask(plan, options, stop_when_it_moves, stop.is_set)
            assert [(o.state, o.attempts) for o in outcomes[::2]] == [("cancelled", 1), ("cancelled", 0)]
            assert outcomes[1].state in ("cancelled", "done")
            assert not psutil.Process(worker.pid).children()
            again = run_dask(a_plan(tmp_path, plan.tasks[1]), options, ignore, never)
            assert again[0].state in ("done", "kept")
        with pytest.raises(InputError, match="--tls-ca is missing"):
            run_dask(plan, FarmOptions(farm=address), ignore, never)
        gone = ClusterOptions(**{**pems, "tls_key": tmp_path / "gone.pem"})
        with pytest.raises(InputError, match=r"gone\.pem: there is no such file"):
            run_dask(plan, FarmOptions(farm=address, cluster=gone), ignore, never)
        mixed = ClusterOptions(**{**pems, "tls_key": tmp_path / "ca.pem"})
        with pytest.raises(InputError, match="give PEM files that belong together"):
            run_dask(plan, FarmOptions(farm=address, cluster=mixed), ignore, never)
    with pytest.raises(InputError, match="is unused with tcp://"):
        run_dask(plan, FarmOptions(farm="tcp://127.0.0.1:9", cluster=ClusterOptions(**pems)), ignore, never)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]"])
def test_the_loopback_needs_no_trust(host):
    check_trust(f"tcp://{host}:8786", trust_network=False)


@pytest.mark.parametrize("host", ["10.0.0.7", "render-01", "127.0.0.1.example.org", "[::]", "0.0.0.0"])
def test_another_machine_in_the_clear_has_to_be_trusted(host, capsys):
    assert dask_worker.main([f"tcp://{host}:8786"]) == 3 and "--trust-network" in capsys.readouterr().err
    with pytest.raises(InputError, match="--trust-network"):
        check_trust(f"tcp://{host}:8786", trust_network=False)
    check_trust(f"tcp://{host}:8786", trust_network=True)
    check_trust(f"tls://{host}:8786", trust_network=False)


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'physgen\[farm\]'"):
        run_dask(a_plan(tmp_path, a_task("x", "effects")), FarmOptions(farm="dask", workers=1), ignore, never)


def test_slots_are_dealt_out_in_portions_that_are_of_use():
    assert worker_shares({"gpu": 1}, {"gpu": 3}, 2) == [{"gpu": 2}, {"gpu": 1}]
    assert worker_shares({"gpu": 2}, {"gpu": 5}, 3) == [{"gpu": 2}, {"gpu": 2}, {}]
    assert worker_shares({}, {}, 2) == [{}, {}]


def test_workers_of_slurm_ask_for_what_the_tasks_take(tmp_path):
    wanted = ClusterOptions(
        queue="short", account="lab", walltime="4:00:00", memory="8G", cores=6, sbatch=("--qos=high",)
    )
    with slurm_cluster(FarmOptions(farm="slurm", cluster=wanted), {"gpu": 1}, tmp_path / "shared") as cluster:
        script = cluster.job_script().splitlines()
        assert cluster.scheduler_address.startswith("tls://")
    for line in ("-p short", "-A lab", "--cpus-per-task=6", "--mem=8G", "-t 4:00:00", "--gres=gpu:1", "--qos=high"):
        assert f"#SBATCH {line}" in script
    [command] = [line for line in script if "dask_worker" in line]
    assert script.index("export PYTHONSAFEPATH=1") < script.index(command), "the job's folder may be a stranger's"
    assert script.index("export DASK_DISTRIBUTED__WORKER__HTTP__ROUTES=[]") < script.index(command)
    assert "--resources gpu=1" in command and "--nthreads 1" in command and "--tls-key" in command
    for file in (tmp_path / "shared").iterdir():
        assert file.stat().st_mode & 0o077 == 0, "keys are for this user only"
