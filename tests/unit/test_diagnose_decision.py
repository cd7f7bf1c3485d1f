# SPDX-License-Identifier: MIT
"""From fits to a verdict: evidence, misfit, alternatives, gap, places, words, files."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.diagnose import diagnosis as files
from physgen.sim.diagnose.comparison_settings import ComparisonSettings
from physgen.sim.diagnose.diagnosis import NONE, UNKNOWN, Diagnosis, Gap, Localisation, TrialArrays, Verdict
from physgen.sim.diagnose.fits import CandidateFit, Discrepancy, Estimate, PhaseInterval
from physgen.sim.diagnose.gap_metrics import carried_residual, localise
from physgen.sim.diagnose.model_comparison import ModelComparison, compare_models
from physgen.sim.diagnose.report.assumptions import assumptions
from physgen.sim.diagnose.report.wording import alternatives_sentence, verdict_summary
from physgen.sim.diagnose.run_diagnosis import found_fit
from physgen.sim.diagnose.suggested_experiments import next_experiment, recorded_setting
from physgen.sim.errors import InputError

from .test_capture import a_capture, a_trial


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """Fits with made-up numbers."""

    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float = 0.004
    grain_rms_m: float = 0.0


def fit(
    *effects, evidence=0.0, misfit=1.0, rms=None, chi=math.nan, trials=(), elsewhere=(), bending=0.0, limit=math.nan
):
    parameters = {name: {"x": Estimate(value=1.0, unit="1", low=0.5, high=1.5)} for name in effects}
    return CandidateFit(
        effects=effects,
        parameters=parameters,
        log_evidence=evidence,
        heldout_log_score=np.zeros(3),
        heldout_rms_m=(0.005 if effects else 0.01) if rms is None else rms,
        misfit=misfit,
        heldout_chi=float(np.sqrt(np.mean(np.square(trials)))) if trials else chi,
        heldout_trials=tuple(trials),
        heldout_elsewhere=tuple(elsewhere),
        bending=bending,
        limit=limit,
    )


def weighed(*candidates, nominal_evidence=0.0, nominal_misfit=1.0, weighing=None):
    nominal = fit(evidence=nominal_evidence, misfit=nominal_misfit)
    return compare_models(
        Found(nominal=nominal, refitted=nominal, candidates=candidates), weighing or ComparisonSettings()
    )


def test_a_plain_winner_wins():
    result = weighed(fit("air_drag", evidence=500), fit("wind", evidence=0), nominal_misfit=10.0)
    assert result.verdict.effect == "air_drag" and result.verdict.probability > 0.9
    assert result.verdict.effects == ("air_drag",) and "friction" not in result.verdict.alternatives


def test_nothing_missing_is_none_and_everything_bad_is_unknown():
    assert weighed(fit("air_drag", evidence=1.0)).verdict.effect == NONE
    bad = weighed(fit("air_drag", evidence=900, misfit=9.0), nominal_misfit=12.0)
    assert bad.verdict.effect == UNKNOWN and bad.verdict.effects == ()


def test_indistinguishable_candidates_are_named():
    result = weighed(fit("time_scale", evidence=300.0), fit("buoyancy", evidence=297.0), nominal_misfit=5.0)
    assert result.verdict.effect == "time_scale" and result.verdict.alternatives == ("buoyancy",)


def test_two_causes_count_for_the_first():
    alone = fit("friction", evidence=100, misfit=4.0), fit("air_drag", evidence=50, misfit=4.5)
    result = weighed(*alone, fit("friction", "air_drag", evidence=900))
    assert result.verdict.effect == "friction" and result.verdict.effects == ("friction", "air_drag")


def test_candidates_without_predictive_gain_are_rejected():
    result = weighed(fit("restitution", evidence=56.0, rms=0.012), nominal_misfit=1.2)
    assert result.verdict.effect == NONE


def test_a_second_cause_has_to_earn_its_place():
    singles = fit("friction", evidence=900, misfit=1.2), fit("air_drag", evidence=20, misfit=4.0)
    little = weighed(*singles, fit("friction", "air_drag", evidence=908, misfit=1.0), nominal_misfit=5.0)
    assert little.verdict.effects == ("friction",)
    hardly = weighed(*singles, fit("friction", "air_drag", evidence=990, misfit=1.19), nominal_misfit=5.0)
    assert hardly.verdict.effects == ("friction",)


def test_a_pair_is_judged_in_nats():
    singles = fit("friction", evidence=900, misfit=1.2), fit("air_drag", evidence=20, misfit=4.0)
    found = weighed(*singles, fit("friction", "air_drag", evidence=990, misfit=1.1, rms=0.004), nominal_misfit=5.0)
    assert found.verdict.effects == ("friction", "air_drag")
    worse = weighed(*singles, fit("friction", "air_drag", evidence=990, misfit=1.3, rms=0.004), nominal_misfit=5.0)
    assert worse.verdict.effects == ("friction",)


@pytest.mark.parametrize(("left", "both"), [(0.2, True), (0.5, True), (0.96, False), (1.1, False)])
def test_a_second_cause_at_contacts_shows_in_held_out_trials(left, both):
    """A hollow box in air: +31 nats over drag alone, because states between contacts absorb what its inertia does,
    and held-out trials predicted four times as well."""
    singles = fit("air_drag", evidence=900, misfit=0.96, chi=1.5), fit("inertia", evidence=20, misfit=20.0, chi=2.0)
    nominal = fit(misfit=28.0, chi=2.4)
    pair = fit("air_drag", "inertia", evidence=931, misfit=0.87, chi=1.5 * left)
    models = Found(nominal=nominal, refitted=nominal, candidates=(*singles, pair))
    found = compare_models(models, ComparisonSettings()).verdict
    assert found.effects == (("air_drag", "inertia") if both else ("air_drag",))
    # What it gains has to be more than a second prior is worth, all the same.
    little = dataclasses.replace(models, candidates=(*singles, dataclasses.replace(pair, log_evidence=910.0)))
    assert compare_models(little, ComparisonSettings()).verdict.effects == ("air_drag",)


def test_a_pair_that_shares_a_cause_with_the_verdict_is_named_by_the_other():
    """Drag and lift beside wind and lift: what the data cannot tell apart are drag and wind, and not drag and lift."""
    singles = fit("air_drag", evidence=300, misfit=3.0), fit("magnus", evidence=200, misfit=3.5)
    singles += (fit("wind", evidence=100, misfit=4.0),)
    pairs = fit("air_drag", "magnus", evidence=2000, rms=0.004), fit("magnus", "wind", evidence=1999, rms=0.004)
    result = weighed(*singles, *pairs, nominal_misfit=6.0)
    assert result.verdict.effects == ("air_drag", "magnus") and result.verdict.alternatives == ("wind",)
    assert result.best["wind"].effects == ("magnus", "wind") and result.best["magnus"].effects == ("magnus",)
    assert result.probabilities["magnus"] < 0.01 < result.probabilities["wind"] < result.probabilities["air_drag"]
    # As much in all for the pair with wind as for the verdict: each counts for its first effect, and none is hidden.
    even = weighed(*singles, pairs[0], dataclasses.replace(pairs[1], log_evidence=2000.0), nominal_misfit=6.0)
    assert even.verdict.effects == ("air_drag", "magnus") and "magnus" not in even.verdict.alternatives


def test_a_pair_names_what_is_the_same_motion():
    singles = (
        fit("time_scale", evidence=900, misfit=2.2),
        fit("buoyancy", evidence=900, misfit=2.2),
        fit("friction", evidence=20, misfit=4.0),
    )
    found = weighed(*singles, fit("time_scale", "friction", evidence=1300, rms=0.004), nominal_misfit=5.0)
    assert found.verdict.effects == ("time_scale", "friction") and found.verdict.alternatives == ("buoyancy",)


def test_chaotic_held_out_motion_does_not_veto_a_large_gain():
    """An adhesion that gains 472 nats, on bounces whose prediction wanders by twice the gap."""
    nominal = fit(misfit=1.9, rms=0.0134)
    adhesion, little = (fit("adhesion", evidence=e, misfit=0.9, rms=0.0142) for e in (472.0, 60.0))

    def verdict(candidate, grain):
        models = Found(
            nominal=nominal, refitted=nominal, candidates=(candidate,), floor_rms_m=0.0017, grain_rms_m=grain
        )
        return compare_models(models, ComparisonSettings()).verdict.effect

    assert verdict(adhesion, 0.0237) == "adhesion"
    assert verdict(adhesion, 0.0) == UNKNOWN and verdict(little, 0.0237) in (NONE, UNKNOWN)


@pytest.mark.parametrize(("misfit", "limit", "named"), [(1.0, 1.27, True), (1.5, 1.27, False), (1.5, 1.8, True)])
def test_what_a_deformable_leaves_is_measured_by_what_its_lattices_leave_open(misfit, limit, named):
    damping = fit("internal_damping", evidence=500.0, misfit=misfit, limit=limit)
    found = weighed(damping, nominal_misfit=1.7)
    assert (found.verdict.effect, found.probabilities[UNKNOWN] > 0.9) == (
        ("internal_damping", False) if named else (UNKNOWN, True)
    )


def test_a_cause_of_a_deformable_that_predicts_no_better_is_not_named():
    """Beams: both lattices of the simulator are as far apart as the gap, and a stiffness gains 851 nats on trials."""
    nominal = fit(misfit=1.0, rms=0.084, limit=1.7)
    stiffer, better = (fit("stiffness", evidence=851.0, rms=rms, limit=1.7) for rms in (0.098, 0.02))

    def verdict(candidate):
        models = Found(
            nominal=nominal, refitted=nominal, candidates=(candidate,), floor_rms_m=0.0014, grain_rms_m=0.103
        )
        return compare_models(models, ComparisonSettings()).verdict.effect

    assert verdict(stiffer) == UNKNOWN and verdict(better) == "stiffness"


def test_a_trial_that_tumbles_chaotically_does_not_decide_what_predicts_better():
    """Cubes whose inertia gained 137 nats: four tosses predicted better, the fifth comes to lie on another face."""
    nominal = fit(misfit=4.0, rms=0.0537, chi=2.6)

    def probability(**held):
        hollow = fit("inertia", evidence=137.0, misfit=1.8, **held)
        models = Found(nominal=nominal, refitted=nominal, candidates=(hollow,), floor_rms_m=0.0225, grain_rms_m=0.0218)
        return compare_models(models, ComparisonSettings()).probabilities["inertia"]

    assert probability(rms=0.0567, chi=2.0) > 0.8
    assert probability(rms=0.0567, chi=2.7) < 0.1 and probability(rms=0.0567) < 0.1


@given(st.floats(0.0, 1e5), st.floats(1.0, 4.0), st.floats(0.3, 12.0), st.floats(1e-3, 1.0))
def test_what_predicts_worse_than_nothing_is_never_sure(evidence, growth, nominal_misfit, grain):
    """An adhesion was named with p = 1.00 where its held-out error was half again the nominal model's."""
    nominal = fit(misfit=nominal_misfit, rms=0.0055)
    adhesion = fit("adhesion", evidence=evidence, misfit=0.8, rms=0.0055 * growth)
    found = compare_models(
        Found(nominal=nominal, refitted=nominal, candidates=(adhesion,), grain_rms_m=grain), ComparisonSettings()
    )
    assert found.probabilities["adhesion"] <= 0.9 / growth + 1e-9
    surely = compare_models(
        Found(nominal=nominal, refitted=nominal, candidates=(dataclasses.replace(adhesion, heldout_rms_m=0.004),)),
        ComparisonSettings(),
    )
    assert surely.probabilities["adhesion"] > 0.95 or evidence < 60


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["air_drag", "wind", "friction", "buoyancy"]),
            st.one_of(st.floats(-1e6, 1e6), st.just(-math.inf), st.just(math.nan)),
            st.one_of(st.floats(1e-3, 1e4), st.just(math.nan), st.just(math.inf)),
        ),
        max_size=6,
    ),
    st.floats(-1e6, 1e6),
    st.floats(0.1, 100),
)
def test_probabilities_are_probabilities(candidates, evidence, misfit):
    result = weighed(
        *(fit(name, evidence=e, misfit=m) for name, e, m in candidates),
        nominal_evidence=evidence,
        nominal_misfit=misfit,
    )
    values = list(result.probabilities.values())
    assert all(0 <= p <= 1 for p in values) and sum(values) == pytest.approx(1.0)
    assert result.probabilities[result.verdict.effect] == max(values) == result.verdict.probability
    assert result.verdict.effect not in result.verdict.alternatives


