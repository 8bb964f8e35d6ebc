"""Every reader of other people's bytes, fed with bytes that are almost right (`scripts/fuzz`).

`scripts/fuzz` goes on for as long as one likes, guided by coverage.
"""

import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from scripts.programs.fuzz.target import Target
from scripts.programs.fuzz.targets import TARGETS
from tests.support.thorough import examples

EXAMPLES = examples(300)


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS.keys())
def test_valid_input_is_read(target: Target) -> None:
    for seed in target.seeds():
        target.check(seed)


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS.keys())
def test_only_documented_errors(target: Target) -> None:
    @settings(max_examples=EXAMPLES, deadline=None)
    @given(number=st.integers(0, 2**32))
    @example(number=0)
    def check(number: int) -> None:
        target.check(target.mutated_seed(random.Random(number)))

    check()
