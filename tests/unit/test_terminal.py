# SPDX-License-Identifier: GPL-3.0-or-later
"""The remaining time that a command shows."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.terminal import RemainingTime


class Clock:
    """A clock that a test sets."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def event(stage, done, total, eta_s=None):
    return {"event": "progress", "stage": stage, "done": done, "total": total, "eta_s": eta_s}


GUESSES = {"reconstruct": 40.0, "bake": 30.0, "render": 200.0}


def test_first_it_is_what_was_guessed():
    assert RemainingTime(GUESSES, clock=Clock()).update(event("reconstruct", 0, 20)) == pytest.approx(270)


def test_a_stage_without_an_estimate_of_its_own_is_followed_by_its_pace():
    clock = Clock()
    left = RemainingTime({"reconstruct": 40.0}, clock=clock)
    left.update(event("reconstruct", 0, 20))
    clock.now = 300.0
    # Half is done after five minutes: the other half takes about as long, whatever was guessed.
    assert left.update(event("reconstruct", 10, 20)) == pytest.approx(225, abs=80)
    clock.now = 570.0
    assert left.update(event("reconstruct", 19, 20)) == pytest.approx(30, abs=5)


def test_a_machine_four_times_slower_than_guessed_is_so_for_what_follows():
    clock = Clock()
    left = RemainingTime(GUESSES, clock=clock)
    left.update(event("reconstruct", 0, 2))
    clock.now = 160.0
    assert left.update(event("reconstruct", 2, 2)) == pytest.approx(4 * 230)


def test_a_cached_stage_makes_no_machine_faster():
    left = RemainingTime(GUESSES, clock=Clock())
    left.update(event("reconstruct", 0, 2))
    assert left.update(event("reconstruct", 2, 2)) == pytest.approx(230)


def test_a_stage_that_begins_anew_is_counted_from_there():
    clock = Clock()
    left = RemainingTime({}, clock=clock)
    for begun in (0.0, 100.0):
        clock.now = begun
        left.update(event("rehearsal", 0, 10))
        clock.now = begun + 5.0
        assert left.update(event("rehearsal", 5, 10)) == pytest.approx(5.0, abs=2.6)


@given(st.lists(st.tuples(st.sampled_from([*GUESSES, "propose"]), st.integers(0, 9), st.integers(0, 9),
                          st.none() | st.floats(0, 1e6), st.floats(0, 1e5)), max_size=30))  # fmt: skip
def test_it_is_never_negative_nor_endless(steps):
    clock = Clock()
    left = RemainingTime(GUESSES, clock=clock)
    for stage, done, total, eta, passed in steps:
        clock.now += passed
        assert 0 <= left.update(event(stage, done, total, eta)) < 1e9