@given(
    st.lists(
        st.tuples(st.sampled_from(["air_drag", "wind", "friction"]), st.floats(-1e4, 1e4), st.floats(1e-4, 1.0)),
        max_size=4,
    ),
    st.floats(1e-4, 1.0),
    st.floats(1e-4, 0.3),
    st.floats(0.0, 0.3),
)
def test_none_is_never_said_of_an_error_many_times_noise_and_grain(candidates, error, floor, grain):
    """The hard rule: three real gaps of 12 to 31 mm had been called ``none``."""
    nominal = fit(misfit=1.0, rms=error)
    found = compare_models(
        Found(
            nominal=nominal,
            refitted=nominal,
            candidates=tuple(fit(n, evidence=e, rms=r) for n, e, r in candidates),
            floor_rms_m=floor,
            grain_rms_m=grain,
        ),
        ComparisonSettings(),
    )
    if error > 3.0 * math.hypot(floor, grain):
        assert found.verdict.effect != NONE and found.probabilities[NONE] == 0.0
        if not candidates:
            assert found.verdict.effect == UNKNOWN and "3 times" in found.reasons[NONE]


def nothing_found(**held):
    """The verdict without candidates, where noise and grain of all trials together excuse the error."""
    nominal = fit(rms=0.02, **held)
    fits = Found(nominal=nominal, refitted=nominal, candidates=(), floor_rms_m=0.001, grain_rms_m=0.012)
    return compare_models(fits, ComparisonSettings())


