# SPDX-License-Identifier: MIT
"""The blind check without its simulators: quotas, the seal, the score, and what the diagnosing process gets to see."""

import argparse
import dataclasses
import hashlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.commands.diagnosis_commands import add_blind_check, run_blind_check
from physgen.blind_check import BlindCheckOptions, blind_check, score_table
from physgen.blind_check.case import BlindCase, TrialTruth, Truth, break_seal, publish, seal, verify
from physgen.blind_check.check import LEAST_CASES, plan_cases
from physgen.blind_check.scoring import calibration_error, rank_auc, score_report, total_score
from physgen.sim.diagnose.capture import Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.errors import InputError
from physgen.sim.events import never

LABELS = {"case-001": {"effect": "wind"}, "case-002": {"effect": "none"}}


@given(count=st.integers(LEAST_CASES, 400), seed=st.integers(0, 2**32))
@settings(max_examples=60, deadline=None)
def test_quotas_hold_for_any_number_of_cases(count, seed):
    plan = plan_cases(count, np.random.default_rng(seed))
    effects = [c.effects for c in plan]
    assert len(plan) == count
    assert effects.count(()) >= count / 5
    assert effects.count(("unknown",)) >= count / 7
    pairs = [e for e in effects if len(e) == 2]
    assert len(pairs) >= max(1, math.floor(count / 10))
    assert all(a != b for a, b in pairs)
    assert sum(c.matter == "soft" for c in plan) <= count / 4 + 2


def test_a_long_plan_goes_round_all_effects_and_has_a_quarter_soft():
    plan = plan_cases(120, np.random.default_rng(1))
    singles = [c.effects[0] for c in plan if len(c.effects) == 1 and c.effects != ("unknown",)]
    assert len(set(singles)) == 19
    assert sum(c.matter == "soft" for c in plan) == 30


def test_too_few_cases_are_refused():
    with pytest.raises(InputError, match="cases is 3"):
        plan_cases(3, np.random.default_rng(0))


def test_a_seal_commits_to_the_labels_and_hides_them(tmp_path):
    sealed = seal(LABELS, tmp_path / "labels.sealed")
    content = sealed.path.read_bytes()
    assert b"wind" not in content
    assert "wind" not in repr(sealed) and sealed.key.hex() not in repr(sealed)
    text = json.dumps(LABELS, sort_keys=True, separators=(",", ":")).encode()
    assert sealed.digest == hashlib.sha256(sealed.salt + text).hexdigest()
    assert break_seal(sealed) == LABELS
    again = seal(LABELS, tmp_path / "again.sealed")
    assert again.digest != sealed.digest and again.path.read_bytes() != content


@given(place=st.integers(0, 10**6), change=st.integers(1, 255))
@settings(max_examples=30, deadline=None)
def test_tampering_with_sealed_labels_is_found(tmp_path_factory, place, change):
    sealed = seal(LABELS, tmp_path_factory.mktemp("seal") / "labels.sealed")
    content = bytearray(sealed.path.read_bytes())
    content[place % len(content)] ^= change
    sealed.path.write_bytes(bytes(content))
    with pytest.raises(InputError, match="changed"):
        break_seal(sealed)


def test_tampering_with_published_labels_is_found(tmp_path):
    path = tmp_path / "labels.json"
    publish(seal(LABELS, tmp_path / "labels.sealed"), LABELS, path)
    assert verify(path) == LABELS
    path.write_text(path.read_text().replace("wind", "none"))
    with pytest.raises(InputError, match="changed"):
        verify(path)


def _truth(effect="wind", effects=("wind",), masked=False):
    points = np.zeros((6, 3, 3))
    active = np.array([0, 0, 1, 1, 0, 0], dtype=bool)
    withheld = np.ones((4, 3, 3))
    mask = np.array([True, False, False]) if masked else None
    return Truth(
        effect=effect,
        effects=effects,
        mechanism=effect,
        simulator="hand",
        parameters={},
        oracle_rms_m=0.0,
        effect_rms_over_noise=20.0,
        trials={
            "a": TrialTruth(points=points, active=active, point_mask=mask),
            "p": TrialTruth(points=points[:3], active=active[:3], withheld=withheld, withheld_active=np.ones(4, bool)),
        },
    )


