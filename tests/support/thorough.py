"""How much the tests try: less by default, everything under ``scripts/test_slow``."""

import os
from collections.abc import Iterable
from typing import Any, TypeVar

import pytest

_Case = TypeVar("_Case")

THOROUGH = os.environ.get("MAPFOLD_TEST_THOROUGH") == "1"


def examples(number: int) -> int:
    """Hypothesis examples of a test: ``number`` when thorough, else a tenth of it."""
    return number if THOROUGH else -(-number // 10)


def stride(quick: int) -> int:
    """Step of a loop over every byte or statement: 1 when thorough, else ``quick``."""
    return 1 if THOROUGH else quick


def rounds(number: int, quick: int) -> int:
    """Repetitions, or size of the data, of a test: ``number`` when thorough, else ``quick``."""
    return number if THOROUGH else quick


def every_other(cases: Iterable[_Case]) -> list[_Case]:
    """Cases of a grid: all when thorough, else every other one.

    In a `product` of two values and an odd number of others, each value stays.
    """
    return list(cases)[:: stride(2)]


def mostly_slow(cases: Iterable[Any], quick: int = 1) -> list[Any]:
    """Cases for `pytest.mark.parametrize`: all but the first ``quick`` are marked slow.

    A tuple is the values of several parameters; wrap one that is the value of a single parameter.
    """
    found: list[Any] = []
    for number, case in enumerate(cases):
        given = case if isinstance(case, tuple) else (case,)
        slow = [pytest.mark.slow] if number >= quick else []
        found.append(pytest.param(*given, marks=slow))
    return found