def test_none_is_never_said_where_trials_are_many_times_off_each():
    """A rolling resistance that nothing offered: two trials 7 and 8 times as far off as they should be, beside the
    grain of one that tumbles, were ``none`` at 0.91."""
    found = nothing_found(trials=(1.4, 8.5, 1.4, 7.2, 1.4))
    assert found.verdict.effect == UNKNOWN and found.probabilities[NONE] == 0.0
    assert "5.1 times" in found.reasons[NONE]
    # One trial that comes to lie on another face is no gap, nor is what noise makes of a single one.
    fallen = (False, True, False, False, False)
    assert nothing_found(trials=(0.5, 9.0, 0.6, 0.4, 0.8), elsewhere=fallen).verdict.effect == NONE
    # All of them are one, and so is one that lies as predicted, beside others in which the cause hardly acts.
    assert nothing_found(trials=(5.0, 9.0, 6.0, 4.0, 8.0), elsewhere=(True,) * 5).verdict.effect == UNKNOWN
    restitution = nothing_found(trials=(0.5, 0.5, 8.3, 0.7), elsewhere=(False,) * 4)
    assert restitution.verdict.effect == UNKNOWN and restitution.probabilities[NONE] == 0.0
    assert nothing_found(trials=(2.0,)).verdict.effect == NONE and nothing_found().verdict.effect == NONE


