"""What-if against a fold of each setting alone, compared after every event."""

import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.history.whatif import what_if
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.view import MapView
from tests.support.envelopes import envelope
from tests.support.thorough import examples, rounds
from tests.support.walks import walks, write_log

BASE = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=2.0)
OTHERS = st.lists(
    st.builds(
        Settings,
        eps_m=st.sampled_from([0.7, 1.1, 1.4]),
        min_samples=st.integers(2, 4),
        fusion_radius_m=st.sampled_from([1.0, 2.0]),
        fusion_similarity=st.sampled_from([0.7, 0.999]),
        fusion=st.sampled_from(["page", "page", "evidence"]),
    ),
    min_size=1,
    max_size=3,
)


def groups(view: MapView) -> tuple[set[frozenset[int]], set[frozenset[int]]]:
    """The places as sets of keyframes and the objects as sets of observations."""
    return (
        {frozenset(place.members) for place in view.places.values()},
        {frozenset(found.observations) for found in view.objects.values()},
    )


def parting(first: list[Any], second: list[Any]) -> int | None:
    """The first event after which two lists of states, one per number of events, differ."""
    return next(
        (i - 1 for i, pair in enumerate(zip(first, second, strict=True)) if pair[0] != pair[1]),
        None,
    )


@settings(deadline=None, max_examples=examples(40), suppress_health_check=[HealthCheck.too_slow])
@given(walks(most=20), OTHERS)
def test_whatif_equals_separate_folds(
    documents: list[dict[str, Any]], others: list[Settings]
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        found = what_if(log, BASE, others, len(documents))
        states: dict[Settings, list[Any]] = {}
        with LogReader(log) as reader:
            for each in {BASE, *others}:
                views = [fold_log(reader, each, n)[1] for n in range(len(documents) + 1)]
                states[each] = [groups(view) for view in views]
                states[each].append(map_digest(views[-1]))
    for each, alternative in zip(others, found.alternatives, strict=True):
        base, other = states[BASE], states[each]
        assert alternative.result.digest == other[-1]
        assert alternative.places.same is (base[-2][0] == other[-2][0])
        assert alternative.objects.same is (base[-2][1] == other[-2][1])
        for index, parted in enumerate((alternative.places_part_at, alternative.objects_part_at)):
            expected = parting([s[index] for s in base[:-1]], [s[index] for s in other[:-1]])
            assert parted == expected


@settings(deadline=None, max_examples=examples(20), suppress_health_check=[HealthCheck.too_slow])
@given(walks(most=20))
def test_equal_settings_change_nothing(documents: list[dict[str, Any]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        log = write_log(Path(folder) / "log", documents)
        found = what_if(log, BASE, [BASE], len(documents))
    (same,) = found.alternatives
    assert same.same
    assert same.places_part_at is None
    assert same.objects_part_at is None
    assert same.result.digest == found.base.result.digest
    assert same.name == "no change"


@pytest.mark.slow
def test_a_long_chain_of_merges_can_be_pickled(tmp_path: Path) -> None:
    """Each place is absorbed by the one founded before it, the last one first: a pickle that went
    from survivor to survivor would go too deep."""
    far, count = Settings(eps_m=1.0, min_samples=2), rounds(3_000, 600)
    first = [envelope(n, 1.5 * n) for n in range(count)]
    second = [envelope(count + n, 1.5 * n + 0.1) for n in reversed(range(count))]
    between = [envelope(2 * count + n, 1.5 * n + 0.8) for n in range(count - 1)]
    documents = [*first, *second, *between]
    log = write_log(tmp_path / "log", documents)
    found = what_if(log, far, [BASE], len(documents), processes=2, keep_views=True)
    assert found.base.result.merges == count - 1
    for each in found.all:
        assert each.result.view is not None
        assert map_digest(each.result.view) == each.result.digest
