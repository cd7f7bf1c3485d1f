# SPDX-License-Identifier: MIT
"""The budget is work: the clock decides nothing, what the budget cuts off is named, and warnings have no source."""

import json
import time
import warnings

import numpy as np
import pytest
from physgen.batch.cli import main
from physgen.benchmarks.diagnosis import quick_capture
from physgen.sim.diagnose.capture_folder import load_capture
from physgen.sim.diagnose.diagnosis import report_json
from physgen.sim.diagnose.rigid.rigid_simulator import RigidWorlds
from physgen.sim.diagnose.run_diagnosis import DiagnoseOptions, cut_off, diagnose
from physgen.sim.diagnose.work import LAUNCH, RIGID_RATE, Work
from physgen.sim.errors import InputError

from .test_diagnose_rigid import scene_of, sphere, state


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "throw"
    quick_capture(folder)
    return folder


def told(folder, **options):
    """Everything that report.json says about the capture, as text."""
    data = report_json(diagnose(load_capture(folder), DiagnoseOptions(confirm=False, **options)))
    return json.dumps(data, sort_keys=True), data


def test_no_clock_changes_a_verdict(folder, monkeypatch):
    options = {"effects": ("air_drag", "gravity_tilt"), "budget_s": 10.0}
    calm, data = told(folder, **options)
    assert data["work"]["skipped"] == {}
    # A machine on which every look at the clock is an hour later, and every launch takes longer.
    hours, run = iter(range(0, 10**9, 3600)), RigidWorlds.run

    def slow(self, *arguments):
        time.sleep(0.002)
        return run(self, *arguments)

    monkeypatch.setattr(time, "monotonic", lambda: float(next(hours)))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(hours)))
    monkeypatch.setattr(RigidWorlds, "run", slow)
    busy, _ = told(folder, **options)
    assert busy == calm


def test_what_the_budget_cuts_off_is_named(folder, monkeypatch):
    few, data = told(folder, effects=("air_drag", "gravity_tilt", "magnus"), work=100_000)
    assert data["work"]["budget"] == 100_000 <= data["work"]["spent"]
    assert data["work"]["skipped"]["magnus"] == "tried" and "magnus" not in {e["name"] for e in data["effects"]}
    assert any("Magnus lift" in w and "not tried" in w and "--budget" in w for w in data["warnings"])
    hours = iter(range(0, 10**9, 3600))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(hours)))
    assert told(folder, effects=("air_drag", "gravity_tilt", "magnus"), work=100_000)[0] == few


def test_a_pair_that_the_budget_cuts_off_is_named_in_words():
    work = Work(limit=10)
    work.skip(("rolling_resistance", "air_drag"), "refined")
    (said,) = cut_off(work)
    assert said.startswith("rolling resistance and air drag: not refined, because the budget was spent")


def test_an_effect_that_was_asked_for_and_cannot_act_is_named(folder):
    _, data = told(folder, effects=("air_drag", "camera_pose", "restitution"))
    said = next(w for w in data["warnings"] if "asked for" in w)
    assert "camera_pose" in said and "restitution" in said and "air_drag" not in said


def test_a_minute_is_the_same_work_everywhere(folder):
    _, data = told(folder, effects=("air_drag",), budget_s=60.0)
    assert data["work"]["budget"] == 60 * RIGID_RATE and data["work"]["per_second"] == RIGID_RATE


def test_steps_are_counted_as_they_are_taken():
    work, scene = Work(), scene_of(sphere())
    simulator = RigidWorlds(body=scene.body, threads=1, work=work)
    numbers = np.repeat(scene.numbers([scene.base]), 3, axis=0)
    simulator.run(np.repeat(state((0, 0, 50))[None], 3, axis=0), numbers, [np.array([0.5])] * 3)
    # Free flight in steps of 5 ms, in three worlds.
    assert work.spent == LAUNCH + 3 * 100
    assert Work(limit=10).left() and not Work(limit=10, spent=5).left(0.5)


@pytest.mark.parametrize("work", [0, 5, -1, 10**15])
def test_an_absurd_budget_is_refused(work):
    with pytest.raises(InputError, match="steps"):
        DiagnoseOptions(work=work)


def test_points_that_vanish_raise_no_warning(folder, tmp_path, capsys):
    """A point that is never seen at the end, and one never at all, have no mean there."""
    hidden = tmp_path / "hidden"
    quick_capture(hidden)
    with np.load(hidden / "throw1.npz") as file:
        arrays = dict(file)
    arrays["points"][12:, 2] = np.nan
    arrays["points"][:, 3] = np.nan
    arrays["points"][6] = np.nan
    np.savez(hidden / "throw1.npz", **arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        line = ["diagnose", str(hidden), "--out", str(tmp_path / "out"), "--effects", "air_drag", "--no-confirm"]
        assert main([*line, "--work", "2e6"]) == 0
    assert "Warning" not in capsys.readouterr().err