@pytest.mark.parametrize("count", [1, 2, 5])
def test_noise_alone_hardly_ever_excludes_none(count):
    drawn = np.abs(np.random.default_rng(count).normal(size=(400, count)))
    false = sum(nothing_found(trials=tuple(map(float, trials))).verdict.effect != NONE for trials in drawn)
    # One in a thousand is wanted; 4 of 400 or more have a chance of one in a thousand then.
    assert false < 4
    assert all(nothing_found(trials=tuple(map(float, 4 + trials))).verdict.effect == UNKNOWN for trials in drawn[:20])


@pytest.mark.parametrize(
    ("chi", "nats", "found"), [(0.95, 15.8, "friction"), (2.25, 15.8, UNKNOWN), (0.95, 2.0, UNKNOWN)]
)
def test_what_held_out_trials_ask_for_pays_no_fee_for_the_search(chi, nats, found):
    """A friction of 0.305 for 0.334 gains 16 nats in all, as states between contacts absorb what it does; held-out
    trials exclude none, and it predicts them down to noise and grain. It was unknown, 0.53."""
    nominal = fit(misfit=0.78, rms=0.0089, trials=(2.3, 1.0, 1.1, 3.1, 3.1))
    friction = fit("friction", evidence=nats, misfit=0.70, rms=0.0031, chi=chi)
    fits = Found(nominal=nominal, refitted=nominal, candidates=(friction,), floor_rms_m=0.0019, grain_rms_m=0.0034)
    result = compare_models(fits, ComparisonSettings())
    assert result.verdict.effect == found and result.probabilities[NONE] == 0.0
    if found == "friction":
        assert 0.7 < result.verdict.probability < 0.9
        # Trials that do not exclude none leave it to the evidence, which is little.
        quiet = dataclasses.replace(nominal, heldout_chi=1.0, heldout_trials=(1.0,) * 5)
        calm = dataclasses.replace(friction, heldout_chi=0.4)
        fits = dataclasses.replace(fits, nominal=quiet, refitted=quiet, candidates=(calm,))
        assert compare_models(fits, ComparisonSettings()).verdict.effect == NONE


