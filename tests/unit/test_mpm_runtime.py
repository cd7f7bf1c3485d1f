# SPDX-License-Identifier: MIT
"""What this project changes in Taichi is given up, never insisted on, where Taichi is another."""

from types import SimpleNamespace

import pytest
from physgen.sim.mpm.kernels import runtime
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
