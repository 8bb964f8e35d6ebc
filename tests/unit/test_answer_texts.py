"""What an answer says of its evidence and scores."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from projections.localize.relocalize import parse_question, rank
from projections.localize.relocalize.candidates import ExactIndex
from projections.localize.relocalize.ranking import Method, _place_shares
from projections.surfaces.cli.relocalize import answer_text
from tests.support.envelopes import payload
from tests.unit.test_floors_in_answers import LOOKS, ask, building


@pytest.mark.parametrize("method", ["joint", "plain"])
def test_a_class_that_is_compared_with_nothing_has_no_similarity(method: Method) -> None:
    index = ExactIndex(building({"ground": {}}))
    question = parse_question(
        payload([{"class": "chair"}, {"embedding": LOOKS["ground", "lamp"], "class": "lamp"}])
    )
    answer = rank(question, index.search(question.crops), method=method)
    told = [line.split()[:2] for line in answer_text(answer).splitlines() if line[:3] == "   "]
    assert sorted(told) == [["1.000", "lamp"], ["class", "chair"]]
    (place,) = answer.document()["places"]
    assert [set(seen) for seen in place["evidence"]] == [
        {"det_id", "object_id", "class_name", "similarity"}
    ] * 2
    assert [seen["similarity"] for seen in place["evidence"]] == pytest.approx([1.0, 1.0])


@dataclass
class Weighed:
    """The part of a posterior that shares are made of."""

    poses: NDArray[np.float64]
    weights: NDArray[np.float64]


def test_a_share_is_at_most_one_whatever_the_rounding() -> None:
    view = building({"ground": {}})
    question = parse_question(payload([{"class": "chair"}]))
    candidates = ExactIndex(view).search(question.crops)
    poses = np.zeros((2, 3))
    for weights, share in (([0.5, 0.5 + 2**-51], 1.0), ([0.5, 0.5 - 2**-51], 1.0 - 2**-51)):
        weighed = Weighed(poses, np.array(weights))
        assert list(_place_shares(candidates, weighed).values()) == [share]  # type: ignore[arg-type]
    assert ask(view, "ground").places[0].score <= 1.0
