"""The probability of each site, from the answers of their maps."""

import math

from hypothesis import given
from hypothesis import strategies as st

from projections.adapters.fleet.site_databases import (
    CONFIDENCE_WEIGHT,
    FITTED_SITES,
    INTERCEPT,
    KNOWN_WEIGHT,
    which_site,
)
from projections.localize.relocalize import Answer

SHARES = st.floats(0.0, 1.0)
ANSWERS = st.dictionaries(
    st.text("abcdefgh", min_size=1, max_size=2),
    st.builds(lambda c, k: Answer((), None, c, k), SHARES, SHARES),
    min_size=1,
    max_size=12,
)


def _odds(probability: float) -> float:
    within = min(1.0 - 1e-6, max(1e-6, probability))
    return within / (1.0 - within)


@given(ANSWERS)
def test_they_are_the_shares_of_weighted_odds(answers: dict[str, Answer]) -> None:
    found = which_site(answers)

    weights = {
        name: FITTED_SITES
        / len(answers)
        * math.exp(INTERCEPT)
        * _odds(answer.known) ** KNOWN_WEIGHT
        * _odds(answer.confidence) ** CONFIDENCE_WEIGHT
        for name, answer in answers.items()
    }
    total = 1.0 + sum(weights.values())
    assert math.isclose(found.none, 1.0 / total, rel_tol=1e-9)
    assert {site.name for site in found.sites} == set(answers)
    for site in found.sites:
        assert math.isclose(site.probability, weights[site.name] / total, rel_tol=1e-9)
        assert site.answer is answers[site.name]
    shares = [site.probability for site in found.sites]
    assert shares == sorted(shares, reverse=True)
    assert math.isclose(found.none + sum(shares), 1.0, rel_tol=1e-12)
    assert (found.best is None) == (found.none >= shares[0])


@given(ANSWERS, st.randoms())
def test_the_order_of_the_sites_does_not_matter(
    answers: dict[str, Answer], random: "st.DataObject"
) -> None:
    names = list(answers)
    random.shuffle(names)  # type: ignore[attr-defined]
    assert which_site({name: answers[name] for name in names}) == which_site(answers)


def test_more_sites_that_know_nothing_hardly_change_the_answer() -> None:
    sure, no = Answer((), None, 0.9, 0.99), Answer((), None, 0.01, 0.01)
    few = which_site({"a": sure, "b": no})
    many = which_site({"a": sure} | {f"x{i}": no for i in range(20)})
    assert few.best is not None
    assert many.best is not None
    assert few.best.name == many.best.name == "a"
    assert few.best.probability > many.best.probability > 0.7


def test_without_an_answer_it_is_none_of_them() -> None:
    found = which_site({})
    assert (found.sites, found.none, found.best) == ((), 1.0, None)
