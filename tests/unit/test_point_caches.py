# SPDX-License-Identifier: MIT
"""Point caches, manifests and locks: whole or refused, whatever is on the disk."""

import json
import os
import socket
import struct
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from physgen.sim import folder_lock as folder_lock_module
from physgen.sim.cache.bake_folder import BakedObject, load_manifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Reader, Pc2Writer
from physgen.sim.errors import InputError
from physgen.sim.folder_lock import LOCK_FILE, MOST_BYTES, folder_lock, is_held, is_locked

from ..conftest import complete_manifest

samples_of_points = hnp.arrays(
    np.float32, st.tuples(st.integers(1, 5), st.integers(1, 9), st.just(3)), elements=st.floats(-1e3, 1e3, width=32)
)
keeps_tmp = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)


@given(samples_of_points)
@keeps_tmp
def test_samples_come_back(tmp_path, samples):
    path = tmp_path / "a.pc2"
    with Pc2Writer(path, vertex_count=samples.shape[1]) as writer:
        for index, sample in enumerate(samples):
            writer.append(sample)
            assert Pc2Reader(path).sample_count == index + 1
    reader = Pc2Reader(path)
    assert np.array_equal(np.stack([reader.sample(i) for i in range(len(samples))]), samples)


def test_the_header_is_the_one_blender_reads(tmp_path):
    path = tmp_path / "a.pc2"
    with Pc2Writer(path, vertex_count=2, start_frame=5) as writer:
        writer.append(np.zeros((2, 3)))
    assert struct.unpack("<12siiffi", path.read_bytes()[:32]) == (b"POINTCACHE2\0", 1, 2, 5.0, 1.0, 1)


def test_a_writer_goes_on_from_kept_samples(tmp_path):
    path = tmp_path / "a.pc2"
    with Pc2Writer(path, vertex_count=1) as writer:
        for value in range(5):
            writer.append(np.full((1, 3), value))
    with Pc2Writer(path, vertex_count=1, keep=2) as writer:
        writer.append(np.full((1, 3), 9))
    assert [float(Pc2Reader(path).sample(i)[0, 0]) for i in range(3)] == [0.0, 1.0, 9.0]
    assert Pc2Reader(path).sample_count == 3
    with pytest.raises(InputError, match="sample 3"):
        Pc2Reader(path).sample(3)
    with pytest.raises(InputError, match="7 samples"):
        Pc2Writer(path, vertex_count=1, keep=7)


def test_bad_samples_are_refused(tmp_path):
    with Pc2Writer(tmp_path / "a.pc2", vertex_count=2) as writer:
        with pytest.raises(InputError, match="shape"):
            writer.append(np.zeros((3, 3)))
        with pytest.raises(InputError, match="finite"):
            writer.append(np.full((2, 3), np.nan))


@given(st.binary(max_size=80), st.booleans())
@keeps_tmp
def test_garbage_is_no_cache(tmp_path, content, signed):
    path = tmp_path / "a.pc2"
    path.write_bytes((b"POINTCACHE2\0" if signed else b"") + content)
    try:
        reader = Pc2Reader(path)
    except InputError:
        return
    assert path.stat().st_size >= 32 + reader.sample_count * reader.vertex_count * 12


def a_manifest(**changes):
    cup = BakedObject(name="cup", file="cup.pc2", vertices=4)
    return complete_manifest(cup, **{"particles": 8, **changes})


def test_a_manifest_comes_back(tmp_path):
    save_manifest(tmp_path, a_manifest())
    assert load_manifest(tmp_path) == a_manifest()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "other/1"}, "format"),
        ({"state": "done"}, "state"),
        ({"frames_done": 9}, "frame range"),
        ({"fps": 0}, "frame range"),
        ({"objects": [{"name": "a", "file": "../a.pc2", "vertices": 1}]}, "file name"),
    ],
)
def test_bad_manifests_are_named(tmp_path, change, words):
    save_manifest(tmp_path, a_manifest())
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=words):
        load_manifest(tmp_path)


def test_no_bake_says_what_to_run(tmp_path):
    with pytest.raises(InputError, match="physgen bake"):
        load_manifest(tmp_path)


HOLDER = """
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from physgen.sim.folder_lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """A process that holds ``tmp_path``."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        yield other
        other.kill()


def test_a_living_process_keeps_its_folder(tmp_path, holder):
    with pytest.raises(InputError, match=f"in use by process {holder.pid}"), folder_lock(tmp_path):
        pass
    assert is_locked(tmp_path)
    holder.kill()
    holder.wait()
    # Its file is still there; the lock went with it.
    assert (tmp_path / LOCK_FILE).exists() and not is_locked(tmp_path)
    with folder_lock(tmp_path):
        assert json.loads((tmp_path / LOCK_FILE).read_text())["pid"] == os.getpid()
    assert not (tmp_path / LOCK_FILE).exists()


