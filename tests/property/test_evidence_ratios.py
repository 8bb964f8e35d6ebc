"""Evidence of one pair alone is that of the pair among many, to the last bit."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.agreement import log_of, logs
from projections.fold.evidence import EvidenceConstants
from projections.fold.evidence_objects import EvidenceObjects
from projections.fold.exact import cos_sin
from projections.fold.looks import LookRatios
from projections.fold.spots import Spots
from projections.fold.things import FusedThing, LabelCounts
from tests.support.evidence_pictures import a_room, fold_one, pictures_of
from tests.support.thorough import examples

LABELS = st.sampled_from(["chair", "table", "bed", "lamp"])
POSITIVE = st.floats(1e-12, 1e12)
_ANGLE = st.floats(-4.0, 4.0)


@given(st.lists(POSITIVE, min_size=1, max_size=9))
def test_one_logarithm_is_that_of_an_array(values: list[float]) -> None:
    assert [log_of(value) for value in values] == logs(np.array(values)).tolist()


@given(POSITIVE)
def test_a_logarithm_is_right_to_five_digits(value: float) -> None:
    assert abs(log_of(value) - math.log(value)) < 2e-5


@given(
    st.lists(LABELS, max_size=30), st.dictionaries(LABELS, st.integers(1, 40), min_size=1), LABELS
)
def test_a_label_speaks_by_how_much_likelier_it_is_for_the_thing(
    learned: list[str], classes: dict[str, int], label: str
) -> None:
    counts = LabelCounts()
    counts.learn(learned)
    total = sum(classes.values())
    thing = FusedThing(total, 0, 0, 0.0, 0.0, next(iter(classes)), classes, Spots())
    usual = counts.usual(label)
    assert usual == pytest.approx((learned.count(label) + 1) / (len(learned) + 10))
    own = (classes.get(label, 0) + 0.3 * usual) / (total + 0.3)
    assert abs(counts.ratio(thing, label, usual) - math.log(own / usual)) < 2e-5


@given(
    st.lists(st.tuples(st.floats(-1.0, 1.0), _ANGLE, st.integers(0, 2)), min_size=1, max_size=6),
    _ANGLE,
    st.integers(0, 2),
    st.booleans(),
    st.floats(-0.5, 0.9),
)
def test_a_look_and_exemplars_one_by_one_are_as_in_arrays(
    exemplars: list[tuple[float, float, int]],
    toward: float,
    run: int,
    agree: bool,
    different: float,
) -> None:
    ratios = LookRatios(EvidenceConstants())
    rows = list(range(len(exemplars)))[::-1]  # looks are in another order than exemplars
    marks = [
        (1.0 / 2048, *cos_sin(angle), own, own * 8, row)
        for (_, angle, own), row in zip(exemplars, rows, strict=True)
    ]
    dots = [0.0] * len(rows)
    for (cosine, _, _), row in zip(exemplars, rows, strict=True):
        dots[row] = float(round(cosine * 2048 * 2048))
    cos, sin = cos_sin(toward)
    ratio, best = ratios.of_exemplars(dots, marks, 1.0 / 2048, cos, sin, run, agree, different)
    cosines = np.array([dots[row] for row in rows]) / 2048 / 2048
    each = ratios.ratios(
        (cosines - different) * (1.0 / (1.0 - different)),
        np.array([mark[1] * cos + mark[2] * sin for mark in marks]),
        np.array([mark[3] != run for mark in marks]),
        np.array([agree] * len(marks)),
    )
    four = sorted(each.tolist(), reverse=True)[:4]
    assert best == cosines.max()
    assert ratio == pytest.approx(sum(four) / len(four) - 0.125 * (4 - len(four)), abs=1e-12)


@given(st.lists(st.tuples(st.integers(0, 2), _ANGLE), max_size=40))
def test_exemplars_are_the_newest_of_their_kind(kept: list[tuple[int, float]]) -> None:
    """Against a plain list: of a kind the last three, of all the last six."""
    thing, naive = FusedThing(0, 0, 0, 0.0, 0.0, "chair", {}, Spots()), list[tuple[int, int, int]]()
    for number, (run, angle) in enumerate(kept):
        cos, sin = cos_sin(angle)
        thing.keep(np.full(4, number, np.float32), 0.5, cos, sin, run)
        eighth = (cos > 0, sin > 0, abs(cos) > abs(sin))
        kind = run * 8 + sum(bit * flag for bit, flag in zip((4, 2, 1), eighth, strict=True))
        alike = [other for other in naive if other[1] == kind]
        if len(alike) == 3:
            naive.remove(alike[0])
        elif len(naive) == 6:
            naive.pop(0)
        naive.append((number, kind, run))
    assert [(thing.looks[row][0], kind, run) for *_, run, kind, row in thing.marks] == naive
    assert sorted(row for *_, row in thing.marks) == list(range(len(naive)))


@settings(max_examples=examples(10), deadline=None)
@given(st.integers(0, 10_000))
def test_the_looks_of_one_thing_compare_as_among_several(seed: int) -> None:
    objects = EvidenceObjects(EvidenceConstants())
    for picture in pictures_of(a_room(seed, 10), seed, 40):
        fold_one(objects, picture)
    things = [thing for thing in objects._index._things if thing is not None]
    merging = objects._merging
    for one in things:
        assert merging._looks(one, things) == [merging._looks(one, [o])[0] for o in things]
