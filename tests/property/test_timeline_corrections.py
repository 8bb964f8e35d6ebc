"""Time travel in logs with commands, against a fold of its own for each question: the events before
W under the commands before V."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.commands import Command, NamePlace
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections, compile_corrections
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.diff import rows_of
from projections.history.rule_folds import Rules
from projections.history.whatif import command_trials, what_if
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.parsing import read_commands, read_corrections
from projections.map.state_output import state_document
from projections.map.view import MapView
from tests.support.envelopes import envelope
from tests.support.logs import forget_keyframes, undo
from tests.support.thorough import rounds
from tests.support.walks import anchor, corrected_walks, write_mixed_log

RULES = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=1.0)
Items = list[dict[str, Any] | Command]
slow = settings(
    deadline=None, max_examples=rounds(100, 4), suppress_health_check=[HealthCheck.too_slow]
)


def chosen(corrections: Corrections) -> Settings:
    return corrections.settings or RULES


@contextmanager
def timeline(items: Items) -> Iterator[LogTimeline]:
    with (
        tempfile.TemporaryDirectory() as folder,
        LogTimeline(write_mixed_log(Path(folder) / "log", items), chosen) as opened,
    ):
        yield opened


def folded(opened: LogTimeline, end: int, known_at: int) -> MapView:
    """The map after ``end`` events under the commands before ``known_at``, from the start."""
    with LogReader(opened.reader.path) as reader:
        corrections = read_corrections(reader, known_at)
        return fold_log(
            reader, chosen(corrections), end, keep_embeddings=False, corrections=corrections
        )[1]


def whole(view: MapView) -> dict[str, Any]:
    return {
        **state_document(view, map_digest(view)),
        "members": {p.place_id: p.members for p in view.all_places},
        "names": [(p.name, p.name_offset) for p in view.all_places],
        "objects of observations": [o.object for o in view.observations],
        "all objects": [(o.object_id, o.observations, o.obs_count) for o in view.all_objects],
        "skipped": view.skipped,
    }


@slow
@given(corrected_walks(), st.data())
def test_a_map_is_a_fold_of_its_own_under_what_was_known(items: Items, data: st.DataObject) -> None:
    """Any W under any V, in any order, from one timeline."""
    with timeline(items) as opened:
        points = st.tuples(st.integers(0, opened.end), st.integers(0, opened.end))
        for end, known_at in data.draw(st.lists(points, min_size=1, max_size=6)):
            view = opened.at(end, known_at=known_at)
            assert whole(view) == whole(folded(opened, end, known_at))
            event(f"{len(view.corrections.in_force)} in force")


@slow
@given(corrected_walks(), st.data())
def test_a_map_knows_the_commands_before_it_by_default(items: Items, data: st.DataObject) -> None:
    with timeline(items) as opened:
        for end in data.draw(st.lists(st.integers(0, opened.end), min_size=1, max_size=4)):
            assert whole(opened.at(end)) == whole(folded(opened, end, end))


@slow
@given(corrected_walks(), st.data())
def test_changing_a_view_changes_no_other(items: Items, data: st.DataObject) -> None:
    """A view taken at one offset and folded on gives the later map, and changes no other view."""
    with timeline(items) as opened:
        end, known_at = (data.draw(st.integers(0, opened.end)) for _ in range(2))
        known = opened.knowing(known_at)
        view, kept, last = known.at(end), known.at(end), known.at()
        before, after = whole(kept), whole(last)
        for each in known.deltas(end):
            view.apply_event(each.offset, each.deltas)
        assert whole(view) == after == whole(folded(opened, opened.end, known_at))
        assert whole(kept) == before


@slow
@given(corrected_walks(), st.data())
def test_a_difference_applied_to_the_first_map_gives_the_second(
    items: Items, data: st.DataObject
) -> None:
    """Each map under its own commands, or both under the same."""
    with timeline(items) as opened:
        start, end = (data.draw(st.integers(0, opened.end)) for _ in range(2))
        known_at = data.draw(st.one_of(st.none(), st.integers(0, opened.end)))
        diff = opened.diff(start, end, known_at=known_at)
        first = folded(opened, start, start if known_at is None else known_at)
        second = folded(opened, end, end if known_at is None else known_at)
        assert diff.apply(rows_of(first)) == rows_of(second)
        assert diff.digests == (map_digest(first), map_digest(second))
        between = [i for i in range(*sorted((start, end))) if not isinstance(items[i], dict)]
        assert [c.offset for c in diff.commands] == ([] if known_at is not None else between)


def test_counts_of_a_difference_are_of_both_maps_when_one_leaves_nothing_out() -> None:
    walk = [envelope(n, 0.5 * n, 0.0) for n in range(6)]
    forgotten = forget_keyframes(2, 3)
    with timeline([*walk, forgotten, undo(forgotten)]) as opened:
        assert opened.diff(7, 8).document()["counts"]["forgotten"] == [2, 0]
        assert opened.diff(6, 7).document()["counts"]["forgotten"] == [0, 2]


@settings(deadline=None, max_examples=rounds(60, 4), suppress_health_check=[HealthCheck.too_slow])
@given(corrected_walks(most=20), st.sampled_from(["kitchen", "hall"]), st.data())
def test_a_name_is_found_by_the_fold_that_has_it_first(
    items: Items, name: str, data: st.DataObject
) -> None:
    documents = [item for item in items if isinstance(item, dict) and "run_id" in item]
    assume(documents)
    named_one = data.draw(st.sampled_from(documents))
    place = anchor(named_one["run_id"], named_one["keyframe_id"])
    said = NamePlace(command_id="the-name", issued_by="ann@lab", place=place, name=name)
    items.insert(data.draw(st.integers(0, len(items))), said)
    with timeline(items) as opened:
        known_at = opened.end
        views = [folded(opened, end, known_at) for end in range(opened.end + 1)]
        named = [any(p.name == name for p in view.places.values()) for view in views]
        turns = [i for i in range(opened.end) if named[i + 1] and not named[i]]
        known = opened.knowing(known_at)
        found = known.bisect(f"named('{name}')").found
        assert (None if found is None else found.cause.offset) == (turns[0] if turns else None)
        for view in views:
            facts = known.facts(view.next_offset)
            called = (p.place_id for p in view.places.values() if p.name == name)
            assert facts.place_called(name) == next(called, None)
            assert facts.object_count() == len(view.objects)
            for each in view.all_places:
                stands = each.ordinal in view.places
                assert facts.name(each.place_id) == (each.name if stands else None)
            for found_object in view.objects.values():
                assert facts.sightings(found_object.object_id) == found_object.obs_count
                assert facts.located_in(found_object.object_id) == view.place_id(found_object.place)


def groups(view: MapView) -> tuple[set[Any], set[Any]]:
    """Places as sets of keyframes and objects as sets of detections, by what the log calls them."""
    keyframes = [(k.run_id, k.keyframe_id) for k in view.keyframes]
    return (
        {frozenset(keyframes[k] for k in p.members) for p in view.places.values()},
        {
            frozenset(view.observations[o].det_id for o in found.observations)
            for found in view.objects.values()
        },
    )


@settings(deadline=None, max_examples=rounds(60, 4), suppress_health_check=[HealthCheck.too_slow])
@given(corrected_walks(most=20), st.data())
def test_whatif_without_a_command_equals_a_fold_without_it(
    items: Items, data: st.DataObject
) -> None:
    given_ids = [item.command_id for item in items if not isinstance(item, dict)]
    assume(given_ids)
    left_out = data.draw(st.sampled_from(given_ids))
    with tempfile.TemporaryDirectory() as folder:
        log = write_mixed_log(Path(folder) / "log", items)
        with LogReader(log) as reader:
            commands = read_commands(reader)
            kept = [c for c in commands if c.command.command_id != left_out]
            both = [compile_corrections(each) for each in (commands, kept)]
            views = [
                [
                    fold_log(reader, chosen(each), n, corrections=each)[1]
                    for n in range(len(items) + 1)
                ]
                for each in both
            ]
        trials = command_trials(commands, [left_out], chosen)
        found = what_if(log, Rules(chosen(both[0]), both[0]), trials, len(items))
    (without,) = found.alternatives
    assert found.base.result.digest == map_digest(views[0][-1])
    assert without.result.digest == map_digest(views[1][-1])
    assert without.without is not None
    assert without.without.command.command_id == left_out
    states = [[groups(view) for view in each] for each in views]
    for part, parted in enumerate((without.places_part_at, without.objects_part_at)):
        pairs = zip(*(each for each in states), strict=True)
        differ = [n - 1 for n, (a, b) in enumerate(pairs) if a[part] != b[part]]
        assert parted == (differ[0] if differ else None)
    assert without.places.same is (states[0][-1][0] == states[1][-1][0])
    assert without.objects.same is (states[0][-1][1] == states[1][-1][1])
    named = [
        {p.place_id: p.name for p in each[-1].places.values() if p.name is not None}
        for each in views
    ]
    assert without.renamed == {
        place: (named[0].get(place), named[1].get(place))
        for place in sorted(named[0].keys() | named[1].keys())
        if named[0].get(place) != named[1].get(place)
    }
