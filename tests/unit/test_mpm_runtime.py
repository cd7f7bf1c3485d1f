# SPDX-License-Identifier: MIT
"""Patches of Taichi are skipped where its version differs; its check for updates is disabled; arrays are given back."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from physgen.sim.memory import resident_memory
from physgen.sim.mpm.kernels import runtime
from physgen.sim.mpm.kernels.layout import mat3, vec4
from physgen.sim.mpm.solver_options import SolverOptions
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext


@pytest.fixture(autouse=True)
def restored():
    before = ASTTransformerContext.get_pos_info
    yield
    ASTTransformerContext.get_pos_info = before


def test_a_line_is_named_and_not_drawn_and_what_is_unknown_is_left_to_taichi(monkeypatch):
    asked = []
    monkeypatch.setattr(ASTTransformerContext, "get_pos_info", lambda context, node: f"drawn {asked.append(node)}")
    runtime._leave_source_lines_out()
    runtime._leave_source_lines_out()
    context = SimpleNamespace(file="a.py", lineno_offset=10, func=SimpleNamespace(func=runtime.generation))
    said = ASTTransformerContext.get_pos_info(context, SimpleNamespace(lineno=2))
    assert said == 'File "a.py", line 12, in generation:\n' and not asked
    assert ASTTransformerContext.get_pos_info(object(), "node") == "drawn None" and asked == ["node"]


def test_a_taichi_without_it_starts_all_the_same(monkeypatch):
    monkeypatch.delattr(ASTTransformerContext, "get_pos_info")
    runtime._leave_source_lines_out()
    assert not hasattr(ASTTransformerContext, "get_pos_info")


CALLS = """
import sys, threading
calls = []
sys.addaudithook(lambda event, arguments: calls.append(event) if event.startswith(("socket.", "urllib.")) else None)
%s
for thread in threading.enumerate():
    if thread is not threading.current_thread():
        thread.join(20)
print(" ".join(calls))
"""
OURS = """
from physgen.sim.mpm.kernels.runtime import ensure_started
from physgen.sim.mpm.solver_options import SolverOptions
ensure_started(SolverOptions())
"""
TAICHI = "import taichi; taichi.init(arch=taichi.cpu)"


@pytest.mark.parametrize(("start", "asks"), [(OURS, False), (TAICHI, True)])
def test_the_engine_asks_nobody_for_a_newer_version(tmp_path, start, asks):
    """Taichi does, once a day: with a new home it is due. The second case shows that this test would notice."""
    away = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "https_proxy": "http://127.0.0.1:9"}
    kept = {key: value for key, value in os.environ.items() if key != "TI_SKIP_VERSION_CHECK"}
    result = subprocess.run(
        [sys.executable, "-c", CALLS % start], env={**kept, **away}, capture_output=True, text=True, check=True
    )
    assert ("urllib.Request" in result.stdout.splitlines()[-1]) == asks, result.stdout


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="what this process holds is read from /proc")
@pytest.mark.parametrize("kind", [vec4, mat3])
def test_the_memory_of_arrays_that_nothing_refers_to_is_given_back(kind):
    """Taichi keeps that of vectors and matrices until it is restarted: twenty of 16 MB would take 320 MB."""
    runtime.ensure_started(SolverOptions())
    length = 4_000_000 // (kind.n * kind.m if kind is mat3 else kind.n)
    array = runtime.new_array(kind, length)
    before = resident_memory()
    for _ in range(20):
        array = runtime.new_array(kind, length)
    assert array.shape == (length,)
    assert resident_memory() - before < 3 * 16_000_000


RESTARTED = """
import gc
import numpy as np
import taichi as ti
from physgen.sim.mpm.kernels.layout import vec4
from physgen.sim.mpm.kernels.runtime import ensure_started, generation, new_array
from physgen.sim.mpm.solver_options import SolverOptions

def arrays(count, value):
    made = [new_array(kind, 1000) for kind in (ti.f32, vec4) for _ in range(count)]
    for array in made:
        array.fill(value)
    return made

ensure_started(SolverOptions())
first = generation()
old = arrays(300, 1.0)
ensure_started(SolverOptions(threads=1))
assert generation() == first + 1
new = arrays(300, 2.0)
try:
    old[0].fill(3.0)
except RuntimeError as error:
    print(error)
del old
gc.collect()
others = arrays(300, 4.0)
print(sum(bool((array.to_numpy() != 2.0).any()) for array in new), "overwritten")
"""


def test_arrays_from_before_a_restart_free_none_from_after_it():
    """Taichi frees the array at an old one's address: several of 600, which others then overwrite."""
    result = subprocess.run([sys.executable, "-c", RESTARTED], capture_output=True, text=True, check=True)
    said = ["this array was freed when Taichi restarted: make a new one", "0 overwritten"]
    assert result.stdout.splitlines() == said and not result.stderr
