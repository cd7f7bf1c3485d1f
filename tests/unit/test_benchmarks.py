# SPDX-License-Identifier: GPL-3.0-or-later
"""Every benchmark starts by its module's name and runs to its end with ``--quick``."""

import importlib.util
import json
import subprocess
import sys

import pytest
from physgen.benchmarks import cutouts
from physgen.benchmarks.__main__ import benchmarks, main

FAST = (
    "cutouts",
    "diagnosis",
    "farm",
    "farm_dask",
    "gpu",
    "kills",
    "main_thread",
    "materials",
    "mpm",
    "peers",
    "playback",
    "render",
    "rest",
    "shadows",
    "shapes",
    "splats",
    "stiff",
    "worlds",
)
SLOW = ("calibration", "compose", "demo", "first_frame", "light", "published", "reconstruct", "thin_parts")
NEEDS = {
    **dict.fromkeys((*SLOW[1:], "main_thread", "playback", "render"), "bpy"),
    "calibration": "mujoco",
    "farm_dask": "distributed",
}


def test_the_list_names_every_benchmark_with_what_it_measures(capsys):
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == sorted((*FAST, *SLOW)) == list(benchmarks())
    assert all(len(line.split()) > 3 for line in lines)
    with pytest.raises(SystemExit):
        main(["no_such_benchmark"])


@pytest.mark.long
@pytest.mark.parametrize("name", [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_a_benchmark_runs_quickly_and_prints_json(name):
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"needs {NEEDS[name]}")
    command = [sys.executable, "-m", f"physgen.benchmarks.{name}", "--quick", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    # Blender logs to standard output, too, before the redirection begins.
    assert isinstance(json.loads(done.stdout.strip().splitlines()[-1]), dict)


@pytest.mark.slow
def test_compositions_are_dropped_quickly():
    for needed in ("bpy", "mujoco"):
        pytest.importorskip(needed)
    command = [sys.executable, "-m", "physgen.benchmarks.compose", "--quick", "--stand", "--truth", "--json"]
    done = subprocess.run([*command, "--only", "ring", "loaf"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    every = ["composed, free", "composed, held", "composed, free", "truth, held", "truth, free"]
    assert [row["what"] for row in found["rows"]] == every and found["rows"][0]["asset"] == "loaf"
    assert found["seat"] == 0.006 and [row["asset"] for row in found["pictures"]] == ["ring"]


def test_defaults_of_quick_yield_to_given_options():
    from physgen.benchmarks.common import benchmark_parser

    parser = benchmark_parser("x", None, frames=2, size=3)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--size", type=int, default=64)
    slow, quick = parser.parse_args(["--size", "5"]), parser.parse_args(["--size", "5", "--quick"])
    assert (slow.frames, slow.size, slow.quick) == (48, 5, False)
    assert (quick.frames, quick.size, quick.quick) == (2, 5, True)


def test_the_recall_of_a_drawn_ring_without_a_box_is_one(tmp_path):
    cases = cutouts.rendered_cases(cutouts.drawn(tmp_path))
    rows = [cutouts.recall(case) for case in cases]
    assert cutouts.totals(rows) == {"recall_found": 1.0, "recall_used": 1.0}
    assert cutouts.box_iou((0, 0, 10, 10), (5, 0, 15, 10)) == pytest.approx(1 / 3)
    assert cutouts.totals([{"objects": 2, "found": 1, "used": 0}]) == {"recall_found": 0.5, "recall_used": 0.0}
