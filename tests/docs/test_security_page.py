"""docs/security.md names tests and attacks; each of them must be there."""

import ast
import re

import pytest

from tests.docs.console import ROOT

PAGE = (ROOT / "docs" / "security.md").read_text()
TESTS = sorted(set(re.findall(r"`(tests/[^`\s]*::[^`\s]+)`", PAGE)))


@pytest.mark.parametrize("name", TESTS)
def test_a_named_test_is_there(name: str) -> None:
    path, *parts = name.split("::")
    body: list[ast.stmt] = ast.parse((ROOT / path).read_text()).body
    for part in parts:
        (found,) = (
            node
            for node in body
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == part
        )
        body = found.body


def test_named_attacks_are_there_and_each_is_named() -> None:
    # Here: they import most libraries, and every worker imports this module.
    from scripts.programs.attack.attacks import ATTACKS

    assert set(re.findall(r"scripts/attack --only (\w+)", PAGE)) == ATTACKS.keys()


def test_there_are_named_tests() -> None:
    assert len(TESTS) > 20
    assert all(f"`{path}" in PAGE for path in TESTS)