def test_none_yields_to_unknown_as_what_is_left_bends():
    found = [nothing_found(bending=nats) for nats in (0.0, 3.0, 4.5, 4.7, 6.0, 24.0)]
    said = [f.probabilities[NONE] for f in found]
    assert all(a > b for a, b in itertools.pairwise(said)) and said[0] > 0.9 and said[-1] < 1e-6
    assert said[0] == nothing_found(trials=(1.0, 1.0)).probabilities[NONE] > 0.95
    assert [f.verdict.effect for f in found[1:]] == [NONE, NONE, UNKNOWN, UNKNOWN, UNKNOWN]
    assert "bends" in nothing_found(bending=24.0).reasons[NONE]


@pytest.mark.parametrize(("nats", "misfit", "found"), [(27.7, 0.9, UNKNOWN), (2.0, 0.9, NONE), (128.0, 28.7, NONE)])
def test_none_yields_to_unknown_where_other_contacts_explain_the_trials(nats, misfit, found):
    """Without its inertia among the candidates a ball was none, 0.92: within noise and grain, but its friction would
    have to be three standard deviations off, and more. What leaves far more of the trials explains nothing."""
    nominal = fit(misfit=0.97, rms=0.0118, trials=(1.4, 0.5, 1.1))
    friction = fit("friction", evidence=nats, misfit=misfit, rms=0.0121)
    other = fit("friction", "restitution", evidence=nats, misfit=misfit, rms=0.0121)
    fits = Found(nominal=nominal, refitted=other, candidates=(friction,), floor_rms_m=0.002, grain_rms_m=0.0125)
    result = compare_models(fits, ComparisonSettings())
    assert result.verdict.effect == found and result.verdict.probability > 0.7
    if found == UNKNOWN:
        assert "plausible ranges" in result.reasons[NONE]
    # A restitution that shows in held-out trials is named, whatever the other one makes of them.
    bounce = fit("restitution", evidence=57.2, misfit=0.73, rms=0.0035)
    named = compare_models(dataclasses.replace(fits, candidates=(friction, bounce)), ComparisonSettings())
    assert named.verdict.effect == "restitution" and named.verdict.probability > 0.95


def test_the_simulators_own_grain_is_no_gap():
    nominal = fit(rms=0.03)
    fits = Found(nominal=nominal, refitted=nominal, candidates=(), floor_rms_m=0.001, grain_rms_m=0.02)
    assert compare_models(fits, ComparisonSettings()).verdict.effect == NONE
    assert compare_models(dataclasses.replace(fits, grain_rms_m=0.002), ComparisonSettings()).verdict.effect == UNKNOWN


def test_no_evidence_makes_a_verdict_sure():
    """Untested effects are unknown, and what every answer keeps is too little to be named as an alternative."""
    lapse = ComparisonSettings().lapse
    sure = weighed(fit("air_drag", evidence=1e6), fit("wind", evidence=0), nominal_misfit=10.0)
    assert 1 - lapse < sure.verdict.probability < 1 - 0.9 * lapse
    assert sum(sure.probabilities.values()) == pytest.approx(1.0) and sure.verdict.alternatives == ()
    assert sure.probabilities[UNKNOWN] > 10 * sure.probabilities["wind"] == pytest.approx(10 * lapse / 21)
    plain = weighed(fit("air_drag", evidence=1e6), nominal_misfit=10.0, weighing=ComparisonSettings(lapse=0.0))
    assert plain.verdict.probability > 0.999 > sure.verdict.probability


def test_what_predicts_down_to_the_noise_is_not_unknown():
    """A large misfit alone does not reject an effect that closes the whole gap on held-out trials."""
    rough = [fit("wind", evidence=900, misfit=9.0, rms=rms) for rms in (0.0041, 0.0047, 0.008)]
    fits = [
        Found(nominal=fit(misfit=12.0, rms=0.04), refitted=fit(misfit=12.0, rms=0.04), candidates=(r,)) for r in rough
    ]
    found = [compare_models(f, ComparisonSettings()) for f in fits]
    assert [f.verdict.effect for f in found] == ["wind", "wind", UNKNOWN]
    assert found[0].probabilities[UNKNOWN] <= ComparisonSettings().lapse
    assert found[2].reasons["wind"] == "leaves 9.0 times the noise unexplained"