def _report(folder, effect, *, probability=0.9, alternatives=(), effects=(), miss=0.25):
    """A report whose frame scores are right but for one tie and whose prediction is ``miss`` of the nominal's off."""
    folder.mkdir(parents=True)
    verdict = {"effect": effect, "probability": probability, "alternatives": alternatives, "effects": effects}
    report = {"format": "physgen-diagnosis/1", "verdict": verdict, "effects": [], "gap": {}, "where": {}}
    (folder / "report.json").write_text(json.dumps(report))
    points = np.tile([3.0, 1.0, 1.0], (6, 1))
    np.savez(folder / "where.npz", **{"a.frame_score": np.array([0, 1, 1, 5, 0, 0.0]), "a.point_score": points})
    away = np.array([0.0, 0.0, 0.4])
    np.savez(
        folder / "prediction.npz",
        **{"p.before": np.ones((4, 3, 3)) + away, "p.after": np.ones((4, 3, 3)) + miss * away},
    )
    return folder


def _scored(tmp_path, truth, *arguments, **keywords):
    folder = _report(tmp_path / f"r{len(list(tmp_path.iterdir()))}", *arguments, **keywords)
    return score_report(folder.name, folder, truth.label(), truth.arrays(), 1.0)


def test_scores_of_a_report_made_by_hand(tmp_path):
    row = _scored(tmp_path, _truth(masked=True), "wind")
    assert row.right_first and row.right
    assert row.closed == pytest.approx(0.75) and row.reach == pytest.approx(0.75)
    assert row.frame_auc == pytest.approx((4 + 3 + 0.5) / 8)
    assert row.point_auc == 1.0
    among = _scored(tmp_path, _truth(), "air_drag", alternatives=["wind"])
    assert not among.right_first and among.right


def test_totals_of_reports_made_by_hand(tmp_path):
    two = dataclasses.replace(_truth("magnus", ("magnus", "friction")))
    rows = [
        _scored(tmp_path, _truth(), "wind", probability=0.95),
        _scored(tmp_path, _truth(), "none", probability=0.85),
        _scored(tmp_path, _truth("none", ()), "none", probability=0.95),
        _scored(tmp_path, _truth("none", ()), "friction", probability=0.45),
        _scored(tmp_path, _truth("unknown", ()), "unknown", probability=0.95),
        _scored(tmp_path, two, "friction", probability=0.95, effects=["friction"]),
    ]
    score = total_score(rows, seed=7, digest="d")
    assert score.right_first == pytest.approx(4 / 6)
    assert score.false_alarms == 0.5 and score.abstentions == 1.0
    assert score.two_cause_recall == 0.5 and score.two_cause_both == 0.0
    assert score.confusion["wind"] == {"wind": 1, "none": 1}
    assert score.calibration_error == pytest.approx((4 * 0.05 + 0.85 + 0.45) / 6)
    assert score.closed_median == pytest.approx(0.75)
    table = score_table(score)
    assert "magnus + friction" in table and "seed 7" in table
    json.dumps(score.to_json(), allow_nan=False)


def test_a_missing_report_is_wrong_and_named(tmp_path):
    truth = _truth()
    row = score_report("c", tmp_path / "nothing", truth.label(), truth.arrays(), 1.0)
    score = total_score([row])
    assert row.verdict is None and not row.right
    assert score.confusion["wind"] == {"no report": 1} and score.closed_median == 0.0


