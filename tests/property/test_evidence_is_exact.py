"""Fusion by evidence calls no function whose last bit depends on the machine.

Every transcendental function of Python and numpy, and float sums and products whose order a
library chooses, are replaced by ones that raise, or give another last bit; the deltas stay.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from projections.fold.evidence import EvidenceConstants
from projections.fold.evidence_objects import EvidenceObjects
from tests.support.evidence_pictures import a_room, fold_all, fold_one, pictures_of

_OF_MATH = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "exp2", "expm1", "log"),
    *("log2", "log10", "log1p", "pow", "hypot", "dist", "sinh", "cosh", "tanh", "fsum", "cbrt"),
)
_OF_NUMPY = (
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "exp", "exp2", "expm1"),
    *("log", "log2", "log10", "log1p", "power", "float_power", "hypot", "cbrt", "mean", "sum"),
    *("std", "var", "cumsum", "prod", "average", "trapezoid"),
)


def _raising(name: str) -> Callable[..., Any]:
    def raises(*_: Any, **__: Any) -> Any:
        raise AssertionError(f"{name} depends on the machine")

    return raises


def test_it_calls_nothing_of_libm(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = pictures_of(a_room(5, 10), 5, 80)
    before = fold_all(pictures)
    with monkeypatch.context() as patch:
        for name in _OF_MATH:
            patch.setattr(math, name, _raising(f"math.{name}"), raising=False)
        for name in _OF_NUMPY:
            patch.setattr(np, name, _raising(f"np.{name}"), raising=False)
        objects = EvidenceObjects(EvidenceConstants(sizes_m={"chair": 0.5}))
        with_sizes = [delta for picture in pictures for delta in fold_one(objects, picture)]
        after = fold_all(pictures)
    assert before == after
    assert len(with_sizes) >= len(before) // 2


def test_no_float_is_raised_to_a_power() -> None:
    """``x ** 0.5`` is libm's pow; `math.sqrt` is correctly rounded."""
    import ast
    import inspect

    from projections.fold import (
        agreement,
        evidence_fusion,
        evidence_matching,
        evidence_merging,
        evidence_objects,
        exact,
        looks,
        presence,
        sights,
        spots,
        thing_index,
        things,
    )

    modules = (
        *(agreement, evidence_fusion, evidence_matching, evidence_merging),
        *(evidence_objects, exact, looks, presence, sights, spots, thing_index, things),
    )
    for module in modules:
        tree = ast.parse(inspect.getsource(module))
        powers = [node for node in ast.walk(tree) if isinstance(node, ast.Pow)]
        assert powers == [], module.__name__
        sums = [
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id == "sum"
        ]
        # Python 3.12 changed how sum() adds floats; those of things and exact are of integers.
        assert not sums or module in (exact, things), module.__name__
