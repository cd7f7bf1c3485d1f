# SPDX-License-Identifier: MIT
"""Every loader reads damaged and hostile files: only PhysGenError may escape, in time and in bounded memory."""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from mutations import VALUES, mutated

RUN = Path(__file__).with_name("run.py")
LEAST_LOADERS = 92


def fuzz(count, seed):
    command = [sys.executable, str(RUN), "--count", str(count), "--seed", str(seed), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
    assert done.stdout, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def check(results, count):
    assert len(results) >= LEAST_LOADERS
    assert {name: result["found"] for name, result in results.items() if result["found"]} == {}
    assert all(result["inputs"] == result["asked"] >= count / 4 for result in results.values())


def test_an_input_does_not_depend_on_earlier_ones():
    """What is put into JSON is copied: lists that held each other once made an input endless, 2,213 inputs on."""
    before, content = repr(VALUES), b'{"a": [1, {"b": 2}], "c": {}}'
    first = [mutated(content, random.Random(index), as_json=True) for index in range(400)]
    assert repr(VALUES) == before
    assert first == [mutated(content, random.Random(index), as_json=True) for index in range(400)]


@pytest.mark.long
def test_only_own_errors_escape_from_any_loader():
    check(fuzz(40, seed=0), 40)


@pytest.mark.long
def test_only_own_errors_escape_from_any_loader_with_more_inputs():
    check(fuzz(300, seed=1), 300)
