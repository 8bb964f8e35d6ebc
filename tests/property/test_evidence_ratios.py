"""Evidence of one pair alone is that of the pair among many, to the last bit."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.evidence import EvidenceConstants
from projections.reducers.agreement import log_of, logs
from projections.reducers.evidence_objects import EvidenceObjects
from projections.reducers.label_counts import LabelCounts
from projections.reducers.spots import Spots
from projections.reducers.things import Thing
from tests.evidence_pictures import a_room, fold_one, pictures_of

LABELS = st.sampled_from(["chair", "table", "bed", "lamp"])
POSITIVE = st.floats(1e-12, 1e12)


@given(st.lists(POSITIVE, min_size=1, max_size=9))
def test_one_logarithm_is_that_of_an_array(values: list[float]) -> None:
    assert [log_of(value) for value in values] == logs(np.array(values)).tolist()


@given(POSITIVE)
def test_a_logarithm_is_right_to_five_digits(value: float) -> None:
    assert abs(log_of(value) - math.log(value)) < 2e-5


@given(
    st.lists(LABELS, max_size=30),
    st.lists(
        st.tuples(st.dictionaries(LABELS, st.integers(1, 40), min_size=1), LABELS),
        min_size=1,
        max_size=9,
    ),
)
def test_the_ratio_of_one_label_is_that_of_a_pair_among_many(
    learned: list[str], pairs: list[tuple[dict[str, int], str]]
) -> None:
    counts = LabelCounts()
    counts.learn(learned)
    things = [
        Thing(sum(classes.values()), 0, 0, 0.0, 0.0, next(iter(classes)), classes, Spots())
        for classes, _ in pairs
    ]
    labels = [label for _, label in pairs]
    ratios, agree = counts.ratios(things, labels)
    assert ratios.tolist() == [
        counts.ratio(thing, label) for thing, label in zip(things, labels, strict=True)
    ]
    assert agree.tolist() == [label in classes for classes, label in pairs]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_the_looks_of_one_thing_compare_as_among_several(seed: int) -> None:
    objects = EvidenceObjects(EvidenceConstants())
    for picture in pictures_of(a_room(seed, 10), seed, 40):
        fold_one(objects, picture)
    things = [thing for thing in objects._index._things if thing is not None]
    merging = objects._merging
    for one in things:
        assert merging._looks(one, things) == [merging.look(one, other) for other in things]