def test_a_camera_is_not_blamed_for_what_it_cannot_see(tmp_path):
    rng = np.random.default_rng(0)
    withheld = rng.normal(size=(4, 3, 3))
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    base = _truth("camera_pose", ("camera_pose",))
    trial = dataclasses.replace(base.trials["p"], withheld=withheld)
    truth = dataclasses.replace(base, trials={**base.trials, "p": trial})
    folder = _report(tmp_path / "r", "camera_pose")
    moved, away = withheld @ turn.T + (0.2, -0.1, 0), np.array([0, 0, 0.1])
    np.savez(folder / "prediction.npz", **{"p.before": withheld + away, "p.after": moved})
    assert score_report("r", folder, truth.label(), truth.arrays()).closed == pytest.approx(1.0)


@given(scores=st.lists(st.integers(0, 5), min_size=2, max_size=20), data=st.data())
@settings(deadline=None)
def test_auc_counts_pairs(scores, data):
    truth = data.draw(st.lists(st.booleans(), min_size=len(scores), max_size=len(scores)))
    true = [s for s, y in zip(scores, truth, strict=True) if y]
    false = [s for s, y in zip(scores, truth, strict=True) if not y]
    pairs = [(a > b) + 0.5 * (a == b) for a in true for b in false]
    found = rank_auc(np.array(scores, dtype=float), np.array(truth))
    assert found is None if not pairs else found == pytest.approx(np.mean(pairs))


def test_honest_probabilities_have_no_calibration_error():
    assert calibration_error(np.full(10, 0.7), np.array([1.0] * 7 + [0.0] * 3)) == pytest.approx(0.0)
    assert calibration_error(np.ones(4), np.zeros(4)) == 1.0


