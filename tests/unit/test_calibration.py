# SPDX-License-Identifier: MIT
"""Recorded fits of generated captures: kept, judged, tuned without the effect that is judged."""

import dataclasses

import numpy as np
import pytest
from physgen.blind_check.calibration import chance_errors, cross_validated, judge, pair_gain, reliability
from physgen.blind_check.check import plan_cases
from physgen.blind_check.fit_records import FORMAT, load_records, missing_cases, save_record
from physgen.sim.diagnose.comparison_settings import ComparisonSettings
from physgen.sim.errors import InputError


def fit(*effects, evidence=0.0, misfit=1.0, rms=0.002, value=1.0, spread=0.1):
    names = {"air_drag": "drag_per_mass", "friction": "friction"}
    interval = [value, value - spread, value + spread, "1"]
    return {
        "effects": list(effects),
        "log_evidence": evidence,
        "heldout_rms_m": rms,
        "misfit": misfit,
        "heldout_log_score": [0.0, None],
        "heldout_trials": [0.4, 2.2],
        "heldout_elsewhere": [False, True],
        "bending": 1.5,
        "parameters": {e: {names[e]: interval} for e in effects},
    }


def record(effects, *candidates, effect=None, parameters=None):
    nominal = fit(misfit=6.0 if effects or effect else 1.0, rms=0.02 if effects or effect else 0.001)
    return {
        "format": FORMAT,
        "matter": "rigid",
        "truth": {"effect": effect or (effects[0] if effects else "none"), "effects": effects,
                  "parameters": parameters or {}, "oracle_rms_m": 0.0005},
        "nominal": nominal,
        "refitted": {**nominal, "effects": ["friction"], "parameters": {}, "heldout_rms_m": 0.03},
        "candidates": list(candidates),
        "floor_rms_m": 0.001,
        "grain_rms_m": 0.001,
        "withheld_rms_m": {"": 0.02, "refitted": 0.03, **{"+".join(c["effects"]): 0.002 for c in candidates}},
        "frame_auc": {"": 0.6, **{"+".join(c["effects"]): 0.9 for c in candidates}},
        "size_m": float("nan"),
        "cpu_s": 1.0,
    }  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    drag, rub = fit("air_drag", evidence=500, value=0.1), fit("friction", evidence=90, misfit=4.0)
    both = fit("air_drag", "friction", evidence=900, rms=0.001)
    cases = [
        record([]),
        record(["air_drag"], drag, rub, parameters={"drag_per_mass_1_per_m": 0.15}),
        record(["air_drag"], drag, rub, parameters={"drag_per_mass_1_per_m": 0.5}),
        record(["friction", "air_drag"], {**drag, "misfit": 1.4}, rub, both),
        record([], fit("air_drag", evidence=400, misfit=5.5, rms=0.018), effect="unknown"),
    ]
    for i, case in enumerate(cases):
        save_record(case, tmp_path / f"case-{i:04d}.json")
    return tmp_path


def test_records_are_judged_as_a_diagnosis_judges(folder):
    records = load_records(folder)
    assert records[1].candidates[0].heldout_elsewhere == (False, True)
    assert records[1].candidates[0].heldout_trials == (0.4, 2.2) and records[1].nominal.bending == 1.5
    cases = [judge(r, ComparisonSettings()) for r in records]
    assert [c.verdict for c in cases] == ["none", "air_drag", "air_drag", "air_drag", "unknown"]
    assert cases[3].both and cases[3].pair and not cases[1].pair
    assert cases[1].closed == pytest.approx(0.9) and np.isnan(cases[0].closed)
    assert cases[1].reach == pytest.approx(18.0 / 19.5)
    found = reliability(cases)
    assert found.first == 1.0 and found.pairs_both == 1.0 and found.false_pairs == 0.0 and found.false_alarms == 0.0
    assert found.covered == (1, 2)
    # The cause found localises in three, the bare measurement where it is unknown; without a gap there is nothing.
    assert found.frame_auc == pytest.approx((3 * 0.9 + 0.6) / 4) and np.isnan(cases[0].frame_auc)
    assert sum(row[2] for row in found.rows[0]) == len(cases) == sum(row[2] for row in found.rows[1])
    assert "both 100 %" in found.text() and "1 of 2" in found.text()
    assert pair_gain(records[3])[:2] == (("air_drag", "friction"), pytest.approx(400))


def test_few_cases_have_a_calibration_error_by_chance():
    """At one half it is |share - 1/2| of N coins: a half-normal one of deviation 1 / (2 sqrt N)."""
    low, high = chance_errors(np.full(400, 0.5))
    assert low == pytest.approx(0.0627 / 40, abs=1 / 400)  # outcomes come in steps of one in N
    assert high == pytest.approx(1.96 / 40, abs=1 / 400)
    assert chance_errors(np.ones(7)) == (0.0, 0.0)


def test_constants_are_chosen_without_the_effect_that_is_judged(folder):
    said = []
    records = load_records(folder)
    cases, settings = cross_validated(records, ComparisonSettings(), said.append)
    assert sorted(c.record.effect for c in cases) == sorted(r.effect for r in records)
    assert [line.split(":")[0] for line in said] == [
        "without air_drag", "without none", "without two causes", "without unknown"
    ]  # fmt: skip
    # All cases are alike: leaving one effect out changes what its own cases get.
    alone, _ = cross_validated([r for r in records if r.effect == "none"], ComparisonSettings())
    assert alone[0].probability == judge(records[0], ComparisonSettings()).probability
    assert dataclasses.is_dataclass(settings)


def test_a_calibration_goes_on_where_it_stopped(folder):
    assert list(missing_cases(folder, 8, (0, 1))) == [5, 6, 7]
    assert list(missing_cases(folder, 8, (1, 2))) == [5, 7]
    with pytest.raises(InputError, match="shard"):
        missing_cases(folder, 8, (2, 2))


def test_cases_kept_for_the_end_are_not_read(folder):
    """A damaged one outside of the numbers does not even disturb."""
    (folder / "case-0004.json").write_text("kept for the end")
    assert [r.effect for r in load_records(folder, numbers=range(0, 2))] == ["none", "air_drag"]
    with pytest.raises(InputError, match="from 7 to 8"):
        load_records(folder, numbers=range(7, 9))


def test_a_damaged_record_is_named(folder):
    (folder / "case-0001.json").write_text('{"format": "physgen-fit-record/1", "matter": "rigid"}')
    with pytest.raises(InputError, match="case-0001"):
        load_records(folder)
    with pytest.raises(InputError, match="no records"):
        load_records(folder / "nowhere")


def test_the_share_of_two_causes_is_as_asked():
    many = plan_cases(100, np.random.default_rng(0), two_share=0.3)
    assert sum(len(c.effects) == 2 for c in many) == 30 and len(many) == 100
    with pytest.raises(InputError, match="two causes"):
        plan_cases(100, np.random.default_rng(0), two_share=0.7)
