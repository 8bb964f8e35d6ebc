"""Every answer of a timeline against a brute force: folding a shorter log, or a log without one
event."""

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.history import Expression, LogTimeline
from projections.history.bisect import Search
from projections.history.diff import rows_of
from projections.history.merge_reasons import chains_of
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.state_output import state_document
from projections.map.view import MapView
from projections.store.history_records import Merge
from tests.support.thorough import examples
from tests.support.walks import walks, write_log

RULES = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=2.0)
slow = settings(
    deadline=None, max_examples=examples(60), suppress_health_check=[HealthCheck.too_slow]
)


@contextmanager
def timeline(documents: list[dict[str, Any]]) -> Iterator[LogTimeline]:
    with (
        tempfile.TemporaryDirectory() as folder,
        LogTimeline(write_log(Path(folder) / "log", documents), RULES) as opened,
    ):
        yield opened


def folded(opened: LogTimeline, end: int) -> MapView:
    """The map after ``end`` events, folded from the start."""
    with LogReader(opened.reader.path) as reader:
        return fold_log(reader, RULES, end, keep_embeddings=False)[1]


def whole(view: MapView) -> dict[str, Any]:
    members = {place.place_id: place.members for place in view.all_places}
    return {**state_document(view, map_digest(view)), "members": members, "skipped": view.skipped}


@slow
@given(walks(), st.data())
def test_at_is_a_shorter_fold(documents: list[dict[str, Any]], data: st.DataObject) -> None:
    with timeline(documents) as opened:
        for end in data.draw(st.lists(st.integers(0, opened.end), min_size=1, max_size=4)):
            assert whole(opened.at(end)) == whole(folded(opened, end))


