"""Answers to generated questions against those recorded of a slower ranking."""

import json

import pytest

from projections.localize.relocalize import rank
from tests.support.recorded import FILE, numbers, questions


def test_answers_are_those_recorded_of_the_ranking_crop_by_crop() -> None:
    """Places in the same order, and positions, probabilities and weights to 1e-9."""
    recorded = json.loads(FILE.read_text("utf-8"))
    names = []
    for name, question, candidates in questions():
        names.append(name)
        found, expected = numbers(rank(question, candidates, top=5)), recorded[name]
        assert [place for place, _ in found["places"]] == [p for p, _ in expected["places"]], name
        scores = [score for _, score in expected["places"]]
        assert [score for _, score in found["places"]] == pytest.approx(scores, abs=1e-9), name
        for what in ("pose", "probabilities", "hypotheses"):
            near = pytest.approx(expected[what], abs=1e-9, rel=1e-9, nan_ok=True)
            assert found[what] == near, (name, what)
    assert names == list(recorded)
