"""A `Rejected` has no truth value: nothing tests whether a call rejects but by `isinstance` or `is None`."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

FILES = sorted((Path(__file__).resolve().parents[1] / "segslam").rglob("*.py"))
TREES = {file: ast.parse(file.read_text(encoding="utf-8")) for file in FILES}
CALLABLES = {"gate", "also", "first", "second"}
"""Attributes and parameters that hold a `Gate`."""
REJECTING = CALLABLES | {
    node.name
    for tree in TREES.values()
    for node in ast.walk(tree)
    if isinstance(node, ast.FunctionDef) and node.returns and ast.unparse(node.returns) == "Rejected | None"
}


def _tested(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions that are tested for their truth value."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BoolOp):
            yield from node.values
        elif isinstance(node, ast.If | ast.IfExp | ast.While | ast.Assert):
            yield node.test
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield node.operand


def _lost_rejections(tree: ast.AST) -> list[str]:
    """Calls whose rejection raises where it is tested; results stored in a variable first are not followed."""
    names = (
        (test.func.attr if isinstance(test.func, ast.Attribute) else getattr(test.func, "id", ""), test.lineno)
        for test in _tested(tree)
        if isinstance(test, ast.Call)
    )
    return [f"line {line}: {name}" for name, line in names if name in REJECTING]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_no_rejection_is_tested_for_its_truth_value(file: Path) -> None:
    assert not _lost_rejections(TREES[file])


@pytest.mark.parametrize(
    "code",
    ["x = far_from_prior(pose) or pose", "if self.gate(T, slack_m=0.0): pass", "y = 1 if far_from_prior() else 2"],
)
def test_a_lost_rejection_is_found(code: str) -> None:
    assert _lost_rejections(ast.parse(code))
