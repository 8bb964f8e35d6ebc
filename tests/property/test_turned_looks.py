"""How alike two things look that may be turned, beside loops over angles and pairs."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from projections.fold.evidence import EvidenceConstants
from projections.fold.evidence_merging import turned_looks
from projections.fold.looks import LookRatios, LookScale, looks_of
from projections.fold.spots import Spots
from projections.fold.things import FusedThing
from tests.support.thorough import examples

DIM = 48
RATIOS = LookRatios(EvidenceConstants())
SCALE = LookScale(0.5)
CASES = settings(max_examples=examples(40), deadline=None)
SEEDS = st.integers(0, 10_000)
Picture = tuple[np.ndarray, float, int]
"""An embedding, the side that it shows, radians, and the run."""


def thing_of(pictures: list[Picture]) -> FusedThing:
    """A thing whose exemplars are these pictures."""
    thing = FusedThing(1, 0, 0, 0.0, 0.0, "chair", {"chair": 1}, Spots())
    for vector, side, run in pictures:
        unit = np.rint(vector / np.linalg.norm(vector) * 2**20)
        looks, inverses = looks_of([unit])
        thing.keep(looks[0], float(inverses[0]), math.cos(side), math.sin(side), run)
    return thing


def pictures(
    chance: np.random.Generator, like: list[np.ndarray], run: int, count: int, turned: float = 0.0
) -> list[Picture]:
    """Pictures of a thing from all around: ``like`` is its look, then its front and its left."""
    made = []
    for _ in range(count):
        side = float(chance.uniform(-math.pi, math.pi))
        noise = chance.normal(size=DIM) * 0.1
        vector = like[0] + 0.4 * math.cos(side) * like[1] + 0.4 * math.sin(side) * like[2] + noise
        made.append((vector, side + turned, run))
    return made


def slow(one: FusedThing, other: FusedThing) -> float:
    """As the module's text says, in plain floats."""
    likelihoods = []
    for turn in range(8):
        angle = turn * math.pi / 4
        total = 0.0
        for _, a_cos, a_sin, a_run, _, i in one.marks:
            for _, b_cos, b_sin, b_run, _, j in other.marks:
                a, b = one.looks[i].astype(float), other.looks[j].astype(float)
                cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
                apart = math.atan2(b_sin, b_cos) - math.atan2(a_sin, a_cos) + angle
                (ratio,) = RATIOS.ratios(
                    np.array([max((cosine - 0.5) / 0.5, 0.0)]),
                    np.array([math.cos(apart)]),
                    np.array([a_run != b_run]),
                    np.array([True]),
                )
                total += min(max(float(ratio), -6.0), 6.0)
        likelihoods.append(math.exp(total / math.sqrt(len(one.marks) * len(other.marks))))
    return math.log(sum(likelihoods) / 8)


@CASES
@given(SEEDS, st.integers(1, 6), st.lists(st.integers(1, 6), max_size=4))
def test_ratios_are_those_of_loops(seed, own, others):
    chance = np.random.default_rng(seed)
    like = list(chance.normal(size=(3, DIM)) + 0.7)
    one = thing_of(pictures(chance, like, 0, own))
    rest = [
        thing_of(pictures(chance, [like[0] + k * chance.normal(size=DIM), *like[1:]], k % 2, count))
        for k, count in enumerate(others)
    ]
    told = turned_looks(one, rest, RATIOS, SCALE)
    # A table's step of likeness or side may round the other way: an oracle of floats is near.
    assert told == pytest.approx([slow(one, other) for other in rest], abs=0.35)
    assert told == [turned_looks(one, [other], RATIOS, SCALE)[0] for other in rest]


@CASES
@given(SEEDS, st.integers(0, 7))
def test_a_thing_may_stand_turned(seed, turn):
    """Turned by eighths of a circle the same angles are averaged, so the ratio is the same."""
    chance = np.random.default_rng(seed)
    like = list(chance.normal(size=(3, DIM)) + 0.7)
    one = thing_of(pictures(chance, like, 0, 4))
    later = pictures(chance, like, 1, 3)
    straight = thing_of(later)
    turned = thing_of([(v, side + turn * math.pi / 4, run) for v, side, run in later])
    (expected,) = turned_looks(one, [straight], RATIOS, SCALE)
    (found,) = turned_looks(one, [turned], RATIOS, SCALE)
    assert found == pytest.approx(expected, abs=0.35)


def test_the_same_thing_turned_looks_more_alike_than_another():
    same, other = [], []
    for seed in range(20):
        chance = np.random.default_rng(seed)
        common = chance.normal(size=DIM) + 0.7
        chair, stool = (
            [common + chance.normal(size=DIM), *chance.normal(size=(2, DIM))] for _ in "ab"
        )
        one = thing_of(pictures(chance, chair, 0, 6))
        later = [thing_of(pictures(chance, like, 1, 4, 2.0)) for like in (chair, stool)]
        yes, no = turned_looks(one, later, RATIOS, SCALE)
        same.append(yes)
        other.append(no)
    assert min(same) > 2.0
    assert max(other) < 0.0


def test_nothing_is_compared_with_nothing():
    assert turned_looks(thing_of([(np.ones(DIM), 0.0, 0)]), [], RATIOS, SCALE) == []