@pytest.mark.parametrize(("misfit", "found"), [(28.7, NONE), (2.3, UNKNOWN)])
def test_an_effect_that_leaves_far_more_than_the_nominal_model_takes_nothing_from_none(misfit, found):
    """A restitution whose contacts were surer, and wrong, made a recording of the nominal motion unknown."""
    better = fit("restitution", evidence=128.0, misfit=misfit, rms=0.005)
    assert weighed(better, nominal_misfit=1.2).verdict.effect == found


def test_a_better_fit_never_loses_probability():
    probabilities = [
        weighed(fit("wind", evidence=e), fit("air_drag", evidence=50.0)).probabilities["wind"] for e in range(0, 200, 5)
    ]
    assert (np.diff(probabilities) >= 0).all()


def discrepancy(trial, scores):
    count = trial.observed.shape[1]
    return Discrepancy(
        frame_score=scores,
        point_score=np.tile(scores[:, None], (1, count)),
        residual=np.zeros_like(trial.observed),
        intervals=(
            PhaseInterval(start_s=float(trial.times[0]), end_s=float(trial.times[10]), phase="flight"),
            PhaseInterval(start_s=float(trial.times[10]), end_s=float(trial.times[-1]), phase="contact"),
        ),
        directions={"normal": 1.0, "along_velocity": 0.0, "along_gravity": 0.0, "other": 0.0},
    )


def test_what_differs_by_rounding_is_the_same_motion():
    """Re-fitted contacts of a flight: the comparison said *the same motion* and drew another curve."""
    nominal = fit(misfit=9.0, rms=0.0214)
    for rms, other in ((0.0214 * (1 - 1e-14), False), (0.0213, True), (0.0215, False)):
        refitted = dataclasses.replace(fit(misfit=9.0, rms=rms), log_evidence=1.0)
        models = Found(nominal=nominal, refitted=refitted, candidates=())
        for effect in (NONE, UNKNOWN):
            weighed = ModelComparison(
                verdict=Verdict(effect=effect, probability=0.9), probabilities={}, best={}, reasons={}
            )
            assert found_fit(models, weighed) is (refitted if other else nominal)


def test_shares_of_time_follow_the_scores():
    capture = a_capture(a_trial())
    scores = np.where(np.arange(20) < 10, 3.0, 1.0)
    where = localise(capture, {"take01": discrepancy(capture.trials[0], scores)})
    assert [i.phase for i in where.intervals] == ["flight", "contact"]
    # The first frame and the last stand for half a frame: 9.5 frames of 3 against 9.5 of 1.
    assert where.intervals[0].share == pytest.approx(0.75) and where.objects[0].share == 1.0
    assert where.direction["normal"] == 1.0


def test_no_discrepancy_is_no_division_by_zero():
    capture = a_capture(a_trial())
    where = localise(capture, {"take01": discrepancy(capture.trials[0], np.zeros(20))})
    assert sum(i.share for i in where.intervals) == pytest.approx(1.0)
    assert sum(where.direction.values()) == pytest.approx(1.0)


GAP = Gap(
    before_rms_m=0.02,
    refitted_rms_m=0.015,
    after_rms_m=0.004,
    noise_floor_rms_m=0.002,
    closed_fraction=0.889,
    closed_fraction_ci95=(0.8, 0.93),
    resolvable=True,
)


def test_the_verdict_in_words():
    verdict = Verdict(effect="time_scale", probability=0.6, alternatives=("buoyancy",), effects=("time_scale",))
    text = verdict_summary(verdict, GAP)
    assert "clock" in text and "buoyancy" in text and "60 %" in text and "89 %" in text
    # One rounding on the whole page: the table shows 99.6 %.
    assert "(99.6 % confidence)" in verdict_summary(dataclasses.replace(verdict, probability=0.9964), GAP)
    pair = Verdict(effect="air_drag", probability=0.6, alternatives=("magnus", "wind"), effects=("air_drag", "magnus"))
    assert "cannot rule out Magnus lift alone or wind" in verdict_summary(pair, GAP)
    assert "distinguish them from Magnus lift alone or wind" in str(alternatives_sentence(pair))
    unsure = dataclasses.replace(GAP, resolvable=False)
    assert "too close to the noise" in verdict_summary(verdict, unsure)
    assert "explains" in verdict_summary(Verdict(effect=NONE, probability=0.9), GAP)
    assert "no known effect" in verdict_summary(Verdict(effect=UNKNOWN, probability=0.9), GAP)