@slow
@given(walks(), st.data())
def test_changing_a_view_changes_no_other(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    """A view taken at one offset and folded on gives the later map, and changes no other view."""
    with timeline(documents) as opened:
        end = data.draw(st.integers(0, opened.end))
        view, kept = opened.at(end), opened.at(end)
        before = whole(kept)
        for event in opened.deltas(end):
            view.apply_event(event.offset, event.deltas)
        assert whole(view) == whole(folded(opened, opened.end))
        assert whole(kept) == before


@slow
@given(walks(), st.data())
def test_a_difference_applied_to_the_first_map_gives_the_second(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    with timeline(documents) as opened:
        start, end = (data.draw(st.integers(0, opened.end)) for _ in range(2))
        diff = opened.diff(start, end)
        first, second = rows_of(opened.at(start)), rows_of(folded(opened, end))
        assert diff.apply(first) == second
        changed = [diff.keyframes, diff.places, diff.objects, diff.edges]
        assert diff.same <= all(change.none for change in changed)
        assert all(
            place in diff.absorbed for place in first.places if place not in second.places
        ) or (end < start)


EXPRESSIONS = [
    "place_count < 2",
    "place_count >= 2 and noise_count == 0",
    "noise_count > 2",
    "keyframe_count('run-a') >= 4",
    "object_count('cup') > 1 or object_count >= 4",
    "not keyframe_count < 3 and object_count > 0",
    "keyframe_count < 5",
]


def slow_search(opened: LogTimeline, expression: str, start: int, end: int) -> int | None:
    """The first offset by whose event a condition becomes true, asking a fold at every offset."""

    def holds(events: int) -> bool:
        counts = folded(opened, events).counts()
        view = folded(opened, events)
        names = {
            "place_count": counts["places"],
            "noise_count": counts["noise"],
            "keyframe_count": CallableCount(
                counts["keyframes"], [k.run_id for k in view.keyframes]
            ),
            "object_count": CallableCount(
                counts["objects"], [o.class_name for o in view.objects.values()]
            ),
        }
        return bool(eval(expression, {"__builtins__": {}}, names))

    truths = [holds(events) for events in range(start, end + 1)]
    turns = [i for i in range(len(truths) - 1) if truths[i + 1] and not truths[i]]
    return start + turns[0] if turns else None


class CallableCount(int):
    """``object_count`` and ``object_count('cup')`` at once, for Python's eval as the oracle."""

    names: list[str]

    def __new__(cls, count: int, names: list[str]) -> "CallableCount":
        made = super().__new__(cls, count)
        made.names = names
        return made

    def __call__(self, name: str) -> int:
        return self.names.count(name)


@settings(deadline=None, max_examples=examples(30), suppress_health_check=[HealthCheck.too_slow])
@given(walks(most=20), st.sampled_from(EXPRESSIONS), st.data())
def test_bisect_and_scan_equal_a_linear_search(
    documents: list[dict[str, Any]], expression: str, data: st.DataObject
) -> None:
    with timeline(documents) as opened:
        names = {m.text for m in Expression(expression).mentions()}
        facts = opened.facts()
        kinds = [m.kind for m in Expression(expression).mentions()]
        assume(all(any(name in facts.names(kind) for kind in kinds) for name in names))
        start = data.draw(st.integers(0, opened.end))
        expected = slow_search(opened, expression, start, opened.end)
        for scan in (False, True):
            found = opened.bisect(expression, start, scan=scan)
            assert _offset(found) == expected


@slow
@given(walks(), st.data())
def test_pairs_of_keyframes_are_together_since_the_first_fold_that_says_so(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    with timeline(documents) as opened:
        keyframes = opened.at().keyframes
        assume(keyframes)
        first, second = (data.draw(st.sampled_from(keyframes)).ordinal for _ in range(2))
        names = [f"{k.run_id}:{k.keyframe_id}" for k in (keyframes[first], keyframes[second])]
        expected = next(
            (
                end - 1
                for end in range(opened.end + 1)
                if together(folded(opened, end), first, second)
            ),
            None,
        )
        story = opened.why_same(names[0], names[1])
        assert story.facts["since"] == expected
        found = opened.bisect(f"same_place({names[0]!r}, {names[1]!r})")
        assert _offset(found) == expected


def together(view: MapView, first: int, second: int) -> bool:
    if max(first, second) >= len(view.keyframes):
        return False
    place = view.keyframes[first].place
    return place is not None and place == view.keyframes[second].place


def _offset(search: Search) -> int | None:
    return None if search.found is None else search.found.cause.offset


@slow
@given(walks())
def test_without_its_bridge_a_merge_does_not_happen(documents: list[dict[str, Any]]) -> None:
    """Take the bridging keyframe out of the log: at that offset the places are still apart."""
    with timeline(documents) as opened:
        for merge in opened.merges():
            before = opened.at(merge.cause.offset)
            members = {
                p: before.all_places[p].members[0] for p in merge.places if p in before.places
            }
            assume(len(members) > 1)
            without = list(documents)
            del without[merge.cause.offset]
            with timeline(without) as mended:
                view = mended.at(merge.cause.offset)
                names = [
                    (before.keyframes[k].run_id, before.keyframes[k].keyframe_id)
                    for k in members.values()
                ]
                places = {(k.run_id, k.keyframe_id): k.place for k in view.keyframes}
                assert len({places[name] for name in names}) == len(members)


@slow
@given(walks())
def test_a_merge_shows_from_the_next_offset_on(documents: list[dict[str, Any]]) -> None:
    with timeline(documents) as opened:
        for merge in opened.merges():
            before, after = opened.at(merge.cause.offset), opened.at(merge.cause.offset + 1)
            standing = [place for place in merge.absorbed if place in before.places]
            assert standing or all(
                opened.history.places[p].formed.offset == merge.cause.offset for p in merge.absorbed
            )
            assert not any(place in after.places for place in merge.absorbed)
            assert merge.survivor in after.places
            sizes = {p.ordinal: p.keyframe_count for p in before.places.values()}
            for place, size in zip(merge.absorbed, merge.absorbed_sizes, strict=True):
                assert sizes.get(place, size) == size


@slow
@given(walks())
def test_the_links_of_a_merge_are_true(documents: list[dict[str, Any]]) -> None:
    """Each link joins two points that are core now and near each other, at least one of which was
    not core before; together they join the survivor with every absorbed place."""
    with timeline(documents) as opened:
        for merge in opened.merges():
            before, after = opened.at(merge.cause.offset), opened.at(merge.cause.offset + 1)
            for link in merge.links:
                near = distance_um(after, link.core, link.neighbour)
                assert near <= RULES.eps_m * 1e6
                assert link.distance_um == int(near)
                assert is_core(after, link.core)
                assert is_core(after, link.neighbour)
                assert not (is_core(before, link.core) and is_core(before, link.neighbour))
            assert len(merge.links) == len(merge.absorbed)
            assert_chains_join(opened, merge, before, after)
            event(f"{len(merge.absorbed)} absorbed")


def assert_chains_join(opened: LogTimeline, merge: Merge, before: MapView, after: MapView) -> None:
    """Every absorbed place hangs by core points, each near the next, on one that is joined."""
    joined = {merge.survivor}
    for chain in chains_of(opened.history, merge):
        assert before.keyframes[chain.points[0]].place == chain.joined
        assert before.keyframes[chain.points[-1]].place == chain.absorbed
        assert chain.joined in joined
        joined.add(chain.absorbed)
        for point in (chain.points[0], chain.points[-1]):
            assert is_core(before, point)
        assert chain.made_core
        for point in chain.made_core:
            assert is_core(after, point)
            assert not is_core(before, point)
        for near, far in pairwise(chain.points):
            assert distance_um(after, near, far) <= RULES.eps_m * 1e6
    assert joined == set(merge.places)


def distance_um(view: MapView, a: int, b: int) -> float:
    first, second = view.keyframes[a].pose, view.keyframes[b].pose
    assert first is not None
    assert second is not None
    return math.hypot(first.x_um - second.x_um, first.y_um - second.y_um)


def is_core(view: MapView, keyframe: int) -> bool:
    if keyframe >= len(view.keyframes):
        return False
    posed = [k.ordinal for k in view.keyframes if k.pose is not None]
    near = sum(distance_um(view, keyframe, other) <= RULES.eps_m * 1e6 for other in posed)
    return near >= RULES.min_samples