def test_a_number_that_another_process_has_by_now_blocks_nobody(tmp_path, holder):
    """As after a reboot: the text names a living process, which started at another time than it says."""
    left = json.loads((tmp_path / LOCK_FILE).read_text())
    holder.kill()
    holder.wait()
    pid, started, machine = left["mark"].split("-")
    for mark in (f"{os.getppid()}-{started}-{machine}", f"1-{started}-{machine}", f"{pid}-0-{machine}"):
        (tmp_path / LOCK_FILE).write_text(json.dumps({**left, "pid": int(mark.split("-")[0]), "mark": mark}))
        with folder_lock(tmp_path):
            pass


def test_another_machines_run_is_respected(tmp_path):
    (tmp_path / LOCK_FILE).write_text(json.dumps({"pid": 7, "host": "elsewhere", "mark": "7-abc-00000000"}))
    words = r"process 7 on elsewhere; if that run is gone, delete .*\.lock"
    with pytest.raises(InputError, match=words), folder_lock(tmp_path):
        pass
    assert (tmp_path / LOCK_FILE).exists() and is_held(tmp_path) and not is_locked(tmp_path)
    # Somebody else's folder may have one that goes on for a terabyte.
    with (tmp_path / LOCK_FILE).open("r+") as file:
        file.seek(0, 2)
        file.write(" " * (MOST_BYTES - file.tell()))
        file.truncate(2**40)
    with pytest.raises(InputError, match=words), folder_lock(tmp_path):
        pass


def test_looking_at_a_lock_takes_nothing(tmp_path, holder):
    """Blender's timer looks twice a second: no run may be refused for that."""
    holder.stdin.close()
    holder.wait()
    stop = threading.Event()
    looks = [0]

    def look():
        while not stop.is_set():
            is_locked(tmp_path)
            looks[0] += 1

    watcher = threading.Thread(target=look)
    watcher.start()
    for _ in range(200):
        with folder_lock(tmp_path):
            assert not is_locked(tmp_path)
    stop.set()
    watcher.join()
    assert looks[0] > 10


def test_of_two_threads_one_holds_the_folder(tmp_path):
    words = f"in use by another job of this process .{os.getpid()}."
    with folder_lock(tmp_path), ThreadPoolExecutor(1) as other, pytest.raises(InputError, match=words):
        other.submit(lambda: folder_lock(tmp_path).__enter__()).result()


def test_without_locks_of_the_kernel_the_text_decides(tmp_path, holder, monkeypatch):
    """As on a network disk that has none."""
    monkeypatch.setattr(folder_lock_module, "_take", lambda file: None)
    with pytest.raises(InputError, match=f"in use by process {holder.pid}"), folder_lock(tmp_path):
        pass
    holder.kill()
    holder.wait()
    with folder_lock(tmp_path):
        pass


@pytest.mark.parametrize("content", ["", "garbage", "[]", '{"pid": "x"}'])
def test_a_broken_lock_is_taken_over(tmp_path, content):
    (tmp_path / LOCK_FILE).write_text(content)
    with folder_lock(tmp_path):
        pass


def test_a_cache_with_nan_is_refused_where_it_is_read(tmp_path):
    path = tmp_path / "a.pc2"
    with Pc2Writer(path, vertex_count=1) as writer:
        writer.append(np.zeros((1, 3)))
    content = bytearray(path.read_bytes())
    content[32:36] = np.float32(np.nan).tobytes()
    path.write_bytes(content)
    with pytest.raises(InputError, match="sample 0"):
        Pc2Reader(path).sample(0)


def test_of_many_that_find_a_dead_lock_one_holds_the_folder_at_a_time(tmp_path):
    code = """
import sys, time
from pathlib import Path
from physgen.sim.folder_lock import folder_lock
from physgen.sim.errors import InputError
folder = Path(sys.argv[1])
for _ in range(40):
    try:
        with folder_lock(folder):
            (folder / "inside").touch(exist_ok=False)
            time.sleep(0.001)
            (folder / "inside").unlink()
    except InputError:
        pass
"""
    (tmp_path / LOCK_FILE).write_text(json.dumps({"pid": 2**22 + 1, "host": socket.gethostname()}))
    runs = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stderr=subprocess.PIPE) for _ in range(4)]
    assert [(run.wait(), run.stderr.read()) for run in runs] == [(0, b"")] * 4
    for run in runs:
        run.stderr.close()
