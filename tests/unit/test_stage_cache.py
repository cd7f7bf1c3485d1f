# SPDX-License-Identifier: MIT
"""A stage is computed once for the same inputs, and again for others; damaged files count as none."""

import dataclasses
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.reconstruct.stage_cache import StageCache, inputs_hash


@dataclasses.dataclass(frozen=True)
class Options:
    width: int = 3
    name: str | None = None


def make_counting(calls, **arrays):
    def make(notice):
        calls.append(1)
        notice("found something")
        return arrays or {"value": np.arange(4)}

    return make


def test_cached_results_come_with_their_notices(tmp_path):
    calls, said = [], []
    first = StageCache(tmp_path / "a", tmp_path / "none", said.append)
    first.run("cut", {"pixels": np.zeros((2, 2))}, make_counting(calls))
    second = StageCache(tmp_path / "b", tmp_path / "a", said.append)
    found = second.run("cut", {"pixels": np.zeros((2, 2))}, make_counting(calls))
    assert len(calls) == 1 and said == ["found something"] * 2
    assert second.recalled == ["cut"] and (found["value"] == np.arange(4)).all()
    # What was recalled is kept for the time after.
    third = StageCache(tmp_path / "c", tmp_path / "b", said.append)
    third.run("cut", {"pixels": np.zeros((2, 2))}, make_counting(calls))
    assert len(calls) == 1


def test_other_inputs_are_computed_and_what_nobody_asks_for_is_left_behind(tmp_path):
    calls = []
    first = StageCache(tmp_path / "a", tmp_path / "none", lambda _: None)
    first.run("cut", {"pixels": np.zeros((2, 2))}, make_counting(calls))
    second = StageCache(tmp_path / "b", tmp_path / "a", lambda _: None)
    second.run("cut", {"pixels": np.ones((2, 2))}, make_counting(calls))
    assert len(calls) == 2 and second.recalled == []
    assert len(list((tmp_path / "b").iterdir())) == 1


@pytest.mark.parametrize(
    "others",
    [
        {"a": np.zeros(4)},
        {"a": np.zeros((2, 2), dtype=np.float32)},
        {"a": np.zeros((2, 2)), "b": None},
        {"a": [np.zeros((2, 2))]},
        {"b": np.zeros((2, 2))},
    ],
)
def test_the_hash_sees_shapes_types_names_and_nesting(others):
    assert inputs_hash("s", {"a": np.zeros((2, 2))}) != inputs_hash("s", others)
    assert inputs_hash("s", others) != inputs_hash("t", others)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(st.text(), values, max_size=5), st.dictionaries(st.text(), values, max_size=5))
def test_equal_inputs_and_no_others_have_equal_hashes(first, second):
    same = inputs_hash("s", first) == inputs_hash("s", second)
    assert same == (repr(sorted(first.items())) == repr(sorted(second.items()))) or first == second


def test_dataclasses_are_inputs_and_what_cannot_be_compared_is_refused():
    assert inputs_hash("s", {"o": Options()}) != inputs_hash("s", {"o": Options(width=4)})
    with pytest.raises(TypeError, match="object"):
        inputs_hash("s", {"o": object()})


@given(st.binary(max_size=300))
def test_garbage_in_place_of_a_result_is_computed_again(tmp_path_factory, garbage):
    folder = tmp_path_factory.mktemp("stages")
    (folder / f"cut-{inputs_hash('cut', {})}.npz").write_bytes(garbage)
    calls = []
    store = StageCache(folder / "new", folder, lambda _: None)
    assert (store.run("cut", {}, make_counting(calls))["value"] == np.arange(4)).all()
    assert len(calls) == 1


def test_files_that_would_fill_memory_or_hold_objects_are_computed_again(tmp_path):
    name = f"cut-{inputs_hash('cut', {})}.npz"
    with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("big.npy", "w") as file:
        block = bytes(2**20)
        for _ in range(1100):
            file.write(block)
    calls = []
    StageCache(tmp_path / "new", tmp_path, lambda _: None).run("cut", {}, make_counting(calls))
    np.savez(tmp_path / name, value=np.array([object()], dtype=object), notices=np.array("[]"))
    StageCache(tmp_path / "newer", tmp_path, lambda _: None).run("cut", {}, make_counting(calls))
    assert len(calls) == 2