def test_a_verdict_of_none_does_not_explain_more_than_noise_and_grain_do():
    """16 mm beside a floor of 6 mm, as of a ball launched at 45 degrees: too little for a cause, and not nothing."""
    none = Verdict(effect=NONE, probability=0.85)
    left = dataclasses.replace(GAP, before_rms_m=0.0162, noise_floor_rms_m=0.0059, grain_rms_m=0.0)
    assert "2.7 times" in verdict_summary(none, left) and "down to its noise" not in verdict_summary(none, left)
    chaotic = dataclasses.replace(left, grain_rms_m=0.03)
    assert "down to its noise and the simulator's own uncertainty" in verdict_summary(none, chaotic)


def test_every_effect_has_words_and_an_experiment():
    from physgen.sim.diagnose.model_comparison import kind_of
    from physgen.sim.diagnose.report.effect_words import LABELS
    from physgen.sim.effects.registry import effects

    vocabulary = [name for name in effects() if name != "sandy"]
    assert set(vocabulary) <= set(LABELS)
    kinds = {name: kind_of(name) for name in vocabulary}
    for a in vocabulary:
        for b in vocabulary:
            if a != b:
                verdict = Verdict(effect=a, probability=0.5, alternatives=(b,), effects=(a,))
                assert next_experiment(verdict, kinds, resolvable=True)
    assert next_experiment(Verdict(effect=NONE, probability=0.9), kinds, resolvable=True) is None


def test_a_single_recording_is_to_be_repeated():
    """Half of it judges the other half: that no further recording is needed would be said too soon."""
    verdict, kinds = Verdict(effect="air_drag", probability=0.9, effects=("air_drag",)), {"air_drag": "force"}
    for count in (1, 2):
        capture = a_capture(*(a_trial(f"take{k}") for k in range(count)))
        setting = recorded_setting(capture)
        said = next_experiment(verdict, kinds, resolvable=True, setting=setting)
        assert (said is not None and "two more times" in said) == (count == 1)
        one = [line for line in assumptions(capture) if "complete trial" in line]
        assert len(one) == 1 and ("second half judges" in one[0]) == (count == 1)


def a_diagnosis(capture):
    trial = capture.trials[0]
    count = trial.observed.shape[1]
    arrays = TrialArrays(
        times=trial.times,
        frame_score=np.ones(20),
        point_score=np.ones((20, count)),
        residual=np.zeros((20, count, 3)),
        nominal=trial.observed,
        found=trial.observed,
        before=np.zeros((5, count, 3)),
        after=np.zeros((5, count, 3)),
    )
    return Diagnosis(
        verdict=Verdict(effect="air_drag", probability=0.9, effects=("air_drag",)),
        effects=(files.RankedEffect(name="air_drag", kind="force", probability=0.9, heldout_rms_m=math.nan),),
        gap=GAP,
        controls={"wrong_effect_rms_m": math.nan, "last_residual_rms_m": 0.1},
        next_experiment=None,
        where=Localisation(objects=(), intervals=(), direction={}),
        trials={"take01": arrays},
        summary="Missing is air drag.",
    )


def test_a_diagnosis_is_written_and_read(tmp_path):
    files.write_diagnosis(a_diagnosis(a_capture()), tmp_path)
    report, where, prediction = files.read_diagnosis(tmp_path)
    assert report["verdict"]["effect"] == "air_drag" and report["controls"]["wrong_effect_rms_m"] is None
    assert where["take01.frame_score"].shape == (20,) and prediction["take01.after"].shape == (5, 8, 3)
    (tmp_path / "report.json").write_text('{"format": "physgen-diagnosis/1", "verdict": 3}')
    with pytest.raises(InputError, match="verdict: missing or malformed"):
        files.read_diagnosis(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        files.read_diagnosis(tmp_path / "nowhere")


@pytest.mark.filterwarnings("error")
def test_a_trial_that_nothing_is_seen_of_later_has_no_carried_residual_and_warns_of_nothing():
    seen = a_trial(frames=40)
    assert seen.points is not None
    nominal = {seen.name: seen.points + 0.002}
    assert carried_residual(a_capture(seen), nominal) == pytest.approx(0.0, abs=1e-9)
    lost = seen.points.copy()
    lost[12:] = np.nan
    gone = dataclasses.replace(seen, points=lost)
    assert math.isnan(carried_residual(a_capture(gone), nominal))