def _tiny(planned, rng, cancelled):
    """A case of three points, the same layout whatever is hidden in it."""
    times = np.arange(8) / 100
    rest = np.array([[0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
    points = rest + np.array([0, 0, 1.0]) - 4.905 * times[:, None, None] ** 2 * np.array([0, 0, 1.0])
    effect = planned.effects[0] if planned.effects else "none"
    truth = TrialTruth(points=points, active=np.ones(8, dtype=bool))
    ahead = TrialTruth(
        points=points[:4], active=truth.active[:4], withheld=points[4:], withheld_active=truth.active[4:]
    )
    common = {"pixels": None, "object_index": np.zeros(3, dtype=np.int64), "rest_points": rest}
    noisy = points + rng.normal(scale=1e-4, size=points.shape)
    trials = (
        Trial(name="take01", role="fit", times=times, points=noisy, **common),
        Trial(name="take02", role="predict", times=times[:4], points=noisy[:4], predict_times=times[4:], **common),
    )
    corners = 0.01 * np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=500.0, stiffness="hard")
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    capture = Capture(
        gravity=(0, 0, -9.81),
        ground=Ground(restitution=0.3),
        objects=(CaptureObject(belief=belief, vertices=corners, faces=faces),),
        noise_sigma=1e-4,
        camera=None,
        trials=trials,
    )
    return BlindCase(
        capture=capture,
        truth=Truth(
            effect=effect,
            effects=tuple(e for e in planned.effects if e != "unknown"),
            mechanism=effect,
            simulator="hand",
            parameters={},
            oracle_rms_m=1e-4,
            effect_rms_over_noise=1.0,
            trials={"take01": truth, "take02": ahead},
        ),
    )


_SPY = """
import json, os, sys
from pathlib import Path
capture, report, log = map(Path, sys.argv[1:])
around = capture.parent.parent
seen = {
    "name": capture.name,
    "files": sorted(str(p.relative_to(capture)) for p in capture.rglob("*")),
    "keys": sorted(json.loads((capture / "capture.json").read_text())),
    "times": sorted({int(p.stat().st_mtime) for p in capture.rglob("*")}),
    "around": sorted(str(p.relative_to(around)) for p in around.rglob("*") if "case-" not in str(p)),
    "arguments": sys.argv,
    "environment": sorted(os.environ.items()),
}
with log.open("a") as f:
    f.write(json.dumps(seen) + "\\n")
report.mkdir()
verdict = {"effect": "none", "probability": 0.6, "alternatives": []}
text = json.dumps({"format": "physgen-diagnosis/1", "verdict": verdict, "effects": [], "gap": {}, "where": {}})
(report / "report.json").write_text(text)
import zipfile
for name in ("where.npz", "prediction.npz"):
    zipfile.ZipFile(report / name, "w").close()
print(json.dumps({"event": "done"}))
"""


def test_the_diagnosing_process_sees_captures_and_nothing_else(tmp_path):
    log, spy = tmp_path / "log", tmp_path / "spy.py"
    spy.write_text(_SPY)

    def diagnose(capture: Path, report: Path):
        return [sys.executable, str(spy), str(capture), str(report), str(log)]

    events = []
    options = BlindCheckOptions(cases=10, diagnose=diagnose, out=tmp_path / "out")
    score = blind_check(options, events.append, never, make=_tiny)
    seen = [json.loads(line) for line in log.read_text().splitlines()]
    assert [s["name"] for s in seen] == [f"case-{i:03d}" for i in range(1, 11)]
    for key in ("files", "keys", "times", "around", "environment"):
        assert all(s[key] == seen[0][key] for s in seen), key
    assert seen[0]["around"] == ["captures", "reports"]
    labels = verify(tmp_path / "out" / "labels.json")
    secrets = {str(score.seed), json.loads((tmp_path / "out" / "labels.json").read_text())["salt"]}
    for s in seen:
        told = json.dumps([s["arguments"], s["environment"]])
        assert not any(secret in told for secret in secrets)
        assert not any(f'"{label["effect"]}"' in json.dumps(s["files"]) for label in labels.values())
    # The hash was public before the first diagnosis, and the labels have it.
    stages = [e.get("stage") for e in events]
    assert stages.index("seal") < stages.index("diagnose")
    assert score.digest in events[stages.index("seal")]["message"]
    nones = sum(label["effect"] == "none" for label in labels.values())
    assert score.right_first == pytest.approx(nones / 10) and score.false_alarms == 0.0


def test_a_diagnosis_that_fails_is_a_case_without_a_report(tmp_path):
    def diagnose(capture: Path, report: Path):
        return [sys.executable, "-c", "raise SystemExit(4)"]

    score = blind_check(BlindCheckOptions(cases=4, diagnose=diagnose), lambda e: None, never, make=_tiny)
    assert score.right == 0.0 and all("diagnosis failed" in r.note for r in score.rows)


def test_a_seed_repeats_the_cases_and_fresh_ones_differ(tmp_path):
    def diagnose(capture: Path, report: Path):
        return [sys.executable, "-c", "raise SystemExit(4)"]

    def rows(seed):
        score = blind_check(BlindCheckOptions(cases=8, seed=seed, diagnose=diagnose), lambda e: None, never, make=_tiny)
        return score.seed, [(r.case, r.effect, r.effects) for r in score.rows]

    assert rows(5) == rows(5)
    assert rows(None)[0] != rows(None)[0]


def test_the_command_says_the_numbers_of_the_check():
    parser = argparse.ArgumentParser()
    add_blind_check(parser)
    assert parser.parse_args([]).cases == BlindCheckOptions().cases
    assert f"{LEAST_CASES} or more (default {BlindCheckOptions().cases})" in parser.format_help().replace("\n", " ")


def test_without_the_optional_package_the_command_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "physgen.blind_check", None)
    options = argparse.Namespace(cases=4, seed=None, budget=None, out=None)
    with pytest.raises(InputError, match=r"pip install 'physgen\[blind\]'"):
        run_blind_check(options, lambda event: None, never)


def test_bad_options_are_refused(tmp_path):
    with pytest.raises(InputError, match="seed is -1"):
        BlindCheckOptions(seed=-1)
    with pytest.raises(InputError, match="already exists"):
        BlindCheckOptions(out=tmp_path)
