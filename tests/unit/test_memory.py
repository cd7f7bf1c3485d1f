# SPDX-License-Identifier: MIT
"""Memory: what there is, on each system; estimates that refuse before a stage begins; what its lack leaves behind."""


import numpy as np
import pytest
from physgen.sim import memory
from physgen.sim.errors import InputError
from physgen.sim.memory import available_memory, ran_out, require_memory

MIB = 2**20


def test_available_memory_is_plausible_here():
    found = available_memory()
    assert found is None or 2**26 < found < 2**46


def test_memory_on_linux_is_what_the_system_calls_available(tmp_path):
    (tmp_path / "meminfo").write_text("MemTotal: 16 kB\nMemAvailable:    8000 kB\n")
    assert memory._linux_memory(tmp_path / "meminfo") == 8000 * 1024
    (tmp_path / "meminfo").write_text("MemTotal: 16 kB\n")
    assert memory._linux_memory(tmp_path / "meminfo") is None


def a_group(folder, limit, used, *, first=False, cached=0):
    folder.mkdir(parents=True, exist_ok=True)
    names = ("memory.limit_in_bytes", "memory.usage_in_bytes") if first else ("memory.max", "memory.current")
    for name, value in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{value}\n")
    (folder / "memory.stat").write_text(f"{'total_' if first else ''}inactive_file {cached}\nanon 7\n")


def test_a_control_groups_limit_counts_and_so_do_those_above_it(tmp_path):
    """Slurm, systemd and containers limit a group above the process's own; files in the cache are given back."""
    membership, root = tmp_path / "cgroup", tmp_path / "fs"
    membership.write_text("0::/job/step\n")
    assert memory._group_memory(membership, root) is None
    a_group(root / "job" / "step", "max", 100)
    assert memory._group_memory(membership, root) is None
    a_group(root / "job", 5000, 1500, cached=500)
    assert memory._group_memory(membership, root) == 4000
    a_group(root, 3000, 1000)
    assert memory._group_memory(membership, root) == 2000
    a_group(root, 3000, 4000)
    assert memory._group_memory(membership, root) == 0
    # The first version, and a container in which the path of outside is not there.
    membership.write_text("4:cpu:/\n9:memory:/docker/abc\n")
    a_group(root / "memory", 9 * 2**60, 5, first=True)
    assert memory._group_memory(membership, root) is None
    a_group(root / "memory", 7000, 1000, first=True, cached=200)
    assert memory._group_memory(membership, root) == 6200
    assert memory._group_memory(tmp_path / "none", root) is None


def test_too_little_is_refused_with_the_numbers_unless_the_user_says_anyway(monkeypatch):
    words = {"what": "9 cups", "remedy": "give fewer"}
    require_memory(5 * 2**30, None, **words)
    require_memory(2**30, 2**30, **words)
    with pytest.raises(InputError, match=r"about 3 GiB of memory for 9 cups, and 2 GiB are available: give fewer"):
        require_memory(3 * 2**30, 2 * 2**30, **words)
    monkeypatch.setenv("PHYSGEN_ANYWAY", "1")
    require_memory(3 * 2**30, 2 * 2**30, **words)


@pytest.mark.parametrize(
    ("error", "lack"),
    [
        (MemoryError(), True),
        (np._core._exceptions._ArrayMemoryError((2**40,), np.dtype(float)), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("std::bad_alloc"), True),
        (ImportError("libx.so: failed to map segment from shared object"), True),
        (RuntimeError("(-4:Insufficient memory) Failed to allocate 9 bytes in function 'OutOfMemoryError'"), True),
        (RuntimeError("division by zero"), False),
        (ImportError("no module named x"), False),
    ],
)
def test_the_lack_of_memory_is_known_by_whatever_name(error, lack):
    assert ran_out(error) is lack
